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
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pydantic import AwareDatetime, BaseModel, ConfigDict, ValidationError

from perchctl.errors import InvalidValue
from perchctl.files import write_files
from perchctl.places import user_state_folder
from perchctl.profile import PositioningConfig

VALID_S = 24 * 3600.0
AHEAD_S = 60.0
"""A computer's clock is set by so much, now and then."""
MOST_BYTES, MOST_FOUND = 65536, 300
MOST_OTHERS = 200
"""Records that are looked through for other vehicles."""
AGAIN = "run perchctl check --lift, lift the vehicle and turn it by hand"


class SetUp(BaseModel):
    """What a comparison is true of: another vehicle, capture, body or turn of its axes is another
    one. `vehicle`: as `perchctl.link.vehicle_uri` has it."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

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
class NoComparison(ComparisonRecord):
    """There is no record, or none that can be read: what was found, and what to do."""

    found: str
    advice: str

    def objection(self, now: datetime) -> tuple[str, str] | None:
        return self.found, self.advice


NEVER = NoComparison("the motion capture was never compared with this vehicle", f"{AGAIN}, once")


def unreadable(path: Path, why: str) -> NoComparison:
    """There is a record, and nobody knows what it says."""
    found = f"whether the motion capture was compared is not known: {path} {why}"
    return NoComparison(found, f"remove that file, then {AGAIN}")


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
    return SetUp(
        vehicle=vehicle, system=config.system, host=config.host, body=config.body,
        body_rpy_deg=rpy, body_position_m=place,
    )  # fmt: skip


def _told(at: datetime, now: datetime) -> str:
    """Of another year with the year, in the time zone of `now`."""
    there = at.astimezone(now.tzinfo)
    year = f" {there.year}" if there.year != now.year else ""
    return f"{there.day} {_MONTHS[there.month - 1]}{year} {there:%H:%M}"


_MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


class _File(BaseModel):
    """What the file of a comparison holds."""

    model_config = ConfigDict(strict=True)

    set_up: SetUp
    at: AwareDatetime
    passed: bool
    found: str


def encoded(set_up: SetUp, record: Comparison) -> bytes:
    """The bytes of a comparison's file."""
    values = {
        "set_up": set_up.model_dump(),
        "at": record.at.astimezone(UTC).isoformat(),
        "passed": record.passed,
        "found": _one_line(record.found),
    }
    return (json.dumps(values, indent=1) + "\n").encode()


def decoded(data: bytes, set_up: SetUp) -> Comparison:
    """Errors: ValueError, with what is wrong of it, for what is none or is of another set-up."""
    try:
        file = _File.model_validate_json(data)
    except ValidationError:
        raise ValueError("is damaged") from None
    if not timedelta(0) < file.at - _LONG_AGO < _LONG:  # else no time zone could tell it
        raise ValueError("is damaged")
    if file.set_up != set_up:
        raise ValueError("is of another set-up")
    return Comparison(file.at, file.passed, _one_line(file.found))


_LONG_AGO, _LONG = datetime(2000, 1, 1, tzinfo=UTC), timedelta(days=365_000)


def _one_line(text: str) -> str:
    """What a terminal shows as one."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:MOST_FOUND]


# --- The files ---------------------------------------------------------------------------


def path_of(set_up: SetUp) -> Path:
    name = hashlib.sha256(json.dumps(set_up.model_dump()).encode()).hexdigest()[:16]
    return user_state_folder() / "compared" / f"{name}.json"


def load_comparison(config: PositioningConfig, vehicle: str) -> ComparisonRecord:
    """What is known of this vehicle in this set-up."""
    set_up = set_up_of(config, vehicle)
    path = path_of(set_up)
    data = _read(path)
    if isinstance(data, NoComparison):
        return data
    if data is None:
        others = _others(set_up)
        if not others:
            return NEVER
        found = (
            f"the motion capture was compared with another vehicle ({', '.join(others)}), and "
            f"never with this one ({vehicle})"
        )
        return NoComparison(found, f"{AGAIN}, once")
    try:
        return decoded(data, set_up)
    except ValueError as error:
        return unreadable(path, str(error))


def _read(path: Path) -> bytes | NoComparison | None:
    """None where there is no file."""
    try:
        if not path.exists():
            return None
        if not path.is_file():  # one that is a pipe would be waited for
            return unreadable(path, "is no file")
        with path.open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
    except FileNotFoundError:
        return None
    except OSError as error:
        return unreadable(path, f"cannot be read ({error.strerror or error})")
    return unreadable(path, "is damaged") if len(data) > MOST_BYTES else data


def _others(set_up: SetUp) -> tuple[str, ...]:
    """The other vehicles of which there is a record in this set-up; only for a sentence."""
    found = set()
    for path in itertools.islice(sorted(path_of(set_up).parent.glob("*.json")), MOST_OTHERS):
        data = _read(path)
        if not isinstance(data, bytes):
            continue
        with contextlib.suppress(ValidationError):
            of = _File.model_validate_json(data).set_up
            if of == set_up.model_copy(update={"vehicle": of.vehicle}):
                found.add(_one_line(of.vehicle))
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
