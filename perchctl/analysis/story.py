"""Describe a flight in sentences with times, from the log's events and ticks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from perchctl.analysis.flight import FlightAnalysis
from perchctl.analysis.sight import TargetLoss
from perchctl.mission import Phase
from perchctl.record import PhaseSpan

HELD_LEAST_S = 0.1
FLYING = frozenset(phase.value for phase in Phase if phase.is_before_landing)
TOOK_OVER = {
    "watchdog": "The watchdog took over",
    "rescue": "After an error, the rescue routine took over",
    "reconnect": "The link was reopened",
}
ACTIONS = {
    "APPROACH": "it took off",
    "SEARCH": "it looked for the target",
    "ESTIMATE": "it waited for a steady pose",
    "ALIGN": "it moved under the target",
    "ASCEND": "it climbed",
    "PERCH": "it pressed against the target",
    "COMPLETE": "it transferred its weight to the magnet",
    "RECOVER": "it backed off",
    "HOVER": "it hovered under the target",
    "LANDING": "it landed",
}
FINAL_PHASE_TEXTS = {"PERCHED": "Perched", "LANDED": "Down", "ABORTED": "The flight was aborted"}
SIGHTED = frozenset({"ESTIMATE", "ALIGN", "ASCEND", "PERCH", "HOVER"})
"""Phases whose sentence says where the target was when the phase began."""
MOTORS = {"stop": "The motors were stopped", "emergency": "The motors were cut and locked"}


@dataclass(frozen=True)
class Sentence:
    """An event of the flight at `t_s` after the first tick; `grade`: step, good, warn or bad."""

    t_s: float
    text: str
    grade: str = "step"


def tell_story(flight: FlightAnalysis) -> tuple[Sentence, ...]:
    """The events of a flight in chronological order; empty for a log without ticks."""
    if not flight.log.records:
        return ()
    told = [
        *(_step(flight, stay) for stay in flight.log.phases),
        *map(_loss, flight.target_losses),
        *_holds(flight),
        *_taken_over(flight),
        *(Sentence(max(0.0, t_s), _upper(note)) for t_s, note in flight.notes if note),
        *_motors(flight),
        *_end(flight),
    ]
    return tuple(sorted(told, key=lambda sentence: sentence.t_s))


def _step(flight: FlightAnalysis, stay: PhaseSpan) -> Sentence:
    text = _upper(stay.reason)
    if stay.phase in SIGHTED:
        text += _where(flight, stay.start_s)
    if stay.phase in FINAL_PHASE_TEXTS:
        text = f"{FINAL_PHASE_TEXTS[stay.phase]}: {stay.reason}".rstrip(": ")
    else:
        text = f"{text}: {ACTIONS.get(stay.phase, stay.phase)}"
    if stay.simulated:
        text += f" (the simulation: {stay.simulated})"
    return Sentence(stay.start_s, text, _grade(stay))


def _grade(stay: PhaseSpan) -> str:
    if stay.phase in ("PERCHED", "COMPLETE"):
        return "good"
    if stay.phase == "ABORTED" or stay.severity == "stop":
        return "bad"
    if stay.phase in ("RECOVER", "LANDING") or stay.severity in ("back off", "hold"):
        return "warn"
    return "step"


def _where(flight: FlightAnalysis, t_s: float) -> str:
    up_m = flight.value_at(t_s, "ez_m")
    aside_m = math.hypot(flight.value_at(t_s, "ex_m"), flight.value_at(t_s, "ey_m"))
    if not math.isfinite(up_m + aside_m):
        return ""
    return f", {height_text(up_m)} the target and {length_text(aside_m)} off centre"


def _loss(loss: TargetLoss) -> Sentence:
    for_s = f"for {loss.duration_s:.1f} s" if loss.is_regained else "and not found again"
    if loss.frames_without_target:
        count = count_text(loss.frames_without_target, "frame")
        text = f"The target was lost {for_s}: {count} without it"
    else:
        text = f"No usable picture arrived {for_s if loss.is_regained else 'after this'}"
    return Sentence(loss.start_s, text, "warn")


def _holds(flight: FlightAnalysis) -> Iterator[Sentence]:
    for hold in flight.position_holds:
        if hold.duration_s >= HELD_LEAST_S:
            text = f"Held in place for {hold.duration_s:.1f} s: {hold.reason}"
            yield Sentence(hold.start_s, text, "warn")


def _taken_over(flight: FlightAnalysis) -> Iterator[Sentence]:
    for go in flight.takeovers:
        if go.by in TOOK_OVER:
            text = f"{TOOK_OVER[go.by]} for {go.end_s - go.start_s:.1f} s: {go.text}"
            steered = go.commands.keys() <= {"position setpoint", "raw thrust"}
            yield Sentence(max(0.0, go.start_s), text, "warn" if steered else "bad")


def _motors(flight: FlightAnalysis) -> Iterator[Sentence]:
    commands = flight.log.texts("cmd")
    for command, text in MOTORS.items():
        if command in commands:
            t_s = float(flight.log.t_s[commands.index(command)])
            yield Sentence(t_s, text, "step" if command == "stop" else "bad")


def _end(flight: FlightAnalysis) -> Iterator[Sentence]:
    end, phases, end_s = flight.summary, flight.log.phases, flight.log.end_s
    if flight.log.summary is None:
        text = f"The log ends here, in {phases[-1].phase if phases else '?'}"
        height_m = flight.value_at(end_s, "z_m") - flight.value_at(0.0, "z_m")
        if phases and phases[-1].phase in FLYING | {"LANDING"} and math.isfinite(height_m):
            text += f" at {length_text(height_m)}"
        text += ": it is unknown how the flight ended, as the log has no summary"
        yield Sentence(end_s, text, "bad")
    if end.locked:
        text = "The supervisor locked the vehicle: inspect and restart it"
        yield Sentence(end_s, text, "bad")
    if end.touchdown is not None and end.touchdown.is_hard:
        yield Sentence(end_s, f"It {end.touchdown.text}", "bad")
    if end.fell:
        yield Sentence(end_s, "The vehicle fell", "bad")


def _upper(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


# --- Numbers in readable form ---


def height_text(below_m: float) -> str:
    """How far the gear is below a target: ``31 cm below``. At a contact, the noise of the estimate
    may place it above: ``1.3 mm above``."""
    return f"{length_text(abs(below_m))} {'above' if below_m <= -5e-5 else 'below'}"


def length_text(metres: float) -> str:
    """A length with its unit: ``1.7 mm``, ``8.4 cm``, ``31 cm``, ``1.83 m``."""
    size = abs(metres)
    if not math.isfinite(size):
        return "unknown"
    if size < 0.02:
        return f"{metres * 1e3:.1f} mm"
    if size < 0.095:
        return f"{metres * 1e2:.1f} cm"
    if size < 0.995:
        return f"{metres * 1e2:.0f} cm"
    return f"{metres:.2f} m"


def count_text(number: int, noun: str) -> str:
    """A number with its noun: ``1 frame``, ``14 frames``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
