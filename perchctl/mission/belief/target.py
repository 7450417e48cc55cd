"""The belief about the target: its position in the world and relative to the gear."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.geometry import Array
from perchctl.mission.belief.motion import ZERO_VECTOR, Vector
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vision import TargetEstimate

MIN_GEAR_TO_TARGET_Z_TO_EXCLUDE_HANGING_M = 0.5
"""Height above the gear beyond which the target cannot hold the vehicle, m. Larger: a vehicle that
has fallen off seems to hang. Smaller: a magnet on a sheet below an unseen ceiling seems not to
hold."""
VISUAL_VELOCITY_TIME_CONSTANT_S = 0.1
"""Time constant of the low-pass filter on the velocity from pictures, s. Larger: a descent
controlled with this velocity oscillates. Smaller: the noise of single detections moves the
vehicle."""
MAX_DETECTION_INTERVAL_TO_COMPUTE_VELOCITY_S = 1.0
"""Longest time between two detections from which a velocity is computed, s. Larger: a motion that
has ended still counts. Smaller: a few lost pictures leave the velocity unknown."""
MIN_UNINTERRUPTED_DETECTION_TIME_TO_USE_VELOCITY_S = 0.3
"""Time for which the target must be detected before the velocity is used, s. Smaller: the low-pass
filter has not settled."""
MAX_PLAUSIBLE_VISUAL_VELOCITY_MPS = 1.5
"""Largest velocity between two detections, m/s; a larger one is a step of the pose. Larger: a step
counts as motion. Smaller: a fast motion is ignored."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TargetBelief:
    """Position of the target. Every value is unknown until the first measurement.

    Attributes:
        world_position_m, world_yaw_rad: position (3,) in the world frame of the state estimate, and
            heading, counter-clockwise from world x; None while unknown.
        gear_to_target_distance_xy_m, gear_to_target_z_m: horizontal distance between gear and
            target, and height of the target above the gear; infinite while unknown.
        vehicle_to_target_yaw_rad: heading of the target relative to the vehicle's, positive
            counter-clockwise from above; infinite while unknown.
        vehicle_world_z_when_touching_m: world z of the body's origin at which the gear touches the
            target; infinite while unknown.
        age_s: time since the exposure of the last frame that measured the target; infinite before
            the first one.
        is_tracked: the target is visible, or the filter has predicted it without a measurement for
            at most `kalman.n_max` frames.
        is_fresh: the target is tracked, and `age_s` is at most `ascend.fresh_s` plus the camera's
            latency.
        is_small_marker_fresh: the last measurement of the small marker is no older than
            `ascend.fresh_s` plus the camera's latency.
    """

    world_position_m: Array | None = None
    world_yaw_rad: float | None = None
    gear_to_target_distance_xy_m: float = math.inf
    gear_to_target_z_m: float = math.inf
    vehicle_to_target_yaw_rad: float = math.inf
    vehicle_world_z_when_touching_m: float = math.inf
    age_s: float = math.inf
    is_tracked: bool = False
    is_fresh: bool = False
    is_small_marker_fresh: bool = False

    @property
    def is_too_far_above_to_hold_vehicle(self) -> bool:
        """True if the target's world position is known and the target is more than
        `MIN_GEAR_TO_TARGET_Z_TO_EXCLUDE_HANGING_M` above the gear, so that its magnet cannot be
        holding the vehicle."""
        return (
            self.world_position_m is not None
            and self.gear_to_target_z_m > MIN_GEAR_TO_TARGET_Z_TO_EXCLUDE_HANGING_M
        )

    @classmethod
    def from_estimate(
        cls, target: TargetEstimate | None, t_s: float, camera_latency_s: float, profile: Profile
    ) -> TargetBelief:
        """Return the belief at the loop time `t_s` from the pipeline's estimate; all values are
        unknown if `target` is None. `camera_latency_s`, the age of a picture on arrival, is added
        to the age up to which a measurement is fresh (`ascend.fresh_s`)."""
        if target is None:
            return cls()
        goal_z_m = math.inf
        if target.world_m is not None:
            goal_z_m = float(target.world_m[2]) - profile.vehicle.gear_body_m[2]
        limit_s = profile.planner.ascend.fresh_s + camera_latency_s
        age_s = t_s - target.last_measured_at_s
        return cls(
            world_position_m=target.world_m,
            world_yaw_rad=target.world_yaw_rad,
            gear_to_target_distance_xy_m=math.hypot(target.e_m[0], target.e_m[1]),
            gear_to_target_z_m=float(target.e_m[2]),
            vehicle_to_target_yaw_rad=target.e_yaw_rad,
            vehicle_world_z_when_touching_m=goal_z_m,
            age_s=age_s,
            is_tracked=target.tracked,
            is_fresh=target.tracked and age_s <= limit_s,
            is_small_marker_fresh=t_s - target.small_marker_last_measured_at_s <= limit_s,
        )


@dataclass(frozen=True)
class VisualVelocityFilter:
    """The vehicle's velocity from pictures of a stationary target, for use without telemetry.

    The vehicle moves by -de/dt, where e is the target's position relative to the gear in the level
    frame; a first-order low-pass filter smooths it. Only roll and pitch, which are used to level e,
    come from the telemetry. If they are old while the true tilt phi changes, the lateral velocity
    is wrong by e_z dphi/dt, and the vertical velocity by little. The velocity is wrong if the
    target moves; its lateral part is wrong if the camera's mounting differs from the profile.

    Attributes:
        t_s: exposure time of the newest detection.
        detection_began_at_s: exposure time of the first detection after the last gap.
        gear_to_target_level_m: newest position of the target relative to the gear (ahead, left,
            up), m.
        vehicle_velocity_level_mps: velocity of the vehicle (ahead, left, up), m/s.
    """

    t_s: float = -math.inf
    detection_began_at_s: float = -math.inf
    gear_to_target_level_m: Vector = ZERO_VECTOR
    vehicle_velocity_level_mps: Vector = ZERO_VECTOR

    @property
    def is_velocity_known(self) -> bool:
        """True if the target has been detected for long enough to determine the velocity."""
        return (
            self.t_s - self.detection_began_at_s
            >= MIN_UNINTERRUPTED_DETECTION_TIME_TO_USE_VELOCITY_S
        )

    def with_detection(self, target: TargetEstimate) -> VisualVelocityFilter:
        """Return the motion after a frame that measured the target at `target.last_measured_at_s`.

        A frame that is not newer than the last one changes nothing. After a gap of more than
        `MAX_DETECTION_INTERVAL_TO_COMPUTE_VELOCITY_S`, the velocity is unknown again. A step of the
        target faster than `MAX_PLAUSIBLE_VISUAL_VELOCITY_MPS` changes the position but not the
        velocity.
        """
        x_m, y_m, z_m = (float(v) for v in target.e_m)
        e_m, t_s = (x_m, y_m, z_m), target.last_measured_at_s
        dt_s = t_s - self.t_s
        if dt_s <= 0.0:
            return self
        if dt_s > MAX_DETECTION_INTERVAL_TO_COMPUTE_VELOCITY_S:
            return VisualVelocityFilter(t_s, t_s, e_m)
        moved_mps = [
            (before - now) / dt_s
            for before, now in zip(self.gear_to_target_level_m, e_m, strict=True)
        ]
        if math.hypot(*moved_mps) > MAX_PLAUSIBLE_VISUAL_VELOCITY_MPS:
            return replace(self, t_s=t_s, gear_to_target_level_m=e_m)
        share = 1.0 - math.exp(-dt_s / VISUAL_VELOCITY_TIME_CONSTANT_S)
        ahead, left, up = (
            old + share * (new - old)
            for old, new in zip(self.vehicle_velocity_level_mps, moved_mps, strict=True)
        )
        return VisualVelocityFilter(t_s, self.detection_began_at_s, e_m, (ahead, left, up))
