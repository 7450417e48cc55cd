"""The flight's edges as its log shows them: telemetry, setpoints, positions from outside, and
how late the turns were."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.report.sight import part_of
from perchctl.report.track import Track

GAP_S = 0.1
"""Telemetry older than that is told."""


@dataclass(frozen=True)
class LinkHealth:
    """Telemetry as the turns had it, and what was sent. Rates in 1/s, NaN where unknown.

    Attributes:
        fresh_hz: samples that were new in their turn; not above the loop's own rate.
        samples_hz: all that came, NaN where the log does not hold them (before version 3).
        old: stretches in which the newest sample was older than `GAP_S`: from, to, worst age.
        sent: commands by kind, how many turns each.
        setpoints_hz: position setpoints and raw thrusts, while they were sent.
    """

    turns_hz: float
    fresh_hz: float
    samples_hz: float
    age_s: float
    age_most_s: float
    age_worst_s: float
    old: tuple[tuple[float, float, float], ...]
    sent: tuple[tuple[str, int], ...]
    setpoints_hz: float


@dataclass(frozen=True)
class OutsideHealth:
    """Positions from outside, as they were sent; `stops`: from, to, why none was.
    `apart_m`: between the newest one and the vehicle's own estimate, median and 95 of 100."""

    sent: int
    rate_hz: float
    age_s: float
    age_most_s: float
    apart_m: float
    apart_most_m: float
    stops: tuple[tuple[float, float, str], ...]


def link_of(track: Track) -> LinkHealth:
    """Of a log with at least one tick."""
    t_s, age = track.t_s, track.log.column("tel_age_s")
    spent = max(track.end_s, 1e-9)
    sampled = np.round(t_s - age, 4)
    fresh = np.count_nonzero(np.diff(sampled[np.isfinite(sampled)]) > 0)
    kinds = [str(r.get("cmd")) for r in track.log.records if r.get("cmd")]
    flying = np.array([r.get("cmd") in ("position", "thrust") for r in track.log.records], bool)
    between = np.diff(t_s)[flying[1:] & flying[:-1]] if t_s.size > 1 else np.empty(0)
    return LinkHealth(
        turns_hz=(t_s.size - 1) / spent if t_s.size > 1 else math.nan,
        fresh_hz=fresh / spent if t_s.size > 1 else math.nan,
        samples_hz=_samples_hz(track),
        age_s=part_of(age, 50),
        age_most_s=part_of(age, 99),
        age_worst_s=part_of(age, 100),
        old=_old(track, age),
        sent=tuple((kind, kinds.count(kind)) for kind in dict.fromkeys(kinds)),
        setpoints_hz=1.0 / float(np.mean(between)) if between.size else math.nan,
    )


def _samples_hz(track: Track) -> float:
    """By the samples' own times, so that what came late in one go counts as it was taken."""
    taken = [r.get("taken") for r in track.log.turn_records]
    at_s = [
        s["t_s"]
        for t in taken
        if isinstance(t, dict)
        for s in (*(t.get("samples") or ()), *(t.get("late") or ()))
    ]
    spent = max(at_s) - min(at_s) if at_s else 0.0
    return (len(at_s) - 1) / spent if spent > 0 else math.nan


def _old(track: Track, age: Array) -> tuple[tuple[float, float, float], ...]:
    found: list[tuple[float, float, float]] = []
    inside = False
    for t_s, now in zip(track.t_s, age, strict=True):
        if not now > GAP_S:
            inside = False
        elif inside:
            start_s, _, worst = found[-1]
            found[-1] = (start_s, float(t_s), max(worst, float(now)))
        else:
            found.append((float(t_s), float(t_s), float(now)))
            inside = True
    return tuple(found)


def outside_of(track: Track) -> OutsideHealth | None:
    """None where the vehicle's decks measured its position."""
    sent = track.log.column("pos_sent")
    if not np.isfinite(sent).any():
        return None
    apart = np.linalg.norm(
        np.stack([track.log.column(f"pos_{a}_m") - track.log.column(f"{a}_m") for a in "xyz"], 1),
        axis=1,
    )
    stopped = np.array([r.get("pos_note") is not None for r in track.log.records])
    age = track.log.column("pos_age_s")
    return OutsideHealth(
        int(np.nanmax(sent)),
        part_of(np.where(stopped, np.nan, track.log.column("pos_hz")), 50),
        part_of(age, 50),
        part_of(age, 99),
        part_of(np.where(stopped, np.nan, apart), 50),
        part_of(np.where(stopped, np.nan, apart), 95),
        tuple(track.runs("pos_note")),
    )


def timings_of(track: Track) -> dict[str, Array]:
    """What each turn took, s, by name: how late it began, and what a log of today has of its
    parts; a flight in lockstep has none of them."""
    late = track.log.column("late_s")
    found = {"late": late[np.isfinite(late)]}
    timings = [t for r in track.log.turn_records if isinstance(t := r.get("timing"), dict)]
    for key in dict.fromkeys(key for timing in timings for key in timing):
        found[key.removesuffix("_s")] = np.array([t.get(key, math.nan) for t in timings], float)
    return found
