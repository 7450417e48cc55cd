"""The way down: what ends a landing, what presses, hangs, slips or steps, and what is not seen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from perchctl.mission import (
    GearToTargetDistance,
    ImuMotion,
    Observation,
    Outcome,
    Phase,
    PlannerState,
)
from perchctl.mission.belief.contact import MOTORS_OFF_DWELL_S, TARGET_CONTACT
from perchctl.mission.descent import (
    MAX_ASSUMED_HEIGHT_DRIFT_FOR_LANDING_GOAL_M,
    ONBOARD_LANDING_DURATION_MARGIN_S,
    ONBOARD_LANDING_PEAK_SPEED_MPS,
    make_onboard_landing_command,
)
from perchctl.mission.planner import step_mission
from perchctl.mission.release import EXTRA_HANGING_DWELL_IF_THRUST_UNCONFIRMED_S
from perchctl.mission.table import TABLE
from perchctl.vehicle import (
    CRASHED,
    HL_ACTIVE,
    LOCKED,
    TUMBLED,
    Command,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)
from tests.helpers.mission import (
    AIRBORNE,
    HANG_Z_M,
    HOVER_THRUST,
    PROFILE,
    PROFILES,
    READY,
    Felt,
    observation,
    remembering,
    state_in,
    target_at,
    telemetry,
)
from tests.mission.rig import BEGIN_S, TICK_S, Look, Motors, at, fly, is_setpoint, times

SINKS = (0.0, 0.0, -0.5)
OFF: dict[str, Any] = {"thrust": 0.0, "supervisor": READY}


def landing(z_m: float = HANG_Z_M, phase: Phase = Phase.LANDING, **changes: Any) -> PlannerState:
    """In a landing from a height, or in another phase."""
    return remembering(state_in(phase, z_m=z_m), **changes)


def hanging(phase: Phase = Phase.LANDING, **changes: Any) -> PlannerState:
    """The same, where the magnet may hold it."""
    return landing(HANG_Z_M, phase, **{"vehicle_world_z_at_last_contact_m": HANG_Z_M, **changes})


# --- What presses, and what is on the floor ------------------------------------------------------


def test_a_floor_at_the_wrong_height_is_a_floor() -> None:
    """After a minute of drift the estimate has it at 0.4 m: come down, carried by something
    that is not the ceiling, and still."""
    stops_s = fly(landing(1.5), at(0.4, thrust=20000.0), 1.2).stops_s
    assert 0.5 <= stops_s[0] - BEGIN_S < 0.7


@pytest.mark.parametrize("phase", [Phase.LANDING, Phase.RECOVER])
def test_a_way_down_that_begins_pressed_goes_far_below_until_it_is_away(phase: Phase) -> None:
    """The integrators that a second of full thrust has wound up hold it there for seconds."""
    pressing = fly(landing(1.0, phase, must_end_press=True), at(1.0, thrust=65535.0))
    assert is_setpoint(pressing.command, distance_below_m=0.2)
    away = at(0.85, thrust=45000.0, velocity_mps=(0.0, 0.0, -0.1))
    state, command = step_mission(pressing.state, away(10.5), PROFILE)
    assert not state.must_end_press
    assert is_setpoint(command, above_m=0.4)


# --- A landing stops no motor but on the floor's or the ceiling's proof ------------------------

Bit = tuple[int, float, float, float, float, float]
"""Ticks, and what is observed for them: height, climb, acceleration, thrust, age."""

BITS = st.tuples(
    st.integers(3, 70),
    st.sampled_from([0.02, 0.1, 0.25, 0.6, 1.0, HANG_Z_M - 0.05, HANG_Z_M]),
    st.sampled_from([0.0, 0.0, 0.0, -0.3]),
    st.sampled_from([1.0, 1.0, 1.0, 0.3]),
    st.sampled_from([0.0, 0.0, 1000.0, 20000.0, 33000.0, 56000.0]),
    st.sampled_from([0.01, 0.01, 0.01, 0.15, 0.5]),
)
STATES: tuple[dict[str, Any], ...] = (
    {},
    {"vehicle_world_z_at_last_contact_m": HANG_Z_M},
    {"vehicle_world_z_at_last_contact_m": HANG_Z_M, "weight_transfer_began_at_s": 9.9},
    {"stop_or_land_command_count": 2, "last_stop_or_land_command_at_s": 9.9},
    {"hover_thrust": 0.0},
)


def _was_fresh(seen: list[Observation], for_s: float) -> list[Observation] | None:
    """What was observed in that time, None unless there was something, all of it fresh."""
    now_s = seen[-1].t_s
    recent = [o for o in seen if o.t_s >= now_s - for_s - 1e-6]
    long_enough = now_s - recent[0].t_s >= for_s - 1e-6
    fresh = all(o.t_s - o.telemetry.t_s <= PROFILE.safety.proof_age_s + 1e-9 for o in recent)
    return recent if long_enough and fresh else None


def _at_rest(obs: Observation) -> bool:
    return abs(obs.telemetry.velocity_mps[2]) < 0.05 and abs(obs.telemetry.acc_z_g - 1.0) <= 0.12


def on_the_floor(seen: list[Observation], ground_z_m: dict[float, float], entry_m: float) -> bool:
    """Half a second at rest, down, away from the target, on what could not carry it. Heights
    are over the ground, which steps with the estimate: `ground_z_m` by time, and the landing
    began at `entry_m`."""
    recent = _was_fresh(seen, 0.5)
    return recent is not None and all(
        _at_rest(o)
        and o.telemetry.thrust <= 0.6 * HOVER_THRUST
        and o.telemetry.position_m[2] - ground_z_m[o.t_s] < max(0.3, entry_m - 0.1) + 1e-9
        and o.telemetry.position_m[2] < HANG_Z_M - 0.3
        for o in recent
    )


def on_the_ceiling(seen: list[Observation]) -> bool:
    """The whole weight for as long as it takes, where the target is or the contact was; longer
    where the thrust that is read does not follow what is ordered."""
    hang_s = PROFILE.planner.complete.hang_s
    recent, longer = (
        _was_fresh(seen, hang_s),
        _was_fresh(seen, hang_s + EXTRA_HANGING_DWELL_IF_THRUST_UNCONFIRMED_S),
    )
    if longer is not None and all(_at_rest(o) for o in longer):
        return True
    return recent is not None and all(_at_rest(o) and o.telemetry.thrust <= 5000.0 for o in recent)


def motors_off(seen: list[Observation]) -> bool:
    """The motors stand already, as the supervisor may have stopped them."""
    recent = _was_fresh(seen, MOTORS_OFF_DWELL_S)
    return recent is not None and all(
        o.telemetry.thrust == 0.0 and o.telemetry.supervisor == READY for o in recent
    )


@pytest.mark.long
@settings(max_examples=400)
@example(
    bits=[(8, 0.02, 0.0, 1.0, 0.0, 0.01)],
    begin={"vehicle_world_z_at_last_contact_m": HANG_Z_M, "weight_transfer_began_at_s": 9.9},
    doubt={},
    flying=False,
)
@given(
    bits=st.lists(BITS, min_size=1, max_size=6),
    begin=st.sampled_from(STATES),
    doubt=st.sampled_from(
        [
            {},
            {"has_estimated_position_jumped": True},
            {"link_problem": "gone"},
            {"tick_start_delay_s": 0.5},
        ]
    ),
    flying=st.booleans(),
)
def test_a_landing_stops_no_motor_without_the_floor_or_the_ceiling(
    bits: list[Bit], begin: dict[str, Any], doubt: dict[str, Any], flying: bool
) -> None:
    state, seen, ground_z_m, t_s = landing(1.0, **begin), [], {}, 10.0
    for ticks, z_m, climb_mps, acc_g, thrust, age_s in bits:
        look = at(
            z_m, age_s=age_s, obs=doubt, velocity_mps=(0.0, 0.0, climb_mps), acc_z_g=acc_g,
            thrust=thrust, supervisor=AIRBORNE if flying else READY,
        )  # fmt: skip
        for _ in range(ticks):
            t_s += TICK_S
            seen.append(look(t_s))
            state, command = step_mission(state, seen[-1], PROFILE)
            assert not isinstance(command, EmergencyStop)
            assert state.belief.takeoff_position_m is not None
            ground_z_m[t_s] = state.belief.takeoff_position_m[2]
            if isinstance(command, StopMotors):
                floor = on_the_floor(
                    seen,
                    ground_z_m,
                    state.entry.vehicle_world_position_m[2] - state.belief.takeoff_position_m[2],
                )
                ceiling = (begin or state.weight_transfer_began_at_s) and on_the_ceiling(seen)
                assert floor or ceiling or (state.weight_transfer_began_at_s and motors_off(seen))
                return
            if state.phase is not Phase.LANDING:
                return


@pytest.mark.parametrize(
    ("thrust", "heard", "ends"),
    [(0.0, True, Phase.LANDED), (0.0, False, Phase.LANDING), (5000.0, True, Phase.LANDING)],
)
def test_a_loop_that_hangs_in_every_turn_sees_a_landing_end(
    thrust: float, heard: bool, ends: Phase
) -> None:
    """Each turn is longer than what makes the samples from before it stale; those of the turn
    itself have come, and tell whether the motors were off all the time."""
    state, felt, turn_s = landing(1.0), Felt(), PROFILE.positioning.hold_s + 0.15
    samples = int(turn_s / 0.01)
    for i in range(1, 8 * samples):
        # As something gives it thrust shortly before each turn.
        off = {**OFF, "thrust": thrust if i % samples == samples - 5 else 0.0}
        obs = at(0.02, obs={"target": None}, **off)(10.0 + 0.01 * i)
        if heard or i % samples < 2:
            obs = felt(obs)
        if i % samples == 0:
            state, _ = step_mission(state, obs, PROFILE)
    assert state.phase is ends


@pytest.mark.parametrize(("z_m", "ends"), [(HANG_Z_M, Phase.PERCHED), (0.02, Phase.LANDED)])
def test_motors_that_are_off_despite_an_order_are_stopped_before_the_flight_ends(
    z_m: float, ends: Phase
) -> None:
    """The supervisor ends a flight whose motors idle, and soon lets them turn by the last order
    again: seed 20731163 ended with raw thrust as its last order, and a motor turned 5 s later."""
    idles = at(z_m, acc_z_g=1.15, **OFF)
    ticks = fly(
        hanging(commanded_raw_thrust=1000, weight_transfer_began_at_s=BEGIN_S), idles, 3.0
    ).ticks
    assert ticks[-1].state.phase is ends
    orders = [tick.command for tick in ticks if not isinstance(tick.command, Idle)]
    assert isinstance(orders[-1], StopMotors)
    first = next(tick for tick in ticks if isinstance(tick.command, StopMotors))
    assert first.t_s - BEGIN_S >= 0.1, "one sample is no evidence"
    assert not any(isinstance(tick.command, RawThrust) for tick in ticks if tick.t_s > first.t_s)


@pytest.mark.parametrize("bit", [LOCKED, TUMBLED, CRASHED])
def test_the_supervisors_word_has_no_age(bit: int) -> None:
    """Whoever was locked before the telemetry stopped has its motors off: no landing is flown."""
    flight = fly(landing(1.0, Phase.ALIGN), at(age_s=0.5, supervisor=AIRBORNE | bit))
    assert flight.state.phase is Phase.ABORTED
    assert isinstance(flight.command, StopMotors)


@pytest.mark.parametrize(
    ("distance_below_m", "ends", "words"),
    [
        (0.0, Phase.PERCHED, "hanging"),
        (0.08, Phase.PERCHED, "hanging"),  # as far as an old estimate may have drifted
        (0.2, Phase.ABORTED, "something holds the vehicle"),
        (0.6, Phase.LANDED, "motors off"),  # a height that stood still above the floor
    ],
)
def test_what_has_not_come_down_hangs_where_the_target_is(
    distance_below_m: float, ends: Phase, words: str
) -> None:
    """Its own landing ended up there, motors off."""
    z_m = HANG_Z_M - distance_below_m
    target = target_at(
        BEGIN_S, body_m=(0.0, 0.0, z_m), is_measured_in_newest_frame=False, last_measured_at_s=-20.0
    )
    begin = landing(z_m, stop_or_land_command_count=3, last_stop_or_land_command_at_s=9.9)
    state = fly(begin, at(z_m, obs={"target": target}, **OFF), 2.4).state
    assert state.phase is ends
    assert words in state.transition_reason


# --- What something holds ------------------------------------------------------------------------


class InAHand(Motors):
    """A hand holds it so far below the target, whatever its motors do."""

    def __init__(
        self, distance_below_m: float, lateral_offset_m: float = 0.0, sigma_m: float = 1e-3,
        seen_until_s: float = math.inf,
    ) -> None:  # fmt: skip
        super().__init__()
        self.distance_below_m, self.lateral_offset_m, self.sigma_m = (
            distance_below_m,
            lateral_offset_m,
            sigma_m,
        )
        self.seen_until_s = seen_until_s

    def look(self, t_s: float, state: PlannerState) -> Observation:
        at_m = (self.lateral_offset_m, 0.0, HANG_Z_M - self.distance_below_m)
        target = target_at(
            t_s, body_m=at_m, sigma_m=np.full(3, self.sigma_m), tracked=self.distance_below_m > 0.1
        )
        unseen_s = max(0.0, t_s - self.seen_until_s)
        if unseen_s:
            target = replace(
                target,
                is_measured_in_newest_frame=False,
                tracked=False,
                last_measured_at_s=self.seen_until_s,
            )
        tel = telemetry(t_s, thrust=self.thrust, position_m=at_m)
        return observation(t_s, telemetry=tel, target=target, external_position_age_s=unseen_s)


@pytest.mark.parametrize(
    ("positioning", "seen_until_s"), [("deck", math.inf), ("target", math.inf), ("target", 13.0)]
)
@pytest.mark.parametrize(
    "phase",
    [
        pytest.param(Phase.SEARCH, marks=pytest.mark.long),
        pytest.param(Phase.ALIGN, marks=pytest.mark.long),
        Phase.ASCEND,
        pytest.param(Phase.RECOVER, marks=pytest.mark.long),
    ],
)
def test_what_a_hand_holds_below_the_target_has_not_perched(
    phase: Phase, positioning: str, seen_until_s: float
) -> None:
    """Not even where it was pressed before, and a contact seemed to be there; nor once the target
    that tells it is out of sight."""
    begin = landing(HANG_Z_M - 0.2, phase, vehicle_world_z_at_last_contact_m=HANG_Z_M - 0.2)
    hand = InAHand(0.2, seen_until_s=seen_until_s)
    flight = fly(begin, hand, 20.0, PROFILES[positioning], feels=True)
    state = flight.state
    assert (state.phase, state.outcome) == (Phase.ABORTED, Outcome.SAFETY)
    assert state.transition_name == "held-elsewhere"
    # It neither fights on in the hand, nor stops without its weight having hung in it.
    assert flight.stops_s[0] < 10.0 + 8.0
    assert flight.stops_s[0] - flight.still_s[0] >= PROFILE.planner.complete.hang_s - 0.05


@pytest.mark.parametrize(
    ("distance_below_m", "lateral_offset_m", "sigma_m", "to"),
    [
        (0.0, 0.0, 0.001, Phase.COMPLETE),
        (0.04, 0.02, 0.001, Phase.COMPLETE),
        (0.06, 0.0, 0.001, Phase.LANDING),  # in sight, so that nothing has drifted
        (0.0, 0.03, 0.001, Phase.LANDING),  # beside the magnet
        (0.0, 0.0, 0.03, Phase.LANDING),  # perhaps beside
        (0.0, 0.0, math.inf, Phase.LANDING),  # nobody knows
    ],
)
def test_only_what_hangs_at_the_target_is_caught(
    distance_below_m: float, lateral_offset_m: float, sigma_m: float, to: Phase
) -> None:
    begin = landing(
        HANG_Z_M - distance_below_m,
        Phase.RECOVER,
        vehicle_world_z_at_last_contact_m=HANG_Z_M - distance_below_m,
    )
    assert (
        fly(
            begin, InAHand(distance_below_m, lateral_offset_m, sigma_m), 2.18, feels=True
        ).state.phase
        is to
    )


class BacksOff(Motors):
    """Pressed out of sight of the target, and backed off from; what it touched holds it. The
    estimate goes on sliding, by 2 cm/s."""

    def __init__(self, lateral_offset_m: float, sigma_m: float) -> None:
        super().__init__(1.2 * HOVER_THRUST)
        self.lateral_offset_m, self.sigma_m = lateral_offset_m, sigma_m

    def look(self, t_s: float, state: PlannerState) -> Observation:
        body_m = (self.lateral_offset_m + 0.02 * max(0.0, t_s - 10.5), 0.0, HANG_Z_M)
        target = target_at(
            t_s, body_m=body_m, sigma_m=np.full(3, self.sigma_m), is_measured_in_newest_frame=False,
            tracked=False, last_measured_at_s=10.0, measured_gear_to_target_world_m=None,
        )  # fmt: skip
        return at(obs={"target": target}, position_m=body_m, thrust=self.thrust)(t_s)

    def obey(self, state: PlannerState, command: Command) -> None:
        if not (isinstance(command, PositionSetpoint) and state.phase is Phase.PERCH):
            super().obey(state, command)


@pytest.mark.parametrize(
    ("lateral_offset_m", "sigma_m", "row", "ends", "outcome"),
    [
        (0.012, 0.022, "caught", Phase.PERCHED, Outcome.PERCHED),
        (0.04, 0.01, "hangs-at-contact", Phase.PERCHED, Outcome.SAFETY),
        *(
            pytest.param(
                0.012,
                sigma_m,
                "hangs-at-contact",
                Phase.PERCHED,
                Outcome.SAFETY,
                marks=pytest.mark.long,
            )
            for sigma_m in (0.075, math.inf)
        ),
        (0.06, 0.01, "held", Phase.ABORTED, Outcome.SAFETY),
    ],
)
def test_what_hangs_where_it_touched_the_target_is_told_by_its_place_there(
    lateral_offset_m: float, sigma_m: float, row: str, ends: Phase, outcome: Outcome
) -> None:
    """Not by where the estimate slides to meanwhile, 4 cm farther aside."""
    begin = landing(HANG_Z_M, Phase.PERCH)
    flight = fly(begin, BacksOff(lateral_offset_m, sigma_m), 16.0, feels=True)
    assert {"beside-the-magnet", row} <= flight.rows
    assert (flight.state.phase, flight.state.outcome) == (ends, outcome)
    if ends is Phase.PERCHED:
        assert flight.state.belief.gear_to_target_at_last_contact is not None
        assert flight.state.belief.gear_to_target_at_last_contact.distance_xy_m == pytest.approx(
            lateral_offset_m
        )


# --- Where it touched, as it is remembered -------------------------------------------------------


@pytest.mark.parametrize(("share", "steady_s", "since_s", "touched"), [
    (1.2, 99, 10.0, False), (1.2, 99, 9.0, True), (1.2, 9.0, 10.0, True), (0.5, 9.0, 10.0, True),
])  # fmt: skip
def test_one_sample_that_looks_like_a_contact_is_no_touch_and_what_carries_it_is_one(
    share: float, steady_s: float, since_s: float, touched: bool
) -> None:
    tel = telemetry(10.02, HANG_Z_M, thrust=share * HOVER_THRUST)
    pressing = landing(phase=Phase.PERCH, condition_start_times_s={TARGET_CONTACT: since_s})
    row = next(row for row in TABLE if row.name == "no-contact")
    backs_off = (replace(row, when=lambda c: True),)
    obs = observation(10.02, telemetry=tel, imu=ImuMotion(climb_rate_became_steady_at_s=steady_s))
    after, _ = step_mission(pressing, obs, PROFILE, backs_off)
    assert after.phase is Phase.RECOVER
    assert (after.belief.gear_to_target_at_last_contact is not None) is touched


def test_what_has_left_its_contact_forgets_where_that_was_and_only_that_has_recovered() -> None:
    """Steady because it sticks there, the next attempt would begin pressed."""
    touched = hanging(
        Phase.RECOVER, gear_to_target_at_last_contact=GearToTargetDistance(0.01, 0.02)
    )
    state = fly(touched, at(HANG_Z_M - 0.1)).state
    assert (
        state.belief.vehicle_world_z_at_last_contact_m,
        state.belief.gear_to_target_at_last_contact,
    ) == (
        None,
        None,
    )
    assert fly(touched, at(HANG_Z_M), 1.2).state.phase is Phase.RECOVER


# --- The release -----------------------------------------------------------------------


@pytest.mark.parametrize(("obs", "is_held_by_target"), [({"target": None}, True), ({}, False)])
def test_a_landing_that_does_not_come_down_is_held_unless_its_target_is_far_above(
    obs: dict[str, Any], is_held_by_target: bool
) -> None:
    flight = fly(landing(1.5), at(1.5, obs=obs, thrust=20000.0), 1.2)
    assert isinstance(flight.command, RawThrust) is is_held_by_target


def test_a_release_that_nobody_sees_goes_back_to_a_setpoint() -> None:
    """Still motors would be a stop without a proof: what the magnet lets go of meanwhile is
    on the floor before the link counts as lost. Seen again, it begins anew."""
    look = at(HANG_Z_M, thrust=1000.0)
    half_way = hanging(Phase.COMPLETE, entered_s=8.0, weight_transfer_began_at_s=9.5, t_s=9.98)
    state, command = step_mission(half_way, look(10.0), PROFILE)
    assert isinstance(command, RawThrust)
    state, command = step_mission(state, replace(look(10.0), t_s=10.2), PROFILE)
    assert is_setpoint(command, above_m=HANG_Z_M)
    assert state.weight_transfer_began_at_s is None
    for i in range(12):
        seen_again = at(HANG_Z_M, thrust=20000.0)(10.22 + TICK_S * i)
        state, command = step_mission(state, seen_again, PROFILE)
        assert isinstance(command, PositionSetpoint), i


@pytest.mark.parametrize("positioning", ["deck", pytest.param("target", marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("frozen", "ends"),
    [
        ({"thrust": 0.0, "supervisor": AIRBORNE}, Phase.PERCHED),
        pytest.param(
            {"thrust": 1000.0, "supervisor": READY}, Phase.ABORTED, marks=pytest.mark.long
        ),
        ({"thrust": 20000.0, "supervisor": AIRBORNE}, Phase.ABORTED),
    ],
)
def test_a_completion_whose_telemetry_stands_still_ends(
    frozen: dict[str, float], ends: Phase, positioning: str
) -> None:
    """The supervisor's word, or the thrust, reads as before the stop. Nothing spins up again."""
    stopped = hanging(
        Phase.COMPLETE,
        magnet_reach_entered_at_s=9.0,
        weight_transfer_began_at_s=9.0,
        motor_stop_commanded_at_s=10.0,
        last_stop_or_land_command_at_s=10.0,
        stop_or_land_command_count=1,
    )
    flight = fly(stopped, at(HANG_Z_M, **frozen), 50.0, PROFILES[positioning], feels=True)
    assert all(isinstance(command, StopMotors | Idle) for command in flight.commands)
    assert flight.state.phase is ends


# --- A slip ---------------------------------------------------------------------------


def test_what_peels_off_too_fast_is_caught() -> None:
    """At thrustMin the magnet lets go of a vehicle that has no thrust to go on down with."""
    flight = fly(hanging(), at(HANG_Z_M - 0.03, velocity_mps=SINKS, thrust=20000.0))
    assert flight.state.phase is Phase.LANDING
    assert is_setpoint(flight.command, above_m=HANG_Z_M + 0.5)


def test_a_falling_vehicle_does_not_hang_at_its_contact() -> None:
    """Locked by a lost notify while it slips: it is not reported as perched."""
    locked = {**OFF, "supervisor": READY | LOCKED, "velocity_mps": (0.0, 0.0, -0.9)}
    flight = fly(
        hanging(Phase.COMPLETE, motor_stop_commanded_at_s=9.0, stop_or_land_command_count=5),
        at(HANG_Z_M - 0.05, **locked),
    )
    assert flight.state.phase is not Phase.PERCHED


def test_nothing_is_caught_on_an_old_speed() -> None:
    """Two seconds of full thrust on a speed of long ago would end far above."""
    below = PositionSetpoint(0.0, 0.0, HANG_Z_M - 0.25, 0.0)
    slipped = landing(
        HANG_Z_M, Phase.RECOVER, fall_catch_setpoint_above_vehicle_m=1.0, setpoint=below
    )
    late = at(HANG_Z_M - 0.1, age_s=0.2, velocity_mps=SINKS, thrust=1000.0, acc_z_g=0.2)
    _, command = step_mission(slipped, late(10.08), PROFILE)
    assert is_setpoint(command, distance_below_m=HANG_Z_M + 0.1)


# --- A step of the estimate -------------------------------------------------------------


@pytest.mark.parametrize(
    ("gap_s", "moves"), [(0.02, True), (0.1, True), (0.3, False), (5.0, False)]
)
def test_a_step_behind_missing_samples_may_be_the_vehicle_s(gap_s: float, moves: bool) -> None:
    """It was at rest before the silence and is at rest after it: on the floor. Else what is
    remembered moves with the estimate."""
    state = landing(1.0, last_telemetry=telemetry(10.0, 1.0))
    new, _ = step_mission(
        state, at(0.02, obs={"has_estimated_position_jumped": True})(10.0 + gap_s), PROFILE
    )
    assert state.belief.takeoff_position_m is not None
    assert new.belief.takeoff_position_m is not None
    assert new.belief.takeoff_position_m[2] - state.belief.takeoff_position_m[2] == pytest.approx(
        -0.98 if moves else 0.0
    )
    assert not moves or new.entry.vehicle_world_position_m[2] == pytest.approx(
        0.02
    )  # it has not moved: held where it is


def test_a_step_in_its_own_landing_is_braked_then_the_order_given_anew() -> None:
    """By the line in the world that was it would dive by the step."""
    lands = AIRBORNE | HL_ACTIVE
    state = landing(
        0.4,
        stop_or_land_command_count=3,
        last_stop_or_land_command_at_s=9.0,
        last_telemetry=telemetry(9.98, 0.4, supervisor=lands),
    )
    up = at(
        0.9,
        obs={"has_estimated_position_jumped": True},
        velocity_mps=(0.0, 0.0, -0.3),
        supervisor=lands,
    )
    state, command = step_mission(state, up(10.0), PROFILE)
    assert is_setpoint(command, above_m=1.2)
    slow = at(0.87, velocity_mps=(0.0, 0.0, -0.05), supervisor=lands)
    state, command = step_mission(state, slow(10.14), PROFILE)
    assert isinstance(command, Land)
    assert state.belief.takeoff_position_m is not None
    assert command.height_m < state.belief.takeoff_position_m[2]


# --- Its own landing -----------------------------------------------------------------


def cut(z_m: float, climb_mps: float, **obs: Any) -> Look:
    """Motors that stand still in a fall."""
    return at(z_m, obs=obs, thrust=0.0, acc_z_g=0.02, velocity_mps=(0.0, 0.0, climb_mps))


OVERDUE = landing(3.0, entered_s=10.0 - 0.6 * PROFILE.planner.landing.timeout_s)
ORDERED, LOW = (
    landing(1.5, stop_or_land_command_count=1, last_stop_or_land_command_at_s=9.5),
    landing(1.5, stop_or_land_command_count=3, last_stop_or_land_command_at_s=5.0),
)
HIGH = landing(1.8, stop_or_land_command_count=3, last_stop_or_land_command_at_s=5.0)


@pytest.mark.parametrize(
    ("begin", "look", "again"),
    [
        # At the time's end nothing is sent any more, and setpoints that end are cut.
        (OVERDUE, at(3.0, obs={"target": None}), True),
        # Orders lost, their notify not: cut in the air, and told to land again.
        (ORDERED, cut(1.4, -0.4), True),
        (ORDERED, at(0.02, thrust=0.0), False),
        # It falls for a moment, a hand above the floor. Another order would start the motors once
        # more there, each time by an estimate that has gone further astray; a real fall is braked.
        (LOW, cut(0.0, -0.4), False),
        (LOW, cut(0.0, -1.2), True),
        # The motors stop far above the floor: that is no landing's end, unless no position tells
        # how far above.
        (HIGH, cut(1.5, -0.3), True),
        (HIGH, cut(0.3, -0.3), False),
        (HIGH, cut(1.5, -0.3, external_position_age_s=2.0), False),
    ],
    ids=["overdue", "cut", "stands", "drops", "falls", "cut high", "cut low", "cut unplaced"],
)
def test_a_landing_of_its_own_is_ordered_while_it_is_in_the_air(
    begin: PlannerState, look: Look, again: bool
) -> None:
    command = fly(begin, look).command
    assert isinstance(command, Land if again else Idle | StopMotors)


@given(z_m=st.floats(-2.0, 3.0), flown_s=st.floats(0.0, 60.0))
def test_its_own_landing_is_slow_and_aims_lower_the_longer_the_estimate_has_drifted(
    z_m: float, flown_s: float
) -> None:
    """Also from below the ground, from where it would climb to it. Of a quintic the largest speed
    is 15/8 of the mean; it begins while the vehicle sinks, which costs time that is not way."""
    config = PROFILE.planner.landing
    order = make_onboard_landing_command(PROFILE.planner, 0.0, flown_s, z_m)
    drift_m = min(MAX_ASSUMED_HEIGHT_DRIFT_FOR_LANDING_GOAL_M, config.drift_mps * flown_s)
    assert order.height_m == pytest.approx(min(0.0, z_m) - config.undershoot_m - drift_m)
    way_m = z_m - order.height_m
    assert 15 / 8 * way_m / (order.duration_s - ONBOARD_LANDING_DURATION_MARGIN_S) == pytest.approx(
        ONBOARD_LANDING_PEAK_SPEED_MPS
    )


# --- What stays up, or stands still ----------------------------------------------------


@pytest.mark.parametrize(
    "frozen",
    [{"roll_rad": 0.1}, {"position_m": (0.0, 0.0, 1.01), "velocity_mps": (0.0, 0.0, 0.01)}],
    ids=["attitude", "position and velocity"],
)
def test_what_stands_still_is_telemetry_that_grows_old(frozen: dict[str, Any]) -> None:
    """By such an attitude a target that is seen is looked for where it is not; by such a speed an
    offset of the accelerometer seems to be there that is none."""
    felt = Felt()
    felt(at()(BEGIN_S))
    flight = fly(landing(1.0, Phase.ALIGN), at(**frozen), 1.4, feels=felt, one_phase=True)
    assert flight.state.transition_name == "telemetry-stale"
    last_stale_s = PROFILE.safety.telemetry_land_s
    assert flight.ticks[-1].t_s - BEGIN_S == pytest.approx(last_stale_s, abs=0.1)


@pytest.mark.parametrize(("drift_m", "descended_m", "leaves"), [
    (0.0, 0.0, False), (0.0, 0.06, True), (0.08, 0.0, False), (0.08, 0.06, True),
])  # fmt: skip
def test_only_its_own_way_down_takes_a_vehicle_off_its_contact(
    drift_m: float, descended_m: float, leaves: bool
) -> None:
    """An estimate that sank during the contact does not: extreme seed 21231252 still hung."""
    begins_m = HANG_Z_M - drift_m
    state = remembering(
        state_in(Phase.RECOVER, z_m=begins_m), vehicle_world_z_at_last_contact_m=HANG_Z_M
    )
    for t_s in times(0.1):
        state, _ = step_mission(state, at(begins_m - descended_m)(t_s), PROFILE)
    assert (state.belief.vehicle_world_z_at_last_contact_m is None) is leaves
