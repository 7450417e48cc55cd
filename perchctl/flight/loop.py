"""The flight loop: newest frame, telemetry, pipeline, planner, link, log; one thread.

Time comes from a `Clock`, so the same loop flies in real time through cflib and in
lockstep with a simulated vehicle.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, replace

from perchctl.camera.source import FrameSource
from perchctl.errors import Interrupted, NotFound
from perchctl.flight.clock import Clock
from perchctl.flight.history import extended
from perchctl.flight.outside import AtRest
from perchctl.flight.preflight import (
    refuse,
    refuse_strange,
    refuse_unmeasured,
    still_waiting_for,
)
from perchctl.flight.rescue import rescue
from perchctl.flight.senses import Senses
from perchctl.flight.watchdog import Watchdog
from perchctl.link.evidence import FRESH_S
from perchctl.link.protocol import Link
from perchctl.mission import planner
from perchctl.mission.context import Context
from perchctl.mission.findings import findings_of
from perchctl.mission.hold import unplaced
from perchctl.mission.state import (
    FLYING_PHASES,
    Observation,
    Operator,
    Outcome,
    Phase,
    PlannerState,
    Severity,
)
from perchctl.mission.watch import Event, EventKind, FlightReport, Outside, Tick, Watcher
from perchctl.pipeline import Pipeline
from perchctl.positioning.feed import FeedStatus
from perchctl.profile import Profile
from perchctl.vehicle import LOCKED, NO_BATTERY_READING_V, Command, Idle
from perchctl.vision.consistency import Consistency

HUNG_S = 0.25
"""A turn that takes longer was hung up somewhere: what it knew of the vehicle is old."""


@dataclass(frozen=True, eq=False)
class FlightParts:
    """The edges. `simulated` says what the scenario of a simulated flight did that explains
    an event; `positions` how it goes with those from outside, None where decks measure them."""

    link: Link
    source: FrameSource
    clock: Clock
    profile: Profile
    pipeline: Pipeline
    watchers: tuple[Watcher, ...] = ()
    operator: Callable[[], Operator] = lambda: Operator.NONE
    simulated: Callable[[Event], str] = lambda event: ""
    positions: Callable[[float], FeedStatus] | None = None


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
    watchdog = Watchdog(parts.profile, parts.operator)
    parts.link.guard(watchdog)
    started_s = parts.clock.now()
    try:
        return _mission(parts, senses, watchdog)
    except BaseException as error:
        watchdog.rescuing()
        safe = rescue(
            parts.link,
            parts.clock,
            parts.profile.planner.landing,
            parts.operator,
            senses.history.newest,
            senses.ground_z_m,
            flown_s=parts.clock.now() - started_s,
            held_m=watchdog.held_m,
        )
        _tell_rescue(parts, error, safe)
        raise


def _tell_rescue(parts: FlightParts, error: BaseException, safe: bool) -> None:
    what = "it is down, or hangs: the motors are off"
    if not safe:
        what = "a landing was ordered, but could not be confirmed: keep away from the vehicle"
    text = f"{type(error).__name__} in flight: {what}"
    for watcher in parts.watchers:
        with contextlib.suppress(Exception):  # it may be the one that failed
            watcher.event(Event(parts.clock.now(), EventKind.NOTE, text))


def _wait_until_ready(parts: FlightParts, senses: Senses) -> None:
    refuse_unmeasured(parts.link, parts.profile, positions=parts.positions is not None)
    started_s, at_rest = parts.clock.now(), AtRest()
    while True:
        now_s = parts.clock.now()
        if parts.operator() is not Operator.NONE:
            raise Interrupted("interrupted before take-off: nothing was started")
        senses.take_in(now_s)
        newest = senses.history.newest
        refuse(newest, parts.profile)
        outside = None if parts.positions is None else parts.positions(now_s)
        refuse_strange(outside, newest, parts.profile, at_rest)
        waiting = still_waiting_for(
            newest, senses.frames > 0, senses.camera_problem, now_s - started_s, parts.profile,
            senses.target(now_s), 0.0 if newest is None else now_s - newest.t_s + newest.behind_s,
            outside,
        )  # fmt: skip
        if parts.source.finished:
            raise NotFound(
                f"{parts.source.describe()} ended before take-off: a flight needs pictures that "
                f"go on, from a camera or a longer recording"
            )
        if not waiting:
            return
        parts.clock.wait_until(now_s + 1.0 / parts.profile.link.loop_hz)


def _mission(parts: FlightParts, senses: Senses, watchdog: Watchdog) -> FlightReport:
    period_s = 1.0 / parts.profile.link.loop_hz
    clock = parts.clock
    due_s = clock.now()
    state: PlannerState | None = None
    passed: list[Event] = []
    redone = log_noted = False
    told = senses.noticed.newest  # to the log
    while True:
        now_s = clock.now()
        senses.take_in(now_s, look=not _is_blind(state))
        now_s = _present(parts, senses, now_s)
        late_s = max(0.0, now_s - due_s)
        outside = None if parts.positions is None else parts.positions(now_s)
        obs = _observe(parts, senses, now_s, late_s, outside)
        before = state
        new, command = planner.step(before or planner.start(obs), obs, parts.profile)
        overruled = new.phase in FLYING_PHASES and watchdog.overruled_s > late_s
        if not redone and (overruled or clock.now() - now_s > HUNG_S):
            redone = True  # nothing that was decided before a hang is sent after it
            continue
        state, redone = new, False
        if not isinstance(command, Idle):
            parts.link.send(command)
        watchdog.turn(
            now_s, max(due_s, now_s) + period_s, state, command, obs.telemetry,
            placed=Context(state, obs, parts.profile).placed,
        )  # fmt: skip
        events = _events(before, state, obs, parts.profile)
        if obs.log_problem is not None and not log_noted:
            log_noted = True
            text = f"the log of this flight is incomplete: {obs.log_problem}"
            events.append(Event(now_s, EventKind.NOTE, text, state.phase))
        for text in senses.take_remarks():
            events.append(Event(now_s, EventKind.NOTE, text, state.phase))
        for event in events:
            event = replace(event, simulated=parts.simulated(event))
            if event.kind is EventKind.PHASE:
                passed.append(event)
            for watcher in parts.watchers:
                watcher.event(event)
        tick = _tick(senses, state, command, obs, told, outside)
        told = senses.noticed.newest
        for watcher in parts.watchers:
            watcher.tick(tick)
        if planner.is_over(state):
            watchdog.end(motors_off=state.phase is not Phase.ABORTED)
            return _report(state, obs, tuple(passed), senses)
        due_s += period_s
        if due_s < now_s:
            due_s = now_s + period_s  # never try to catch up with a burst of old ticks
        clock.wait_until(due_s)


def _present(parts: FlightParts, senses: Senses, began_s: float) -> float:
    """The turn's time. Where camera or vision hung, it is the present, with what has arrived
    meanwhile: a setpoint for the time before the hang would be a stale one."""
    now_s = parts.clock.now()
    if now_s - began_s <= HUNG_S:
        return began_s
    before = senses.history
    after = extended(before, parts.link.telemetry(), parts.profile.safety)
    turned_rad = max(before.turned_rad, after.turned_rad)
    senses.history = replace(after, jumped=before.jumped or after.jumped, turned_rad=turned_rad)
    if senses.last_good_frame_s == began_s:
        senses.last_good_frame_s = now_s  # the picture came: it is not the camera that is gone
    return now_s


def _tick(
    senses: Senses,
    state: PlannerState,
    command: Command,
    obs: Observation,
    told: Consistency | None,
    outside: FeedStatus | None,
) -> Tick:
    newest = senses.noticed.newest
    return Tick(
        obs.t_s,
        obs.telemetry,
        senses.output,
        obs.target,
        state,
        command,
        obs.loop_late_s,
        obs.camera_age_s,
        obs.t_s - obs.telemetry.t_s,
        None if newest is told else newest,
        obs.delay_s,
        None if outside is None else _told_of(outside),
    )


def _told_of(status: FeedStatus) -> Outside:
    return Outside(status.age_s, status.problem, status.sent, status.rate_hz, status.pose)


def _is_blind(state: PlannerState | None) -> bool:
    """Against the ceiling nothing is steered by the picture, and it shows no target."""
    return state is not None and state.phase is Phase.COMPLETE


def _observe(
    parts: FlightParts, senses: Senses, now_s: float, late_s: float, outside: FeedStatus | None
) -> Observation:
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
        turned_rad=senses.history.turned_rad,
        loop_late_s=late_s,
        disagreeing_frames=senses.state.disagreeing_frames,
        operator=parts.operator(),
        log_problem=next((w.problem for w in parts.watchers if w.problem), None),
        delay_s=senses.noticed.used_s,
        position_age_s=0.0 if outside is None else outside.age_s,
        position_problem=None if outside is None else outside.problem,
        target_refused=senses.refused,
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
    elif state.stale_s == obs.t_s and before.stale_s != before.t_s and not state.hold:
        # Where it is not held for it the pilot is told all the same.
        text = unplaced(Context(state, obs, profile))
        events.append(Event(obs.t_s, EventKind.NOTE, text, state.phase))
    return events


def _report(
    state: PlannerState, obs: Observation, passed: tuple[Event, ...], senses: Senses
) -> FlightReport:
    seen, camera = senses.noticed_at_last(), senses.profile.camera
    return FlightReport(
        phase=state.phase,
        outcome=state.outcome or Outcome.SAFETY,
        reason=_reason(state, obs, passed),
        attempts=_attempts(state),
        duration_s=obs.t_s - state.started_s,
        # The telemetry at hand is older than an emergency stop, which always locks.
        locked=obs.telemetry.has(LOCKED) or state.outcome is Outcome.EMERGENCY,
        history=passed,
        findings=None if seen is None else findings_of(seen, camera),
    )


def _attempts(state: PlannerState) -> int:
    """The failed ones, and the one that hangs; a hold that is noticed once they are used up
    has been counted as failed."""
    hangs = state.phase is Phase.PERCHED and state.outcome is not Outcome.ATTEMPTS_USED_UP
    return state.attempts + int(hangs)


def _reason(state: PlannerState, obs: Observation, passed: tuple[Event, ...]) -> str:
    """Why it ended so, with what led to the landing where there was one."""
    why = next((e.reason for e in reversed(passed) if e.phase is Phase.LANDING), "")
    if state.phase in (Phase.LANDED, Phase.PERCHED):
        return f"{why}; {state.reason}" if why else state.reason
    if state.row != "landing-timeout":
        return state.reason
    age_s = obs.t_s - obs.telemetry.t_s
    cause = "by its telemetry the vehicle still flies"
    if age_s > FRESH_S:
        cause = f"nothing was heard from the vehicle for {age_s:.1f} s"
    text = f"the landing was ordered but could not be confirmed: {cause}"
    return f"{why}; {text}" if why else text
