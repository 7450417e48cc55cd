"""Phase 7, COMPLETE: transfer the weight to the magnet, stop the motors, and monitor the
vehicle."""

from __future__ import annotations

from perchctl.mission.belief.contact import (
    MAGNET_HOLDS_VEHICLE,
    MOTORS_OFF_AS_COMMANDED,
    MOTORS_OFF_DWELL_S,
    gear_to_target_at_last_contact_or_now,
    has_slipped_off_contact,
)
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Outcome, Phase, VehicleDiagnosis
from perchctl.mission.release import (
    reduce_press_before_weight_transfer,
    stop_motors,
    transfer_weight_by_raw_thrust,
)
from perchctl.mission.rest import is_still_hanging
from perchctl.mission.setpoints import Action
from perchctl.mission.state import PlannerState
from perchctl.mission.transition import Transition, back_off_row, land_row
from perchctl.values import replace

MOTOR_STOP_TIMEOUT_AFTER_HANG_MONITORING_S = 10.0
"""Time after the end of the monitoring at which the flight ends even if telemetry still shows
thrust, s."""


def enter_complete(state: PlannerState, previous_context: Context) -> PlannerState:
    """Record where the magnet holds the vehicle: the vehicle's world z in `previous_context`, the
    context before the transition in the same tick, and the lateral distance between gear and target
    at the last touch or, if that is not valid, the present one."""
    belief = replace(
        state.belief,
        vehicle_world_z_at_last_contact_m=previous_context.telemetry.position_m[2],
        gear_to_target_at_last_contact=gear_to_target_at_last_contact_or_now(
            previous_context.belief
        ),
    )
    return replace(state, belief=belief, weight_transfer_began_at_s=None)


def act_in_complete(c: Context) -> Action:
    """Return the state and the command that transfer the weight from the rotors to the magnet and
    then stop the motors. The press is reduced until the measurements have shown for
    `complete.hold_dwell_s` that the magnet holds the vehicle
    (`reduce_press_before_weight_transfer`). Then raw thrust is reduced until the magnet carries the
    whole weight and a motor stop is commanded (`transfer_weight_by_raw_thrust`). After that,
    `stop_motors` repeats the stop command."""
    if c.state.motor_stop_commanded_at_s is not None:
        return stop_motors(c)
    holds = c.true_for_s(MAGNET_HOLDS_VEHICLE) >= c.planner.complete.hold_dwell_s
    return (
        transfer_weight_by_raw_thrust(c)
        if holds or c.state.weight_transfer_began_at_s is not None
        else reduce_press_before_weight_transfer(c)
    )


def time_since_motor_stop_command_s(c: Context) -> float:
    """Seconds since the first command to stop the motors; -1 before it."""
    return (
        -1.0
        if c.state.motor_stop_commanded_at_s is None
        else c.t_s - c.state.motor_stop_commanded_at_s
    )


def is_hang_monitoring_over(c: Context) -> bool:
    """True if `complete.watch_s` has passed since the first command to stop the motors, and the
    motors have been off for `MOTORS_OFF_DWELL_S`."""
    return (
        time_since_motor_stop_command_s(c) >= c.planner.complete.watch_s
        and c.true_for_s(MOTORS_OFF_AS_COMMANDED) >= MOTORS_OFF_DWELL_S
    )


COMPLETE = PhaseDefinition(
    phase=Phase.COMPLETE,
    maneuver=Maneuver(),
    enter=enter_complete,
    act=act_in_complete,
    exits=(
        back_off_row(
            "slipped",
            {Phase.COMPLETE},
            lambda c: has_slipped_off_contact(c.belief),
            lambda c: (
                "slipped while hanging"
                if c.state.motor_stop_commanded_at_s
                else "the magnet does not hold"
            ),
            diagnosis=VehicleDiagnosis.SLIPPED_OFF_CONTACT,
        ),
        back_off_row(
            "not-released",
            {Phase.COMPLETE},
            lambda c: (
                c.state.motor_stop_commanded_at_s is None
                and c.time_in_phase_s > c.planner.complete.release_timeout_s
            ),
            "the release was not completed in time",
            diagnosis=VehicleDiagnosis.STILL_AT_PROVEN_CONTACT,
        ),
        Transition(
            "perched",
            {Phase.COMPLETE},
            lambda c: is_hang_monitoring_over(c) and is_still_hanging(c),
            Phase.PERCHED,
            "hanging still with the motors off",
            outcome=Outcome.PERCHED,
        ),
        land_row(
            "fell-unseen",
            {Phase.COMPLETE},
            is_hang_monitoring_over,
            "it is unknown whether the vehicle is still hanging",
        ),
        land_row(
            "not-stopped",
            {Phase.COMPLETE},
            lambda c: (
                time_since_motor_stop_command_s(c)
                > c.planner.complete.watch_s + MOTOR_STOP_TIMEOUT_AFTER_HANG_MONITORING_S
            ),
            lambda c: (
                f"motors stopped, but telemetry still reports a thrust of {c.telemetry.thrust:.0f}"
            ),
        ),
    ),
)
