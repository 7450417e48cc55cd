"""Down without a heading: level, by raw thrust, on the vertical speed alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import Phase, PlannerState, planner
from perchctl.mission.lander import SINK_MPS
from perchctl.mission.state import BEFORE_CONTACT
from perchctl.vehicle import Land, PositionSetpoint, RawThrust, StopMotors
from tests.helpers.mission import HOVER_THRUST, PROFILE, observation, state_in, telemetry

DT_S = 0.02
TURNED_RAD = 1.5


def lost(phase: Phase = Phase.LANDING) -> PlannerState:
    return replace(state_in(phase, z_m=1.0), heading_lost=True, hover_thrust=HOVER_THRUST)


@pytest.mark.parametrize("phase", sorted(BEFORE_CONTACT, key=lambda p: p.value))
def test_a_heading_that_jumps_ends_position_control_at_once(phase: Phase) -> None:
    """With a heading that is far off, a position setpoint leads away from its place."""
    state, command = planner.step_mission(
        state_in(phase), observation(10.02, 1.0, jumped=True, turned_rad=TURNED_RAD), PROFILE
    )
    assert state.phase is Phase.LANDING
    assert state.heading_lost
    assert isinstance(command, RawThrust)


def test_a_small_step_of_the_heading_is_held_as_any_other() -> None:
    obs = observation(10.02, 1.0, jumped=True, turned_rad=0.4)
    state, command = planner.step_mission(state_in(Phase.ALIGN), obs, PROFILE)
    assert not state.heading_lost
    assert state.hold
    assert isinstance(command, PositionSetpoint)


@given(speed_mps=st.floats(-1.5, 0.5))
def test_it_brakes_what_sinks_fast_and_lets_sink_what_does_not(speed_mps: float) -> None:
    tel = telemetry(10.02, 1.0, velocity_mps=(0.0, 0.0, speed_mps))
    _, command = planner.step_mission(lost(), observation(10.02, telemetry=tel), PROFILE)
    assert isinstance(command, RawThrust)
    beside = abs(speed_mps + SINK_MPS) < 0.02
    assert beside or (command.thrust > HOVER_THRUST) == (speed_mps < -SINK_MPS)
    assert command.thrust <= 60000  # more is clipped
    assert (command.roll_rad, command.pitch_rad) == (0.0, 0.0)


def test_what_does_not_sink_gets_less_until_the_floor_proves_itself() -> None:
    state = lost()
    thrust = HOVER_THRUST
    for i in range(1, 300):
        tel = telemetry(10.0 + DT_S * i, 0.05, thrust=thrust)
        state, command = planner.step_mission(state, observation(tel.t_s, telemetry=tel), PROFILE)
        if isinstance(command, StopMotors):
            break
        assert isinstance(command, RawThrust)
        assert command.thrust < thrust + 1
        thrust = float(command.thrust)
    assert isinstance(command, StopMotors)
    assert i * DT_S < 4.0


def test_unseen_it_is_the_vehicles_own_landing() -> None:
    """Without its vertical speed raw thrust would be blind."""
    tel = telemetry(9.5, 1.0)
    _, command = planner.step_mission(lost(), observation(10.02, telemetry=tel), PROFILE)
    assert isinstance(command, Land)
