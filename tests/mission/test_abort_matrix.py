"""Every phase x every abort event, each to its proper end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from perchctl.mission import Observation, Operator, Outcome, Phase, PlannerState, planner
from perchctl.mission.state import FLYING_PHASES, Severity
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
)
from tests.helpers.mission import (
    AIRBORNE,
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    PROFILE,
    READY,
    changed,
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
    "position-lost": (
        _obs(position_age_s=0.8, position_problem="occluded"), 0.1,
        CAMERA_PHASES | {Phase.APPROACH, Phase.PERCH}, LAND, Outcome.SAFETY,
    ),
    "estimator-jump": (_obs(jumped=True), 0.8, BEFORE_CONTACT, LAND, Outcome.SAFETY),
    "estimate-unsure": (
        _tel(position_variance_m2=0.08), 1.2, CAMERA_PHASES | {Phase.APPROACH}, LAND,
        Outcome.SAFETY,
    ),
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


BY_ITSELF = ("link-lost", "telemetry-stale", "estimator-jump", "loop-late")
"""Where height, link or loop are doubtful the vehicle lands by its own; else by setpoints."""
LEVEL = "position-lost"
"""Where nothing measures the position it comes down level, by thrust."""


def down(command: object, z_m: float, *, by_itself: bool = False, level: bool = False) -> None:
    if level:
        assert isinstance(command, RawThrust)
        assert command.thrust < HOVER_THRUST
    elif by_itself:
        assert isinstance(command, Land)
        assert command.height_m <= 0.0
    else:
        assert isinstance(command, PositionSetpoint)
        assert command.z_m <= z_m + 1e-9


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
        state, command = planner.step_mission(state, obs, PROFILE)
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
        at_ceiling = phase in (Phase.PERCH, Phase.COMPLETE)  # peeled off first, also blindly
        by_itself = name in BY_ITSELF and not at_ceiling
        down(commands[-1], state.entry_m[2], by_itself=by_itself, level=name == LEVEL)
    assert state.reason


@pytest.mark.parametrize("name", [n for n, e in EVENTS.items() if e[3] == LAND])
def test_a_landing_is_never_undone(name: str) -> None:
    """Once it lands nothing but a stop changes it, whatever comes and goes."""
    event, lasts_s, _, _, _ = EVENTS[name]
    state, _ = _run(_begin(Phase.ALIGN, name), event, lasts_s)
    orders = 0
    for i in range(200):
        obs = observation(20.0 + 0.02 * i, 0.8)
        state, command = planner.step_mission(state, obs, PROFILE)
        assert state.phase is Phase.LANDING
        assert isinstance(command, RawThrust if name == LEVEL else Land | Idle | PositionSetpoint)
        if isinstance(command, PositionSetpoint):
            assert command.z_m < 0.8
        orders += isinstance(command, Land)
    assert orders <= 6


@pytest.mark.parametrize("phase", sorted(FLYING_PHASES, key=lambda p: p.value))
def test_ctrl_c_once_lands_and_twice_stops(phase: Phase) -> None:
    state = _begin(phase, "")
    obs = observation(10.02, state.entry_m[2], operator=Operator.LAND)
    state, command = planner.step_mission(state, obs, PROFILE)
    down(command, state.entry_m[2])
    state, command = planner.step_mission(
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
        _tel(position_variance_m2=0.08),
        _obs(position_age_s=0.3),
    ],
    ids=["camera-silent", "loop-late", "telemetry-late", "estimate-unsure", "position-stale"],
)
def test_a_short_fault_never_climbs(phase: Phase, event: Event) -> None:
    state = state_in(phase)
    before = state.setpoint
    state, command = planner.step_mission(state, event(observation(10.02)), PROFILE)
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
            state, command = planner.step_mission(state, obs, PROFILE)
            if state.phase is not phase:
                break
            if isinstance(command, PositionSetpoint) and phase is not Phase.COMPLETE:
                assert command.z_m <= start_z + 1e-9


def test_no_stop_without_contact_tumble_word_or_attitude() -> None:
    """Motors stop only on proof: nothing else in the table leads to a stop."""
    for phase in ALL:
        state = _begin(phase, "")
        for i in range(1, 300):
            obs = observation(10.0 + 0.02 * i, state.entry_m[2])
            state, command = planner.step_mission(state, obs, PROFILE)
            assert not isinstance(command, EmergencyStop | StopMotors)


@pytest.mark.parametrize("mode", ["raw", "position"])
def test_the_perch_ends_by_itself(mode: str) -> None:
    """Without proof of contact the press is bounded and backs off down."""
    profile = changed({"planner.perch.mode": mode})
    state = state_in(Phase.PERCH, z_m=2.09)
    sent: list[object] = []
    for i in range(1, 200):
        t_s = 10.0 + 0.02 * i
        state, command = planner.step_mission(state, observation(t_s, 2.09), profile)
        if state.phase is not Phase.PERCH:
            break
        sent.append(command)
    assert state.phase is Phase.RECOVER
    assert isinstance(command, PositionSetpoint)
    assert command.z_m <= 2.09 - PROFILE.planner.recover.descend_m
    kind = RawThrust if mode == "raw" else PositionSetpoint
    assert all(isinstance(c, kind) for c in sent)
    assert math.isclose(len(sent) * 0.02, PROFILE.planner.perch.timeout_s, abs_tol=0.1)


# --- What may stop the motors ------------------------------------------------------------


def hanging(phase: Phase = Phase.COMPLETE) -> PlannerState:
    """The thrust is released as far as position mode goes, and the magnet holds."""
    state = state_in(phase, z_m=HANG_Z_M)
    return replace(state, contact_z_m=HANG_Z_M, released_s=10.0)


def run_hanging(
    state: PlannerState, change: Callable[[Observation, int], Observation], ticks: int = 130
) -> tuple[PlannerState, list[tuple[float, object]]]:
    """The vehicle hangs, its thrust as it was ordered; `change` spoils what is observed."""
    thrust, sent = 20000.0, []
    for i in range(1, ticks):
        t_s = 10.0 + 0.02 * i
        obs = observation(t_s, telemetry=telemetry(t_s, HANG_Z_M, thrust=thrust))
        state, command = planner.step_mission(state, change(obs, i), PROFILE)
        if isinstance(command, RawThrust):
            thrust = float(command.thrust)
        elif isinstance(command, StopMotors):
            thrust = 0.0
        sent.append((t_s, command))
    return state, sent


@pytest.mark.parametrize("phase", [Phase.COMPLETE, Phase.LANDING])
def test_the_motors_stop_once_the_whole_weight_has_hung(phase: Phase) -> None:
    state, sent = run_hanging(hanging(phase), lambda obs, i: obs)
    stops = [t_s for t_s, command in sent if isinstance(command, StopMotors)]
    still = next(t_s for t_s, c in sent if isinstance(c, RawThrust) and c.thrust <= 5000)
    assert stops[0] - still >= PROFILE.planner.complete.hang_s - 0.03
    assert len(stops) == 5  # one lost notify would lock a vehicle that hangs well
    assert stops[-1] - stops[0] < 0.6  # well within the supervisor's 2 s
    assert state.phase is phase


def _stale(obs: Observation, i: int) -> Observation:
    return replace(obs, telemetry=replace(obs.telemetry, t_s=obs.t_s - 0.15))


def _gaps(obs: Observation, i: int) -> Observation:
    """Fresh for half a second, then an outage."""
    old = 0.2 if i % 30 > 25 else 0.0
    return replace(obs, telemetry=replace(obs.telemetry, t_s=obs.t_s - old))


def _restless(obs: Observation, i: int) -> Observation:
    return replace(obs, telemetry=replace(obs.telemetry, acc_z_g=0.7))


@pytest.mark.parametrize("change", [_stale, _gaps, _restless])
@pytest.mark.parametrize("phase", [Phase.COMPLETE, Phase.LANDING])
def test_no_motor_stops_without_fresh_proof(
    phase: Phase, change: Callable[[Observation, int], Observation]
) -> None:
    """Old, interrupted or contradicting telemetry proves nothing (fault 40)."""
    _, sent = run_hanging(hanging(phase), change, ticks=100)
    assert not [c for _, c in sent if isinstance(c, StopMotors | EmergencyStop)]


def test_a_landing_at_the_ceiling_peels_off_first() -> None:
    """The setpoint goes below, and the thrust with it, before anything is concluded."""
    state = replace(state_in(Phase.LANDING, z_m=HANG_Z_M), contact_z_m=HANG_Z_M)
    obs = observation(10.02, telemetry=telemetry(10.02, HANG_Z_M))
    for i in range(1, 60):
        obs = observation(10.0 + 0.02 * i, telemetry=telemetry(10.0 + 0.02 * i, HANG_Z_M))
        state, command = planner.step_mission(state, obs, PROFILE)
        assert isinstance(command, PositionSetpoint)
        assert command.z_m <= HANG_Z_M
    assert command.z_m < HANG_Z_M - 0.2


def test_a_slip_is_caught_from_above_then_held_where_it_is() -> None:
    state = replace(hanging(), released_s=9.0)
    falling = telemetry(
        10.02, HANG_Z_M - 0.01, velocity_mps=(0.0, 0.0, -0.3), acc_z_g=0.2, thrust=1000.0
    )
    for i in range(1, 4):
        tel = replace(falling, t_s=10.0 + 0.02 * i)
        state, command = planner.step_mission(state, observation(tel.t_s, telemetry=tel), PROFILE)
    assert state.phase is Phase.RECOVER
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > HANG_Z_M + 0.5  # a setpoint below would cost the change of mode's dip
    caught = telemetry(10.18, HANG_Z_M - 0.2, velocity_mps=(0.0, 0.0, 0.01))
    state, command = planner.step_mission(state, observation(10.18, telemetry=caught), PROFILE)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m < HANG_Z_M - 0.1


def test_a_slip_with_half_of_the_thrust_left_is_caught_gently() -> None:
    """Caught by full thrust it would stick to the ceiling again, beside the target's centre."""
    state = replace(hanging(), released_s=None)
    for i in range(1, 4):
        t_s = 10.0 + 0.02 * i
        tel = telemetry(t_s, HANG_Z_M - 0.04, velocity_mps=(0.0, 0.0, -0.3), thrust=30000.0)
        state, command = planner.step_mission(state, observation(t_s, telemetry=tel), PROFILE)
    assert state.phase is Phase.RECOVER
    assert isinstance(command, PositionSetpoint)
    assert HANG_Z_M < command.z_m < HANG_Z_M + 0.3
    slow = telemetry(10.2, HANG_Z_M - 0.07, velocity_mps=(0.0, 0.0, -0.05))
    state, command = planner.step_mission(state, observation(10.2, telemetry=slow), PROFILE)
    assert isinstance(command, PositionSetpoint)
    assert command.z_m < HANG_Z_M - 0.05


def test_a_slip_on_nearly_the_whole_thrust_is_let_sink() -> None:
    """More thrust would bring it back to the ceiling, and the magnet would catch beside the
    target's centre: three of a hundred flights hung 8 to 16 mm beside it."""
    state = replace(hanging(), released_s=None)
    for i in range(1, 6):
        t_s = 10.0 + 0.02 * i
        tel = telemetry(
            t_s, HANG_Z_M - 0.03, velocity_mps=(0.0, 0.0, -0.15), thrust=0.9 * HOVER_THRUST
        )
        state, command = planner.step_mission(state, observation(t_s, telemetry=tel), PROFILE)
        assert isinstance(command, PositionSetpoint)
        assert state.phase is Phase.COMPLETE or command.z_m < HANG_Z_M - 0.05
    assert state.phase is Phase.RECOVER


def test_a_free_fall_is_answered_in_the_tick_that_shows_it() -> None:
    """At 1 g, each 10 ms of waiting cost what full thrust takes 80 ms to give back."""
    state = replace(hanging(), released_s=9.0)
    falls = telemetry(
        10.02, HANG_Z_M - 0.001, velocity_mps=(0.0, 0.0, -0.1), acc_z_g=0.1, thrust=1000.0
    )
    state, command = planner.step_mission(state, observation(10.02, telemetry=falls), PROFILE)
    assert state.phase is Phase.RECOVER
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > HANG_Z_M + 0.5


@pytest.mark.parametrize("stopped_s", [None, 9.5])
def test_a_slip_in_a_landing_is_caught_and_the_landing_goes_on(stopped_s: float | None) -> None:
    """Released, or with the motors stopped already: they spin again, and then it goes down."""
    orders = 0 if stopped_s is None else 5
    state = replace(hanging(Phase.LANDING), released_s=9.0, stopped_s=stopped_s, orders=orders)
    for i in range(1, 4):
        tel = telemetry(
            10.0 + 0.02 * i, HANG_Z_M - 0.01, velocity_mps=(0.0, 0.0, -0.3), acc_z_g=0.2, thrust=0.0
        )
        state, command = planner.step_mission(state, observation(tel.t_s, telemetry=tel), PROFILE)
    assert state.phase is Phase.LANDING
    assert isinstance(command, PositionSetpoint)
    assert command.z_m > HANG_Z_M + 0.5
    for i in range(1, 40):
        tel = telemetry(10.2 + 0.02 * i, HANG_Z_M - 0.2)
        state, command = planner.step_mission(state, observation(tel.t_s, telemetry=tel), PROFILE)
        assert isinstance(command, PositionSetpoint)
        assert command.z_m <= HANG_Z_M - 0.2 + 1e-9
    assert state.stopped_s is None


def test_unknown_is_not_on_the_ground() -> None:
    """The telemetry dies as the take-off begins: the last sample shows no thrust, and the
    vehicle may fly all the same. A landing is ordered, and nothing is called landed."""
    state = state_in(Phase.APPROACH, z_m=0.0)
    last = telemetry(10.0, 0.0, thrust=0.0, supervisor=READY)
    orders = 0
    for i in range(1, 200):
        t_s = 10.0 + 0.02 * i
        state, command = planner.step_mission(state, observation(t_s, telemetry=last), PROFILE)
        orders += isinstance(command, Land)
        assert state.phase in (Phase.APPROACH, Phase.LANDING)
    assert state.phase is Phase.LANDING
    assert orders >= 1


@pytest.mark.parametrize("phase", sorted(ALL, key=lambda p: p.value))
def test_an_old_tilt_cuts_no_motor(phase: Phase) -> None:
    """A gust tilts it, and then the telemetry stays away: nothing says that it still is."""
    state = _begin(phase, "")
    last = telemetry(10.0, state.entry_m[2], roll_rad=1.2)
    for i in range(1, 80):
        obs = observation(10.0 + 0.02 * i, telemetry=last)
        state, command = planner.step_mission(state, obs, PROFILE)
        assert not isinstance(command, EmergencyStop | StopMotors)
        assert state.phase is not Phase.ABORTED
