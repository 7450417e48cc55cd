"""RECOVER: after a failed attempt, leave the contact and hold below it until steady."""

from __future__ import annotations

import math

from perchctl.mission.belief.belief import GearToTargetDistance
from perchctl.mission.belief.contact import (
    IMU_SHOWS_SUPPORT,
    TARGET_CONTACT,
    current_gear_to_target,
    is_at_contact_height,
)
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Outcome, Phase, VehicleDiagnosis
from perchctl.mission.release import (
    catch_falling_vehicle,
    choose_fall_catch_setpoint_above_vehicle_m,
    end_press,
    forget_contact_when_below,
)
from perchctl.mission.setpoints import (
    Action,
    fly_to,
    make_setpoint_at_vehicle,
    step_setpoint_towards,
    vehicle_world_xy_with_gear_under_target_m,
)
from perchctl.mission.state import PlannerState
from perchctl.mission.transition import Transition, land_row
from perchctl.values import replace
from perchctl.vehicle import PositionSetpoint

MIN_THRUST_TO_HOVER_RATIO_TO_SKIP_FALL_CATCH = 0.85
"""Fraction of the hover thrust above which a slipping vehicle is sinking so slowly that it needs no
catch."""
MIN_DESCENT_TO_COUNT_AS_DETACHED_M = 0.05
"""Distance below the contact beyond which the vehicle has left it, m; at most half of the descent
is used."""
MAX_SIGHTING_AGE_TO_FOLLOW_TARGET_S = 3.0
"""Largest age of a sighting at which the vehicle still follows the target, s."""
RECOVERY_DURATION_AFTER_LAST_ATTEMPT_S = 0.5
"""Time for which the vehicle recovers before the last failed attempt ends the flight, s."""
UNLIMITED_SETPOINT_SINK_RATE_MPS = 10.0
"""Downward speed of the setpoint, m/s: so high that the setpoint reaches its goal at once."""

STEADY_AFTER_ATTEMPT = Condition[Context](
    "steady", lambda c: c.belief.speed_mps <= c.planner.recover.steady_mps
)
"""The vehicle is slower than `recover.steady_mps`."""


def enter_recover(state: PlannerState, previous_context: Context) -> PlannerState:
    """Return the state at the start of RECOVER. It records the horizontal distance between gear and
    target at the last touch, the vehicle's world z at a contact or obstacle, and, if the vehicle
    has slipped off its contact with too little thrust to carry most of its weight, how far above
    the vehicle a setpoint must be to catch it. The measurements are those of `previous_context`,
    the context before the transition in the same tick."""
    old, b, diagnosis = previous_context.state, previous_context.belief, state.entry.diagnosis
    z_m, thrust = b.telemetry.position_m[2], b.telemetry.thrust
    touched = old.phase is Phase.PERCH or VehicleDiagnosis.BLOCKED_BY_OBSTACLE in diagnosis
    # A vehicle whose motors carry most of its weight hardly falls.
    falls = (
        VehicleDiagnosis.SLIPPED_OFF_CONTACT in diagnosis
        and thrust < MIN_THRUST_TO_HOVER_RATIO_TO_SKIP_FALL_CATCH * b.hover_thrust
    )
    belief = replace(
        state.belief,
        gear_to_target_at_last_contact=_find_gear_to_target_at_touch(previous_context, diagnosis),
        # The vehicle counts as within the magnet's reach until its position is below this contact.
        vehicle_world_z_at_last_contact_m=z_m if touched else b.vehicle_world_z_at_last_contact_m,
    )
    return replace(
        state,
        belief=belief,
        motor_stop_commanded_at_s=None,
        weight_transfer_began_at_s=None,
        fall_catch_setpoint_above_vehicle_m=choose_fall_catch_setpoint_above_vehicle_m(
            b.hover_thrust, thrust
        )
        if falls
        else None,
        vehicle_world_z_when_blocked_m=z_m
        if VehicleDiagnosis.BLOCKED_BY_OBSTACLE in diagnosis
        else old.vehicle_world_z_when_blocked_m,
    )


def _find_gear_to_target_at_touch(
    previous_context: Context, diagnosis: VehicleDiagnosis
) -> GearToTargetDistance | None:
    """Return the horizontal distance between gear and target at the touch that ended the attempt;
    None if no touch is known. `previous_context` is the context before the transition into RECOVER,
    in the same tick, and `diagnosis` is what the transition asserts.

    If the vehicle has not left its contact since an earlier touch, the distance recorded at that
    touch is returned. Otherwise, only a press in PERCH at the target's height counts as a touch,
    and only if the contact was proven or accelerometer and thrust showed support; the distance is
    then the present one.
    """
    old, b = previous_context.state, previous_context.belief
    # the contact was proven, and the vehicle has not come off
    if VehicleDiagnosis.STILL_AT_PROVEN_CONTACT in diagnosis:
        return b.gear_to_target_at_last_contact
    if old.phase is Phase.RECOVER:  # pressed again before it left the contact
        return (
            b.gear_to_target_at_last_contact
            if b.vehicle_world_z_at_last_contact_m is not None
            else None
        )
    proven = b.true_for_s(TARGET_CONTACT) >= previous_context.planner.perch.contact_dwell_s
    # the predicate of `IMU_SHOWS_SUPPORT` already requires this dwell time
    carried = proven or b.true_for_s(IMU_SHOWS_SUPPORT) >= 0.0
    if old.phase is Phase.PERCH and carried and is_at_contact_height(b):
        return current_gear_to_target(b)
    return None


def act_in_recover(c: Context) -> Action:
    """Command position setpoints throughout: first to catch a falling vehicle, then to end a press,
    and then to hold `recover.descend_m` below the position where the attempt ended or, after a
    catch, where the fall stopped. If the target was seen in the last
    `MAX_SIGHTING_AGE_TO_FOLLOW_TARGET_S`, the vehicle holds that height below the target."""
    if (caught := catch_falling_vehicle(c)) is not None:
        return caught
    recover = c.planner.recover
    least_m = min(MIN_DESCENT_TO_COUNT_AS_DETACHED_M, 0.5 * recover.descend_m)
    # During a contact that lasts several seconds, the estimate may drift downwards by this much. In
    # this phase, the vehicle itself must have descended.
    if c.state.entry.vehicle_world_position_m[2] - c.telemetry.position_m[2] >= least_m:
        c = Context(forget_contact_when_below(c.state, least_m))
    state, away = end_press(c)
    if away is not None:
        return state, away
    if state.fall_catch_setpoint_above_vehicle_m is not None:
        x, y, z = c.telemetry.position_m  # position where the fall has stopped
        entry = replace(state.entry, vehicle_world_position_m=(x, y, z + recover.descend_m))
        state = replace(state, fall_catch_setpoint_above_vehicle_m=None, setpoint=None, entry=entry)
    z = state.entry.vehicle_world_position_m[2] - recover.descend_m
    setpoint = state.setpoint or make_setpoint_at_vehicle(c)
    if setpoint.z_m > z:
        setpoint = replace(setpoint, z_m=z)
    target = c.belief.target
    if target.world_position_m is not None and target.age_s < MAX_SIGHTING_AGE_TO_FOLLOW_TARGET_S:
        x, y = vehicle_world_xy_with_gear_under_target_m(c, setpoint.yaw_rad)
        goal = PositionSetpoint(x, y, z, setpoint.yaw_rad)
    else:
        goal = replace(setpoint, z_m=z)
    c = Context(replace(state, setpoint=setpoint))
    return fly_to(
        c, step_setpoint_towards(c, setpoint, goal, max_down_mps=UNLIMITED_SETPOINT_SINK_RATE_MPS)
    )


def has_recovered(c: Context) -> bool:
    """True if the vehicle has been slower than `recover.steady_mps` for `recover.dwell_s` and is
    away from its contact."""
    dwell_s = c.planner.recover.dwell_s
    steady = c.true_for_s(STEADY_AFTER_ATTEMPT) >= dwell_s and c.time_in_phase_s >= dwell_s
    return steady and c.belief.vehicle_world_z_at_last_contact_m is None


def unsteady_reason(c: Context) -> str:
    """Return a message that says that the vehicle is not steady `recover.timeout_s` after an
    attempt. It lists the speed, the horizontal distance from the setpoint and a contact that the
    vehicle has not left, each only if known, and gives no causes. It is the reason to land at that
    timeout."""
    b, setpoint = c.belief, c.state.setpoint
    seen = [f"moving at {b.speed_mps:.2f} m/s"] if math.isfinite(b.speed_mps) else []
    if b.is_position_valid and setpoint is not None:
        x_m, y_m, _ = c.telemetry.position_m
        lateral_offset_m = math.hypot(x_m - setpoint.x_m, y_m - setpoint.y_m)
        seen.append(f"{lateral_offset_m:.2f} m from its setpoint")
    if b.vehicle_world_z_at_last_contact_m is not None:
        seen.append("still at its contact")
    text = f"not steady {c.planner.recover.timeout_s:g} s after the attempt"
    return f"{text}: {', '.join(seen)}" if seen else text


RECOVER = PhaseDefinition(
    phase=Phase.RECOVER,
    maneuver=Maneuver(is_in_free_air=True, is_camera_guided=True, retreats_after_attempt=True),
    enter=enter_recover,
    act=act_in_recover,
    timed_conditions=(STEADY_AFTER_ATTEMPT,),
    exits=(
        land_row(
            "attempts-used",
            {Phase.RECOVER},
            lambda c: (
                c.state.failed_attempts >= c.planner.attempts
                and c.time_in_phase_s > RECOVERY_DURATION_AFTER_LAST_ATTEMPT_S
            ),
            lambda c: (
                "all perching attempts are used up"
                if c.planner.hover is None
                else "all attempts to hover are used up"
            ),
            Outcome.ATTEMPTS_USED_UP,
        ),
        Transition(
            "recovered",
            {Phase.RECOVER},
            has_recovered,
            Phase.ESTIMATE,
            "steady again: starting another attempt",
        ),
        land_row(
            "recover-timeout",
            {Phase.RECOVER},
            lambda c: c.time_in_phase_s > c.planner.recover.timeout_s,
            unsteady_reason,
        ),
    ),
)
