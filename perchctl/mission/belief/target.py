"""The target as it is believed: in the world, and from the gear."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.geometry import Array
from perchctl.mission.belief.motion import ZERO, Vector
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vision import TargetEstimate

FAR_BELOW_M = 0.5
"""A target this far above the gear does not hold the vehicle. Larger: what has fallen off seems to
hang. Smaller: a magnet on a sheet below an unseen ceiling seems not to hold."""
SEEN_MEMORY_S = 0.1
"""Time constant of the low pass of the velocity by pictures. Larger: a descent by it swings.
Smaller: the noise of single detections moves the vehicle."""
SEEN_GAP_S = 1.0
"""Longest time between two detections whose difference is a velocity. Larger: a motion that is over
counts. Smaller: a few lost pictures leave it unknown."""
LEAST_SEEN_S = 0.3
"""Time for which the target has to be detected until its motion counts. Smaller: the low pass has
not settled yet."""
MOST_SEEN_MPS = 1.5
"""Largest velocity between two detections; more is a step of the pose. Larger: such a step counts
as motion. Smaller: a fast motion goes unseen."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetBelief:
    """Where the target is. Everything is unknown until it was seen once.

    Attributes:
        world_m, world_yaw_rad: position in the world of the state estimate, (3,), and heading; None
            while unknown.
        error_xy_m, error_z_m, error_yaw_rad: from the gear to the target, in the level frame;
            infinite while unknown.
        contact_goal_z_m: height of the body at which the gear touches the target.
        age_s: time since the exposure of the last frame in which it was measured.
        is_tracked: it is seen, or coasts within the filter's n_max frames.
        is_fresh: it was measured as lately as the latency allows; `is_small_fresh`: so was the
            small marker.
    """

    world_m: Array | None = None
    world_yaw_rad: float | None = None
    error_xy_m: float = math.inf
    error_z_m: float = math.inf
    error_yaw_rad: float = math.inf
    contact_goal_z_m: float = math.inf
    age_s: float = math.inf
    is_tracked: bool = False
    is_fresh: bool = False
    is_small_fresh: bool = False

    @property
    def is_far_above(self) -> bool:
        """True if the camera sees the target too far above to hold the vehicle."""
        return self.world_m is not None and self.error_z_m > FAR_BELOW_M

    @classmethod
    def of(
        cls, target: TargetEstimate | None, t_s: float, latency_s: float, profile: Profile
    ) -> TargetBelief:
        """The belief at `t_s` by the pipeline's estimate, whose pictures are `latency_s` old when
        they arrive."""
        if target is None:
            return cls()
        goal_z_m = math.inf
        if target.world_m is not None:
            goal_z_m = float(target.world_m[2]) - profile.vehicle.gear_body_m[2]
        limit_s = profile.planner.ascend.fresh_s + latency_s
        age_s = t_s - target.measured_s
        return cls(
            world_m=target.world_m,
            world_yaw_rad=target.world_yaw_rad,
            error_xy_m=math.hypot(target.e_m[0], target.e_m[1]),
            error_z_m=float(target.e_m[2]),
            error_yaw_rad=target.e_yaw_rad,
            contact_goal_z_m=goal_z_m,
            age_s=age_s,
            is_tracked=target.tracked,
            is_fresh=target.tracked and age_s <= limit_s,
            is_small_fresh=t_s - target.small_measured_s <= limit_s,
        )


@dataclass(frozen=True)
class TargetMotion:
    """The vehicle's velocity by pictures of a target that stands still, for want of telemetry.

    The vehicle moves by -de/dt, where e is the target's position from the gear in the level frame;
    a first-order low pass smooths it. Only roll and pitch, which level e, come from telemetry: old
    ones add e_z dphi/dt sideways while the vehicle tilts, and little vertically. The velocity is
    wrong if the target moves, and sideways if the camera is mounted otherwise than assumed.

    Attributes:
        t_s: exposure of the newest detection.
        since_s: exposure of the first in a row without a gap.
        e_m: the newest position of the target, (ahead, left, up).
        velocity_mps: of the vehicle, (ahead, left, up).
    """

    t_s: float = -math.inf
    since_s: float = -math.inf
    e_m: Vector = ZERO
    velocity_mps: Vector = ZERO

    @property
    def is_known(self) -> bool:
        """True if the target was detected for long enough to tell the velocity."""
        return self.t_s - self.since_s >= LEAST_SEEN_S

    def with_detection(self, target: TargetEstimate) -> TargetMotion:
        """The motion after a frame that measured the target."""
        x_m, y_m, z_m = (float(v) for v in target.e_m)
        e_m, t_s = (x_m, y_m, z_m), target.measured_s
        dt_s = t_s - self.t_s
        if dt_s <= 0.0:
            return self
        if dt_s > SEEN_GAP_S:
            return TargetMotion(t_s, t_s, e_m)
        moved_mps = [(before - now) / dt_s for before, now in zip(self.e_m, e_m, strict=True)]
        if math.hypot(*moved_mps) > MOST_SEEN_MPS:
            return replace(self, t_s=t_s, e_m=e_m)
        share = 1.0 - math.exp(-dt_s / SEEN_MEMORY_S)
        ahead, left, up = (
            old + share * (new - old) for old, new in zip(self.velocity_mps, moved_mps, strict=True)
        )
        return TargetMotion(t_s, self.since_s, e_m, (ahead, left, up))
