"""Where setpoints may lie, whatever is seen or estimated."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import Operator, Phase, planner
from perchctl.mission.context import Context
from perchctl.mission.guidance import FLOOR_M, limited
from perchctl.mission.state import FLYING_PHASES
from perchctl.vehicle import PositionSetpoint
from tests.helpers.mission import (
    PROFILE,
    READY,
    changed,
    observation,
    state_in,
    target_at,
    telemetry,
)

GROUND_Z_M = 0.4
"""A table, in a world whose zero is the floor."""


@given(st.floats(-5, 5), st.sampled_from(sorted(FLYING_PHASES | {Phase.LANDING}, key=str)))
def test_no_setpoint_lies_in_the_ground(z_m: float, phase: Phase) -> None:
    state = replace(state_in(phase), ground_m=(0.0, 0.0, GROUND_Z_M))
    c = Context(state, observation(10.02), PROFILE)
    lowest = GROUND_Z_M + (0.0 if phase is Phase.APPROACH else FLOOR_M)
    sent = limited(c, PositionSetpoint(0.0, 0.0, z_m, 0.0)).z_m
    assert sent >= lowest
    assert sent == z_m or z_m < lowest or z_m > GROUND_Z_M + PROFILE.safety.max_height_m


def test_a_target_that_seems_to_lie_below_is_not_dived_to() -> None:
    """SEARCH looks for a target that it knows from below it."""
    for phase in (Phase.SEARCH, Phase.ASCEND, Phase.PERCH):
        state, z_m = state_in(phase), 1.0
        for i in range(1, 400):
            t_s = 10.0 + 0.02 * i
            body_m = (0.0, 0.0, z_m)
            target = target_at(t_s, (0.0, 0.0, -1.0), body_m, tracked=False, measured=False)
            tel = telemetry(t_s, position_m=body_m)
            obs = observation(t_s, telemetry=tel, target=target)
            state, command = planner.step_mission(state, obs, PROFILE)
            if isinstance(command, PositionSetpoint):
                assert command.z_m >= FLOOR_M
                z_m = command.z_m


def test_a_take_off_begins_on_the_ground() -> None:
    state = planner.start_mission(observation(0.0, 0.0))
    tel = telemetry(0.02, 0.0, thrust=0.0, supervisor=READY)
    _, command = planner.step_mission(state, observation(0.02, telemetry=tel), PROFILE)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m < FLOOR_M


@pytest.mark.parametrize("handover_m", [0.1, 0.3])
def test_a_landing_is_handed_over_above_the_floor(handover_m: float) -> None:
    """The lowest setpoint of a landing still leads below where it is handed over."""
    profile = changed({"planner.landing.handover_m": handover_m})
    state, z_m, lowest_m = state_in(Phase.ALIGN), 1.0, 1.0
    for i in range(1, 1000):
        t_s = 10.0 + 0.02 * i
        obs = observation(t_s, z_m, operator=Operator.LAND)
        state, command = planner.step_mission(state, obs, profile)
        if not isinstance(command, PositionSetpoint):
            break
        lowest_m = command.z_m
        z_m += 0.1 * (command.z_m - z_m)
    assert state.orders == 1
    assert FLOOR_M <= lowest_m < handover_m
