"""The perching planner: `step_mission(state, observation, profile) -> (state, command)`.

The planner is pure: it uses no clock and no input other than its arguments, so replaying a log
yields identical commands. One tick:

    observation ──> belief ──> decision (table) ──> action (phase) ──> command

Each command is chosen as if it were the last packet to arrive. If nothing follows a position
setpoint, the firmware levels the vehicle after 0.5 s and cuts the motors after 2 s
(docs/firmware.md, "When setpoints stop").
"""

from __future__ import annotations

from perchctl.mission.belief.contact import is_pressing_against_surface
from perchctl.mission.belief.evidence import update_condition_start_times
from perchctl.mission.belief.quality import hold_reason
from perchctl.mission.belief.update import reset_phase_dependent_conditions
from perchctl.mission.context import Context
from perchctl.mission.descent import record_command
from perchctl.mission.endurance import compute_battery_outlook
from perchctl.mission.observation import Observation
from perchctl.mission.observe import update_state_with_observation
from perchctl.mission.phase import Phase, Severity
from perchctl.mission.phases.approach import MIN_HEIGHT_TO_CORRECT_SETPOINT_HEIGHT_M
from perchctl.mission.phases.hover import is_hovering
from perchctl.mission.setpoints import Action, fly_to, lower_held_setpoint
from perchctl.mission.state import PhaseEntry, PlannerState
from perchctl.mission.table import (
    PHASE_TIMED_CONDITIONS,
    PHASES,
    TABLE,
    find_first_matching_transition,
)
from perchctl.mission.transition import Transition
from perchctl.profile import HoverConfig, Profile
from perchctl.values import replace
from perchctl.vehicle import Command


def step_mission(
    state: PlannerState | None,
    obs: Observation,
    profile: Profile,
    table: tuple[Transition, ...] = TABLE,
) -> tuple[PlannerState, Command]:
    """Fly one tick of the mission: update the belief with the observation, enter the phase to which
    a row of `table` leads, if one applies (`find_first_matching_transition`), and return the new
    state with the command of the resulting phase. `state` is None in the first tick, on the
    ground."""
    state = _update_before_decision(
        state or PlannerState.initial_on_ground(obs, profile), obs, profile
    )
    c = Context(state)
    row = find_first_matching_transition(c, table)
    if row is None:
        state = replace(state, wait_in_phase_reason="")
    elif row.keeps_mission_in(state.phase):
        total_wait_in_phase_s = state.total_wait_in_phase_s + obs.t_s - state.t_s
        state = replace(
            state,
            wait_in_phase_reason=row.reason_text(c),
            total_wait_in_phase_s=total_wait_in_phase_s,
        )
    else:
        state = _enter_phase(c, row)
        hold = hold_reason(state.belief, PHASES[state.phase].maneuver)
        state = replace(state, hold_reason=hold)
    return record_command(*act_in_phase(Context(state)))


def _update_before_decision(
    state: PlannerState, obs: Observation, profile: Profile
) -> PlannerState:
    """Return the state updated with the observation, before a transition is chosen: the belief, the
    number of successive frames that measured the target, the errors of a hover, the start times of
    the phases' conditions, the reason for a hold, and the battery outlook."""
    maneuver = PHASES[state.phase].maneuver
    state = update_state_with_observation(state, obs, profile, maneuver)
    consecutive_target_frames, target = state.consecutive_target_frames, obs.target
    if obs.has_new_frame:
        measured = (
            target is not None and target.is_measured_in_newest_frame and target.world_m is not None
        )
        consecutive_target_frames = consecutive_target_frames + 1 if measured else 0
        if measured and is_hovering(state):
            state = _add_target_error_to_hover_statistics(state, obs, profile)
    hold = hold_reason(state.belief, maneuver)
    condition_start_times_s = update_condition_start_times(
        state.condition_start_times_s, PHASE_TIMED_CONDITIONS, Context(state), obs.t_s
    )
    state = replace(
        state,
        consecutive_target_frames=consecutive_target_frames,
        hold_reason=hold,
        condition_start_times_s={} if hold else condition_start_times_s,
    )
    return replace(state, battery=compute_battery_outlook(Context(state)))


def _add_target_error_to_hover_statistics(
    state: PlannerState, obs: Observation, profile: Profile
) -> PlannerState:
    """Return the state with one more frame counted in `state.hover_errors`: the vector from the
    gear to the hover position in the level frame, m, and the target's heading relative to the
    vehicle's, rad. `obs` must have a target estimate."""
    target, below_m = obs.target, (profile.planner.hover or HoverConfig()).below_m
    assert target is not None
    x_m, y_m, z_m = (float(each) for each in target.e_m)
    e_m = x_m, y_m, z_m - below_m
    errors = state.hover_errors.with_error(obs.t_s, e_m, target.e_yaw_rad)
    return replace(state, hover_errors=errors)


def _enter_phase(c: Context, row: Transition) -> PlannerState:
    """Return the state after the transition `row` into its phase `row.to`, prepared by that phase's
    `enter` function. A transition of severity `BACK_OFF` counts as a failed attempt."""
    state = c.state
    # A commanded press has wound up the integrators, whatever the reported thrust. A vehicle whose
    # fall is being caught runs at full thrust without pressing.
    ends = row.to in (Phase.RECOVER, Phase.LANDING)
    presses_against_target = state.phase is Phase.PERCH or is_pressing_against_surface(c.belief)
    new = replace(
        state,
        belief=reset_phase_dependent_conditions(c.belief),
        phase=row.to,
        entry=PhaseEntry(
            t_s=c.t_s,
            vehicle_world_position_m=c.telemetry.position_m,
            vehicle_world_yaw_rad=c.telemetry.yaw_rad,
            transition_name=row.name,
            reason=row.reason_text(c),
            diagnosis=row.diagnosis,
            stop_command=row.stop_command,
        ),
        severity=state.severity.escalate(row.severity),
        outcome=row.outcome_after_transition(state.outcome),
        condition_start_times_s={},
        failed_attempts=state.failed_attempts + int(row.severity is Severity.BACK_OFF),
        wait_in_phase_reason="",
        total_wait_in_phase_s=0.0,
        search_step_began_at_s=c.t_s,
        consecutive_target_frames=0,
        must_end_press=ends
        and state.fall_catch_setpoint_above_vehicle_m is None
        and presses_against_target,
        last_stop_or_land_command_at_s=None,
        stop_or_land_command_count=0,
    )
    return PHASES[row.to].enter(new, c)


def act_in_phase(c: Context) -> Action:
    """Return the new planner state and the command of this tick, from the `act` function of the
    present phase. During a hold, the command keeps the setpoint instead, unless RECOVER is catching
    a fall or ending a press."""
    state = c.state
    # A fall is caught and a press ended even during a hold, since the setpoint is above the
    # vehicle.
    leaves = state.phase is Phase.RECOVER and (
        state.must_end_press or state.fall_catch_setpoint_above_vehicle_m is not None
    )
    if state.hold_reason and state.setpoint is not None and not leaves:
        corrects_height = (
            state.phase is not Phase.APPROACH
            or c.belief.height_m > MIN_HEIGHT_TO_CORRECT_SETPOINT_HEIGHT_M
        )
        return fly_to(c, lower_held_setpoint(c, state.setpoint), corrects_height=corrects_height)
    return PHASES[state.phase].act(c)
