"""The target is the positioning system, and is not seen any more: hold, sink, down blindly."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import planner
from perchctl.mission.context import PUT_RIGHT_S
from perchctl.mission.hold import BLIND_VARIANCE_M2, LOWEST_M
from perchctl.mission.level import BLIND_SINK_MPS, MOST_BRAKE_RAD
from perchctl.mission.state import Condition, Observation, Operator, Phase, PlannerState, Severity
from perchctl.profile import Profile
from perchctl.vehicle import Command, Land, PositionSetpoint, RawThrust, StopMotors
from tests.helpers.mission import AIRBORNE, HOVER_THRUST, READY, observation, state_in, telemetry

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
        state, command = planner.step(state, unseen(t_s, z_m, TURN_S * i, telemetry=tel), PROFILE)
        turns.append((state, command))
    return turns


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
    after, _ = planner.step(
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
    assert planner.step(state_in(Phase.ALIGN), doubtful, PROFILE)[0].phase is Phase.ALIGN


def test_a_sight_in_time_goes_on_with_the_flight() -> None:
    state = flown(state_in(Phase.ALIGN), 1.2)[-1][0]
    assert state.hold
    for i in range(40):
        t_s = BEGIN_S + 1.2 + TURN_S * (i + 1)
        state, command = planner.step(state, observation(t_s, 1.0), PROFILE)
        assert isinstance(command, PositionSetpoint)
    assert not state.hold
    assert state.phase is not Phase.LANDING


def test_once_blind_it_stays_so_though_the_target_is_seen_again() -> None:
    """Each change of the mode costs height; and severity does not fall."""
    state = flown(state_in(Phase.ALIGN), LAND_S + 0.2)[-1][0]
    assert state.severity is Severity.LAND
    _, command = planner.step(state, observation(BEGIN_S + 2.0, 0.9), PROFILE)
    assert isinstance(command, RawThrust)


@given(
    vx_mps=st.floats(-1.5, 1.5),
    vy_mps=st.floats(-1.5, 1.5),
    yaw_rad=st.floats(-math.pi, math.pi),
    pushed=st.booleans(),
)
def test_seen_again_it_brakes_what_carries_it_aside(
    vx_mps: float, vy_mps: float, yaw_rad: float, pushed: bool
) -> None:
    """A blow may have thrown it, and its attitude been wrong as it hung: level it would fly on
    aside, 2 m and more until the floor. Without a sight nothing is known of that: level."""
    state = flown(state_in(Phase.ALIGN), LAND_S + 0.2)[-1][0]
    for i in range(1, 60):
        t_s = BEGIN_S + LAND_S + 0.2 + TURN_S * i
        tel = telemetry(t_s, 1.0, velocity_mps=(vx_mps, vy_mps, -0.5), yaw_rad=yaw_rad)
        age_s = LAND_S + 0.2 + TURN_S * i if pushed else 0.05
        obs = observation(t_s, telemetry=tel, position_age_s=age_s)
        state, command = planner.step(state, obs, PROFILE)
        assert isinstance(command, RawThrust)
        if pushed or TURN_S * i < PUT_RIGHT_S:
            assert command == RawThrust(command.thrust)
    if pushed:
        return
    # Nose down is forwards, roll to the right is to the right (docs/firmware.md).
    ahead, left = command.pitch_rad, -command.roll_rad
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    x, y = ahead * cos - left * sin, ahead * sin + left * cos
    speed_mps = math.hypot(vx_mps, vy_mps)
    assert math.hypot(x, y) <= math.sqrt(2.0) * MOST_BRAKE_RAD + 1e-9
    assert x * vx_mps + y * vy_mps <= -0.05 * min(speed_mps, 1.0) * speed_mps
    if speed_mps < 1.0:
        assert x * vy_mps - y * vx_mps == pytest.approx(0.0, abs=1e-9)


def test_what_was_stopped_as_it_hung_and_is_carried_since_hangs() -> None:
    """The operator lands what is being watched after its stop: nothing is taken from the magnet,
    and without a position of its own it is no landing. With a gap it may lie on the floor."""
    for hangs_s, ends in ((BEGIN_S - 3.0, Phase.PERCHED), (BEGIN_S - 0.5, Phase.ABORTED)):
        state = replace(
            state_in(Phase.LANDING, z_m=1.9),
            contact_z_m=1.9, released_s=BEGIN_S - 4.0, stopped_s=BEGIN_S - 1.0,
            orders=5, since={Condition.WEIGHT_HANGS: hangs_s},
        )  # fmt: skip
        for i in range(1, 150):
            t_s = BEGIN_S + TURN_S * i
            tel = telemetry(t_s, 1.9, thrust=0.0, supervisor=READY)
            obs = unseen(t_s, 1.9, 0.6 + TURN_S * i, telemetry=tel)
            state, command = planner.step(state, obs, PROFILE)
            if planner.is_over(state):
                break
            assert not isinstance(command, Land | PositionSetpoint | RawThrust)
        assert state.phase is ends, state.reason


def test_what_slips_off_the_magnet_has_its_whole_way_down_before_it() -> None:
    """Blind for long while it hung, it would have less and less thrust at once, and fall."""
    hung = replace(
        state_in(Phase.LANDING, z_m=2.0),
        blind_s=BEGIN_S - 6.0, entered_s=BEGIN_S - 1.0, hover_thrust=HOVER_THRUST, caught=True,
    )  # fmt: skip
    thrusts = []
    for state in (hung, replace(hung, entered_s=BEGIN_S - 6.0)):
        tel = telemetry(BEGIN_S + TURN_S, 1.5, velocity_mps=(0.0, 0.0, -0.5))
        obs = unseen(BEGIN_S + TURN_S, 1.5, 6.0, telemetry=tel)
        _, command = planner.step(replace(state, level_thrust=HOVER_THRUST), obs, PROFILE)
        assert isinstance(command, RawThrust)
        thrusts.append(command.thrust)
    assert thrusts[0] == pytest.approx(HOVER_THRUST, abs=0.02 * HOVER_THRUST)
    assert thrusts[1] < thrusts[0]


def test_a_landing_that_loses_it_goes_on_blindly() -> None:
    state, _ = planner.step(
        state_in(Phase.ALIGN), observation(BEGIN_S + TURN_S, operator=Operator.LAND), PROFILE
    )
    assert state.phase is Phase.LANDING
    assert state.blind_s is None
    state, command = planner.step(state, unseen(BEGIN_S + 2.0, 0.9, LAND_S + 0.1), PROFILE)
    assert state.blind_s is not None
    assert isinstance(command, RawThrust)


def test_a_landing_of_its_own_near_the_floor_is_left_to_its_end() -> None:
    """A change of the mode a hand above the floor would drop it."""
    state = replace(
        state_in(Phase.LANDING, z_m=0.3), entered_s=BEGIN_S - 6.0, orders=1, ordered_s=BEGIN_S
    )
    for i in range(1, 40):
        obs = unseen(BEGIN_S + TURN_S * i, 0.25, LAND_S + TURN_S * i)
        state, command = planner.step(state, obs, PROFILE)
        assert not isinstance(command, RawThrust)
    assert state.blind_s is None


def test_how_long_it_may_take_counts_from_the_loss_and_not_from_the_landing() -> None:
    state = replace(
        state_in(Phase.LANDING),
        entered_s=BEGIN_S - 20.0,
        blind_s=BEGIN_S,
        level_thrust=HOVER_THRUST,
    )
    tel = telemetry(BEGIN_S + 1.0, 0.8, velocity_mps=(0.0, 0.0, -BLIND_SINK_MPS))
    _, command = planner.step(state, unseen(BEGIN_S + 1.0, 0.8, 2.5, telemetry=tel), PROFILE)
    assert isinstance(command, RawThrust)
    assert command.thrust > 0.97 * HOVER_THRUST


@pytest.mark.parametrize("hover", [0.0, HOVER_THRUST])
def test_blind_from_the_take_off_it_has_a_thrust_to_come_down_on(hover: float) -> None:
    state = replace(state_in(Phase.APPROACH, z_m=0.3), hover_thrust=hover)
    after, command = planner.step(state, unseen(BEGIN_S + TURN_S, 0.3, math.inf), PROFILE)
    assert after.phase is Phase.LANDING
    assert after.hover_thrust > 0.0
    assert isinstance(command, RawThrust | Land)


@given(felt_g=st.floats(0.8, 1.2))
def test_a_hover_thrust_that_was_not_learned_yet_is_felt(felt_g: float) -> None:
    """What just sinks is carried by less than its weight; flown on that it would fall."""
    state = replace(state_in(Phase.APPROACH, z_m=0.3), hover_thrust=0.0)
    tel = telemetry(BEGIN_S + TURN_S, 0.3, thrust=felt_g * HOVER_THRUST, acc_z_g=felt_g)
    after, _ = planner.step(
        state, unseen(BEGIN_S + TURN_S, 0.3, LAND_S + 0.1, telemetry=tel), PROFILE
    )
    assert after.blind_s is not None
    assert after.hover_thrust == pytest.approx(HOVER_THRUST, rel=0.1)


@given(speed_mps=st.floats(-1.2, 0.3))
def test_blind_it_brakes_what_sinks_faster_than_it_should(speed_mps: float) -> None:
    state = replace(state_in(Phase.LANDING), blind_s=BEGIN_S)
    tel = telemetry(BEGIN_S + TURN_S, 1.0, velocity_mps=(0.0, 0.0, speed_mps))
    _, command = planner.step(state, unseen(BEGIN_S + TURN_S, 1.0, 2.0, telemetry=tel), PROFILE)
    assert isinstance(command, RawThrust)
    beside = abs(speed_mps + BLIND_SINK_MPS) < 0.02
    assert beside or (command.thrust > HOVER_THRUST) == (speed_mps < -BLIND_SINK_MPS)


@pytest.mark.parametrize(("in_reach", "ends"), [(False, Phase.LANDED), (True, Phase.ABORTED)])
def test_a_blind_way_down_whose_speed_has_drifted_ends_on_the_floor_all_the_same(
    in_reach: bool, ends: Phase
) -> None:
    """By its estimate it sinks for ever, at the speed that is wanted; it has stood for long. What
    carries it may be the magnet only where it began in its reach."""
    state = replace(state_in(Phase.LANDING), blind_s=BEGIN_S, blind_in_reach=in_reach)
    thrust, stopped = HOVER_THRUST, False
    for i in range(1, 1000):
        t_s = BEGIN_S + TURN_S * i
        tel = telemetry(
            t_s, 1.0 - 0.01 * i, thrust=thrust, velocity_mps=(0.0, 0.0, -BLIND_SINK_MPS),
            supervisor=READY if stopped else AIRBORNE,
        )  # fmt: skip
        obs = unseen(t_s, 1.0, 2.0, telemetry=tel, target=None)
        state, command = planner.step(state, obs, PROFILE)
        stopped |= isinstance(command, StopMotors)
        thrust = float(command.thrust) if isinstance(command, RawThrust) else thrust
        thrust = 0.0 if stopped else thrust
        if planner.is_over(state):
            break
    assert stopped
    assert state.phase is ends


# --- the last centimetres ------------------------------------------------------------------


def test_a_press_without_a_contact_backs_off_before_dead_reckoning_leads_aside() -> None:
    turns = flown(state_in(Phase.PERCH, z_m=2.1), 1.4, 2.1)
    rows = [state.row for state, _ in turns if state.phase is Phase.RECOVER]
    assert rows[0] == "pressed-blindly"
    assert turns[-1][0].attempts == 1
    assert "after the last sight" in turns[-1][0].reason


def test_by_other_means_a_press_has_the_time_that_it_always_had() -> None:
    state = state_in(Phase.PERCH, z_m=2.1)
    after, _ = planner.step(state, unseen(BEGIN_S + TURN_S, 2.1, 1.3), Profile())
    assert after.row != "pressed-blindly"
