"""The flight loop: newest frame, telemetry, pipeline, planner, link, log; one thread.

Time comes from a `Clock`, so the same loop flies in real time through cflib and in
lockstep with a simulated vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from perchctl.camera.health import HealthState, assess
from perchctl.camera.source import FrameSource, check_size
from perchctl.errors import Interrupted, NotFound
from perchctl.flight.history import History, attitude_at, extended
from perchctl.flight.preflight import Readiness, refuse, still_waiting_for
from perchctl.link.protocol import Link
from perchctl.mission import planner
from perchctl.mission.state import Observation, Operator, Outcome, Phase, PlannerState
from perchctl.mission.watch import FlightReport, Tick, Watcher
from perchctl.pipeline import Pipeline
from perchctl.pipeline import step as pipeline_step
from perchctl.profile import Profile
from perchctl.vehicle import (
    FLYING,
    HL_ACTIVE,
    LOCKED,
    NO_BATTERY_READING_V,
    EmergencyStop,
    Idle,
    Land,
    Telemetry,
)
from perchctl.vision.types import Frame, PipelineOutput, PipelineState, TargetPose

RESCUE_LOOK_S = 0.5
"""For so long a vehicle must be seen with its motors off before a rescue leaves it."""


class Clock(Protocol):
    def now(self) -> float:
        """Seconds, monotonic."""

    def wait_until(self, t_s: float) -> None:
        """Return at `t_s`, or at once when it is past."""


@dataclass(frozen=True, eq=False)
class FlightParts:
    link: Link
    source: FrameSource
    clock: Clock
    profile: Profile
    pipeline: Pipeline
    watchers: tuple[Watcher, ...] = ()
    operator: Callable[[], Operator] = lambda: Operator.NONE


@dataclass(eq=False)
class _Senses:
    """The loop's working memory of what it sees; belongs to this module only."""

    history: History = field(default_factory=History)
    health: HealthState = field(default_factory=HealthState)
    pipeline: PipelineState = field(default_factory=PipelineState)
    output: PipelineOutput | None = None
    target: TargetPose | None = None
    last_good_frame_s: float = -math.inf
    camera_problem: str | None = None
    camera_note: str | None = None
    frames: int = 0


def fly(parts: FlightParts) -> FlightReport:
    """Connect is done: wait until ready, fly the mission, return how it ended.

    Whatever is raised on the way, the vehicle is landed first. Errors:
    `SafetyAbort`, `TimedOut`, `NotFound` and `Interrupted` before take-off, and
    anything unforeseen after the rescue.
    """
    senses = _Senses()
    _wait_until_ready(parts, senses)  # nothing is started before it returns
    try:
        return _mission(parts, senses)
    except BaseException:
        rescue(parts, senses.history.newest)
        raise


def rescue(parts: FlightParts, known: Telemetry | None) -> None:
    """Land whatever still flies and wait for it, bounded; the last resort of every
    error path. The landing needs no further packet once it is under way.

    `known` is the newest telemetry the loop has taken in. On the ground it is looked at
    again for `RESCUE_LOOK_S`: a take-off just ordered does not show at once.
    """
    link, clock, landing = parts.link, parts.clock, parts.profile.planner.landing
    newest = known
    start_s = clock.now()
    ordered_s: float | None = None
    while clock.now() < start_s + landing.timeout_s:
        if parts.operator() is Operator.STOP:
            link.send(EmergencyStop())
            return
        samples = link.telemetry()
        newest = samples[-1] if samples else newest
        flies = newest is not None and _motors_run(newest)
        if flies and newest is not None and _shall_order(newest, ordered_s, clock.now()):
            duration_s = max(1.0, newest.position_m[2] / landing.speed_mps)
            link.send(Land(-landing.undershoot_m, duration_s))
            ordered_s = clock.now()
        if not flies and clock.now() >= start_s + RESCUE_LOOK_S:
            return
        clock.wait_until(clock.now() + 0.1)


def _motors_run(telemetry: Telemetry) -> bool:
    """In the air, or about to be. The flying bit alone outlives the motors by 2 s, and a
    vehicle that hangs with its motors off shall not start them again."""
    return telemetry.has(HL_ACTIVE) or (telemetry.has(FLYING) and telemetry.thrust >= 1)


def _shall_order(telemetry: Telemetry, ordered_s: float | None, now_s: float) -> bool:
    """Once, and again while the order shows no effect."""
    if ordered_s is None:
        return True
    return not telemetry.has(HL_ACTIVE) and now_s - ordered_s > 1.0


def _wait_until_ready(parts: FlightParts, senses: _Senses) -> None:
    readiness = Readiness(started_s=parts.clock.now())
    while True:
        now_s = parts.clock.now()
        if parts.operator() is not Operator.NONE:
            raise Interrupted("Ctrl-C before take-off: nothing was started")
        _sense(parts, senses, now_s)
        newest = senses.history.newest
        refuse(newest, parts.profile)
        waiting = still_waiting_for(
            readiness, newest, senses.frames > 0, senses.camera_problem, now_s, parts.profile
        )
        if parts.source.finished:
            raise NotFound(
                f"{parts.source.describe()} ended before take-off: a flight needs pictures that "
                f"go on, from a camera or a longer recording"
            )
        if not waiting:
            return
        parts.clock.wait_until(now_s + 1.0 / parts.profile.link.loop_hz)


def _mission(parts: FlightParts, senses: _Senses) -> FlightReport:
    period_s = 1.0 / parts.profile.link.loop_hz
    clock = parts.clock
    due_s = clock.now()
    state: PlannerState | None = None
    passed: list[tuple[float, str, str]] = []
    while True:
        now_s = clock.now()
        late_s = max(0.0, now_s - due_s)
        fresh_output = _sense(parts, senses, now_s, look=not _is_blind(state))
        obs = _observe(parts, senses, now_s, late_s, fresh_output)
        if state is None:
            state = planner.start(obs)
            passed.append((now_s, state.phase.value, state.reason))
            _tell(parts, now_s, f"{state.phase.value}: {state.reason}")
            if obs.telemetry.battery_v < NO_BATTERY_READING_V:
                grace_s = parts.profile.safety.battery_stale_s
                _tell(parts, now_s, f"no battery reading: landing after {grace_s:.0f} s at most")
        before = state
        state, command = planner.step(state, obs, parts.profile)
        if not isinstance(command, Idle):
            parts.link.send(command)
        if state.phase is not before.phase:
            passed.append((now_s, state.phase.value, state.reason))
            _tell(parts, now_s, f"{state.phase.value}: {state.reason}")
        elif state.hold and state.hold != before.hold and not before.hold:
            _tell(parts, now_s, f"holding: {state.hold}")
        tick = Tick(
            now_s,
            obs.telemetry,
            senses.output if fresh_output else None,
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


def _sense(parts: FlightParts, senses: _Senses, now_s: float, *, look: bool = True) -> bool:
    """Take in telemetry and at most one frame; True when a good frame was processed.

    Without `look` the frame only counts as a sign of the camera's life."""
    safety = parts.profile.safety
    senses.history = extended(senses.history, parts.link.telemetry(), safety)
    frame = parts.source.poll(now_s)
    problem = parts.source.problem(now_s)
    if frame is None:
        if problem is None and parts.source.finished:
            problem = f"{parts.source.describe()} has ended"
        if problem is not None:
            senses.camera_problem = problem
        return False
    if senses.frames == 0:
        check_size(parts.source.size_px, parts.pipeline.camera, parts.source.describe())
    rejection = problem or _rejection(parts, senses, frame, now_s)
    senses.camera_problem = rejection or senses.camera_note
    if rejection is not None:
        return False
    senses.last_good_frame_s = now_s
    senses.frames += 1
    if not look:
        senses.target = None
        return False
    attitude = attitude_at(senses.history, frame.t_s)
    senses.pipeline, senses.output = pipeline_step(senses.pipeline, frame, attitude, parts.pipeline)
    senses.target = senses.output.target
    return True


def _rejection(parts: FlightParts, senses: _Senses, frame: Frame, now_s: float) -> str | None:
    """Why this frame is no measurement: frozen, no picture at all, or too old."""
    live = parts.source.live
    senses.health, verdict = assess(senses.health, frame, live)
    # A dark target may still be seen, and a bare ceiling looks like an empty screen:
    # such pictures are searched all the same, but the user is told of them.
    senses.camera_note = verdict.text if verdict.kind in ("dark", "uniform") else None
    if not verdict.usable and senses.camera_note is None:
        return verdict.text
    age_s = now_s - frame.t_s
    if live and age_s > parts.profile.safety.max_frame_age_s:
        return f"the picture is {age_s:.1f} s late"
    return None


def _observe(
    parts: FlightParts, senses: _Senses, now_s: float, late_s: float, new_frame: bool
) -> Observation:
    newest = senses.history.newest
    assert newest is not None
    changed_s = senses.history.battery_changed_s
    target = senses.target
    camera_age_s = now_s - senses.last_good_frame_s
    if camera_age_s > parts.profile.safety.camera_hold_s:
        target = None  # the filter coasts by frames; without any, its word is stale
    return Observation(
        t_s=now_s,
        telemetry=newest,
        target=target,
        new_frame=new_frame,
        camera_age_s=camera_age_s,
        camera_problem=senses.camera_problem,
        link_problem=parts.link.problem(now_s),
        battery_age_s=0.0 if changed_s is None else now_s - changed_s,
        jumped=senses.history.jumped,
        loop_late_s=late_s,
        disagreeing_frames=senses.output.disagreeing_frames if senses.output else 0,
        operator=parts.operator(),
        log_problem=next((w.problem for w in parts.watchers if w.problem), None),
    )


def _report(
    state: PlannerState,
    now_s: float,
    telemetry: Telemetry,
    passed: tuple[tuple[float, str, str], ...],
) -> FlightReport:
    reason = state.reason
    if state.phase is Phase.LANDED:
        why = next((r for _, phase, r in reversed(passed) if phase == "LANDING"), "")
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


def _tell(parts: FlightParts, t_s: float, text: str) -> None:
    for watcher in parts.watchers:
        watcher.event(t_s, text)
