"""Decide whether the belief is good enough to fly by, and define the conditions under which it is
not."""

from __future__ import annotations

import math

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.vehicle import LOW_POWER, NO_BATTERY_READING_V

MAX_LATERAL_SPEED_FROM_DRAUGHT_MPS = 0.5
"""Lateral speed that no draught can cause, m/s. Larger: an impact during the press is noticed
late."""
MAX_ESTIMATE_MINUS_IMU_VELOCITY_TO_TRUST_POSITIONS_MPS = 0.15
"""Largest lateral velocity that the estimate may gain without the accelerometer, m/s; correct
positions cause at most 0.07. Larger: positions in the wrong axes displace the vehicle further
before they are noticed."""
MIN_DISTANCE_TO_COUNT_TARGET_AS_BELOW_M = 0.3
"""Distance of the target below the vehicle beyond which it cannot be on the ceiling, m."""
NO_ESTIMATE_CORRECTION_TEXT = (
    "the estimate's variance keeps growing; the positioning system may have failed"
)


def _does_estimate_contradict_imu(b: Belief) -> bool:
    """True if, with motion capture, the state estimate has recently gained more than
    `MAX_ESTIMATE_MINUS_IMU_VELOCITY_TO_TRUST_POSITIONS_MPS` of lateral velocity that the
    accelerometer has not measured: the positions are then in the wrong axes. Always False with
    another position source."""
    by_capture = b.profile.positioning.source.is_mocap
    return (
        by_capture
        and math.hypot(*b.dead_reckoning.recent_estimate_minus_imu_velocity_world_xy_mps)
        > MAX_ESTIMATE_MINUS_IMU_VELOCITY_TO_TRUST_POSITIONS_MPS
    )


def _is_tilt_too_large(b: Belief) -> bool:
    return b.is_imu_fresh and b.tilt_rad > math.radians(b.profile.safety.max_tilt_deg)


def _is_battery_low(b: Belief) -> bool:
    """True if the firmware reports low power, or if the measured voltage is below
    `safety.min_load_v`. A missing voltage does not count as low."""
    tel = b.telemetry
    known = tel.battery_v >= NO_BATTERY_READING_V
    low = known and tel.battery_v < b.profile.safety.min_load_v
    return tel.battery_state == LOW_POWER or low


TILT_TOO_LARGE = Condition("tilted", _is_tilt_too_large, persists_across_phases=True)
"""The tilt exceeds `safety.max_tilt_deg`."""
LATERAL_SPEED_EXCEEDS_DRAUGHT = Condition[Belief](
    "lateral blow",
    lambda b: (
        b.is_position_valid
        and math.hypot(*b.velocity_world_mps[:2]) > MAX_LATERAL_SPEED_FROM_DRAUGHT_MPS
    ),
)
"""The vehicle is moving laterally faster than any draught can move it."""
ESTIMATE_VARIANCE_TOO_LARGE = Condition[Belief](
    "variance too large", lambda b: b.is_estimate_variance_too_large, persists_across_phases=True
)
"""The variance of the state estimate is too large for position control."""
TARGET_BELOW_VEHICLE = Condition[Belief](
    "target below",
    lambda b: (
        b.target.is_fresh and b.target.gear_to_target_z_m < -MIN_DISTANCE_TO_COUNT_TARGET_AS_BELOW_M
    ),
)
"""The target appears below the vehicle, so the mounting must be wrong."""
BATTERY_LOW = Condition("battery low", _is_battery_low, persists_across_phases=True)
"""The battery is low under load."""
ESTIMATE_CONTRADICTS_IMU = Condition(
    "velocity disagrees", _does_estimate_contradict_imu, persists_across_phases=True
)
"""The estimate follows positions that contradict the accelerometer."""
QUALITY_CONDITIONS = (
    TILT_TOO_LARGE,
    LATERAL_SPEED_EXCEEDS_DRAUGHT,
    ESTIMATE_VARIANCE_TOO_LARGE,
    TARGET_BELOW_VEHICLE,
    BATTERY_LOW,
    ESTIMATE_CONTRADICTS_IMU,
)
"""All conditions defined in this module."""


def hold_reason(b: Belief, maneuver: Maneuver) -> str:
    """Return why the vehicle must hold its position in this tick of the maneuver, or an empty
    string.

    In free air, the reason is a stale position. In a maneuver guided by the camera, it is also old
    telemetry, a jump of the state estimate, an excessive variance of its velocity or position, a
    late control loop or, if the maneuver requires pictures, an old picture.
    """
    safety = b.profile.safety
    if maneuver.is_in_free_air and b.is_position_stale:
        return position_loss_text(b)
    if not maneuver.is_camera_guided:
        return ""
    if b.telemetry_age_s > safety.telemetry_hold_s:
        return f"the newest telemetry is {b.telemetry_age_s:.1f} s old"
    if b.first_estimate_jump_at_s is not None:
        return "the state estimate jumped"
    if b.is_estimate_variance_too_large:
        return f"the state estimate is uncertain ({excessive_variance_text(b)})"
    if b.obs.tick_start_delay_s > safety.loop_late_hold_s:
        return f"the control loop is {b.obs.tick_start_delay_s:.1f} s late"
    if maneuver.requires_pictures and b.obs.last_good_frame_age_s > safety.camera_hold_s:
        return no_picture_reason(b)
    return ""


def position_loss_text(b: Belief) -> str:
    """Return a message for a lost position, such as "no position for 1.2 s: ...": how long ago the
    newest external position was sent or, with decks, the newest measurement corrected the estimate,
    and the reason if it is known. The message is "no position has arrived" if there has been none.
    After a sideways push that no position has corrected yet, the message says this instead. The
    function does not check whether the position is lost."""
    if b.is_estimate_missing_gust:
        return "pushed sideways while the target was out of view"
    age_s, why = b.position_correction_age_s, b.obs.external_position_problem
    if b.profile.positioning.source.is_deck:
        why = why or NO_ESTIMATE_CORRECTION_TEXT
    if b.obs.rejected_sighting_to_estimate_distance_m > 0.0:
        why = (
            "the target places the vehicle "
            f"{b.obs.rejected_sighting_to_estimate_distance_m:.2f} m from its estimated position"
        )
    text = f"no position for {age_s:.1f} s" if math.isfinite(age_s) else "no position has arrived"
    return f"{text}: {why}" if why else text


def excessive_variance_text(b: Belief) -> str:
    """Return a message that names the variance that is too large, and its limit. Call it only while
    `is_estimate_variance_too_large` is true.

    The message names the variance of the estimated velocity if it is too large, otherwise that of
    the estimated position (with decks, of the height). If this variance is unknown, the message
    says so.
    """
    safety = b.profile.safety
    what, variance, unit = "velocity", b.max_axis_velocity_variance_m2ps2, "(m/s)^2"
    most = safety.flight_velocity_variance_m2ps2
    if variance <= most:
        what = "height" if b.profile.positioning.source.is_deck else "position"
        variance, most, unit = b.max_axis_position_variance_m2, safety.flight_variance_m2, "m^2"
    if math.isinf(variance):
        return f"the {what}'s variance is unknown"
    return f"the {what}'s variance is {variance:.2g} {unit}, but at most {most:g} is allowed"


def no_picture_reason(b: Belief) -> str:
    """Return why no good picture has arrived lately: the camera's problem or, if none is known, a
    message such as "no picture for 1.2 s". The caller has found that the newest picture is too old;
    this function does not check it."""
    return b.obs.camera_problem or f"no picture for {b.obs.last_good_frame_age_s:.1f} s"
