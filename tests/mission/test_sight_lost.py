"""Down without a position or a heading: hold, sink, and level by raw thrust."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import ImuMotion, Observation, Operator, Phase, PlannerState, lander
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
from perchctl.mission.planner import step_mission
from perchctl.mission.state import Severity
from perchctl.mission.table import BLIND_VARIANCE_M2
from perchctl.profile import Profile
from perchctl.vehicle import Command, Idle, Land, PositionSetpoint, RawThrust, StopMotors
from tests.helpers.mission import (
    AIRBORNE,
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    MOCAP,
    READY,
    Felt,
    state_in,
    target_at,
    telemetry,
)
from tests.helpers.mission import BY_TARGET as PROFILE
from tests.helpers.mission import PROFILE as DECKS
from tests.mission.rig import BEGIN_S, TICK_S, Flight, Look, Motors, at, fly, is_setpoint

HOLD_S, LAND_S = PROFILE.positioning.hold_s, PROFILE.positioning.land_s
IN_THE_AIR = (
    Phase.APPROACH, Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER,
)  # fmt: skip


def unseen(z_m: float, since_s: float = 0.0, for_s: float | None = None, **tel: Any) -> Look:
    """The target is not seen since `since_s` before the begin, or at each time for `for_s`."""

    def look(t_s: float) -> Observation:
        obs = {
            "position_age_s": t_s - BEGIN_S + since_s if for_s is None else for_s,
            "position_problem": "the target is not seen",
            "new_frame": False,
        }
        return at(z_m, obs=obs, **tel)(t_s)

    return look


def blinded(
    z_m: float, velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0), **changes: object
) -> PlannerState:
    """On its way down by accelerometer and attitude alone, with that reckoned speed."""
    reckoning = Reckoning(imu=ImuMotion(t_s=BEGIN_S), velocity_mps=velocity_mps)
    state = replace(
        state_in(Phase.LANDING, z_m=z_m), blind_s=BEGIN_S, blind_height_m=z_m,
        severity=Severity.LAND, reckoning=reckoning,
    )  # fmt: skip
    return replace(state, **changes)  # type: ignore[arg-type]


def lost(state: PlannerState, lasts_s: float, z_m: float = 1.0, **tel: Any) -> Flight:
    """Turn by turn, without a sight from the first one on."""
    return fly(state, unseen(z_m, **{"position_variance_m2": 1e-3, **tel}), lasts_s, PROFILE)


def test_a_target_has_its_own_patience() -> None:
    assert (HOLD_S, LAND_S) == (0.5, 1.5)
    assert (MOCAP.positioning.hold_s, MOCAP.positioning.land_s) == (0.15, 0.7)
    own = Profile.model_validate({"positioning": {"by": "target", "hold_s": 0.3}})
    assert (own.positioning.hold_s, own.positioning.land_s) == (0.3, 1.5)


@pytest.mark.parametrize("phase", IN_THE_AIR)
def test_it_is_held_then_sinks_and_then_comes_down_level(phase: Phase) -> None:
    height_m = 0.45 if phase is Phase.APPROACH else 1.0
    flight = lost(state_in(phase, z_m=height_m), LAND_S + 0.3, height_m)
    heights: list[float] = []
    for tick in flight.ticks:
        unseen_s = tick.t_s - BEGIN_S
        if unseen_s < LAND_S - 1e-6:
            assert isinstance(tick.command, PositionSetpoint)
            assert tick.state.setpoint is not None
            heights.append(tick.state.setpoint.z_m)
            assert unseen_s <= HOLD_S + TICK_S + 1e-6 or "not seen" in tick.state.hold
        elif unseen_s > LAND_S + TICK_S + 1e-6:
            assert tick.state.phase is Phase.LANDING
            assert isinstance(tick.command, RawThrust)
    blind_m = heights[round(HOLD_S / TICK_S) + 1 :]
    assert all(after <= before for before, after in pairwise(blind_m))
    assert blind_m[-1] < blind_m[0]
    assert flight.state.row == "position-lost"
    assert "down level" in flight.state.reason


@given(age_s=st.floats(0.0, 1.4), z_m=st.floats(0.3, 2.0), phase=st.sampled_from(IN_THE_AIR))
def test_nothing_climbs_without_a_sight(age_s: float, z_m: float, phase: Phase) -> None:
    """Not even a search, which would climb by a position that drifts."""
    state = replace(state_in(phase, z_m=z_m), searches=2, search_step_s=0.0)
    after = fly(state, unseen(z_m, for_s=max(age_s, HOLD_S + 0.01)), profile=PROFILE).state
    assert after.setpoint is None or after.setpoint.z_m <= z_m


def test_sinking_ends_above_the_floor() -> None:
    state = lost(state_in(Phase.ALIGN, z_m=LOWEST_M + 0.05), LAND_S - 0.1, LOWEST_M + 0.05).state
    assert state.setpoint is not None
    assert state.setpoint.z_m == pytest.approx(LOWEST_M)


def test_the_estimates_own_doubt_ends_the_waiting_sooner() -> None:
    doubts = {"position_variance_m2": 1.1 * BLIND_VARIANCE_M2}
    flight = lost(state_in(Phase.ALIGN), 0.8, **doubts)
    first = next(tick for tick in flight.ticks if tick.state.phase is Phase.LANDING)
    assert first.t_s - BEGIN_S == pytest.approx(HOLD_S, abs=0.05)
    soon = fly(state_in(Phase.ALIGN), unseen(1.0, for_s=0.1, **doubts), profile=PROFILE)
    assert soon.state.phase is Phase.ALIGN


def test_a_sight_in_time_goes_on_with_the_flight_and_a_later_one_does_not() -> None:
    """Each change of the mode costs height; and severity does not fall."""
    state = lost(state_in(Phase.ALIGN), 1.2).state
    assert state.hold
    for i in range(40):
        state, command = step_mission(state, at()(BEGIN_S + 1.22 + TICK_S * i), PROFILE)
        assert isinstance(command, PositionSetpoint)
    assert not state.hold
    assert state.phase is not Phase.LANDING
    late = lost(state_in(Phase.ALIGN), LAND_S + 0.2).state
    assert late.severity is Severity.LAND
    assert isinstance(step_mission(late, at(0.9)(BEGIN_S + 2.0), PROFILE)[1], RawThrust)


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
    sinks = {"velocity_mps": (0.0, 0.0, -0.5), "yaw_rad": yaw_rad}
    look = at(obs={"position_age_s": age_s}, **sinks)
    command = fly(blinded(1.0, (vx_mps, vy_mps, -SINK_MPS)), look, profile=PROFILE).command
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
    begin = replace(state_in(Phase.RECOVER), reckoning=reckoning)
    obs = replace(unseen(1.0, for_s=0.6)(BEGIN_S + TICK_S), imu=ImuMotion(t_s=BEGIN_S + TICK_S))
    assert (step_mission(begin, obs, PROFILE)[0].row == "position-lost") is lands


@given(aside_g=st.floats(-1.0, 1.0), ahead_g=st.floats(-1.0, 1.0), yaw_rad=st.floats(-3.1, 3.1))
def test_a_blow_that_only_the_accelerometer_feels_ends_the_waiting_and_is_braked(
    aside_g: float, ahead_g: float, yaw_rad: float
) -> None:
    """For 0.1 s without a sight: sideways the estimate feels none of it."""
    gained_mps = 9.81 * 0.1 * math.hypot(aside_g, ahead_g)
    assume(abs(gained_mps - BLOWN_MPS) >= 0.05)

    def look(t_s: float) -> Observation:
        passed_s = t_s - BEGIN_S
        blown = 0.2 + 1e-6 < passed_s <= 0.3 + 1e-6
        felt = {"acc_x_g": ahead_g, "acc_y_g": aside_g} if blown else {"acc_x_g": 0.0}
        return unseen(1.0, for_s=max(0.01, passed_s - 0.1), yaw_rad=yaw_rad, **felt)(t_s)

    flight = fly(state_in(Phase.ALIGN), look, 0.58, PROFILE, feels=True, one_phase=True)
    assert (flight.state.phase is Phase.LANDING) is (gained_mps > BLOWN_MPS)
    if flight.state.phase is Phase.LANDING:
        assert flight.state.row == "position-lost"
        assert flight.ticks[-1].t_s - BEGIN_S >= 0.1 + CORRECTED_S
        assert isinstance(flight.command, RawThrust)
        assert flight.command.pitch_rad * ahead_g <= 1e-3
        assert flight.command.roll_rad * aside_g >= -1e-3


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
    state = replace(
        state_in(Phase.LANDING, z_m=1.9), contact_z_m=1.9, released_s=BEGIN_S - 4.0,
        stopped_s=BEGIN_S - 1.0, orders=5, reach_s=BEGIN_S - 6.0,
    )  # fmt: skip

    def look(t_s: float) -> Observation:
        passed_s = t_s - BEGIN_S
        silent = 0.5 + 1e-6 < passed_s <= 0.5 + silence_s + 1e-6
        heard_s = BEGIN_S + 0.5 if silent else t_s
        z_m = 1.9 + (way_m if heard_s > BEGIN_S + 0.5 + 1e-6 else 0.0)
        thrust = 1.0 if passed_s < 0.6 - 1e-6 else 0.0  # not seen to be off yet
        tel = telemetry(heard_s, z_m, thrust=thrust, supervisor=READY)
        return replace(unseen(1.9, 0.6)(t_s), telemetry=tel, target=None)

    flight = fly(state, look, 2.98, PROFILE, feels=True)
    assert not any(isinstance(c, Land | PositionSetpoint | RawThrust) for c in flight.commands[:-1])
    assert flight.state.phase is ends, flight.state.reason


def test_a_landing_that_loses_it_goes_on_blindly() -> None:
    ordered = at(obs={"operator": Operator.LAND})
    state = fly(state_in(Phase.ALIGN), ordered, profile=PROFILE).state
    assert state.phase is Phase.LANDING
    assert state.blind_s is None
    state, command = step_mission(state, unseen(0.9, for_s=LAND_S + 0.1)(BEGIN_S + 2.0), PROFILE)
    assert state.blind_s is not None
    assert isinstance(command, RawThrust)


def test_a_landing_of_its_own_near_the_floor_is_left_to_its_end() -> None:
    """A change of the mode a hand above the floor would drop it."""
    state = replace(
        state_in(Phase.LANDING, z_m=0.3), entered_s=BEGIN_S - 6.0, orders=1, ordered_s=BEGIN_S
    )
    flight = fly(state, unseen(0.25, LAND_S), 0.78, MOCAP)
    assert all(isinstance(command, Land | Idle) for command in flight.commands)


def thrust_of(state: PlannerState, look: Look) -> float:
    """The thrust that is ordered in the first tick, as a part of the hover thrust."""
    command = fly(state, look, profile=PROFILE).command
    assert isinstance(command, RawThrust)
    return command.thrust / HOVER_THRUST


@pytest.mark.parametrize(("entered_s", "fresh"), [(BEGIN_S - 1.0, True), (BEGIN_S - 8.0, False)])
def test_what_slips_off_the_magnet_has_its_whole_way_down_before_it(
    entered_s: float, fresh: bool
) -> None:
    """Blind for long while it hung, it would have less and less thrust at once, and fall."""
    hung = blinded(
        1.5, (0.0, 0.0, -SINK_MPS), blind_s=BEGIN_S - 8.0, level_thrust=HOVER_THRUST,
        entered_s=entered_s,
    )  # fmt: skip
    part = thrust_of(hung, unseen(1.5, for_s=6.0))
    assert part == pytest.approx(1.0, abs=0.02)
    assert (part > thrust_of(replace(hung, entered_s=BEGIN_S - 8.0), unseen(1.5, for_s=6.0))) is (
        fresh
    )


def test_how_long_it_may_take_counts_from_the_loss_and_not_from_the_landing() -> None:
    sinks = (0.0, 0.0, -SINK_MPS)
    state = blinded(0.8, sinks, entered_s=BEGIN_S - 20.0, level_thrust=HOVER_THRUST)
    assert thrust_of(state, unseen(0.8, for_s=2.5)) > 0.97


@pytest.mark.parametrize(("entered_s", "falls"), [(BEGIN_S, False), (BEGIN_S - 2.0, True)])
def test_a_speed_from_before_it_was_held_unheard_is_none_any_more(
    entered_s: float, falls: bool
) -> None:
    """Silent in a climb of 0.7 m/s, it is held for a second, and then let down as what hovers. In a
    way down that was heard so far the last speed is the present one."""
    state = blinded(1.0, (0.0, 0.0, 0.7), entered_s=entered_s, level_thrust=HOVER_THRUST)
    unheard = unseen(1.0, for_s=2.0, t_s=BEGIN_S - 1.1, velocity_mps=(0.0, 0.0, 0.7))
    assert (thrust_of(state, unheard) < 0.75) is falls


@pytest.mark.parametrize(("within", "overdue"), [(UNLEARNED_WITHIN, False), (HOVER_WITHIN, True)])
def test_unheard_its_time_begins_after_its_own_estimate_has_flown_it(
    within: float, overdue: bool
) -> None:
    """Else it would have less and less thrust as soon as thrust flies it, and fall."""
    state = blinded(
        0.3, (0.0, 0.0, -0.4), blind_s=BEGIN_S - 2.0, entered_s=BEGIN_S - 2.0, level_within=within,
        level_thrust=0.9 * HOVER_THRUST, entry_m=(0.0, 0.0, 0.3), under_way_mps=-0.4,
    )  # fmt: skip
    assert (thrust_of(state, unseen(0.3, for_s=3.0, t_s=BEGIN_S - 3.0)) < 0.9) is overdue


def rests_at_contact(
    lasts_s: float, speed_mps: float = 0.0, below_m: float = 0.0, fell_ago_s: float = math.inf,
    blow_g: tuple[float, float] = (0.0, 0.0), **tel: Any,
) -> Flight:  # fmt: skip
    """Blind at its contact; a blow from ahead and aside lasts from 0.52 s on."""

    def look(t_s: float) -> Observation:
        i = round((t_s - BEGIN_S) / TICK_S)
        ahead_g, aside_g = blow_g if i > 25 else (0.0, 0.0)
        alive = {"acc_z_g": 1.0 + 0.001 * (i % 2), "acc_x_g": ahead_g, "acc_y_g": aside_g}
        obs = felt(unseen(1.0, for_s=2.0, **alive, **tel)(t_s))
        return replace(obs, imu=replace(obs.imu, fell_s=t_s - fell_ago_s))

    felt = Felt()
    begun = felt(unseen(1.0, for_s=2.0)(BEGIN_S))
    state = blinded(1.0, (0.0, 0.0, speed_mps), contact_z_m=1.0)
    reckoning = replace(state.reckoning, imu=begun.imu, below_m=below_m)
    return fly(replace(state, reckoning=reckoning), look, lasts_s, PROFILE)


@pytest.mark.parametrize(
    ("below_m", "fell_ago_s", "goes"),
    [(0.0, math.inf, True), (0.0, 0.5, False), (0.1, math.inf, False)],
)
def test_what_an_impact_left_of_a_speed_goes_while_it_rests_at_its_contact(
    below_m: float, fell_ago_s: float, goes: bool
) -> None:
    """Reckoned on, it would be 0.1 m/s for all of a way down, and half a metre of its height. What
    has not come to its target yet is moved by a gust."""
    state = rests_at_contact(0.58, -0.12, below_m, fell_ago_s).state
    assert (state.reckoning.velocity_mps == (0.0, 0.0, 0.0)) is goes


@given(aside_g=st.floats(-1.5, 1.5), ahead_g=st.floats(-1.5, 1.5), yaw_rad=st.floats(-3.1, 3.1))
def test_a_blow_from_the_side_is_no_rest_though_it_hangs_at_its_contact(
    aside_g: float, ahead_g: float, yaw_rad: float
) -> None:
    """The magnet holds its height for some moments while the blow knocks it off: all of the speed
    that it leaves is reckoned, but for what an accelerometer at rest drifts by."""
    state = rests_at_contact(0.58, blow_g=(ahead_g, aside_g), yaw_rad=yaw_rad).state
    gained_mps = 9.81 * 3.5 * TICK_S * math.hypot(aside_g, ahead_g)  # the first by its half
    x_mps, y_mps, _ = state.reckoning.velocity_mps
    assert math.hypot(x_mps, y_mps) >= gained_mps - 1.5 * STEADY_ASIDE_MPS


@given(wrong_rad=st.floats(-0.08, 0.08), yaw_rad=st.floats(-3.1, 3.1))
def test_a_wrong_attitude_is_no_blow_while_it_hangs(wrong_rad: float, yaw_rad: float) -> None:
    """It makes up to 0.8 m/s each second that are none, and a catch would brake them."""
    flight = rests_at_contact(1.98, yaw_rad=yaw_rad, pitch_rad=wrong_rad)
    for tick in flight.ticks[30:]:
        assert tick.state.reckoning.velocity_mps == (0.0, 0.0, 0.0)


@given(x_mps=st.floats(-2.0, 2.0), y_mps=st.floats(-2.0, 2.0))
def test_a_catch_brakes_a_speed_aside_that_the_estimate_has_not(x_mps: float, y_mps: float) -> None:
    """Knocked off the magnet it is caught by position, and the position mode would tilt it by its
    estimate, which has felt no blow: the setpoint asks for the opposite of what that lacks."""
    unknown_mps = math.hypot(x_mps, y_mps)
    assume(abs(unknown_mps - BLOWN_MPS) > 0.01)
    imu = ImuMotion(t_s=BEGIN_S)
    state = replace(
        state_in(Phase.LANDING, z_m=1.9), contact_z_m=1.9, released_s=BEGIN_S - 1.0,
        reach_s=BEGIN_S - 6.0, blind_s=BEGIN_S - 3.0,
        reckoning=Reckoning(imu=imu, velocity_mps=(x_mps, y_mps, -0.5)),
    )  # fmt: skip
    falls = unseen(1.85, for_s=2.0, velocity_mps=(0.0, 0.0, -0.5), acc_z_g=0.2, thrust=0.0)
    obs = replace(falls(BEGIN_S + TICK_S), imu=replace(imu, t_s=BEGIN_S + TICK_S))
    _, command = step_mission(state, obs, PROFILE)
    assert is_setpoint(command, above_m=1.85)
    assert isinstance(command, PositionSetpoint)
    if unknown_mps > BLOWN_MPS:
        for way_m, mps in ((command.x_m, x_mps), (command.y_m, y_mps)):
            braked_mps = max(-MOST_BRAKED_MPS, min(MOST_BRAKED_MPS, mps))
            assert way_m == pytest.approx(-braked_mps / POSITION_GAIN_PER_S, abs=0.02)
    else:
        assert (command.x_m, command.y_m) == (0.0, 0.0)


@pytest.mark.parametrize("hover", [0.0, HOVER_THRUST])
def test_blind_from_the_take_off_it_has_a_thrust_to_come_down_on(hover: float) -> None:
    state = replace(state_in(Phase.APPROACH, z_m=0.3), hover_thrust=hover)
    flight = fly(state, unseen(0.3, for_s=math.inf), profile=PROFILE)
    assert flight.state.phase is Phase.LANDING
    assert flight.state.hover_thrust > 0.0
    assert isinstance(flight.command, RawThrust | Land)


@given(felt_g=st.floats(0.8, 1.2))
def test_a_hover_thrust_that_was_not_learned_yet_is_felt(felt_g: float) -> None:
    """What just sinks is carried by less than its weight; flown on that it would fall."""
    state = replace(state_in(Phase.APPROACH, z_m=0.3), hover_thrust=0.0)
    look = unseen(0.3, for_s=LAND_S + 0.1, thrust=felt_g * HOVER_THRUST, acc_z_g=felt_g)
    after = fly(state, look, profile=PROFILE).state
    assert after.blind_s is not None
    assert after.hover_thrust == pytest.approx(HOVER_THRUST, rel=0.1)


@given(speed_mps=st.floats(-1.5, 0.5), blind=st.booleans())
def test_level_it_brakes_what_sinks_fast_and_lets_sink_what_does_not(
    speed_mps: float, blind: bool
) -> None:
    """Blind by the felt speed, whatever the estimate says; without a heading by the estimate's."""
    state = blinded(1.0, (0.0, 0.0, speed_mps)) if blind else heading_lost()
    look = unseen(1.0, for_s=2.0) if blind else at()
    estimated_mps = 0.5 if blind else speed_mps

    def sinks(t_s: float) -> Observation:
        obs = look(t_s)
        tel = replace(obs.telemetry, velocity_mps=(0.0, 0.0, estimated_mps))
        return replace(obs, telemetry=tel)

    command = fly(state, sinks, profile=PROFILE if blind else DECKS).command
    assert isinstance(command, RawThrust)
    beside = abs(speed_mps + SINK_MPS) < 0.02
    assert beside or (command.thrust > HOVER_THRUST) == (speed_mps < -SINK_MPS)
    assert command.thrust <= 60000  # more is clipped
    assert blind or (command.roll_rad, command.pitch_rad) == (0.0, 0.0)


class Drifts(Motors):
    """By its estimate, and its reckoning, it sinks for ever; something has carried it for long.
    It may be silent for a while, in which it has gone down by more."""

    def __init__(self, silence_s: float) -> None:
        super().__init__(HOVER_THRUST)
        self.silence_s, self.stopped = silence_s, False

    def look(self, t_s: float, state: PlannerState) -> Observation:
        passed_s = t_s - BEGIN_S
        silent = 1.0 + 1e-6 < passed_s <= 1.0 + self.silence_s + 1e-6
        fallen_m = 0.4 if self.silence_s and passed_s > 1.0 + self.silence_s + 1e-6 else 0.0
        tel = telemetry(
            BEGIN_S + 1.0 if silent else t_s, 1.0 - 0.5 * passed_s - fallen_m, thrust=self.thrust,
            velocity_mps=(0.0, 0.0, -SINK_MPS), supervisor=READY if self.stopped else AIRBORNE,
        )  # fmt: skip
        return replace(unseen(1.0, for_s=2.0)(t_s), telemetry=tel, target=None)

    def obey(self, state: PlannerState, command: Command) -> None:
        self.stopped |= isinstance(command, StopMotors)
        self.thrust = float(command.thrust) if isinstance(command, RawThrust) else self.thrust
        self.thrust = 0.0 if self.stopped else self.thrust


@pytest.mark.parametrize(
    ("in_reach", "silence_s", "ends"),
    [(False, 0.0, Phase.LANDED), (True, 0.0, Phase.PERCHED), (True, 0.3, Phase.ABORTED)],
)
def test_a_blind_way_down_whose_speed_has_drifted_ends_all_the_same(
    in_reach: bool, silence_s: float, ends: Phase
) -> None:
    """That may be the magnet only where it began in its reach, and is, as long as no fall is felt
    and no silence could hide one."""
    felt = Felt()
    began = felt(unseen(1.0, for_s=2.0)(BEGIN_S))
    state = blinded(
        1.0, contact_z_m=1.0 if in_reach else None, reach_s=BEGIN_S if in_reach else None,
        reckoning=Reckoning(imu=began.imu, velocity_mps=(0.0, 0.0, -SINK_MPS)),
    )  # fmt: skip
    flight = fly(state, Drifts(silence_s), 20.0, PROFILE, feels=felt)
    assert not any(isinstance(command, Land) for command in flight.commands)
    assert flight.stops_s
    assert flight.state.phase is ends, flight.state.reason


# --- the last centimetres ------------------------------------------------------------------


def test_a_press_without_a_contact_backs_off_before_dead_reckoning_leads_aside() -> None:
    """By other means it has the time that it always had."""
    flight = lost(state_in(Phase.PERCH, z_m=2.1), 1.4, 2.1)
    rows = [tick.state.row for tick in flight.ticks if tick.state.phase is Phase.RECOVER]
    assert rows[0] == "pressed-blindly"
    assert flight.state.attempts == 1
    assert "after the last sight" in flight.state.reason
    decks = fly(state_in(Phase.PERCH, z_m=2.1), unseen(2.1, for_s=1.3))
    assert decks.state.row != "pressed-blindly"


def pressed_past_the_sight(
    aside_m: float = 0.0, sigma_m: float = 1e-3, climb_mps: float = 0.0
) -> PlannerState:
    """The last sight was 4.5 cm below the target. From there on the estimate sinks at 0.1 m/s, as
    after an impact, and the accelerometer feels `climb_mps` more each second; it holds."""

    def look(t_s: float) -> Observation:
        i = round((t_s - BEGIN_S) / TICK_S) - 1
        z_m = HANG_Z_M - 0.045 - 0.1 * TICK_S * i
        target = target_at(
            t_s, (aside_m, 0.0, CEILING_M), (0.0, 0.0, z_m), measured=not i,
            measured_s=BEGIN_S + TICK_S, sigma_m=np.full(3, sigma_m),
        )  # fmt: skip
        return at(
            z_m, obs={"target": target, "new_frame": not i, "position_age_s": TICK_S * i},
            velocity_mps=(0.0, 0.0, -0.1 if i else 0.0), thrust=1.1 * HOVER_THRUST,
            acc_z_g=1.0 + climb_mps / GRAVITY_MPS2,
        )(t_s)  # fmt: skip

    begin = state_in(Phase.PERCH, z_m=HANG_Z_M - 0.045)
    return fly(begin, look, 0.9, PROFILE, feels=True, one_phase=True).state


def test_a_contact_that_holds_is_proven_past_the_last_sight_by_what_is_felt() -> None:
    """Though the estimate sinks, and half a second later places nothing any more."""
    state = pressed_past_the_sight()
    assert (state.phase, state.row) == (Phase.COMPLETE, "contact")
    assert state.entered_s - BEGIN_S > HOLD_S
    assert pressed_past_the_sight(climb_mps=0.5).phase is Phase.PERCH  # it rises still


@pytest.mark.parametrize(("aside_m", "sigma_m"), [(0.03, 1e-3), (0.02, 0.01), (0.0, math.inf)])
def test_a_contact_beside_the_magnet_or_nobody_knows_where_is_none(
    aside_m: float, sigma_m: float
) -> None:
    state = pressed_past_the_sight(aside_m, sigma_m)
    assert (state.phase, state.row, state.attempts) == (Phase.RECOVER, "beside-the-magnet", 1)


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
    z_m = HANG_Z_M - below_m

    def look(t_s: float) -> Observation:
        obs = {"new_frame": t_s < BEGIN_S + 0.22 - 1e-6, "position_age_s": age_s}
        return at(z_m, obs=obs, thrust=of_hover * HOVER_THRUST)(t_s)

    flight = fly(state_in(phase, z_m=z_m), look, 0.9, PROFILE, feels=True)
    assert (flight.state.reach_s is not None) is within
    if within:
        landing = lander.begin_landing(flight.state, flight.obs, PROFILE)
        assert lander.is_in_reach(Context(landing, flight.obs, PROFILE))


# --- Without a heading: level, on the vertical speed alone ----------------------------------------


def heading_lost() -> PlannerState:
    return replace(state_in(Phase.LANDING), heading_lost=True)


def test_a_small_step_of_the_heading_is_held_as_any_other() -> None:
    flight = fly(state_in(Phase.ALIGN), at(obs={"jumped": True, "turned_rad": 0.4}))
    assert not flight.state.heading_lost
    assert flight.state.hold
    assert isinstance(flight.command, PositionSetpoint)


def test_what_does_not_sink_gets_less_until_the_floor_proves_itself() -> None:
    class OnTheFloor(Motors):
        def look(self, t_s: float, state: PlannerState) -> Observation:
            return at(0.05, thrust=self.thrust)(t_s)

    flight = fly(heading_lost(), OnTheFloor(HOVER_THRUST), 4.0, DECKS)
    stopped = next(i for i, c in enumerate(flight.commands) if isinstance(c, StopMotors))
    thrusts = [c.thrust for c in flight.commands[:stopped] if isinstance(c, RawThrust)]
    assert len(thrusts) == stopped
    assert all(after < before + 1 for before, after in pairwise([HOVER_THRUST, *thrusts]))
