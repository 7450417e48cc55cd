"""Determine the rest state of a vehicle with its motors off: on the magnet, on the floor, or
unknown."""

from __future__ import annotations

import math
from enum import Enum

from perchctl.mission.belief.contact import contact_height_tolerance_m
from perchctl.mission.belief.target import MIN_GEAR_TO_TARGET_Z_TO_EXCLUDE_HANGING_M
from perchctl.mission.context import Context
from perchctl.mission.phase import Phase, VehicleDiagnosis

MAX_DISTANCE_BELOW_CONTACT_TO_COUNT_AS_HANGING_M = 0.3
"""Largest distance below its contact at which a vehicle counts as still hanging, m; allows for
drift of the estimate."""
MIN_HEIGHT_TO_INFER_HANGING_M = 0.45
"""Height above which hanging can be distinguished from standing on the floor, m; it is compared
with the height at the start of a descent or with the present height."""
MAX_HEIGHT_TO_COUNT_AS_ON_FLOOR_M = 0.3
"""Height up to which a vehicle with its motors off counts as being on the floor, m."""
MAX_HEIGHT_LOSS_TO_COUNT_AS_STILL_HANGING_WITH_MOTORS_OFF_M = 0.15
"""Height loss below which a vehicle counts as still hanging where the descent began, m. Larger: a
vehicle on a table seems to hang. Smaller: with a drifting estimate, a hanging vehicle seems to have
come off."""


class RestState(Enum):
    """Where a vehicle with its motors off rests: hanging on the target's magnet (`HANGS`), held by
    another object (`HELD`), on the floor (`STANDS`), or either hanging or on the floor (`UNKNOWN`).
    `END_UNCONFIRMED` means that telemetry did not confirm that the flight has ended, so the motors
    may still be running. Each value is a phrase without a full stop."""

    HANGS = "the vehicle is hanging on the magnet with its motors off"
    HELD = "something holds the vehicle in place, away from the target; the motors are off"
    STANDS = "the vehicle is on the floor with its motors off"
    UNKNOWN = "the motors are off; it is unknown whether the vehicle is hanging or on the floor"
    END_UNCONFIRMED = "the end of the flight could not be confirmed: keep away from the vehicle"


def find_rest_state(c: Context) -> RestState:
    """Return where the vehicle rests; only valid once the motors are off. The first case that
    applies decides:

    - An object other than the target holds the vehicle during a landing: HELD.
    - No deck or motion capture gives a valid position, or the vehicle has been restarted: STANDS if
      a tracked target is too far above to hold it; otherwise, the falls that the accelerometer has
      measured decide (`_find_rest_state_from_measured_falls`). After a restart, the position
      estimate starts again at the origin, so earlier positions and sightings are not used.
    - All other cases: HANGS if the target is not known to be too far above to hold the vehicle, and
      the height shows that it has not come down. This is so if it has lost less than
      `MAX_HEIGHT_LOSS_TO_COUNT_AS_STILL_HANGING_WITH_MOTORS_OFF_M` of height in the present phase,
      which began more than `MIN_HEIGHT_TO_INFER_HANGING_M` above the ground, or if a contact is
      recorded and it is more than `MAX_HEIGHT_TO_COUNT_AS_ON_FLOOR_M` above the ground. STANDS
      otherwise.
    """
    b, state = c.belief, c.state
    if _is_held_by_other_object(c):
        return RestState.HELD
    restarted_at_s = b.imu.vehicle_restarted_at_s
    if b.is_target_position_source or not b.is_position_valid or restarted_at_s > -math.inf:
        is_seen = b.target.is_tracked and b.dead_reckoning.last_sighting_at_s >= restarted_at_s
        if is_seen and b.target.is_too_far_above_to_hold_vehicle:
            return RestState.STANDS
        return _find_rest_state_from_measured_falls(c)
    high = state.entry.vehicle_world_position_m[2] - b.ground_z_m > MIN_HEIGHT_TO_INFER_HANGING_M
    came_down_m = state.entry.vehicle_world_position_m[2] - b.telemetry.position_m[2]
    stayed = (
        high
        and not b.target.is_too_far_above_to_hold_vehicle
        and came_down_m < MAX_HEIGHT_LOSS_TO_COUNT_AS_STILL_HANGING_WITH_MOTORS_OFF_M
    )
    at_contact = (
        b.vehicle_world_z_at_last_contact_m is not None
        and not b.target.is_too_far_above_to_hold_vehicle
    )
    if stayed or (b.height_m > MAX_HEIGHT_TO_COUNT_AS_ON_FLOOR_M and at_contact):
        return RestState.HANGS
    return RestState.STANDS


def _is_held_by_other_object(c: Context) -> bool:
    b, state = c.belief, c.state
    if state.phase is not Phase.LANDING:
        return False
    if (
        b.is_position_valid
        and state.entry.vehicle_world_position_m[2] - b.telemetry.position_m[2]
        >= MAX_HEIGHT_LOSS_TO_COUNT_AS_STILL_HANGING_WITH_MOTORS_OFF_M
    ):
        return False
    if VehicleDiagnosis.HELD_BY_OTHER_OBJECT in state.entry.diagnosis:
        return b.imu.last_fall_at_s <= state.entry.t_s
    below = (
        contact_height_tolerance_m(b)
        < b.target.gear_to_target_z_m
        <= MIN_GEAR_TO_TARGET_Z_TO_EXCLUDE_HANGING_M
        and b.gear_to_target_at_last_contact is None
    )
    by_position = (
        b.is_position_valid
        and not b.is_target_position_source
        and b.first_estimate_jump_at_s is None
        and b.height_m > MIN_HEIGHT_TO_INFER_HANGING_M
    )
    return below and (b.target.is_fresh or by_position)


def _find_rest_state_from_measured_falls(c: Context) -> RestState:
    """Return the rest state from the falls that the accelerometer has measured: HANGS if the
    vehicle has come within the magnet's reach and has neither fallen nor reached the floor since,
    otherwise STANDS. Return UNKNOWN instead if a gap in the telemetry may hide an event that makes
    this wrong: for HANGS a fall, and for STANDS a catch by the magnet."""
    b, dead_reckoning, since_s = (
        c.belief,
        c.belief.dead_reckoning,
        c.belief.magnet_reach_entered_at_s,
    )
    floor_s = c.state.descent.floor_detected_at_s
    down_s = max(b.imu.last_fall_at_s, -math.inf if floor_s is None else floor_s)
    # a sighting resolves the doubt
    unsure = dead_reckoning.last_telemetry_gap_in_magnet_reach_ended_at_s > max(
        down_s, dead_reckoning.last_sighting_at_s
    )
    if since_s is None or down_s > since_s:
        return RestState.UNKNOWN if unsure else RestState.STANDS
    came_unheard = (
        unsure and dead_reckoning.last_telemetry_gap_in_magnet_reach_ended_at_s <= since_s
    )
    return (
        RestState.UNKNOWN
        if came_unheard or b.imu.last_gap_that_may_hide_fall_ended_at_s > since_s
        else RestState.HANGS
    )


def is_still_hanging(c: Context) -> bool:
    """True if the height or the accelerometer shows that the vehicle is still hanging.

    The height shows it if a deck or motion capture gives a valid position, a contact is recorded,
    and the vehicle is at most `MAX_DISTANCE_BELOW_CONTACT_TO_COUNT_AS_HANGING_M` below that contact
    and not sinking faster than `complete.slip_mps`. The accelerometer shows it if it has measured
    no fall since the vehicle came within the magnet's reach, and no gap in the telemetry can hide
    one (`_find_rest_state_from_measured_falls`).
    """
    b, tel = c.belief, c.telemetry
    if (
        not b.is_target_position_source
        and b.is_position_valid
        and b.vehicle_world_z_at_last_contact_m is not None
    ):
        falls = tel.velocity_mps[2] < -c.planner.complete.slip_mps
        if (
            not falls
            and b.vehicle_world_z_at_last_contact_m - tel.position_m[2]
            <= MAX_DISTANCE_BELOW_CONTACT_TO_COUNT_AS_HANGING_M
        ):
            return True
    return _find_rest_state_from_measured_falls(c) is RestState.HANGS


def is_hanging_with_motors_off(c: Context) -> bool:
    """True if a motor stop has been commanded and the vehicle is still hanging
    (`is_still_hanging`). False if a landing found the motors already off and has sent no stop
    command of its own."""
    motor_stop_commanded_at_s, landing = (
        c.state.motor_stop_commanded_at_s,
        c.state.phase is Phase.LANDING,
    )
    if motor_stop_commanded_at_s is None or (
        landing
        and motor_stop_commanded_at_s >= c.state.entry.t_s
        and c.state.stop_or_land_command_count == 0
    ):
        return False
    return is_still_hanging(c)
