"""The numbers of one flight, read off its log, by which flights are told and compared."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.log.frames import log_frames
from perchctl.log.read import FlightLog, PhaseSpan
from perchctl.log.summary import summarise_flight
from perchctl.vehicle import NO_BATTERY_READING_V

SETTLED_S = 1.0
"""So long before the contact begins is looked at for how well the vehicle has settled."""
_NUMBER = re.compile(r"[0-9.]+")
_SETTLING, _CONTACT = "ASCEND", "PERCH"


def _number(label: str, unit: str = "", scale: float = 1.0, digits: int = 0) -> Any:
    """A number that may be unknown, and how people read it: `label`, and so many `digits` of
    `scale` times it in `unit`."""
    shown = {"label": label, "unit": unit, "scale": scale, "digits": digits}
    return field(default=None, metadata=shown)


@dataclass(frozen=True)
class Measures:
    """What one flight came to; None is not known.

    The settled errors are the RMS over the last `SETTLED_S` of the ascent from which the last
    contact was begun: horizontal distance of gear and target, and heading.
    """

    duration_s: float | None = _number("flight", "s", digits=1)
    attempts: int | None = _number("attempts")
    miss_m: float | None = _number("miss", "mm", 1e3, 1)
    settled_xy_rms_m: float | None = _number("settled, aside, RMS", "mm", 1e3, 1)
    settled_yaw_rms_rad: float | None = _number("settled, heading, RMS", "deg", 180 / np.pi, 2)
    latency_s: float | None = _number("latency found", "ms", 1e3, 0)
    latency_sigma_s: float | None = _number("latency, SD", "ms", 1e3, 1)
    battery_start_v: float | None = _number("battery, first", "V", digits=2)
    battery_min_v: float | None = _number("battery, lowest", "V", digits=2)
    battery_end_v: float | None = _number("battery, last", "V", digits=2)
    frames: int | None = _number("frames")
    frames_unseen: int | None = _number("frames without target")
    frame_rate_hz: float | None = _number("frames, median rate", "Hz", digits=1)
    frame_age_s: float | None = _number("frames, median age", "ms", 1e3, 0)
    frame_gaps: int | None = _number("gaps without a frame")
    frame_gaps_s: float | None = _number("time in such gaps", "s", digits=2)
    corner_rms_px: float | None = _number("corners' misfit, median", "px", digits=2)
    turns: int | None = _number("turns of the loop")
    late_p99_s: float | None = _number("turn late, 99 %", "ms", 1e3, 1)
    telemetry_age_p99_s: float | None = _number("telemetry's age, 99 %", "ms", 1e3, 0)


@dataclass(frozen=True)
class Held:
    """The vehicle was held in place; times on the loop's clock."""

    start_s: float
    end_s: float
    phase: str
    reason: str


def measures_of(log: FlightLog) -> Measures:
    """Errors: InvalidValue for a field that is not a number."""
    end = summarise_flight(log)
    battery_v = log.column("battery_v")
    battery_v = battery_v[battery_v >= NO_BATTERY_READING_V]
    found = end.findings
    return Measures(
        duration_s=end.duration_s if log.records or end.duration_s else None,
        attempts=end.attempts,
        miss_m=end.miss_m,
        latency_s=None if found is None else found.latency_s,
        latency_sigma_s=None if found is None else found.latency_sigma_s,
        battery_start_v=_at(battery_v, 0),
        battery_min_v=end.battery_min_v,
        battery_end_v=_at(battery_v, -1),
        turns=len(log.records),
        late_p99_s=_quantile(log.column("late_s"), 0.99),
        telemetry_age_p99_s=_quantile(log.column("tel_age_s"), 0.99),
        **_settled(log),
        **_frames(log),
    )


def shown(measures: Measures, name: str) -> str:
    """A number as people read it, without its unit; ``-`` where it is not known."""
    (of,) = [f for f in fields(measures) if f.name == name]
    value = getattr(measures, name)
    if value is None:
        return "-"
    return f"{value * of.metadata['scale']:.{of.metadata['digits']}f}"


def holds_of(log: FlightLog) -> tuple[Held, ...]:
    """Each stretch of turns in one phase that were held for one and the same reason, whatever
    its numbers, which are the last ones'."""
    found: list[Held] = []
    before: tuple[str, str] | None = None
    for record in log.records:
        t_s, phase = float(record["t_s"]), str(record.get("phase") or "")
        reason = str(record.get("hold") or "")
        this = (phase, _NUMBER.sub("", reason)) if reason else None
        if before is not None:
            last = found[-1]
            found[-1] = replace(last, end_s=t_s, reason=reason if this == before else last.reason)
        if this is not None and this != before:
            found.append(Held(t_s, t_s, phase, reason))
        before = this
    return tuple(found)


def last_contact(log: FlightLog) -> PhaseSpan | None:
    """The ascent from which the last contact was begun."""
    ascents = [a for a, b in pairwise(log.phases) if (a.phase, b.phase) == (_SETTLING, _CONTACT)]
    return ascents[-1] if ascents else None


def _settled(log: FlightLog) -> dict[str, Any]:
    ascent = last_contact(log)
    if ascent is None:
        return {}
    t_s = log.column("t_s")
    start_s = max(ascent.start_s, ascent.end_s - SETTLED_S)
    inside = (t_s >= start_s) & (t_s < ascent.end_s)
    x_m, y_m, yaw_rad = (log.column(key)[inside] for key in ("ex_m", "ey_m", "eyaw_rad"))
    known = np.isfinite(x_m + y_m + yaw_rad)
    if not known.any():
        return {}
    return {
        "settled_xy_rms_m": float(np.sqrt(np.mean(x_m[known] ** 2 + y_m[known] ** 2))),
        "settled_yaw_rms_rad": float(np.sqrt(np.mean(yaw_rad[known] ** 2))),
    }


def _frames(log: FlightLog) -> dict[str, Any]:
    frames = log_frames(log)
    times_s = np.sort(np.concatenate([frames.seen_s, frames.unseen_s]))
    periods_s = np.diff(times_s)
    misfits_px = log.column("j_rms_px")
    if not np.isfinite(misfits_px).any():  # four corners alone fit nearly any pose
        misfits_px = np.concatenate([log.column("l_rms_px"), log.column("s_rms_px")])
    return {
        "frames": len(times_s),
        "frames_unseen": len(frames.unseen_s),
        "frame_rate_hz": float(1 / np.median(periods_s)) if np.any(periods_s > 0) else None,
        "frame_age_s": _quantile(log.column("t_s") - log.column("frame_t_s"), 0.5),
        "frame_gaps": len(frames.gaps_s),
        "frame_gaps_s": float(np.sum(np.diff(frames.gaps_s, axis=1))),
        "corner_rms_px": _quantile(misfits_px, 0.5),
    }


def _at(values: Array, index: int) -> float | None:
    return float(values[index]) if values.size else None


def _quantile(values: Array, share: float) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.quantile(values, share)) if values.size else None
