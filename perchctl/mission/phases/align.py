"""Phase 4, ALIGN: move under the target at constant height, and turn to its heading.

In a fleet, the vehicle waits here, below its target, until the fleet's parent process permits the
climb. The ascent continues even if the permission is withdrawn later.
"""

from __future__ import annotations

import math

from perchctl.mission.belief.evidence import Condition
from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.endurance import battery_shortfall_text, is_charge_too_low_for_any_attempt
from perchctl.mission.phase import Phase, Severity
from perchctl.mission.phases.ascend import MAX_HEIGHT_ERROR_TO_BEGIN_HOVER_M
from perchctl.mission.phases.recover import has_recovered
from perchctl.mission.setpoints import (
    MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M,
    Action,
    fly_under_target,
    make_setpoint_at_vehicle,
)
from perchctl.mission.transition import Transition, back_off_row, land_row

MAX_WAIT_FOR_CLIMB_PERMISSION_S = 45.0
"""Longest wait for permission to climb, s, from the entry into the phase or the end of a hold;
`planner.perching_time_s` limits the total. Larger: the battery of a vehicle without permission runs
down. Smaller: this flight also ends if a neighbour blocks the climb only for a limited time. The
longest such time is that of a neighbour whose link is silent while it lands: up to the time limit
of its landing (30 s by default), and 10 s more until it is certainly down."""

ALIGNED = Condition[Context](
    "aligned",
    lambda c: (
        c.belief.target.is_fresh
        and c.belief.target.gear_to_target_distance_xy_m <= c.planner.align.xy_m
        and abs(c.belief.target.vehicle_to_target_yaw_rad) <= math.radians(c.planner.align.yaw_deg)
    ),
)
"""The vehicle is below a fresh target and has the target's heading."""
CLIMB_WITHHELD = Condition[Context](
    "climb withheld", lambda c: c.obs.climb_withheld_reason is not None
)
"""The fleet's parent process does not permit the climb."""


def act_in_align(c: Context) -> Action:
    """Return the state and the command that move the vehicle under the target and turn it to the
    target's heading. The height stays that of the present setpoint or, without a setpoint, that of
    the vehicle."""
    return fly_under_target(c, (c.state.setpoint or make_setpoint_at_vehicle(c)).z_m)


def is_aligned(c: Context) -> bool:
    """True once the vehicle has been aligned for `align.dwell_s`: its gear is within `align.xy_m`
    of the axis of a fresh target, and its heading within `align.yaw_deg` of the target's."""
    return c.true_for_s(ALIGNED) >= c.planner.align.dwell_s


def is_charge_too_low_to_begin_attempt(c: Context) -> bool:
    """True if the vehicle is about to begin an attempt (it is aligned in ALIGN, or has recovered in
    RECOVER), attempts are left, and the battery has too little charge for one. Always False before
    that moment, whatever the charge."""
    begins = is_aligned(c) if c.state.phase is Phase.ALIGN else has_recovered(c)
    return (
        begins
        and c.state.failed_attempts < c.planner.attempts
        and is_charge_too_low_for_any_attempt(c)
    )


def planned_hover_height_above_ground_m(c: Context) -> float | None:
    """Return the height above the ground at which the vehicle would hover below the target, m; None
    if the mission does not hover."""
    hover, b = c.planner.hover, c.belief
    return (
        None
        if hover is None
        else b.target.vehicle_world_z_when_touching_m - hover.below_m - b.ground_z_m
    )


def is_planned_hover_height_unsafe(c: Context) -> bool:
    """True if the vehicle is aligned and would hover lower than
    `MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M` above the ground, or higher than `safety.max_height_m`
    minus `MAX_HEIGHT_ERROR_TO_BEGIN_HOVER_M`. False if the mission does not hover."""
    height_m = planned_hover_height_above_ground_m(c)
    if height_m is None or not is_aligned(c):
        return False
    highest_m = c.safety.max_height_m - MAX_HEIGHT_ERROR_TO_BEGIN_HOVER_M
    return not MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M <= height_m <= highest_m


def unsafe_hover_height_reason(c: Context) -> str:
    """Return a message with the height at which the vehicle would hover and the range of allowed
    heights, both above the ground. It is the reason to land once `is_planned_hover_height_unsafe`
    is true, and does not check that again. Only valid in a mission that hovers."""
    hover, height_m = c.planner.hover, planned_hover_height_above_ground_m(c)
    assert hover is not None
    assert height_m is not None
    highest_m = c.safety.max_height_m - MAX_HEIGHT_ERROR_TO_BEGIN_HOVER_M
    return (
        f"{hover.below_m:g} m below the target is {height_m:.2f} m above the ground, but the "
        f"vehicle hovers only {MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M:g} to {highest_m:g} m "
        f"above the ground: change the distance below the target"
    )


ALIGN = PhaseDefinition(
    phase=Phase.ALIGN,
    maneuver=Maneuver(
        is_in_free_air=True, is_camera_guided=True, requires_pictures=True, learns_hover_thrust=True
    ),
    act=act_in_align,
    timed_conditions=(ALIGNED, CLIMB_WITHHELD),
    exits=(
        Transition(
            "align-lost",
            {Phase.ALIGN},
            lambda c: not c.belief.target.is_tracked,
            Phase.SEARCH,
            "target lost during the alignment",
            Severity.HOLD,
        ),
        back_off_row(
            "align-timeout",
            {Phase.ALIGN},
            lambda c: c.time_in_phase_s - c.state.total_wait_in_phase_s > c.planner.align.timeout_s,
            "the alignment took too long",
        ),
        land_row(
            "too-little-left",
            {Phase.ALIGN, Phase.RECOVER},
            is_charge_too_low_to_begin_attempt,
            battery_shortfall_text,
        ),
        land_row(
            "hover-height",
            {Phase.ALIGN},
            is_planned_hover_height_unsafe,
            unsafe_hover_height_reason,
        ),
        land_row(
            "climb-not-permitted",
            {Phase.ALIGN},
            lambda c: c.true_for_s(CLIMB_WITHHELD) > MAX_WAIT_FOR_CLIMB_PERMISSION_S,
            lambda c: (
                f"no permission to climb for {MAX_WAIT_FOR_CLIMB_PERMISSION_S:g} s: "
                f"{c.obs.climb_withheld_reason}"
            ),
        ),
        Transition(
            "climb-withheld",
            {Phase.ALIGN},
            lambda c: is_aligned(c) and c.obs.climb_withheld_reason is not None,
            Phase.ALIGN,
            lambda c: f"waiting for permission to climb: {c.obs.climb_withheld_reason}",
            Severity.HOLD,
        ),
        Transition(
            "aligned", {Phase.ALIGN}, is_aligned, Phase.ASCEND, "aligned in position and heading"
        ),
    ),
)
