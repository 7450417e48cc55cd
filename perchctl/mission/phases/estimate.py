"""Phase 3, ESTIMATE: hold the position and observe until the target's pose has settled."""

from __future__ import annotations

from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Phase, Severity
from perchctl.mission.setpoints import Action, fly_to, make_setpoint_at_vehicle
from perchctl.mission.transition import Transition

TARGET_UNTRACKED_TIMEOUT_TO_RESTART_SEARCH_S = 1.0
"""Time without the target after which the search restarts, s."""

TARGET_UNTRACKED = Condition[Context]("untracked", lambda c: not c.belief.target.is_tracked)
"""The target is not tracked."""
TARGET_POSITION_STEADY = Condition[Context](
    "estimated",
    lambda c: (
        c.belief.target.is_fresh
        and c.belief.recent_max_target_world_shift_between_pictures_m <= c.planner.estimate.spread_m
    ),
)
"""The target is fresh, and its position is steady within `estimate.spread_m`."""


def act_in_estimate(c: Context) -> Action:
    """Hold the setpoint, or the vehicle's position if there is none, while several frames confirm
    the target's position."""
    return fly_to(c, c.state.setpoint or make_setpoint_at_vehicle(c))


ESTIMATE = PhaseDefinition(
    phase=Phase.ESTIMATE,
    maneuver=Maneuver(
        is_in_free_air=True, is_camera_guided=True, requires_pictures=True, learns_hover_thrust=True
    ),
    act=act_in_estimate,
    timed_conditions=(TARGET_UNTRACKED, TARGET_POSITION_STEADY),
    exits=(
        Transition(
            "estimate-lost",
            {Phase.ESTIMATE},
            lambda c: (
                c.true_for_s(TARGET_UNTRACKED) > TARGET_UNTRACKED_TIMEOUT_TO_RESTART_SEARCH_S
                or c.time_in_phase_s > c.planner.estimate.timeout_s
            ),
            Phase.SEARCH,
            "target lost, or its pose did not settle",
            Severity.HOLD,
        ),
        Transition(
            "estimated",
            {Phase.ESTIMATE},
            lambda c: c.true_for_s(TARGET_POSITION_STEADY) >= c.planner.estimate.dwell_s,
            Phase.ALIGN,
            "pose is steady",
        ),
    ),
)
