"""Phase 1, APPROACH: take off and climb to the height at which the search begins."""

from __future__ import annotations

from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Phase
from perchctl.mission.setpoints import Action, fly_to, step_setpoint_towards
from perchctl.mission.transition import Transition, land_row
from perchctl.vehicle import PositionSetpoint

MIN_HEIGHT_TO_CORRECT_SETPOINT_HEIGHT_M = 0.1
"""Height below which the vehicle may still be on the ground, m; the height is not corrected there.
Larger: a heavy vehicle stays near the ground for longer. Smaller: a vehicle that is still on the
ground jumps up."""
MIN_TAKEOFF_HEIGHT_FRACTION_FOR_LATERAL_APPROACH = 0.7
"""Fraction of the take-off height above which the vehicle flies to `planner.approach_xy_m`."""
MIN_TAKEOFF_HEIGHT_FRACTION_TO_END_TAKEOFF = 0.8
"""Fraction of the take-off height that counts as reached."""
MAX_SPEED_TO_END_TAKEOFF_MPS = 0.25
"""Largest speed that counts as hovering, m/s."""
TAKEOFF_END_DWELL_S = 0.3
"""Time for which the vehicle must hover to end the take-off, s."""

TAKEOFF_HEIGHT_REACHED = Condition[Context](
    "at take-off height",
    lambda c: (
        c.belief.height_m >= MIN_TAKEOFF_HEIGHT_FRACTION_TO_END_TAKEOFF * c.planner.takeoff_height_m
        and c.belief.speed_mps <= MAX_SPEED_TO_END_TAKEOFF_MPS
        and c.state.setpoint is not None
    ),
)
"""The vehicle hovers near the take-off height."""


def act_in_approach(c: Context) -> Action:
    """Climb to `planner.takeoff_height_m` above the take-off position at
    `planner.takeoff_speed_mps`. Near the end of the climb, also fly sideways to
    `planner.approach_xy_m` if the profile sets it. The command is a position setpoint, so that the
    firmware levels the vehicle out if no more commands arrive."""
    planner, state, b = c.planner, c.state, c.belief
    assert b.takeoff_position_m is not None
    x, y, z = b.takeoff_position_m
    start = state.setpoint or PositionSetpoint(x, y, z, state.entry.vehicle_world_yaw_rad)
    if (
        planner.approach_xy_m is not None
        and b.height_m > MIN_TAKEOFF_HEIGHT_FRACTION_FOR_LATERAL_APPROACH * planner.takeoff_height_m
    ):
        x, y = planner.approach_xy_m
    goal = PositionSetpoint(x, y, z + planner.takeoff_height_m, state.entry.vehicle_world_yaw_rad)
    setpoint = step_setpoint_towards(c, start, goal, max_up_mps=planner.takeoff_speed_mps)
    return fly_to(c, setpoint, corrects_height=b.height_m > MIN_HEIGHT_TO_CORRECT_SETPOINT_HEIGHT_M)


APPROACH = PhaseDefinition(
    phase=Phase.APPROACH,
    maneuver=Maneuver(is_in_free_air=True),
    act=act_in_approach,
    timed_conditions=(TAKEOFF_HEIGHT_REACHED,),
    exits=(
        Transition(
            "approached",
            {Phase.APPROACH},
            lambda c: c.true_for_s(TAKEOFF_HEIGHT_REACHED) >= TAKEOFF_END_DWELL_S,
            Phase.SEARCH,
            "hovering in the perching area",
        ),
        land_row(
            "approach-timeout",
            {Phase.APPROACH},
            lambda c: c.time_in_phase_s > c.planner.approach_timeout_s,
            lambda c: f"the take-off reached only {c.belief.height_m:.2f} m",
        ),
    ),
)
