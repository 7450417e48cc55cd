"""What to change for the next flight: each sentence with the figure that it rests on, and none
where the log shows nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from perchctl.analysis.flight import FlightAnalysis, runs_of
from perchctl.analysis.sight import percentile
from perchctl.analysis.words import count, length, milliseconds, share, times
from perchctl.vehicle import NO_BATTERY_READING_V

LEAST_PAIRS, SCALE_OFF = 20, 0.03
RMS_PX = 1.0
UNSEEN_SHARE, LEAST_UNSEEN = 0.1, 10
IN_VIEW = 0.5
"""Aside by less than half of the height: a camera that looks up has the target in view."""
GAP_S = 0.3
SPARE_V = 0.15
APART_M = 0.05


@dataclass(frozen=True)
class Advice:
    """What to change, with its reason: `about` is one word, `evidence` has the figures, a sentence
    without its end."""

    about: str
    text: str
    evidence: str


def advice_of(flight: FlightAnalysis) -> tuple[Advice, ...]:
    """Collect the advice for the next flight, in the order in which to heed it."""
    return (
        *_latency_and_mounting(flight),
        *_computer(flight),  # what it delays looks like a video that fails
        *_print(flight),
        *_light(flight),
        *_video(flight),
        *_link(flight),
        *_battery(flight),
        *_external(flight),
    )


def _latency_and_mounting(flight: FlightAnalysis) -> Iterator[Advice]:
    for sentence in () if flight.findings is None else flight.findings.advice:
        about = "latency" if sentence.startswith("latency") else "mounting"
        yield Advice(about, sentence, "fitted to the whole flight, with its 95 % interval")


def _print(flight: FlightAnalysis) -> Iterator[Advice]:
    large, small = flight.log.column("lz_m"), flight.log.column("sz_m")
    ratio = large / np.where(small > 0.05, small, np.nan) - 1.0
    known = ratio[np.isfinite(ratio)]
    if known.size >= LEAST_PAIRS and abs(off := float(np.median(known))) > SCALE_OFF:
        farther = "farther away" if off > 0 else "nearer"
        yield Advice(
            "print",
            "measure both markers on the sheet, and write their sides into target.large.side_m "
            "and target.small.side_m",
            f"the large marker seems {share(abs(off))} {farther} than the small one, median of "
            f"{known.size} frames with both",
        )
    if flight.frames.misfit_px > RMS_PX:
        yield Advice(
            "print",
            "look whether the sheet is flat, and check the camera's calibration",
            f"the corners miss the pose by {flight.frames.misfit_px:.1f} px, median over "
            f"{count(len(flight.frames.seen_s), 'frame')}",
        )


def _light(flight: FlightAnalysis) -> Iterator[Advice]:
    unseen, frames = _unseen_in_view(flight)
    if unseen < LEAST_UNSEEN or unseen < UNSEEN_SHARE * frames:
        return
    yield Advice(
        "light",
        "look for what darkens, dazzles or hides the target; more light and a shorter exposure "
        "(v4l2-ctl) help where the flight was fast",
        f"{unseen} of {frames} frames did not show the target, though it was overhead",
    )


def _unseen_in_view(flight: FlightAnalysis) -> tuple[int, int]:
    """Count the frames that lack a target that was overhead, and all frames with it overhead."""
    overhead = np.hypot(flight.log.column("ex_m"), flight.log.column("ey_m")) < (
        IN_VIEW * flight.log.column("ez_m")
    )
    phases = flight.log.texts("phase")
    overhead_seen = [
        seen
        for i, seen in zip(flight.frames.ticks, flight.frames.seen, strict=True)
        if overhead[i] and phases[i] in ("ESTIMATE", "ALIGN", "ASCEND")
    ]
    return overhead_seen.count(False), len(overhead_seen)


def _video(flight: FlightAnalysis) -> Iterator[Advice]:
    long = [b - a for a, b in flight.frames.gaps_s if b - a > GAP_S]
    if long:
        yield Advice(
            "video",
            "look at the video's way: channel, antennas, receiver, cable",
            f"{times(len(long))} no picture came for more than {GAP_S:g} s, at most "
            f"{max(long):.1f} s",
        )


def _link(flight: FlightAnalysis) -> Iterator[Advice]:
    hold_s = flight.log.number("safety.telemetry_hold_s") or GAP_S
    age_s = np.nan_to_num(flight.log.column("tel_age_s"))
    old = age_s > hold_s
    if old.any():
        starts = int(np.count_nonzero(old & ~np.append(False, old[:-1])))
        yield Advice(
            "link",
            "another radio channel, or an antenna with a free view",
            f"telemetry was older than {milliseconds(hold_s)} {times(starts)}, at most "
            f"{milliseconds(float(age_s.max()))}",
        )


def _computer(flight: FlightAnalysis) -> Iterator[Advice]:
    period_s = 1.0 / (flight.log.number("link.loop_hz") or 50.0)
    most_s = percentile(flight.log.column("late_s"), 99)
    if most_s > period_s / 2:
        yield Advice(
            "computer",
            "close other programs on the computer, or lower the camera's resolution",
            f"1 turn in 100 began {milliseconds(most_s)} late or more, of a period of "
            f"{milliseconds(period_s)}",
        )


def _battery(flight: FlightAnalysis) -> Iterator[Advice]:
    least_v, volts = flight.log.number("safety.min_load_v"), flight.log.column("battery_v")
    lowest_v = percentile(volts[volts >= NO_BATTERY_READING_V], 0)
    if least_v is not None and lowest_v < least_v + SPARE_V:
        yield Advice(
            "battery",
            "start with a full battery; where it was full, take another one: this one is worn, or "
            "its contacts are",
            f"it came down to {lowest_v:.2f} V, and at {least_v:.2f} V a flight is ended",
        )


def _external(flight: FlightAnalysis) -> Iterator[Advice]:
    stops, apart_m = runs_of(flight.log, "pos_note"), flight.measures.external_apart_p95_m
    if stops:
        start_s, end_s, why = max(stops, key=lambda stop: stop[1] - stop[0])
        yield Advice(
            "positioning",
            "look where the markers are hidden from the cameras",
            f"{times(len(stops))} no position was sent, at most for {end_s - start_s:.1f} s: {why}",
        )
    if apart_m is not None and apart_m > APART_M:
        yield Advice(
            "positioning",
            "compare both by hand (`perchctl check --lift`)",
            f"the vehicle's estimate was {length(apart_m)} from the positions from outside in 1 "
            f"turn of 20",
        )
