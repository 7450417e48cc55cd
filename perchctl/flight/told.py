"""What is told of a flight: what happened in a turn, and how it ended."""

from __future__ import annotations

from perchctl.flight.senses import Senses
from perchctl.link import FRESH_S
from perchctl.mission import (
    Context,
    Event,
    EventKind,
    FlightReport,
    Observation,
    Outcome,
    Phase,
    PlannerState,
    Severity,
    contact_error_of,
    flight_findings,
    start_mission,
    touchdown_of,
    unplaced_text,
)
from perchctl.profile import Profile
from perchctl.vehicle import LOCKED, is_battery_reading


def events_of(
    before: PlannerState | None, state: PlannerState, obs: Observation, profile: Profile
) -> list[Event]:
    """What happened in this turn; `before` is None in the first."""
    events: list[Event] = []
    if before is None:
        start = start_mission(obs)
        events.append(Event(obs.t_s, EventKind.PHASE, start.reason, start.phase))
        if not is_battery_reading(obs.telemetry.battery_v):
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
        text = unplaced_text(Context(state, obs, profile))
        events.append(Event(obs.t_s, EventKind.NOTE, text, state.phase))
    return events


def report_of(
    state: PlannerState, obs: Observation, passed: tuple[Event, ...], senses: Senses
) -> FlightReport:
    seen, camera = senses.noticed_at_last(), senses.profile.camera
    c = Context(state, obs, senses.profile)
    return FlightReport(
        phase=state.phase,
        outcome=state.outcome or Outcome.SAFETY,
        reason=_reason(state, obs, passed),
        attempts=_attempts(state),
        duration_s=obs.t_s - state.started_s,
        # The telemetry at hand is older than an emergency stop, which always locks.
        locked=obs.telemetry.has(LOCKED) or state.outcome is Outcome.EMERGENCY,
        history=passed,
        findings=None if seen is None else flight_findings(seen, camera),
        contact=contact_error_of(c),
        touchdown=touchdown_of(c),
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
