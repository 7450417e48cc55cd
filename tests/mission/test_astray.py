"""A capture in another world: what goes astray by it comes down level, by thrust alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from perchctl.mission import ImuMotion, Phase, PlannerState, planner
from perchctl.mission.conditions import OTHERWISE_MPS
from perchctl.mission.imu import Reckoning
from perchctl.mission.lander import LEAST_ORDERS
from perchctl.vehicle import HL_ACTIVE, RawThrust, StopMotors
from tests.helpers.mission import (
    AIRBORNE,
    HOVER_THRUST,
    MOCAP,
    PROFILE,
    READY,
    Felt,
    observation,
    state_in,
    target_at,
    telemetry,
)
from tests.mission.test_positions import BEGIN_S, TURN_S, times


@pytest.mark.parametrize("felt_too_much_g", [0.0, 0.015, -0.015])
@pytest.mark.parametrize("hover", [42000.0, 55000.0])
def test_a_climb_that_goes_sideways_is_ended_level_by_thrust_alone(
    hover: float, felt_too_much_g: float
) -> None:
    """A world with its y up: the vehicle rises, its position slides, its height and its vertical
    speed stand. It is let down by what its accelerometer feels, one with an offset too."""
    state = replace(state_in(Phase.APPROACH, z_m=0.2), hover_thrust=0.0, last=None)
    z_m, up_mps, thrust, highest_m, felt = 0.0, 0.0, 1.15 * hover, 0.0, Felt()
    for t_s in times(5.0):
        acc_g = thrust / hover
        up_mps += 9.81 * (acc_g - 1.0) * TURN_S
        z_m += up_mps * TURN_S
        highest_m = max(highest_m, z_m)
        tel = telemetry(
            t_s, position_m=(0.0, z_m, 0.0), velocity_mps=(0.0, up_mps, 0.0), thrust=thrust,
            acc_z_g=acc_g + felt_too_much_g,
        )  # fmt: skip
        obs = observation(t_s, telemetry=tel, target=target_at(t_s, body_m=tel.position_m))
        state, command = planner.step_mission(state, felt(obs), MOCAP)
        if isinstance(command, RawThrust):
            thrust = float(command.thrust)
        if z_m <= 0.0:
            break
    assert (state.phase, state.row) == (Phase.LANDING, "position-astray")
    assert "perchctl check --lift" in state.reason
    assert z_m <= 0.0
    assert -0.9 < up_mps < 0.0
    assert highest_m < 0.3


def test_what_is_astray_and_unfelt_for_a_moment_keeps_the_speed_that_it_had() -> None:
    """A gap in telemetry tells nothing: neither that it stands still nor the estimate's speed."""
    felt = Felt()
    began = felt(observation(10.0, telemetry=telemetry(10.0)))
    state = replace(
        state_in(Phase.LANDING), astray=True, row="position-astray", last=began.telemetry,
        reckoning=Reckoning(imu=began.imu, velocity_mps=(0.0, 0.0, -0.4)),
    )  # fmt: skip
    tel = telemetry(10.3, velocity_mps=(0.0, 0.0, 0.8))
    after, _ = planner.step_mission(state, felt(observation(10.3, telemetry=tel)), MOCAP)
    assert after.reckoning.velocity_mps[2] == pytest.approx(-0.4)
    tel = telemetry(10.32, velocity_mps=(0.0, 0.0, 0.8), acc_z_g=1.1)
    again, _ = planner.step_mission(after, felt(observation(10.32, telemetry=tel)), MOCAP)
    assert -0.4 < again.reckoning.velocity_mps[2] < -0.38


def test_what_went_astray_comes_to_rest_whatever_its_position_says() -> None:
    """On the floor, by a height that says 0.6 m: the motors are stopped all the same, in time."""
    state, felt = replace(state_in(Phase.APPROACH, z_m=0.2), hover_thrust=0.0), Felt()
    thrust = 60000.0
    for t_s in times(14.0):
        down = t_s > BEGIN_S + 2.0
        body_m = (0.0, 0.2, 0.6 if down else 0.0)
        tel = telemetry(
            t_s, position_m=body_m, thrust=thrust, supervisor=READY if thrust == 0 else AIRBORNE
        )
        obs = felt(observation(t_s, telemetry=tel, target=None))
        state, command = planner.step_mission(state, obs, MOCAP)
        if isinstance(command, RawThrust):
            thrust = float(command.thrust)
        elif isinstance(command, StopMotors):
            thrust = 0.0
        if state.phase.is_over:
            break
    assert state.phase is Phase.LANDED


@pytest.mark.parametrize("profile", [PROFILE, MOCAP])
def test_only_positions_from_outside_go_astray(profile: Any) -> None:
    tel = telemetry(10.02, position_m=(0.2, 0.0, 0.02))
    state, _ = planner.step_mission(
        state_in(Phase.APPROACH, z_m=0.2), observation(10.02, telemetry=tel), profile
    )
    assert (state.phase is Phase.LANDING) is (profile is MOCAP)


@pytest.mark.parametrize(("phase", "z_m", "aside_m", "lands"), [
    (Phase.APPROACH, 0.02, 0.08, False), (Phase.APPROACH, 0.2, 0.2, False),
    (Phase.APPROACH, 0.2, 0.3, True), (Phase.ALIGN, 1.0, 0.6, False), (Phase.ALIGN, 1.0, 0.9, True),
    (Phase.SEARCH, 0.5, 0.15, False), (Phase.SEARCH, 0.5, 0.3, True),
    (Phase.ESTIMATE, 0.5, 0.3, True),
    (Phase.LANDING, 1.0, 0.3, False), (Phase.LANDING, 1.0, 0.5, True),
])  # fmt: skip
def test_a_draught_is_not_another_world(
    phase: Phase, z_m: float, aside_m: float, lands: bool
) -> None:
    tel = telemetry(10.02, position_m=(aside_m, 0.0, z_m))
    obs = observation(10.02, telemetry=tel)
    state, _ = planner.step_mission(state_in(phase, z_m=z_m), obs, MOCAP)
    assert (state.row == "position-astray") is lands


@pytest.mark.parametrize(("z_m", "pushed_s", "lands"), [
    (0.5, 9.5, False), (0.5, 8.0, True), (0.2, 9.5, True),
])  # fmt: skip
def test_what_a_gust_carries_off_is_not_in_another_world(
    z_m: float, pushed_s: float, lands: bool
) -> None:
    """Moving air is felt as a force from the side. Near the floor nothing asks for it."""
    tel = telemetry(10.02, position_m=(0.3, 0.0, z_m))
    obs = observation(10.02, telemetry=tel, imu=ImuMotion(t_s=10.02, pushed_s=pushed_s))
    state, _ = planner.step_mission(state_in(Phase.ESTIMATE, z_m=0.5), obs, MOCAP)
    assert (state.row == "position-astray") is lands


@pytest.mark.parametrize(
    ("phase", "climb_mps", "lands"),
    [
        (Phase.ASCEND, -0.6, True), (Phase.ALIGN, -1.0, True), (Phase.ASCEND, -0.4, False),
        (Phase.ASCEND, 1.0, False), (Phase.RECOVER, -1.0, False), (Phase.APPROACH, -1.0, False),
    ],
)  # fmt: skip
def test_positions_that_are_late_swing_it_up_and_down(
    phase: Phase, climb_mps: float, lands: bool
) -> None:
    """A catch falls as fast, and a take-off may be set down by hand."""
    tel = telemetry(10.02, 1.0, velocity_mps=(0.0, 0.0, climb_mps))
    for profile in (MOCAP, PROFILE):
        begin = state_in(phase, z_m=1.0)
        state, _ = planner.step_mission(begin, observation(10.02, telemetry=tel), profile)
        assert (state.row == "position-astray") is (lands and profile is MOCAP)
        if state.row == "position-astray":
            assert "late" in state.reason


def test_what_has_touched_the_ceiling_is_left_to_its_landing() -> None:
    """The magnet may hold it aside of its setpoint: that is no other world."""
    begin = replace(state_in(Phase.LANDING, z_m=1.0), contact_z_m=1.0)
    obs = observation(10.02, telemetry=telemetry(10.02, position_m=(0.5, 0.0, 1.0)))
    state, _ = planner.step_mission(begin, obs, MOCAP)
    assert state.row != "position-astray"


def test_a_landing_that_goes_astray_is_named_anew_and_flown_level() -> None:
    begin = replace(state_in(Phase.LANDING, z_m=0.5), reason="camera.mount", row="mounting")
    obs = observation(10.02, telemetry=telemetry(10.02, position_m=(0.5, 0.0, 0.5)))
    state, command = planner.step_mission(begin, obs, MOCAP)
    assert isinstance(command, RawThrust)
    assert state.astray
    assert "swapped axes" in state.reason


@pytest.mark.parametrize("beside_mps", [0.9 * OTHERWISE_MPS, 1.1 * OTHERWISE_MPS])
def test_a_landing_of_its_own_is_not_left_to_positions_that_move_otherwise(
    beside_mps: float,
) -> None:
    """It would follow them to its end: 15 m aside within six seconds, where they are mirrored."""
    felt = Felt()
    begun = felt(observation(BEGIN_S, telemetry=telemetry(BEGIN_S)))
    state = replace(
        state_in(Phase.LANDING), orders=LEAST_ORDERS, ordered_s=BEGIN_S, last=begun.telemetry,
        reckoning=Reckoning(imu=begun.imu),
    )  # fmt: skip
    for t_s in times(0.2):
        state = replace(state, reckoning=replace(state.reckoning, beside_mps=(0.0, -beside_mps)))
        tel = telemetry(t_s, supervisor=AIRBORNE | HL_ACTIVE)
        state, command = planner.step_mission(state, felt(observation(t_s, telemetry=tel)), MOCAP)
    assert state.astray is (beside_mps > OTHERWISE_MPS)
    assert isinstance(command, RawThrust) is state.astray


def test_a_tilt_that_wrong_positions_have_turned_is_taken_off_the_reckoned_motion() -> None:
    """They have added 0.3 m/s to the left: so the attitude leans by 0.05 rad that the vehicle does
    not, and what is reckoned by it would brake a speed that is none."""
    felt = Felt()
    begun = felt(observation(BEGIN_S, telemetry=telemetry(BEGIN_S)))
    state = replace(state_in(Phase.ALIGN), last=begun.telemetry, reckoning=Reckoning(begun.imu))
    for t_s in times(1.5):
        if not state.astray:
            beside = replace(state.reckoning, beside_mps=(0.0, 0.3))
            state = replace(state, reckoning=beside)
        tel = telemetry(t_s, roll_rad=-0.05 + 1e-6 * (round(100 * t_s) % 7))  # alive
        state, _ = planner.step_mission(state, felt(observation(t_s, telemetry=tel)), MOCAP)
    assert state.row == "position-astray"
    assert abs(state.reckoning.velocity_mps[1]) < 0.15


def come_down(height_m: float, felt: Felt, felt_too_much_g: float) -> tuple[PlannerState, float]:
    """A vehicle in a world whose axes are swapped in the plane alone, until it meets the floor:
    with what speed, 0 if it does not."""
    state = state_in(Phase.ALIGN, z_m=height_m)
    z_m, up_mps, thrust = height_m, 0.0, state.hover_thrust
    for t_s in times(12.0):
        acc_g = thrust / HOVER_THRUST
        up_mps += 9.81 * (acc_g - 1.0) * TURN_S
        z_m += up_mps * TURN_S
        aside_m = 2.0 * (t_s - BEGIN_S)
        tel = telemetry(
            t_s, position_m=(aside_m, 0.0, z_m), velocity_mps=(2.0, 0.0, up_mps), thrust=thrust,
            acc_z_g=acc_g + felt_too_much_g,
        )  # fmt: skip
        obs = felt(observation(t_s, telemetry=tel, target=None))
        state, command = planner.step_mission(state, obs, MOCAP)
        if isinstance(command, RawThrust):
            thrust = float(command.thrust)
        if z_m <= 0.0:
            return state, up_mps
    return state, 0.0


@pytest.mark.parametrize("felt_too_much_g", [0.0, 0.02, -0.02])
@pytest.mark.parametrize("height_m", [0.5, 1.0, 2.0])
def test_from_high_up_it_comes_down_as_softly(height_m: float, felt_too_much_g: float) -> None:
    """The accelerometer's offset, which would sum up on the longer way, was learned at rest."""
    felt = Felt().at_rest(BEGIN_S, 1.0 + felt_too_much_g)
    state, up_mps = come_down(height_m, felt, felt_too_much_g)
    assert state.row == "position-astray"
    assert -0.9 < up_mps < 0.0


def test_a_felt_speed_that_has_drifted_keeps_nothing_up() -> None:
    """By an accelerometer whose offset nobody knows it seems to sink faster and faster, and is
    braked more and more: for so long as the way takes, and no longer."""
    assert come_down(1.0, Felt(), -0.02)[1] < 0.0
