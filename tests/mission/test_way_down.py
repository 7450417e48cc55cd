"""The way down: what ends a landing, what presses, hangs, slips or steps, and what is not seen."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.mission import (
    CATCHABLE_M,
    Observation,
    Operator,
    Outcome,
    Phase,
    PlannerState,
    planner,
)
from perchctl.mission.conditions import touched_aside_m
from perchctl.mission.context import Context
from perchctl.mission.guidance import UNREAD_S
from perchctl.mission.lander import MOST_DRIFT_M, PLANNED_MPS, SETTLING_S, own_landing
from perchctl.mission.state import Condition
from perchctl.mission.table import TABLE
from perchctl.profile import Profile
from perchctl.vehicle import (
    CRASHED,
    FULL_THRUST,
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
    target_at,
    telemetry,
)


def test_a_floor_at_the_wrong_height_is_a_floor() -> None:
    """After a minute of drift the estimate has it at 0.4 m: come down, carried by something
    that is not the ceiling, and still."""
    state = state_in(Phase.LANDING, z_m=1.5)
    for i in range(1, 60):
        t_s = 10.0 + 0.02 * i
        tel = telemetry(t_s, 0.4, thrust=20000.0)
        state, command = planner.step_mission(state, observation(t_s, telemetry=tel), PROFILE)
        if isinstance(command, StopMotors):
            break
    assert 0.5 <= t_s - 10.0 < 0.7


@pytest.mark.parametrize("phase", [Phase.LANDING, Phase.RECOVER])
def test_a_way_down_that_begins_pressed_goes_far_below_until_it_is_away(phase: Phase) -> None:
    """The integrators that a second of full thrust has wound up hold it there for seconds."""
    state = replace(state_in(phase, z_m=1.0), pressed=True)
    tel = telemetry(10.02, 1.0, thrust=65535.0)
    state, command = planner.step_mission(state, observation(10.02, telemetry=tel), PROFILE)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m < 0.2
    away = telemetry(10.5, 0.85, thrust=45000.0, velocity_mps=(0.0, 0.0, -0.1))
    state, command = planner.step_mission(state, observation(10.5, telemetry=away), PROFILE)
    assert not state.pressed
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > 0.4


def test_what_presses_when_its_way_down_begins_is_remembered() -> None:
    for thrust, pressed in ((65535.0, True), (42000.0, False)):
        state = state_in(Phase.SEARCH, z_m=1.0)
        tel = telemetry(10.02, 1.0, thrust=thrust)
        obs = observation(10.02, telemetry=tel, operator=Operator.LAND)
        state, _ = planner.step_mission(state, obs, PROFILE)
        assert state.phase is Phase.LANDING
        assert state.pressed is pressed


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
STATES: tuple[dict[str, object], ...] = (
    {},
    {"contact_z_m": HANG_Z_M},
    {"contact_z_m": HANG_Z_M, "released_s": 9.9},
    {"orders": 2, "ordered_s": 9.9},
    {"hover_thrust": 0.0},
)


def _was_fresh(seen: list[Observation], for_s: float) -> list[Observation] | None:
    """What was observed in that time, None unless there was something, all of it fresh."""
    now_s = seen[-1].t_s
    recent = [o for o in seen if o.t_s >= now_s - for_s - 1e-6]
    long_enough = now_s - recent[0].t_s >= for_s - 1e-6
    fresh = all(o.t_s - o.telemetry.t_s <= PROFILE.safety.proof_age_s + 1e-9 for o in recent)
    return recent if long_enough and fresh else None


def _at_rest(tel: Telemetry) -> bool:
    return abs(tel.velocity_mps[2]) < 0.05 and abs(tel.acc_z_g - 1.0) <= 0.12


def on_the_floor(seen: list[Observation], ground_z_m: dict[float, float], entry_m: float) -> bool:
    """Half a second at rest, down, away from the target, on what could not carry it. Heights
    are over the ground, which steps with the estimate: `ground_z_m` by time, and the landing
    began at `entry_m`."""
    recent = _was_fresh(seen, 0.5)
    return recent is not None and all(
        _at_rest(o.telemetry)
        and o.telemetry.thrust <= 0.6 * HOVER_THRUST
        and o.telemetry.position_m[2] - ground_z_m[o.t_s] < max(0.3, entry_m - 0.1) + 1e-9
        and o.telemetry.position_m[2] < HANG_Z_M - 0.3
        for o in recent
    )


def on_the_ceiling(seen: list[Observation]) -> bool:
    """The whole weight for as long as it takes, where the target is or the contact was; longer
    where the thrust that is read does not follow what is ordered."""
    hang_s = PROFILE.planner.complete.hang_s
    recent, longer = _was_fresh(seen, hang_s), _was_fresh(seen, hang_s + UNREAD_S)
    if longer is not None and all(_at_rest(o.telemetry) for o in longer):
        return True
    return recent is not None and all(
        _at_rest(o.telemetry) and o.telemetry.thrust <= 5000.0 for o in recent
    )


@pytest.mark.long
@settings(max_examples=400)
@given(
    bits=st.lists(BITS, min_size=1, max_size=6),
    begin=st.sampled_from(STATES),
    doubt=st.sampled_from([{}, {"jumped": True}, {"link_problem": "gone"}, {"loop_late_s": 0.5}]),
    flying=st.booleans(),
)
def test_a_landing_stops_no_motor_without_the_floor_or_the_ceiling(
    bits: list[Bit], begin: dict[str, object], doubt: dict[str, object], flying: bool
) -> None:
    state = replace(state_in(Phase.LANDING), **begin)  # type: ignore[arg-type]
    seen: list[Observation] = []
    ground_z_m: dict[float, float] = {}
    t_s = 10.0
    for ticks, z_m, climb_mps, acc_g, thrust, age_s in bits:
        for _ in range(ticks):
            t_s += 0.02
            tel = telemetry(
                t_s - age_s, z_m, velocity_mps=(0.0, 0.0, climb_mps), acc_z_g=acc_g,
                thrust=thrust, supervisor=AIRBORNE if flying else READY,
            )  # fmt: skip
            obs = observation(t_s, telemetry=tel, **doubt)
            seen.append(obs)
            state, command = planner.step_mission(state, obs, PROFILE)
            assert not isinstance(command, EmergencyStop)
            assert state.ground_m is not None
            ground_z_m[t_s] = state.ground_m[2]
            if isinstance(command, StopMotors):
                floor = on_the_floor(seen, ground_z_m, state.entry_m[2] - state.ground_m[2])
                assert floor or ((begin or state.released_s) and on_the_ceiling(seen))
                return
            if state.phase is not Phase.LANDING:
                return


@pytest.mark.parametrize("z_m", [0.02, HANG_Z_M])
def test_a_landing_that_is_proven_stops_the_motors(z_m: float) -> None:
    """What the test above looks for does happen."""
    begin = STATES[2] if z_m > 1.0 else {"orders": 1, "ordered_s": 9.9}
    state = replace(state_in(Phase.LANDING), **begin)  # type: ignore[arg-type]
    sent: list[object] = []
    for i in range(1, 120):
        tel = telemetry(10.0 + 0.02 * i, z_m, thrust=1000.0)
        state, command = planner.step_mission(state, observation(tel.t_s, telemetry=tel), PROFILE)
        sent.append(command)
    assert any(isinstance(c, StopMotors) for c in sent)


@pytest.mark.parametrize(
    ("thrust", "heard", "ends"),
    [(0.0, True, Phase.LANDED), (0.0, False, Phase.LANDING), (5000.0, True, Phase.LANDING)],
)
def test_a_loop_that_hangs_in_every_turn_sees_a_landing_end(
    thrust: float, heard: bool, ends: Phase
) -> None:
    """Each turn is longer than what makes the samples from before it stale; those of the turn
    itself have come, and tell whether the motors were off all the time."""
    state, felt, turn_s = state_in(Phase.LANDING), Felt(), PROFILE.positioning.hold_s + 0.15
    samples = int(turn_s / 0.01)
    for i in range(1, 8 * samples):
        tel = telemetry(10.0 + 0.01 * i, 0.02, thrust=0.0, supervisor=READY)
        if i % samples == samples - 5:
            tel = replace(tel, thrust=thrust)  # as something gives it shortly before each turn
        obs = observation(tel.t_s, telemetry=tel, target=None)
        if heard or i % samples < 2:
            obs = felt(obs)
        if i % samples == 0:
            state, _ = planner.step_mission(state, obs, PROFILE)
    assert state.phase is ends


# --- How old a word may be -----------------------------------------------------------------------


@pytest.mark.parametrize("bit", [LOCKED, TUMBLED, CRASHED])
def test_the_supervisors_word_has_no_age(bit: int) -> None:
    """Whoever was locked before the telemetry stopped has its motors off: no landing is flown."""
    state = state_in(Phase.ALIGN)
    last = telemetry(10.0, supervisor=AIRBORNE | bit)
    state, command = planner.step_mission(state, observation(10.5, telemetry=last), PROFILE)
    assert state.phase is Phase.ABORTED
    assert isinstance(command, StopMotors)


def test_what_hangs_teaches_no_hover_thrust() -> None:
    """Stuck to the ceiling on a third of the thrust, it would seem to hover on that, and its
    hanging would never be noticed."""
    state = state_in(Phase.ASCEND)
    for i in range(1, 200):
        tel = telemetry(10.0 + 0.02 * i, 1.0, thrust=20000.0)
        state, _ = planner.step_mission(state, observation(tel.t_s, telemetry=tel), PROFILE)
        assert state.hover_thrust > 0.8 * HOVER_THRUST


@pytest.mark.parametrize(
    ("below_m", "ends", "words"),
    [
        (0.0, Phase.PERCHED, "hanging"),
        (0.08, Phase.PERCHED, "hanging"),  # as far as an old estimate may have drifted
        (0.2, Phase.ABORTED, "something holds it"),
        (0.6, Phase.LANDED, "motors off"),  # a height that stood still above the floor
    ],
)
def test_what_has_not_come_down_hangs_where_the_target_is(
    below_m: float, ends: Phase, words: str
) -> None:
    """Its own landing ended up there, motors off."""
    z_m = HANG_Z_M - below_m
    state = replace(state_in(Phase.LANDING, z_m=z_m), orders=3, ordered_s=9.9)
    for i in range(1, 120):
        tel = telemetry(10.0 + 0.02 * i, z_m, thrust=0.0, supervisor=READY)
        target = target_at(tel.t_s, body_m=(0.0, 0.0, z_m), measured=False, measured_s=-20.0)
        state, _ = planner.step_mission(
            state, observation(tel.t_s, telemetry=tel, target=target), PROFILE
        )
    assert state.phase is ends
    assert words in state.reason


def in_a_hand(
    begin: PlannerState, below_m: float, aside_m: float = 0.0, sigma_m: float = 1e-3,
    profile: Profile = PROFILE, lasts_s: float = 20.0, seen_until_s: float = math.inf,
) -> tuple[PlannerState, list[tuple[float, Command]]]:  # fmt: skip
    """A hand holds it so far below the target, whatever its motors do; they do as ordered, and a
    setpoint makes them turn at a third."""
    felt, state, thrust = Felt(), begin, 0.34 * HOVER_THRUST
    z_m, sent = HANG_Z_M - below_m, []
    for i in range(1, round(lasts_s / 0.02)):
        t_s = 10.0 + 0.02 * i
        tel = replace(telemetry(t_s, z_m, thrust=thrust), position_m=(aside_m, 0.0, z_m))
        target = target_at(
            t_s, body_m=(aside_m, 0.0, z_m), sigma_m=np.full(3, sigma_m), tracked=below_m > 0.1
        )
        unseen_s = max(0.0, t_s - seen_until_s)
        if unseen_s:
            target = replace(target, measured=False, tracked=False, measured_s=seen_until_s)
        obs = observation(t_s, telemetry=tel, target=target, position_age_s=unseen_s)
        state, command = planner.step_mission(state, felt(obs), profile)
        sent.append((t_s, command))
        if state.phase.is_over:
            break
        match command:
            case RawThrust(order):
                thrust = 0.0 if order < 5000 else float(order)
            case StopMotors():
                thrust = 0.0
            case PositionSetpoint():
                thrust = 0.34 * HOVER_THRUST
    return state, sent


@pytest.mark.parametrize(
    ("positioning", "seen_until_s"), [("deck", math.inf), ("target", math.inf), ("target", 13.0)]
)
@pytest.mark.parametrize("phase", [Phase.SEARCH, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER])
def test_what_a_hand_holds_below_the_target_has_not_perched(
    phase: Phase, positioning: str, seen_until_s: float
) -> None:
    """Not even where it was pressed before, and a contact seemed to be there; nor once the target
    that tells it is out of sight."""
    begin = replace(state_in(phase, z_m=HANG_Z_M - 0.2), contact_z_m=HANG_Z_M - 0.2)
    profile = Profile.model_validate({"positioning": positioning})
    state, sent = in_a_hand(begin, 0.2, profile=profile, seen_until_s=seen_until_s)
    assert (state.phase, state.outcome) == (Phase.ABORTED, Outcome.SAFETY)
    assert state.row == "held-elsewhere"
    # It neither fights on in the hand, nor stops without its weight having hung in it.
    first_s = next(t_s for t_s, command in sent if isinstance(command, StopMotors))
    assert first_s < 10.0 + 8.0
    still = [t_s for t_s, c in sent if isinstance(c, RawThrust) and c.thrust <= 5000]
    assert first_s - still[0] >= PROFILE.planner.complete.hang_s - 0.05


@pytest.mark.parametrize(
    ("below_m", "aside_m", "sigma_m", "to"),
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
    below_m: float, aside_m: float, sigma_m: float, to: Phase
) -> None:
    begin = state_in(Phase.RECOVER, z_m=HANG_Z_M - below_m)
    begin = replace(begin, contact_z_m=HANG_Z_M - below_m)
    state, _ = in_a_hand(begin, below_m, aside_m, sigma_m, lasts_s=2.2)
    assert state.phase is to


def backed_off_from(
    aside_m: float, sigma_m: float, *, below_m: float = 0.0, comes_off: bool = False,
    profile: Profile = PROFILE,
) -> tuple[PlannerState, set[str]]:  # fmt: skip
    """Pressed out of sight of the target, and backed off from; what it touched holds it, or lets
    it fall to the floor 0.4 s later. The estimate goes on sliding, by 2 cm/s. Its rows, too."""
    up_m = HANG_Z_M - below_m
    felt, state, thrust, rows = Felt(), state_in(Phase.PERCH, z_m=up_m), 1.2, set()
    off_s = math.inf
    for i in range(1, 800):
        t_s = 10.0 + 0.02 * i
        if comes_off and state.phase is Phase.RECOVER:
            off_s = min(off_s, state.entered_s + 0.4)
        fell_s = max(0.0, t_s - off_s)
        z_m = max(0.0, up_m - 4.9 * fell_s**2)
        x_m = aside_m + 0.02 * max(0.0, t_s - 10.5)
        tel = telemetry(
            t_s, thrust=thrust * HOVER_THRUST, position_m=(x_m, 0.0, z_m),
            acc_z_g=0.0 if fell_s > 0.0 < z_m else 1.0,
        )  # fmt: skip
        target = target_at(
            t_s, body_m=(x_m, 0.0, z_m), sigma_m=np.full(3, sigma_m), measured=False,
            tracked=False, measured_s=10.0,
        )  # fmt: skip
        unseen_s = t_s - 10.0 if profile.positioning.by == "target" else 0.0
        obs = observation(t_s, telemetry=tel, target=target, position_age_s=unseen_s)
        state, command = planner.step_mission(state, felt(obs), profile)
        rows.add(state.row)
        if state.phase.is_over:
            break
        match command:
            case RawThrust(order):
                thrust = order / HOVER_THRUST if order > 5000 else 0.0
            case StopMotors():
                thrust = 0.0
            case PositionSetpoint() if state.phase is not Phase.PERCH:
                thrust = 0.34
    return state, rows


@pytest.mark.parametrize(
    ("aside_m", "sigma_m", "row", "ends", "outcome"),
    [
        (0.012, 0.022, "caught", Phase.PERCHED, Outcome.PERCHED),
        (0.012, 0.075, "hangs-at-contact", Phase.PERCHED, Outcome.SAFETY),
        (0.04, 0.01, "hangs-at-contact", Phase.PERCHED, Outcome.SAFETY),
        (0.012, math.inf, "hangs-at-contact", Phase.PERCHED, Outcome.SAFETY),
        (0.06, 0.01, "held", Phase.ABORTED, Outcome.SAFETY),
    ],
)
def test_what_hangs_where_it_touched_the_target_is_told_by_its_place_there(
    aside_m: float, sigma_m: float, row: str, ends: Phase, outcome: Outcome
) -> None:
    """Not by where the estimate slides to meanwhile, 4 cm farther aside."""
    state, rows = backed_off_from(aside_m, sigma_m)
    assert {"beside-the-magnet", row} <= rows
    assert (state.phase, state.outcome) == (ends, outcome)
    if ends is Phase.PERCHED:
        assert state.contact_aside_m == pytest.approx(aside_m)


@pytest.mark.parametrize(
    ("touched", "by", "moved_m", "row"),
    [
        (False, "deck", 0.0, "hangs-at-contact"),
        (False, "deck", 0.12, "held"),
        (True, "mocap", 0.12, "held"),
    ],
)
def test_what_a_hand_holds_where_nothing_was_touched_is_not_caught(
    touched: bool, by: str, moved_m: float, row: str
) -> None:
    """A press that ended in the air, so near the target that it may be its magnet that holds it;
    or farther aside; or one that touched it, and then went aside by a motion capture, which does
    not slide."""
    profile = Profile.model_validate({"positioning": by})
    felt, state = Felt(), state_in(Phase.PERCH, z_m=HANG_Z_M - 0.04)
    state = replace(state, entered_s=10.0 - PROFILE.planner.perch.timeout_s + 0.3, reach_s=None)
    for i in range(1, 400):
        t_s = 10.0 + 0.02 * i
        held = state.phase is not Phase.PERCH
        went_m = min(moved_m, 0.08 * (t_s - state.entered_s)) if held else 0.0
        tel = telemetry(
            t_s, thrust=(0.34 if held else 1.2 if touched else 1.0) * HOVER_THRUST,
            position_m=(0.03 + went_m, 0.0, HANG_Z_M - 0.04),
        )  # fmt: skip
        if 0.0 < went_m < moved_m:
            tel = replace(tel, velocity_mps=(0.08 + tel.velocity_mps[0], 0.0, 0.0))
        target = target_at(
            t_s, body_m=tel.position_m, sigma_m=np.full(3, 0.01), measured=False, tracked=False,
            measured_s=10.0,
        )  # fmt: skip
        state, _ = planner.step_mission(
            state, felt(observation(t_s, telemetry=tel, target=target)), profile
        )
        if state.phase not in (Phase.PERCH, Phase.RECOVER):
            break
    assert (state.phase, state.row) == (Phase.LANDING, row)


def recovering(row: str, old: PlannerState, **obs: object) -> PlannerState:
    """One tick on, into RECOVER by that row."""
    table = tuple(
        replace(r, when=lambda c: True) for r in TABLE if r.name == row and old.phase in r.phases
    )
    state, _ = planner.step_mission(old, observation(10.02, HANG_Z_M, **obs), PROFILE, table)
    assert (state.phase, state.row) == (Phase.RECOVER, row)
    return state


@pytest.mark.parametrize(
    ("phase", "row", "kept"),
    [
        (Phase.COMPLETE, "not-released", True), (Phase.COMPLETE, "slipped", False),
        (Phase.RECOVER, "blocked", True), (Phase.PERCH, "no-contact", False),
    ],
)  # fmt: skip
def test_what_has_not_come_off_keeps_the_place_where_it_touched(
    phase: Phase, row: str, kept: bool
) -> None:
    old = replace(
        state_in(phase, z_m=HANG_Z_M), contact_z_m=HANG_Z_M, contact_aside_m=0.01,
        contact_sigma_m=0.02,
    )  # fmt: skip
    assert recovering(row, old).contact_aside_m == (0.01 if kept else None)


def test_one_sample_that_looks_like_a_contact_is_no_touch() -> None:
    tel = telemetry(10.02, HANG_Z_M, thrust=1.2 * HOVER_THRUST)
    for since_s, touched in ((10.0, False), (9.0, True)):
        state = replace(state_in(Phase.PERCH, z_m=HANG_Z_M), since={Condition.CONTACT: since_s})
        after = recovering("no-contact", state, telemetry=tel)
        assert (after.contact_aside_m is not None) is touched


def test_a_sight_of_now_tells_the_place_better_than_a_touch_of_before() -> None:
    state = replace(state_in(Phase.RECOVER, z_m=HANG_Z_M), contact_z_m=HANG_Z_M)
    state = replace(state, contact_aside_m=0.01, contact_sigma_m=0.01)
    seen = observation(10.02, HANG_Z_M)
    assert seen.target is not None
    lost = replace(seen, target=replace(seen.target, tracked=False))
    assert touched_aside_m(Context(state, lost, PROFILE)) == (0.01, 0.01)
    assert touched_aside_m(Context(state, seen, PROFILE)) is None


def test_a_landing_for_another_reason_proves_no_touch() -> None:
    old = replace(
        state_in(Phase.RECOVER, z_m=HANG_Z_M), contact_z_m=HANG_Z_M, contact_aside_m=0.01,
        contact_sigma_m=0.02, attempts=PROFILE.planner.attempts, entered_s=9.0,
    )  # fmt: skip
    state, _ = planner.step_mission(old, observation(10.02, HANG_Z_M), PROFILE)
    assert (state.row, state.contact_aside_m) == ("attempts-used", None)


def test_what_hangs_where_it_was_pressed_below_the_target_has_not_touched_it() -> None:
    state, rows = backed_off_from(0.0, 1e-3, below_m=0.2)
    assert {"blocked", "held"} <= rows
    assert state.phase is Phase.ABORTED


@pytest.mark.parametrize("positioning", ["deck", "target"])
def test_what_fell_from_where_it_touched_the_target_is_not_caught_there(positioning: str) -> None:
    profile = Profile.model_validate({"positioning": positioning})
    _, rows = backed_off_from(0.012, 0.022, comes_off=True, profile=profile)
    assert "beside-the-magnet" in rows
    assert not rows & {"caught", "hangs-at-contact", "contact", "perched", "hung"}


def test_what_has_left_its_contact_forgets_where_that_was() -> None:
    begin = replace(state_in(Phase.RECOVER, z_m=HANG_Z_M), contact_z_m=HANG_Z_M)
    begin = replace(begin, contact_aside_m=0.01, contact_sigma_m=0.01)
    state, _ = planner.step_mission(begin, observation(10.02, HANG_Z_M - 0.1), PROFILE)
    assert (state.contact_z_m, state.contact_aside_m) == (None, None)


@pytest.mark.parametrize("step_m", [-0.6, 0.7])
def test_a_step_of_the_estimates_height_moves_what_is_remembered(step_m: float) -> None:
    """The vehicle has not moved: held where it is, over a ground that is as far below."""
    state = state_in(Phase.ALIGN)
    for i in range(1, 4):
        state, _ = planner.step_mission(state, observation(10.0 + 0.02 * i), PROFILE)
    assert state.ground_m is not None
    ground_m = state.ground_m[2]
    tel = telemetry(10.08, 1.0 + step_m)
    obs = observation(10.08, telemetry=tel, jumped=True)
    state, command = planner.step_mission(state, obs, PROFILE)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m == pytest.approx(1.0 + step_m, abs=0.02)
    assert state.ground_m is not None
    assert state.ground_m[2] == pytest.approx(ground_m + step_m, abs=0.02)


def test_a_vehicle_still_at_the_ceiling_has_not_recovered() -> None:
    """Steady because it sticks there: the next attempt would begin pressed."""
    state = replace(state_in(Phase.RECOVER, z_m=HANG_Z_M), contact_z_m=HANG_Z_M)
    for i in range(1, 60):
        obs = observation(10.0 + 0.02 * i, HANG_Z_M)
        state, _ = planner.step_mission(state, obs, PROFILE)
    assert state.phase is Phase.RECOVER
    for i in range(60, 120):
        obs = observation(10.0 + 0.02 * i, HANG_Z_M - 0.1)
        state, _ = planner.step_mission(state, obs, PROFILE)
    assert state.phase is not Phase.RECOVER


@pytest.mark.parametrize("descend_m", [0.02, 0.1])
def test_a_short_descent_is_enough_to_have_left(descend_m: float) -> None:
    profile = changed({"planner.recover.descend_m": descend_m})
    state = replace(state_in(Phase.RECOVER, z_m=HANG_Z_M), contact_z_m=HANG_Z_M)
    for i in range(1, 60):
        obs = observation(10.0 + 0.02 * i, HANG_Z_M - descend_m)
        state, _ = planner.step_mission(state, obs, profile)
    assert state.phase is not Phase.RECOVER


def test_what_peels_off_too_fast_is_caught() -> None:
    """At thrustMin the magnet lets go of a vehicle that has no thrust to go on down with."""
    state = replace(state_in(Phase.LANDING, z_m=HANG_Z_M), contact_z_m=HANG_Z_M)
    falls = telemetry(10.02, HANG_Z_M - 0.03, velocity_mps=(0.0, 0.0, -0.5), thrust=20000.0)
    state, command = planner.step_mission(state, observation(10.02, telemetry=falls), PROFILE)
    assert state.phase is Phase.LANDING
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > HANG_Z_M + 0.5


@pytest.mark.parametrize(("age_s", "released"), [(0.02, True), (0.2, True), (0.5, False)])
def test_a_release_in_a_landing_begins_on_telemetry_that_is_a_little_late(
    age_s: float, released: bool
) -> None:
    """It stops nothing; what is older than `safety.telemetry_hold_s` begins nothing."""
    state = replace(state_in(Phase.LANDING, z_m=HANG_Z_M), contact_z_m=HANG_Z_M)
    for i in range(1, 80):
        t_s = 10.0 + 0.02 * i
        tel = telemetry(t_s - age_s, HANG_Z_M, thrust=20000.0)
        state, command = planner.step_mission(state, observation(t_s, telemetry=tel), PROFILE)
        assert not isinstance(command, StopMotors)
    assert (state.released_s is not None) is released


@pytest.mark.parametrize("still", [True, False])
def test_a_flight_that_ends_hanging_unseen_is_kept_from_locking(still: bool) -> None:
    """Its motors stand still by raw thrust; the stream's end alone would lock it."""
    state = replace(
        state_in(Phase.LANDING, z_m=HANG_Z_M),
        contact_z_m=HANG_Z_M,
        released_s=5.0 if still else None,
        orders=0 if still else 3,
        ordered_s=None if still else 5.0,
        entered_s=10.0 - PROFILE.planner.landing.timeout_s,
    )
    tel = telemetry(9.8, HANG_Z_M, thrust=1000.0)
    state, command = planner.step_mission(state, observation(10.02, telemetry=tel), PROFILE)
    assert state.phase is Phase.ABORTED
    assert isinstance(command, StopMotors) is still


def test_a_falling_vehicle_does_not_hang_at_its_contact() -> None:
    """Locked by a lost notify while it slips: it is not reported as perched."""
    state = replace(
        state_in(Phase.COMPLETE, z_m=HANG_Z_M), contact_z_m=HANG_Z_M, stopped_s=9.0, orders=5
    )
    tel = telemetry(
        10.02, HANG_Z_M - 0.05, velocity_mps=(0.0, 0.0, -0.9), thrust=0.0, supervisor=READY | LOCKED
    )
    state, _ = planner.step_mission(state, observation(10.02, telemetry=tel), PROFILE)
    assert state.phase is not Phase.PERCHED


def test_without_a_heading_a_slip_is_not_caught_by_position() -> None:
    """Position control would lead away from its setpoint: raw thrust brakes the fall."""
    state = replace(
        state_in(Phase.LANDING, z_m=1.8), caught=False, catch_above_m=0.2, heading_lost=True
    )
    tel = telemetry(10.02, 1.8, velocity_mps=(0.0, 0.0, -0.5))
    state, command = planner.step_mission(state, observation(10.02, telemetry=tel), PROFILE)
    assert isinstance(command, RawThrust)
    assert state.caught


@pytest.mark.parametrize("positioning", ["deck", "target"])
@pytest.mark.parametrize(
    ("frozen", "ends"),
    [
        ({"thrust": 0.0, "supervisor": AIRBORNE}, Phase.PERCHED),
        ({"thrust": 1000.0, "supervisor": READY}, Phase.ABORTED),
        ({"thrust": 20000.0, "supervisor": AIRBORNE}, Phase.ABORTED),
    ],
)
def test_a_completion_whose_telemetry_stands_still_ends(
    frozen: dict[str, float], ends: Phase, positioning: str
) -> None:
    """The supervisor's word, or the thrust, reads as before the stop. Nothing spins up again."""
    profile = Profile.model_validate({"positioning": positioning})
    felt, state = Felt(), replace(
        state_in(Phase.COMPLETE, z_m=HANG_Z_M), contact_z_m=HANG_Z_M, reach_s=9.0, released_s=9.0,
        stopped_s=10.0, ordered_s=10.0, orders=1,
    )  # fmt: skip
    for i in range(1, 50 * 50):
        t_s = 10.0 + 0.02 * i
        tel = telemetry(t_s, HANG_Z_M, **frozen)
        state, command = planner.step_mission(state, felt(observation(t_s, telemetry=tel)), profile)
        assert isinstance(command, (StopMotors, Idle))
        if state.phase.is_over:
            break
    assert state.phase is ends


# --- What happens while nothing new is known of the vehicle, and what counts afterwards ----------


def ticked(
    state: PlannerState, t_s: float, tel: Telemetry, **obs: object
) -> tuple[PlannerState, Command]:
    return planner.step_mission(state, observation(t_s, telemetry=tel, **obs), PROFILE)


def mid_release(phase: Phase = Phase.COMPLETE) -> PlannerState:
    """Half a second into the release, the motors on their way down to still."""
    state = state_in(phase, z_m=HANG_Z_M)
    return replace(state, contact_z_m=HANG_Z_M, entered_s=8.0, released_s=9.5, t_s=9.98)


def hangs_still(t_s: float, z_m: float = HANG_Z_M, **changes: object) -> Telemetry:
    return telemetry(t_s, z_m, **{"thrust": 1000.0, **changes})


# --- the release ----------------------------------------------------------------------


def test_a_release_that_nobody_sees_goes_back_to_a_setpoint() -> None:
    """Still motors would be a stop without a proof: what the magnet lets go of meanwhile is
    on the floor before the link counts as lost."""
    state, command = ticked(mid_release(), 10.0, hangs_still(10.0))
    assert isinstance(command, RawThrust)
    state, command = ticked(state, 10.2, hangs_still(10.0))
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > HANG_Z_M
    assert state.released_s is None
    for i in range(12):  # seen again, it begins anew: the dwell times too
        t_s = 10.22 + 0.02 * i
        state, command = ticked(state, t_s, hangs_still(t_s, thrust=20000.0))
        assert isinstance(command, PositionSetpoint), t_s


def test_a_raw_release_waits_for_telemetry_too() -> None:
    profile = changed({"planner.perch.mode": "raw"})
    state = replace(mid_release(), released_s=None, setpoint=None, entered_s=9.6)
    obs = observation(10.2, telemetry=hangs_still(10.0))
    assert isinstance(planner.step_mission(state, obs, profile)[1], PositionSetpoint)


# --- After the stop -------------------------------------------------------------------


def motors_stopped(**changes: object) -> PlannerState:
    state = replace(mid_release(), stopped_s=4.0, orders=5, reach_s=3.0)
    return replace(state, **changes)  # type: ignore[arg-type]


def a_second_after(state: PlannerState, z_m: float, silence_s: float = 0.0) -> PlannerState:
    """A second later. A fall that nobody has heard of may be in that silence."""
    felt = Felt()
    felt(observation(10.0, telemetry=telemetry(10.0, thrust=0.0, supervisor=READY)))
    for i in range(1, 50):
        t_s = 10.0 + silence_s + 0.02 * i
        off = telemetry(t_s, z_m, thrust=0.0, supervisor=READY)
        state, _ = planner.step_mission(state, felt(observation(t_s, telemetry=off)), PROFILE)
    return state


def test_what_lies_on_the_floor_has_not_perched() -> None:
    state = a_second_after(motors_stopped(), z_m=0.02, silence_s=0.7)
    assert (state.phase, state.outcome) == (Phase.LANDED, Outcome.SAFETY)


def test_what_hangs_where_it_did_has_perched() -> None:
    assert a_second_after(motors_stopped(), HANG_Z_M - 0.1, silence_s=0.7).phase is Phase.PERCHED


def test_an_estimate_that_drifts_while_it_is_watched_is_no_fall() -> None:
    assert a_second_after(motors_stopped(), HANG_Z_M - 0.6).phase is Phase.PERCHED


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
