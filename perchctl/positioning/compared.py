"""The result of comparing a motion-capture system with the vehicle, which is lifted by hand
(`perchctl check --lift`), stored for `fly`.

Swapped axes cannot be detected while a vehicle is in the orientation in which its rigid body was
defined. They can only be detected when it is lifted and rotated by hand. Each comparison is
therefore stored for its vehicle and set-up, and a flight requires one that passed at most `VALID_S`
ago.
"""

from __future__ import annotations

import contextlib
import hashlib
from datetime import datetime
from pathlib import Path
from typing import Any

from pydantic import AwareDatetime, BaseModel, ConfigDict, ValidationError

from perchctl.errors import InvalidValue
from perchctl.files import write_files
from perchctl.places import user_folder
from perchctl.profile import PositioningConfig

VALID_S = 24 * 3600.0
"""Time for which a comparison is valid, s."""
CLOCK_ADJUSTMENT_S = 60.0
"""How far in the future the date of a comparison may seem to be, s: the computer's clock may have
been adjusted since."""
AGAIN = "run perchctl check --lift, lift the vehicle and turn it by hand"
_TRUE_OF = {"system", "host", "body", "body_rpy_deg", "body_position_m"}


class CaptureComparison(BaseModel):
    """The result of comparing one vehicle with its motion-capture system by hand, with the fields
    of the stored file.

    `set_up` identifies the vehicle, the motion-capture system, the rigid body and its mounting; the
    result applies to that set-up only. `at` is None if no comparison was made. `found` is the
    result in words.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    set_up: dict[str, Any]
    at: AwareDatetime | None = None
    passed: bool = False
    found: str = ""

    def objection_and_advice(self, now: datetime) -> tuple[str, str] | None:
        """Return why a flight must not rely on this comparison, and what to do; None if the
        comparison passed at most `VALID_S` ago. `now` must have a time zone, in which dates are
        shown."""
        if self.at is None:
            return "the motion-capture system has never been compared with this vehicle", AGAIN
        when, age_s = self.text(now), (now - self.at).total_seconds()
        if not self.passed:
            return f"{self.found} ({when})", f"correct that, then {AGAIN}"
        if age_s < -CLOCK_ADJUSTMENT_S:
            return f"{when}, which is in the future", f"set this computer's clock, then {AGAIN}"
        if age_s > VALID_S:
            return f"{when}, {age_s / 3600.0:.0f} h ago (24 h at most)", AGAIN
        return None

    def text(self, now: datetime) -> str:
        """Return the comparison's date in words."""
        assert self.at is not None
        date = f"{self.at.astimezone(now.tzinfo):%d %b %Y %H:%M}"
        return f"motion capture compared with the hand-held vehicle on {date}"


def _set_up(config: PositioningConfig, vehicle: str) -> dict[str, Any]:
    return {"vehicle": vehicle, **config.model_dump(mode="json", include=_TRUE_OF)}


def comparison_path(config: PositioningConfig, vehicle: str) -> Path:
    """Return the path of a vehicle's comparison; `vehicle` is in the form of
    `perchctl.link.vehicle_uri`."""
    of = repr(_set_up(config, vehicle)).encode()
    return user_folder("state") / "compared" / f"{hashlib.sha256(of).hexdigest()[:16]}.json"


def load_comparison(config: PositioningConfig, vehicle: str) -> CaptureComparison:
    """Return the stored comparison for the vehicle in this set-up; its `at` is None if no file can
    be read."""
    none = CaptureComparison(set_up=_set_up(config, vehicle))
    try:
        kept = CaptureComparison.model_validate_json(comparison_path(config, vehicle).read_bytes())
    except (OSError, ValidationError):
        return none
    return kept if kept.set_up == none.set_up else none


def save_comparison(
    config: PositioningConfig, vehicle: str, at: datetime, passed: bool, found: str
) -> str | None:
    """Replace the stored comparison of this vehicle and set-up.

    `at` must have a time zone; `found` is the result in words. Returns None, or why the file could
    not be written. If the file could not be written and the new comparison did not pass, the old
    comparison is deleted.
    """
    path = comparison_path(config, vehicle)
    record = CaptureComparison(set_up=_set_up(config, vehicle), at=at, passed=passed, found=found)
    try:
        write_files({path: record.model_dump_json(indent=1).encode()})
    except (InvalidValue, OSError) as error:
        if not passed:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        return str(error)
    return None
