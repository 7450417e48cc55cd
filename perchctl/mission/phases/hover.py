"""HOVER: hold below the target for a time, then land; the mission of `perchctl hover`.

Up to ASCEND, the mission is the same as for a perch, but ASCEND ends at the hover position instead
of the stand-off. HOVER itself never climbs. A vehicle that sinks below its hover position, for
example because the estimated height drifts, climbs back in ASCEND; the hover timer continues if
that takes at most `MAX_HEIGHT_RETURN_DURATION_TO_KEEP_HOVER_TIMER_S`. A vehicle that leaves its
hover position returns to ALIGN, and the timer restarts. In a completed hover, the vehicle has
therefore kept its position for the whole time, apart from such climbs.
"""

from __future__ import annotations

from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Outcome, Phase, Severity, VehicleDiagnosis
from perchctl.mission.phases.ascend import (
    ascent_cone_radius_at_gear_m,
    is_returning_to_hover_height,
    is_target_lost,
)
from perchctl.mission.setpoints import Action, fly_under_target, make_setpoint_at_vehicle
from perchctl.mission.state import HoverErrorAccumulator, PlannerState
from perchctl.mission.transition import Transition, back_off_row, land_row
from perchctl.profile import HoverConfig
from perchctl.values import replace

MAX_SETPOINT_ABOVE_HOVER_HEIGHT_M = 0.02
"""Height of the setpoint above the hover position beyond which it is lowered, m. Larger: a drift of
the estimated height brings the vehicle closer to the ceiling. Smaller: the noise of the target's
height lowers it step by step."""
MAX_SINK_BELOW_HOVER_HEIGHT_BEFORE_CLIMB_BACK_M = 0.06
"""Distance below the hover position beyond which the vehicle climbs back, m. Larger: a drift of the
estimated height moves the vehicle further. Smaller: the noise of the target's height makes it climb
back needlessly."""
SUNK_BELOW_HOVER_HEIGHT_DWELL_S = 0.3
"""Time for which the vehicle must be too low before it climbs back, s."""
MAX_HEIGHT_RETURN_DURATION_TO_KEEP_HOVER_TIMER_S = 5.0
"""Longest duration of a climb back to the hover position after which the hover timer continues, s.
Larger: a weak vehicle counts as hovering although it is too low. Smaller: a climb in wind restarts
the timer."""
MAX_HEIGHT_ERROR_TO_KEEP_HOVERING_M = 0.15
"""Vertical distance from the hover position beyond which the vehicle has left it, m. Larger: a
vehicle that sinks or rises still counts as hovering. Smaller: a gust restarts the timer."""

SUNK_BELOW_HOVER_HEIGHT = Condition[Context](
    "sunk",
    lambda c: distance_below_hover_height_m(c) > MAX_SINK_BELOW_HOVER_HEIGHT_BEFORE_CLIMB_BACK_M,
)
"""The vehicle is too low for a hover."""


def hover_config(c: Context) -> HoverConfig:
    """Return the profile's hover section, or its defaults if the mission does not hover."""
    return c.planner.hover or HoverConfig()


def is_hovering(state: PlannerState) -> bool:
    """True in HOVER, and in an ASCEND in which the vehicle climbs back to the hover height."""
    return state.phase is Phase.HOVER or is_returning_to_hover_height(state)


def time_since_hover_began_s(c: Context) -> float:
    """Return the time since the newest hover began, s, including short climbs back to the hover
    position (`enter_hover`). Only valid once a hover has begun."""
    return c.t_s - c.state.hover_errors.hover_began_at_s


def enter_hover(state: PlannerState, previous_context: Context) -> PlannerState:
    """Return the state with the hover timer and the statistics of the position errors restarted. If
    the vehicle has only climbed back to its hover position, in at most
    `MAX_HEIGHT_RETURN_DURATION_TO_KEEP_HOVER_TIMER_S`, return the state unchanged, so that both
    continue. `previous_context`, the context before the transition in the same tick, shows whether
    it has."""
    if (
        is_returning_to_hover_height(previous_context.state)
        and previous_context.time_in_phase_s <= MAX_HEIGHT_RETURN_DURATION_TO_KEEP_HOVER_TIMER_S
    ):
        return state
    return replace(state, hover_errors=HoverErrorAccumulator(state.entry.t_s, state.entry.t_s))


def act_in_hover(c: Context) -> Action:
    """Stay under the target at the setpoint's height, and never climb. If the setpoint is more than
    `MAX_SETPOINT_ABOVE_HOVER_HEIGHT_M` above the hover height, lower it to that limit."""
    old = c.state.setpoint or make_setpoint_at_vehicle(c)
    goal_z_m = c.belief.target.vehicle_world_z_when_touching_m - hover_config(c).below_m
    return fly_under_target(c, min(old.z_m, goal_z_m + MAX_SETPOINT_ABOVE_HOVER_HEIGHT_M))


def distance_below_hover_height_m(c: Context) -> float:
    """Return how far the vehicle is below its hover height, m; negative if it is above."""
    return c.belief.target.gear_to_target_z_m - hover_config(c).below_m


def has_left_hover_position(c: Context) -> bool:
    """True if the gear's offset from the target's axis exceeds the radius of the approach cone
    (`ascent_cone_radius_at_gear_m`), or its height differs from the hover height by more than
    `MAX_HEIGHT_ERROR_TO_KEEP_HOVERING_M`."""
    lateral_m = c.belief.target.gear_to_target_distance_xy_m
    return (
        lateral_m > ascent_cone_radius_at_gear_m(c)
        or abs(distance_below_hover_height_m(c)) > MAX_HEIGHT_ERROR_TO_KEEP_HOVERING_M
    )


def left_hover_position_reason(c: Context) -> str:
    """Return a message that says how far the gear is from its hover position, to the side and up or
    down. It is the reason to align again once `has_left_hover_position` is true, and does not check
    that again."""
    aside_m, below_m = (
        c.belief.target.gear_to_target_distance_xy_m,
        distance_below_hover_height_m(c),
    )
    return (
        f"moved {aside_m:.2f} m to the side and {abs(below_m):.2f} m "
        f"{'down' if below_m > 0.0 else 'up'} from its hover position"
    )


HOVER = PhaseDefinition(
    phase=Phase.HOVER,
    maneuver=Maneuver(
        is_in_free_air=True,
        is_camera_guided=True,
        requires_pictures=True,
        learns_hover_thrust=True,
        climbs_to_target=True,
    ),
    enter=enter_hover,
    act=act_in_hover,
    timed_conditions=(SUNK_BELOW_HOVER_HEIGHT,),
    exits=(
        back_off_row(
            "hover-lost",
            {Phase.HOVER},
            is_target_lost,
            "target lost during the hover",
        ),
        Transition(
            "left-place",
            {Phase.HOVER},
            has_left_hover_position,
            Phase.ALIGN,
            left_hover_position_reason,
            Severity.HOLD,
        ),
        land_row(
            "hovered",
            {Phase.HOVER},
            lambda c: (
                time_since_hover_began_s(c) >= hover_config(c).duration_s
                and c.belief.target.is_fresh
            ),
            lambda c: (
                f"hovered for {hover_config(c).duration_s:g} s, {hover_config(c).below_m:g} m "
                f"below the target"
            ),
            Outcome.HOVERED,
        ),
        Transition(
            "sunk",
            {Phase.HOVER},
            lambda c: c.true_for_s(SUNK_BELOW_HOVER_HEIGHT) >= SUNK_BELOW_HOVER_HEIGHT_DWELL_S,
            Phase.ASCEND,
            lambda c: f"{distance_below_hover_height_m(c):.2f} m too low: climbing back",
            diagnosis=VehicleDiagnosis.RETURNING_TO_HOVER_HEIGHT,
        ),
    ),
)
