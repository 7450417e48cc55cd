"""The target as it is believed: in the world, and from the gear."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.geometry import Array
from perchctl.profile import Profile
from perchctl.vision import TargetEstimate

FAR_BELOW_M = 0.5
"""A target this far above the gear does not hold the vehicle. Larger: what has fallen off seems to
hang. Smaller: a magnet on a sheet below an unseen ceiling seems not to hold."""


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
