"""The flight loop: newest frame, telemetry, pipeline, planner, link, log; one thread.

Time comes from a `Clock`, so the same loop flies in real time through cflib and in
lockstep with a simulated vehicle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from perchctl.camera.source import FrameSource
from perchctl.errors import Interrupted, NotFound
from perchctl.flight.clock import Clock
from perchctl.flight.preflight import refuse, still_waiting_for
from perchctl.flight.rescue import rescue
from perchctl.flight.senses import Senses
from perchctl.link.protocol import Link
from perchctl.mission import planner
from perchctl.mission.state import Observation, Operator, Outcome, Phase, PlannerState, Severity
from perchctl.mission.watch import Event, EventKind, FlightReport, Tick, Watcher
from perchctl.pipeline import Pipeline
from perchctl.profile import Profile
from perchctl.vehicle import LOCKED, NO_BATTERY_READING_V, Idle, Telemetry


@dataclass(frozen=True, eq=False)
class FlightParts:
    link: Link
    source: FrameSource
    clock: Clock
    profile: Profile
    pipeline: Pipeline
    watchers: tuple[Watcher, ...] = ()
    operator: Callable[[], Operator] = lambda: Operator.NONE


def fly(parts: FlightParts) -> FlightReport:
    """Connect is done: wait until ready, fly the mission, return how it ended.

    Whatever is raised on the way, the vehicle is landed first. Errors:
    `SafetyAbort`, `TimedOut`, `NotFound` and `Interrupted` before take-off, and
    anything unforeseen after the rescue.
    """
    senses = Senses(parts.link, parts.source, parts.pipeline, parts.profile)
    _wait_until_ready(parts, senses)  # nothing is started before it returns
    if senses.history.newest is not None:
        senses.ground_z_m = senses.history.newest.position_m[2]
    try:
        return _mission(parts, senses)
    except BaseException:
        landing, newest = parts.profile.planner.landing, senses.history.newest
        rescue(parts.link, parts.clock, landing, parts.operator, newest, senses.ground_z_m)
        raise


def _wait_until_ready(parts: FlightParts, senses: Senses) -> None:
    started_s = parts.clock.now()
    while True:
        now_s = parts.clock.now()
        if parts.operator() is not Operator.NONE:
            raise Interrupted("Ctrl-C before take-off: nothing was started")
        senses.take_in(now_s)
        newest = senses.history.newest
        refuse(newest, parts.profile)
        waiting = still_waiting_for(
            newest, senses.frames > 0, senses.camera_problem, now_s - started_s, parts.profile
        )
        if parts.source.finished:
            raise NotFound(
                f"{parts.source.describe()} ended before take-off: a flight needs pictures that "
                f"go on, from a camera or a longer recording"
            )
        if not waiting:
            return
        parts.clock.wait_until(now_s + 1.0 / parts.profile.link.loop_hz)


def _mission(parts: FlightParts, senses: Senses) -> FlightReport:
    period_s = 1.0 / parts.profile.link.loop_hz
    clock = parts.clock
    due_s = clock.now()
    state: PlannerState | None = None
    passed: list[Event] = []
    while True:
        now_s = clock.now()
        late_s = max(0.0, now_s - due_s)
        senses.take_in(now_s, look=not _is_blind(state))
        obs = _observe(parts, senses, now_s, late_s)
        before = state
        state, command = planner.step(before or planner.start(obs), obs, parts.profile)
        if not isinstance(command, Idle):
            parts.link.send(command)
        for event in _events(before, state, obs, parts.profile):
            if event.kind is EventKind.PHASE:
                passed.append(event)
            for watcher in parts.watchers:
                watcher.event(event)
        tick = Tick(
            now_s,
            obs.telemetry,
            senses.output,
            obs.target,
            state,
            command,
            late_s,
            obs.camera_age_s,
            now_s - obs.telemetry.t_s,
        )
        for watcher in parts.watchers:
            watcher.tick(tick)
        if planner.is_over(state):
            return _report(state, now_s, obs.telemetry, tuple(passed))
        due_s += period_s
        if due_s < now_s:
            due_s = now_s + period_s  # never try to catch up with a burst of old ticks
        clock.wait_until(due_s)


def _is_blind(state: PlannerState | None) -> bool:
    """Against the ceiling nothing is steered by the picture, and it shows no target."""
    return state is not None and state.phase is Phase.COMPLETE


def _observe(parts: FlightParts, senses: Senses, now_s: float, late_s: float) -> Observation:
    newest = senses.history.newest
    assert newest is not None
    changed_s = senses.history.battery_changed_s
    return Observation(
        t_s=now_s,
        telemetry=newest,
        target=senses.target(now_s),
        new_frame=senses.output is not None,
        camera_age_s=now_s - senses.last_good_frame_s,
        camera_problem=senses.camera_problem,
        link_problem=parts.link.problem(now_s),
        battery_age_s=0.0 if changed_s is None else now_s - changed_s,
        jumped=senses.history.jumped,
        loop_late_s=late_s,
        disagreeing_frames=senses.state.disagreeing_frames,
        operator=parts.operator(),
        log_problem=next((w.problem for w in parts.watchers if w.problem), None),
    )


def _events(
    before: PlannerState | None, state: PlannerState, obs: Observation, profile: Profile
) -> list[Event]:
    """What happened in this turn; `before` is None in the first."""
    events: list[Event] = []
    if before is None:
        start = planner.start(obs)
        events.append(Event(obs.t_s, EventKind.PHASE, start.reason, start.phase))
        if obs.telemetry.battery_v < NO_BATTERY_READING_V:
            grace_s = profile.safety.battery_stale_s
            text = f"no battery reading: landing after {grace_s:.0f} s at most"
            events.append(Event(obs.t_s, EventKind.NOTE, text, start.phase))
        before = start
    if state.phase is not before.phase:
        entered = Event(
            obs.t_s, EventKind.PHASE, state.reason, state.phase, state.row, state.severity
        )
        events.append(entered)
    elif state.hold and not before.hold:
        events.append(
            Event(obs.t_s, EventKind.HOLD, state.hold, state.phase, severity=Severity.HOLD)
        )
    return events


def _report(
    state: PlannerState, now_s: float, telemetry: Telemetry, passed: tuple[Event, ...]
) -> FlightReport:
    reason = state.reason
    if state.phase is Phase.LANDED:
        why = next((e.reason for e in reversed(passed) if e.phase is Phase.LANDING), "")
        reason = f"{why}; {state.reason}" if why else state.reason
    return FlightReport(
        phase=state.phase,
        outcome=state.outcome or Outcome.SAFETY,
        reason=reason,
        attempts=state.attempts + int(state.phase is Phase.PERCHED),
        duration_s=now_s - state.started_s,
        locked=telemetry.has(LOCKED),
        history=passed,
    )
