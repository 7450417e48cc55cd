"""A flight and a campaign in a few lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.mission.view import NO_BATTERY_READING_V
from perchctl.record.log_file import FlightLog, PhaseSpan
from perchctl.record.results import ENDS, FlightResult, campaign_summary, worst_first


@dataclass(frozen=True)
class FlightSummary:
    """What is worth saying after one flight.

    Attributes:
        outcome: ``perched``, ``landed``, ``aborted``, or ``unknown`` for a log
            that ends without its summary.
        cause: what decided it, such as ``target not found``.
        miss_m: None where no truth is known.
    """

    outcome: str
    reason: str
    cause: str = ""
    duration_s: float = 0.0
    attempts: int = 0
    miss_m: float | None = None
    battery_min_v: float | None = None
    locked: bool = False
    fell: bool = False
    phases: tuple[PhaseSpan, ...] = ()

    def as_record(self) -> dict[str, Any]:
        """For `FlightLogWriter.close`; the phases are in the ticks already."""
        return {
            "outcome": self.outcome,
            "cause": self.cause or None,
            "reason": self.reason,
            "duration_s": self.duration_s,
            "attempts": self.attempts,
            "miss_m": self.miss_m,
            "battery_min_v": self.battery_min_v,
            "locked": self.locked,
            "fell": self.fell,
        }


def summary_of(log: FlightLog) -> FlightSummary:
    """From the log's summary record; from its ticks where that is missing."""
    phases = log.phases
    battery_v = log.column("battery_v")
    known_v = battery_v[battery_v >= NO_BATTERY_READING_V]
    said: Mapping[str, Any] = log.summary or {
        "outcome": "unknown",
        "reason": f"the log ends in {phases[-1].phase}" if phases else "the log holds no flight",
    }
    last = log.records[-1] if log.records else {}
    battery_min_v = float(np.min(known_v)) if known_v.size else None
    return FlightSummary(
        outcome=str(said.get("outcome", "unknown")),
        reason=str(said.get("reason", "")),
        cause=str(said.get("cause") or ""),
        duration_s=float(said.get("duration_s") or sum(p.duration_s for p in phases)),
        attempts=int(said.get("attempts", last.get("attempts")) or 0),
        miss_m=said.get("miss_m"),
        battery_min_v=said.get("battery_min_v") or battery_min_v,
        locked=bool(said.get("locked", False)),
        fell=bool(said.get("fell", False)),
        phases=phases,
    )


def summary_text(
    flight: FlightSummary | FlightLog, log_path: Path | None = None, plot_path: Path | None = None
) -> str:
    """A few lines, no colour, no line break at the end."""
    faults = []
    if isinstance(flight, FlightLog):
        faults = _log_faults(flight)
        flight = summary_of(flight)
    lines = [f"{flight.outcome.upper()}: {flight.reason}".rstrip(": ")]
    if flight.cause and flight.cause != flight.outcome:
        lines[0] += f" [{flight.cause}]"
    if flight.miss_m is not None:
        lines.append(f"miss:      {flight.miss_m * 1e3:.1f} mm")
    lines.append(f"flight:    {flight.duration_s:.1f} s, {_attempts(flight.attempts)}")
    if flight.phases:
        lines.append(f"phases:    {phases_text(flight.phases)}")
    if flight.battery_min_v is not None:
        lines.append(f"battery:   {flight.battery_min_v:.2f} V at its lowest")
    if flight.locked:
        lines.append("vehicle:   locked by its supervisor: inspect and restart it")
    if flight.fell:
        lines.append("vehicle:   fell")
    lines += faults
    if log_path is not None:
        lines.append(f"log:       {log_path}")
    if plot_path is not None:
        lines.append(f"plot:      {plot_path}")
    return "\n".join(lines)


def _log_faults(log: FlightLog) -> list[str]:
    """What the log has lost, if anything."""
    faults = []
    lost = (log.summary or {}).get("lost_records", 0)
    if lost:
        faults.append(f"log lost:  {lost} records ({(log.summary or {}).get('problem')})")
    if log.ignored_bytes:
        faults.append(f"log lost:  its tail, {log.ignored_bytes} unreadable bytes")
    return faults


def phases_text(phases: Sequence[PhaseSpan]) -> str:
    """``APPROACH 3.1 s > SEARCH 0.4 s > ...``; terminals, which take no time, by name."""
    parts = [f"{p.phase} {p.duration_s:.1f} s" if p.duration_s > 0 else p.phase for p in phases]
    return " > ".join(parts)


def campaign_table(
    results: Sequence[FlightResult], wall_s: float | None = None, worst: int = 5
) -> str:
    """The campaign's figures and its worst flights as plain text."""
    figures = campaign_summary(results, wall_s, worst)
    lines = [f"{name:<18}{text}" for name, text in campaign_rows(figures, results)]
    if results:
        lines += ["", "worst flights"]
        lines += aligned(
            [("seed", "outcome", "miss [mm]", "time [s]", "attempts", "reason")]
            + [_cells(r) for r in worst_first(results)[:worst]]
        )
    return "\n".join(lines)


def aligned(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Rows of cells as lines of columns; the first row is the head."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _cells(r: FlightResult) -> tuple[str, ...]:
    flags = [word for word, on in (("locked", r.locked), ("fell", r.fell)) if on]
    outcome = ", ".join([r.outcome, *flags])
    miss = "-" if r.miss_m is None else f"{r.miss_m * 1e3:.1f}"
    return str(r.seed), outcome, miss, f"{r.time_s:.1f}", str(r.attempts), r.reason


def campaign_rows(
    figures: Mapping[str, Any], results: Sequence[FlightResult]
) -> list[tuple[str, str]]:
    """Name and text of each figure of `campaign_summary`."""
    flights = figures["flights"]
    rows = [("flights", str(flights))]
    for end in ENDS:
        share = f" ({100.0 * figures[end] / flights:.1f} %)" if flights else ""
        rows.append((end, f"{figures[end]}{share}"))
    rows += [("locked", str(figures["locked"])), ("fell", str(figures["fell"]))]
    miss = figures["miss_m"]
    if miss["max"] is not None:
        text = ", ".join(f"{k} {miss[k] * 1e3:.1f}" for k in ("median", "p95", "max"))
        rows.append(("miss [mm]", text))
    if results:
        times = [r.time_s for r in results]
        attempts = [r.attempts for r in results]
        rows.append(("flight time [s]", f"median {np.median(times):.1f}, max {max(times):.1f}"))
        rows.append(("attempts", f"mean {np.mean(attempts):.2f}, max {max(attempts)}"))
    if figures["realtime_factor"] is not None:
        rows.append(("real-time factor", f"{figures['realtime_factor']:.1f}"))
    if figures["worst_seeds"]:
        rows.append(("worst seeds", ", ".join(map(str, figures["worst_seeds"]))))
    return rows


def _attempts(count: int) -> str:
    return f"{count} attempt" if count == 1 else f"{count} attempts"
