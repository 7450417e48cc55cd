"""What the thrust proves, and where setpoints may lie."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.mission import (
    ImuMotion,
    Observation,
    OperatorRequest,
    Outcome,
    Phase,
    PlannerState,
    planner,
)
from perchctl.mission.belief.contact import (
    MAGNET_HOLDS_VEHICLE,
    NOT_CLIMBING_AT_FULL_THRUST,
    SLOW_CLIMB_AT_NEARLY_FULL_THRUST,
)
from perchctl.mission.phase import PRE_LANDING_PHASES
from perchctl.mission.setpoints import (
    MIN_SETPOINT_HEIGHT_ABOVE_GROUND_M,
    limit_setpoint_to_fence_and_height_range,
)
from perchctl.profile import Profile
from perchctl.vehicle import FULL_THRUST, Command, PositionSetpoint
from tests.helpers.mission import (
    CEILING_M,
    PROFILE,
    changed,
    context_at,
    observation,
    observing,
    remembering,
    state_in,
    target_at,
)
from tests.mission.rig import BEGIN_S, Motors, at, fly, times

CONTACT_Z_M = CEILING_M - PROFILE.vehicle.gear_body_m[2]


def flown(
    state: PlannerState,
    for_s: float,
    z_m: float = 1.0,
    profile: Profile = PROFILE,
    setpoint_z_m: float | None = None,
    lateral_offset_m: float = 0.0,
    **tel: Any,
) -> PlannerState:
    """For so long in that state of flight, or until the phase changes."""
    for t_s in times(for_s):
        if setpoint_z_m is not None:
            state = remembering(state, setpoint=PositionSetpoint(0.0, 0.0, setpoint_z_m, 0.0))
        target = target_at(t_s, (lateral_offset_m, 0.0, CEILING_M), (0.0, 0.0, z_m))
        new, _ = planner.step_mission(state, at(z_m, obs={"target": target}, **tel)(t_s), profile)
        if new.phase is not state.phase:
            return new
        state = new
    return state


@pytest.mark.parametrize(
    ("hover", "thrust", "holds"),
    [
        (56_000, 33_500, True),
        (56_000, 33_700, False),  # a magnet is proven below 0.6 of the hover thrust
        (29_400, 20_000, True),  # strong motors: position mode goes no lower
        (29_400, 20_100, False),
        (24_500, 20_000, False),  # so much may be held by the air under the ceiling
        (24_500, 14_600, True),
    ],
)
def test_how_little_thrust_proves_that_the_magnet_holds(
    hover: float, thrust: float, holds: bool
) -> None:
    hangs = remembering(
        state_in(Phase.COMPLETE), hover_thrust=hover, vehicle_world_z_at_last_contact_m=CONTACT_Z_M
    )
    c = context_at(hangs, at(CONTACT_Z_M, thrust=float(thrust))(BEGIN_S), PROFILE)
    assert MAGNET_HOLDS_VEHICLE.predicate(c.belief) is holds


@pytest.mark.parametrize(
    ("how", "learns"),
    [
        ({}, True),
        ({"velocity_mps": (0.0, 0.0, 0.25)}, True),  # a steady climb takes no more
        ({"setpoint_z_m": 1.3}, False),
        ({"acc_z_g": 1.2}, False),
        ({"acc_z_g": 0.8}, False),
        ({"velocity_mps": (0.0, 0.0, 0.29)}, False),
        ({"velocity_mps": (0.4, 0.0, 0.0)}, False),
        ({"behind_s": 0.2}, False),
    ],
    ids=["quiet", "climbs", "pressed", "speeds up", "brakes", "climbs hard", "journey", "stale"],
)
def test_only_quiet_flight_teaches_the_hover_thrust(how: dict[str, Any], learns: bool) -> None:
    start = remembering(
        state_in(Phase.ESTIMATE),
        hover_thrust=0.0,
        recent_max_target_world_shift_between_pictures_m=1.0,
    )
    after = flown(start, 0.3, thrust=50000.0, **how)
    assert after.belief.hover_thrust == (50000.0 if learns else 0.0)


def pressing(hover: float, thrust: float) -> PlannerState:
    start = remembering(state_in(Phase.PERCH, z_m=CONTACT_Z_M), hover_thrust=hover)
    return flown(start, 0.5, CONTACT_Z_M, PROFILE, thrust=thrust)


@pytest.mark.parametrize("hover", [56000.0, 63000.0, 64000.0])
def test_a_contact_can_be_proven_with_what_thrust_there_is(hover: float) -> None:
    assert pressing(hover, FULL_THRUST).phase is Phase.COMPLETE
    assert pressing(hover, hover).phase is Phase.PERCH


RAW = changed({"planner.perch.mode": "raw"})


@pytest.mark.parametrize(("hover", "presses"), [(57000.0, True), (59500.0, False)])
def test_a_press_that_could_not_press_is_not_begun(hover: float, presses: bool) -> None:
    """Raw thrust of 60000 at a hover thrust of 59500: the vehicle would hang in the air."""
    z_m = CONTACT_Z_M - PROFILE.planner.ascend.standoff_m
    start = remembering(state_in(Phase.ASCEND, z_m=z_m), hover_thrust=hover)
    state = flown(start, 0.5, z_m, RAW, thrust=hover)
    assert state.phase is (Phase.PERCH if presses else Phase.LANDING)
    if not presses:
        assert state.outcome is Outcome.SAFETY
        assert "too heavy" in state.transition_reason


@pytest.mark.parametrize(("hover", "lasts_s", "row"), [
    # It hovers below its setpoint on all the thrust there is, as before on nearly all.
    (62500.0, 1.9, ""), (62500.0, 2.5, "too-weak"), (56000.0, 1.0, "blocked"),
])  # fmt: skip
def test_a_weak_vehicle_at_full_thrust_is_not_called_pressed(
    hover: float, lasts_s: float, row: str
) -> None:
    start = remembering(state_in(Phase.ALIGN), hover_thrust=hover)
    state = flown(start, lasts_s, thrust=float(FULL_THRUST), setpoint_z_m=1.2, lateral_offset_m=0.2)
    assert state.transition_name == row
    assert row != "too-weak" or "battery too low" in state.transition_reason


def flown_at_full_thrust(
    state: PlannerState, for_s: float, z_m: float, climb_mps: float, aside_m: float = 0.2
) -> PlannerState:
    """For so long at full thrust with that climb rate from that height on, or until a row acts."""
    for t_s in times(for_s):
        now_m = z_m + climb_mps * (t_s - BEGIN_S)
        target = target_at(t_s, (aside_m, 0.0, CEILING_M), (0.0, 0.0, now_m))
        sample = at(
            now_m,
            obs={"target": target},
            thrust=float(FULL_THRUST),
            velocity_mps=(0.0, 0.0, climb_mps),
        )
        state, _ = planner.step_mission(state, sample(t_s), PROFILE)
        if state.transition_name:
            return state
    return state


@settings(max_examples=20)  # each is a flight of 60 ticks
@given(climb_mps=st.floats(-0.1, 0.6))
def test_only_a_vehicle_that_climbs_at_full_thrust_goes_on_taking_off(climb_mps: float) -> None:
    """One that the ground effect lifts, or a rested battery, would soon sink and hit the floor."""
    state = flown_at_full_thrust(state_in(Phase.APPROACH), 1.1, 0.15, climb_mps)
    assert (state.transition_name == "cannot-rise") is (climb_mps < 0.2)


@pytest.mark.parametrize(
    ("phase", "climb_mps", "for_s", "lands"),
    [
        (Phase.ALIGN, 0.19, 1.9, False),
        (Phase.ALIGN, 0.19, 2.1, True),
        (Phase.ALIGN, -0.3, 2.1, True),  # no fall that full thrust would end
        (Phase.ALIGN, 0.21, 2.1, False),
        (Phase.ASCEND, 0.04, 1.9, False),
        (Phase.ASCEND, 0.04, 2.1, True),  # something is above it, or it is too weak
        (Phase.ASCEND, -0.3, 2.1, True),
        (Phase.ASCEND, 0.06, 3.0, False),  # the last part of a weak vehicle's climb
    ],
)
def test_a_vehicle_that_sinks_or_crawls_at_full_thrust_lands(
    phase: Phase, climb_mps: float, for_s: float, lands: bool
) -> None:
    """Seed 21011139 went on along the floor."""
    weak = remembering(state_in(phase, z_m=1.1), hover_thrust=62500.0)
    aside_m = 0.2 if phase is Phase.ALIGN else 0.0  # it neither has aligned nor leaves the cone
    state = flown_at_full_thrust(weak, for_s, 1.1, climb_mps, aside_m)
    assert (state.transition_name == "too-weak") is lands


@pytest.mark.parametrize(("phase", "slow"), [(Phase.ALIGN, True), (Phase.PERCH, False)])
def test_a_press_is_no_flight_on_too_little_thrust(phase: Phase, slow: bool) -> None:
    c = context_at(state_in(phase), at(thrust=float(FULL_THRUST))(BEGIN_S), PROFILE)
    for condition in (NOT_CLIMBING_AT_FULL_THRUST, SLOW_CLIMB_AT_NEARLY_FULL_THRUST):
        assert condition.predicate(c.belief) is slow


@pytest.mark.parametrize(
    ("commanded_raw_thrust", "reads", "known"),
    [
        (1000, 20000.0, False),  # stands still where it was before the order
        (1000, 0.0, True),
        (20000, 20000.0, True),
        (None, 20000.0, True),  # position mode: nothing tells what it should be
    ],
)
def test_a_reading_that_stands_still_under_a_changed_order_is_stale(
    commanded_raw_thrust: int | None, reads: float, known: bool
) -> None:
    """It proves no hold: a magnet that carries nothing would pass for one that carries it all."""
    state = remembering(
        state_in(Phase.COMPLETE, z_m=CONTACT_Z_M), commanded_raw_thrust=commanded_raw_thrust,
        weight_transfer_began_at_s=9.5,
        setpoint=None if commanded_raw_thrust else PositionSetpoint(0.0, 0.0, CONTACT_Z_M, 0.0),
    )  # fmt: skip
    for t_s in times(0.38):
        obs = at(CONTACT_Z_M, thrust=reads)(t_s)
        state = replace(observing(state, obs, PROFILE), t_s=t_s)
    b = state.belief
    assert b.is_reported_thrust_reliable is MAGNET_HOLDS_VEHICLE.predicate(b) is known


@given(st.floats(0.0, 3.0))
def test_a_long_press_is_released_at_once(pressed_s: float) -> None:
    """The integrator of the firmware has wound up by then: with a release in steps, a press whose
    thrust was not reported at first lasted 4.2 s (seed 2612010094)."""
    state = state_in(Phase.COMPLETE, z_m=CONTACT_Z_M)
    imu = ImuMotion(climb_rate_became_steady_at_s=BEGIN_S - pressed_s)
    pressed = at(CONTACT_Z_M, obs={"imu": imu}, thrust=float(FULL_THRUST))
    first, *_, last = fly(state, pressed, 1.0).commands
    assert isinstance(first, PositionSetpoint)
    assert isinstance(last, PositionSetpoint)
    drop_m = PROFILE.planner.complete.release_drop_m
    assert last.z_m == pytest.approx(CONTACT_Z_M - drop_m)
    if pressed_s > 1.5:
        assert first.z_m == pytest.approx(last.z_m)
    elif pressed_s < 1.45:
        assert first.z_m > CONTACT_Z_M


def pressed_late(t_s: float, late_s: float) -> Observation:
    """A vehicle that touches something with all its thrust, seen by a late turn."""
    late = {"target": None, "has_new_frame": False, "tick_start_delay_s": late_s}
    return at(CONTACT_Z_M, obs=late, thrust=float(FULL_THRUST))(t_s)


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_a_press_ends_before_the_turn_that_would_be_too_late(late_s: float) -> None:
    timeout_s = PROFILE.planner.perch.timeout_s
    state = state_in(Phase.PERCH, 10.0, CONTACT_Z_M + 0.02)
    state, _ = planner.step_mission(state, pressed_late(10.0 + timeout_s - 0.2, late_s), PROFILE)
    assert state.phase is (Phase.RECOVER if late_s else Phase.PERCH)


def test_what_backs_off_from_a_press_is_not_held_to_it() -> None:
    """Late turns hold a vehicle in place: by the press's own setpoint they would press on."""
    t_s = 10.1 + PROFILE.planner.perch.timeout_s
    saturated = {NOT_CLIMBING_AT_FULL_THRUST: 10.5}
    above = state_in(Phase.PERCH, 10.0, CONTACT_Z_M + 0.25)
    state = remembering(
        above, condition_start_times_s=saturated, fall_catch_setpoint_above_vehicle_m=None
    )
    for _ in range(2):
        state, command = planner.step_mission(state, pressed_late(t_s, 0.3), PROFILE)
        assert state.phase is Phase.RECOVER  # and full thrust is no sign of a heavy vehicle
        assert state.hold_reason
        assert isinstance(command, PositionSetpoint)
        assert command.z_m < CONTACT_Z_M - 0.5
        t_s += 0.3


# --- Where setpoints may lie, whatever is seen or estimated ---------------------------------------


GROUND_Z_M = 0.4
"""A table, in a world whose zero is the floor."""


@given(st.floats(-5, 5), st.sampled_from(sorted(PRE_LANDING_PHASES | {Phase.LANDING}, key=str)))
def test_no_setpoint_lies_in_the_ground(z_m: float, phase: Phase) -> None:
    state = remembering(state_in(phase), takeoff_position_m=(0.0, 0.0, GROUND_Z_M))
    c = context_at(state, observation(10.02), PROFILE)
    lowest = GROUND_Z_M + (0.0 if phase is Phase.APPROACH else MIN_SETPOINT_HEIGHT_ABOVE_GROUND_M)
    sent = limit_setpoint_to_fence_and_height_range(c, PositionSetpoint(0.0, 0.0, z_m, 0.0)).z_m
    assert sent >= lowest
    assert sent == z_m or z_m < lowest or z_m > GROUND_Z_M + PROFILE.safety.max_height_m


class Follows(Motors):
    """Where its setpoint is; its target is placed below, or as it is."""

    def __init__(self, follows: float, **obs: Any) -> None:
        super().__init__()
        self.z_m, self.obs, self.follows, self.sent_m = 1.0, obs, follows, [1.0]

    def look(self, t_s: float, state: PlannerState) -> Observation:
        return at(self.z_m, obs=self.obs)(t_s)

    def obey(self, state: PlannerState, command: Command) -> None:
        if isinstance(command, PositionSetpoint):
            self.sent_m.append(command.z_m)
            self.z_m += self.follows * (command.z_m - self.z_m)


@pytest.mark.parametrize("phase", [Phase.SEARCH, Phase.ASCEND, Phase.PERCH])
def test_a_target_that_seems_to_lie_below_is_not_dived_to(phase: Phase) -> None:
    """SEARCH looks for a target that it knows from below it."""
    below = target_at(BEGIN_S, (0.0, 0.0, -1.0), tracked=False, is_measured_in_newest_frame=False)
    it = Follows(1.0, target=below)
    fly(state_in(phase), it, 8.0)
    assert min(it.sent_m) >= MIN_SETPOINT_HEIGHT_ABOVE_GROUND_M


@pytest.mark.parametrize("handover_m", [0.1, pytest.param(0.3, marks=pytest.mark.long)])
def test_a_landing_is_handed_over_above_the_floor(handover_m: float) -> None:
    """The lowest setpoint of a landing still leads below where it is handed over."""
    profile = changed({"planner.landing.handover_m": handover_m})
    it = Follows(0.1, operator_request=OperatorRequest.LAND)
    flight = fly(state_in(Phase.ALIGN), it, 20.0, profile)
    ordered = next(i for i, c in enumerate(flight.commands) if not isinstance(c, PositionSetpoint))
    assert flight.ticks[ordered].state.stop_or_land_command_count == 1
    assert MIN_SETPOINT_HEIGHT_ABOVE_GROUND_M <= it.sent_m[ordered] < handover_m
