"""What a comparison by hand found of a motion capture (`perchctl check --lift`), kept for `fly`.

Swapped axes do not show on a vehicle that stands as when its body was defined; only a hand that
lifts and turns it tells. So each comparison is written down for its very vehicle and set-up, and a
flight asks for one that passed, at most `VALID_S` old.
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
CLOCK_ADJUSTMENT_S = 60.0
"""A computer's clock is set by so much, now and then."""
AGAIN = "run perchctl check --lift, lift the vehicle and turn it by hand"
_TRUE_OF = {"system", "host", "body", "body_rpy_deg", "body_position_m"}


class CaptureComparison(BaseModel):
    """The result of comparing one vehicle with its motion capture by hand, as its file stores it.

    `set_up` identifies vehicle, capture, body and mounting of the body; the result holds for that
    set-up only. `at` is None if no comparison was made; `found`: the result in words.
    """

    model_config = ConfigDict(strict=True, frozen=True)

    set_up: dict[str, Any]
    at: AwareDatetime | None = None
    passed: bool = False
    found: str = ""

    def objection_and_advice(self, now: datetime) -> tuple[str, str] | None:
        """Return why no flight may rely on this comparison, and what to do; None if it passed, at
        most `VALID_S` ago. `now` has a time zone, in which dates are shown."""
        if self.at is None:
            return "the motion capture was never compared with this vehicle", f"{AGAIN}, once"
        when, age_s = self.text(now), (now - self.at).total_seconds()
        if not self.passed:
            return f"{self.found} ({when})", f"mend that, then {AGAIN}"
        if age_s < -CLOCK_ADJUSTMENT_S:
            return f"{when}, which is yet to come", f"set this computer's clock, then {AGAIN}"
        if age_s > VALID_S:
            return f"{when}, {age_s / 3600.0:.0f} h ago (24 h at most)", AGAIN
        return None

    def text(self, now: datetime) -> str:
        """The comparison's date in words."""
        assert self.at is not None
        return f"compared by hand on {self.at.astimezone(now.tzinfo):%d %b %Y %H:%M}"


def _set_up(config: PositioningConfig, vehicle: str) -> dict[str, Any]:
    return {"vehicle": vehicle, **config.model_dump(mode="json", include=_TRUE_OF)}


def comparison_path(config: PositioningConfig, vehicle: str) -> Path:
    """A vehicle's comparison file; `vehicle` is as `perchctl.link.vehicle_uri` has it."""
    of = repr(_set_up(config, vehicle)).encode()
    return user_folder("state") / "compared" / f"{hashlib.sha256(of).hexdigest()[:16]}.json"


def load_comparison(config: PositioningConfig, vehicle: str) -> CaptureComparison:
    """The vehicle's comparison in this set-up; with `at` None if no file can be read."""
    none = CaptureComparison(set_up=_set_up(config, vehicle))
    try:
        kept = CaptureComparison.model_validate_json(comparison_path(config, vehicle).read_bytes())
    except (OSError, ValidationError):
        return none
    return kept if kept.set_up == none.set_up else none


def save_comparison(
    config: PositioningConfig, vehicle: str, at: datetime, passed: bool, found: str
) -> str | None:
    """Write a comparison over the old comparison of this vehicle and set-up.

    `at` has a time zone; `found`: the result in words. Returns None, or why the file could not be
    written; then the old comparison is deleted if the new comparison did not pass.
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
