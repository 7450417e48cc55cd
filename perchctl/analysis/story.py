"""A flight in sentences, each at its time, made of the log's events and ticks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from perchctl.analysis.flight import FlightAnalysis, runs_of
from perchctl.analysis.sight import Loss
from perchctl.analysis.words import count, length
from perchctl.mission import Phase
from perchctl.record import PhaseSpan
from perchctl.vehicle import NO_BATTERY_READING_V

HELD_LEAST_S = 0.1
BACKED_OFF_M = 0.01
FLYING = frozenset(phase.value for phase in Phase if phase.is_flying)
TOOK_OVER = {
    "watchdog": "The watchdog took over",
    "rescue": "The rescue took over, after an error",
    "reconnect": "The link was opened once more",
}
ENDS = {"PERCHED": "Perched", "LANDED": "Down", "ABORTED": "The flight was broken off"}
ACTS = {
    "position": "it gave it a place to hold",
    "thrust": "it kept the thrust",
    "land": "it ordered a landing",
    "stop": "it stopped the motors",
    "emergency": "it cut the motors",
}
SEVEN = tuple(phase.value for phase in Phase)[:7]


@dataclass(frozen=True)
class Sentence:
    """What happened at a time, s from the first tick; `grade`: step, good, warn or bad."""

    t_s: float
    text: str
    grade: str = "step"


def story_of(flight: FlightAnalysis) -> tuple[Sentence, ...]:
    """Tell the whole flight in order; empty for a log without ticks."""
    if not flight.log.records:
        return ()
    told = [
        *_steps(flight),
        *map(_told_loss, flight.losses),
        *_holds(flight),
        *_taken_over(flight),
        *_unpositioned(flight),
        *_notes(flight),
        *_motors(flight),
        *_end(flight),
    ]
    return tuple(sorted(told, key=lambda sentence: sentence.t_s))


# --- the phases -----------------------------------------------------------------------


def _steps(flight: FlightAnalysis) -> Iterator[Sentence]:
    for i, stay in enumerate(flight.log.phases):
        text = _step_text(flight, stay)
        if stay.simulated:
            text += f" (the simulation: {stay.simulated})"
        if i == 0 and stay.phase == "APPROACH":
            text += _battery(flight)
        yield Sentence(stay.start_s, text, _grade(stay))


def _grade(stay: PhaseSpan) -> str:
    if stay.phase in ("PERCHED", "COMPLETE"):
        return "good"
    if stay.phase == "ABORTED" or stay.severity == "stop":
        return "bad"
    if stay.phase == "RECOVER" or stay.severity in ("back off", "hold"):
        return "warn"
    return "warn" if stay.phase == "LANDING" else "step"


def _step_text(flight: FlightAnalysis, stay: PhaseSpan) -> str:
    reason, at_s = _upper(stay.reason), stay.start_s
    match stay.phase:
        case "APPROACH":
            return "Took off"
        case "SEARCH":
            at = f"at {length(flight.height_m(at_s))}"
            if stay.row == "approached" or stay.reason == "hovering in the perching area":
                return f"It hovered {at}, and looked for the target"
            return f"{reason}: it looked for the target again, {at}"
        case "ESTIMATE":
            where = _where(flight, at_s)
            if stay.row == "recovered" or "again" in stay.reason or "once more" in stay.reason:
                return f"{reason}:{where}" if where else reason
            return f"Found the target{where}"
        case "ALIGN":
            if stay.severity == "hold" or "cone" in stay.reason:
                return f"{reason}{_beside(flight, at_s)}: it aligned again"
            return f"Its pose was steady{_spread(flight, at_s)}: it went under the target"
        case "ASCEND":
            return f"Aligned{_beside(flight, at_s)}{_heading_and_time(flight, stay)}: it climbed"
        case "PERCH":
            return _perch(flight, stay)
        case "COMPLETE":
            thrust = flight.at(at_s, "thrust") / 655.35
            at = f", at {thrust:.0f} % thrust" if math.isfinite(thrust) else ""
            return f"{reason}{at}: the thrust was taken away"
        case "RECOVER":
            return f"{reason}: {_backed_off(flight, stay)}"
        case "LANDING":
            height_m = flight.height_m(at_s)
            at = f", from {length(height_m)}" if math.isfinite(height_m) else ""
            return f"{reason}: it landed{at}"
    begin = ENDS.get(stay.phase, stay.phase)
    return f"{begin}: {stay.reason}" if stay.reason else begin


def _heading_and_time(flight: FlightAnalysis, stay: PhaseSpan) -> str:
    turned, took_s = flight.at(stay.start_s, "eyaw_rad"), _time_before(flight, stay, "ALIGN")
    text = f" and {abs(math.degrees(turned)):.1f} deg off" if math.isfinite(turned) else ""
    return f"{text}, after {took_s:.1f} s" if took_s else text


def _perch(flight: FlightAnalysis, stay: PhaseSpan) -> str:
    below_m = flight.at(stay.start_s, "ez_m")
    below = f" {length(below_m)} below the target" if math.isfinite(below_m) else ""
    text = f"Settled at the stand-off{below}{_beside(flight, stay.start_s)}"
    took_s = _time_before(flight, stay, "ASCEND")
    return f"{text}, after {took_s:.1f} s of ascent: it pressed" if took_s else text


def _backed_off(flight: FlightAnalysis, stay: PhaseSpan) -> str:
    heights = flight.log.column("z_m")[flight.within(stay.start_s, stay.end_s)]
    heights = heights[np.isfinite(heights)]
    down_m = float(heights[0] - np.min(heights)) if heights.size else 0.0
    attempts = flight.at(stay.start_s, "attempts")
    nth = f" (failed attempt {attempts:.0f})" if attempts >= 1 else ""
    away = f"backed off {length(down_m)}" if down_m >= BACKED_OFF_M else "it stayed where it was"
    return f"{away}{nth}"


def _battery(flight: FlightAnalysis) -> str:
    volts = flight.at(0.0, "battery_v")
    return f" with the battery at {volts:.2f} V" if volts >= NO_BATTERY_READING_V else ""


def _where(flight: FlightAnalysis, t_s: float) -> str:
    up_m, aside_m = flight.at(t_s, "ez_m"), _aside_m(flight, t_s)
    if not math.isfinite(up_m + aside_m):
        return ""
    return f" {length(up_m)} above, {length(aside_m)} to the side"


def _beside(flight: FlightAnalysis, t_s: float) -> str:
    aside_m = _aside_m(flight, t_s)
    return f", {length(aside_m)} off centre" if math.isfinite(aside_m) else ""


def _aside_m(flight: FlightAnalysis, t_s: float) -> float:
    return math.hypot(flight.at(t_s, "ex_m"), flight.at(t_s, "ey_m"))


def _spread(flight: FlightAnalysis, t_s: float) -> str:
    sigma_m = math.hypot(flight.at(t_s, "esx_m"), flight.at(t_s, "esy_m"))
    return f" to {length(sigma_m)}" if math.isfinite(sigma_m) else ""


def _time_before(flight: FlightAnalysis, stay: PhaseSpan, phase: str) -> float:
    """Return how long the phase before lasted, 0 where another one was before."""
    at = flight.log.phases.index(stay)
    before = flight.log.phases[at - 1] if at else None
    return before.duration_s if before and before.phase == phase else 0.0


# --- between them ---------------------------------------------------------------------


def _told_loss(loss: Loss) -> Sentence:
    for_s = f"for {loss.duration_s:.1f} s" if loss.regained else "and not seen again"
    if loss.frames:
        text = f"The target was lost {for_s}: {count(loss.frames, 'frame')} without it"
        text += f", at {loss.speed_mps:.1f} m/s" if math.isfinite(loss.speed_mps) else ""
    else:
        text = f"No picture that could be used came {for_s if loss.regained else 'any more'}"
    return Sentence(loss.start_s, text, "warn")


def _holds(flight: FlightAnalysis) -> Iterator[Sentence]:
    for hold in flight.holds:
        if hold.duration_s >= HELD_LEAST_S:
            text = f"Held in place for {hold.duration_s:.1f} s: {hold.reason}"
            yield Sentence(hold.start_s, text, "warn")


def _taken_over(flight: FlightAnalysis) -> Iterator[Sentence]:
    """Tell what was sent in the loop's place. The farewell, to a vehicle that is down, is not part
    of the flight."""
    for go in flight.takeovers:
        who = TOOK_OVER.get(go.by)
        if who is None:
            continue
        acts = [ACTS[name] for name, _ in go.sent]
        for_s = go.end_s - go.start_s
        lasted = f" for {for_s:.1f} s" if for_s >= HELD_LEAST_S else ""
        steered = all(name in ("position", "thrust") for name, _ in go.sent)
        t_s = max(0.0, flight.log.since(go.start_s))
        text = f"{who}{lasted}: {' and '.join(acts)}"
        yield Sentence(t_s, text, "warn" if steered else "bad")


def _unpositioned(flight: FlightAnalysis) -> Iterator[Sentence]:
    for start_s, end_s, why in runs_of(flight.log, "pos_note"):
        text = f"No external position was sent for {end_s - start_s:.1f} s: {why}"
        yield Sentence(start_s, text, "warn")


def _notes(flight: FlightAnalysis) -> Iterator[Sentence]:
    for t_s, note in flight.notes:
        if note:
            yield Sentence(max(0.0, t_s), _upper(note))


def _motors(flight: FlightAnalysis) -> Iterator[Sentence]:
    """Tell each kind of stop once: it may be repeated, and an emergency cut may come long after."""
    tells = {"stop": "The motors were stopped", "emergency": "The motors were cut and locked"}
    for start_s, _end_s, command in runs_of(flight.log, "cmd"):
        text = tells.pop(command, None)
        if text is not None:
            yield Sentence(start_s, text, "step" if command == "stop" else "bad")


def _end(flight: FlightAnalysis) -> Iterator[Sentence]:
    """Tell what the vehicle needs after the flight, or where a log stops without its end."""
    if flight.log.summary is not None:
        end = flight.summary
        if end.locked:
            text = "The supervisor locked the vehicle: inspect and restart it"
            yield Sentence(flight.end_s, text, "bad")
        if end.touchdown is not None and end.touchdown.is_hard:
            yield Sentence(flight.end_s, f"It {end.touchdown.text}", "bad")
        if end.fell:
            yield Sentence(flight.end_s, "The vehicle fell", "bad")
        return
    phase = flight.log.phases[-1].phase if flight.log.phases else "?"
    text = f"The log ends here, in {phase}"
    height_m = flight.height_m(flight.end_s)
    if phase in FLYING | {"LANDING"} and math.isfinite(height_m):
        text += f" at {length(height_m)}"
    yield Sentence(
        flight.end_s, f"{text}: how the flight ended is not known, its program was ended", "bad"
    )


def _upper(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
