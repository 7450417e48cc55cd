"""Update the planner's memory with an observation, before any decision."""

from __future__ import annotations

from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.belief.update import has_tick_gap, update_belief
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Phase
from perchctl.mission.release import FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_OFF_M
from perchctl.mission.state import PlannerState
from perchctl.profile import Profile
from perchctl.values import replace


def update_state_with_observation(
    state: PlannerState, obs: Observation, profile: Profile, maneuver: Maneuver
) -> PlannerState:
    """Return the planner's state with its belief updated by the observation `obs`; no decision is
    made. `maneuver` is the one that the vehicle is flying.

    After a gap without ticks, the conditions of the phase must last for their whole time again, and
    if a falling vehicle was being caught, the catch ends and its setpoint is deleted. After a jump
    of the estimated position, the positions that the state remembers are shifted by the same
    amount.
    """
    if has_tick_gap(state.belief, obs, profile):
        # The setpoint of a catch is far above the vehicle; keeping it would make the vehicle press
        # against the ceiling.
        setpoint = state.setpoint if state.fall_catch_setpoint_above_vehicle_m is None else None
        state = replace(
            state,
            condition_start_times_s={},
            fall_catch_setpoint_above_vehicle_m=None,
            setpoint=setpoint,
        )
    known = state.belief.last_telemetry is not None
    belief = update_belief(state.belief, obs, state.command_history(maneuver), profile)
    state = replace(state, belief=belief)
    return _apply_world_frame_shift(state) if obs.has_estimated_position_jumped and known else state


def _apply_world_frame_shift(state: PlannerState) -> PlannerState:
    """Return the state after a jump of the estimated position, which shifts the world frame: the
    setpoint, the position at the start of the phase, and the height of an obstacle are shifted by
    the same amount. The belief in `state` must have been shifted already.

    The firmware's own landing follows a trajectory in the old frame. If one is in progress with its
    motors running, it is forgotten: position control first catches the vehicle, and then the
    landing is commanded again.
    """
    b, vehicle_world_z_when_blocked_m = state.belief, state.vehicle_world_z_when_blocked_m
    if (
        state.phase is Phase.LANDING
        and state.stop_or_land_command_count
        and b.telemetry.thrust >= 1
    ):
        state = replace(
            state,
            entry=replace(state.entry, t_s=b.obs.t_s),
            stop_or_land_command_count=0,
            last_stop_or_land_command_at_s=None,
            fall_catch_setpoint_above_vehicle_m=FALL_CATCH_SETPOINT_ABOVE_VEHICLE_WITH_MOTORS_OFF_M,
        )
    return replace(
        state,
        setpoint=b.command_history.setpoint,
        entry=replace(
            state.entry, vehicle_world_position_m=b.command_history.maneuver_start_position_m
        ),
        vehicle_world_z_when_blocked_m=None
        if vehicle_world_z_when_blocked_m is None
        else vehicle_world_z_when_blocked_m + b.world_frame_shift_in_tick_m[2],
    )
