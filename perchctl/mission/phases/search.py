"""Phase 2, SEARCH: wait for the target, then climb one step, turn one step and wait again."""

from __future__ import annotations

import math

from perchctl.mission.belief.maneuver import Maneuver
from perchctl.mission.belief.mounting import CameraMountingMonitor
from perchctl.mission.context import Context
from perchctl.mission.definition import PhaseDefinition
from perchctl.mission.phase import Outcome, Phase
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

MIN_CLEARANCE_BELOW_OBSTACLE_M = 0.1
"""Distance that the search keeps below an obstacle, m."""
MAX_LATERAL_MOVE_BEFORE_CAMERA_MOUNTING_CHECK_M = 0.2
"""Largest lateral distance flown to a previously seen target while the camera's mounting is
unconfirmed, m. Larger: a rotated camera leads the vehicle further away."""


def enter_search(state: PlannerState, previous_context: Context) -> PlannerState:
    """Start the search at the last setpoint in `previous_context`, the context before the
    transition in the same tick; without a setpoint, at the vehicle's position on entry."""
    setpoint = previous_context.state.setpoint
    if setpoint is None:
        return state
    place_m = (setpoint.x_m, setpoint.y_m, setpoint.z_m)
    return replace(
        state,
        entry=replace(
            state.entry, vehicle_world_position_m=place_m, vehicle_world_yaw_rad=setpoint.yaw_rad
        ),
    )


def act_in_search(c: Context) -> Action:
    """Every `search.wait_s`, climb by `search.step_m` and turn by `search.yaw_step_deg`, never
    above the height limit or close to a known obstacle. If the target was seen before, search from
    below its last position instead, turning without climbing."""
    search, state, b = c.planner.search, c.state, c.belief
    takeoff_position_m = b.takeoff_position_m
    assert takeoff_position_m is not None
    if c.t_s - state.search_step_began_at_s > search.wait_s:
        state = replace(
            state,
            searched_position_count=state.searched_position_count + 1,
            search_step_began_at_s=c.t_s,
        )
        c = Context(state)
    x, y, z = state.entry.vehicle_world_position_m
    if b.target.world_position_m is not None:
        there = vehicle_world_xy_with_gear_under_target_m(c, state.entry.vehicle_world_yaw_rad)
        unconfirmed = b.camera_mounting_monitor.is_target_motion_undetermined
        x, y = (
            _limit_move_before_camera_mounting_check(b.camera_mounting_monitor, (x, y), there)
            if unconfirmed
            else there
        )
        height = min(z, b.target.vehicle_world_z_when_touching_m - c.planner.ascend.near_m)
    else:
        top = max(z, takeoff_position_m[2] + search.max_height_m)
        if state.vehicle_world_z_when_blocked_m is not None:
            top = min(top, state.vehicle_world_z_when_blocked_m - MIN_CLEARANCE_BELOW_OBSTACLE_M)
        height = min(z + search.step_m * state.searched_position_count, top)
    yaw = (
        state.entry.vehicle_world_yaw_rad
        + math.radians(search.yaw_step_deg) * state.searched_position_count
    )
    goal = PositionSetpoint(x, y, height, yaw)
    old = state.setpoint or make_setpoint_at_vehicle(c)
    return fly_to(c, step_setpoint_towards(c, old, goal, max_up_mps=c.planner.ascend.speed_mps))


def _limit_move_before_camera_mounting_check(
    mounting: CameraMountingMonitor,
    start_world_xy_m: tuple[float, float],
    goal_world_xy_m: tuple[float, float],
) -> tuple[float, float]:
    """Return `goal_world_xy_m`, limited to a circle of radius
    `MAX_LATERAL_MOVE_BEFORE_CAMERA_MOUNTING_CHECK_M`: a goal outside is moved towards the centre
    onto the circle. The centre is the vehicle's position at the last sighting in `mounting` or,
    without a sighting, `start_world_xy_m`. All positions are world x and y, m."""
    if mounting.sightings:
        start_world_xy_m = (
            mounting.sightings[-1].vehicle_world_xy_m.real,
            mounting.sightings[-1].vehicle_world_xy_m.imag,
        )
    dx, dy = goal_world_xy_m[0] - start_world_xy_m[0], goal_world_xy_m[1] - start_world_xy_m[1]
    part = min(1.0, MAX_LATERAL_MOVE_BEFORE_CAMERA_MOUNTING_CHECK_M / max(math.hypot(dx, dy), 1e-6))
    return start_world_xy_m[0] + part * dx, start_world_xy_m[1] + part * dy


def target_not_found_reason(c: Context) -> str:
    """Return a message that says that the target was not found, and why if known: the camera's
    problem or, without one, why a sighting was refused. It is the reason to land once all
    `search.attempts` steps of the search have been used."""
    text, why = "target not found in the allowed attempts", c.obs.camera_problem
    why = why or c.obs.target_refusal_reason
    return f"{text}: {why}" if why else text


SEARCH = PhaseDefinition(
    phase=Phase.SEARCH,
    maneuver=Maneuver(is_in_free_air=True, is_camera_guided=True, requires_pictures=True),
    enter=enter_search,
    act=act_in_search,
    exits=(
        Transition(
            "found",
            {Phase.SEARCH},
            lambda c: c.state.consecutive_target_frames >= c.planner.search.confirm_frames,
            Phase.ESTIMATE,
            "target seen",
        ),
        land_row(
            "searched-out",
            {Phase.SEARCH},
            lambda c: c.state.searched_position_count >= c.planner.search.attempts,
            target_not_found_reason,
            Outcome.TARGET_NOT_FOUND,
        ),
    ),
)
