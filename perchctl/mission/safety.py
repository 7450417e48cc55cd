"""The rows of the table that apply in many phases, most severe first.

These rows come before the exits of each phase: operator commands, a locked or tumbled vehicle, a
lost link, old telemetry, unreliable positions and pictures, limits and the battery; then a magnet
that catches early, and obstacles.
"""

from __future__ import annotations

import math

from perchctl.mission.belief.contact import (
    CLIMB_BLOCKED,
    HANGING,
    HANGING_CONFIRMATION_DWELL_S,
    MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_SATURATED,
    NOT_CLIMBING_AT_FULL_THRUST,
    SLOW_CLIMB_AT_NEARLY_FULL_THRUST,
    Support,
    contact_height_tolerance_m,
    gear_to_target_at_last_contact_or_now,
    max_press_thrust,
)
from perchctl.mission.belief.motion import MAX_PUSH_TO_ESTIMATE_RESPONSE_DELAY_S
from perchctl.mission.belief.quality import (
    BATTERY_LOW,
    ESTIMATE_CONTRADICTS_IMU,
    ESTIMATE_VARIANCE_TOO_LARGE,
    TARGET_BELOW_VEHICLE,
    TILT_TOO_LARGE,
    excessive_variance_text,
    no_picture_reason,
    position_loss_text,
)
from perchctl.mission.context import Context
from perchctl.mission.phase import (
    CAMERA_GUIDED_PHASES,
    FREE_AIR_PHASES,
    PHASES_IN_WHICH_MAGNET_MAY_ATTACH,
    PRE_CONTACT_PHASES,
    PRE_LANDING_PHASES,
    OperatorRequest,
    Outcome,
    Phase,
    VehicleDiagnosis,
)
from perchctl.mission.phases.ascend import ASCENT_END_HEIGHT_REACHED
from perchctl.mission.rest import is_hanging_with_motors_off
from perchctl.mission.transition import (
    Transition,
    back_off_row,
    land_row,
    motor_cut_row,
    supervisor_abort_row,
)
from perchctl.profile import USED_LATENCY_S
from perchctl.vehicle import CRASHED, LOCKED, TUMBLED

MIN_HEIGHT_TO_COUNT_AS_LIFTED_OFF_M = 0.05
"""Height below which the lateral limit of a take-off is
`MAX_LATERAL_DISTANCE_FROM_SETPOINT_BEFORE_LIFTOFF_M`, m."""
MAX_LATERAL_DISTANCE_FROM_SETPOINT_BEFORE_LIFTOFF_M = 0.12
"""Largest lateral motion of the vehicle before it has lifted off, m. Larger: a wrong mounting tips
it over."""
MAX_HEIGHT_TO_COUNT_AS_NEAR_FLOOR_M = 0.3
"""Height below which positions in the wrong axes may lead the vehicle into the floor, m."""
MAX_LATERAL_DISTANCE_FROM_SETPOINT_NEAR_FLOOR_M = 0.22
"""Lateral distance from the setpoint at which positions have diverged, m, below
`MAX_HEIGHT_TO_COUNT_AS_NEAR_FLOOR_M` and in a vertical climb."""
MAX_LATERAL_DISTANCE_FROM_SETPOINT_IN_LANDING_M = 0.4
"""Lateral distance from the setpoint at which positions have diverged during a landing, m."""
MAX_LATERAL_DISTANCE_FROM_SETPOINT_M = 0.8
"""Lateral distance from the setpoint at which positions have diverged in all other cases, m:
further than any draught moves the vehicle. Larger: the vehicle reaches the walls."""
SETPOINT_DISTANCE_LIMIT_INCREASE_PER_LATENCY_SIGMA_MPS = 4.0
"""How much the limit on the lateral distance from the setpoint increases with the uncertainty of
the camera latency, m per second of its standard deviation, if the target is the position source.
Pictures that arrive 0.1 s later than assumed displace the vehicle by up to 0.2 m. Larger: a rotated
camera leads the vehicle further away."""
MAX_LATERAL_SETPOINT_MOVE_TO_COUNT_AS_VERTICAL_CLIMB_M = 0.1
"""Largest lateral distance between setpoint and start in a vertical climb, m."""
ESTIMATE_CONTRADICTS_IMU_DWELL_S = 0.1
"""Time for which the estimate must contradict the accelerometer, s."""
MIN_SINK_RATE_TO_COUNT_AS_OSCILLATION_MPS = 0.5
"""Sink rate that only an oscillation of position control reaches, m/s."""
MIN_CLIMB_ABOVE_ASCENT_SPEED_TO_COUNT_AS_OSCILLATION_MPS = 0.35
"""If the climb rate exceeds `ascend.speed_mps`, the setpoint's climb rate in an ascent, by more
than this value, m/s, position control must be oscillating; in flights with prompt positions, the
difference is 0.1. Larger: the vehicle strikes the target. Smaller: a gust ends the flight."""
TARGET_BELOW_VEHICLE_DWELL_S = 0.3
"""Time for which the target must appear below the vehicle, s."""
SLOW_AT_NEARLY_FULL_THRUST_DWELL_S = 2.0
"""Time at nearly full thrust after which a hovering vehicle counts as having too little thrust, s.
Larger: it sinks to the floor from a greater height. Smaller: a gust makes a weak vehicle land."""
NOT_CLIMBING_AT_FULL_THRUST_DWELL_S = 2.0
"""Time at full thrust after which a vehicle that does not climb has too little thrust for a press,
or is pressing against something, s. Larger: it presses for longer. Smaller: a gust makes a weak
vehicle land."""
SLOW_TAKEOFF_AT_NEARLY_FULL_THRUST_DWELL_S = 1.0
"""Time at full thrust after which a vehicle that takes off too slowly cannot fly, s; the weakest
vehicles that can perch reach full thrust for up to 0.4 s. Larger: the vehicle sinks to the floor
from a greater height. Smaller: a weak vehicle that can perch lands."""
HELD_BY_OTHER_OBJECT_DWELL_S = 2.0
"""Time that it takes to distinguish the magnet from other supports, s."""
MAX_VELOCITY_VARIANCE_TO_TRUST_STALE_POSITION_M2PS2 = 0.02
"""Variance of the estimated velocity above which a stale position counts as lost, (m/s)^2; it is
reached about 3 s after the last sighting."""
MIN_SIGHTING_TO_ESTIMATE_DISTANCE_TO_REJECT_ESTIMATE_M = 0.3
"""Distance of the newest sighting from the estimate beyond which the estimate is wrong, m. Larger:
position control moves the vehicle further away. Smaller: an oscillation ends the flight."""
MIN_POSITION_CORRECTION_AGE_TO_TRUST_REJECTED_SIGHTINGS_S = 0.35
"""Age of the newest position, including the latency, at which contradicting sightings can no longer
be a single mistake, s. Larger: position control diverges for longer. Smaller: one wrong detection
ends the flight."""


# --- Reliability of position, pictures and mounting ---


def is_position_control_diverging(c: Context) -> bool:
    """True if position control leads the vehicle away from its setpoint, as with external positions
    in the wrong axes: it is further away than any draught could move it, it oscillates vertically,
    or its estimated velocity contradicts the accelerometer. Always False if the position comes from
    a deck or is not valid."""
    setpoint, phase, b = c.state.setpoint, c.state.phase, c.belief
    if b.profile.positioning.source.is_deck or not b.is_position_valid:
        return False
    if c.true_for_s(
        ESTIMATE_CONTRADICTS_IMU
    ) >= ESTIMATE_CONTRADICTS_IMU_DWELL_S or _is_oscillating_vertically(c):
        return True
    if setpoint is None:
        return False
    if phase is Phase.LANDING:
        touched = (
            b.vehicle_world_z_at_last_contact_m is not None
            or c.state.motor_stop_commanded_at_s is not None
        )
        return (
            not touched
            and _lateral_distance_from_setpoint_m(c)
            > MAX_LATERAL_DISTANCE_FROM_SETPOINT_IN_LANDING_M
        )
    spare_m = (
        SETPOINT_DISTANCE_LIMIT_INCREASE_PER_LATENCY_SIGMA_MPS * c.obs.camera_latency_sigma_s
        if b.is_target_position_source
        else 0.0
    )
    if phase is Phase.APPROACH and b.height_m < MIN_HEIGHT_TO_COUNT_AS_LIFTED_OFF_M:
        return (
            _lateral_distance_from_setpoint_m(c)
            > MAX_LATERAL_DISTANCE_FROM_SETPOINT_BEFORE_LIFTOFF_M + spare_m
        )
    ground = b.takeoff_position_m
    above_start = ground is not None and (
        math.hypot(setpoint.x_m - ground[0], setpoint.y_m - ground[1])
        < MAX_LATERAL_SETPOINT_MOVE_TO_COUNT_AS_VERTICAL_CLIMB_M
    )
    only_climbs = above_start and phase in (Phase.APPROACH, Phase.SEARCH, Phase.ESTIMATE)
    is_pushed = (
        b.imu.t_s - b.imu.last_lateral_push_at_s <= MAX_PUSH_TO_ESTIMATE_RESPONSE_DELAY_S
    )  # by moving air
    stays = b.height_m < MAX_HEIGHT_TO_COUNT_AS_NEAR_FLOOR_M or (only_climbs and not is_pushed)
    return _lateral_distance_from_setpoint_m(c) > (
        MAX_LATERAL_DISTANCE_FROM_SETPOINT_NEAR_FLOOR_M + spare_m
        if stays
        else MAX_LATERAL_DISTANCE_FROM_SETPOINT_M
    )


def _is_oscillating_vertically(c: Context) -> bool:
    moves = c.state.phase in (Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.HOVER)
    by_capture = c.profile.positioning.source.is_mocap
    most_mps = c.planner.ascend.speed_mps + MIN_CLIMB_ABOVE_ASCENT_SPEED_TO_COUNT_AS_OSCILLATION_MPS
    return (
        moves
        and by_capture
        and not -MIN_SINK_RATE_TO_COUNT_AS_OSCILLATION_MPS <= c.belief.climb_mps <= most_mps
    )


def _lateral_distance_from_setpoint_m(c: Context) -> float:
    (x_m, y_m, _), setpoint = c.telemetry.position_m, c.state.setpoint
    return 0.0 if setpoint is None else math.hypot(x_m - setpoint.x_m, y_m - setpoint.y_m)


def position_control_divergence_reason(c: Context) -> str:
    """Return a message that says how position control diverges (vertical oscillation, distance from
    the setpoint, or a velocity that contradicts the accelerometer), and the possible causes. It is
    the reason to land once `is_position_control_diverging` is true, and does not check that
    again."""
    b = c.belief
    if _is_oscillating_vertically(c):
        return (
            f"vertical oscillation, {'climbing' if b.climb_mps > 0 else 'sinking'} at "
            f"{abs(b.climb_mps):.1f} m/s: motion-capture positions may be delayed"
        )
    cause = (
        "the motion capture may have swapped axes, delayed positions or a rotated rigid body; run "
        "perchctl check --lift"
    )
    if b.is_target_position_source:
        cause = (
            "the camera's rotation in camera.mount may be wrong; measure it with "
            "`perchctl calibrate mount`"
        )
    found = f"the vehicle drifted {_lateral_distance_from_setpoint_m(c):.2f} m from its setpoint"
    if c.true_for_s(ESTIMATE_CONTRADICTS_IMU) >= ESTIMATE_CONTRADICTS_IMU_DWELL_S:
        found = "the estimated velocity contradicts the accelerometer"
    return f"{found} at a height of {b.height_m:.2f} m: {cause}"


def is_position_lost(c: Context) -> bool:
    """True if no position has arrived for `positioning.land_s`. Also true earlier if the estimate
    is useless: after an impact or gust that no sighting has corrected; because sightings contradict
    it; or, with the target as the position source, because the position is stale and the variance
    of the estimated velocity too large."""
    b = c.belief
    if b.position_correction_age_s > c.profile.positioning.land_s or b.is_estimate_missing_gust:
        return True
    if (
        b.position_correction_age_s > MIN_POSITION_CORRECTION_AGE_TO_TRUST_REJECTED_SIGHTINGS_S
        and c.obs.rejected_sighting_to_estimate_distance_m
        > MIN_SIGHTING_TO_ESTIMATE_DISTANCE_TO_REJECT_ESTIMATE_M
    ):
        return True
    unsure = (
        b.max_axis_velocity_variance_m2ps2 > MAX_VELOCITY_VARIANCE_TO_TRUST_STALE_POSITION_M2PS2
    )
    return b.is_target_position_source and b.is_position_stale and unsure


def is_outside_fence(c: Context) -> bool:
    """True if the vehicle's estimated horizontal distance from its take-off position exceeds
    `safety.fence_radius_m`. False while the take-off position is unknown."""
    takeoff_position_m = c.belief.takeoff_position_m
    if takeoff_position_m is None:
        return False
    x, y, _ = c.telemetry.position_m
    dx, dy = x - takeoff_position_m[0], y - takeoff_position_m[1]
    return math.hypot(dx, dy) > c.safety.fence_radius_m


def is_outside_fleet_corridor(c: Context) -> bool:
    """True if the vehicle is outside the corridor that its fleet reserves for it
    (`safety.corridor`), where another vehicle may fly, or if its position is NaN. Always False
    without a corridor, as in a flight of one vehicle."""
    corridor, (x_m, y_m, _) = c.safety.corridor, c.telemetry.position_m
    return corridor is not None and not corridor.contains(x_m, y_m, c.belief.height_m)


def wrong_camera_latency_reason(c: Context) -> str:
    """Return a message with the measured age of the pictures and, if the profile sets the latency,
    that latency; otherwise, the range of latencies that can be measured in flight. If the telemetry
    is late, the message says instead by how much the times of pictures and telemetry disagree. It
    is the reason to land once pictures and accelerometer have shown that the latency is wrong, and
    does not check that again."""
    camera, b = c.profile.camera, c.belief
    assumed_s = camera.start_latency_s + c.obs.camera_latency_above_profile_s
    error_s = b.camera_imu_mismatch.camera_latency_error_s
    found = f"the pictures are {1e3 * (assumed_s + error_s):.0f} ms old"
    if not b.is_telemetry_fresh:  # with late telemetry, pictures that are on time seem late
        return (
            f"the times of pictures and telemetry disagree by {1e3 * error_s:.0f} ms; "
            f"the newest telemetry is {b.telemetry_age_s:.1f} s old"
        )
    if isinstance(camera.latency_s, str):
        least_s, most_s = USED_LATENCY_S
        return (
            f"{found}, but only a latency of {1e3 * least_s:.0f} to {1e3 * most_s:.0f} ms can be "
            f"measured in flight (camera.latency_s): find out what delays the pictures"
        )
    return (
        f"{found}, but camera.latency_s is {1e3 * assumed_s:.0f} ms: find out what delays the "
        "pictures"
    )


def is_camera_mounting_contradicted(c: Context) -> bool:
    """True if the camera seems to be mounted differently from the profile: the target moves along
    with the vehicle, the pictures fit the accelerometer only with a rotated camera, or the target
    has appeared below the vehicle for `TARGET_BELOW_VEHICLE_DWELL_S`."""
    b = c.belief
    below = c.true_for_s(TARGET_BELOW_VEHICLE) >= TARGET_BELOW_VEHICLE_DWELL_S
    return (
        b.camera_mounting_monitor.is_camera_mounting_wrong
        or b.camera_imu_mismatch.camera_yaw_error_rad != 0.0
        or below
    )


def wrong_camera_mounting_reason(c: Context) -> str:
    """Return a message that says how the camera seems to be mounted (rotated relative to the
    profile, or not pointing up), and what to check or correct. It is the reason to land once
    `is_camera_mounting_contradicted` is true, and does not check that again."""
    b = c.belief
    turn_rad = b.camera_imu_mismatch.camera_yaw_error_rad
    if turn_rad or b.camera_mounting_monitor.is_camera_mounting_wrong:
        turn_deg = 10 * round(
            math.degrees(turn_rad or b.camera_mounting_monitor.camera_yaw_error_rad) / 10.0
        )
        turn_deg = 180 if turn_deg == -180 else turn_deg
        text = (
            f"the camera seems to be rotated by about {turn_deg} deg relative to the profile: the "
            f"target moves with the vehicle; measure the mounting with `perchctl calibrate mount`, "
            f"or add {turn_deg} to the last value of camera.mount.rpy_deg"
        )
        capture = not turn_rad and c.profile.positioning.source.is_mocap
        return f"{text}; or the motion capture may have swapped axes" if capture else text
    return (
        f"the target appears {-b.target.gear_to_target_z_m:.1f} m below the vehicle: "
        f"camera.mount does not point the camera up"
    )


# --- Supports, obstacles and insufficient thrust ---


def is_held_by_target(c: Context) -> bool:
    """True if thrust, position and motion have shown for `HANGING_CONFIRMATION_DWELL_S` that
    something is holding the vehicle, and this support is the target's magnet. A press with a proven
    contact is not necessary: the magnet may catch the vehicle earlier."""
    hangs = c.true_for_s(HANGING) >= HANGING_CONFIRMATION_DWELL_S
    return hangs and c.vehicle_support is Support.MAGNET


def is_held_by_other_object(c: Context) -> bool:
    """True if something has held the vehicle for `HELD_BY_OTHER_OBJECT_DWELL_S`, and the vehicle is
    certainly away from the target's height or from its axis."""
    hangs = c.true_for_s(HANGING) >= HELD_BY_OTHER_OBJECT_DWELL_S
    return hangs and c.vehicle_support is Support.HELD_BY_OTHER_OBJECT


def is_climb_blocked(c: Context) -> bool:
    """True if the vehicle has pressed against an obstacle for `safety.blocked_s`."""
    return c.true_for_s(CLIMB_BLOCKED) >= c.safety.blocked_s


def is_climb_blocked_off_target(c: Context) -> bool:
    """True if the vehicle is blocked at a position where a press would not prove the contact: in
    any phase but PERCH, or in PERCH with the gear further from the target's height than
    `contact_height_tolerance_m`."""
    pressing = c.state.phase is Phase.PERCH
    return is_climb_blocked(c) and not (
        pressing and abs(c.belief.target.gear_to_target_z_m) <= contact_height_tolerance_m(c.belief)
    )


def is_thrust_insufficient_for_takeoff(c: Context) -> bool:
    """True if the vehicle has climbed too slowly at nearly full thrust for
    `SLOW_TAKEOFF_AT_NEARLY_FULL_THRUST_DWELL_S`, to be used during the take-off. Such a vehicle
    rises only in the ground effect or on a freshly charged battery, and would soon sink back."""
    return (
        c.true_for_s(SLOW_CLIMB_AT_NEARLY_FULL_THRUST) >= SLOW_TAKEOFF_AT_NEARLY_FULL_THRUST_DWELL_S
    )


def is_thrust_insufficient_to_fly_or_press(c: Context) -> bool:
    """True if too little thrust remains to keep flying or to press. Any of these shows it:

    - The vehicle has not climbed at full thrust for `NOT_CLIMBING_AT_FULL_THRUST_DWELL_S`.
    - The vehicle has hardly climbed at nearly full thrust for `SLOW_AT_NEARLY_FULL_THRUST_DWELL_S`.
      This does not count in ASCEND, since a weak vehicle that can perch climbs the last part
      slowly.
    - At the stand-off before a press, hover thrust exceeds
      `MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_SATURATED` times the largest press thrust. A mission
      that hovers does not press, so this does not apply to it.

    Always False while a press is being ended.
    """
    if c.state.must_end_press:
        return False
    ascends = c.state.phase is Phase.ASCEND
    if c.true_for_s(NOT_CLIMBING_AT_FULL_THRUST) >= NOT_CLIMBING_AT_FULL_THRUST_DWELL_S:
        return True
    if (
        not ascends
        and c.true_for_s(SLOW_CLIMB_AT_NEARLY_FULL_THRUST) >= SLOW_AT_NEARLY_FULL_THRUST_DWELL_S
    ):
        return True
    near = ascends and c.true_for_s(ASCENT_END_HEIGHT_REACHED) >= 0.0
    near = near and c.planner.hover is None
    return (
        near
        and c.belief.hover_thrust
        > MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_SATURATED * max_press_thrust(c.profile)
    )


def _outcome_if_supervisor_locks_hanging_vehicle(previous_outcome: Outcome | None) -> Outcome:
    """Return the outcome if the supervisor has locked a hanging vehicle. HOVERED becomes SAFETY,
    since a hover must end on the floor; any other outcome is kept; without an outcome, the result
    is PERCHED."""
    return (
        Outcome.SAFETY
        if previous_outcome is Outcome.HOVERED
        else previous_outcome or Outcome.PERCHED
    )


def has_time_for_all_attempts_run_out(c: Context) -> bool:
    """True if more than `planner.perching_time_s`, plus the duration of the hover in a mission that
    hovers, has passed since the start of the flight."""
    hover = c.planner.hover
    allowed_s = c.planner.perching_time_s + (0.0 if hover is None else hover.duration_s)
    return c.t_s - c.state.flight_started_at_s > allowed_s


SAFETY_ROWS: tuple[Transition, ...] = (
    motor_cut_row(
        "operator-stop",
        lambda c: c.obs.operator_request >= OperatorRequest.CUT_MOTORS,
        "the operator cut the motors",
        Outcome.EMERGENCY,
    ),
    Transition(
        "hung-but-locked",
        {Phase.COMPLETE, Phase.LANDING},
        lambda c: c.telemetry.has_bit(LOCKED) and is_hanging_with_motors_off(c),
        Phase.PERCHED,
        "hanging, but the supervisor has locked the vehicle: restart it before the next flight",
        outcome=_outcome_if_supervisor_locks_hanging_vehicle,
    ),
    supervisor_abort_row(
        "locked", LOCKED, "the supervisor has locked the vehicle: inspect and restart it"
    ),
    supervisor_abort_row("tumbled", TUMBLED, "the vehicle has tumbled: inspect and restart it"),
    supervisor_abort_row(
        "crashed", CRASHED, "the supervisor reports a crash: inspect and restart the vehicle"
    ),
    motor_cut_row(
        "tilted",
        lambda c: (
            c.true_for_s(TILT_TOO_LARGE) >= c.safety.tilt_debounce_s
            and c.state.motor_stop_commanded_at_s is None
        ),
        "tilted beyond the limit: motors cut",
    ),
    land_row(
        "operator-land",
        PRE_LANDING_PHASES,
        lambda c: c.obs.operator_request >= OperatorRequest.LAND,
        "the operator asked to land",
        Outcome.ENDED_BY_OPERATOR,
    ),
    land_row(
        "link-lost",
        PRE_LANDING_PHASES,
        lambda c: c.obs.link_problem is not None,
        lambda c: f"link lost: {c.obs.link_problem}",
    ),
    land_row(
        "telemetry-stale",
        PRE_LANDING_PHASES,
        lambda c: c.belief.telemetry_age_s > c.safety.telemetry_land_s,
        lambda c: f"the newest telemetry is {c.belief.telemetry_age_s:.1f} s old",
    ),
    land_row(
        "heading-lost",
        PRE_CONTACT_PHASES,
        lambda c: c.belief.is_heading_lost,
        "the estimated heading jumped: descending level on thrust alone",
    ),
    land_row(
        "position-astray",
        FREE_AIR_PHASES | {Phase.LANDING},
        is_position_control_diverging,
        position_control_divergence_reason,
        diagnosis=VehicleDiagnosis.EXTERNAL_POSITIONS_WRONG | VehicleDiagnosis.PROFILE_MAY_BE_WRONG,
    ),
    land_row(
        "position-lost",
        FREE_AIR_PHASES | {Phase.PERCH},
        is_position_lost,
        lambda c: f"{position_loss_text(c.belief)}; descending level on thrust alone",
    ),
    land_row(
        "estimator-jump",
        PRE_CONTACT_PHASES,
        lambda c: (
            c.belief.first_estimate_jump_at_s is not None
            and c.t_s - c.belief.first_estimate_jump_at_s >= c.safety.jump_hold_s
        ),
        "the state estimate jumped: landing at the current position",
    ),
    land_row(
        "estimate-unsure",
        FREE_AIR_PHASES,
        lambda c: c.true_for_s(ESTIMATE_VARIANCE_TOO_LARGE) >= c.safety.variance_land_s,
        lambda c: f"{excessive_variance_text(c.belief)}: the positioning system may have failed",
    ),
    land_row(
        "battery-low",
        PRE_CONTACT_PHASES,
        lambda c: c.true_for_s(BATTERY_LOW) >= c.safety.battery_debounce_s,
        lambda c: f"battery at {c.telemetry.battery_v:.2f} V under load",
    ),
    land_row(
        "battery-unknown",
        PRE_CONTACT_PHASES,
        lambda c: c.obs.battery_reading_age_s > c.safety.battery_stale_s,
        "the battery reading is no longer updated",
    ),
    land_row(
        "latency",
        FREE_AIR_PHASES,
        lambda c: c.belief.camera_imu_mismatch.camera_latency_error_s != 0.0,
        wrong_camera_latency_reason,
        diagnosis=VehicleDiagnosis.PROFILE_MAY_BE_WRONG,
    ),
    land_row(
        "mounting",
        FREE_AIR_PHASES,
        is_camera_mounting_contradicted,
        wrong_camera_mounting_reason,
        diagnosis=VehicleDiagnosis.CAMERA_MOUNTING_WRONG | VehicleDiagnosis.PROFILE_MAY_BE_WRONG,
    ),
    land_row(
        "height-limit",
        PRE_CONTACT_PHASES,
        lambda c: c.belief.height_m > c.safety.max_height_m,
        lambda c: f"height {c.belief.height_m:.2f} m is above the limit",
    ),
    land_row("fence", PRE_CONTACT_PHASES, is_outside_fence, "outside the fence"),
    land_row("corridor", PRE_CONTACT_PHASES, is_outside_fleet_corridor, "outside its corridor"),
    land_row(
        "camera-gone",
        CAMERA_GUIDED_PHASES,
        lambda c: c.obs.last_good_frame_age_s > c.safety.camera_land_s,
        lambda c: no_picture_reason(c.belief),
    ),
    land_row(
        "loop-late",
        PRE_LANDING_PHASES,
        lambda c: c.obs.tick_start_delay_s > c.safety.loop_late_land_s,
        lambda c: f"the control loop was {c.obs.tick_start_delay_s:.1f} s late",
    ),
    land_row(
        "markers-disagree",
        CAMERA_GUIDED_PHASES,
        lambda c: c.obs.successive_marker_conflict_frames >= c.profile.merge.disagreement_frames,
        "the two markers contradict each other: check the printed sizes and the calibration",
    ),
    land_row(
        "log-lost",
        PRE_CONTACT_PHASES,
        lambda c: c.safety.land_on_log_error and c.obs.flight_log_problem is not None,
        lambda c: f"flight log: {c.obs.flight_log_problem}",
    ),
    land_row(
        "time-over",
        PRE_CONTACT_PHASES,
        has_time_for_all_attempts_run_out,
        lambda c: (
            "the perching time has run out"
            if c.planner.hover is None
            else "the hover was not completed in time"
        ),
        Outcome.ATTEMPTS_USED_UP,
    ),
    # --- the magnet may catch early ---
    Transition(
        "caught",
        PHASES_IN_WHICH_MAGNET_MAY_ATTACH,
        is_held_by_target,
        Phase.COMPLETE,
        "already hanging on the magnet",
    ),
    land_row(
        "held",
        PHASES_IN_WHICH_MAGNET_MAY_ATTACH,
        is_held_by_other_object,
        "something holds the vehicle in place, away from the target",
        diagnosis=VehicleDiagnosis.HELD_BY_OTHER_OBJECT,
    ),
    land_row(
        "hangs-at-contact",
        PHASES_IN_WHICH_MAGNET_MAY_ATTACH,
        lambda c: c.true_for_s(HANGING) >= HELD_BY_OTHER_OBJECT_DWELL_S,
        lambda c: (
            f"the vehicle is hanging at the target's height, "
            f"{gear_to_target_at_last_contact_or_now(c.belief).text}: "
            "the target's magnet may hold it"
        ),
        diagnosis=VehicleDiagnosis.HANGING_AT_LAST_TOUCH,
    ),
    # --- obstacles ---
    land_row(
        "cannot-rise",
        {Phase.APPROACH},
        lambda c: is_climb_blocked(c) or is_thrust_insufficient_for_takeoff(c),
        lambda c: (
            f"cannot climb above {c.belief.height_m:.2f} m: an obstacle is above, or the thrust is "
            f"too low"
        ),
    ),
    back_off_row(
        "blocked",
        PHASES_IN_WHICH_MAGNET_MAY_ATTACH,
        is_climb_blocked_off_target,
        lambda c: (
            f"pressing against an obstacle at {c.belief.height_m:.2f} m"
            + ("" if c.belief.hover_thrust else ", or the thrust is too low")
        ),
        diagnosis=VehicleDiagnosis.BLOCKED_BY_OBSTACLE,
    ),
    land_row(
        "too-weak",
        CAMERA_GUIDED_PHASES,
        is_thrust_insufficient_to_fly_or_press,
        "hovering needs all of the thrust: the vehicle is too heavy, the battery too low, or an "
        "obstacle is above",
    ),
)
"""The safety rows in their order. Your own rows follow them and precede the exits of the phases."""
