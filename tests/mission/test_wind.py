"""A steady wind: what holds a vehicle there is trimmed, goes down with it, and is no motion."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.mission import ImuMotion, Observation, OperatorRequest, Phase
from perchctl.mission.belief.reckoning import DeadReckoningState, advance_dead_reckoning
from perchctl.mission.phases.recover import STEADY_AFTER_ATTEMPT
from perchctl.mission.setpoints import (
    MAX_INTEGRAL_SETPOINT_SHIFT_M,
    MAX_SPEED_TO_COUNT_AS_HOVERING_MPS,
)
from perchctl.vehicle import PositionSetpoint
from tests.helpers.mission import BY_TARGET, MOCAP, observation, state_in, target_at, telemetry
from tests.mission.rig import BEGIN_S, Look, at, fly

LEARNED_S = 8.0  # four times the memory of the velocity's bias
TARGET_M = (0.0, 0.0, 2.2)
BRIEFLY = settings(max_examples=5)  # each flies for seconds


def blown(
    lateral_offset_m: float,
    reads_mps: float = 0.0,
    towards_rad: float = 0.0,
    flown_mps: float = 0.0,
) -> Look:
    """A vehicle beside its target, or on its way there at `flown_mps`, whose estimated velocity is
    off by `reads_mps`."""
    cos, sin = math.cos(towards_rad), math.sin(towards_rad)

    def look(t_s: float) -> Observation:
        away_m = lateral_offset_m - flown_mps * (t_s - BEGIN_S)
        speed_mps = reads_mps - flown_mps
        body_m = (away_m * cos, away_m * sin, 1.0)
        sample = telemetry(
            t_s, position_m=body_m, velocity_mps=(speed_mps * cos, speed_mps * sin, 0.0)
        )
        return observation(t_s, telemetry=sample, target=target_at(t_s, TARGET_M, body_m))

    return look


@BRIEFLY
@given(reads_mps=st.floats(-0.45, 0.45), towards_rad=st.floats(-3.1, 3.1))
def test_a_velocity_that_no_position_shows_is_no_motion(
    reads_mps: float, towards_rad: float
) -> None:
    """The firmware takes the air's drag for a tilt, and its velocity reads 0.4 m/s in 4 m/s of
    wind, while the vehicle stands still."""
    flight = fly(state_in(Phase.RECOVER), blown(0.0, reads_mps, towards_rad), LEARNED_S, MOCAP)
    assert Phase.ESTIMATE in {tick.state.phase for tick in flight.ticks}  # steady, it goes on
    bias_mps = flight.state.belief.dead_reckoning.estimated_velocity_bias_world_xy_mps
    assert bias_mps == pytest.approx(
        (reads_mps * math.cos(towards_rad), reads_mps * math.sin(towards_rad)), abs=0.02
    )


@BRIEFLY
@given(flown_mps=st.floats(0.15, 0.4), towards_rad=st.floats(-3.1, 3.1))
def test_a_motion_that_positions_show_stays_one(flown_mps: float, towards_rad: float) -> None:
    look = blown(0.6, 0.0, towards_rad, flown_mps)
    flight = fly(state_in(Phase.RECOVER), look, 3.0, MOCAP, one_phase=True)
    assert flight.state.phase is Phase.RECOVER
    assert (
        math.hypot(*flight.state.belief.dead_reckoning.estimated_velocity_bias_world_xy_mps) < 0.02
    )
    assert STEADY_AFTER_ATTEMPT not in flight.state.condition_start_times_s


@BRIEFLY
@given(lateral_offset_m=st.floats(0.07, 0.35), towards_rad=st.floats(-3.1, 3.1))
def test_an_offset_in_which_the_vehicle_stands_is_trimmed(
    lateral_offset_m: float, towards_rad: float
) -> None:
    """The setpoint goes on to the other side of the target until the vehicle follows."""
    flight = fly(state_in(Phase.ALIGN), blown(lateral_offset_m, 0.0, towards_rad), 1.5, MOCAP)
    x_m, y_m = flight.state.integral_setpoint_shift_world_xy_m
    along_m = x_m * math.cos(towards_rad) + y_m * math.sin(towards_rad)
    gain = MOCAP.planner.integral_per_s * 1.5
    assert along_m == pytest.approx(
        -min(gain * lateral_offset_m, MAX_INTEGRAL_SETPOINT_SHIFT_M), rel=0.1
    )


@BRIEFLY
@given(flown_mps=st.floats(2.0 * MAX_SPEED_TO_COUNT_AS_HOVERING_MPS, 0.5))
def test_an_offset_on_the_way_is_not_trimmed(flown_mps: float) -> None:
    flight = fly(state_in(Phase.ALIGN), blown(0.3, 0.0, 0.0, flown_mps), 0.4, MOCAP)
    assert flight.state.phase is Phase.ALIGN
    assert flight.state.integral_setpoint_shift_world_xy_m == (0.0, 0.0)


@BRIEFLY
@given(lateral_offset_m=st.floats(-0.25, 0.25), towards_rad=st.floats(-3.1, 3.1))
def test_what_holds_it_in_the_wind_goes_down_with_it(
    lateral_offset_m: float, towards_rad: float
) -> None:
    """The setpoint of a vehicle that stands 0.25 m beside it is beside it by as much on the way
    down; anchored where the vehicle is, it would go on by another 0.25 m."""
    look, lands_s = blown(lateral_offset_m, 0.0, towards_rad), BEGIN_S + 0.5

    def lands(t_s: float) -> Observation:
        operator = OperatorRequest.LAND if t_s > lands_s else OperatorRequest.NONE
        return replace(look(t_s), operator_request=operator)

    flight = fly(state_in(Phase.ALIGN), lands, 0.6, MOCAP)
    assert flight.state.phase is Phase.LANDING
    before = next(tick.command for tick in reversed(flight.ticks) if tick.t_s <= lands_s)
    assert isinstance(before, PositionSetpoint)
    assert isinstance(flight.command, PositionSetpoint)
    assert flight.command.x_m == pytest.approx(before.x_m, abs=0.02)
    assert flight.command.y_m == pytest.approx(before.y_m, abs=0.02)


@BRIEFLY
@given(
    wind_g=st.floats(0.0, 0.12), towards_rad=st.floats(-3.1, 3.1), heading_rad=st.floats(-3.1, 3.1)
)
def test_what_holds_against_the_wind_is_learned_and_a_kick_is_not(
    wind_g: float, towards_rad: float, heading_rad: float
) -> None:
    """It leans by as much as it did while it stood still; a blow of 17 m/s2 changes that by less
    than 0.01 g."""
    ahead_g, left_g = (
        wind_g * math.cos(towards_rad - heading_rad),
        wind_g * math.sin(towards_rad - heading_rad),
    )
    dead_reckoning, imu, last = DeadReckoningState(), ImuMotion(), None
    for k in range(2400):
        kicked_g = 1.7 if 2000 <= k < 2004 else 0.0
        sample = telemetry(
            0.01 * k,
            acc_x_g=ahead_g + kicked_g + 1e-6 * (k % 7),
            acc_y_g=left_g,
            pitch_rad=-math.asin(ahead_g),
            roll_rad=math.asin(left_g),
            yaw_rad=heading_rad,
        )
        imu = imu.with_sample(last, sample)
        last = sample
        dead_reckoning = advance_dead_reckoning(
            dead_reckoning,
            imu,
            sample,
            is_estimate_trusted=True,
            is_estimated_velocity_being_corrected=True,
        )
    (bx, by, _), (x_mps2, y_mps2) = (
        dead_reckoning.acceleration_bias_world_mps2,
        dead_reckoning.mean_specific_force_world_xy_mps2,
    )
    assert (bx - x_mps2) / 9.81 == pytest.approx(-wind_g * math.cos(towards_rad), abs=0.01)
    assert (by - y_mps2) / 9.81 == pytest.approx(-wind_g * math.sin(towards_rad), abs=0.01)


@BRIEFLY
@given(push_g=st.floats(0.01, 0.035))
def test_a_push_that_no_sight_corrects_is_a_motion_and_no_bias(push_g: float) -> None:
    """In the last second under the target nothing is seen: what the wind moves the vehicle by has
    to be in the distance that is reported."""
    lost_s = BEGIN_S + 0.5

    def look(t_s: float) -> Observation:
        unseen_s = max(0.0, t_s - lost_s)
        shakes_g = 0.1 * math.sin(4.0 * math.pi * t_s)  # as in a draught: it does not rest
        pushed = {"acc_x_g": push_g if unseen_s > 0.2 else 0.0, "acc_z_g": 1.0 + shakes_g}
        obs = at(1.9, obs={"external_position_age_s": 0.05 + unseen_s}, **pushed)(t_s)
        if not unseen_s:
            return obs
        assert obs.target is not None
        late = replace(obs.target, last_measured_at_s=lost_s, is_measured_in_newest_frame=False)
        return replace(obs, target=late, has_new_frame=False)

    flight = fly(state_in(Phase.PERCH, z_m=1.9), look, 1.2, BY_TARGET, feels=True, one_phase=True)
    assert flight.state.phase is Phase.PERCH
    first = next(
        tick.state.belief.dead_reckoning for tick in flight.ticks if tick.t_s > lost_s + 0.2
    )
    last = flight.state.belief.dead_reckoning
    assert last.acceleration_bias_world_mps2[0] == pytest.approx(
        first.acceleration_bias_world_mps2[0], abs=1e-6
    )
    way_m = 0.5 * 9.81 * push_g * 0.5**2
    assert first.gear_to_target_world_xy_m[0] - last.gear_to_target_world_xy_m[0] == pytest.approx(
        way_m, rel=0.1
    )
