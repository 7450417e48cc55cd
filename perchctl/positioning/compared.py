"""What a comparison by hand found of a motion capture (`perchctl check --lift`), kept for `fly`.

Axes that are swapped do not show on a vehicle at rest that stands as it stood when its body was
defined: all numbers look right. Only a hand that lifts and turns it tells. So each comparison is
written down, for exactly the vehicle and set-up that it is true of, and a flight asks for one that
passed, at most `VALID_S` old. What cannot be read, or is of another time than the past, is unknown,
and no comparison.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import AwareDatetime, BaseModel, ConfigDict, ValidationError

from perchctl.errors import InvalidValue
from perchctl.files import write_files
from perchctl.places import user_state_folder
from perchctl.profile import PositioningConfig

VALID_S = 24 * 3600.0
AHEAD_S = 60.0
"""A computer's clock is set by so much, now and then."""
MOST_FOUND = 300
AGAIN = "run perchctl check --lift, lift the vehicle and turn it by hand"


@dataclass(frozen=True)
class NoComparison:
    """There is no comparison of a vehicle with its motion capture, or none that can be read.
    `found` and `advice` go into a sentence."""

    found: str
    advice: str = f"{AGAIN}, once"

    def objection(self, now: datetime) -> tuple[str, str] | None:
        """Say why no flight may rely on it: what was found, and what to do. None where it passed,
        and not long ago. `now` has a time zone, in which dates are shown."""
        return self.found, self.advice


NEVER = NoComparison("the motion capture was never compared with this vehicle")


@dataclass(frozen=True)
class Comparison:
    """A comparison's date (with its time zone), whether it passed, and what it found."""

    at: datetime
    passed: bool
    found: str

    def objection(self, now: datetime) -> tuple[str, str] | None:
        """Object to one that did not pass, is older than `VALID_S`, or lies in the future."""
        when = _date_text(self.at, now)
        if not self.passed:
            return f"{self.found} (found by check --lift on {when})", f"mend that, then {AGAIN}"
        age_s = (now - self.at).total_seconds()
        if age_s < -AHEAD_S:
            found = f"the motion capture was compared on {when}, which is yet to come"
            return found, f"set this computer's clock, then {AGAIN}"
        if age_s > VALID_S:
            hours = age_s / 3600.0
            old = f"{hours:.0f} h" if hours < 72.0 else f"{hours / 24.0:.0f} days"
            found = f"the motion capture was last compared {old} ago, on {when} (24 h at most)"
            return found, AGAIN
        return None

    def text(self, now: datetime) -> str:
        """Say when the comparison passed."""
        return f"compared by hand on {_date_text(self.at, now)}"


ComparisonRecord = Comparison | NoComparison
"""What is known of a vehicle's comparison with its motion capture."""


def _date_text(at: datetime, now: datetime) -> str:
    """Return day and time in the time zone of `now`, with the year if it is another one."""
    there = at.astimezone(now.tzinfo)
    year = f" {there.year}" if there.year != now.year else ""
    return f"{there.day} {_MONTHS[there.month - 1]}{year} {there:%H:%M}"


_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


# --- The files -----------------------------------------------------------------------------------

_TRUE_OF = {"system", "host", "body", "body_rpy_deg", "body_position_m"}


class _File(BaseModel):
    """What the file of a comparison holds. `set_up`: what it is true of; another vehicle, capture,
    body or turn of its axes is another one."""

    model_config = ConfigDict(strict=True)

    set_up: dict[str, Any]
    at: AwareDatetime
    passed: bool
    found: str


def _set_up(config: PositioningConfig, vehicle: str) -> dict[str, Any]:
    return {"vehicle": vehicle, **config.model_dump(mode="json", include=_TRUE_OF)}


def path_of(config: PositioningConfig, vehicle: str) -> Path:
    """Return the file of a vehicle's comparison. `vehicle`: as `perchctl.link.vehicle_uri` has
    it."""
    of = json.dumps(_set_up(config, vehicle)).encode()
    return user_state_folder() / "compared" / f"{hashlib.sha256(of).hexdigest()[:16]}.json"


def load_comparison(config: PositioningConfig, vehicle: str) -> ComparisonRecord:
    """Return what is known of this vehicle in this set-up."""
    path = path_of(config, vehicle)
    why = "is damaged"
    try:
        if not path.exists():
            return NEVER
        if not path.is_file():  # one that is a pipe would be waited for
            raise OSError("it is no file")
        file = _File.model_validate_json(path.read_bytes())
        if 1 < file.at.year < 9999:  # any time zone can tell it
            if file.set_up == _set_up(config, vehicle):
                return Comparison(file.at, file.passed, _one_line(file.found))
            why = "is of another set-up"
    except ValidationError:
        pass
    except OSError as error:
        why = f"cannot be read ({error.strerror or error})"
    return NoComparison(
        f"whether the motion capture was compared is not known: {path} {why}",
        f"remove that file, then {AGAIN}",
    )


def save_comparison(config: PositioningConfig, vehicle: str, record: Comparison) -> str | None:
    """Write it down; what was there of this vehicle in this set-up is gone. None, or why it could
    not be written: one that passed must not stand, then, where the newest did not, and is taken
    away if it can be."""
    path = path_of(config, vehicle)
    values = {
        "set_up": _set_up(config, vehicle),
        "at": record.at.astimezone(UTC).isoformat(),
        "passed": record.passed,
        "found": _one_line(record.found),
    }
    try:
        write_files({path: (json.dumps(values, indent=1) + "\n").encode()})
    except (InvalidValue, OSError) as error:
        if not record.passed:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        return str(error)
    return None


def _one_line(text: str) -> str:
    """Return the text as a terminal shows it in one line."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:MOST_FOUND]
