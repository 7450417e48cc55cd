"""The flight loop: read telemetry and the newest frame, run pipeline and planner, send a command,
and write the log.

One iteration is called a turn, and all turns run in a single thread. Time comes from a `Clock`, so
the same loop flies in real time through cflib and in lockstep with a simulated vehicle.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from perchctl.camera import FrameSource, mirrored_problem
from perchctl.errors import Interrupted, NotFound, SafetyAbort
from perchctl.flight.clock import Clock
from perchctl.flight.criteria import GroundCriteria, RestCheck
from perchctl.flight.inputs import FlightInputs, TurnReporter
from perchctl.flight.preflight import (
    Arming,
    GroundTurn,
    abort_on,
    disarm_on_word,
    refuse_armed,
    refuse_unfit_vehicle,
    refuse_without_positions,
    refuse_wrong_positions,
    still_waiting_for,
    view_problem,
)
from perchctl.flight.watchdog import Watchdog, rescue
from perchctl.flight.watching import Watchers
from perchctl.link import Link
from perchctl.mission import (
    Event,
    EventKind,
    FlightReport,
    Observation,
    OperatorRequest,
    Phase,
    PlannerState,
    SentCommand,
    Tick,
    Transition,
    Watcher,
    load_table,
    step_mission,
)
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import Idle, Telemetry
from perchctl.vision import Pipeline

TURN_HANG_S = 0.25
"""Duration of a turn above which something has hung, so that the turn's data about the vehicle is
out of date, s."""
PERMISSION = "permission to take off"
"""The only remaining condition for a vehicle whose own checks have passed while other vehicles are
flying in the same room, as shown to the operator."""
PERMISSION_PERIOD_S = 0.1
"""Period of the turns while waiting for permission, s. Longer: more time passes between the
permission and the take-off. Shorter: vehicles on the floor take computing time from those in the
air."""


class PositionStatus(Protocol):
    """The part of `perchctl.positioning.PositionFeed` that the loop uses."""

    def status(self, now_s: float) -> FeedStatus: ...

    def stop(self) -> None: ...


@dataclass(frozen=True, eq=False)
class FlightParts:
    """The parts from which a flight is assembled.

    `watchers` observe the flight and cannot end it (`perchctl.flight.watching`); `judges` observe a
    simulated flight, and their errors do end it. `positions` sends the external positions; None if
    decks measure them. `remarks` returns new notes on things that do not affect safety, such as a
    recording. `table` replaces the profile's transition table. `begin_turn` is called in the loop's
    own thread at the beginning of each turn, also before take-off. `may_take_off` is called in each
    turn before take-off with a text that lists the conditions the vehicle is still waiting for; the
    text is empty once the vehicle's own checks have passed. Until it returns True, the vehicle
    stays disarmed on the floor and the checks continue. `climb_withheld` is called in each turn of
    the mission; while it returns a reason, the vehicle does not begin to climb to its target. If
    the flight is `simulated`, its measured latency and mounting are not suggested for the
    profile."""

    link: Link
    source: FrameSource
    clock: Clock
    profile: Profile
    pipeline: Pipeline
    watchers: tuple[Watcher, ...] = ()
    operator: Callable[[], OperatorRequest] = lambda: OperatorRequest.NONE
    positions: PositionStatus | None = None
    remarks: Callable[[], Sequence[str]] = tuple
    table: tuple[Transition, ...] = load_table(None)
    judges: tuple[Watcher, ...] = ()
    begin_turn: Callable[[], None] = lambda: None
    may_take_off: Callable[[str], bool] = lambda waiting: True
    climb_withheld: Callable[[], str | None] = lambda: None
    simulated: bool = False

    def position_age_s(self, now_s: float) -> float:
        """Age of the newest position from motion capture; 0 if positions come from elsewhere."""
        return 0.0 if self.positions is None else self.positions.status(now_s).age_s


def fly(parts: FlightParts) -> FlightReport:
    """Wait until the vehicle is ready, fly the mission, and return how it ended.

    The link must be connected. If anything raises an exception, the vehicle is landed (the rescue)
    before the exception is re-raised. Errors: `SafetyAbort`, `TimedOut`, `NotFound` and
    `Interrupted` before take-off, and any unforeseen error after the rescue. The report, or the
    error's `__notes__`, contains one sentence for each watcher that was detached.
    """
    watchers = Watchers(parts.watchers, parts.clock.now, parts.remarks, parts.judges)
    try:
        report = _fly(parts, watchers)
    except BaseException as error:
        for sentence in watchers.detached:
            error.add_note(sentence)
        raise
    return replace(report, detached_watcher_messages=tuple(watchers.detached))


def _fly(parts: FlightParts, watchers: Watchers) -> FlightReport:
    turns = TurnReporter(watchers.turn)
    inputs = FlightInputs(
        parts.link,
        parts.source,
        parts.pipeline,
        parts.profile,
        send=parts.link.send_external,
        is_logged=watchers.have_log,
        on_frame=watchers.frame,
    )
    parts.link.set_guard(disarm_on_word(parts.operator), watchers.sent)
    _wait_until_ready(
        parts, inputs, turns, watchers
    )  # the vehicle stays on the ground until this returns
    watchdog = Watchdog(parts.profile, parts.operator, parts.position_age_s)
    parts.link.set_guard(watchdog.poll, watchers.sent)
    try:
        return _mission(parts, inputs, watchdog, turns, watchers)
    except BaseException as error:
        watchdog.note_rescue()
        rest = rescue(
            parts.link,
            parts.clock,
            parts.profile,
            parts.operator,
            watchdog.state,
            inputs.history,
            parts.position_age_s,
            watchers.sent,
            inputs.perception.motion.motion,
        )
        with contextlib.suppress(Exception):  # the part that failed may fail again
            turns.report_failure(inputs, error)
        with contextlib.suppress(Exception):  # a judge's error must not replace the first one
            watchers.event(Event.make_rescue_note(parts.clock.now(), error, rest.state, rest.text))
        raise


def _wait_until_ready(
    parts: FlightParts, inputs: FlightInputs, turns: TurnReporter, watchers: Watchers
) -> None:
    refuse_without_positions(parts.link, parts.profile, has_feed=parts.positions is not None)
    decks, arming = parts.link.decks(), Arming()
    started_s, at_rest = parts.clock.now(), RestCheck()
    while True:
        now_s = parts.clock.now()
        _end_on_word(parts.operator(), arming)
        parts.begin_turn()
        inputs.poll_inputs(now_s)
        newest = inputs.history.newest
        refuse_unfit_vehicle(newest, parts.profile)
        if not arming.has_begun:
            refuse_armed(newest)
        feed = _outside(parts, inputs, now_s)
        refuse_wrong_positions(feed, newest, parts.profile, now_s, at_rest)
        turns.report_waiting_turn(inputs, now_s, feed)
        if inputs.perception.is_mirrored:
            raise SafetyAbort(mirrored_problem(parts.profile.camera).sentence)
        if parts.profile.safety.land_on_log_error and (problem := watchers.problem):
            raise SafetyAbort(
                f"flight log: {problem}, and safety.land_on_log_error is set: not flying"
            )
        seen = GroundTurn(
            profile=parts.profile,
            waited_s=now_s - started_s,
            samples=inputs.history.samples,
            telemetry_age_s=inputs.telemetry_age_s(now_s),
            decks=decks,
            feed=feed,
            picture_problem=inputs.picture_problem(now_s),
            unseen_s=now_s - inputs.last_good_frame_s,
            target=inputs.target(now_s),
            link_problem=parts.link.problem(now_s),
            took_s=parts.clock.now() - now_s,
        )
        waiting = still_waiting_for(seen)
        if parts.source.finished:
            raise NotFound(
                f"{parts.source.describe()} ended before take-off: use a camera, or a longer "
                "recording"
            )
        # the operator's command given in this turn takes precedence over arming
        _end_on_word(parts.operator(), arming)
        if not waiting and newest is not None:
            _refuse_lost_view(parts, inputs, newest)
        is_held = not parts.may_take_off(waiting) and not waiting
        if is_held:
            # A vehicle may wait for permission for minutes; after that, each check has its full
            # time limit again.
            waiting, started_s = PERMISSION, now_s
        arming.note_waiting(waiting, now_s, parts.clock.now())
        if not waiting and newest is not None:
            if not GroundCriteria(newest, parts.profile).waits_for_arming:
                return
            request = arming.next_request(newest, now_s)
            if request is not None:
                parts.link.send(request)
                watchers.sent(SentCommand(now_s, "preflight", request))
        # If the target is the positioning system, its positions must be sent without a pause.
        slow = is_held and inputs.target_positioning is None
        period_s = PERMISSION_PERIOD_S if slow else 1.0 / parts.profile.link.loop_hz
        parts.clock.wait_until(now_s + period_s)


def _refuse_lost_view(parts: FlightParts, inputs: FlightInputs, newest: Telemetry) -> None:
    """Raise SafetyAbort if the target is the positioning system and would leave the camera's view
    during the climb."""
    positioning = inputs.target_positioning
    if positioning is not None and positioning.feed.target:
        camera, place = parts.pipeline.camera, positioning.feed.target
        abort_on(view_problem(place, newest.position_m, newest.yaw_rad, parts.profile, camera))


def _end_on_word(word: OperatorRequest, arming: Arming) -> None:
    """Raise Interrupted if the operator has given a command. The link disarms the vehicle when it
    is closed."""
    if word is not OperatorRequest.NONE:
        ending = "disarming" if arming.has_begun else "nothing was started"
        raise Interrupted(f"interrupted before take-off: {ending}")


def _mission(
    parts: FlightParts,
    inputs: FlightInputs,
    watchdog: Watchdog,
    turns: TurnReporter,
    watchers: Watchers,
) -> FlightReport:
    period_s = 1.0 / parts.profile.link.loop_hz
    clock = parts.clock
    due_s = clock.now()
    state: PlannerState | None = None
    passed: list[Event] = []
    redone = log_noted = drops_sightings = False
    told_change_s: tuple[float, float] | None = None
    logged = inputs.perception.calibration.newest
    while True:
        began_s = now_s = clock.now()
        turns.begin_turn(began_s)
        parts.begin_turn()
        inputs.poll_inputs(
            began_s,
            # At the ceiling, the camera is too close to see the target.
            search=state is None or state.phase is not Phase.COMPLETE,
            sends_sights=state is None or state.belief.dead_reckoning_began_at_s is None,
            drops_sightings=drops_sightings,
        )
        drops_sightings = False
        if clock.now() - began_s > TURN_HANG_S:  # after a hang, the decision is out of date
            now_s = clock.now()
            inputs.catch_up(began_s, now_s)
        late_s = max(0.0, now_s - due_s)
        feed = _outside(parts, inputs, now_s)
        obs = _observe(parts, inputs, now_s, late_s, feed, watchers.problem)
        turns.note_observation(obs)
        before = state
        new, command = step_mission(before, obs, parts.profile, parts.table)
        turns.note_decision(obs, new, command, feed)
        overruled = new.phase.is_before_landing and watchdog.overruled_s > late_s
        if not redone and (overruled or clock.now() - now_s > TURN_HANG_S):
            redone = True  # decide again: the decision made before the hang is not sent
            turns.report_discarded_turn(inputs, obs, new, command)
            continue
        state, redone = new, False
        if not isinstance(command, Idle):
            parts.link.send(command)
        watchdog.tick(max(due_s, now_s) + period_s, state, command, obs)
        if (
            state.belief.is_position_diverged
            and parts.positions is not None
            and not (before and before.belief.is_position_diverged)
        ):
            parts.positions.stop()
            drops_sightings = True
        events = Event.list_events_of_tick(before, state, obs, parts.profile)
        notes = watchers.take_notes()
        if obs.flight_log_problem is not None and not log_noted:
            log_noted = True
            notes.insert(0, f"the flight log is incomplete: {obs.flight_log_problem}")
        changed_s = inputs.perception.calibration.changed_s
        if changed_s is not None and changed_s != told_change_s:
            told_change_s = changed_s
            notes.append(_latency_text(parts.profile, changed_s))
        events += [Event(now_s, EventKind.NOTE, text, state.phase) for text in notes]
        for event in events:
            if event.kind is EventKind.PHASE:
                passed.append(event)
            watchers.event(event)
        newest = inputs.perception.calibration.newest
        tick = Tick(
            record=turns.flown_turn(inputs, obs, state, command, feed),
            state=state,
            output=inputs.output,
            camera_errors=None if newest is logged else newest,
        )
        logged = newest
        watchers.tick(tick)
        if state.phase.is_final:
            watchdog.end(motors_off=state.phase is not Phase.ABORTED)
            return FlightReport.from_state(
                state,
                obs,
                parts.profile,
                tuple(passed),
                inputs.perception.camera_errors(),
                simulated=parts.simulated,
            )
        due_s += period_s
        if due_s < now_s:
            due_s = now_s + period_s  # missed ticks are not made up for
        clock.wait_until(due_s)


def _latency_text(profile: Profile, changed_s: tuple[float, float]) -> str:
    before_ms, after_ms = (1e3 * (profile.camera.start_latency_s + each) for each in changed_s)
    return f"the camera's latency changed from {before_ms:.0f} to {after_ms:.0f} ms"


def _outside(parts: FlightParts, inputs: FlightInputs, now_s: float) -> FeedStatus | None:
    """The status of the external positions, from motion capture or the target; None with decks."""
    if inputs.target_positioning is not None:
        return inputs.target_positioning.feed.status(now_s)
    return None if parts.positions is None else parts.positions.status(now_s)


def _observe(
    parts: FlightParts,
    inputs: FlightInputs,
    now_s: float,
    late_s: float,
    feed: FeedStatus | None,
    flight_log_problem: str | None,
) -> Observation:
    return replace(
        inputs.observation(now_s),
        link_problem=parts.link.problem(now_s),
        tick_start_delay_s=late_s,
        operator_request=parts.operator(),
        climb_withheld_reason=parts.climb_withheld(),
        flight_log_problem=flight_log_problem,
        external_position_age_s=0.0 if feed is None else feed.age_s,
        external_position_problem=None if feed is None else feed.problem,
        rejected_sighting_to_estimate_distance_m=0.0 if feed is None else feed.beside_m,
    )
