"""What happens while nothing new is known of the vehicle, and what counts afterwards."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from perchctl.mission import CATCHABLE_M, Outcome, Phase, PlannerState, planner
from perchctl.mission.lander import MOST_DRIFT_M, PLANNED_MPS, SETTLING_S, own_landing
from perchctl.vehicle import (
    FULL_THRUST,
    HL_ACTIVE,
    Command,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    Telemetry,
)
from tests.helpers.mission import (
    AIRBORNE,
    HANG_Z_M,
    HOVER_THRUST,
    PROFILE,
    READY,
    Felt,
    changed,
    observation,
    state_in,
    telemetry,
)


def ticked(
    state: PlannerState, t_s: float, tel: Telemetry, **obs: object
) -> tuple[PlannerState, Command]:
    return planner.step_mission(state, observation(t_s, telemetry=tel, **obs), PROFILE)


def released(phase: Phase = Phase.COMPLETE) -> PlannerState:
    """Half a second into the release, the motors on their way down to still."""
    state = state_in(phase, z_m=HANG_Z_M)
    return replace(state, contact_z_m=HANG_Z_M, entered_s=8.0, released_s=9.5, t_s=9.98)


def hangs(t_s: float, z_m: float = HANG_Z_M, **changes: object) -> Telemetry:
    return telemetry(t_s, z_m, **{"thrust": 1000.0, **changes})


# --- the release ----------------------------------------------------------------------


def test_a_release_that_nobody_sees_goes_back_to_a_setpoint() -> None:
    """Still motors would be a stop without a proof: what the magnet lets go of meanwhile is
    on the floor before the link counts as lost."""
    state, command = ticked(released(), 10.0, hangs(10.0))
    assert isinstance(command, RawThrust)
    state, command = ticked(state, 10.2, hangs(10.0))
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > HANG_Z_M
    assert state.released_s is None
    for i in range(12):  # seen again, it begins anew: the dwell times too
        t_s = 10.22 + 0.02 * i
        state, command = ticked(state, t_s, hangs(t_s, thrust=20000.0))
        assert isinstance(command, PositionSetpoint), t_s


def test_a_raw_release_waits_for_telemetry_too() -> None:
    profile = changed({"planner.perch.mode": "raw"})
    state = replace(released(), released_s=None, setpoint=None, entered_s=9.6)
    obs = observation(10.2, telemetry=hangs(10.0))
    assert isinstance(planner.step_mission(state, obs, profile)[1], PositionSetpoint)


# --- after the stop -------------------------------------------------------------------


def stopped(**changes: object) -> PlannerState:
    state = replace(released(), stopped_s=4.0, orders=5, reach_s=3.0)
    return replace(state, **changes)  # type: ignore[arg-type]


def after(state: PlannerState, z_m: float, silence_s: float = 0.0) -> PlannerState:
    """A second later. A fall that nobody has heard of may be in that silence."""
    felt = Felt()
    felt(observation(10.0, telemetry=telemetry(10.0, thrust=0.0, supervisor=READY)))
    for i in range(1, 50):
        t_s = 10.0 + silence_s + 0.02 * i
        off = telemetry(t_s, z_m, thrust=0.0, supervisor=READY)
        state, _ = planner.step_mission(state, felt(observation(t_s, telemetry=off)), PROFILE)
    return state


def test_what_lies_on_the_floor_has_not_perched() -> None:
    state = after(stopped(), z_m=0.02, silence_s=0.7)
    assert (state.phase, state.outcome) == (Phase.LANDED, Outcome.SAFETY)


def test_what_hangs_where_it_did_has_perched() -> None:
    assert after(stopped(), HANG_Z_M - 0.1, silence_s=0.7).phase is Phase.PERCHED


def test_an_estimate_that_drifts_while_it_is_watched_is_no_fall() -> None:
    assert after(stopped(), HANG_Z_M - 0.6).phase is Phase.PERCHED


# --- the estimate ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gap_s", "moves"), [(0.02, True), (0.1, True), (0.3, False), (5.0, False)]
)
def test_a_step_behind_missing_samples_may_be_the_vehicle_s(gap_s: float, moves: bool) -> None:
    """It was at rest before the silence and is at rest after it: on the floor."""
    state = replace(state_in(Phase.LANDING, z_m=1.0), last=telemetry(10.0, 1.0))
    assert state.ground_m is not None
    ground_z_m = state.ground_m[2]
    t_s = 10.0 + gap_s
    new, _ = ticked(state, t_s, telemetry(t_s, 0.02), jumped=True)
    assert new.ground_m is not None
    moved_m = new.ground_m[2] - ground_z_m
    assert moved_m == pytest.approx(-0.98 if moves else 0.0)


def test_a_step_in_its_own_landing_is_braked_then_the_order_given_anew() -> None:
    """By the line in the world that was it would dive by the step."""
    lands = AIRBORNE | HL_ACTIVE
    state = replace(state_in(Phase.LANDING, z_m=0.4), orders=3, ordered_s=9.0)
    state = replace(state, last=telemetry(9.98, 0.4, supervisor=lands))
    sinks = (0.0, 0.0, -0.3)
    up = telemetry(10.0, 0.9, velocity_mps=sinks, supervisor=lands)
    state, command = ticked(state, 10.0, up, jumped=True)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > 1.2
    slow = telemetry(10.14, 0.87, velocity_mps=(0.0, 0.0, -0.05), supervisor=lands)
    state, command = ticked(state, 10.14, slow)
    assert isinstance(command, Land)
    assert state.ground_m is not None
    assert command.height_m < state.ground_m[2]


# --- a slip ---------------------------------------------------------------------------


def slipping(t_s: float, **changes: object) -> Telemetry:
    fast = {"velocity_mps": (0.0, 0.0, -0.5), "thrust": 1000.0, "acc_z_g": 0.2}
    return telemetry(t_s, HANG_Z_M - 0.1, **{**fast, **changes})


def caught_from(state_changes: dict[str, object]) -> PlannerState:
    state = replace(state_in(Phase.RECOVER, z_m=HANG_Z_M), row="slipped", caught=False)
    below = PositionSetpoint(0.0, 0.0, HANG_Z_M - 0.25, 0.0)
    return replace(state, catch_above_m=1.0, setpoint=below, **state_changes)  # type: ignore[arg-type]


def test_no_hold_keeps_a_slip_from_being_caught() -> None:
    state, command = ticked(caught_from({}), 10.2, slipping(10.2), loop_late_s=0.4)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > HANG_Z_M
    assert not state.caught


def test_nothing_is_caught_on_an_old_speed() -> None:
    """Two seconds of full thrust on a speed of long ago would end far above."""
    _, command = ticked(caught_from({}), 10.3, slipping(10.1))
    assert isinstance(command, PositionSetpoint)
    assert command.z_m < HANG_Z_M + 0.1


@pytest.mark.parametrize("caught", [False, True])
def test_a_fall_that_turns_at_full_thrust_presses_nothing(caught: bool) -> None:
    state = replace(caught_from({}), caught=caught, attempts=PROFILE.planner.attempts)
    turns = slipping(10.6, velocity_mps=(0.0, 0.0, 0.01), thrust=FULL_THRUST, acc_z_g=1.1)
    state, _ = ticked(state, 10.6, turns)
    assert state.phase is Phase.LANDING
    assert state.pressed is caught


def test_a_contact_too_low_for_a_catch_says_so() -> None:
    z_m = CATCHABLE_M - 0.1
    state = state_in(Phase.PERCH, z_m=z_m)
    for i in range(1, 60):
        t_s = 10.0 + 0.02 * i
        target = observation(t_s, z_m).target
        assert target is not None
        touching = replace(target, e_m=target.e_m * 0.0)
        tel = telemetry(t_s, z_m, thrust=1.14 * HOVER_THRUST)
        state, _ = ticked(state, t_s, tel, target=touching)
    assert state.phase is Phase.COMPLETE
    assert "too low for a slip to be caught" in state.reason


# --- the landing ----------------------------------------------------------------------


def test_a_landing_that_takes_too_long_is_left_to_the_vehicle_in_time() -> None:
    """At its time's end nothing is sent any more, and setpoints that end are cut."""
    slow_s = PROFILE.planner.landing.timeout_s
    state = replace(state_in(Phase.LANDING, z_m=3.0), entered_s=10.0 - 0.6 * slow_s)
    assert isinstance(ticked(state, 10.0, telemetry(10.0, 3.0), target=None)[1], Land)


def test_motors_that_stand_still_in_a_fall_are_no_landing() -> None:
    """Orders lost, their notify not: cut in the air, and told to land again."""
    state = replace(state_in(Phase.LANDING, z_m=1.5), orders=1, ordered_s=9.5)
    falls = telemetry(10.0, 1.4, thrust=0.0, acc_z_g=0.02, velocity_mps=(0.0, 0.0, -0.4))
    assert isinstance(ticked(state, 10.0, falls)[1], Land)
    stands = telemetry(10.0, 0.02, thrust=0.0)
    assert isinstance(ticked(state, 10.0, stands)[1], (Idle, StopMotors))


@pytest.mark.parametrize(("mps", "again"), [(0.4, False), (1.2, True)])
def test_a_landing_that_ends_a_hand_above_the_floor_is_over(mps: float, again: bool) -> None:
    """It falls for a moment. Another order would start the motors once more on the floor, each
    time by an estimate that has gone further astray; a real fall is braked."""
    state = replace(state_in(Phase.LANDING, z_m=1.5), orders=3, ordered_s=5.0)
    drops = telemetry(10.0, 0.0, thrust=0.0, acc_z_g=0.02, velocity_mps=(0.0, 0.0, -mps))
    assert isinstance(ticked(state, 10.0, drops)[1], Land) is again


@pytest.mark.parametrize(
    ("z_m", "age_s", "again"), [(1.5, 0.0, True), (0.3, 0.0, False), (1.5, 2.0, False)]
)
def test_a_cut_in_the_air_is_answered_at_once(z_m: float, age_s: float, again: bool) -> None:
    """Ordered three times, and the motors stop far above the floor: that is no landing's end,
    unless no position tells how far above."""
    state = replace(state_in(Phase.LANDING, z_m=1.8), orders=3, ordered_s=5.0)
    cut = telemetry(10.0, z_m, thrust=0.0, acc_z_g=0.02, velocity_mps=(0.0, 0.0, -0.3))
    _, command = ticked(state, 10.02, replace(cut, t_s=10.02), position_age_s=age_s)
    assert isinstance(command, Land) is again


@pytest.mark.parametrize("z_m", [-2.0, -0.3, 0.0, 0.3, 2.0])
def test_no_landing_of_its_own_goes_up(z_m: float) -> None:
    """Wherever the estimate has drifted to: below the ground it would climb to the ground."""
    config = PROFILE.planner.landing
    order = own_landing(config, 0.0, 10.0, z_m)
    assert order.height_m <= min(0.0, z_m) - config.undershoot_m
    assert order.height_m >= min(0.0, z_m) - config.undershoot_m - 2.0 * MOST_DRIFT_M
    assert 1.0 < order.duration_s < 20.0


def test_a_landing_aims_the_lower_the_longer_the_estimate_may_have_drifted() -> None:
    config = PROFILE.planner.landing
    aims = [own_landing(config, 0.0, flown_s, 2.0).height_m for flown_s in (0, 20)]
    assert aims[0] == pytest.approx(-config.undershoot_m)
    assert aims[1] == pytest.approx(aims[0] - 20 * config.drift_mps)
    assert own_landing(config, 0.0, 1e6, math.nan).height_m >= aims[0] - MOST_DRIFT_M


@pytest.mark.parametrize("height_m", [0.1, 0.5, 2.5])
def test_its_own_landing_is_slow_from_any_height(height_m: float) -> None:
    """Of a quintic the largest speed is 15/8 of the mean; it begins while the vehicle sinks,
    which costs time that is not way."""
    order = own_landing(PROFILE.planner.landing, 0.0, 10.0, height_m)
    way_m = height_m - order.height_m
    assert 15 / 8 * way_m / order.duration_s < PLANNED_MPS
    assert order.duration_s - 15 / 8 * way_m / PLANNED_MPS == pytest.approx(SETTLING_S)


def test_a_landing_that_stays_up_hangs_wherever_its_target_was_thought_to_be() -> None:
    """Neither a contact was noticed nor is a target in sight: it is held, and put to the proof."""
    state = state_in(Phase.LANDING, z_m=1.8)
    for i in range(1, 80):
        t_s = 10.0 + 0.02 * i
        held = telemetry(t_s, 1.8, thrust=0.5 * HOVER_THRUST)
        state, command = ticked(state, t_s, held, target=None)
    assert isinstance(command, RawThrust)


def test_a_height_that_has_frozen_far_below_the_target_is_no_hanging() -> None:
    """On the floor, where a positioning system's height stood still half a metre above it."""
    state = state_in(Phase.LANDING, z_m=0.5)
    target = observation(10.0, 0.5).target
    for i in range(1, 80):
        t_s = 10.0 + 0.02 * i
        stands = telemetry(t_s, 0.5, thrust=0.4 * HOVER_THRUST)
        state, command = ticked(state, t_s, stands, target=target)
        assert not isinstance(command, RawThrust), t_s
    for i in range(80, 90):
        t_s = 10.0 + 0.02 * i
        off = telemetry(t_s, 0.5, thrust=0.0, supervisor=READY)
        state, _ = ticked(state, t_s, off, target=target)
    assert state.phase is Phase.LANDED


@pytest.mark.parametrize("z_m", [math.nan, math.inf])
def test_an_unknown_height_is_landed_slowly(z_m: float) -> None:
    config = PROFILE.planner.landing
    assert own_landing(config, 0.0, 1.0, z_m).duration_s > 5.0


@pytest.mark.parametrize(("age_s", "level"), [(0.02, True), (0.2, True), (0.5, False)])
def test_a_level_descent_does_not_change_its_mode_for_a_moment(age_s: float, level: bool) -> None:
    state = replace(state_in(Phase.LANDING, z_m=1.5), heading_lost=True)
    _, command = ticked(state, 10.5, telemetry(10.5 - age_s, 1.5))
    assert isinstance(command, RawThrust) is level


@pytest.mark.parametrize(
    "frozen",
    [{"roll_rad": 0.1}, {"position_m": (0.0, 0.0, 1.01), "velocity_mps": (0.0, 0.0, 0.01)}],
    ids=["attitude", "position and velocity"],
)
def test_what_stands_still_is_telemetry_that_grows_old(frozen: dict[str, Any]) -> None:
    """By such an attitude a target that is seen is looked for where it is not; by such a speed an
    offset of the accelerometer seems to be there that is none."""
    felt, state = Felt(), state_in(Phase.ALIGN)
    for i in range(70):
        t_s = 10.0 + 0.02 * i
        tel = telemetry(t_s, **(frozen if i else {}))
        state, _ = planner.step_mission(state, felt(observation(t_s, telemetry=tel)), PROFILE)
        if state.phase is Phase.LANDING:
            break
    assert state.row == "telemetry-stale"
    assert 0.02 * i == pytest.approx(PROFILE.safety.telemetry_land_s, abs=0.1)
