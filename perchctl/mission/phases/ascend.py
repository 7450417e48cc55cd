"""Phase 5, ASCEND: climb inside a cone below the target, and settle at the stand-off or at the
hover position."""

from __future__ import annotations

import math

from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Phase, Severity, VehicleDiagnosis
from perchctl.mission.setpoints import (
    MAX_SPEED_TO_COUNT_AS_HOVERING_MPS,
    Action,
    fly_under_target,
    make_setpoint_at_vehicle,
)
from perchctl.mission.state import PlannerState
from perchctl.mission.transition import Transition, back_off_row
from perchctl.values import replace

MAX_LATERAL_ERROR_TO_CONE_RADIUS_RATIO_TO_CLIMB = 0.7
"""Fraction of the cone's radius within which the vehicle climbs. Larger: the vehicle leaves the
cone and returns to ALIGN."""
MAX_SETPOINT_HEIGHT_ABOVE_VEHICLE_IN_ASCENT_M = 0.15
"""Largest height of the setpoint above the vehicle during the climb, m. Larger: the setpoint runs
far ahead of a weak vehicle."""
MIN_ASCENT_SETPOINT_CLIMB_RATE_MPS = 0.02
"""Lowest speed at which the setpoint approaches the stand-off, m/s."""
MAX_HEIGHT_ERROR_TO_BEGIN_HOVER_M = 0.05
"""Largest vertical distance from the hover position at which the vehicle has reached it, m. Larger:
the hover begins during the climb. Smaller: a height error prevents the hover from beginning."""
MAX_SETPOINT_HEIGHT_ERROR_TO_BEGIN_HOVER_M = 0.01
"""Largest vertical distance of the setpoint from the hover position at which the hover can begin,
m; the setpoint stays at its height during the hover. Larger: the vehicle hovers too low. Smaller:
noise in the target's estimated height prevents the hover from beginning."""
MAX_TARGET_OUT_OF_VIEW_DURATION_S = 1.5
"""Time since the last sighting of the target after which an ascent or a hover is given up, s, if a
positioning system holds the vehicle in place meanwhile. Larger: the vehicle waits for a target that
has moved or is covered. Smaller: a burst of lost pictures ends an attempt that would succeed."""


def ascent_cone_radius_at_gear_m(c: Context) -> float:
    """Return the radius of the approach cone at the gear's present height, m: the largest allowed
    horizontal distance of the gear from the target's axis. It is `ascend.cone_base_m` at the target
    and grows by `ascend.cone_slope` per metre below it."""
    ascend = c.planner.ascend
    return ascend.cone_base_m + ascend.cone_slope * max(0.0, c.belief.target.gear_to_target_z_m)


def ascent_end_distance_below_target_m(c: Context) -> float:
    """Return the distance of the gear below the target at which the ascent ends, m: the stand-off
    or, if the mission hovers, the distance at which it hovers."""
    hover = c.planner.hover
    return c.planner.ascend.standoff_m if hover is None else hover.below_m


def has_reached_ascent_end_height(c: Context) -> bool:
    """True if the gear is at most `ascend.settle_z_m` below the height at which the ascent ends
    (`ascent_end_distance_below_target_m`), or above it."""
    return (
        c.belief.target.gear_to_target_z_m
        <= ascent_end_distance_below_target_m(c) + c.planner.ascend.settle_z_m
    )


def _is_settled_at_standoff(c: Context) -> bool:
    """True if the vehicle is slow and below the target, at the stand-off height and with the
    target's heading, within the `ascend.settle_*` tolerances, and the camera has seen the small
    marker recently."""
    ascend, target, lateral = (
        c.planner.ascend,
        c.belief.target,
        c.belief.lateral_offset_and_velocity,
    )
    gear_to_target_distance_xy_m = (
        target.gear_to_target_distance_xy_m
        if lateral is None
        else math.hypot(*lateral.gear_to_target_world_xy_m)
    )
    return (
        target.is_fresh
        and target.is_small_marker_fresh
        and has_reached_ascent_end_height(c)
        and gear_to_target_distance_xy_m <= ascend.settle_xy_m
        and abs(target.vehicle_to_target_yaw_rad) <= math.radians(ascend.settle_yaw_deg)
        and c.belief.speed_mps <= ascend.settle_speed_mps
    )


def _is_at_hover_position(c: Context) -> bool:
    """True if the vehicle is slow, its gear and its setpoint are at the height at which the mission
    hovers (within `MAX_HEIGHT_ERROR_TO_BEGIN_HOVER_M` and
    `MAX_SETPOINT_HEIGHT_ERROR_TO_BEGIN_HOVER_M`), and the camera has seen the target recently. The
    gear's lateral offset from the target's axis and the heading must be within the tolerances of
    ALIGN; those of the stand-off do not apply, since the small marker may be too far away to be
    seen."""
    align, target, setpoint = c.planner.align, c.belief.target, c.state.setpoint
    goal_z_m = target.vehicle_world_z_when_touching_m - ascent_end_distance_below_target_m(c)
    return (
        target.is_fresh
        and setpoint is not None
        and abs(setpoint.z_m - goal_z_m) <= MAX_SETPOINT_HEIGHT_ERROR_TO_BEGIN_HOVER_M
        and abs(target.gear_to_target_z_m - ascent_end_distance_below_target_m(c))
        <= MAX_HEIGHT_ERROR_TO_BEGIN_HOVER_M
        and target.gear_to_target_distance_xy_m <= align.xy_m
        and abs(target.vehicle_to_target_yaw_rad) <= math.radians(align.yaw_deg)
        and c.belief.speed_mps <= MAX_SPEED_TO_COUNT_AS_HOVERING_MPS
    )


def is_returning_to_hover_height(state: PlannerState) -> bool:
    """True in an ASCEND that brings the vehicle back to its hover position after it has sunk during
    its hover. False in the first ASCEND to that position and in all other phases."""
    return (
        state.phase is Phase.ASCEND
        and VehicleDiagnosis.RETURNING_TO_HOVER_HEIGHT in state.entry.diagnosis
    )


def is_target_lost(c: Context) -> bool:
    """True if the target is no longer tracked (it is not visible, and the filter has stopped
    predicting it) and was last seen more than `MAX_TARGET_OUT_OF_VIEW_DURATION_S` ago. If the
    target itself is the position source, the vehicle's position drifts without sightings, so the
    target counts as lost as soon as it is no longer tracked."""
    b = c.belief
    patience_s = 0.0 if b.is_target_position_source else MAX_TARGET_OUT_OF_VIEW_DURATION_S
    return not b.target.is_tracked and b.target.age_s > patience_s


ASCENT_END_HEIGHT_REACHED = Condition[Context](
    "near the stand-off", lambda c: c.belief.target.is_tracked and has_reached_ascent_end_height(c)
)
"""The gear is at the stand-off below a tracked target."""
SETTLED_AT_STANDOFF = Condition[Context]("settled", _is_settled_at_standoff)
"""The vehicle is slow and aligned at the stand-off."""
AT_HOVER_POSITION = Condition[Context](
    "at the hover's place", lambda c: c.planner.hover is not None and _is_at_hover_position(c)
)
"""The mission hovers, and the vehicle is slow and aligned at the hover position."""


def enter_ascend(state: PlannerState, previous_context: Context) -> PlannerState:
    """Return the state at the start of ASCEND: the count of searched positions is reset, so that a
    search for a target that is lost later has all its steps again. `previous_context` is not
    used."""
    del previous_context
    return replace(state, searched_position_count=0)


def act_in_ascend(c: Context) -> Action:
    """Stay under the target and climb to the height at which the ascent ends. The setpoint climbs
    only with a fresh target, with the gear well inside the approach cone, and while it is not far
    above the vehicle. It climbs at `ascend.speed_mps`, or at `ascend.near_speed_mps` near the
    target."""
    ascend, target = c.planner.ascend, c.belief.target
    setpoint = c.state.setpoint or make_setpoint_at_vehicle(c)
    goal_z = target.vehicle_world_z_when_touching_m - ascent_end_distance_below_target_m(c)
    may_climb = (
        target.is_fresh
        and target.gear_to_target_distance_xy_m
        < MAX_LATERAL_ERROR_TO_CONE_RADIUS_RATIO_TO_CLIMB * ascent_cone_radius_at_gear_m(c)
    )
    lag_m = setpoint.z_m - c.telemetry.position_m[2]
    speed = ascend.near_speed_mps if target.gear_to_target_z_m < ascend.near_m else ascend.speed_mps
    speed = min(speed, max(MIN_ASCENT_SETPOINT_CLIMB_RATE_MPS, goal_z - setpoint.z_m))
    return fly_under_target(
        c,
        goal_z,
        max_up_mps=speed
        if may_climb and lag_m < MAX_SETPOINT_HEIGHT_ABOVE_VEHICLE_IN_ASCENT_M
        else 0.0,
    )


ASCEND = PhaseDefinition(
    phase=Phase.ASCEND,
    maneuver=Maneuver(
        is_in_free_air=True,
        is_camera_guided=True,
        requires_pictures=True,
        learns_hover_thrust=True,
        climbs_to_target=True,
    ),
    enter=enter_ascend,
    act=act_in_ascend,
    timed_conditions=(ASCENT_END_HEIGHT_REACHED, SETTLED_AT_STANDOFF, AT_HOVER_POSITION),
    exits=(
        back_off_row(
            "ascend-lost",
            {Phase.ASCEND},
            is_target_lost,
            "target lost during the ascent",
        ),
        Transition(
            "outside-cone",
            {Phase.ASCEND},
            lambda c: (
                c.belief.target.gear_to_target_distance_xy_m > ascent_cone_radius_at_gear_m(c)
            ),
            Phase.ALIGN,
            "drifted out of the ascent cone",
            Severity.HOLD,
        ),
        back_off_row(
            "ascend-timeout",
            {Phase.ASCEND},
            lambda c: (
                c.time_in_phase_s > c.planner.ascend.timeout_s
                or c.true_for_s(ASCENT_END_HEIGHT_REACHED) > c.planner.ascend.settle_timeout_s
            ),
            "did not settle under the target",
        ),
        Transition(
            "at-hover-place",
            {Phase.ASCEND},
            lambda c: c.true_for_s(AT_HOVER_POSITION) >= c.planner.ascend.settle_dwell_s,
            Phase.HOVER,
            lambda c: f"steady {ascent_end_distance_below_target_m(c):g} m below the target",
        ),
        Transition(
            "settled",
            {Phase.ASCEND},
            lambda c: (
                c.planner.hover is None
                and c.true_for_s(SETTLED_AT_STANDOFF) >= c.planner.ascend.settle_dwell_s
            ),
            Phase.PERCH,
            "settled at the stand-off",
        ),
    ),
)
