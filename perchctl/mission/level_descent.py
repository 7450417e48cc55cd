"""Descend level by raw thrust, controlled by the vertical speed alone, without a position.

Let T_h be the hover thrust, v the climb rate (from the accelerometer if no position measures it), u
the climb rate that recent commands have caused but no sample shows yet, and s the sink rate
setpoint. Then

    T = T_h (1 - k (v + u + s)) / cos(tilt)

is a proportional rate controller. The gain k falls with the age of v; otherwise, the vehicle would
oscillate. With old telemetry and the target in view, v is the climb rate from pictures. While the
vehicle is not sinking, the thrust is reduced until the vehicle sinks, the magnet lets go, or the
floor is detected. Laterally, the vehicle leans against the wind and brakes
(`_compute_braking_roll_pitch_rad`).
"""

from __future__ import annotations

import math

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission.belief import hover
from perchctl.mission.belief.contact import MAX_RAW_THRUST_APPLIED_BY_FIRMWARE
from perchctl.mission.belief.reckoning import ACCELERATION_BIAS_LEARNING_TIME_CONSTANT_S
from perchctl.mission.belief.target import VISUAL_VELOCITY_TIME_CONSTANT_S, VisualVelocityFilter
from perchctl.mission.context import Context
from perchctl.mission.release import forget_contact_when_below
from perchctl.mission.setpoints import Action
from perchctl.mission.state import PlannerState
from perchctl.values import replace
from perchctl.vehicle import RawThrust

SINK_RATE_SETPOINT_MPS = 0.7
"""Sink rate setpoint, m/s. Without a position, the gyroscope's offset moves the vehicle 2 m
laterally in 4 s. Larger: the vehicle lands harder if the floor is not detected. Smaller: the
vehicle lands further from the target's axis."""
NEAR_FLOOR_SINK_RATE_SETPOINT_MPS = 0.4
"""Sink rate setpoint near the floor, m/s."""
MAX_HEIGHT_FOR_NEAR_FLOOR_SINK_RATE_M = 0.6
"""Height below which the vehicle sinks at `NEAR_FLOOR_SINK_RATE_SETPOINT_MPS`, m."""
MAX_SINK_RATE_TO_THRUST_GAIN_HOVER_FRACTION_PER_MPS = 0.5
"""Largest gain k from the error of the sink rate to the thrust, as a fraction of the hover thrust
per m/s. Larger: the vehicle oscillates."""
MIN_SINK_RATE_TO_THRUST_GAIN_HOVER_FRACTION_PER_MPS = 0.2
"""Smallest gain k, used with old telemetry, as a fraction of the hover thrust per m/s."""
SINK_RATE_TO_THRUST_GAIN_TIMES_MEASUREMENT_AGE_S2_PER_M = 0.06
"""Product of the gain k and the age of the vertical speed, as long as k is between its smallest and
its largest value."""
COMMANDED_THRUST_FACTOR_IF_CLIMB_RATE_UNKNOWN = 0.98
"""Factor on the thrust that makes the vehicle descend while its vertical speed is not measured."""
SINK_RATE_SETPOINT_IF_CAMERA_GUIDED_MPS = 0.4
"""Sink rate setpoint if the vertical speed comes from pictures, which do not show the distance to
the floor, m/s. Larger: the vehicle lands harder. Smaller: it drifts for longer."""
MIN_VISUAL_VERTICAL_SPEED_TO_COUNT_AS_MOVING_MPS = 0.2
"""Sink rate measured from pictures below which the vehicle counts as not sinking, and climb rate
below which it counts as not climbing, m/s; the error of single detections is half as large."""
BRAKE_TILT_GAIN_IF_CAMERA_GUIDED_RAD_PER_MPS = 0.15
"""Tilt per lateral speed measured from pictures, rad per m/s. Larger: the vehicle oscillates, since
the tilt itself looks like a motion. Smaller: it drifts further."""
ASSUMED_SETTLING_TIME_AT_CONSTANT_SETPOINT_S = 0.6
"""Time at a constant setpoint after which the vehicle has come to rest, s."""
THRUST_RAMP_DOWN_RATE_HOVER_FRACTION_PER_S = 0.25
"""Rate at which the thrust of a vehicle that is not sinking is reduced, as a fraction of the hover
thrust per second. Larger: the vehicle hits the floor faster. Smaller: a magnet holds it for
longer."""
THRUST_RAMP_DOWN_RATE_IF_CAMERA_GUIDED_HOVER_FRACTION_PER_S = 0.1
"""Rate at which the thrust of a vehicle that is not sinking is reduced while the vertical speed
comes from pictures, as a fraction of the hover thrust per second; pictures take a quarter of a
second to show that the vehicle is sinking. Larger: the vehicle falls at first. Smaller: the vehicle
is on the floor for longer with its motors running."""
MIN_TELEMETRY_SINK_RATE_TO_COUNT_AS_SINKING_MPS = 0.05
"""Sink rate, from the telemetry and the commands since its newest sample, below which the vehicle
counts as not sinking, m/s."""
MIN_COMMANDED_TO_HOVER_THRUST_RATIO = 0.4
"""Smallest commanded thrust, as a fraction of the hover thrust."""
MIN_TILT_COSINE_IN_THRUST_COMPENSATION = 0.8
"""Smallest cosine of the tilt for which the thrust is compensated."""
BRAKE_TILT_GAIN_RAD_PER_MPS = 0.25
"""Tilt per lateral speed, rad per m/s."""
MAX_VISUAL_VELOCITY_AGE_TO_BRAKE_S = 0.5
"""Largest age at which the vehicle still brakes a lateral speed from pictures, s. Larger: after the
last picture, the vehicle keeps tilting to brake a speed that no longer exists. Smaller: a few lost
pictures end the braking."""
MAX_BRAKE_TILT_RAD = 0.22
"""Largest tilt that brakes the lateral speed, rad; it costs 2.5 % of the thrust."""
MAX_WIND_COMPENSATION_TILT_RAD = 0.2
"""Largest tilt against the wind, rad; it balances a wind of 6 m/s. Larger: an impact or a wrong
bias moves the vehicle far off course."""
MAX_LATERAL_VELOCITY_AGE_FOR_FULL_BRAKE_S = 0.2
"""Age of the lateral speed above which the vehicle brakes less, s; otherwise it would oscillate."""
LATERAL_VELOCITY_SIGMA_AT_POSITION_LOSS_MPS = 0.05
"""Uncertainty of the lateral speed when the position is lost, m/s."""
LATERAL_VELOCITY_SIGMA_GROWTH_MPS2 = 0.1
"""Growth of the lateral speed's uncertainty, m/s per second: an attitude error of 0.01 rad adds
0.1."""
MAX_ASSUMED_LATERAL_VELOCITY_SIGMA_MPS = 0.3
"""Largest uncertainty of the lateral speed, m/s."""
VISUAL_ATTITUDE_BIAS_FADE_OUT_DURATION_S = 6.0
"""Time after which the attitude error that pictures have shown no longer applies, s."""
MIN_SPECIFIC_FORCE_TO_COUNT_AS_SUPPORTED_G = 0.95
"""Above this specific force, g, a vehicle at low thrust must be resting on something."""
MAX_THRUST_TO_HOVER_RATIO_TO_COUNT_AS_SUPPORTED = 0.88
"""Largest thrust at which a vehicle that reads 1 g must be resting on something, as a fraction of
the hover thrust."""
MAX_SPECIFIC_FORCE_TO_COUNT_AS_AIRBORNE_G = 0.85
"""Specific force below which the vehicle is in the air, g, even if the descent is overdue."""
COMMANDED_TO_HOVER_THRUST_RATIO_AFTER_TOUCHDOWN = 0.5
"""Thrust right after the floor was detected, as a fraction of the hover thrust."""
REDUCED_THRUST_DURATION_AFTER_TOUCHDOWN_S = 0.25
"""Time for which the reduced thrust lasts after the floor was detected, s; an impact within this
time belongs to the touchdown."""
MAX_IMPACT_HEIGHT_TO_COUNT_AS_FLOOR_M = 0.7
"""Height below which an impact from below is that of the floor, m."""
TOUCHDOWN_OVERDUE_MARGIN_S = 2.0
"""Time beyond the expected duration of a descent after which the vehicle must have landed or be
hanging, s."""
TOUCHDOWN_OVERDUE_MARGIN_IF_CLIMB_UNKNOWN_S = 0.8
"""Used instead of `TOUCHDOWN_OVERDUE_MARGIN_S` while the vertical speed is not measured, s."""
MAX_DURATION_OF_DESCENT_BY_SETPOINTS_S = 1.5
"""Time for which a vehicle with old telemetry and an imprecise hover thrust descends by setpoints,
using its own estimate, s."""
MIN_EXPECTED_MEAN_SINK_RATE_MPS = 0.35
"""Smallest mean speed of the descent, m/s."""
MIN_DISTANCE_BELOW_CONTACT_TO_COUNT_AS_DETACHED_M = 0.1
"""Distance of the vehicle below its contact beyond which the magnet has let go, m. Larger: a
vehicle that has come off still seems to hang. Smaller: with a drifting estimate, a hanging vehicle
seems to have come off."""
MIN_VISUAL_GEAR_BELOW_TARGET_TO_COUNT_AS_DETACHED_M = 0.2
"""Distance of the gear below the target, from pictures with an old attitude, beyond which the
magnet has let go, m. Larger: the vehicle drifts for longer before it brakes. Smaller: a target seen
at an angle seems to be above."""
MAX_THRUST_TO_HOVER_RATIO_TO_DETECT_FLOOR_BY_CAMERA = 0.75
"""Fraction of the hover thrust below which a vehicle that does not move in the pictures must be on
the floor: in the air, it would sink at 1 m/s. Larger: a slow start of the descent looks like the
floor. Smaller: the motors run on the floor for longer."""
LOW_THRUST_DWELL_TO_DETECT_FLOOR_BY_CAMERA_S = 0.5
"""Time for which the thrust must have been too low before pictures without motion show the floor,
s: in the air, the vehicle would sink at 1.2 m/s by then, and pictures show that after a quarter of
a second. Larger: the motors run on the floor for longer. Smaller: a vehicle that stops climbing
counts as standing."""
MAX_THRUST_RAMP_INTEGRATION_STEP_S = 0.1
"""Longest time between two ticks that the ramp integrates, s."""


def _visual_motion_if_telemetry_old(c: Context) -> VisualVelocityFilter | None:
    """Return the vehicle's motion from pictures of the target if the attitude in the telemetry is
    older than `safety.telemetry_hold_s`, and the pictures are newer and determine a velocity;
    otherwise None."""
    b, seen = c.belief, c.belief.visual_velocity_filter
    old = b.attitude_age_s > c.safety.telemetry_hold_s
    return seen if old and seen.is_velocity_known and seen.t_s > b.telemetry.t_s else None


def _is_target_redetected_without_velocity(c: Context) -> bool:
    """True if the telemetry is old and the target is detected again, but not yet for long enough to
    determine the motion."""
    b, seen = c.belief, c.belief.visual_velocity_filter
    old = b.attitude_age_s > c.safety.telemetry_hold_s
    return old and not seen.is_velocity_known and seen.t_s > max(b.telemetry.t_s, c.state.entry.t_s)


def _climb_rate_measured_at_s(c: Context) -> float:
    """Return the loop time, s, at which the newest climb rate was measured: the time of the newest
    telemetry or, if the telemetry is old and newer pictures show the target, that of the newest
    picture minus the lag of its low-pass filter."""
    seen = _visual_motion_if_telemetry_old(c)
    return c.telemetry.t_s if seen is None else seen.t_s - VISUAL_VELOCITY_TIME_CONSTANT_S


def _clamped_time_since_last_tick_s(c: Context) -> float:
    """Return the time since the planner's previous tick, s, limited to the range from 0 to
    `MAX_THRUST_RAMP_INTEGRATION_STEP_S`."""
    return max(0.0, min(MAX_THRUST_RAMP_INTEGRATION_STEP_S, c.t_s - c.state.t_s))


def _climb_rate_measurement_age_s(c: Context) -> float:
    """Return the age of the newest measured climb rate, s, from telemetry or pictures: at least the
    time since the previous tick."""
    return max(1e-3, _clamped_time_since_last_tick_s(c), c.t_s - _climb_rate_measured_at_s(c))


def should_begin_descent_with_setpoints(c: Context) -> bool:
    """True if the vehicle should descend by setpoints at first, because the telemetry is old and
    the hover thrust is not known well enough for raw thrust. This applies only before the first
    command of raw thrust, and for at most `MAX_DURATION_OF_DESCENT_BY_SETPOINTS_S`.

    A climb rate from pictures does not make raw thrust safe: it is a quarter of a second late, in
    which a vehicle with 15 % too little thrust gains 0.4 m/s. The result is nevertheless False if
    pictures determine the motion and the state estimate has diverged or lost its heading, because
    setpoints follow the wrong estimate.
    """
    begins_rough = (
        c.state.descent.last_commanded_raw_thrust == 0.0
        and c.belief.hover_thrust_estimate.is_imprecise
    )
    is_old = c.t_s - c.telemetry.t_s > hover.MAX_TELEMETRY_AGE_TO_LEARN_HOVER_THRUST_S
    # Setpoints follow the estimate. If it is known to be wrong, pictures are the better guide.
    misled = c.belief.is_position_diverged or c.belief.is_heading_lost
    if misled and _visual_motion_if_telemetry_old(c) is not None:
        return False
    return is_old and begins_rough and c.time_in_phase_s < MAX_DURATION_OF_DESCENT_BY_SETPOINTS_S


def descend_level_by_raw_thrust(c: Context) -> Action:
    """Return the planner's new state and the raw-thrust command of a descent without a position: a
    proportional controller of the sink rate sets the thrust, and a small tilt brakes the lateral
    speed and balances the wind.

    While the vehicle is not sinking, is supported, or should have landed by now, the thrust falls
    steadily instead, down to `MIN_COMMANDED_TO_HOVER_THRUST_RATIO` of the hover thrust, until the
    magnet lets go or the vehicle stands on the floor. After the floor is detected, the thrust is
    `COMMANDED_TO_HOVER_THRUST_RATIO_AFTER_TOUCHDOWN` of the hover thrust for
    `REDUCED_THRUST_DURATION_AFTER_TOUCHDOWN_S`, and then falls in the same way. This function does
    not stop the motors.
    """
    state, descent, tel, b = c.state, c.state.descent, c.telemetry, c.belief
    dt_s, age_s, measured_s = (
        _clamped_time_since_last_tick_s(c),
        _climb_rate_measurement_age_s(c),
        _climb_rate_measured_at_s(c),
    )
    measured_climb_mps = _last_measured_climb_mps(c)
    climb_mps = measured_climb_mps + descent.climb_rate_change_not_yet_measured_mps
    may_be_held, ramp_per_s = (
        climb_mps > -MIN_TELEMETRY_SINK_RATE_TO_COUNT_AS_SINKING_MPS,
        THRUST_RAMP_DOWN_RATE_HOVER_FRACTION_PER_S,
    )
    # If the speed comes from pictures, only the measured speed can show that the vehicle is moving,
    # not the predicted effect of commands: a vehicle on the floor does not respond to commands. One
    # that is still climbing is held by nothing; a ramp that began with the small thrust that brakes
    # the climb would let it fall.
    if _visual_motion_if_telemetry_old(c) is not None:
        may_be_held, ramp_per_s = (
            abs(measured_climb_mps) < MIN_VISUAL_VERTICAL_SPEED_TO_COUNT_AS_MOVING_MPS,
            THRUST_RAMP_DOWN_RATE_IF_CAMERA_GUIDED_HOVER_FRACTION_PER_S,
        )
    hover_thrust = hover.estimate_hover_thrust(b).raw_thrust
    height_m = b.height_m if b.dead_reckoning_began_at_s is None else b.dead_reckoned_height_m
    height_m += min(0.0, climb_mps) * age_s
    thrust = _compute_thrust_for_sink_rate(c, hover_thrust, climb_mps, height_m)
    if age_s > hover.MAX_TELEMETRY_AGE_TO_LEARN_HOVER_THRUST_S:
        thrust *= COMMANDED_THRUST_FACTOR_IF_CLIMB_RATE_UNKNOWN
    # Since the first command that is too weak, not since the last one that was not: while the loop
    # stands still, the vehicle keeps the thrust that it received last.
    begins = descent.last_commanded_raw_thrust == 0.0
    thrust_too_low_to_fly_since_s = math.inf if begins else descent.thrust_too_low_to_fly_since_s
    floor_detected_at_s = _find_floor_detection_time_s(
        c, height_m, measured_climb_mps, thrust_too_low_to_fly_since_s
    )
    touched_s = math.inf if floor_detected_at_s is None else c.t_s - floor_detected_at_s
    # In the air, the accelerometer reading is proportional to the thrust; on the floor, it is 1 g.
    falls = b.is_imu_fresh and tel.acc_z_g < 0.5 * (1.0 + tel.thrust / hover_thrust)
    if touched_s >= REDUCED_THRUST_DURATION_AFTER_TOUCHDOWN_S and falls:
        # the vehicle is falling at low thrust, so it did not touch the floor
        floor_detected_at_s = None
    carried = (
        b.is_imu_fresh
        and tel.acc_z_g > MIN_SPECIFIC_FORCE_TO_COUNT_AS_SUPPORTED_G
        and tel.thrust < MAX_THRUST_TO_HOVER_RATIO_TO_COUNT_AS_SUPPORTED * hover_thrust
    )
    overdue = _is_touchdown_overdue(c) and not (
        b.is_imu_fresh and tel.acc_z_g < MAX_SPECIFIC_FORCE_TO_COUNT_AS_AIRBORNE_G
    )
    before = descent.last_commanded_raw_thrust or hover_thrust
    if touched_s < REDUCED_THRUST_DURATION_AFTER_TOUCHDOWN_S:
        thrust = COMMANDED_TO_HOVER_THRUST_RATIO_AFTER_TOUCHDOWN * hover_thrust
    elif _is_target_redetected_without_velocity(c):
        thrust = before
    elif floor_detected_at_s is not None or carried or may_be_held or overdue:
        thrust = min(thrust, before - ramp_per_s * hover_thrust * dt_s)
    thrust = max(
        MIN_COMMANDED_TO_HOVER_THRUST_RATIO * hover_thrust,
        min(MAX_RAW_THRUST_APPLIED_BY_FIRMWARE, thrust),
    )
    # Speed that the commands since the newest sample have caused.
    shown_s = (
        0.0 if b.last_telemetry is None else max(0.0, measured_s - descent.climb_rate_measured_at_s)
    )
    gained_mps = GRAVITY_MPS2 * (thrust / hover_thrust - 1.0) * dt_s
    climb_rate_change_not_yet_measured_mps = (
        descent.climb_rate_change_not_yet_measured_mps * max(0.0, 1.0 - shown_s / age_s)
        + gained_mps
    )
    supports = thrust >= MAX_THRUST_TO_HOVER_RATIO_TO_DETECT_FLOOR_BY_CAMERA * hover_thrust
    state = _forget_contact_after_fall(c)
    state = replace(
        state,
        descent=replace(
            descent,
            last_commanded_raw_thrust=thrust,
            thrust_too_low_to_fly_since_s=math.inf
            if supports
            else min(c.t_s, thrust_too_low_to_fly_since_s),
            floor_detected_at_s=floor_detected_at_s,
            climb_rate_change_not_yet_measured_mps=climb_rate_change_not_yet_measured_mps,
            climb_rate_measured_at_s=measured_s,
        ),
        setpoint=None,
        stop_or_land_command_count=0,
        fall_catch_setpoint_above_vehicle_m=None,
    )
    roll_rad, pitch_rad = (
        (0.0, 0.0) if floor_detected_at_s is not None else _compute_braking_roll_pitch_rad(c)
    )
    return state, RawThrust(int(thrust), roll_rad, pitch_rad)


def _last_measured_climb_mps(c: Context) -> float:
    """Return the last measured vertical speed, m/s, positive up: from pictures if the telemetry is
    old and they are newer, otherwise from telemetry; 0 if setpoints have held the vehicle in place
    since the last telemetry."""
    seen = _visual_motion_if_telemetry_old(c)
    if seen is not None:
        return seen.vehicle_velocity_level_mps[2]
    held = c.telemetry.t_s < c.state.entry.t_s - ASSUMED_SETTLING_TIME_AT_CONSTANT_SETPOINT_S
    return 0.0 if held else c.belief.climb_mps


def _find_floor_detection_time_s(
    c: Context, height_m: float, measured_climb_mps: float, thrust_too_low_to_fly_since_s: float
) -> float | None:
    """Return the time at which the floor was first detected; None if it was not.

    The floor is detected by an impact from below while the vehicle was sinking and its height above
    the ground (`height_m`) was less than `MAX_IMPACT_HEIGHT_TO_COUNT_AS_FLOOR_M`; or by pictures in
    which the vehicle does not sink (`measured_climb_mps`), clearly below the target, although its
    thrust has been too low to support it since `thrust_too_low_to_fly_since_s`, for at least
    `LOW_THRUST_DWELL_TO_DETECT_FLOOR_BY_CAMERA_S`. A shorter time is not enough: a small thrust
    also brakes a climb.
    """
    descent, b, seen = c.state.descent, c.belief, _visual_motion_if_telemetry_old(c)
    if descent.floor_detected_at_s is not None:
        return descent.floor_detected_at_s
    struck = (
        c.t_s - b.imu.last_impact_or_bounce_at_s < REDUCED_THRUST_DURATION_AFTER_TOUCHDOWN_S
        and b.dead_reckoning.climb_rate_before_newest_impact_mps < 0.0
    )
    stands = (
        seen is not None
        and seen.gear_to_target_level_m[2] > MIN_VISUAL_GEAR_BELOW_TARGET_TO_COUNT_AS_DETACHED_M
        and c.t_s - thrust_too_low_to_fly_since_s >= LOW_THRUST_DWELL_TO_DETECT_FLOOR_BY_CAMERA_S
        and measured_climb_mps > -MIN_VISUAL_VERTICAL_SPEED_TO_COUNT_AS_MOVING_MPS
    )
    return (
        c.t_s if stands or (struck and height_m < MAX_IMPACT_HEIGHT_TO_COUNT_AS_FLOOR_M) else None
    )


def _compute_thrust_for_sink_rate(
    c: Context, hover_thrust: float, climb_mps: float, height_m: float
) -> float:
    """Return the raw thrust (full thrust is 65535) of the proportional sink-rate controller, before
    it is clamped:

        thrust = hover_thrust * (1 - k * (climb_mps + s)) / cos(tilt)

    `hover_thrust` is the raw thrust that carries the weight. `climb_mps` is the climb rate,
    positive upwards, including the change that recent commands cause but no measurement shows yet.
    The sink rate setpoint s, m/s, is smaller if `height_m` (above the ground) is at most
    `MAX_HEIGHT_FOR_NEAR_FLOOR_SINK_RATE_M` or may be wrong, or if the climb rate comes from
    pictures. The gain k, hover thrusts per m/s, falls with the age of the measured climb rate. The
    cosine is at least `MIN_TILT_COSINE_IN_THRUST_COMPENSATION`.
    """
    b = c.belief
    # Late pictures, and positions that have diverged, may place the floor half a metre too low.
    is_height_wrong = b.camera_imu_mismatch.camera_latency_error_s != 0.0 or b.is_position_diverged
    low = height_m <= MAX_HEIGHT_FOR_NEAR_FLOOR_SINK_RATE_M or is_height_wrong
    sink_mps = NEAR_FLOOR_SINK_RATE_SETPOINT_MPS if low else SINK_RATE_SETPOINT_MPS
    if _visual_motion_if_telemetry_old(c) is not None:
        sink_mps = SINK_RATE_SETPOINT_IF_CAMERA_GUIDED_MPS
    gain = SINK_RATE_TO_THRUST_GAIN_TIMES_MEASUREMENT_AGE_S2_PER_M / max(
        1e-3, c.t_s - _climb_rate_measured_at_s(c)
    )
    gain = max(
        MIN_SINK_RATE_TO_THRUST_GAIN_HOVER_FRACTION_PER_MPS,
        min(MAX_SINK_RATE_TO_THRUST_GAIN_HOVER_FRACTION_PER_MPS, gain),
    )
    tilt = max(MIN_TILT_COSINE_IN_THRUST_COMPENSATION, math.cos(b.tilt_rad))
    return hover_thrust * (1.0 - gain * (climb_mps + sink_mps)) / tilt


def _forget_contact_after_fall(c: Context) -> PlannerState:
    """Return the state without its recorded contact with the target, and without being within the
    magnet's reach, if the vehicle has come off: a position or pictures show it clearly below the
    contact, or the accelerometer has shown a fall. Otherwise, the state is unchanged."""
    state, b, seen = c.state, c.belief, _visual_motion_if_telemetry_old(c)
    if b.is_position_valid and b.dead_reckoning_began_at_s is None:
        return forget_contact_when_below(state, MIN_DISTANCE_BELOW_CONTACT_TO_COUNT_AS_DETACHED_M)
    magnet_reach_entered_at_s = b.magnet_reach_entered_at_s
    fell = magnet_reach_entered_at_s is not None and b.imu.last_fall_at_s > max(
        magnet_reach_entered_at_s, state.entry.t_s
    )
    seen_below = (
        seen is not None
        and seen.gear_to_target_level_m[2] > MIN_VISUAL_GEAR_BELOW_TARGET_TO_COUNT_AS_DETACHED_M
    )
    if fell or (b.is_possibly_in_magnet_reach and seen_below):
        belief = replace(
            b,
            vehicle_world_z_at_last_contact_m=None,
            magnet_reach_entered_at_s=None,
            dead_reckoning=replace(b.dead_reckoning, gear_below_target_m=math.inf),
            dead_reckoning_began_at_s=None if b.dead_reckoning_began_at_s is None else c.t_s,
        )
        return replace(state, belief=belief)
    return state


def _is_touchdown_overdue(c: Context) -> bool:
    """True if the vehicle, without a position or with diverged positions, has descended for longer
    than the descent from its start height takes at `MIN_EXPECTED_MEAN_SINK_RATE_MPS`, plus a
    margin: it must then have landed or be hanging. Always False with a position."""
    state, b = c.state, c.belief
    if b.dead_reckoning_began_at_s is None and not b.is_position_diverged:
        return False
    descent_m = max(0.0, state.entry.vehicle_world_position_m[2] - b.ground_z_m)
    began_s = max(b.dead_reckoning_began_at_s or 0.0, state.entry.t_s)
    measured = (
        c.t_s - _climb_rate_measured_at_s(c) <= hover.MAX_TELEMETRY_AGE_TO_LEARN_HOVER_THRUST_S
    )
    spare_s = (
        TOUCHDOWN_OVERDUE_MARGIN_S if measured else TOUCHDOWN_OVERDUE_MARGIN_IF_CLIMB_UNKNOWN_S
    )
    if not measured and b.hover_thrust_estimate.is_imprecise:
        spare_s += MAX_DURATION_OF_DESCENT_BY_SETPOINTS_S
    return c.t_s - began_s > spare_s + descent_m / MIN_EXPECTED_MEAN_SINK_RATE_MPS


def _compute_braking_roll_pitch_rad(c: Context) -> tuple[float, float]:
    """Return roll and pitch, rad, that balance the wind and brake the lateral speed; roll to the
    right and pitch nose down are positive. Both are 0 without a heading, or while the magnet may
    hold the vehicle.

    The lateral reading of the accelerometer is the air's force per mass w, m/s^2, because the
    thrust acts along the body's z axis. To balance this force, the thrust needs the lateral part
    -w. The estimated attitude is wrong by b / g, where b is the bias of accelerometer and attitude.
    The estimated tilt must therefore be (b - w) / g.

    Both b and w are means over the time with a known position, so an offset of the accelerometer
    cancels. Means over less than `ACCELERATION_BIAS_LEARNING_TIME_CONSTANT_S` have less weight.
    Means from wrong positions have no weight, and the bias that pictures have shown recently is
    used instead. The present reading is not used, since most of it is drag due to the vehicle's own
    motion, and this drag brakes the vehicle.
    """
    b = c.belief
    if b.is_heading_lost or b.is_possibly_in_magnet_reach:
        return 0.0, 0.0
    dead_reckoning, yaw_rad = b.dead_reckoning, c.telemetry.yaw_rad
    x_mps, y_mps, _ = dead_reckoning.velocity_world_mps
    speed_mps = max(1e-6, math.hypot(x_mps, y_mps))
    blind_s = 0.0 if b.dead_reckoning_began_at_s is None else c.t_s - b.dead_reckoning_began_at_s
    visual_age_s = (
        math.inf
        if c.obs.visual_inertial_motion is None
        else c.t_s - c.obs.visual_inertial_motion.t_s
    )
    unsure_mps = min(
        MAX_ASSUMED_LATERAL_VELOCITY_SIGMA_MPS,
        LATERAL_VELOCITY_SIGMA_AT_POSITION_LOSS_MPS
        + LATERAL_VELOCITY_SIGMA_GROWTH_MPS2 * min(blind_s, visual_age_s),
    )
    part = max(0.0, 1.0 - unsure_mps / speed_mps)
    part *= min(1.0, MAX_LATERAL_VELOCITY_AGE_FOR_FULL_BRAKE_S / max(1e-3, b.attitude_age_s))
    ahead_mps, left_mps = _world_to_heading_xy(part * x_mps, part * y_mps, yaw_rad)
    seen, gain = _visual_motion_if_telemetry_old(c), BRAKE_TILT_GAIN_RAD_PER_MPS
    if seen is not None and b.does_camera_motion_match_vehicle:
        ahead_mps, left_mps, gain = 0.0, 0.0, BRAKE_TILT_GAIN_IF_CAMERA_GUIDED_RAD_PER_MPS
        if c.t_s - seen.t_s <= MAX_VISUAL_VELOCITY_AGE_TO_BRAKE_S:
            ahead_mps, left_mps, _ = seen.vehicle_velocity_level_mps
    (bias_x_mps2, bias_y_mps2, _), (x_mps2, y_mps2) = (
        dead_reckoning.acceleration_bias_world_mps2,
        dead_reckoning.mean_specific_force_world_xy_mps2,
    )
    known = (
        0.0
        if b.is_position_diverged
        else min(
            1.0,
            dead_reckoning.time_under_position_control_s
            / ACCELERATION_BIAS_LEARNING_TIME_CONSTANT_S,
        )
    )
    counts = known + (1.0 - known) * max(
        0.0, 1.0 - visual_age_s / VISUAL_ATTITUDE_BIAS_FADE_OUT_DURATION_S
    )
    ahead_mps2, left_mps2 = _world_to_heading_xy(
        counts * bias_x_mps2 - known * x_mps2, counts * bias_y_mps2 - known * y_mps2, yaw_rad
    )
    roll_rad, pitch_rad = c.obs.imu.error_of_estimated_roll_pitch_rad
    return (
        _compute_braking_tilt_rad(-left_mps, gain)
        - _wind_compensation_tilt_rad(left_mps2)
        + roll_rad,
        _compute_braking_tilt_rad(ahead_mps, gain)
        + _wind_compensation_tilt_rad(ahead_mps2)
        + pitch_rad,
    )


def _world_to_heading_xy(x: float, y: float, yaw_rad: float) -> tuple[float, float]:
    """Rotate the horizontal vector (`x`, `y`) from world axes into the axes, ahead and left, of a
    vehicle with the heading `yaw_rad` (counter-clockwise from world x)."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return x * cos + y * sin, y * cos - x * sin


def _wind_compensation_tilt_rad(acceleration_against_wind_mps2: float) -> float:
    """Return the tilt, rad, at which a hovering vehicle's thrust causes the given horizontal
    acceleration, limited to `MAX_WIND_COMPENSATION_TILT_RAD`. Both have the same sign."""
    return max(
        -MAX_WIND_COMPENSATION_TILT_RAD,
        min(
            MAX_WIND_COMPENSATION_TILT_RAD, math.atan(acceleration_against_wind_mps2 / GRAVITY_MPS2)
        ),
    )


def _compute_braking_tilt_rad(lateral_velocity_mps: float, brake_gain_rad_per_mps: float) -> float:
    """Return the tilt, rad, against the velocity along one axis: minus the gain times the velocity,
    limited to `MAX_BRAKE_TILT_RAD`."""
    return max(
        -MAX_BRAKE_TILT_RAD, min(MAX_BRAKE_TILT_RAD, -brake_gain_rad_per_mps * lateral_velocity_mps)
    )
