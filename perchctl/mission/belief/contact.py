"""Evidence that something supports, presses or holds the vehicle.

The vehicle has no force sensor, so a contact is inferred from thrust, accelerometer and motion
together. In the air, thrust minus weight accelerates the vehicle. If the vehicle is supported or
pressed, its accelerometer reads 1 g and it does not move, whatever its thrust. A vehicle at rest
whose accelerometer reads 1 g is therefore in contact with something if its thrust is far from hover
thrust: with more thrust, the vehicle is pressing; with less thrust, something is supporting the
vehicle. The vehicle's position and its maneuver then distinguish the magnet from the floor, and
both from another object.

One threshold decides whether the thrust exceeds hover thrust (`is_thrust_above_hover`). A vehicle
at rest with that thrust is pressing (`is_pressing_against_surface`):
against the target if it is at the target's height (`TARGET_CONTACT`), against an obstacle if the
setpoint is above the vehicle (`CLIMB_BLOCKED`), and, if its position is unknown, against an unknown
object (`IMU_SHOWS_SUPPORT`).
`IMU_SHOWS_SUPPORT` also applies if the thrust is too small; its lower threshold is as far below
hover thrust as the threshold for a press is above it. A change of
`MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS` therefore affects all of these conditions, and
`Support.AIR`. `HANGING`, `MAGNET_HOLDS_VEHICLE` and `ON_FLOOR` require a thrust too small to
support the vehicle (`is_thrust_too_low_to_fly`).

`find_support` combines these conditions into one result: the vehicle is flying, pressing, hanging
on the magnet, held by something else, or on the floor, or its support is unknown. `true_for_s`
returns how long a condition has lasted. Each row of the transition table has its own dwell time,
chosen by what a mistake would cost.
"""

from __future__ import annotations

import math
from enum import Enum

from perchctl.mission.belief.belief import Belief, GearToTargetDistance
from perchctl.mission.belief.evidence import Condition, RequiredData
from perchctl.mission.belief.thrust import MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE
from perchctl.profile import Profile
from perchctl.vehicle import FLYING, FULL_THRUST

# --- thrust ---
MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS = 1.08
"""Ratio of reported thrust to hover thrust at which a vehicle at rest counts as pressing: a margin
of more than five standard deviations of the hover thrust learned in quiet flight. Larger: a weak
press goes undetected. Smaller: a gust or a sagging battery looks like a press."""
MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_SATURATED = 0.98
"""Fraction of full thrust above which the motors are saturated, so that the thrust no longer shows
how much the vehicle needs."""
MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_NEARLY_FULL = 0.96
"""Fraction of full thrust that a sufficiently powerful vehicle needs only when it climbs. A vehicle
with less than 4 % to spare sinks by half a metre after each interruption of its setpoints. Larger:
such a vehicle goes on until it falls to the floor. Smaller: weak vehicles that can perch land."""
MAX_RAW_THRUST_APPLIED_BY_FIRMWARE = 60000.0
"""Largest raw thrust that the firmware applies, 0..65535."""
MIN_REPORTED_TO_COMMANDED_THRUST_RATIO_TO_DETECT_PRESS = 0.99
"""Ratio of reported to commanded thrust at which a vehicle that presses by raw thrust always counts
as pressing. Larger: a reading just below the commanded thrust goes undetected. Smaller: a heavy
vehicle seems to be pressing while it is hovering."""
MAX_HOVER_TO_FULL_THRUST_RATIO_TO_DETECT_PRESS = 0.93
"""Hover thrust, as a fraction of full thrust, above which too little thrust remains to prove a
press. Smaller: a press is never detected on a heavy vehicle."""
MAX_HOVER_THRUST_FRACTION_TOO_LOW_TO_FLY = 0.8
"""Fraction of hover thrust up to which thrust cannot hold the vehicle in the air. With more thrust,
the ground effect of the ceiling may hold it."""
MAX_RAW_THRUST_WITH_MOTORS_STOPPED = 5000
"""Largest raw thrust, 0..65535, at which the motors do not turn."""
MIN_PLAUSIBLE_HOVER_RAW_THRUST = 1000
"""Smallest reported thrust, 0..65535, that may be hover thrust; the hover thrust of any vehicle is
far larger."""

# --- motion and position ---
MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS = 0.05
"""Vertical speed below which the vehicle counts as motionless, m/s. Larger: a slow descent looks
like hanging."""
MIN_CLIMB_RATE_EXPECTED_AT_FULL_THRUST_MPS = 0.2
"""Climb rate that any vehicle with enough thrust to hover soon exceeds at full thrust, m/s: at full
thrust, the weakest vehicles that can perch take off at 0.3 to 0.5 m/s. Larger: such a vehicle lands
at once. Smaller: a vehicle that only the ground effect lifts rises further before it sinks."""
MAX_SPEED_TO_COUNT_THRUST_AS_HOVER_MPS = 0.3
"""Largest speed at which the present thrust counts as hover thrust, m/s."""
MAX_CLIMB_RATE_TO_COUNT_THRUST_AS_HOVER_MPS = 0.27
"""Largest vertical speed at which the present thrust counts as hover thrust, m/s."""
MAX_SPECIFIC_FORCE_DEVIATION_TO_COUNT_THRUST_AS_HOVER_G = 0.1
"""Largest deviation of the specific force from 1 g at which the present thrust counts as hover
thrust, g."""
MAX_ESTIMATED_HEIGHT_DRIFT_RATE_WHILE_PRESSED_MPS = 0.1
"""Rate at which a pressed vehicle's estimated height may drift, m/s. Larger: a contact far from the
target is accepted. Smaller: a true contact is rejected if the last sighting is old."""
MIN_SETPOINT_HEIGHT_ABOVE_VEHICLE_TO_DETECT_PRESS_M = 0.08
"""Distance of the setpoint above a motionless vehicle beyond which the vehicle must be pressing
against whatever blocks it, m. Larger: a blocked climb is detected late."""
GEAR_DISPLACEMENT_BY_TOUCH_SIGMA_M = 0.001
"""Standard deviation of the distance by which the touch itself moves the gear, m."""
LATERAL_SPEED_SIGMA_BEFORE_TOUCH_MPS = 0.02
"""Standard deviation of the lateral speed of a vehicle that is about to touch, m/s: twice that of a
settled vehicle. Larger: the offset of a contact is reported as less precise than it is. Smaller: if
the vehicle is pushed just before it touches, the offset is reported as more precise than it is."""
DECK_POSITION_SIGMA_ADDED_BY_CEILING_IMPACT_M = 0.002
"""Uncertainty that the impact on the ceiling adds to a position from a deck, m."""
DECK_POSITION_SIGMA_GROWTH_WITHOUT_SIGHTING_MPS = 0.01
"""Rate at which the uncertainty of a position from a deck grows without a sighting, m/s."""
MAX_HEIGHT_ABOVE_LAST_CONTACT_TO_DETECT_SLIP_M = 0.02
"""Largest upward drift of the estimated height despite which a slip is still detected, m."""
MIN_HEIGHT_LOSS_IN_DESCENT_TO_DETECT_FLOOR_M = 0.1
"""Height loss beyond which a descending vehicle counts as having come down, m."""
MAX_HEIGHT_LOSS_TO_COUNT_AS_STILL_HANGING_M = 0.1
"""Height loss within which a descending vehicle may still be held where its descent began, m."""
MIN_ESTIMATED_HEIGHT_TO_COUNT_AS_HANGING_M = 0.3
"""Estimated height up to which a vehicle held at low thrust may be on the floor instead of hanging,
m; allows for the drift of the height in flight. (`MAX_HEIGHT_TO_COUNT_AS_STANDING_BEFORE_TAKEOFF_M`
applies before take-off, when the height has not drifted yet.)"""
MIN_HEIGHT_TO_DETECT_BLOCKED_CLIMB_M = 0.15
"""Height above which a blocked vehicle has left the ground, m."""
MAX_HEIGHT_TO_COUNT_AS_STANDING_BEFORE_TAKEOFF_M = 0.1
"""Height below which a vehicle may still be on the ground instead of pressing, m."""
MAX_GEAR_TO_TARGET_Z_TO_COUNT_AS_HANGING_M = 0.15
"""Largest height difference between gear and target, m, at which the vehicle may hang on its
magnet."""
MIN_GEAR_TO_TARGET_Z_TO_COUNT_AS_ON_FLOOR_M = 0.3
"""Smallest height difference between gear and target, m, of a vehicle that is on the floor."""
MAX_CLIMB_RATE_TO_DETECT_FALL_IN_WEIGHT_TRANSFER_MPS = -0.05
"""Climb rate below which a vehicle with a low specific force is falling, once the weight transfer
by raw thrust has begun, m/s."""

# --- time ---
MIN_TIME_AFTER_MOTOR_STOP_TO_TRUST_ZERO_THRUST_S = 5.0
"""Time after a stop command from which zero thrust alone shows that the motors are off, s: the
flying bit stays set for 2 s."""
MOTORS_OFF_DWELL_S = 0.1
"""Time for which telemetry must show the motors off before they count as off, s. Smaller: one wrong
sample ends the flight. Larger: the flight ends later."""
HANGING_CONFIRMATION_DWELL_S = 1.0
"""Time for which a vehicle must hang to prove that the magnet holds it, s."""


# --- Offset of the gear from the target ---


def current_gear_to_target(b: Belief) -> GearToTargetDistance:
    """Return the present distance between the gear and the target's axis, with its standard
    deviation. It comes from the newest image if that was exposed during the present contact, or
    just before it, and is at least as precise as dead reckoning from the last sighting, otherwise
    from dead reckoning. With a deck as the position source, the standard deviation of the
    dead-reckoned distance grows with the age of the sighting, because the estimated position drifts
    and the impact on the ceiling disturbs it."""
    reckoned, seen = _dead_reckoned_gear_to_target(b), _gear_to_target_seen_in_contact(b)
    return reckoned if seen is None or reckoned.sigma_m < seen.sigma_m else seen


def _gear_to_target_seen_in_contact(b: Belief) -> GearToTargetDistance | None:
    """Return the distance between the gear and the target's axis in the newest image that shows the
    target, if that image was exposed during the present contact or just before it; otherwise None.

    Friction holds the gear while it is pressed, so the distance in an image remains valid until the
    contact ends. It does not depend on the state estimate, which wanders by millimetres. Before the
    touch, a settled vehicle hardly moves sideways. Images that contradict the vehicle's motion are
    not used: they may be older than they seem. The distance is wrong if the vehicle is pushed or
    slides after the exposure.
    """
    target = b.obs.target
    if (
        target is None
        or target.measured_gear_to_target_world_m is None
        or b.obs.camera_imu_mismatch is not None
        or b.camera_mounting_monitor.is_camera_mounting_wrong
        or not _is_in_contact_with_target(b)
    ):
        return None
    x_m, y_m, z_m = target.measured_gear_to_target_world_m.tolist()
    before_touch_s = max(0.0, b.imu.climb_rate_became_steady_at_s - target.last_measured_at_s)
    perch = b.profile.planner.perch
    if abs(z_m) > perch.contact_z_m + perch.climb_mps * before_touch_s:
        return None
    # In a very slow climb, the speed does not show when the climb ends, but the image still shows
    # the gap between gear and target.
    before_touch_s = max(before_touch_s, z_m / perch.climb_mps)
    sigma_m = math.hypot(
        target.measured_gear_to_target_sigma_m,
        GEAR_DISPLACEMENT_BY_TOUCH_SIGMA_M,
        LATERAL_SPEED_SIGMA_BEFORE_TOUCH_MPS * before_touch_s,
    )
    return GearToTargetDistance(math.hypot(x_m, y_m), sigma_m)


def _dead_reckoned_gear_to_target(b: Belief) -> GearToTargetDistance:
    dead_reckoning = b.dead_reckoning
    sigma_m = math.hypot(
        dead_reckoning.gear_to_target_sigma_m,
        GEAR_DISPLACEMENT_BY_TOUCH_SIGMA_M,
        *dead_reckoning.unexplained_position_step_sum_world_xy_m,
    )
    if b.profile.positioning.source.is_deck and b.is_position_valid:
        sigma_m = math.hypot(
            sigma_m,
            DECK_POSITION_SIGMA_ADDED_BY_CEILING_IMPACT_M,
            DECK_POSITION_SIGMA_GROWTH_WITHOUT_SIGHTING_MPS * b.sighting_age_s,
        )
    return GearToTargetDistance(math.hypot(*dead_reckoning.gear_to_target_world_xy_m), sigma_m)


def valid_gear_to_target_at_last_contact(b: Belief) -> GearToTargetDistance | None:
    """Return the gear's distance from the target's axis at the last touch, while the vehicle
    retreats from an attempt (RECOVER). None in all other maneuvers, with a fresh sighting, before
    the first touch, or once motion capture shows that the vehicle is more than
    `perch.contact_xy_m` away, horizontally, from the position where the retreat began."""
    if (
        not b.command_history.maneuver.retreats_after_attempt
        or b.gear_to_target_at_last_contact is None
        or b.target.is_fresh
    ):
        return None
    x_m, y_m, _ = b.telemetry.position_m
    away_m = math.hypot(
        x_m - b.command_history.maneuver_start_position_m[0],
        y_m - b.command_history.maneuver_start_position_m[1],
    )
    by_capture = b.profile.positioning.source.is_mocap and b.is_position_valid
    if by_capture and away_m > b.profile.planner.perch.contact_xy_m:
        return None
    return b.gear_to_target_at_last_contact


def gear_to_target_at_last_contact_or_now(b: Belief) -> GearToTargetDistance:
    """Return the gear's distance from the target's axis at the last touch if it is still valid,
    which is only possible while the vehicle retreats from an attempt
    (`valid_gear_to_target_at_last_contact`), otherwise the present distance
    (`current_gear_to_target`)."""
    return valid_gear_to_target_at_last_contact(b) or current_gear_to_target(b)


def contact_height_tolerance_m(b: Belief) -> float:
    """Return the largest height difference between gear and target, m, at which the object that
    holds the vehicle may be the target.

    The tolerance grows with the time since the last sighting, because the estimated height drifts.
    The tolerance is at most twice `perch.contact_z_m`, so that an obstacle further below is not
    mistaken for the target. The condition `TARGET_CONTACT`, which proves a touch of the target,
    uses its own tolerances.
    """
    planner = b.profile.planner
    drift_mps = (
        MAX_ESTIMATED_HEIGHT_DRIFT_RATE_WHILE_PRESSED_MPS
        if b.is_target_position_source
        else planner.landing.drift_mps
    )
    return planner.perch.contact_z_m + min(planner.perch.contact_z_m, drift_mps * b.sighting_age_s)


def is_at_contact_height(b: Belief) -> bool:
    """True if the gear is at the target's height, within `contact_height_tolerance_m`."""
    return abs(b.target.gear_to_target_z_m) <= contact_height_tolerance_m(b)


def is_gear_certainly_in_magnet_reach(b: Belief) -> bool:
    """True if the gear is at the target's height and so close to its axis that the magnet reaches
    it: the offset plus one standard deviation is at most `perch.contact_xy_m`."""
    near = current_gear_to_target(b).is_certainly_within(b.profile.planner.perch.contact_xy_m)
    return near and is_at_contact_height(b)


# --- Evidence from the thrust ---


def max_press_thrust(profile: Profile) -> float:
    """Return the largest thrust that a press can reach, 0..65535: in a press by raw thrust, the
    profile's `perch.thrust`, limited to `MAX_RAW_THRUST_APPLIED_BY_FIRMWARE`; otherwise full
    thrust."""
    perch = profile.planner.perch
    return (
        min(float(perch.thrust), MAX_RAW_THRUST_APPLIED_BY_FIRMWARE)
        if perch.mode == "raw"
        else FULL_THRUST
    )


def is_flying_at_hover_thrust(b: Belief) -> bool:
    """True if the vehicle flies so quietly that its present thrust is hover thrust: speed, climb
    rate and specific force are within `MAX_SPEED_TO_COUNT_THRUST_AS_HOVER_MPS`,
    `MAX_CLIMB_RATE_TO_COUNT_THRUST_AS_HOVER_MPS` and
    `MAX_SPECIFIC_FORCE_DEVIATION_TO_COUNT_THRUST_AS_HOVER_G` of those in hover, the motors are
    neither off nor saturated, and nothing blocks a climb. False without fresh telemetry or a valid
    position. The thrust is not compared with the estimated hover thrust."""
    tel, setpoint = b.telemetry, b.command_history.setpoint
    vz = tel.velocity_mps[2]
    stuck = (
        setpoint is not None
        and setpoint.z_m - tel.position_m[2] > MIN_SETPOINT_HEIGHT_ABOVE_VEHICLE_TO_DETECT_PRESS_M
        and vz < MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS
    )
    return (
        b.is_telemetry_fresh
        and b.is_position_valid
        and MIN_PLAUSIBLE_HOVER_RAW_THRUST
        <= tel.thrust
        < MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_SATURATED * FULL_THRUST
        and b.speed_mps < MAX_SPEED_TO_COUNT_THRUST_AS_HOVER_MPS
        and abs(vz) < MAX_CLIMB_RATE_TO_COUNT_THRUST_AS_HOVER_MPS
        and abs(tel.acc_z_g - 1.0) < MAX_SPECIFIC_FORCE_DEVIATION_TO_COUNT_THRUST_AS_HOVER_G
        and not stuck
    )


def is_thrust_too_low_to_fly(b: Belief) -> bool:
    """True if the reported thrust is too small to support the vehicle in the air.

    The limit is `complete.hold_ratio` times hover thrust. Position mode never commands less than
    `MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE`, so that value is the limit if it is larger and still
    too small to lift the vehicle. False while hover thrust is unknown or the reported thrust is not
    reliable.
    """
    most = b.profile.planner.complete.hold_ratio * b.hover_thrust
    if (
        MAX_HOVER_THRUST_FRACTION_TOO_LOW_TO_FLY * b.hover_thrust
        >= MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE
    ):
        most = max(most, MIN_RAW_THRUST_IN_FIRMWARE_POSITION_MODE)
    return b.is_reported_thrust_reliable and b.hover_thrust > 0 and b.telemetry.thrust <= most


def is_thrust_above_hover(b: Belief) -> bool:
    """True if the reported thrust is at least `MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS`
    times hover thrust. If the vehicle cannot produce that much, or hover thrust is unknown, a
    thrust close to the largest possible one is enough: close to `max_press_thrust` during a press
    by raw thrust, otherwise close to full thrust."""
    most = MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_SATURATED * FULL_THRUST
    if (
        b.command_history.maneuver.presses_against_target
        and b.command_history.commanded_raw_thrust is not None
    ):
        most = MIN_REPORTED_TO_COMMANDED_THRUST_RATIO_TO_DETECT_PRESS * max_press_thrust(b.profile)
    least = (
        min(MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS * b.hover_thrust, most)
        if b.hover_thrust > 0
        else most
    )
    return b.telemetry.thrust >= least


def is_pressing_against_surface(b: Belief) -> bool:
    """True if the thrust exceeds hover thrust (`is_thrust_above_hover`), the estimated vertical
    speed is at most `MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS` in either direction, and the
    vehicle is too high to be on the ground."""
    return (
        is_thrust_above_hover(b)
        and abs(b.telemetry.velocity_mps[2]) <= MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS
        and b.height_m >= MAX_HEIGHT_TO_COUNT_AS_STANDING_BEFORE_TAKEOFF_M
    )


# --- Conditions that must last for some time ---


def is_slipping_off_contact(b: Belief) -> bool:
    """True if the vehicle is sinking faster than `complete.slip_mps` after a contact, and either
    its estimated height is not above the height of the contact (within
    `MAX_HEIGHT_ABOVE_LAST_CONTACT_TO_DETECT_SLIP_M`), or the accelerometer reads less than
    `complete.slip_acc_g`, or the position is not valid. False if no contact is recorded."""
    complete, tel = b.profile.planner.complete, b.telemetry
    if b.vehicle_world_z_at_last_contact_m is None or not b.is_sinking(complete.slip_mps):
        return False
    above_m = tel.position_m[2] - b.vehicle_world_z_at_last_contact_m
    return (
        not b.is_position_valid
        or above_m < MAX_HEIGHT_ABOVE_LAST_CONTACT_TO_DETECT_SLIP_M
        or tel.acc_z_g < complete.slip_acc_g
    )


def is_vertically_motionless(b: Belief) -> bool:
    """True if the vehicle does not move vertically, as in hover or on a support: the accelerometer
    reads 1 g and, if the position is valid, the vertical speed is less than
    `MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS`. Without a valid position, a constant climb rate
    also counts."""
    return b.is_accelerometer_reading_one_g and (
        abs(b.telemetry.velocity_mps[2]) < MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS
        or not b.is_position_valid
    )


def _is_in_contact_with_target(b: Belief) -> bool:
    """True if position, acceleration and thrust together show that the gear is pressed against the
    target.

    The gear has stopped within `perch.contact_z_m` of the target's height, the accelerometer reads
    1 g, and the thrust exceeds hover thrust, so the ceiling must be pushing back. With the target
    as the only position source, the tolerance in height grows with the age of the last sighting.
    The lateral distance from the target is not checked.
    """
    perch, tel = b.profile.planner.perch, b.telemetry
    steady = (
        abs(tel.velocity_mps[2]) <= MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS
        and b.is_position_valid
    )
    motionless_s = b.obs.t_s - b.imu.climb_rate_became_steady_at_s
    return (
        abs(b.target.gear_to_target_z_m)
        <= perch.contact_z_m
        + (
            MAX_ESTIMATED_HEIGHT_DRIFT_RATE_WHILE_PRESSED_MPS * b.sighting_age_s
            if b.is_target_position_source
            else 0
        )
        and (steady or motionless_s >= perch.contact_dwell_s)
        and b.is_accelerometer_reading_one_g
        and b.hover_thrust > 0
        and b.is_reported_thrust_reliable
        and is_thrust_above_hover(b)
    )


def _is_magnet_holding_vehicle(b: Belief) -> bool:
    return (
        is_thrust_too_low_to_fly(b)
        and not is_slipping_off_contact(b)
        and (b.is_position_valid or is_vertically_motionless(b))
    )


def _is_hanging_with_motors_stopped(b: Belief) -> bool:
    """True if the vehicle is hanging, with its motors stopped, where it made contact: the weight
    transfer (reduction of raw thrust until the support carries the whole weight) has begun, the
    reported thrust is at most `MAX_RAW_THRUST_WITH_MOTORS_STOPPED` (or is unreliable), and the
    vehicle neither moves vertically nor slips."""
    return (
        b.command_history.weight_transfer_began_at_s is not None
        and (
            b.telemetry.thrust <= MAX_RAW_THRUST_WITH_MOTORS_STOPPED
            or not b.is_reported_thrust_reliable
        )
        and is_vertically_motionless(b)
        and not is_slipping_off_contact(b)
    )


def _is_hanging(b: Belief) -> bool:
    """True if something is holding the vehicle up: it is motionless, off the floor, at a thrust too
    small to support it. During a descent to the floor, it must also be at the height of the last
    contact, at the target's height, or still where the descent began, because a drifted height may
    hide the floor. Without a valid position, a magnet cannot be distinguished from the floor, and
    the result is True in both cases; the slow reduction of the thrust that follows is safe in
    both."""
    tel, complete = b.telemetry, b.profile.planner.complete
    if not b.is_position_valid:
        return is_thrust_too_low_to_fly(b) and is_vertically_motionless(b)
    held = (
        is_thrust_too_low_to_fly(b)
        and b.height_m > MIN_ESTIMATED_HEIGHT_TO_COUNT_AS_HANGING_M
        and is_vertically_motionless(b)
    )
    if not b.command_history.maneuver.descends_to_floor:
        return held
    at_contact = (
        b.vehicle_world_z_at_last_contact_m is not None
        and abs(tel.position_m[2] - b.vehicle_world_z_at_last_contact_m) <= complete.slip_m
    )
    at_target = (
        b.obs.target is not None
        and abs(b.target.gear_to_target_z_m) <= MAX_GEAR_TO_TARGET_Z_TO_COUNT_AS_HANGING_M
    )
    stayed = (
        b.command_history.maneuver_start_position_m[2] - tel.position_m[2]
        < MAX_HEIGHT_LOSS_TO_COUNT_AS_STILL_HANGING_M
        and not b.target.is_too_far_above_to_hold_vehicle
    )
    return held and (at_contact or at_target or stayed)


def _are_motors_off(b: Belief) -> bool:
    """True if the thrust is zero and the supervisor no longer reports the vehicle as flying.
    `MIN_TIME_AFTER_MOTOR_STOP_TO_TRUST_ZERO_THRUST_S` after a stop command, zero thrust is
    enough."""
    motor_stop_commanded_at_s = b.command_history.motor_stop_commanded_at_s
    long_off = (
        motor_stop_commanded_at_s is not None
        and b.obs.t_s - motor_stop_commanded_at_s > MIN_TIME_AFTER_MOTOR_STOP_TO_TRUST_ZERO_THRUST_S
    )
    return b.telemetry.thrust < 1 and (not b.telemetry.has_bit(FLYING) or long_off)


def _is_raw_thrust_commanded(b: Belief) -> bool:
    return (b.command_history.commanded_raw_thrust or 0) > 0


def _are_motors_off_as_commanded(b: Belief) -> bool:
    return _are_motors_off(b) and not _is_raw_thrust_commanded(b)


def _are_motors_off_despite_thrust_command(b: Belief) -> bool:
    return _are_motors_off(b) and _is_raw_thrust_commanded(b)


def _is_on_floor(b: Belief) -> bool:
    """True if the vehicle is motionless, at a thrust too small to support it, is not near the
    target's height, and either is lower than `landing.handover_m` or has lost height in a descent
    without a recorded contact. The height alone is not sufficient evidence, because the estimate
    may have drifted."""
    near_target = (
        b.obs.target is not None
        and abs(b.target.gear_to_target_z_m) <= MIN_GEAR_TO_TARGET_Z_TO_COUNT_AS_ON_FLOOR_M
    )
    came_down_m = b.command_history.maneuver_start_position_m[2] - b.telemetry.position_m[2]
    came_down = (
        b.command_history.maneuver.descends_to_floor
        and came_down_m > MIN_HEIGHT_LOSS_IN_DESCENT_TO_DETECT_FLOOR_M
    )
    handover_m = b.profile.planner.landing.handover_m
    low = b.height_m < handover_m or (came_down and b.vehicle_world_z_at_last_contact_m is None)
    return is_thrust_too_low_to_fly(b) and low and not near_target and is_vertically_motionless(b)


def _is_pressing_against_obstacle(b: Belief) -> bool:
    """True if something blocks the vehicle's climb: the setpoint is above the vehicle, the thrust
    exceeds hover thrust, the vehicle is above `MIN_HEIGHT_TO_DETECT_BLOCKED_CLIMB_M`, and it does
    not move vertically. False for a vehicle so heavy that too little thrust remains to prove a
    press (`MAX_HOVER_TO_FULL_THRUST_RATIO_TO_DETECT_PRESS`). The target also counts as an
    obstacle."""
    setpoint, tel = b.command_history.setpoint, b.telemetry
    if (
        setpoint is None
        or setpoint.z_m - tel.position_m[2] < MIN_SETPOINT_HEIGHT_ABOVE_VEHICLE_TO_DETECT_PRESS_M
    ):
        return False
    strong = (
        b.hover_thrust < MAX_HOVER_TO_FULL_THRUST_RATIO_TO_DETECT_PRESS * FULL_THRUST
        and is_thrust_above_hover(b)
    )
    return (
        strong and b.height_m > MIN_HEIGHT_TO_DETECT_BLOCKED_CLIMB_M and is_vertically_motionless(b)
    )


def _does_imu_show_support(b: Belief) -> bool:
    """True if accelerometer and thrust alone show that something is supporting the vehicle or that
    it is pressing against something.

    The thrust is above or below hover thrust by at least the margin in
    `MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS`, which would accelerate a vehicle in the
    air. Nevertheless, the accelerometer reads 1 g and the vertical speed stays constant.
    """
    tel, perch, hover = b.telemetry, b.profile.planner.perch, b.hover_thrust
    return (
        0 < hover < MAX_HOVER_TO_FULL_THRUST_RATIO_TO_DETECT_PRESS * FULL_THRUST
        and b.is_reported_thrust_reliable
        and (
            is_thrust_above_hover(b)
            or tel.thrust <= (2.0 - MIN_REPORTED_TO_HOVER_THRUST_RATIO_TO_DETECT_PRESS) * hover
        )
        and b.is_accelerometer_reading_one_g
        and b.obs.t_s - b.imu.climb_rate_became_steady_at_s >= perch.contact_dwell_s
    )


def _is_not_climbing_at_full_thrust(b: Belief) -> bool:
    full = b.telemetry.thrust >= MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_SATURATED * FULL_THRUST
    flies = b.command_history.maneuver.is_in_free_air
    return flies and full and b.climb_mps < MAX_CLIMB_RATE_TO_COUNT_AS_MOTIONLESS_MPS


def _is_climbing_slowly_at_nearly_full_thrust(b: Belief) -> bool:
    full = b.telemetry.thrust >= MIN_FULL_THRUST_FRACTION_TO_COUNT_AS_NEARLY_FULL * FULL_THRUST
    flies = b.command_history.maneuver.is_in_free_air
    return flies and full and b.climb_mps < MIN_CLIMB_RATE_EXPECTED_AT_FULL_THRUST_MPS


TARGET_CONTACT = Condition(
    "contact", _is_in_contact_with_target, required_data=RequiredData.POSITION
)
"""Contact with the target, proven by position, acceleration and thrust."""
MAGNET_HOLDS_VEHICLE = Condition(
    "magnet holds", _is_magnet_holding_vehicle, required_data=RequiredData.TELEMETRY
)
"""The magnet is holding the vehicle: the thrust is low, and the vehicle is not slipping."""
SLIPPING_OFF_CONTACT = Condition("slipping", is_slipping_off_contact)
"""The vehicle is falling away from the proven contact."""
HANGING_WITH_MOTORS_STOPPED = Condition(
    "the whole weight hangs", _is_hanging_with_motors_stopped, required_data=RequiredData.TELEMETRY
)
"""The vehicle is hanging with its motors stopped: its support carries the whole weight, and the
vehicle is not slipping."""
HANGING = Condition("hanging", _is_hanging, required_data=RequiredData.POSITION)
"""Something is holding the vehicle up, off the floor."""
MOTORS_OFF_AS_COMMANDED = Condition(
    "motors stopped", _are_motors_off_as_commanded, required_data=RequiredData.TELEMETRY
)
"""The motors are off, and the last command does not make them turn."""
MOTORS_OFF_DESPITE_THRUST_COMMAND = Condition(
    "motors off despite a thrust command",
    _are_motors_off_despite_thrust_command,
    required_data=RequiredData.TELEMETRY,
)
"""The motors are off although the last command was raw thrust: the supervisor has ended the flight.
The supervisor will soon let that command start the motors again (docs/firmware.md,
"Supervisor")."""
ON_FLOOR = Condition("on the floor", _is_on_floor, required_data=RequiredData.POSITION)
"""The vehicle is on the floor."""
CLIMB_BLOCKED = Condition("blocked", _is_pressing_against_obstacle)
"""The vehicle is pressing against an obstacle below its setpoint."""
IMU_SHOWS_SUPPORT = Condition(
    "supported, by accelerometer and thrust",
    _does_imu_show_support,
    persists_across_phases=True,
    required_data=RequiredData.TELEMETRY,
)
"""Something is supporting the vehicle, or it is pressing against something: proven by accelerometer
and thrust alone."""
NOT_CLIMBING_AT_FULL_THRUST = Condition(
    "not climbing at full thrust",
    _is_not_climbing_at_full_thrust,
    persists_across_phases=True,
    required_data=RequiredData.TELEMETRY,
)
"""The thrust is at its limit in free air, and the vehicle is not climbing: it is too weak, or
something is above it."""
SLOW_CLIMB_AT_NEARLY_FULL_THRUST = Condition(
    "slow at nearly full thrust",
    _is_climbing_slowly_at_nearly_full_thrust,
    persists_across_phases=True,
    required_data=RequiredData.TELEMETRY,
)
"""The thrust is nearly at its limit in free air, and the vehicle climbs more slowly than one that
can hover with thrust to spare."""
SUPPORT_CONDITIONS = (
    TARGET_CONTACT,
    MAGNET_HOLDS_VEHICLE,
    SLIPPING_OFF_CONTACT,
    HANGING_WITH_MOTORS_STOPPED,
    HANGING,
    MOTORS_OFF_AS_COMMANDED,
    MOTORS_OFF_DESPITE_THRUST_COMMAND,
    ON_FLOOR,
    CLIMB_BLOCKED,
    IMU_SHOWS_SUPPORT,
    NOT_CLIMBING_AT_FULL_THRUST,
    SLOW_CLIMB_AT_NEARLY_FULL_THRUST,
)
"""All conditions defined in this module."""


class Support(Enum):
    """What supports the vehicle: the air, a surface that it presses against, the target's magnet,
    another object, the floor, or unknown."""

    AIR = "nothing: the vehicle is flying"
    PRESSED_SURFACE = "the target or an obstacle that the vehicle is pressing against"
    MAGNET = "the target's magnet"
    HELD_BY_OTHER_OBJECT = (
        "something away from the target that the vehicle is hanging from or standing on"
    )
    FLOOR = "the floor"
    UNKNOWN = "unknown"


def find_support(b: Belief) -> Support:
    """Return what supports the vehicle. The first condition that is true in this tick decides:

    - `HANGING`: MAGNET if the gear was within the magnet's radius (`perch.contact_xy_m`) at the
      last touch, or certainly is now, at the target's height. HELD_BY_OTHER_OBJECT if the gear is
      certainly outside that radius, or below the target by more than `contact_height_tolerance_m`.
      (The gear cannot be above the target, because the ceiling is there: such an estimate is wrong
      and proves nothing.) UNKNOWN otherwise.
    - `ON_FLOOR`: FLOOR.
    - `TARGET_CONTACT` or `CLIMB_BLOCKED`: PRESSED_SURFACE.
    - None of these: AIR if the vehicle moves as in hover (`is_flying_at_hover_thrust`) and its
      thrust is neither too low to fly nor above hover thrust; UNKNOWN otherwise, for example while
      the vehicle accelerates or its position is unknown.

    If the result is UNKNOWN, a row of the transition table must assume the more dangerous of the
    possible supports.
    """
    if HANGING in b.condition_start_times_s:
        return _find_what_vehicle_hangs_on(b)
    if ON_FLOOR in b.condition_start_times_s:
        return Support.FLOOR
    if TARGET_CONTACT in b.condition_start_times_s or CLIMB_BLOCKED in b.condition_start_times_s:
        return Support.PRESSED_SURFACE
    flies = (
        is_flying_at_hover_thrust(b)
        and not is_thrust_too_low_to_fly(b)
        and not is_thrust_above_hover(b)
    )
    return Support.AIR if flies else Support.UNKNOWN


def _find_what_vehicle_hangs_on(b: Belief) -> Support:
    touched, radius_m = (
        valid_gear_to_target_at_last_contact(b),
        b.profile.planner.perch.contact_xy_m,
    )
    was_near = touched is not None and max(touched.distance_xy_m, touched.sigma_m) <= radius_m
    if was_near or is_gear_certainly_in_magnet_reach(b):
        return Support.MAGNET
    gear_to_target = gear_to_target_at_last_contact_or_now(b)
    is_off_axis = gear_to_target.distance_xy_m - 2.0 * gear_to_target.sigma_m > radius_m
    is_below = touched is None and b.target.gear_to_target_z_m > contact_height_tolerance_m(b)
    return Support.HELD_BY_OTHER_OBJECT if is_off_axis or is_below else Support.UNKNOWN


def is_evidence_fresh(b: Belief, condition: Condition[Belief]) -> bool:
    """True if the data that the condition requires is fresh in this tick.

    Two conditions are accepted without all of the data that they require. With the target as the
    only position source, `TARGET_CONTACT` needs no valid position during a press, because the last
    sighting is accurate enough for a while. During a descent, `HANGING` needs no position and
    accepts telemetry as old as `safety.telemetry_hold_s`. Without the exception for `HANGING`, a
    vehicle hanging on the magnet would keep its motors running while its telemetry is poor. The end
    of the weight transfer that follows (`HANGING_WITH_MOTORS_STOPPED`) still needs fresh telemetry.
    """
    if condition is HANGING and b.command_history.maneuver.descends_to_floor:
        return b.attitude_age_s <= b.profile.safety.telemetry_hold_s
    match condition.required_data:
        case RequiredData.NOTHING:
            return True
        case RequiredData.TELEMETRY:
            return b.is_imu_fresh
        case RequiredData.POSITION:
            reckons = (
                condition is TARGET_CONTACT
                and b.is_target_position_source
                and b.command_history.maneuver.presses_against_target
            )
            return b.is_imu_fresh and (b.is_position_valid or reckons)


def has_slipped_off_contact(b: Belief) -> bool:
    """True if the vehicle has slipped off its contact: `is_slipping_off_contact` has been true for
    `complete.slip_dwell_s`. Once the weight transfer has begun, which reduces raw thrust until the
    support carries the whole weight, one tick is enough in which fresh telemetry shows a specific
    force below `complete.slip_acc_g` and a climb rate below
    `MAX_CLIMB_RATE_TO_DETECT_FALL_IN_WEIGHT_TRANSFER_MPS`."""
    tel, complete = b.telemetry, b.profile.planner.complete
    falls = (
        b.command_history.weight_transfer_began_at_s is not None
        and tel.acc_z_g < complete.slip_acc_g
    )
    if (
        falls
        and b.is_imu_fresh
        and b.climb_mps < MAX_CLIMB_RATE_TO_DETECT_FALL_IN_WEIGHT_TRANSFER_MPS
    ):
        return True
    return b.true_for_s(SLIPPING_OFF_CONTACT) >= complete.slip_dwell_s
