"""The planner's memory with one more observation taken in, before anything is decided on it."""

from __future__ import annotations

from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.belief.update import has_gap, update_belief
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Phase
from perchctl.mission.release import CATCH_STILL_ABOVE_M
from perchctl.mission.state import PlannerState
from perchctl.profile import Profile
from perchctl.values import replace


def observe(
    state: PlannerState, obs: Observation, profile: Profile, maneuver: Maneuver
) -> PlannerState:
    """The state with its belief updated in `maneuver`. After a time in which nothing was decided a
    catch is over; where the estimate has jumped, the places that were decided on move with it."""
    if has_gap(state.belief, obs, profile):
        # With a catch its setpoint far above is over: held, it would press.
        setpoint = state.setpoint if state.catch_above_m is None else None
        state = replace(state, since={}, catch_above_m=None, setpoint=setpoint)
    known = state.belief.last is not None
    belief = update_belief(state.belief, obs, state.sent(maneuver), profile)
    state = replace(state, belief=belief)
    return _moved_with_estimate(state) if obs.jumped and known else state


def _moved_with_estimate(state: PlannerState) -> PlannerState:
    """The state after a jump. The vehicle's own landing follows a trajectory in the old world: it
    is caught, and ordered anew."""
    b, blocked_z_m = state.belief, state.blocked_z_m
    if state.phase is Phase.LANDING and state.orders and b.telemetry.thrust >= 1:
        state = replace(
            state,
            entry=replace(state.entry, t_s=b.obs.t_s),
            orders=0,
            ordered_s=None,
            catch_above_m=CATCH_STILL_ABOVE_M,
        )
    return replace(
        state,
        setpoint=b.sent.setpoint,
        entry=replace(state.entry, position_m=b.sent.began_m),
        blocked_z_m=None if blocked_z_m is None else blocked_z_m + b.shift_m[2],
    )
