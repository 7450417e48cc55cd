"""Which of several targets is the vehicle's own, where their markers are the same.

Several vehicles may hang under one ceiling, each with its target. Where ids do not tell these
apart, the place does: the one counts that is nearest to where the profile says that the own one
is, in the world of the state estimate, or else to the upward axis through the gear. That
decides once; from then on the lock (`perchctl.vision.tracks`) stays with the one that was chosen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.geometry import Array
from perchctl.vision.places import to_world
from perchctl.vision.pose import PoseSetup, estimate_pose
from perchctl.vision.types import Attitude, Detection, MarkerName, MarkerPose

OTHER_TARGET_TEXT = (
    "a target is in view that is too far from target.expected_xy_m to be the own one: it is not "
    "followed"
)
_SIGMA_PX = 1.0  # of corners as a search finds them


@dataclass(frozen=True)
class OwnTargetPlace:
    """Where the own target is, in the world of the state estimate; `xy_m` None: not known.
    One that is farther than `within_m` from there is another vehicle's."""

    xy_m: tuple[float, float] | None = None
    within_m: float = math.inf


NOWHERE = OwnTargetPlace()
"""Nothing is known: the gear's axis decides."""


@dataclass(frozen=True, eq=False)
class TargetSelector:
    """How far aside a marker is, for a picture taken at `attitude`."""

    place: OwnTargetPlace
    t_s: float
    attitude: Attitude | None
    pose: PoseSetup

    @property
    def refuses(self) -> bool:
        """Whether some markers are too far aside."""
        return self.attitude is not None and math.isfinite(self.place.within_m)

    def aside_m(self, marker: MarkerName, corners_px: Array) -> float:
        """From where the own target is; inf for one that cannot be it. Corners (4, 2) px."""
        seen = Detection(marker, corners_px, _SIGMA_PX, refined=False)
        pose = estimate_pose([seen], self.t_s, self.attitude, self.pose)
        if pose is None:
            return math.inf
        away_m = aside_m(pose, self.attitude, self.place, self.pose)
        return away_m if away_m <= self.place.within_m else math.inf


def aside_m(
    pose: MarkerPose, attitude: Attitude | None, place: OwnTargetPlace, setup: PoseSetup
) -> float:
    """How far a target is from the own one's place; without that, or without an attitude, from
    the upward axis through the gear."""
    if place.xy_m is None or attitude is None:
        return math.hypot(pose.e_m[0], pose.e_m[1])
    seen_m, _ = to_world(pose.e_m, pose.e_yaw_rad, attitude, setup)
    return math.hypot(seen_m[0] - place.xy_m[0], seen_m[1] - place.xy_m[1])


def refusal(
    pose: MarkerPose, attitude: Attitude | None, place: OwnTargetPlace, setup: PoseSetup
) -> str | None:
    """One sentence where the target is another vehicle's. Nothing is refused without an attitude:
    where the vehicle is, is not known then."""
    if attitude is None or place.xy_m is None:
        return None
    away_m = aside_m(pose, attitude, place, setup)
    if away_m <= place.within_m:
        return None
    return (
        f"a target {away_m:.2f} m from target.expected_xy_m is not followed "
        f"(target.expected_within_m is {place.within_m:g} m)"
    )
