"""All failures that perchctl reports, as one exception hierarchy.

Each class has the exit code of the process; `EXIT_CODES` is the table that is shown in `fly --help`
and the README. Each message says in one sentence what was found, what is allowed and what to do.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal

MOST_DECIMALS = 9


def distinct_texts(found: float, limit: float, decimals: int) -> tuple[str, str]:
    """Return `found` and `limit` as text for a message, with `decimals` decimals or as many as the
    limit has. If both texts would be the same, more decimals are used."""
    own = -int(Decimal(f"{limit:g}").as_tuple().exponent)
    for count in range(min(max(decimals, own), MOST_DECIMALS), MOST_DECIMALS + 1):
        texts = f"{found:.{count}f}", f"{limit:.{count}f}"
        if texts[0] != texts[1]:
            break
    return texts


@dataclass(frozen=True)
class Problem:
    """A problem. `found`: the reading and its limit; `advice`: what to do."""

    found: str
    advice: str

    @property
    def sentence(self) -> str:
        return f"{self.found}: {self.advice}"


class PerchError(Exception):
    """Base of all reported failures; the process ends with its `exit_code`.

    The message is `found`, followed by `advice` (what to do about it) if that is given.
    """

    exit_code = 1
    meaning = "other failure"

    def __init__(self, found: str = "", advice: str = "", *, separator: str = "; ") -> None:
        super().__init__(f"{found}{separator}{advice}" if advice else found)
        self.found, self.advice = found, advice


class UsageError(PerchError):
    exit_code = 2
    meaning = "invalid command line"


def _install(extra: str) -> str:
    return f"install it with: {sys.executable} -m pip install 'perchctl[{extra}]'"


def no_simulator(missing: str | None = "mujoco") -> UsageError:
    """The error to raise if the extra ``sim``, which provides the module `missing`, is not
    installed."""
    return UsageError(f"the simulator is not installed ({missing} is missing); {_install('sim')}")


def no_motion_capture(needed_by: str = "positioning by motion capture") -> UsageError:
    """The error if the extra ``mocap`` is not installed."""
    return UsageError(f"{needed_by} needs the motioncapture library; {_install('mocap')}")


def broken_motion_capture(why: str) -> UsageError:
    """The error if the extra ``mocap`` is installed but cannot be loaded."""
    return UsageError(
        f"the motioncapture library cannot be loaded: {why}; reinstall it with: "
        f"{sys.executable} -m pip install --force-reinstall 'perchctl[mocap]'"
    )


def unfit_cflib(part: str, version: str) -> UsageError:
    """The error for a cflib version that lacks `part`, which perchctl reads or replaces."""
    return UsageError(
        f"cflib {version} has no {part}, which perchctl needs; install a supported "
        f"version with: {sys.executable} -m pip install 'cflib>=0.1.34,<0.2'"
    )


def no_cluster(why: str = "it is missing") -> UsageError:
    """The error if the extra ``cluster`` is not installed or cannot be loaded."""
    return UsageError(f"--cluster needs the distributed library ({why}); {_install('cluster')}")


class ConnectionFailed(PerchError):
    exit_code = 10
    meaning = "no connection to the vehicle, motion capture or cluster, or camera lost"


class NotFound(PerchError):
    exit_code = 20
    meaning = "file, profile, variable or camera not found, or camera cannot be opened"


class InvalidValue(PerchError):
    exit_code = 30
    meaning = "invalid value in a profile, file or option"


class TimedOut(PerchError):
    exit_code = 40
    meaning = "timeout before the flight, such as no image from the camera"


class TargetNotFound(PerchError):
    exit_code = 50
    meaning = "target not found, landed"


class AttemptsUsedUp(PerchError):
    exit_code = 51
    meaning = "out of attempts or perching time, landed or left hanging"


class SafetyAbort(PerchError):
    exit_code = 52
    meaning = "safety abort"


class EmergencyStopped(PerchError):
    exit_code = 53
    meaning = "emergency stop, motors cut"


class LogIncomplete(PerchError):
    exit_code = 60
    meaning = "perched, hovered or simulated, but a flight log is incomplete"


class ReplayDiffers(PerchError):
    exit_code = 61
    meaning = "a replay differs from the flight in a decision or a pose"


class Interrupted(PerchError):
    exit_code = 130
    meaning = "interrupted by Ctrl-C: landed, or left on the ground or hanging"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return a question about the known name that is most similar to an unknown one, with a space
    after it; empty if none is similar."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f"did you mean {close[0]}? " if close else ""


def require_type(name: str, value: object, *kinds: type) -> None:
    """Raise InvalidValue, which names the argument, unless the value has one of these types."""
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        allowed = " or ".join(kind.__name__ for kind in kinds)
        raise InvalidValue(f"{name} must be {allowed}, found {type(value).__name__}: {value!r:.80}")


class Note(UserWarning):
    """A warning of one sentence for the user; the command line prints each one once."""


class ProfileNote(Note):
    """Warns that a key in a profile has been renamed or is not used; the profile was read
    anyway."""


_ALL: list[type[PerchError]] = [PerchError, *PerchError.__subclasses__()]
EXIT_CODES: dict[int, str] = {0: "perched, or hovered and landed (or the command succeeded)"} | {
    cls.exit_code: cls.meaning for cls in _ALL
}
