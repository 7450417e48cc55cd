"""The analysis of one flight, as used by `log show`, `compare`, `plot` and `report`.

Times are in seconds since the flight's first turn: the first iteration of the loop in which the
vehicle was flown.
"""

from __future__ import annotations

import math
import re
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.analysis.sight import Frames, TargetLoss, percentile, read_frames, target_losses
from perchctl.analysis.trim import Trim, estimate_trim
from perchctl.errors import UsageError
from perchctl.geometry import Array
from perchctl.mission import SentCommand
from perchctl.record import FlightLog, FlightSummary, PhaseSpan
from perchctl.record import read_log as read_records
from perchctl.vehicle import NO_BATTERY_READING_V

SETTLED_S = 1.0
"""Time before the contact over which the settled errors are computed, s."""
_NUMBER = re.compile(r"[0-9.]+")


@dataclass(frozen=True)
class Hold:
    """A period in which the mission paused; times are since the flight's first turn."""

    start_s: float
    end_s: float
    phase: str
    reason: str

    @property
    def duration_s(self) -> float:
        return self.end_s - self.start_s


def _number(label: str, unit: str = "", scale: float = 1.0, digits: int = 0) -> Any:
    shown = {"label": label, "unit": unit, "scale": scale, "digits": digits}
    return field(default=None, metadata=shown)


@dataclass(frozen=True)
class Measures:
    """Key figures of a flight; None if unknown.

    The settled errors (the horizontal distance between gear and target, and the heading error) are
    RMS values over the last `SETTLED_S` seconds of the ascent before the last contact.
    """

    duration_s: float | None = _number("flight", "s", digits=1)
    attempts: int | None = _number("attempts")
    miss_m: float | None = _number("miss", "mm", 1e3, 1)
    settled_xy_rms_m: float | None = _number("settled, lateral, RMS", "mm", 1e3, 1)
    settled_yaw_rms_rad: float | None = _number("settled, heading, RMS", "deg", 180 / np.pi, 2)
    latency_s: float | None = _number("latency measured", "ms", 1e3, 0)
    latency_sigma_s: float | None = _number("latency, SD", "ms", 1e3, 1)
    battery_start_v: float | None = _number("battery, first", "V", digits=2)
    battery_min_v: float | None = _number("battery, lowest", "V", digits=2)
    battery_end_v: float | None = _number("battery, last", "V", digits=2)
    battery_used_mah: float | None = _number("battery, used for thrust", "mAh")
    frames: int | None = _number("frames")
    frames_unseen: int | None = _number("frames without target")
    frame_rate_hz: float | None = _number("frames, median rate", "Hz", digits=1)
    frame_age_s: float | None = _number("frames, median age", "ms", 1e3, 0)
    frame_gaps: int | None = _number("gaps without a frame")
    frame_gaps_s: float | None = _number("time in such gaps", "s", digits=2)
    turns: int | None = _number("ticks of the loop")
    late_p99_s: float | None = _number("tick late, 99 %", "ms", 1e3, 1)
    telemetry_age_p99_s: float | None = _number("telemetry's age, 99 %", "ms", 1e3, 0)

    def value_text(self, name: str) -> str:
        """The value of the figure `name` in its display unit, without the unit; ``-`` if
        unknown."""
        (of,) = [f for f in fields(self) if f.name == name]
        value = getattr(self, name)
        if value is None:
            return "-"
        return f"{value * of.metadata['scale']:.{of.metadata['digits']}f}"

    @property
    def labels_and_texts(self) -> list[tuple[str, str]]:
        """The label of each known figure, and its value as text with unit."""
        return [
            (f.metadata["label"], f"{self.value_text(f.name)} {f.metadata['unit']}".rstrip())
            for f in fields(self)
            if getattr(self, f.name) is not None
        ]


class FlightAnalysis:
    """Analysis of one flight's log; each property is computed once, on first use.

    `records` contains all ticks with all their fields, and `events` the flight's events.
    `column(field)` returns one field for all ticks, (n,), NaN where it is missing.

    Times are measured from the first iteration in which the vehicle was flown. A property
    that encounters an invalid value in the log raises InvalidValue, TypeError, ValueError,
    LookupError or AttributeError; within `perchctl.record.wrap_log_errors` all of these become
    InvalidValue.
    """

    def __init__(self, log: FlightLog) -> None:
        self.log, self.records, self.events = log, log.records, log.events
        self.column = log.column

    def to_pandas(self) -> Any:
        """Return the ticks as a `pandas.DataFrame` with one column per field and the index `t_s`,
        seconds since the first tick. Raises UsageError if pandas is not installed."""
        try:
            import pandas
        except ImportError:
            how = f"{sys.executable} -m pip install pandas"
            raise UsageError(f"to_pandas needs pandas; install it with: {how}") from None
        index = pandas.Index(self.log.t_s, name="t_s")
        return pandas.DataFrame(self.records).drop(columns="t_s").set_index(index)

    @cached_property
    def summary(self) -> FlightSummary:
        """How the flight ended."""
        return FlightSummary.from_log(self.log)

    # --- holds and notes

    @cached_property
    def position_holds(self) -> tuple[Hold, ...]:
        """Periods in which the mission paused, each within one phase and for one reason.
        If the numbers in the reason change during a pause, the text of the reason is the one at the
        end of the pause."""
        found: list[Hold] = []
        before: tuple[str, str] | None = None
        phases, reasons = self.log.texts("phase"), self.log.texts("hold")
        for t_s, phase, reason in zip(map(float, self.log.t_s), phases, reasons, strict=True):
            this = (phase, _NUMBER.sub("", reason)) if reason else None
            if before is not None:
                last = found[-1]
                found[-1] = replace(
                    last, end_s=t_s, reason=reason if this == before else last.reason
                )
            if this is not None and this != before:
                found.append(Hold(t_s, t_s, phase, reason))
            before = this
        return tuple(found)

    @property
    def notes(self) -> list[tuple[float, str]]:
        """Time (s) and text of each note in the log."""
        return [
            (self.log.to_flight_s(float(event["t_s"])), str(event.get("reason") or ""))
            for event in self.log.events
            if event.get("event") == "note"
        ]

    # --- camera frames, target losses, takeovers and figures

    @cached_property
    def frames(self) -> Frames:
        """Timing of the camera frames that the pipeline processed."""
        return read_frames(self.log)

    @cached_property
    def target_losses(self) -> tuple[TargetLoss, ...]:
        """Intervals in which the target was not seen, in phases that need it."""
        return target_losses(self.log, self.frames)

    @cached_property
    def takeovers(self) -> tuple[Takeover, ...]:
        """Series of commands that were sent by anything other than the flight loop."""
        return group_takeovers(self.log)

    @cached_property
    def trim(self) -> Trim | None:
        """The thrust demanded from each motor in level hover; None if the log does not contain
        it."""
        return estimate_trim(self.log, simulated=self.summary.simulated)

    @cached_property
    def measures(self) -> Measures:
        """Key figures of the flight."""
        end, log, frames = self.summary, self.log, self.frames
        findings = end.findings
        volts, used_mah = log.column("battery_v"), log.column("battery_used_mah")
        volts = volts[volts >= NO_BATTERY_READING_V]
        used_mah = used_mah[np.isfinite(used_mah)]
        xy_m, yaw_rad = self._settled()
        gaps_s = np.diff(frames.gaps_s, axis=1)
        return Measures(
            duration_s=end.duration_s if log.records or end.duration_s else None,
            attempts=end.attempts,
            miss_m=end.miss_m,
            settled_xy_rms_m=xy_m,
            settled_yaw_rms_rad=yaw_rad,
            latency_s=None if findings is None else findings.measured_latency_s,
            latency_sigma_s=None if findings is None else findings.latency_sigma_s,
            battery_start_v=float(volts[0]) if volts.size else None,
            battery_min_v=end.battery_min_v,
            battery_end_v=float(volts[-1]) if volts.size else None,
            battery_used_mah=float(used_mah[-1]) if used_mah.size else None,
            frames=len(frames.t_s),
            frames_unseen=len(frames.times_without_target_s),
            frame_rate_hz=_known(frames.rate_hz),
            frame_age_s=_known(frames.median_age_s),
            frame_gaps=len(gaps_s),
            frame_gaps_s=float(np.sum(gaps_s)),
            turns=len(log.records),
            late_p99_s=_known(percentile(log.column("late_s"), 99)),
            telemetry_age_p99_s=_known(percentile(log.column("tel_age_s"), 99)),
        )

    def _settled(self) -> tuple[float | None, float | None]:
        """Compute RMS errors before the last contact: horizontal (m), heading (rad)."""
        ascent = contact_ascent(self.log.phases)
        if ascent is None:
            return None, None
        inside = self.log.tick_slice(max(ascent.start_s, ascent.end_s - SETTLED_S), ascent.end_s)
        x_m, y_m, yaw_rad = (self.log.column(k)[inside] for k in ("ex_m", "ey_m", "eyaw_rad"))
        known = np.isfinite(x_m + y_m + yaw_rad)
        if not known.any():
            return None, None
        return (
            float(np.sqrt(np.mean(x_m[known] ** 2 + y_m[known] ** 2))),
            float(np.sqrt(np.mean(yaw_rad[known] ** 2))),
        )

    # --- single ticks

    def tracked_values(self, log_field: str) -> Array:
        """A log field of each tick, (n,), NaN while the target is not tracked."""
        remembered = [record.get("tracked") is False for record in self.log.records]
        return np.where(remembered, np.nan, self.log.column(log_field))

    def value_at(self, t_s: float, log_field: str) -> float:
        """The value of a log field in the tick at `t_s`; NaN if it is missing or not a number."""
        records = self.log.records
        value = records[self.log.tick_index_at(t_s)].get(log_field) if records else None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return math.nan
        return float(value)


def read_log(path: Path | str) -> FlightAnalysis:
    """Read a flight log, gzipped or not, and return its analysis. The ticks are available as
    `records`, `column(field)` and `to_pandas()`; see also `events`, `summary` and `measures`.

    Raises:
        NotFound: there is no such file. InvalidValue: the file is damaged or not a flight log.
    """
    return FlightAnalysis(read_records(path))


def contact_ascent(spans: Sequence[PhaseSpan]) -> PhaseSpan | None:
    """Return the ascent that led to the last contact; None if there was no contact."""
    ascents = [a for a, b in pairwise(spans) if (a.phase, b.phase) == ("ASCEND", "PERCH")]
    return ascents[-1] if ascents else None


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None


# --- commands from senders other than the flight loop ---

APART_S = 2.0
"""Time between two commands from one sender above which the second one starts a new series, s."""
_BETWEEN = re.compile(r"(?<=[a-z])(?=[A-Z])")
"""Matches the boundary between two words in a class name such as ``PositionSetpoint``."""


@dataclass(frozen=True)
class Takeover:
    """A series of commands from a sender (`by`) other than the flight loop. Times are since the
    flight's first turn. `commands` is the number of commands of each kind, such as ``position
    setpoint``."""

    by: str
    start_s: float
    end_s: float
    commands: dict[str, int]

    @property
    def text(self) -> str:
        """Each kind of command, and how many were sent: ``position setpoint (14), land (2)``."""
        return ", ".join(f"{name} ({count})" for name, count in self.commands.items())


def group_takeovers(log: FlightLog) -> tuple[Takeover, ...]:
    """Return the series of commands from senders other than the flight loop, oldest first."""
    goes: list[list[SentCommand]] = []
    for each in sorted(log.sent, key=lambda one: one.t_s):
        last = goes[-1][-1] if goes else None
        if last is None or last.sender != each.sender or each.t_s - last.t_s > APART_S:
            goes.append([])
        goes[-1].append(each)
    return tuple(
        Takeover(
            go[0].sender,
            log.to_flight_s(go[0].t_s),
            log.to_flight_s(go[-1].t_s),
            dict(Counter(_BETWEEN.sub(" ", type(each.command).__name__).lower() for each in go)),
        )
        for go in goes
    )
