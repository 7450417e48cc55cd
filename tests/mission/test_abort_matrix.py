"""Every phase x every abort event, each to its proper end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from perchctl.mission import Observation, OperatorRequest, Outcome, Phase, PlannerState, planner
from perchctl.mission.phase import PRE_LANDING_PHASES, Severity
from perchctl.profile import Profile
from perchctl.vehicle import (
    CRASHED,
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
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    HOVERING,
    IN_CORRIDOR,
    PROFILE,
    READY,
    changed,
    observation,
    remembering,
    state_in,
)
from tests.mission.rig import BEGIN_S, TICK_S, Look, Motors, at, fly, is_setpoint, times

Event = Callable[[Observation], Observation]


def _tel(**changes: object) -> Event:
    return lambda obs: replace(obs, telemetry=replace(obs.telemetry, **changes))


def _obs(**changes: object) -> Event:
    return lambda obs: replace(obs, **changes)


def _bits(bit: int) -> Event:
    return _tel(supervisor=AIRBORNE | bit)


STOP, LAND = "stop", "land"
CAMERA_PHASES = {
    Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER, Phase.HOVER,
}  # fmt: skip
PRE_CONTACT_PHASES = PRE_LANDING_PHASES - {Phase.COMPLETE}
ALL = PRE_LANDING_PHASES | {Phase.LANDING}

# event: (what happens, seconds it lasts, where it counts, how it ends, outcome)
EVENTS: dict[str, tuple[Event, float, frozenset[Phase] | set[Phase], str, Outcome]] = {
    "operator-stop": (_obs(operator_request=OperatorRequest.CUT_MOTORS), 0.1, ALL, STOP,
        Outcome.EMERGENCY),
    "locked": (_bits(LOCKED), 0.1, ALL, STOP, Outcome.SAFETY),
    "tumbled": (_bits(TUMBLED), 0.1, ALL, STOP, Outcome.SAFETY),
    "crashed": (_bits(CRASHED), 0.1, ALL, STOP, Outcome.SAFETY),
    "tilted": (_tel(roll_rad=1.5), 0.5, ALL, STOP, Outcome.SAFETY),
    "operator-land": (_obs(operator_request=OperatorRequest.LAND), 0.1, PRE_LANDING_PHASES, LAND,
        Outcome.ENDED_BY_OPERATOR),
    "link-lost": (_obs(link_problem="gone"), 0.1, PRE_LANDING_PHASES, LAND, Outcome.SAFETY),
    "telemetry-stale": (
        lambda o: replace(o, telemetry=replace(o.telemetry, t_s=9.9)),
        1.5, PRE_LANDING_PHASES, LAND, Outcome.SAFETY,
    ),
    "position-lost": (
        _obs(external_position_age_s=0.8, external_position_problem="occluded"), 0.1,
        CAMERA_PHASES | {Phase.APPROACH, Phase.PERCH}, LAND, Outcome.SAFETY,
    ),
    "heading-lost": (
        _obs(has_estimated_position_jumped=True, heading_jump_rad=1.5), 0.1,
        PRE_CONTACT_PHASES, LAND, Outcome.SAFETY,
    ),
    "estimator-jump": (_obs(has_estimated_position_jumped=True), 0.8, PRE_CONTACT_PHASES, LAND,
        Outcome.SAFETY),
    "estimate-unsure": (
        _tel(velocity_variance_m2ps2=0.08), 1.2, CAMERA_PHASES | {Phase.APPROACH}, LAND,
        Outcome.SAFETY,
    ),
    "battery-low": (_tel(battery_v=2.8), 1.8, PRE_CONTACT_PHASES, LAND, Outcome.SAFETY),
    "battery-low-power": (_tel(battery_state=3), 1.8, PRE_CONTACT_PHASES, LAND, Outcome.SAFETY),
    "battery-unknown": (
        _obs(battery_reading_age_s=99.0), 0.1, PRE_CONTACT_PHASES, LAND, Outcome.SAFETY
    ),
    "height-limit": (
        _tel(position_m=(0.0, 0.0, 3.4)), 0.1, PRE_CONTACT_PHASES, LAND, Outcome.SAFETY,
    ),
    "fence": (_tel(position_m=(2.5, 0.0, 1.0)), 0.1, PRE_CONTACT_PHASES, LAND, Outcome.SAFETY),
    "corridor": (_tel(position_m=(0.5, 0.0, 1.0)), 0.1, PRE_CONTACT_PHASES, LAND, Outcome.SAFETY),
    "corridor-unknown": (
        _tel(position_m=(math.nan, 0.0, 1.0)), 0.1, PRE_CONTACT_PHASES, LAND, Outcome.SAFETY,
    ),
    "camera-gone": (
        _obs(last_good_frame_age_s=4.0, has_new_frame=False, camera_problem="camera unplugged"),
        0.1, CAMERA_PHASES, LAND, Outcome.SAFETY,
    ),
    "loop-late": (_obs(tick_start_delay_s=1.2), 0.1, PRE_LANDING_PHASES, LAND, Outcome.SAFETY),
    "markers-disagree": (
        _obs(successive_marker_conflict_frames=40), 0.1, CAMERA_PHASES, LAND, Outcome.SAFETY,
    ),
    "time-over": (
        lambda o: o, 0.1, PRE_CONTACT_PHASES, LAND, Outcome.ATTEMPTS_USED_UP,
    ),
}  # fmt: skip


BY_ITSELF = ("link-lost", "telemetry-stale", "estimator-jump", "loop-late")
"""Where height, link or loop are doubtful the vehicle lands by its own; else by setpoints."""
LEVEL = ("position-lost", "heading-lost")
"""Where nothing measures the position, or a heading that is far off would lead position setpoints
away from their place, it comes down level, by thrust."""


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


PROFILES = {name: IN_CORRIDOR for name in EVENTS if name.startswith("corridor")}
"""The profile of an event that another one than `PROFILE` meets."""


def _profile(phase: Phase, event: str = "") -> Profile:
    flown = PROFILES.get(event, PROFILE)
    if phase is not Phase.HOVER:
        return flown
    return flown.with_({"planner.hover": HOVERING.planner.hover})


def _begin(phase: Phase, event: str) -> PlannerState:
    z = CEILING_M - 0.03 if phase is Phase.COMPLETE else 1.0
    state = state_in(phase, z_m=z)
    return remembering(state, flight_started_at_s=-1000.0) if event == "time-over" else state


def _run(state: PlannerState, name: str) -> tuple[PlannerState, list[object]]:
    event, lasts_s, *_ = EVENTS[name]
    profile = _profile(state.phase, name)
    commands: list[object] = []
    for t_s in times(lasts_s):
        obs = event(observation(t_s, state.entry.vehicle_world_position_m[2]))
        state, command = planner.step_mission(state, obs, profile)
        commands.append(command)
        if state.phase in (Phase.LANDING, Phase.ABORTED) and state.transition_name != "":
            break
    return state, commands


@pytest.mark.parametrize("name", EVENTS)
@pytest.mark.parametrize("phase", sorted(ALL, key=lambda p: p.value))
def test_every_phase_meets_every_abort(phase: Phase, name: str) -> None:
    _, _, counts_in, ends, outcome = EVENTS[name]
    state, commands = _run(_begin(phase, name), name)
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
        # A heading that jumped is set anew first, so that the firmware does not turn by the jump.
        level = name in LEVEL and name != "heading-lost"
        down(
            commands[-1], state.entry.vehicle_world_position_m[2], by_itself=by_itself, level=level
        )
    assert state.transition_reason


@pytest.mark.parametrize("name", PROFILES)
def test_without_a_corridor_no_place_is_outside_of_it(name: str) -> None:
    event, *_ = EVENTS[name]
    state, _ = planner.step_mission(state_in(Phase.ALIGN), event(observation(10.02)), PROFILE)
    assert state.transition_name != "corridor"


@pytest.mark.parametrize("name", [n for n, e in EVENTS.items() if e[3] == LAND])
def test_a_landing_is_never_undone(name: str) -> None:
    """Once it lands nothing but a stop changes it, whatever comes and goes."""
    state, _ = _run(_begin(Phase.ALIGN, name), name)
    orders = 0
    for i in range(200):
        obs = observation(20.0 + 0.02 * i, 0.8)
        state, command = planner.step_mission(state, obs, PROFILES.get(name, PROFILE))
        assert state.phase is Phase.LANDING
        assert isinstance(command, RawThrust if name in LEVEL else Land | Idle | PositionSetpoint)
        if isinstance(command, PositionSetpoint):
            assert command.z_m < 0.8
        orders += isinstance(command, Land)
    assert orders <= 6


@pytest.mark.parametrize("phase", sorted(CAMERA_PHASES - {Phase.RECOVER}, key=lambda p: p.value))
@pytest.mark.parametrize(
    "event",
    [
        _obs(last_good_frame_age_s=1.0, has_new_frame=False, target=None),
        _obs(tick_start_delay_s=0.4),
        lambda o: replace(o, telemetry=replace(o.telemetry, t_s=o.t_s - 0.5)),
        _tel(velocity_variance_m2ps2=0.08),
        _obs(external_position_age_s=0.3),
    ],
    ids=["camera-silent", "loop-late", "telemetry-late", "estimate-unsure", "position-stale"],
)
def test_a_short_fault_never_climbs(phase: Phase, event: Event) -> None:
    state = state_in(phase)
    before = state.setpoint
    state, command = planner.step_mission(state, event(observation(10.02)), _profile(phase))
    if state.phase is Phase.RECOVER:  # the target is lost in the ascent: down, not up
        assert isinstance(command, PositionSetpoint)
        assert before is not None
        assert command.z_m < before.z_m
    else:
        assert state.hold_reason
        assert state.phase is not phase or command == before


@pytest.mark.parametrize("phase", sorted(ALL, key=lambda p: p.value))
def test_an_undisturbed_phase_neither_climbs_nor_stops(phase: Phase) -> None:
    """Only search, ascent, press and take-off climb; motors stop only on proof, and nothing else
    in the table leads to a stop."""
    begin = _begin(phase, "")
    flight = fly(begin, at(begin.entry.vehicle_world_position_m[2]), 6.0, _profile(phase))
    assert not any(isinstance(c, EmergencyStop | StopMotors) for c in flight.commands)
    climbs = {Phase.SEARCH, Phase.ASCEND, Phase.PERCH, Phase.APPROACH, Phase.COMPLETE}
    start_z = begin.setpoint.z_m if begin.setpoint else 0.0
    for tick in flight.ticks[:19]:
        if phase in climbs or tick.state.phase is not phase:
            break
        if isinstance(tick.command, PositionSetpoint):
            assert tick.command.z_m <= start_z + 1e-9


@pytest.mark.parametrize(("mode", "kind"), [("raw", RawThrust), ("position", PositionSetpoint)])
def test_the_perch_ends_by_itself(mode: str, kind: type) -> None:
    """Without proof of contact the press is bounded and backs off down."""
    profile = changed({"planner.perch.mode": mode})
    flight = fly(state_in(Phase.PERCH, z_m=2.09), at(2.09), 4.0, profile, one_phase=True)
    assert flight.state.phase is Phase.RECOVER
    lowest_m = 2.09 - PROFILE.planner.recover.descend_m
    assert is_setpoint(flight.command, distance_below_m=lowest_m + 1e-9)
    *sent, _ = flight.commands
    assert all(isinstance(c, kind) for c in sent)
    assert math.isclose(len(sent) * TICK_S, PROFILE.planner.perch.timeout_s, abs_tol=0.1)


# --- What may stop the motors ------------------------------------------------------------


def hanging(phase: Phase = Phase.COMPLETE, **changes: Any) -> PlannerState:
    """The thrust is released as far as position mode goes, and the magnet holds."""
    held = {
        "vehicle_world_z_at_last_contact_m": HANG_Z_M,
        "weight_transfer_began_at_s": 10.0,
        **changes,
    }
    return remembering(state_in(phase, z_m=HANG_Z_M), **held)


class Hangs(Motors):
    """The vehicle hangs, its thrust as it was ordered; `change` spoils what is observed."""

    def __init__(self, change: Callable[[Observation], Observation] = lambda obs: obs) -> None:
        super().__init__(20000.0)
        self.change = change

    def look(self, t_s: float, state: PlannerState) -> Observation:
        return self.change(at(HANG_Z_M, thrust=self.thrust)(t_s))

    def obey(self, state: PlannerState, command: Command) -> None:
        if isinstance(command, RawThrust | StopMotors):
            self.thrust = float(getattr(command, "thrust", 0.0))


@pytest.mark.parametrize("phase", [Phase.COMPLETE, Phase.LANDING])
def test_the_motors_stop_once_the_whole_weight_has_hung(phase: Phase) -> None:
    flight = fly(hanging(phase), Hangs(), 2.58)
    stops = flight.stops_s
    assert stops[0] - flight.still_s[0] >= PROFILE.planner.complete.hang_s - 0.03
    assert len(stops) == 5  # one lost notify would lock a vehicle that hangs well
    assert stops[-1] - stops[0] < 0.6  # well within the supervisor's 2 s
    assert flight.state.phase is phase


def _aged(obs: Observation, age_s: float) -> Observation:
    return replace(obs, telemetry=replace(obs.telemetry, t_s=obs.t_s - age_s))


@pytest.mark.parametrize(
    "change",
    [
        lambda obs: _aged(obs, 0.15),
        # Fresh for half a second, then an outage.
        lambda obs: _aged(obs, 0.2 if round(50 * (obs.t_s - BEGIN_S)) % 30 > 25 else 0.0),
        lambda obs: replace(obs, telemetry=replace(obs.telemetry, acc_z_g=0.7)),
    ],
    ids=["stale", "gaps", "restless"],
)
@pytest.mark.parametrize("phase", [Phase.COMPLETE, Phase.LANDING])
def test_no_motor_stops_without_fresh_proof(
    phase: Phase, change: Callable[[Observation], Observation]
) -> None:
    """Old, interrupted or contradicting telemetry proves nothing (fault 40)."""
    flight = fly(hanging(phase), Hangs(change), 1.98)
    assert not any(isinstance(c, StopMotors | EmergencyStop) for c in flight.commands)


@pytest.mark.parametrize(
    ("released_s", "falls", "ticks", "above_m"),
    [
        # A setpoint below would cost the change of mode's dip.
        (9.0, {"z_m": -0.01, "vz_mps": -0.3, "acc_z_g": 0.2, "thrust": 1000.0}, 3, (0.5, 2.0)),
        # At 1 g, each 10 ms of waiting cost what full thrust takes 80 ms to give back.
        (9.0, {"z_m": -0.001, "vz_mps": -0.1, "acc_z_g": 0.1, "thrust": 1000.0}, 1, (0.5, 2.0)),
        # Caught by full thrust it would stick to the ceiling again, beside the target's centre.
        (None, {"z_m": -0.04, "vz_mps": -0.3, "thrust": 30000.0}, 3, (0.0, 0.3)),
        # More thrust would bring it back to the ceiling, where the magnet would catch it beside the
        # target's centre: three of a hundred flights hung 8 to 16 mm beside it.
        (None, {"z_m": -0.03, "vz_mps": -0.15, "thrust": 0.9 * HOVER_THRUST}, 5, (-2.0, -0.05)),
    ],
    ids=["released", "free fall", "half of the thrust", "nearly the whole thrust"],
)
def test_a_slip_is_caught_by_as_much_as_it_takes_then_held_where_it_is(
    released_s: float | None, falls: dict[str, float], ticks: int, above_m: tuple[float, float]
) -> None:
    falls = dict(falls)
    z_m, velocity = HANG_Z_M + falls.pop("z_m"), (0.0, 0.0, falls.pop("vz_mps"))
    look = at(z_m, velocity_mps=velocity, **falls)
    flight = fly(hanging(weight_transfer_began_at_s=released_s), look, ticks * TICK_S)
    assert flight.state.phase is Phase.RECOVER
    assert is_setpoint(flight.command, HANG_Z_M + above_m[0], HANG_Z_M + above_m[1])
    if above_m[0] >= 0.0:
        slow = at(HANG_Z_M - 0.2, velocity_mps=(0.0, 0.0, 0.01))(10.2)
        _, command = planner.step_mission(flight.state, slow, PROFILE)
        assert is_setpoint(command, distance_below_m=HANG_Z_M - 0.1)


@pytest.mark.parametrize(
    "stopped",
    [{}, {"motor_stop_commanded_at_s": 9.5, "stop_or_land_command_count": 5}],
    ids=["turns", "stopped"],
)
def test_a_slip_in_a_landing_is_caught_and_the_landing_goes_on(stopped: dict[str, Any]) -> None:
    """Released, or with the motors stopped already: they spin again, and then it goes down."""
    falls = at(HANG_Z_M - 0.01, velocity_mps=(0.0, 0.0, -0.3), acc_z_g=0.2, thrust=0.0)
    flight = fly(hanging(Phase.LANDING, weight_transfer_began_at_s=9.0, **stopped), falls, 0.06)
    state = flight.state
    assert state.phase is Phase.LANDING
    assert is_setpoint(flight.command, above_m=HANG_Z_M + 0.5)
    for i in range(1, 40):
        held = at(HANG_Z_M - 0.2)(10.2 + TICK_S * i)
        state, command = planner.step_mission(state, held, PROFILE)
        assert is_setpoint(command, distance_below_m=HANG_Z_M - 0.2 + 1e-9)
    assert state.motor_stop_commanded_at_s is None


def _heard_last(z_m: float, **tel: Any) -> Look:
    """The telemetry stays away from the begin on."""
    last = at(z_m, **tel)(BEGIN_S).telemetry
    return lambda t_s: observation(t_s, telemetry=last)


def test_unknown_is_not_on_the_ground() -> None:
    """The telemetry dies as the take-off begins: the last sample shows no thrust, and the
    vehicle may fly all the same. A landing is ordered, and nothing is called landed."""
    last = _heard_last(0.0, thrust=0.0, supervisor=READY)
    flight = fly(state_in(Phase.APPROACH, z_m=0.0), last, 4.0)
    assert {tick.state.phase for tick in flight.ticks} == {Phase.APPROACH, Phase.LANDING}
    assert any(isinstance(command, Land) for command in flight.commands)


@pytest.mark.parametrize("phase", sorted(ALL, key=lambda p: p.value))
def test_an_old_tilt_cuts_no_motor(phase: Phase) -> None:
    """A gust tilts it, and then the telemetry stays away: nothing says that it still is."""
    begin = _begin(phase, "")
    flight = fly(begin, _heard_last(begin.entry.vehicle_world_position_m[2], roll_rad=1.2), 1.6)
    assert not any(isinstance(c, EmergencyStop | StopMotors) for c in flight.commands)
    assert flight.state.phase is not Phase.ABORTED
