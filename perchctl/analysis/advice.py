"""What to change for the next flight: each sentence with the figure that it rests on, and none
where the log shows nothing."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from perchctl.analysis.flight import FlightAnalysis
from perchctl.analysis.sight import percentile
from perchctl.analysis.words import count
from perchctl.vehicle import NO_BATTERY_READING_V

LEAST_PAIRS, SCALE_OFF = 20, 0.03
GAP_S = 0.3
SPARE_V = 0.15


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
        *_video(flight),
        *_link(flight),
        *_battery(flight),
    )


def _latency_and_mounting(flight: FlightAnalysis) -> Iterator[Advice]:
    findings = flight.summary.findings
    for sentence in () if findings is None else findings.advice:
        about = "latency" if sentence.startswith("latency") else "mounting"
        yield Advice(about, sentence, "fitted to the whole flight, with its 95 % interval")


def _computer(flight: FlightAnalysis) -> Iterator[Advice]:
    period_s = 1.0 / (flight.log.number("link.loop_hz") or 50.0)
    late_s = percentile(flight.log.column("late_s"), 99)
    if late_s > period_s / 2:
        yield Advice(
            "computer",
            "close other programs on the computer, or lower the camera's resolution",
            f"1 turn in 100 began {1e3 * late_s:.0f} ms late or more, of a period of "
            f"{1e3 * period_s:.0f} ms",
        )


def _print(flight: FlightAnalysis) -> Iterator[Advice]:
    large, small = flight.log.column("lz_m"), flight.log.column("sz_m")
    ratio = large / np.where(small > 0.05, small, np.nan) - 1.0
    known = ratio[np.isfinite(ratio)]
    if known.size >= LEAST_PAIRS and abs(off := float(np.median(known))) > SCALE_OFF:
        yield Advice(
            "print",
            "measure both markers on the sheet, and write their sides into target.large.side_m "
            "and target.small.side_m",
            f"the large marker seems {100 * abs(off):.0f} % {'farther' if off > 0 else 'nearer'} "
            f"than the small one, median of {known.size} frames with both",
        )


def _video(flight: FlightAnalysis) -> Iterator[Advice]:
    long = [b - a for a, b in flight.frames.gaps_s if b - a > GAP_S]
    if long:
        yield Advice(
            "video",
            "look at the video's way: channel, antennas, receiver, cable",
            f"{count(len(long), 'gap')} of more than {GAP_S:g} s without a picture, at most "
            f"{max(long):.1f} s",
        )


def _link(flight: FlightAnalysis) -> Iterator[Advice]:
    hold_s = flight.log.number("safety.telemetry_hold_s") or GAP_S
    age_s = percentile(flight.log.column("tel_age_s"), 100)
    if age_s > hold_s:
        yield Advice(
            "link",
            "another radio channel, or an antenna with a free view",
            f"telemetry was older than {hold_s:g} s, at most {age_s:.2f} s",
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
