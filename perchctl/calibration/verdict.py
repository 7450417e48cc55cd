"""What a calibration is good for: its predicted error against what perching needs."""

from __future__ import annotations

from typing import Literal

from perchctl.calibration.types import Calibration

Level = Literal["fly", "care", "stop"]
LIMIT_SHARE = 0.01
LIMIT_FLOOR_MM = 1.0
CARE_FACTOR = 3.0
ASIDE_FACTOR = 2.0
TITLES: dict[Level, str] = {
    "fly": "GOOD TO FLY",
    "care": "FLY WITH CARE",
    "stop": "DO NOT FLY WITH THIS",
}


def limit_mm(z_m: float) -> float:
    """1 mm, or 1 % of the distance where that is more: the gear settles within 4 mm a hand's
    breadth under the target, and an approach from 1.5 m tolerates centimetres."""
    return max(LIMIT_FLOOR_MM, 1e3 * LIMIT_SHARE * z_m)


def level(calibration: Calibration) -> Level:
    """By the predicted error straight ahead of the camera, where perching happens; aside,
    where the search may see the target first, twice the limit will do. Of what the boards did
    not cover nothing is known, so that a calibration that lacks coverage is no good one."""
    ahead = max(e.axis_mm95 / limit_mm(e.z_m) for e in calibration.errors)
    aside = max(e.mm95 / limit_mm(e.z_m) for e in calibration.errors)
    if ahead <= 1.0 and aside <= ASIDE_FACTOR and not calibration.lacks:
        return "fly"
    return "care" if ahead <= CARE_FACTOR else "stop"


def sentence(calibration: Calibration) -> str:
    """The verdict in words, with the two distances that matter."""
    near = min(calibration.errors, key=lambda e: abs(e.z_m - 0.1))
    far = min(calibration.errors, key=lambda e: abs(e.z_m - 1.0))
    text = (
        f"{TITLES[level(calibration)]}: the target's centre is within {near.axis_mm95:.2g} mm at "
        f"{near.z_m * 100:.0f} cm and {far.axis_mm95:.2g} mm at {far.z_m * 100:.0f} cm (95 %)"
    )
    aside = max(calibration.errors, key=lambda e: e.mm95 / limit_mm(e.z_m))
    if aside.mm95 > ASIDE_FACTOR * limit_mm(aside.z_m):
        text += f", aside {aside.mm95:.2g} mm at {aside.z_m * 100:.0f} cm"
    if calibration.lacks:
        text += ", but " + " and ".join(lack.what for lack in calibration.lacks)
    return text
