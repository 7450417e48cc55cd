"""Every phase x every abort event, each to its proper end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from perchctl.mission import planner
from perchctl.mission.state import (
    FLYING_PHASES,
    Observation,
    Operator,
    Outcome,
    Phase,
    PlannerState,
    Severity,
)
from perchctl.vehicle import (
    CRASHED,
    LOCKED,
    TUMBLED,
    EmergencyStop,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
    TakeOff,
)
from tests.helpers.mission import (
    AIRBORNE,
    CEILING_M,
    PROFILE,
    READY,
    observation,
    state_in,
    telemetry,
)

Event = Callable[[Observation], Observation]


def _tel(**changes: object) -> Event:
    return lambda obs: replace(obs, telemetry=replace(obs.telemetry, **changes))


def _obs(**changes: object) -> Event:
    return lambda obs: replace(obs, **changes)


def _bits(bit: int) -> Event:
    return _tel(supervisor=AIRBORNE | bit)


STOP, LAND = "stop", "land"
CAMERA_PHASES = {Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER}
BEFORE_CONTACT = FLYING_PHASES - {Phase.COMPLETE}
ALL = FLYING_PHASES | {Phase.LANDING}

# event: (what happens, seconds it lasts, where it counts, how it ends, outcome)
EVENTS: dict[str, tuple[Event, float, frozenset[Phase] | set[Phase], str, Outcome]] = {
    "operator-stop": (_obs(operator=Operator.STOP), 0.1, ALL, STOP, Outcome.EMERGENCY),
    "locked": (_bits(LOCKED), 0.1, ALL, STOP, Outcome.SAFETY),
    "tumbled": (_bits(TUMBLED), 0.1, ALL, STOP, Outcome.SAFETY),
    "crashed": (_bits(CRASHED), 0.1, ALL, STOP, Outcome.SAFETY),
    "tilted": (_tel(roll_rad=1.5), 0.5, ALL, STOP, Outcome.SAFETY),
    "operator-land": (_obs(operator=Operator.LAND), 0.1, FLYING_PHASES, LAND, Outcome.OPERATOR),
    "link-lost": (_obs(link_problem="gone"), 0.1, FLYING_PHASES, LAND, Outcome.SAFETY),
    "telemetry-stale": (
        lambda o: replace(o, telemetry=replace(o.telemetry, t_s=9.9)),
        1.5, FLYING_PHASES, LAND, Outcome.SAFETY,
    ),
    "estimator-jump": (_obs(jumped=True), 0.8, FLYING_PHASES, LAND, Outcome.SAFETY),
    "battery-low": (_tel(battery_v=2.8), 1.8, BEFORE_CONTACT, LAND, Outcome.SAFETY),
    "battery-low-power": (_tel(battery_state=3), 1.8, BEFORE_CONTACT, LAND, Outcome.SAFETY),
    "battery-unknown": (_obs(battery_age_s=99.0), 0.1, BEFORE_CONTACT, LAND, Outcome.SAFETY),
    "height-limit": (
        _tel(position_m=(0.0, 0.0, 3.4)), 0.1, BEFORE_CONTACT, LAND, Outcome.SAFETY,
    ),
    "fence": (_tel(position_m=(2.5, 0.0, 1.0)), 0.1, BEFORE_CONTACT, LAND, Outcome.SAFETY),
    "camera-gone": (
        _obs(camera_age_s=4.0, new_frame=False, camera_problem="camera unplugged"),
        0.1, CAMERA_PHASES, LAND, Outcome.SAFETY,
    ),
    "loop-late": (_obs(loop_late_s=1.2), 0.1, FLYING_PHASES, LAND, Outcome.SAFETY),
    "markers-disagree": (
        _obs(disagreeing_frames=40), 0.1, CAMERA_PHASES, LAND, Outcome.SAFETY,
    ),
    "time-over": (
        lambda o: o, 0.1, BEFORE_CONTACT, LAND, Outcome.ATTEMPTS_USED_UP,
    ),
}  # fmt: skip


def _begin(phase: Phase, event: str) -> PlannerState:
    z = CEILING_M - 0.03 if phase is Phase.COMPLETE else 1.0
    state = state_in(phase, z_m=z)
    return replace(state, started_s=-1000.0) if event == "time-over" else state


def _run(state: PlannerState, event: Event, lasts_s: float) -> tuple[PlannerState, list[object]]:
    commands: list[object] = []
    steps = max(1, round(lasts_s / 0.02))
    for i in range(1, steps + 1):
        t_s = 10.0 + 0.02 * i
        obs = event(observation(t_s, state.entry_m[2]))
        state, command = planner.step(state, obs, PROFILE)
        commands.append(command)
        if state.phase in (Phase.LANDING, Phase.ABORTED) and state.row != "":
            break
    return state, commands


@pytest.mark.parametrize("name", EVENTS)
@pytest.mark.parametrize("phase", sorted(ALL, key=lambda p: p.value))
def test_every_phase_meets_every_abort(phase: Phase, name: str) -> None:
    event, lasts_s, counts_in, ends, outcome = EVENTS[name]
    state, commands = _run(_begin(phase, name), event, lasts_s)
    if phase not in counts_in:
        assert state.outcome is not Outcome.SAFETY
        assert not any(isinstance(c, EmergencyStop | StopMotors) for c in commands)
        return
    assert state.outcome is outcome
    if ends == STOP:
        assert state.phase is Phase.ABORTED
        assert state.severity is Severity.STOP
        assert isinstance(commands[-1], EmergencyStop | StopMotors)
    else:
        assert state.phase is Phase.LANDING
        assert isinstance(commands[-1], Land)
        assert commands[-1].height_m <= 0.0
    assert state.reason


@pytest.mark.parametrize("name", [n for n, e in EVENTS.items() if e[3] == LAND])
def test_a_landing_is_never_undone(name: str) -> None:
    """Once it lands nothing but a stop changes it, whatever comes and goes."""
    event, lasts_s, _, _, _ = EVENTS[name]
    state, _ = _run(_begin(Phase.ALIGN, name), event, lasts_s)
    orders = 0
    for i in range(200):
        obs = observation(20.0 + 0.02 * i, 0.8)
        state, command = planner.step(state, obs, PROFILE)
        assert state.phase is Phase.LANDING
        assert isinstance(command, Land | Idle)
        orders += isinstance(command, Land)
    assert orders <= 4


@pytest.mark.parametrize("phase", sorted(FLYING_PHASES, key=lambda p: p.value))
def test_ctrl_c_once_lands_and_twice_stops(phase: Phase) -> None:
    state = _begin(phase, "")
    obs = observation(10.02, state.entry_m[2], operator=Operator.LAND)
    state, command = planner.step(state, obs, PROFILE)
    assert isinstance(command, Land)
    state, command = planner.step(
        state, observation(10.04, state.entry_m[2], operator=Operator.STOP), PROFILE
    )
    assert isinstance(command, EmergencyStop)
    assert state.outcome is Outcome.EMERGENCY


@pytest.mark.parametrize("phase", sorted(CAMERA_PHASES - {Phase.RECOVER}, key=lambda p: p.value))
@pytest.mark.parametrize(
    "event",
    [
        _obs(camera_age_s=1.0, new_frame=False, target=None),
        _obs(loop_late_s=0.4),
        lambda o: replace(o, telemetry=replace(o.telemetry, t_s=o.t_s - 0.5)),
    ],
    ids=["camera-silent", "loop-late", "telemetry-late"],
)
def test_a_short_fault_never_climbs(phase: Phase, event: Event) -> None:
    state = state_in(phase)
    before = state.setpoint
    state, command = planner.step(state, event(observation(10.02)), PROFILE)
    if state.phase is Phase.RECOVER:  # the target is lost in the ascent: down, not up
        assert isinstance(command, PositionSetpoint)
        assert before is not None
        assert command.z_m < before.z_m
    else:
        assert state.hold
        assert state.phase is not phase or command == before


def test_nothing_but_search_ascent_and_perch_climbs() -> None:
    for phase in FLYING_PHASES - {Phase.SEARCH, Phase.ASCEND, Phase.PERCH, Phase.APPROACH}:
        state = _begin(phase, "")
        start_z = state.setpoint.z_m if state.setpoint else 0.0
        for i in range(1, 20):
            obs = observation(10.0 + 0.02 * i, state.entry_m[2])
            state, command = planner.step(state, obs, PROFILE)
            if state.phase is not phase:
                break
            assert not isinstance(command, TakeOff)
            if isinstance(command, PositionSetpoint) and phase is not Phase.COMPLETE:
                assert command.z_m <= start_z + 1e-9


def test_no_stop_without_contact_tumble_word_or_attitude() -> None:
    """Motors stop only on proof: nothing else in the table leads to a stop."""
    for phase in FLYING_PHASES:
        state = _begin(phase, "")
        for i in range(1, 300):
            obs = observation(10.0 + 0.02 * i, state.entry_m[2])
            state, command = planner.step(state, obs, PROFILE)
            assert not isinstance(command, EmergencyStop)
            if isinstance(command, StopMotors):
                assert state.phase is Phase.LANDING
                break


def test_landing_ends_when_the_motors_are_off() -> None:
    state, command = planner.step(
        state_in(Phase.ALIGN), observation(10.02, operator=Operator.LAND), PROFILE
    )
    assert isinstance(command, Land)
    for i in range(20):
        off = telemetry(14.0 + 0.02 * i, 0.01, thrust=0.0, supervisor=READY)
        state, _ = planner.step(state, observation(off.t_s, telemetry=off), PROFILE)
    assert state.phase is Phase.LANDED
    assert state.outcome is Outcome.OPERATOR


@pytest.mark.parametrize("mode", ["raw", "position"])
def test_the_perch_ends_by_itself(mode: str) -> None:
    """Without proof of contact the press is bounded and backs off down."""
    planner_config = PROFILE.planner.model_copy(
        update={"perch": PROFILE.planner.perch.model_copy(update={"mode": mode})}
    )
    profile = PROFILE.model_copy(update={"planner": planner_config})
    state = state_in(Phase.PERCH, z_m=2.09)
    sent: list[object] = []
    for i in range(1, 200):
        t_s = 10.0 + 0.02 * i
        state, command = planner.step(state, observation(t_s, 2.09), profile)
        if state.phase is not Phase.PERCH:
            break
        sent.append(command)
    assert state.phase is Phase.RECOVER
    assert isinstance(command, PositionSetpoint)
    assert command.z_m <= 2.09 - PROFILE.planner.recover.descend_m
    kind = RawThrust if mode == "raw" else PositionSetpoint
    assert all(isinstance(c, kind) for c in sent)
    assert math.isclose(len(sent) * 0.02, PROFILE.planner.perch.timeout_s, abs_tol=0.1)


def test_the_stop_is_sent_several_times() -> None:
    """One lost notify would lock a vehicle that hangs well, one lost stop let it fly on."""
    z_m = CEILING_M - PROFILE.vehicle.gear_body_m[2]
    state = replace(state_in(Phase.COMPLETE, z_m=z_m), hover_thrust=56000.0)
    sent: list[float] = []
    for i in range(1, 120):
        t_s = 10.0 + 0.02 * i
        thrust = 0.0 if sent else 20000.0
        obs = observation(t_s, telemetry=telemetry(t_s, z_m, thrust=thrust))
        state, command = planner.step(state, obs, PROFILE)
        assert state.phase is Phase.COMPLETE
        if isinstance(command, StopMotors):
            sent.append(t_s)
    assert len(sent) == 5
    assert sent[-1] - sent[0] < 0.6  # well within the supervisor's 2 s


def test_a_stop_without_effect_is_repeated() -> None:
    z_m = CEILING_M - PROFILE.vehicle.gear_body_m[2]
    state = state_in(Phase.COMPLETE, z_m=z_m)
    sent = 0
    for i in range(1, 150):
        obs = observation(
            10.0 + 0.02 * i, telemetry=telemetry(10.0 + 0.02 * i, z_m, thrust=20000.0)
        )
        state, command = planner.step(state, obs, PROFILE)
        sent += isinstance(command, StopMotors)
    assert sent > 7
