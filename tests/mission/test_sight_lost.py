"""Down without a position or a heading: hold, sink, and level by raw thrust."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import ImuMotion, Observation, Operator, Phase, PlannerState, lander, planner
from perchctl.mission.context import BLOWN_MPS, CORRECTED_S, Context
from perchctl.mission.guidance import LOWEST_M, MOST_BRAKED_MPS, POSITION_GAIN_PER_S
from perchctl.mission.imu import STEADY_ASIDE_MPS, Reckoning
from perchctl.mission.lander import (
    BRAKE_RAD_PER_MPS,
    HOVER_WITHIN,
    MOST_BRAKE_RAD,
    SINK_MPS,
    UNLEARNED_WITHIN,
)
from perchctl.mission.state import BEFORE_CONTACT, Severity
from perchctl.mission.table import BLIND_VARIANCE_M2
from perchctl.profile import Profile
from perchctl.vehicle import Command, Idle, Land, PositionSetpoint, RawThrust, StopMotors
from tests.helpers.mission import (
    AIRBORNE,
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    READY,
    Felt,
    observation,
    state_in,
    target_at,
    telemetry,
)
from tests.helpers.mission import PROFILE as DECKS

PROFILE = Profile.model_validate({"positioning": "target"})
HOLD_S, LAND_S = PROFILE.positioning.hold_s, PROFILE.positioning.land_s
TURN_S, BEGIN_S = 0.02, 10.0
IN_THE_AIR = (
    Phase.APPROACH, Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER,
)  # fmt: skip


def unseen(t_s: float, z_m: float, age_s: float, **changes: object) -> Observation:
    told = {"position_age_s": age_s, "position_problem": "the target is not seen"}
    return observation(t_s, z_m, new_frame=False, **told, **changes)


def flown(
    state: PlannerState, lasts_s: float, z_m: float = 1.0, variance_m2: float = 1e-3
) -> list[tuple[PlannerState, Command]]:
    """Turn by turn, without a sight from the first one on."""
    turns = []
    for i in range(1, round(lasts_s / TURN_S) + 1):
        t_s = BEGIN_S + TURN_S * i
        tel = telemetry(t_s, z_m, position_variance_m2=variance_m2)
        state, command = planner.step_mission(
            state, unseen(t_s, z_m, TURN_S * i, telemetry=tel), PROFILE
        )
        turns.append((state, command))
    return turns


def blind(
    z_m: float, velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0), **changes: object
) -> PlannerState:
    """On its way down by accelerometer and attitude alone, with that reckoned speed."""
    reckoning = Reckoning(imu=ImuMotion(t_s=BEGIN_S), velocity_mps=velocity_mps)
    state = replace(
        state_in(Phase.LANDING, z_m=z_m), blind_s=BEGIN_S, blind_height_m=z_m,
        severity=Severity.LAND, reckoning=reckoning,
    )  # fmt: skip
    return replace(state, **changes)  # type: ignore[arg-type]


def test_a_target_has_its_own_patience() -> None:
    assert (HOLD_S, LAND_S) == (0.5, 1.5)
    mocap = Profile.model_validate({"positioning": "mocap"})
    assert (mocap.positioning.hold_s, mocap.positioning.land_s) == (0.15, 0.7)
    own = Profile.model_validate({"positioning": {"by": "target", "hold_s": 0.3}})
    assert (own.positioning.hold_s, own.positioning.land_s) == (0.3, 1.5)


@pytest.mark.parametrize("phase", IN_THE_AIR)
def test_it_is_held_then_sinks_and_then_comes_down_level(phase: Phase) -> None:
    height_m = 0.45 if phase is Phase.APPROACH else 1.0
    turns = flown(state_in(phase, z_m=height_m), LAND_S + 0.3, height_m)
    heights: list[float] = []
    for i, (state, command) in enumerate(turns, start=1):
        if TURN_S * i < LAND_S:
            assert isinstance(command, PositionSetpoint)
            assert state.setpoint is not None
            heights.append(state.setpoint.z_m)
            if TURN_S * i > HOLD_S + TURN_S:
                assert "not seen" in state.hold
        elif TURN_S * i > LAND_S + TURN_S:
            assert state.phase is Phase.LANDING
            assert isinstance(command, RawThrust)
    blind_m = heights[round(HOLD_S / TURN_S) + 1 :]
    assert all(after <= before for before, after in pairwise(blind_m))
    assert blind_m[-1] < blind_m[0]
    assert turns[-1][0].row == "position-lost"
    assert "down level" in turns[-1][0].reason


@given(age_s=st.floats(0.0, 1.4), z_m=st.floats(0.3, 2.0), phase=st.sampled_from(IN_THE_AIR))
def test_nothing_climbs_without_a_sight(age_s: float, z_m: float, phase: Phase) -> None:
    """Not even a search, which would climb by a position that drifts."""
    state = replace(state_in(phase, z_m=z_m), searches=2, search_step_s=0.0)
    after, _ = planner.step_mission(
        state, unseen(BEGIN_S + TURN_S, z_m, max(age_s, HOLD_S + 0.01)), PROFILE
    )
    assert after.setpoint is None or after.setpoint.z_m <= z_m


def test_sinking_ends_above_the_floor() -> None:
    state = state_in(Phase.ALIGN, z_m=LOWEST_M + 0.05)
    turns = flown(state, LAND_S - 0.1, LOWEST_M + 0.05)
    last = turns[-1][0].setpoint
    assert last is not None
    assert last.z_m == pytest.approx(LOWEST_M)


def test_the_estimates_own_doubt_ends_the_waiting_sooner() -> None:
    turns = flown(state_in(Phase.ALIGN), 0.8, variance_m2=1.1 * BLIND_VARIANCE_M2)
    first = next(i for i, (state, _) in enumerate(turns) if state.phase is Phase.LANDING)
    assert TURN_S * (first + 1) == pytest.approx(HOLD_S, abs=0.05)
    doubtful = unseen(
        BEGIN_S + TURN_S, 1.0, 0.1,
        telemetry=telemetry(BEGIN_S + TURN_S, 1.0, position_variance_m2=1.1 * BLIND_VARIANCE_M2),
    )  # fmt: skip
    assert planner.step_mission(state_in(Phase.ALIGN), doubtful, PROFILE)[0].phase is Phase.ALIGN


def test_a_sight_in_time_goes_on_with_the_flight() -> None:
    state = flown(state_in(Phase.ALIGN), 1.2)[-1][0]
    assert state.hold
    for i in range(40):
        t_s = BEGIN_S + 1.2 + TURN_S * (i + 1)
        state, command = planner.step_mission(state, observation(t_s, 1.0), PROFILE)
        assert isinstance(command, PositionSetpoint)
    assert not state.hold
    assert state.phase is not Phase.LANDING


def test_once_blind_it_stays_so_though_the_target_is_seen_again() -> None:
    """Each change of the mode costs height; and severity does not fall."""
    state = flown(state_in(Phase.ALIGN), LAND_S + 0.2)[-1][0]
    assert state.severity is Severity.LAND
    _, command = planner.step_mission(state, observation(BEGIN_S + 2.0, 0.9), PROFILE)
    assert isinstance(command, RawThrust)


@given(
    vx_mps=st.floats(-1.5, 1.5),
    vy_mps=st.floats(-1.5, 1.5),
    yaw_rad=st.floats(-math.pi, math.pi),
    age_s=st.sampled_from([0.05, 2.0]),
)
def test_it_brakes_the_felt_speed_aside_whether_or_not_the_target_is_seen_again(
    vx_mps: float, vy_mps: float, yaw_rad: float, age_s: float
) -> None:
    """A blow may have thrown it: level it would fly on aside, 2 m and more until the floor. A
    speed that the attitude leaves unsure is left alone."""
    assume(math.hypot(vx_mps, vy_mps) > 0.1)
    state = blind(1.0, (vx_mps, vy_mps, -SINK_MPS))
    tel = telemetry(BEGIN_S + TURN_S, 1.0, velocity_mps=(0.0, 0.0, -0.5), yaw_rad=yaw_rad)
    obs = observation(tel.t_s, telemetry=tel, position_age_s=age_s)
    _, command = planner.step_mission(state, obs, PROFILE)
    assert isinstance(command, RawThrust)
    # Nose down is forwards, roll to the right is to the right (docs/firmware.md).
    ahead, left = command.pitch_rad, -command.roll_rad
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    x, y = ahead * cos - left * sin, ahead * sin + left * cos
    speed_mps = math.hypot(vx_mps, vy_mps)
    assert max(abs(ahead), abs(left)) <= MOST_BRAKE_RAD + 1e-9
    assert x * vx_mps + y * vy_mps <= -0.1 * min(speed_mps, 1.0) * speed_mps
    if speed_mps * BRAKE_RAD_PER_MPS < MOST_BRAKE_RAD:
        assert x * vy_mps - y * vx_mps == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("felt_mps", "lands"), [(0.15, False), (0.25, True)])
def test_a_vehicle_that_moves_otherwise_than_its_estimate_is_not_held_by_it(
    felt_mps: float, lands: bool
) -> None:
    """By such an estimate it would hold its place at that speed: 0.25 m/s is 1 m aside by the
    time it is down."""
    reckoning = Reckoning(imu=ImuMotion(t_s=BEGIN_S), velocity_mps=(felt_mps, 0.0, 0.0))
    begin = replace(state_in(Phase.RECOVER), t_s=BEGIN_S, reckoning=reckoning)
    obs = unseen(BEGIN_S + TURN_S, 1.0, 0.6, imu=ImuMotion(t_s=BEGIN_S + TURN_S))
    state, _ = planner.step_mission(begin, obs, PROFILE)
    assert (state.row == "position-lost") is lands


@given(aside_g=st.floats(-1.0, 1.0), ahead_g=st.floats(-1.0, 1.0), yaw_rad=st.floats(-3.1, 3.1))
def test_a_blow_that_only_the_accelerometer_feels_ends_the_waiting_and_is_braked(
    aside_g: float, ahead_g: float, yaw_rad: float
) -> None:
    """For 0.1 s without a sight: sideways the estimate feels none of it."""
    felt, state, blows_s = Felt(), state_in(Phase.ALIGN), (0.2, 0.3)
    gained_mps = 9.81 * 0.1 * math.hypot(aside_g, ahead_g)
    for i in range(1, 30):
        passed_s = TURN_S * i
        blown = blows_s[0] < passed_s <= blows_s[1] + 1e-9
        tel = telemetry(
            BEGIN_S + passed_s, yaw_rad=yaw_rad,
            acc_x_g=ahead_g if blown else 0.0, acc_y_g=aside_g if blown else 0.0,
        )  # fmt: skip
        obs = unseen(tel.t_s, 1.0, max(0.01, passed_s - 0.1), telemetry=tel)
        state, command = planner.step_mission(state, felt(obs), PROFILE)
        if state.phase is Phase.LANDING:
            break
    if abs(gained_mps - BLOWN_MPS) < 0.05:
        return
    assert (state.phase is Phase.LANDING) is (gained_mps > BLOWN_MPS)
    if state.phase is Phase.LANDING:
        assert state.row == "position-lost"
        assert passed_s >= 0.1 + CORRECTED_S
        assert isinstance(command, RawThrust)
        assert command.pitch_rad * ahead_g <= 1e-3
        assert command.roll_rad * aside_g >= -1e-3


@pytest.mark.parametrize(
    ("silence_s", "way_m", "ends"),
    [(0.1, 0.0, Phase.PERCHED), (0.3, 0.0, Phase.PERCHED), (0.3, -0.3, Phase.ABORTED)],
)
def test_what_was_stopped_as_it_hung_and_has_not_fallen_since_hangs(
    silence_s: float, way_m: float, ends: Phase
) -> None:
    """The operator lands what is being watched after its stop: nothing is taken from the magnet,
    and without a position of its own it is no landing. A silence may hide a fall, unless the
    estimate shows none."""
    state, felt = replace(
        state_in(Phase.LANDING, z_m=1.9),
        contact_z_m=1.9, released_s=BEGIN_S - 4.0, stopped_s=BEGIN_S - 1.0, orders=5,
        reach_s=BEGIN_S - 6.0,
    ), Felt()  # fmt: skip
    for i in range(1, 150):
        t_s = BEGIN_S + TURN_S * i
        heard_s = t_s if not 0.5 < TURN_S * i <= 0.5 + silence_s else BEGIN_S + 0.5
        z_m = 1.9 + (way_m if heard_s > BEGIN_S + 0.5 else 0.0)
        tel = telemetry(heard_s, z_m, thrust=0.0, supervisor=READY)
        obs = unseen(t_s, 1.9, 0.6 + TURN_S * i, telemetry=tel, target=None)
        if TURN_S * i < 0.6:
            obs = replace(obs, telemetry=replace(tel, thrust=1.0))  # not seen to be off yet
        state, command = planner.step_mission(state, felt(obs), PROFILE)
        if state.phase.is_over:
            break
        assert not isinstance(command, Land | PositionSetpoint | RawThrust)
    assert state.phase is ends, state.reason


def test_what_slips_off_the_magnet_has_its_whole_way_down_before_it() -> None:
    """Blind for long while it hung, it would have less and less thrust at once, and fall."""
    hung = blind(1.5, (0.0, 0.0, -SINK_MPS), blind_s=BEGIN_S - 8.0, level_thrust=HOVER_THRUST)
    thrusts = []
    for entered_s in (BEGIN_S - 1.0, BEGIN_S - 8.0):
        obs = unseen(BEGIN_S + TURN_S, 1.5, 6.0)
        _, command = planner.step_mission(replace(hung, entered_s=entered_s), obs, PROFILE)
        assert isinstance(command, RawThrust)
        thrusts.append(command.thrust)
    assert thrusts[0] == pytest.approx(HOVER_THRUST, abs=0.02 * HOVER_THRUST)
    assert thrusts[1] < thrusts[0]


def test_a_landing_that_loses_it_goes_on_blindly() -> None:
    state, _ = planner.step_mission(
        state_in(Phase.ALIGN), observation(BEGIN_S + TURN_S, operator=Operator.LAND), PROFILE
    )
    assert state.phase is Phase.LANDING
    assert state.blind_s is None
    state, command = planner.step_mission(state, unseen(BEGIN_S + 2.0, 0.9, LAND_S + 0.1), PROFILE)
    assert state.blind_s is not None
    assert isinstance(command, RawThrust)


def test_a_landing_of_its_own_near_the_floor_is_left_to_its_end() -> None:
    """A change of the mode a hand above the floor would drop it."""
    mocap = Profile.model_validate({"positioning": "mocap"})
    state = replace(
        state_in(Phase.LANDING, z_m=0.3), entered_s=BEGIN_S - 6.0, orders=1, ordered_s=BEGIN_S
    )
    for i in range(1, 40):
        obs = unseen(BEGIN_S + TURN_S * i, 0.25, LAND_S + TURN_S * i)
        state, command = planner.step_mission(state, obs, mocap)
        assert isinstance(command, Land | Idle)


def test_how_long_it_may_take_counts_from_the_loss_and_not_from_the_landing() -> None:
    state = blind(0.8, (0.0, 0.0, -SINK_MPS), entered_s=BEGIN_S - 20.0, level_thrust=HOVER_THRUST)
    _, command = planner.step_mission(state, unseen(BEGIN_S + TURN_S, 0.8, 2.5), PROFILE)
    assert isinstance(command, RawThrust)
    assert command.thrust > 0.97 * HOVER_THRUST


@pytest.mark.parametrize(("entered_s", "falls"), [(BEGIN_S, False), (BEGIN_S - 2.0, True)])
def test_a_speed_from_before_it_was_held_unheard_is_none_any_more(
    entered_s: float, falls: bool
) -> None:
    """Silent in a climb of 0.7 m/s, it is held for a second, and then let down as what hovers. In a
    way down that was heard so far the last speed is the present one."""
    state = blind(1.0, (0.0, 0.0, 0.7), entered_s=entered_s, level_thrust=HOVER_THRUST)
    tel = telemetry(BEGIN_S - 1.1, 1.0, velocity_mps=(0.0, 0.0, 0.7))
    _, command = planner.step_mission(
        state, unseen(BEGIN_S + TURN_S, 1.0, 2.0, telemetry=tel), PROFILE
    )
    assert isinstance(command, RawThrust)
    assert (command.thrust < 0.75 * HOVER_THRUST) is falls


@pytest.mark.parametrize(("within", "overdue"), [(UNLEARNED_WITHIN, False), (HOVER_WITHIN, True)])
def test_unheard_its_time_begins_after_its_own_estimate_has_flown_it(
    within: float, overdue: bool
) -> None:
    """Else it would have less and less thrust as soon as thrust flies it, and fall."""
    heard_s = BEGIN_S - 3.0
    state = blind(
        0.3, (0.0, 0.0, -0.4), blind_s=BEGIN_S - 2.0, entered_s=BEGIN_S - 2.0, level_within=within,
        level_thrust=0.9 * HOVER_THRUST, entry_m=(0.0, 0.0, 0.3), under_way_mps=-0.4,
    )  # fmt: skip
    tel = telemetry(heard_s, 0.3)
    state, command = planner.step_mission(
        state, unseen(BEGIN_S + TURN_S, 0.3, 3.0, telemetry=tel), PROFILE
    )
    assert isinstance(command, RawThrust)
    assert (command.thrust < 0.9 * HOVER_THRUST) is overdue


@pytest.mark.parametrize(
    ("below_m", "fell_ago_s", "goes"),
    [(0.0, math.inf, True), (0.0, 0.5, False), (0.1, math.inf, False)],
)
def test_what_an_impact_left_of_a_speed_goes_while_it_rests_at_its_contact(
    below_m: float, fell_ago_s: float, goes: bool
) -> None:
    """Reckoned on, it would be 0.1 m/s for all of a way down, and half a metre of its height. What
    has not come to its target yet is moved by a gust."""
    felt, state = Felt(), blind(1.0, (0.0, 0.0, -0.12), contact_z_m=1.0)
    begun = felt(unseen(BEGIN_S, 1.0, 2.0))
    state = replace(state, reckoning=replace(state.reckoning, imu=begun.imu, below_m=below_m))
    for i in range(1, 30):
        obs = felt(unseen(BEGIN_S + TURN_S * i, 1.0, 2.0))
        obs = replace(obs, imu=replace(obs.imu, fell_s=obs.t_s - fell_ago_s))
        state, _ = planner.step_mission(state, obs, PROFILE)
    rests = state.reckoning.velocity_mps == (0.0, 0.0, 0.0)
    assert rests is goes


@given(aside_g=st.floats(-1.5, 1.5), ahead_g=st.floats(-1.5, 1.5), yaw_rad=st.floats(-3.1, 3.1))
def test_a_blow_from_the_side_is_no_rest_though_it_hangs_at_its_contact(
    aside_g: float, ahead_g: float, yaw_rad: float
) -> None:
    """The magnet holds its height for some moments while the blow knocks it off: all of the speed
    that it leaves is reckoned, but for what an accelerometer at rest drifts by."""
    felt, state = Felt(), blind(1.0, (0.0, 0.0, 0.0), contact_z_m=1.0)
    begun = felt(unseen(BEGIN_S, 1.0, 2.0))
    state = replace(state, reckoning=replace(state.reckoning, imu=begun.imu, below_m=0.0))
    for i in range(1, 30):
        blown = i > 25
        tel = telemetry(
            BEGIN_S + TURN_S * i, 1.0, yaw_rad=yaw_rad,
            acc_x_g=ahead_g if blown else 0.0, acc_y_g=aside_g if blown else 0.0,
            acc_z_g=1.0 + 0.001 * (i % 2),
        )  # fmt: skip
        obs = felt(unseen(tel.t_s, 1.0, 2.0, telemetry=tel))
        state, _ = planner.step_mission(state, obs, PROFILE)
    gained_mps = 9.81 * 3.5 * TURN_S * math.hypot(aside_g, ahead_g)  # the first by its half
    x_mps, y_mps, _ = state.reckoning.velocity_mps
    assert math.hypot(x_mps, y_mps) >= gained_mps - 1.5 * STEADY_ASIDE_MPS


@given(wrong_rad=st.floats(-0.08, 0.08), yaw_rad=st.floats(-3.1, 3.1))
def test_a_wrong_attitude_is_no_blow_while_it_hangs(wrong_rad: float, yaw_rad: float) -> None:
    """It makes up to 0.8 m/s each second that are none, and a catch would brake them."""
    felt, state = Felt(), blind(1.0, (0.0, 0.0, 0.0), contact_z_m=1.0)
    begun = felt(unseen(BEGIN_S, 1.0, 2.0))
    state = replace(state, reckoning=replace(state.reckoning, imu=begun.imu, below_m=0.0))
    for i in range(1, 100):
        tel = telemetry(
            BEGIN_S + TURN_S * i, 1.0, yaw_rad=yaw_rad, pitch_rad=wrong_rad,
            acc_z_g=1.0 + 0.001 * (i % 2),
        )  # fmt: skip
        state, _ = planner.step_mission(
            state, felt(unseen(tel.t_s, 1.0, 2.0, telemetry=tel)), PROFILE
        )
        if i > 30:
            assert state.reckoning.velocity_mps == (0.0, 0.0, 0.0)


@given(x_mps=st.floats(-2.0, 2.0), y_mps=st.floats(-2.0, 2.0))
def test_a_catch_brakes_a_speed_aside_that_the_estimate_has_not(x_mps: float, y_mps: float) -> None:
    """Knocked off the magnet it is caught by position, and the position mode would tilt it by its
    estimate, which has felt no blow: the setpoint asks for the opposite of what that lacks."""
    unknown_mps = math.hypot(x_mps, y_mps)
    assume(abs(unknown_mps - BLOWN_MPS) > 0.01)
    t_s = BEGIN_S + TURN_S
    imu = ImuMotion(t_s=BEGIN_S)
    state = replace(
        state_in(Phase.LANDING, z_m=1.9), contact_z_m=1.9, released_s=BEGIN_S - 1.0,
        reach_s=BEGIN_S - 6.0, blind_s=BEGIN_S - 3.0,
        reckoning=Reckoning(imu=imu, velocity_mps=(x_mps, y_mps, -0.5)),
    )  # fmt: skip
    falls = telemetry(t_s, 1.85, velocity_mps=(0.0, 0.0, -0.5), acc_z_g=0.2, thrust=0.0)
    obs = unseen(t_s, 1.85, 2.0, telemetry=falls, imu=replace(imu, t_s=t_s))
    state, command = planner.step_mission(state, obs, PROFILE)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > 1.85
    x_m, y_m, _ = falls.position_m
    ahead_m, aside_m = command.x_m - x_m, command.y_m - y_m
    if unknown_mps > BLOWN_MPS:
        for way_m, mps in ((ahead_m, x_mps), (aside_m, y_mps)):
            braked_mps = max(-MOST_BRAKED_MPS, min(MOST_BRAKED_MPS, mps))
            assert way_m == pytest.approx(-braked_mps / POSITION_GAIN_PER_S, abs=0.02)
    else:
        assert (ahead_m, aside_m) == (0.0, 0.0)


@pytest.mark.parametrize("hover", [0.0, HOVER_THRUST])
def test_blind_from_the_take_off_it_has_a_thrust_to_come_down_on(hover: float) -> None:
    state = replace(state_in(Phase.APPROACH, z_m=0.3), hover_thrust=hover)
    after, command = planner.step_mission(state, unseen(BEGIN_S + TURN_S, 0.3, math.inf), PROFILE)
    assert after.phase is Phase.LANDING
    assert after.hover_thrust > 0.0
    assert isinstance(command, RawThrust | Land)


@given(felt_g=st.floats(0.8, 1.2))
def test_a_hover_thrust_that_was_not_learned_yet_is_felt(felt_g: float) -> None:
    """What just sinks is carried by less than its weight; flown on that it would fall."""
    state = replace(state_in(Phase.APPROACH, z_m=0.3), hover_thrust=0.0)
    tel = telemetry(BEGIN_S + TURN_S, 0.3, thrust=felt_g * HOVER_THRUST, acc_z_g=felt_g)
    after, _ = planner.step_mission(
        state, unseen(BEGIN_S + TURN_S, 0.3, LAND_S + 0.1, telemetry=tel), PROFILE
    )
    assert after.blind_s is not None
    assert after.hover_thrust == pytest.approx(HOVER_THRUST, rel=0.1)


@given(speed_mps=st.floats(-1.2, 0.3))
def test_blind_it_brakes_what_sinks_faster_than_it_should(speed_mps: float) -> None:
    """By the felt speed, whatever the estimate says."""
    state = blind(1.0, (0.0, 0.0, speed_mps))
    tel = telemetry(BEGIN_S + TURN_S, 1.0, velocity_mps=(0.0, 0.0, 0.5))
    _, command = planner.step_mission(state, unseen(tel.t_s, 1.0, 2.0, telemetry=tel), PROFILE)
    assert isinstance(command, RawThrust)
    beside = abs(speed_mps + SINK_MPS) < 0.02
    assert beside or (command.thrust > HOVER_THRUST) == (speed_mps < -SINK_MPS)


@pytest.mark.parametrize(
    ("in_reach", "silence_s", "ends"),
    [(False, 0.0, Phase.LANDED), (True, 0.0, Phase.PERCHED), (True, 0.3, Phase.ABORTED)],
)
def test_a_blind_way_down_whose_speed_has_drifted_ends_all_the_same(
    in_reach: bool, silence_s: float, ends: Phase
) -> None:
    """By its reckoning it sinks for ever, at the speed that is wanted; something has carried it
    for long. That may be the magnet only where it began in its reach, and is, as long as no fall
    is felt and no silence could hide one."""
    state, felt = blind(1.0, contact_z_m=1.0 if in_reach else None), Felt()
    began = felt(unseen(BEGIN_S, 1.0, 2.0))
    reckoning = Reckoning(imu=began.imu, velocity_mps=(0.0, 0.0, -SINK_MPS))
    state = replace(state, reckoning=reckoning, reach_s=BEGIN_S if in_reach else None)
    thrust, stopped = HOVER_THRUST, False
    for i in range(1, 1000):
        t_s = BEGIN_S + TURN_S * i
        heard_s = t_s if not 1.0 < TURN_S * i <= 1.0 + silence_s else BEGIN_S + 1.0
        fallen_m = 0.4 if 1.0 + silence_s < TURN_S * i and silence_s else 0.0
        tel = telemetry(
            heard_s, 1.0 - 0.01 * i - fallen_m, thrust=thrust, velocity_mps=(0.0, 0.0, -SINK_MPS),
            supervisor=READY if stopped else AIRBORNE,
        )  # fmt: skip
        obs = felt(unseen(t_s, 1.0, 2.0, telemetry=tel, target=None))
        state, command = planner.step_mission(state, obs, PROFILE)
        assert not isinstance(command, Land)
        stopped |= isinstance(command, StopMotors)
        thrust = float(command.thrust) if isinstance(command, RawThrust) else thrust
        thrust = 0.0 if stopped else thrust
        if state.phase.is_over:
            break
    assert stopped
    assert state.phase is ends, state.reason


# --- the last centimetres ------------------------------------------------------------------


def test_a_press_without_a_contact_backs_off_before_dead_reckoning_leads_aside() -> None:
    turns = flown(state_in(Phase.PERCH, z_m=2.1), 1.4, 2.1)
    rows = [state.row for state, _ in turns if state.phase is Phase.RECOVER]
    assert rows[0] == "pressed-blindly"
    assert turns[-1][0].attempts == 1
    assert "after the last sight" in turns[-1][0].reason


def test_by_other_means_a_press_has_the_time_that_it_always_had() -> None:
    state = state_in(Phase.PERCH, z_m=2.1)
    after, _ = planner.step_mission(state, unseen(BEGIN_S + TURN_S, 2.1, 1.3), Profile())
    assert after.row != "pressed-blindly"


def pressed_past_the_sight(
    aside_m: float = 0.0, sigma_m: float = 1e-3, climb_mps: float = 0.0
) -> PlannerState:
    """The last sight was 4.5 cm below the target. From there on the estimate sinks at 0.1 m/s, as
    after an impact, and the accelerometer feels `climb_mps` more each second; it holds."""
    felt, state = Felt(), state_in(Phase.PERCH, z_m=HANG_Z_M - 0.045)
    for i in range(round(0.9 / TURN_S)):
        t_s = BEGIN_S + TURN_S * (i + 1)
        z_m = HANG_Z_M - 0.045 - 0.1 * TURN_S * i
        tel = telemetry(
            t_s, z_m, velocity_mps=(0.0, 0.0, -0.1 if i else 0.0), thrust=1.1 * HOVER_THRUST,
            acc_z_g=1.0 + climb_mps / GRAVITY_MPS2,
        )  # fmt: skip
        target = target_at(
            t_s, (aside_m, 0.0, CEILING_M), tel.position_m, measured=not i,
            measured_s=BEGIN_S + TURN_S, sigma_m=np.full(3, sigma_m),
        )  # fmt: skip
        obs = observation(
            t_s, telemetry=tel, target=target, new_frame=not i, position_age_s=TURN_S * i
        )
        state, _ = planner.step_mission(state, felt(obs), PROFILE)
        if state.phase is not Phase.PERCH:
            break
    return state


def test_a_contact_that_holds_is_proven_past_the_last_sight_by_what_is_felt() -> None:
    """Though the estimate sinks, and half a second later places nothing any more."""
    state = pressed_past_the_sight()
    assert (state.phase, state.row) == (Phase.COMPLETE, "contact")
    assert state.entered_s - BEGIN_S > HOLD_S
    assert pressed_past_the_sight(climb_mps=0.5).phase is Phase.PERCH  # it rises still


@pytest.mark.parametrize(
    ("of_hover", "below_m", "age_s", "phase", "within"),
    [
        (1.25, 0.2, 0.0, Phase.RECOVER, True),
        (0.8, 0.2, 0.0, Phase.RECOVER, True),
        (1.0, 0.2, 0.0, Phase.RECOVER, False),
        (1.25, 0.2, 0.6, Phase.RECOVER, True),  # and it is held in place
        (1.25, 0.5, 0.0, Phase.RECOVER, False),  # by something else
        (0.8, 0.2, 0.0, Phase.LANDING, False),  # by a hover thrust that is wrong
    ],
)
def test_what_is_felt_to_be_held_is_within_reach_whatever_late_pictures_say(
    of_hover: float, below_m: float, age_s: float, phase: Phase, within: bool
) -> None:
    """They have the target above. In the air so much thrust would lift it, or so little let it
    sink, and from there no way down is told that nobody felt."""
    felt, state, z_m = Felt(), state_in(phase, z_m=HANG_Z_M - below_m), HANG_Z_M - below_m
    for i in range(round(0.9 / TURN_S)):
        t_s = BEGIN_S + TURN_S * (i + 1)
        tel = telemetry(t_s, z_m, thrust=of_hover * HOVER_THRUST)
        target = target_at(t_s, body_m=tel.position_m)
        obs = observation(
            t_s, telemetry=tel, target=target, new_frame=TURN_S * i < 0.2, position_age_s=age_s
        )
        state, _ = planner.step_mission(state, felt(obs), PROFILE)
    assert (state.reach_s is not None) is within
    if within:
        landing = lander.begun(state, obs, PROFILE)
        assert lander.reach_of(Context(landing, obs, PROFILE)) is lander.Reach.MAGNET


@pytest.mark.parametrize(("aside_m", "sigma_m"), [(0.03, 1e-3), (0.02, 0.01), (0.0, math.inf)])
def test_a_contact_beside_the_magnet_or_nobody_knows_where_is_none(
    aside_m: float, sigma_m: float
) -> None:
    state = pressed_past_the_sight(aside_m, sigma_m)
    assert (state.phase, state.row, state.attempts) == (Phase.RECOVER, "beside-the-magnet", 1)


# --- Without a heading: level, on the vertical speed alone ----------------------------------------


DT_S = 0.02
TURNED_RAD = 1.5


def heading_lost(phase: Phase = Phase.LANDING) -> PlannerState:
    return replace(state_in(phase, z_m=1.0), heading_lost=True, hover_thrust=HOVER_THRUST)


@pytest.mark.parametrize("phase", sorted(BEFORE_CONTACT, key=lambda p: p.value))
def test_a_heading_that_jumps_ends_position_control_at_once(phase: Phase) -> None:
    """With a heading that is far off, a position setpoint leads away from its place."""
    state, command = planner.step_mission(
        state_in(phase), observation(10.02, 1.0, jumped=True, turned_rad=TURNED_RAD), DECKS
    )
    assert state.phase is Phase.LANDING
    assert state.heading_lost
    assert isinstance(command, RawThrust)


def test_a_small_step_of_the_heading_is_held_as_any_other() -> None:
    obs = observation(10.02, 1.0, jumped=True, turned_rad=0.4)
    state, command = planner.step_mission(state_in(Phase.ALIGN), obs, DECKS)
    assert not state.heading_lost
    assert state.hold
    assert isinstance(command, PositionSetpoint)


@given(speed_mps=st.floats(-1.5, 0.5))
def test_it_brakes_what_sinks_fast_and_lets_sink_what_does_not(speed_mps: float) -> None:
    tel = telemetry(10.02, 1.0, velocity_mps=(0.0, 0.0, speed_mps))
    _, command = planner.step_mission(heading_lost(), observation(10.02, telemetry=tel), DECKS)
    assert isinstance(command, RawThrust)
    beside = abs(speed_mps + SINK_MPS) < 0.02
    assert beside or (command.thrust > HOVER_THRUST) == (speed_mps < -SINK_MPS)
    assert command.thrust <= 60000  # more is clipped
    assert (command.roll_rad, command.pitch_rad) == (0.0, 0.0)


def test_what_does_not_sink_gets_less_until_the_floor_proves_itself() -> None:
    state = heading_lost()
    thrust = HOVER_THRUST
    for i in range(1, 300):
        tel = telemetry(10.0 + DT_S * i, 0.05, thrust=thrust)
        state, command = planner.step_mission(state, observation(tel.t_s, telemetry=tel), DECKS)
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
    _, command = planner.step_mission(heading_lost(), observation(10.02, telemetry=tel), DECKS)
    assert isinstance(command, Land)
