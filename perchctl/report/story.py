"""A flight in sentences, each at its time, made of the log's events and ticks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from perchctl.log import summarise_flight
from perchctl.mission import FLYING_PHASES, SEVEN_PHASES
from perchctl.report.losses import Loss, losses_of
from perchctl.report.track import SAME_S, Step, Track
from perchctl.report.words import count, length
from perchctl.vehicle import NO_BATTERY_READING_V

HELD_LEAST_S = 0.1
BACKED_OFF_M = 0.01
FLYING = frozenset(phase.value for phase in FLYING_PHASES)
TOOK_OVER = {
    "watchdog": "The watchdog took over",
    "rescue": "The rescue took over, after an error",
    "reconnect": "The link was opened once more",
}
ACTS = {
    "position": "it gave it a place to hold",
    "thrust": "it kept the thrust",
    "land": "it ordered a landing",
    "stop": "it stopped the motors",
    "emergency": "it cut the motors",
}
PAPERS = tuple(phase.value for phase in SEVEN_PHASES)


@dataclass(frozen=True)
class Sentence:
    """What happened at a time, s from the first tick; `grade`: step, good, warn or bad."""

    t_s: float
    text: str
    grade: str = "step"


def story_of(track: Track) -> tuple[Sentence, ...]:
    """The whole flight, in order; empty for a log without ticks."""
    if not track.log.records:
        return ()
    told = [
        *_steps(track),
        *(_told_loss(track, loss) for loss in losses_of(track)),
        *_holds(track),
        *_taken_over(track),
        *_notes(track),
        *_motors(track),
        *_end(track),
    ]
    return tuple(sorted(told, key=lambda sentence: sentence.t_s))


# --- the phases -----------------------------------------------------------------------


def _steps(track: Track) -> Iterator[Sentence]:
    for i, step in enumerate(track.steps):
        text = TELLS.get(step.phase, _plain)(track, step)
        if step.simulated:
            text += f" (the simulation: {step.simulated})"
        if i == 0 and step.phase == "APPROACH":
            text += _battery(track)
        yield Sentence(step.start_s, text, _grade(step))


def _grade(step: Step) -> str:
    if step.phase in ("PERCHED", "COMPLETE"):
        return "good"
    if step.phase == "ABORTED" or step.severity == "stop":
        return "bad"
    if step.phase == "RECOVER" or step.severity in ("back off", "hold"):
        return "warn"
    return "warn" if step.phase == "LANDING" else "step"


def _plain(track: Track, step: Step) -> str:
    return f"{step.phase}: {step.reason}" if step.reason else step.phase


def _approach(track: Track, step: Step) -> str:
    return "It set off from the ground"


def _search(track: Track, step: Step) -> str:
    at = f"at {length(track.height_m(step.start_s))}"
    if step.row == "approached" or step.reason == "hovering in the perching area":
        return f"It hovered {at}, and looked for the target"
    return f"{_upper(step.reason)}: it looked for the target again, {at}"


def _estimate(track: Track, step: Step) -> str:
    where = _where(track, step.start_s)
    if step.row == "recovered" or "again" in step.reason or "once more" in step.reason:
        return f"{_upper(step.reason)}{where}"
    return f"The target was found{where}"


def _align(track: Track, step: Step) -> str:
    if step.severity == "hold" or "cone" in step.reason:
        return f"{_upper(step.reason)}{_beside(track, step.start_s)}: it aligned again"
    return f"Its pose was steady{_spread(track, step.start_s)}: it went under the target"


def _ascend(track: Track, step: Step) -> str:
    took_s = _stay_before(track, step, "ALIGN")
    turned = track.at(step.start_s, "eyaw_rad")
    text = f"Aligned{_beside(track, step.start_s)}"
    if math.isfinite(turned):
        text += f" and {abs(math.degrees(turned)):.1f} deg off"
    if took_s:
        text += f", after {took_s:.1f} s"
    return f"{text}: it climbed"


def _perch(track: Track, step: Step) -> str:
    below_m = track.at(step.start_s, "ez_m")
    below = f" {length(below_m)} below the target" if math.isfinite(below_m) else ""
    text = f"Settled at the stand-off{below}{_beside(track, step.start_s)}"
    took_s = _stay_before(track, step, "ASCEND")
    return f"{text}, after {took_s:.1f} s of ascent: it pressed" if took_s else f"{text}"


def _complete(track: Track, step: Step) -> str:
    speed = track.at(step.start_s, "vz_mps")
    thrust = track.at(step.start_s, "thrust") / 655.35
    text = _upper(step.reason)
    if math.isfinite(thrust) and math.isfinite(speed):
        text += f", at {thrust:.0f} % thrust"
    return f"{text}: the thrust was taken away"


def _recover(track: Track, step: Step) -> str:
    heights = track.log.column("z_m")[track.within(step.start_s, step.end_s)]
    heights = heights[np.isfinite(heights)]
    down_m = float(heights[0] - np.min(heights)) if heights.size else 0.0
    attempts = track.at(step.start_s, "attempts")
    nth = f" (failed attempt {attempts:.0f})" if attempts >= 1 else ""
    away = f"backed off {length(down_m)}" if down_m >= BACKED_OFF_M else "it stayed where it was"
    return f"{_upper(step.reason)}: {away}{nth}"


def _landing(track: Track, step: Step) -> str:
    height_m = track.height_m(step.start_s)
    at = f", from {length(height_m)}" if math.isfinite(height_m) else ""
    return f"{_upper(step.reason)}: it landed{at}"


def _perched(track: Track, step: Step) -> str:
    return f"Perched: {step.reason}"


def _landed(track: Track, step: Step) -> str:
    return f"Down: {step.reason}"


def _aborted(track: Track, step: Step) -> str:
    return f"The flight was broken off: {step.reason}"


TELLS: dict[str, Callable[[Track, Step], str]] = {
    "APPROACH": _approach,
    "SEARCH": _search,
    "ESTIMATE": _estimate,
    "ALIGN": _align,
    "ASCEND": _ascend,
    "PERCH": _perch,
    "COMPLETE": _complete,
    "RECOVER": _recover,
    "LANDING": _landing,
    "PERCHED": _perched,
    "LANDED": _landed,
    "ABORTED": _aborted,
}


def _battery(track: Track) -> str:
    volts = track.at(0.0, "battery_v")
    return f", with the battery at {volts:.2f} V" if volts >= NO_BATTERY_READING_V else ""


def _where(track: Track, t_s: float) -> str:
    up_m, aside_m = track.at(t_s, "ez_m"), _aside_m(track, t_s)
    if not math.isfinite(up_m + aside_m):
        return ""
    return f", {length(up_m)} above and {length(aside_m)} aside"


def _beside(track: Track, t_s: float) -> str:
    aside_m = _aside_m(track, t_s)
    return f", {length(aside_m)} beside" if math.isfinite(aside_m) else ""


def _aside_m(track: Track, t_s: float) -> float:
    return math.hypot(track.at(t_s, "ex_m"), track.at(t_s, "ey_m"))


def _spread(track: Track, t_s: float) -> str:
    sigma_m = math.hypot(track.at(t_s, "esx_m"), track.at(t_s, "esy_m"))
    return f" to {length(sigma_m)}" if math.isfinite(sigma_m) else ""


def _stay_before(track: Track, step: Step, phase: str) -> float:
    """How long the phase before lasted, 0 where another one was before."""
    at = track.steps.index(step)
    before = track.steps[at - 1] if at else None
    return before.end_s - before.start_s if before and before.phase == phase else 0.0


# --- between them ---------------------------------------------------------------------


def _told_loss(track: Track, loss: Loss) -> Sentence:
    for_s = f"for {loss.duration_s:.1f} s" if loss.regained else "and not seen again"
    if loss.frames:
        text = f"The target was lost {for_s}: {count(loss.frames, 'frame')} without it"
        text += _motion(loss)
    else:
        text = f"No picture that could be used came {for_s if loss.regained else 'any more'}"
    return Sentence(loss.start_s, f"{text}{_then(track, loss)}", "warn")


def _motion(loss: Loss) -> str:
    if math.isfinite(loss.blur_px):
        fastest = f", blur {loss.blur_px:.1f} px"
    elif math.isfinite(loss.flow_pxps):
        fastest = f", moving at {loss.flow_pxps:.0f} px/s in the picture"
    else:
        fastest = ","
    return f"{fastest} at {loss.speed_mps:.1f} m/s" if math.isfinite(loss.speed_mps) else ""


def _then(track: Track, loss: Loss) -> str:
    """What the mission made of it while it lasted."""
    for step in track.steps:
        if not loss.start_s < step.start_s <= loss.end_s:
            continue
        if step.phase == "RECOVER":
            return f"; {_recover(track, step).rpartition(': ')[2].partition(' (')[0]}"
        if step.phase == "LANDING":
            return "; landed"
        return f"; {step.phase} again" if step.phase in ("SEARCH", "ALIGN") else ""
    return ""


def _holds(track: Track) -> Iterator[Sentence]:
    """A hold's reason counts on while it lasts; its last one says the most."""
    held: list[tuple[float, float, str]] = []
    for start_s, end_s, reason in track.runs("hold"):
        if held and start_s - held[-1][1] < SAME_S:
            start_s = held.pop()[0]
        held.append((start_s, end_s, reason))
    for start_s, end_s, reason in held:
        if end_s - start_s >= HELD_LEAST_S:
            text = f"Held in place for {end_s - start_s:.1f} s: {reason}"
            yield Sentence(start_s, text, "warn")


def _taken_over(track: Track) -> Iterator[Sentence]:
    """What came from elsewhere than the loop. The farewell, to a vehicle that is down, is none of
    the flight's."""
    for go in track.log.takeovers:
        who = TOOK_OVER.get(go.by)
        if who is None:
            continue
        acts = [ACTS[name] for name, _ in go.sent]
        for_s = go.end_s - go.start_s
        lasted = f" for {for_s:.1f} s" if for_s >= HELD_LEAST_S else ""
        steered = all(name in ("position", "thrust") for name, _ in go.sent)
        t_s = max(0.0, track.log.since(go.start_s))
        text = f"{who}{lasted}: {' and '.join(acts)}"
        yield Sentence(t_s, text, "warn" if steered else "bad")


def _notes(track: Track) -> Iterator[Sentence]:
    for event in track.log.events:
        if event.get("event") == "note" and event.get("reason"):
            t_s = track.log.since(float(event["t_s"]))
            yield Sentence(max(0.0, t_s), _upper(str(event["reason"])))


def _motors(track: Track) -> Iterator[Sentence]:
    """Each kind once: a stop may be repeated, and an emergency cut may come long after it."""
    tells = {"stop": "The motors were stopped", "emergency": "The motors were cut and locked"}
    for start_s, _end_s, command in track.runs("cmd"):
        text = tells.pop(command, None)
        if text is not None:
            yield Sentence(start_s, text, "step" if command == "stop" else "bad")


def _end(track: Track) -> Iterator[Sentence]:
    """Where a log stops without saying how the flight ended."""
    if track.log.summary is not None:
        flight = summarise_flight(track.log)
        if flight.locked:
            text = "The supervisor locked the vehicle: inspect and restart it"
            yield Sentence(track.end_s, text, "bad")
        if flight.touchdown is not None and flight.touchdown.is_hard:
            yield Sentence(track.end_s, f"It {flight.touchdown.text}", "bad")
        if flight.fell:
            yield Sentence(track.end_s, "The vehicle fell", "bad")
        return
    phase = track.steps[-1].phase if track.steps else "?"
    text = f"The log ends here, in {phase}"
    height_m = track.height_m(track.end_s)
    if phase in FLYING | {"LANDING"} and math.isfinite(height_m):
        text += f" at {length(height_m)}"
    yield Sentence(
        track.end_s, f"{text}: how the flight ended is not known, its program was ended", "bad"
    )


def _upper(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
