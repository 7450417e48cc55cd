"""External positions that stay away, or are of another world (faults 10 and 11)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.mission import ImuMotion, Observation, Outcome, Phase, PlannerState, planner
from perchctl.mission.conditions import OTHERWISE_MPS, contact_aside_m
from perchctl.mission.context import Context
from perchctl.mission.imu import Reckoning, stepped
from perchctl.mission.lander import LEAST_ORDERS
from perchctl.profile import Profile
from perchctl.vehicle import (
    HL_ACTIVE,
    LOCKED,
    Command,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)
from tests.helpers.mission import (
    AIRBORNE,
    HANG_Z_M,
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

HOLD_S, LAND_S = MOCAP.positioning.hold_s, MOCAP.positioning.land_s
HIDDEN = "motion capture at vicon:lab does not see the rigid body 'cf2'"
TURN_S, BEGIN_S = 0.02, 10.0
PRESSED = HOVER_THRUST * 1.12
HELD_PHASES = (Phase.APPROACH, Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND)


def times(lasts_s: float) -> Iterator[float]:
    for i in range(1, round(lasts_s / TURN_S) + 1):
        yield BEGIN_S + TURN_S * i


def hidden(age_s: float) -> dict[str, Any]:
    return {"position_age_s": age_s, "position_problem": HIDDEN}


def flown(
    state: PlannerState, look: Callable[[float], Observation], lasts_s: float
) -> tuple[PlannerState, list[Command]]:
    """Until the time is over, or the phase is another."""
    phase, sent = state.phase, []
    for t_s in times(lasts_s):
        state, command = planner.step_mission(state, look(t_s), MOCAP)
        sent.append(command)
        if state.phase is not phase:
            break
    return state, sent


# --- In the air --------------------------------------------------------------------------


@pytest.mark.parametrize("phase", HELD_PHASES)
def test_a_short_occlusion_is_held_and_the_flight_goes_on(phase: Phase) -> None:
    """0.3 s: the setpoint stands, then moves on, and nothing is landed for it."""
    begin = state = state_in(phase, z_m=0.3 if phase is Phase.APPROACH else 1.0)
    held = []
    for t_s in times(0.5):
        hidden_s = t_s - BEGIN_S if t_s - BEGIN_S <= 0.3 else 0.0
        obs = observation(t_s, begin.entry_m[2], **hidden(hidden_s))
        state, command = planner.step_mission(state, obs, MOCAP)
        if hidden_s > HOLD_S:
            held.append((state.hold, state.setpoint, command))
    assert state.phase in (*HELD_PHASES, Phase.PERCH)
    assert not state.hold
    assert len(held) >= 7
    for why, setpoint, command in held:
        assert HIDDEN in why
        assert setpoint == held[0][1]
        assert isinstance(command, PositionSetpoint)


@pytest.mark.parametrize("phase", [*HELD_PHASES, Phase.RECOVER, Phase.PERCH])
def test_a_lasting_occlusion_lands_and_says_why(phase: Phase) -> None:
    begin = state_in(phase)
    state, sent = begin, []
    for t_s in times(2.0):
        obs = observation(t_s, begin.entry_m[2], new_frame=False, **hidden(t_s - BEGIN_S))
        state, command = planner.step_mission(state, obs, MOCAP)
        sent.append(command)
        if state.phase is not phase:
            break
    assert (state.phase, state.row, state.outcome) == (
        Phase.LANDING, "position-lost", Outcome.SAFETY,
    )  # fmt: skip
    assert HIDDEN in state.reason
    assert len(sent) * TURN_S == pytest.approx(LAND_S, abs=0.03)


@pytest.mark.parametrize("lost_s", [0.0, 0.06])
@pytest.mark.parametrize("phase", [*HELD_PHASES, Phase.RECOVER, Phase.PERCH])
def test_a_deck_whose_positions_end_is_noticed_by_the_variance(phase: Phase, lost_s: float) -> None:
    """Level, by thrust alone, within a second: long before the estimate itself doubts. Until
    then the setpoint is nowhere above the one that was flown."""
    see, state, sent = Felt(), state_in(phase), []
    state = replace(state, entered_s=BEGIN_S, attempts=1)
    for i in range(125):
        t_s = BEGIN_S + 0.01 * (i - 24)
        variance = 2e-4 + 1e-4 * max(0, math.ceil(10 * (t_s - BEGIN_S - lost_s) - 1e-6))
        tel = telemetry(
            t_s, 1.0, climb_variance_m2ps2=variance, position_variance_m2=variance,
            acc_x_g=1e-4 * (i % 2),
        )  # fmt: skip
        obs = see(observation(t_s, telemetry=tel, new_frame=False))
        if i % 2 == 0 and t_s > BEGIN_S:
            state, command = planner.step_mission(state, obs, PROFILE)
            sent.append(command)
        if state.phase is Phase.LANDING:
            break
    assert (state.phase, state.row, state.outcome) == (
        Phase.LANDING, "position-lost", Outcome.SAFETY,
    )  # fmt: skip
    assert "variance only grows" in state.reason
    assert LAND_S <= len(sent) * TURN_S <= 1.0
    assert isinstance(sent[-1], RawThrust)


def test_what_was_never_measured_lands_at_once() -> None:
    state, _ = planner.step_mission(
        state_in(Phase.ALIGN), observation(10.02, **hidden(math.inf)), MOCAP
    )
    assert state.phase is Phase.LANDING
    assert "no position has come" in state.reason


@pytest.mark.parametrize(("phase", "to"), [
    (Phase.APPROACH, Phase.SEARCH), (Phase.ALIGN, Phase.ASCEND), (Phase.RECOVER, Phase.ESTIMATE),
])  # fmt: skip
def test_no_dwell_time_counts_without_a_position(phase: Phase, to: Phase) -> None:
    """Hidden again and again for 0.3 s, never long enough to be landed for."""
    z_m = 0.5 if phase is Phase.APPROACH else 1.0

    def seen(t_s: float) -> Observation:
        return observation(t_s, z_m)

    def flickers(t_s: float) -> Observation:
        since_s = (t_s - BEGIN_S) % 0.35
        return observation(t_s, z_m, **hidden(since_s if since_s < 0.3 else 0.0))

    assert flown(state_in(phase, z_m=z_m), seen, 1.2)[0].phase is to
    assert flown(state_in(phase, z_m=z_m), flickers, 1.2)[0].phase is phase


# --- At the ceiling ----------------------------------------------------------------------


def pressed(t_s: float, **changes: Any) -> Observation:
    return observation(t_s, telemetry=telemetry(t_s, HANG_Z_M, thrust=PRESSED), **changes)


def test_no_contact_is_proven_without_a_position() -> None:
    assert flown(state_in(Phase.PERCH, z_m=HANG_Z_M), pressed, 0.6)[0].phase is Phase.COMPLETE
    state, _ = flown(
        state_in(Phase.PERCH, z_m=HANG_Z_M), lambda t_s: pressed(t_s, **hidden(0.3)), 0.6
    )
    assert state.phase is Phase.PERCH


def test_a_position_that_comes_again_proves_nothing_yet() -> None:
    """The estimate is drawn back to it, and its speed is not the vehicle's."""

    def back(t_s: float) -> Observation:
        return pressed(t_s, **(hidden(0.3) if t_s < BEGIN_S + 0.1 else {}))

    state, sent = flown(state_in(Phase.PERCH, z_m=HANG_Z_M), back, 2.0)
    assert state.phase is Phase.COMPLETE
    assert len(sent) * TURN_S > 0.1 + 0.5 + PROFILE.planner.perch.contact_dwell_s - 0.05


class Hangs:
    """A vehicle with its gear at the magnet, its body hidden, and an estimate that slides: down
    by `drift_mps`, as one that is pressed and blind does (docs/firmware.md). `carries`: as long
    as its thrust is above this part of the weight, the magnet holds."""

    def __init__(self, drift_mps: float, carries: float = 0.0, hover: float = HOVER_THRUST):
        self.thrust, self.drift_mps = hover, drift_mps
        self.carries, self.hover = carries, hover
        self.fell_s: float | None = None
        self.estimated_m = HANG_Z_M
        self.felt = Felt()

    def look(self, t_s: float) -> Observation:
        lifted = self.thrust / self.hover
        if self.fell_s is None and lifted < self.carries:
            self.fell_s = t_s - TURN_S
        acc_g, sinks_mps = 1.0, 0.0
        if self.fell_s is not None:
            acc_g, sinks_mps = lifted, 9.81 * (1.0 - lifted) * (t_s - self.fell_s)
        self.estimated_m = HANG_Z_M - self.drift_mps * (t_s - BEGIN_S)
        off = self.thrust == 0.0
        tel = telemetry(
            t_s, self.estimated_m, acc_z_g=acc_g, thrust=self.thrust,
            velocity_mps=(0.0, 0.0, -self.drift_mps - sinks_mps),
            supervisor=READY if off else AIRBORNE,
        )  # fmt: skip
        obs = observation(t_s, telemetry=tel, target=None, **hidden(t_s - BEGIN_S + 1.0))
        return self.felt(obs)

    def obeys(self, command: Command) -> None:
        match command:
            case RawThrust(thrust):
                self.thrust = float(thrust)
            case StopMotors():
                self.thrust = 0.0
            case PositionSetpoint(z_m=z_m):
                self.thrust = 20000.0 if z_m < self.estimated_m else 65535.0


def released(it: Hangs, state: PlannerState, lasts_s: float = 12.0) -> tuple[PlannerState, list]:
    sent = []
    for t_s in times(lasts_s):
        state, command = planner.step_mission(state, it.look(t_s), MOCAP)
        it.obeys(command)
        sent.append((t_s, command))
        if state.phase.is_over:
            break
    return state, sent


def at_the_magnet(phase: Phase = Phase.COMPLETE) -> PlannerState:
    state = state_in(phase, z_m=HANG_Z_M)
    return replace(state, contact_z_m=HANG_Z_M, reach_s=BEGIN_S - 5.0)


@pytest.mark.parametrize("drift_mps", [0.0, 0.2, -0.2])
def test_a_release_goes_on_by_the_accelerometer_when_the_body_is_hidden_for_good(
    drift_mps: float,
) -> None:
    """To thrust again for a slide of the estimate would take a vehicle off its magnet."""
    it = Hangs(drift_mps)
    state, sent = released(it, replace(at_the_magnet(), released_s=BEGIN_S))
    assert state.phase is Phase.PERCHED
    stops = [t_s for t_s, command in sent if isinstance(command, StopMotors)]
    still = next(t_s for t_s, c in sent if isinstance(c, RawThrust) and c.thrust <= 5000)
    assert stops[0] - still >= PROFILE.planner.complete.hang_s - 0.05


def test_the_same_slide_with_decks_is_a_slip() -> None:
    """Their position is measured all the time: what sinks by it falls."""
    it = Hangs(0.2)
    state = replace(at_the_magnet(), released_s=BEGIN_S)
    for t_s in times(0.3):
        obs = replace(it.look(t_s), position_age_s=0.0)
        state, _ = planner.step_mission(state, obs, PROFILE)
    assert state.row == "slipped"


@pytest.mark.parametrize("carries", [0.05, 0.3])
@pytest.mark.parametrize("drift_mps", [0.0, 0.2])
def test_a_magnet_that_gives_way_is_noticed_without_a_position(
    carries: float, drift_mps: float
) -> None:
    it = Hangs(drift_mps, carries)
    state = replace(at_the_magnet(), released_s=BEGIN_S)
    for t_s in times(4.0):
        state, command = planner.step_mission(state, it.look(t_s), MOCAP)
        if state.phase is not Phase.COMPLETE:
            break
        assert not isinstance(command, StopMotors)
        it.obeys(command)
    assert it.fell_s is not None
    assert t_s - it.fell_s < 0.15
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > it.look(t_s).telemetry.position_m[2] + 0.15  # caught


STOPPED: dict[str, Any] = {"stopped_s": BEGIN_S - 1.0, "released_s": BEGIN_S - 3.0, "orders": 5}


def off(t_s: float, supervisor: int = READY, gained_mps: float = 0.0) -> Observation:
    """Motors off, no position."""
    tel = telemetry(t_s, HANG_Z_M, thrust=0.0, supervisor=supervisor)
    x_mps, y_mps, z_mps = tel.velocity_mps
    tel = replace(tel, velocity_mps=(x_mps, y_mps, z_mps + gained_mps))
    return observation(t_s, telemetry=tel, target=None, **hidden(5.0))


@pytest.mark.parametrize(
    ("silence_s", "gained_mps", "ends"),
    [(0.1, 0.0, Phase.PERCHED), (0.5, 0.0, Phase.PERCHED), (0.5, -2.5, Phase.ABORTED)],
)
def test_what_nobody_saw_hang_has_not_perched(
    silence_s: float, gained_mps: float, ends: Phase
) -> None:
    """Motors off, no position, and a gap in the telemetry: it may lie on the floor, unless what
    was felt on board meanwhile is no fall."""
    state, felt = replace(at_the_magnet(), **STOPPED), Felt()
    felt(off(BEGIN_S))
    reasons = []
    for t_s in times(4.0):
        heard = t_s > BEGIN_S + silence_s
        obs = felt(off(t_s, gained_mps=gained_mps) if heard else off(BEGIN_S))
        state, command = planner.step_mission(state, replace(obs, t_s=t_s), MOCAP)
        assert not isinstance(command, Land | PositionSetpoint)
        reasons.append(state.reason)
        if state.phase.is_over:
            break
    assert state.phase is ends
    if ends is Phase.ABORTED:
        assert any("still hangs is not known" in reason for reason in reasons)
        assert "not known" in state.reason


@pytest.mark.parametrize(("silence_s", "gained_mps"), [(0.02, 0.0), (0.5, 0.0), (0.5, -2.5)])
def test_a_locked_vehicle_hangs_where_it_has_not_fallen_from(
    silence_s: float, gained_mps: float
) -> None:
    state, felt = replace(at_the_magnet(), **STOPPED), Felt()
    felt(off(BEGIN_S - 0.02))
    locked = felt(off(BEGIN_S + silence_s, READY | LOCKED, gained_mps))
    state, _ = planner.step_mission(state, locked, MOCAP)
    assert state.phase is (Phase.ABORTED if gained_mps else Phase.PERCHED)


# --- On the way down ---------------------------------------------------------------------


@pytest.mark.parametrize("contact", [True, False])
def test_what_something_carries_is_put_down_gently_whatever_that_is(contact: bool) -> None:
    """Magnet or floor. A stop at half of the weight would drop it from a weak magnet; a slow
    release under watch suits both. What had touched the magnet and has not fallen hangs."""
    it = Hangs(-0.1)
    it.thrust = 20000.0
    state = at_the_magnet(Phase.LANDING)
    if not contact:
        state = replace(state, contact_z_m=None, reach_s=None)
    state, sent = released(it, state)
    first = next(i for i, (_, command) in enumerate(sent) if isinstance(command, StopMotors))
    still = [c for _, c in sent[:first] if isinstance(c, RawThrust) and c.thrust <= 5000]
    assert len(still) * TURN_S >= PROFILE.planner.complete.hang_s - 0.05
    assert state.phase is (Phase.PERCHED if contact else Phase.LANDED)


def test_a_drifting_descent_is_no_floor() -> None:
    """It seems to have come down by half a metre, and is held by the magnet."""
    state = replace(state_in(Phase.LANDING, z_m=1.5))
    for t_s in times(0.9):
        tel = telemetry(t_s, 0.9, thrust=20000.0)
        obs = observation(t_s, telemetry=tel, target=None, **hidden(1.0))
        state, command = planner.step_mission(state, obs, MOCAP)
        assert not isinstance(command, StopMotors)


def test_the_ground_stays_where_it_was_when_the_drift_ends() -> None:
    """The estimate steps back to the truth: what was remembered before the drift is true."""
    begin = replace(state_in(Phase.ALIGN), ground_m=(0.0, 0.0, 0.0))
    state, _ = planner.step_mission(begin, observation(10.02, 1.3, **hidden(0.5)), MOCAP)
    back, _ = planner.step_mission(state, observation(10.04, 1.0, jumped=True), MOCAP)
    assert back.ground_m == (0.0, 0.0, 0.0)
    without, _ = planner.step_mission(
        replace(state, stale_s=None), observation(10.04, jumped=True), MOCAP
    )
    assert without.ground_m != (0.0, 0.0, 0.0)


# --- Another world -----------------------------------------------------------------------


def test_what_a_blind_landing_put_its_weight_on_is_not_called_the_ceiling() -> None:
    """On the floor a magnet's hold and the ground's look alike; a lock makes no perch of it."""
    state = state_in(Phase.LANDING, z_m=1.0)
    state = replace(
        state, entered_s=8.0, contact_z_m=0.6, released_s=9.0, stopped_s=9.9, stale_s=BEGIN_S,
        reach_s=8.0,
    )  # fmt: skip
    felt = Felt()
    felt(off(BEGIN_S - TURN_S))
    locked = felt(off(BEGIN_S, READY | LOCKED))
    assert planner.step_mission(state, locked, MOCAP)[0].phase is Phase.ABORTED
    hung = replace(state, phase=Phase.COMPLETE)
    assert planner.step_mission(hung, locked, MOCAP)[0].phase is Phase.PERCHED


def test_a_release_that_is_held_goes_by_where_the_estimate_is_now() -> None:
    """It has slid 0.4 m up from the contact: a setpoint at the contact would take the thrust
    away."""
    state = replace(state_in(Phase.COMPLETE, z_m=HANG_Z_M), contact_z_m=HANG_Z_M, released_s=9.0)
    late = telemetry(BEGIN_S - 0.2, HANG_Z_M + 0.4, thrust=1000.0)
    _, command = planner.step_mission(
        state, observation(BEGIN_S, telemetry=late, **hidden(4.0)), MOCAP
    )
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > late.position_m[2]


# --- Where it touched ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("by", "unseen_s", "least_m", "most_m"),
    [("deck", 0.1, 0.002, 0.003), ("deck", 1.0, 0.01, 0.012), ("mocap", 1.0, 0.001, 0.002)],
)
def test_the_spread_of_a_contact_grows_with_what_the_estimate_may_slide(
    by: str, unseen_s: float, least_m: float, most_m: float
) -> None:
    """A target that is only remembered keeps the spread of its last sight."""
    profile = Profile.model_validate({"positioning": by})
    state = state_in(Phase.PERCH, z_m=HANG_Z_M)
    for t_s in times(0.1):
        remembered = target_at(
            t_s, body_m=(0.0, 0.0, HANG_Z_M), measured_s=t_s - unseen_s, measured=False,
            tracked=False, sigma_m=np.full(3, 1e-4),
        )  # fmt: skip
        obs = observation(t_s, HANG_Z_M, target=remembered)
        state, _ = planner.step_mission(state, obs, profile)
    _, sigma_m = contact_aside_m(Context(state, obs, profile))
    assert least_m <= sigma_m <= most_m


@pytest.mark.parametrize(("silent", "aside_m"), [(True, 0.0), (False, 0.06)])
def test_positions_that_come_back_do_not_move_a_gear_that_has_not_moved(
    silent: bool, aside_m: float
) -> None:
    """Felt to stand still at the target, out of sight: 6 cm, by which the estimate is set right
    after half a second without a position, were its own."""
    felt, state = Felt(), state_in(Phase.PERCH, z_m=HANG_Z_M)
    for t_s in times(1.5):
        since_s = t_s - 10.0
        tel = telemetry(t_s, position_m=(0.06 if since_s > 0.9 else 0.0, 0.0, HANG_Z_M))
        target = target_at(
            t_s, body_m=tel.position_m, measured=since_s < 0.2, measured_s=min(t_s, 10.2)
        )
        gone_s = since_s - 0.3 if silent and since_s < 0.9 else 0.0
        obs = observation(t_s, telemetry=tel, target=target, position_age_s=max(0.0, gone_s))
        state, _ = planner.step_mission(state, felt(obs), MOCAP)
    assert math.hypot(*state.reckoning.aside_m) == pytest.approx(aside_m, abs=0.01)
    assert math.hypot(*state.reckoning.stepped_m) == pytest.approx(aside_m, abs=0.01)


def test_a_gap_in_the_positions_brings_nothing_nearer_to_the_magnet() -> None:
    """Hovering below a target that is out of sight since: how far below it is, the position tells
    as soon as it is back."""
    felt, state = Felt(), state_in(Phase.ALIGN, z_m=HANG_Z_M - 0.35)
    for t_s in times(8.0):
        since_s = t_s - 10.0
        target = target_at(
            t_s, body_m=(0.0, 0.0, HANG_Z_M - 0.35), measured=since_s < 0.2,
            measured_s=min(t_s, 10.2), tracked=since_s < 0.7,
        )  # fmt: skip
        gone_s = since_s - 0.2 if 0.2 < since_s < 0.5 else 0.0
        obs = observation(
            t_s, telemetry=telemetry(t_s, HANG_Z_M - 0.35), target=target, position_age_s=gone_s
        )
        state, _ = planner.step_mission(state, felt(obs), MOCAP)
    assert state.reckoning.below_m == pytest.approx(0.35, abs=0.01)
    assert state.reach_s is None


SMEARED_M = (0.0196, 0.0158, 0.0123, 0.0098)


@pytest.mark.parametrize(
    ("steps_m", "seen_s", "profile", "sigma_m"),
    [
        ((0.06,), 0.5, MOCAP, 0.06),
        ((0.06,), 0.5, Profile(), 0.06),
        (SMEARED_M, 0.5, MOCAP, sum(SMEARED_M)),
        ((0.05, 0.0, -0.05), 0.5, MOCAP, 0.0),
        ((0.06,), 0.97, MOCAP, 0.06),  # by pictures of before it that arrive after it
        ((0.06,), 1.1, MOCAP, 0.0),  # by one that is exposed after it
        ((0.006,), 0.5, MOCAP, 0.0),  # the noise of an estimate
        ((0.06,), 0.5, Profile.model_validate({"positioning": "target"}), 0.0),
    ],
)
def test_a_step_of_the_estimate_makes_the_place_of_the_gear_unsure(
    steps_m: tuple[float, ...], seen_s: float, profile: Profile, sigma_m: float
) -> None:
    """By as much as it steps beyond its speed, tick by tick from 0.98 s on: it was wrong before, or
    it is now. A picture arrives 0.06 s after its exposure."""
    felt, state, x_m = Felt(), state_in(Phase.PERCH, z_m=HANG_Z_M), 0.0
    for i, t_s in enumerate(times(1.3)):
        x_m += steps_m[i - 48] if 48 <= i < 48 + len(steps_m) else 0.0
        tel = telemetry(t_s, position_m=(x_m, 0.0, HANG_Z_M))
        exposed_s = min(t_s - 10.06, seen_s)
        target = target_at(
            t_s, body_m=tel.position_m, measured=exposed_s < seen_s, measured_s=10.0 + exposed_s
        )
        obs = observation(t_s, telemetry=tel, target=target, new_frame=target.measured)
        state, _ = planner.step_mission(state, felt(obs), profile)
    assert math.hypot(*state.reckoning.stepped_m) == pytest.approx(sigma_m, abs=1e-3)
    assert contact_aside_m(Context(state, obs, profile))[1] >= sigma_m - 1e-3


def test_a_position_that_moves_as_fast_as_it_says_is_no_step() -> None:
    """However late its packet is: one that is 80 ms old is carried on by 50."""
    old, last = Reckoning(), telemetry(9.98)
    for k in range(40):
        t_s, behind_s = 10.0 + 0.02 * k, 0.08 if k % 3 else 0.0
        at_m = 0.6 * (t_s - max(0.0, behind_s - 0.05))
        tel = replace(
            telemetry(t_s, position_m=(at_m, 0.0, 1.0), velocity_mps=(0.6, 0.0, 0.0)),
            behind_s=behind_s,
        )
        if k:
            old = stepped(old, last, tel)
        last = tel
    assert old.stepped_m == (0.0, 0.0)


@pytest.mark.parametrize(
    ("x_m", "row"), [(0.0, "hangs-at-contact"), (0.2, "held")]
)  # fmt: skip
def test_what_hangs_where_the_place_is_unsure_is_not_said_to_be_held_elsewhere(
    x_m: float, row: str
) -> None:
    """On the magnet while the estimate steps by 6 cm, out of sight of the target; or 20 cm aside,
    which no such step explains."""
    felt, state = Felt(), state_in(Phase.PERCH, z_m=HANG_Z_M)
    for t_s in times(2.9):
        x = x_m + (0.06 if t_s > 10.48 else 0.0)
        tel = telemetry(t_s, position_m=(x, 0.0, HANG_Z_M), thrust=0.34 * HOVER_THRUST)
        target = target_at(
            t_s, body_m=tel.position_m, measured=t_s < 10.3, measured_s=min(t_s, 10.3),
            tracked=t_s < 10.4,
        )  # fmt: skip
        obs = observation(t_s, telemetry=tel, target=target, new_frame=target.measured)
        state, _ = planner.step_mission(state, felt(obs), MOCAP)
        if state.phase is Phase.LANDING:
            break
    assert state.row == row


# --- Another world: what goes astray by it comes down level, by thrust alone ---------------------


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
