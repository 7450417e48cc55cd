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
import itertools
import json
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from perchctl.errors import InvalidValue
from perchctl.files import write_files
from perchctl.profile import PositioningConfig, user_state_folder

VALID_S = 24 * 3600.0
AHEAD_S = 60.0
"""A computer's clock is set by so much, now and then."""
MOST_BYTES, MOST_FOUND = 65536, 300
MOST_OTHERS = 200
"""Records that are looked through for other vehicles."""
AGAIN = "run perchctl check --lift, lift the vehicle and turn it by hand"


@dataclass(frozen=True)
class SetUp:
    """What a comparison is true of: another vehicle, capture, body or turn of its axes is another
    one. `vehicle`: as `perchctl.link.vehicle_uri` has it."""

    vehicle: str
    system: str
    host: str
    body: str
    body_rpy_deg: tuple[float, ...]
    body_position_m: tuple[float, ...]


class ComparisonRecord:
    """What is known of a vehicle's comparison with its motion capture. `now` has a time zone, in
    which dates are told."""

    def objection(self, now: datetime) -> tuple[str, str] | None:
        """Why no flight may rely on it: what was found, and what to do. None where it passed, and
        not long ago."""
        raise NotImplementedError


@dataclass(frozen=True)
class NeverCompared(ComparisonRecord):
    """There is no record."""

    def objection(self, now: datetime) -> tuple[str, str] | None:
        return "the motion capture was never compared with this vehicle", f"{AGAIN}, once"


@dataclass(frozen=True)
class OthersCompared(ComparisonRecord):
    """Records there are of this very capture and body, and of other vehicles only."""

    vehicle: str
    others: tuple[str, ...]

    def objection(self, now: datetime) -> tuple[str, str] | None:
        found = (
            f"the motion capture was compared with another vehicle ({', '.join(self.others)}), "
            f"and never with this one ({self.vehicle})"
        )
        return found, f"{AGAIN}, once"


@dataclass(frozen=True)
class Unreadable(ComparisonRecord):
    """There is a record, and nobody knows what it says."""

    path: Path
    why: str

    def objection(self, now: datetime) -> tuple[str, str] | None:
        found = f"whether the motion capture was compared is not known: {self.path} {self.why}"
        return found, f"remove that file, then {AGAIN}"


@dataclass(frozen=True)
class Comparison(ComparisonRecord):
    """A comparison's date (with its time zone), whether it passed, and what it found."""

    at: datetime
    passed: bool
    found: str

    def objection(self, now: datetime) -> tuple[str, str] | None:
        when = _told(self.at, now)
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
        """Of a comparison that passed."""
        return f"compared by hand on {_told(self.at, now)}"


def set_up_of(config: PositioningConfig, vehicle: str) -> SetUp:
    rpy, place = (tuple(map(float, v)) for v in (config.body_rpy_deg, config.body_position_m))
    return SetUp(vehicle, config.system, config.host, config.body, rpy, place)


def _told(at: datetime, now: datetime) -> str:
    """Of another year with the year, in the time zone of `now`."""
    there = at.astimezone(now.tzinfo)
    year = f" {there.year}" if there.year != now.year else ""
    return f"{there.day} {_MONTHS[there.month - 1]}{year} {there:%H:%M}"


_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


def encoded(set_up: SetUp, record: Comparison) -> bytes:
    values = {
        "set_up": asdict(set_up),
        "at": record.at.astimezone(UTC).isoformat(),
        "passed": record.passed,
        "found": _one_line(record.found),
    }
    return (json.dumps(values, indent=1) + "\n").encode()


def decoded(data: bytes, set_up: SetUp) -> Comparison:
    """Errors: ValueError, with what is wrong of it, for what is none or is of another set-up."""
    try:
        values = json.loads(data)
        at = datetime.fromisoformat(values["at"])
        passed, found, of = values["passed"], values["found"], values["set_up"]
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ValueError("is damaged") from None
    if not (isinstance(passed, bool) and isinstance(found, str)) or at.tzinfo is None:
        raise ValueError("is damaged")
    if not timedelta(0) < at - _LONG_AGO < _LONG:  # else no time zone could tell it
        raise ValueError("is damaged")
    if of != json.loads(json.dumps(asdict(set_up))):
        raise ValueError("is of another set-up")
    return Comparison(at, passed, _one_line(found))


_LONG_AGO, _LONG = datetime(2000, 1, 1, tzinfo=UTC), timedelta(days=365_000)


def _one_line(text: str) -> str:
    """What a terminal shows as one."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:MOST_FOUND]


# --- The files ---------------------------------------------------------------------------


def path_of(set_up: SetUp) -> Path:
    name = hashlib.sha256(json.dumps(asdict(set_up)).encode()).hexdigest()[:16]
    return user_state_folder() / "compared" / f"{name}.json"


def load_comparison(config: PositioningConfig, vehicle: str) -> ComparisonRecord:
    """What is known of this vehicle in this set-up."""
    set_up = set_up_of(config, vehicle)
    path = path_of(set_up)
    data = _read(path)
    if data is None:
        others = _others(set_up)
        return OthersCompared(vehicle, others) if others else NeverCompared()
    if isinstance(data, Unreadable):
        return data
    try:
        return decoded(data, set_up)
    except ValueError as error:
        return Unreadable(path, str(error))


def _read(path: Path) -> bytes | Unreadable | None:
    """None where there is no file."""
    try:
        if not path.exists():
            return None
        if not path.is_file():  # one that is a pipe would be waited for
            return Unreadable(path, "is no file")
        with path.open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        return Unreadable(path, f"cannot be read ({error.strerror or error})")
    return Unreadable(path, "is damaged") if len(data) > MOST_BYTES else data


def _others(set_up: SetUp) -> tuple[str, ...]:
    """The other vehicles of which there is a record in this set-up; only for a sentence."""
    wanted = json.loads(json.dumps(asdict(set_up)))
    found = set()
    for path in itertools.islice(sorted(path_of(set_up).parent.glob("*.json")), MOST_OTHERS):
        data = _read(path)
        if not isinstance(data, bytes):
            continue
        try:
            of = json.loads(data)["set_up"]
            vehicle = of["vehicle"]
        except (ValueError, KeyError, TypeError, RecursionError):
            continue
        if isinstance(vehicle, str) and of == wanted | {"vehicle": vehicle}:
            found.add(_one_line(vehicle))
    return tuple(sorted(found - {set_up.vehicle}))


def save_comparison(config: PositioningConfig, vehicle: str, record: Comparison) -> str | None:
    """Write it down; what was there of this vehicle in this set-up is gone. None, or why it could
    not be written: one that passed must not stand, then, where the newest did not, and is taken
    away if it can be."""
    set_up = set_up_of(config, vehicle)
    path = path_of(set_up)
    try:
        write_files({path: encoded(set_up, record)})
    except (InvalidValue, OSError) as error:
        if not record.passed:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        return str(error)
    return None
