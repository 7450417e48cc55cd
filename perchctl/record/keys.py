"""Names in the turn records of a log that differ from the names in the program.

A turn (one iteration of the flight loop) is written field by field. If a field or dataclass is
renamed in the program, the log continues to use the original name, so that old and new versions of
perchctl can read each other's logs.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cache

CLASS_KEYS: dict[str, str] = {
    "CameraImuMismatch": "Mismatch",
    "EstimateFusionMonitor": "FusionAge",
    "ExternalPositionStatus": "ExternalPositions",
    "TickInputs": "TurnInputs",
    "TickRecord": "Turn",
}
"""The name of a dataclass in the log's ``turn_fields``, keyed by its name in the program."""
FIELD_KEYS: dict[str, dict[str, str]] = {
    "CameraImuMismatch": {
        "camera_latency_error_s": "later_s",
        "camera_yaw_error_rad": "turn_rad",
    },
    "ExternalPositionStatus": {
        "newest_position_age_s": "age_s",
        "newest_position": "place",
        "sent_count": "sent",
    },
    "FrameRecord": {
        "is_repeated": "repeated",
        "picture_kind": "fields",
    },
    "EstimateFusionMonitor": {
        "climb_variance_m2ps2": "variance_m2ps2",
        "variance_changed_at_s": "changed_s",
        "fusion_stopped_at_s": "none_since_s",
    },
    "Impact": {
        "estimated_climb_rate_before_impact_mps": "estimated_mps",
        "imu_climb_rate_before_impact_mps": "felt_mps",
        "peak_specific_force_body_z_g": "peak_g",
        "world_z_m": "z_m",
    },
    "ImuMotion": {
        "attitude_frozen_for_s": "attitude_frozen_s",
        "acceleration_frozen_for_s": "frozen_s",
        "position_frozen_for_s": "place_frozen_s",
        "last_fall_at_s": "fell_s",
        "low_g_began_at_s": "light_since_s",
        "recently_gained_climb_rate_mps": "sink_mps",
        "up_acceleration_offset_mps2": "offset_mps2",
        "newest_impact": "blow",
        "recently_gained_upward_speed_mps": "blow_mps",
        "last_impact_or_bounce_at_s": "blow_s",
        "recent_impact_candidates": "last_moment",
        "climb_rate_became_steady_at_s": "steady_s",
        "steady_climb_rate_mps": "steady_mps",
        "velocity_since_first_sample_world_mps": "velocity_mps",
        "lateral_velocity_became_steady_at_s": "steady_aside_s",
        "mean_lateral_velocity_world_xy_mps": "steady_aside_mps",
        "mean_specific_force_body_xy_g": "aside_g",
        "last_lateral_push_at_s": "pushed_s",
        "accelerometer_offset_g": "offset_g",
        "last_telemetry_gap_ended_at_s": "silent_s",
        "last_gap_that_may_hide_fall_ended_at_s": "gap_s",
        "vehicle_restarted_at_s": "started_s",
        "estimated_height_change_in_newest_gap_m": "sunk_m",
        "mean_raw_thrust_per_g": "hover_thrust",
        "error_of_estimated_roll_pitch_rad": "misled_rad",
        "body_roll_pitch_rate_radps": "turning_radps",
        "estimate_fusion_monitor": "corrections",
        "motors_stopped_at_s": "off_s",
    },
    "Observation": {
        "battery_reading_age_s": "battery_age_s",
        "last_good_frame_age_s": "camera_age_s",
        "camera_latency_above_profile_s": "delay_s",
        "camera_latency_sigma_s": "delay_sigma_s",
        "flight_log_problem": "log_problem",
        "successive_marker_conflict_frames": "disagreeing_frames",
        "visual_inertial_motion": "felt",
        "has_estimated_position_jumped": "jumped",
        "external_position_age_s": "position_age_s",
        "external_position_problem": "position_problem",
        "camera_imu_mismatch": "mismatch",
        "has_new_frame": "new_frame",
        "operator_request": "operator",
        "rejected_sighting_to_estimate_distance_m": "position_beside_m",
        "target_refusal_reason": "target_refused",
        "tick_start_delay_s": "loop_late_s",
        "heading_jump_rad": "turned_rad",
    },
    "SentCommand": {
        "sender": "by",
    },
    "TargetEstimate": {
        "last_measured_at_s": "measured_s",
        "small_marker_last_measured_at_s": "small_measured_s",
        "is_measured_in_newest_frame": "measured",
        "unseen_frames": "unseen",
        "measured_gear_to_target_world_m": "measured_offset_m",
        "measured_gear_to_target_sigma_m": "measured_offset_sigma_m",
    },
    "TickInputs": {
        "late_samples": "late",
        "camera_problem": "problem",
        "has_camera_source_ended": "ended",
        "is_camera_source_live": "live",
        "is_detection_requested": "look",
        "sends_sightings_as_position": "sends_sights",
        "has_discarded_sightings": "drops_sightings",
    },
    "TickRecord": {
        "inputs": "taken",
        "unfiltered_pose_by_marker": "poses",
        "transition_name": "row",
        "is_holding_position": "held",
        "failed_attempts": "attempts",
        "external_positions": "outside",
        "planner_exception_name": "error",
    },
    "UnfilteredPose": {
        "gear_to_target_level_m": "e_m",
        "vehicle_to_target_yaw_rad": "e_yaw_rad",
    },
    "VisualInertialMotion": {
        "velocity_world_xy_mps": "velocity_mps",
        "acceleration_bias_world_xy_mps2": "bias_mps2",
    },
}
"""The key of a field in the log, looked up by the names of the dataclass and of the field in the
program."""


@dataclass(frozen=True)
class LogNames:
    """The names that a log uses for a dataclass: the name of the class, and each field's key, keyed
    by the field's name in the program."""

    owner: str
    keys: dict[str, str]


@cache
def log_names(kind: type) -> LogNames:
    """Return the names that a log uses for a dataclass and its fields."""
    keys = FIELD_KEYS.get(kind.__name__, {})
    names = (each.name for each in dataclasses.fields(kind))
    owner = CLASS_KEYS.get(kind.__name__, kind.__name__)
    return LogNames(owner, {name: keys.get(name, name) for name in names})
