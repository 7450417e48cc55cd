"""The planner's input in one tick."""

from __future__ import annotations

from dataclasses import dataclass, field

from perchctl.mission.belief.motion import ImuMotion
from perchctl.mission.phase import OperatorRequest
from perchctl.vehicle import Telemetry
from perchctl.vision import TargetEstimate


@dataclass(frozen=True)
class CameraImuMismatch:
    """An error of latency or mounting that explains why the target seems to move: pictures that are
    `camera_latency_error_s` later than assumed, or a camera rotated relative to the profile by
    `camera_yaw_error_rad` about body z, positive counter-clockwise from above. The other value is
    0."""

    camera_latency_error_s: float = 0.0
    camera_yaw_error_rad: float = 0.0


@dataclass(frozen=True)
class VisualInertialMotion:
    """The vehicle's motion at `t_s` from pictures and accelerometer: lateral velocity and bias of
    the acceleration, both (x, y) in world axes, and climb rate, positive up (None if unknown)."""

    t_s: float
    velocity_world_xy_mps: tuple[float, float]
    acceleration_bias_world_xy_mps2: tuple[float, float]  # bias of accelerometer and attitude
    climb_mps: float | None  # climb rate; None if the latency it assumes may no longer apply


@dataclass(frozen=True, eq=False)
class Observation:
    """The planner's input in one tick: the newest telemetry, the target estimate, problems of
    camera, link and log, the operator's request, and the motion from the IMU. Times are on the
    loop's clock; ages are in seconds. A problem or reason is a sentence, or None if there is none.

    `has_new_frame` is True if a good frame was processed in this tick. `heading_jump_rad` is the
    step of the estimated heading beyond any possible rotation, at least 0.
    `successive_marker_conflict_frames` counts the frames in a row in which the two markers
    contradict each other. `climb_withheld_reason` says why the fleet's parent process does not
    permit the climb, and `target_refusal_reason` why the last target in view was taken for another
    vehicle's. `rejected_sighting_to_estimate_distance_m` is the distance from the estimated
    position to the position of the newest sighting; 0 if that sighting was accepted.
    """

    t_s: float
    telemetry: Telemetry  #: newest sample; its age is `t_s - telemetry.t_s`
    target: TargetEstimate | None = None  #: pipeline's estimate at `t_s`; None before the first one
    has_new_frame: bool = False  #: a good frame was processed in this tick
    last_good_frame_age_s: float = 0.0  #: time since the last good frame arrived
    camera_problem: str | None = None  #: None, or one sentence
    link_problem: str | None = None  #: None, or one sentence
    battery_reading_age_s: float = 0.0  #: age of the newest battery voltage
    #: the state estimate moved further than the vehicle could have flown
    has_estimated_position_jumped: bool = False
    heading_jump_rad: float = 0.0  #: step of the estimated heading beyond any possible rotation
    tick_start_delay_s: float = 0.0  #: delay of the start of this tick
    successive_marker_conflict_frames: int = (
        0  #: number of successive frames with contradicting markers
    )
    operator_request: OperatorRequest = OperatorRequest.NONE
    #: why the fleet's parent process does not permit the climb; None if it does, or without a fleet
    climb_withheld_reason: str | None = None
    flight_log_problem: str | None = None  #: the flight log cannot be written
    #: latency beyond the profile's, subtracted from the frames' times (`measured`)
    camera_latency_above_profile_s: float = 0.0
    #: standard deviation of the latency (`measured`); 0 if it is configured
    camera_latency_sigma_s: float = 0.0
    #: why the last target in view was rejected as another vehicle's target
    target_refusal_reason: str | None = None
    external_position_age_s: float = 0.0  #: age of the newest external position sent; 0 with decks
    #: why no external position is sent; None while positions are sent
    external_position_problem: str | None = None
    #: distance from the estimate to the newest sighting; 0 if the sighting was accepted
    rejected_sighting_to_estimate_distance_m: float = 0.0
    imu: ImuMotion = field(default_factory=ImuMotion)  #: motion from all samples up to `telemetry`
    #: newest motion on which pictures and accelerometer agreed
    visual_inertial_motion: VisualInertialMotion | None = None
    #: disagreement of the pictures with `imu`; None if there is none
    camera_imu_mismatch: CameraImuMismatch | None = None
