"""What the thrust proves, and where setpoints may lie."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import (
    Condition,
    Observation,
    Operator,
    Outcome,
    Phase,
    PlannerState,
    lander,
    planner,
)
from perchctl.mission.conditions import CONDITIONS, contact_thrust
from perchctl.mission.context import Context
from perchctl.mission.guidance import FLOOR_M, limited
from perchctl.mission.state import FLYING_PHASES
from perchctl.profile import Profile
from perchctl.vehicle import FULL_THRUST, PositionSetpoint
from tests.helpers.mission import (
    CEILING_M,
    PROFILE,
    READY,
    changed,
    observation,
    state_in,
    target_at,
    telemetry,
)

CONTACT_Z_M = CEILING_M - PROFILE.vehicle.gear_body_m[2]


def flown(
    state: PlannerState,
    for_s: float,
    z_m: float = 1.0,
    profile: Profile = PROFILE,
    setpoint_z_m: float | None = None,
    aside_m: float = 0.0,
    **tel: Any,
) -> PlannerState:
    """For so long in that state of flight, or until the phase changes."""
    for i in range(1, round(for_s / 0.02) + 1):
        t_s = 10.0 + 0.02 * i
        if setpoint_z_m is not None:
            state = replace(state, setpoint=PositionSetpoint(0.0, 0.0, setpoint_z_m, 0.0))
        sample = telemetry(t_s, z_m, **tel)
        target = target_at(t_s, (aside_m, 0.0, CEILING_M), sample.position_m)
        obs = observation(t_s, telemetry=sample, target=target)
        new, _ = planner.step_mission(state, obs, profile)
        if new.phase is not state.phase:
            return new
        state = new
    return state


def learned(**how: Any) -> float:
    """The hover thrust after a second in ESTIMATE."""
    start = replace(state_in(Phase.ESTIMATE), hover_thrust=0.0, target_spread_m=1.0)
    return flown(start, 0.3, thrust=50000.0, **how).hover_thrust


def test_quiet_flight_teaches_the_hover_thrust() -> None:
    assert learned() == 50000.0
    assert learned(velocity_mps=(0.0, 0.0, 0.25)) == 50000.0  # a steady climb takes no more


@pytest.mark.parametrize(
    "how",
    [
        {"setpoint_z_m": 1.3},
        {"acc_z_g": 1.2},
        {"acc_z_g": 0.8},
        {"velocity_mps": (0.0, 0.0, 0.29)},
        {"velocity_mps": (0.4, 0.0, 0.0)},
        {"behind_s": 0.2},
    ],
    ids=["pressed", "speeding up", "braking", "climbing hard", "journey", "stale"],
)
def test_what_is_no_hover_teaches_nothing(how: dict[str, Any]) -> None:
    assert learned(**how) == 0.0


def test_saturated_thrust_teaches_nothing() -> None:
    start = replace(state_in(Phase.ALIGN), hover_thrust=60000.0)
    assert flown(start, 0.3, thrust=float(FULL_THRUST)).hover_thrust == 60000.0


@pytest.mark.parametrize("ratio", [0.55, 0.75, 1.25])
def test_nothing_hovers_on_much_less_or_more_than_before(ratio: float) -> None:
    """It is held by the ceiling or by a hand; learned, it would hide that."""
    start = replace(state_in(Phase.ALIGN), hover_thrust=40000.0, target_spread_m=1.0)
    assert flown(start, 0.3, thrust=ratio * 40000.0).hover_thrust == 40000.0


@pytest.mark.parametrize(("z_m", "learns"), [(1.0, True), (CONTACT_Z_M - 0.05, False)])
def test_near_the_target_an_ascent_learns_nothing(z_m: float, learns: bool) -> None:
    """It may press against a ceiling that is lower than thought."""
    start = replace(state_in(Phase.ASCEND, z_m=z_m), hover_thrust=50000.0)
    hover = flown(start, 0.1, z_m, thrust=52000.0).hover_thrust
    assert (hover > 50000.0) is learns


def pressing(hover: float, thrust: float, profile: Profile = PROFILE) -> PlannerState:
    start = replace(state_in(Phase.PERCH, z_m=CONTACT_Z_M), hover_thrust=hover)
    return flown(start, 0.5, CONTACT_Z_M, profile, thrust=thrust)


@pytest.mark.parametrize("hover", [56000.0, 63000.0, 64000.0])
def test_a_contact_can_be_proven_with_what_thrust_there_is(hover: float) -> None:
    assert pressing(hover, FULL_THRUST).phase is Phase.COMPLETE
    assert pressing(hover, hover).phase is Phase.PERCH


RAW = changed({"planner.perch.mode": "raw"})


def test_a_raw_press_is_measured_by_its_own_thrust() -> None:
    c = Context(replace(state_in(Phase.PERCH), hover_thrust=58500.0), observation(1), RAW)
    assert 58500.0 < contact_thrust(c) < 60000.0


@pytest.mark.parametrize(("hover", "presses"), [(57000.0, True), (59500.0, False)])
def test_a_press_that_could_not_press_is_not_begun(hover: float, presses: bool) -> None:
    """Raw thrust of 60000 at a hover thrust of 59500: the vehicle would hang in the air."""
    z_m = CONTACT_Z_M - PROFILE.planner.ascend.standoff_m
    start = replace(state_in(Phase.ASCEND, z_m=z_m), hover_thrust=hover)
    state = flown(start, 0.5, z_m, RAW, thrust=hover)
    assert state.phase is (Phase.PERCH if presses else Phase.LANDING)
    if not presses:
        assert state.outcome is Outcome.SAFETY
        assert "too heavy" in state.reason


def test_a_weak_vehicle_at_full_thrust_is_not_called_pressed() -> None:
    """It hovers below its setpoint on all the thrust there is, as it did before on nearly all."""
    start = replace(state_in(Phase.ALIGN), hover_thrust=62500.0)
    state = flown(start, 1.9, thrust=float(FULL_THRUST), setpoint_z_m=1.2, aside_m=0.2)
    assert state.phase is Phase.ALIGN
    state = flown(start, 2.5, thrust=float(FULL_THRUST), setpoint_z_m=1.2, aside_m=0.2)
    assert state.row == "too-weak"
    assert "battery too low" in state.reason


def test_a_strong_vehicle_at_full_thrust_is_pressed() -> None:
    state = flown(
        state_in(Phase.ALIGN), 1.0, thrust=float(FULL_THRUST), setpoint_z_m=1.2, aside_m=0.2
    )
    assert state.row == "blocked"


def test_a_change_of_phase_does_not_hide_a_weak_vehicle() -> None:
    state, rows = replace(state_in(Phase.ALIGN), hover_thrust=62500.0), []
    for i in range(1, 115):
        t_s = 10.0 + 0.02 * i
        sample = telemetry(t_s, thrust=float(FULL_THRUST))
        state, _ = planner.step_mission(state, observation(t_s, telemetry=sample), PROFILE)
        rows.append(state.row)
    assert "aligned" in rows
    assert rows[-1] == "too-weak"


@pytest.mark.parametrize(
    ("raw_order", "reads", "known"),
    [
        (1000, 20000.0, False),  # stands still where it was before the order
        (1000, 0.0, True),
        (20000, 20000.0, True),
        (None, 20000.0, True),  # position mode: nothing tells what it should be
    ],
)
def test_a_reading_that_stands_still_under_a_changed_order_is_stale(
    raw_order: int | None, reads: float, known: bool
) -> None:
    """It proves no hold: a magnet that carries nothing would pass for one that carries it all."""
    state = replace(
        state_in(Phase.COMPLETE, z_m=CONTACT_Z_M), raw_order=raw_order, released_s=9.5,
        setpoint=None if raw_order else PositionSetpoint(0.0, 0.0, CONTACT_Z_M, 0.0),
    )  # fmt: skip
    for i in range(1, 20):
        t_s = 10.0 + 0.02 * i
        obs = observation(t_s, telemetry=telemetry(t_s, CONTACT_Z_M, thrust=reads))
        state = replace(lander.observed(state, obs, PROFILE), t_s=t_s, last=obs.telemetry)
    c = Context(state, obs, PROFILE)
    assert c.thrust_is_known is known
    held = CONDITIONS[Condition.MAGNET_HOLDS](c)
    assert held is known


def pressed_late(t_s: float, late_s: float) -> Observation:
    """A vehicle that touches something with all its thrust, seen by a late turn."""
    sample = telemetry(t_s, CONTACT_Z_M, thrust=float(FULL_THRUST))
    return observation(t_s, telemetry=sample, target=None, new_frame=False, loop_late_s=late_s)


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_a_press_ends_before_the_turn_that_would_be_too_late(late_s: float) -> None:
    timeout_s = PROFILE.planner.perch.timeout_s
    state = state_in(Phase.PERCH, 10.0, CONTACT_Z_M + 0.02)
    state, _ = planner.step_mission(state, pressed_late(10.0 + timeout_s - 0.2, late_s), PROFILE)
    assert state.phase is (Phase.RECOVER if late_s else Phase.PERCH)


def test_what_backs_off_from_a_press_is_not_held_to_it() -> None:
    """Late turns hold a vehicle in place: by the press's own setpoint they would press on."""
    t_s = 10.1 + PROFILE.planner.perch.timeout_s
    saturated = {Condition.SATURATED: 10.5}
    above = state_in(Phase.PERCH, 10.0, CONTACT_Z_M + 0.25)
    state = replace(above, since=saturated, caught=True)
    for _ in range(2):
        state, command = planner.step_mission(state, pressed_late(t_s, 0.3), PROFILE)
        assert state.phase is Phase.RECOVER  # and full thrust is no sign of a heavy vehicle
        assert state.hold
        assert isinstance(command, PositionSetpoint)
        assert command.z_m < CONTACT_Z_M - 0.5
        t_s += 0.3


# --- Where setpoints may lie, whatever is seen or estimated ---------------------------------------


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
