"""A flight in a few lines of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.mission import ContactError, Findings, Touchdown
from perchctl.record.read import FlightLog, PhaseSpan
from perchctl.vehicle import NO_BATTERY_READING_V


@dataclass(frozen=True)
class RecordingEnd:
    """What became of a recording.

    Attributes:
        pictures: how many are in it; `missing`: how many are not, and `problem`: the first
            reason why.
    """

    path: Path
    pictures: int
    missing: int = 0
    problem: str | None = None

    @property
    def text(self) -> str:
        told = f"{self.pictures} pictures in {self.path}"
        if self.missing:
            told += f", {self.missing} missing"
        return f"{told} ({self.problem})" if self.problem else told

    def as_record(self) -> dict[str, Any]:
        """Return the record for programs."""
        return {
            "recording": self.path.name,
            "pictures": self.pictures,
            "pictures_missing": self.missing,
            "recording_problem": self.problem,
        }


@dataclass(frozen=True)
class FlightSummary:
    """How one flight ended, and what it found out.

    Attributes:
        outcome: ``perched``, ``landed``, ``aborted``, or ``unknown`` for a log
            that ends without its summary.
        cause: what decided it, such as ``target not found``.
        miss_m: None where no truth is known.
        contact: the program's own error, of what hangs.
        touchdown: how the floor was met, as far as that was felt.
        lost_records, log_problem: what the log lacks, and why; 0 and None for a whole one.
        recording: what became of it; None of a flight without one, and of one that is read back.
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
    findings: Findings | None = None
    contact: ContactError | None = None
    touchdown: Touchdown | None = None
    lost_records: int = 0
    log_problem: str | None = None
    recording: RecordingEnd | None = None

    @classmethod
    def of(cls, log: FlightLog) -> FlightSummary:
        """Return the summary by the log's record; by its ticks where that is missing."""
        phases = log.phases
        battery_v = log.column("battery_v")
        known_v = battery_v[battery_v >= NO_BATTERY_READING_V]
        end: Mapping[str, Any] = log.summary or {
            "outcome": "unknown",
            "reason": _last_known(log),
        }
        last = log.records[-1] if log.records else {}
        battery_min_v = float(np.min(known_v)) if known_v.size else None
        return cls(
            outcome=str(end.get("outcome", "unknown")),
            reason=str(end.get("reason", "")),
            cause=str(end.get("cause") or ""),
            duration_s=float(end.get("duration_s") or sum(p.duration_s for p in phases)),
            attempts=int(end.get("attempts", last.get("attempts")) or 0),
            miss_m=end.get("miss_m"),
            battery_min_v=end.get("battery_min_v") or battery_min_v,
            locked=bool(end.get("locked", False)),
            fell=bool(end.get("fell", False)),
            phases=phases,
            findings=_part_in(end, Findings, _FINDINGS),
            contact=_part_in(end, ContactError, _CONTACT),
            touchdown=_part_in(end, Touchdown, _TOUCHDOWN),
            lost_records=int(end.get("lost_records") or 0),
            log_problem=end.get("problem"),
        )

    def as_record(self) -> dict[str, Any]:
        """Return the record for `FlightLogWriter.close`. The phases are in the ticks already,
        and the writer adds what the log lacks."""
        return {
            "outcome": self.outcome,
            "cause": self.cause or None,
            "reason": self.reason,
            "duration_s": self.duration_s,
            "attempts": self.attempts,
            "miss_m": self.miss_m,
            **_keys_of(self.contact, _CONTACT),
            **_keys_of(self.touchdown, _TOUCHDOWN),
            "battery_min_v": self.battery_min_v,
            "locked": self.locked,
            "fell": self.fell,
            **_keys_of(self.findings, _FINDINGS),
            **({} if self.recording is None else self.recording.as_record()),
        }

    def text(self, log_path: Path | None = None) -> str:
        """Return a few lines about the flight, without colour and a last line break."""
        lines = [f"{self.outcome.upper()}: {self.reason}".rstrip(": ")]
        if self.cause and self.cause != self.outcome:
            lines[0] += f" [{self.cause}]"
        if self.miss_m is not None:
            lines.append(f"miss:      {self.miss_m * 1e3:.1f} mm")
        if self.contact is not None:
            lines.append(f"contact:   {self.contact.text}")
        attempts = f"{self.attempts} attempt{'' if self.attempts == 1 else 's'}"
        lines.append(f"flight:    {self.duration_s:.1f} s, {attempts}")
        if self.phases:
            lines.append(f"phases:    {phases_text(self.phases)}")
        if self.battery_min_v is not None:
            lines.append(f"battery:   {self.battery_min_v:.2f} V at its lowest")
        if self.findings is not None:  # with 95 % intervals
            lines.append(f"latency:   {self.findings.latency_text}")
            lines.append(f"mounting:  turned by {self.findings.turn_text} (x, y, z)")
            lines += [f"advice:    {sentence}" for sentence in self.findings.advice]
        if self.locked:
            lines.append("vehicle:   locked by its supervisor: inspect and restart it")
        if self.touchdown is not None and self.touchdown.is_hard:
            lines.append(f"vehicle:   {self.touchdown.text}")
        if self.fell:
            lines.append("vehicle:   fell")
        if self.lost_records:
            lines.append(f"log lost:  {self.lost_records} records ({self.log_problem})")
        elif self.log_problem is not None:
            lines.append(f"log lost:  perhaps its last records ({self.log_problem})")
        if self.recording is not None:
            lines.append(f"recording: {self.recording.text}")
        if log_path is not None:
            lines.append(f"log:       {log_path}")
        return "\n".join(lines)


# A part of the summary by the record's keys and its own fields, in their order.
_CONTACT = {"contact_aside_m": "aside_m", "contact_sigma_m": "sigma_m"}
_TOUCHDOWN = {"touchdown_mps": "speed_mps", "touchdown_g": "peak_g"}
_FINDINGS = {
    "latency_s": "latency_s",
    "latency_sigma_s": "latency_sigma_s",
    "mount_turn_deg": "turn_deg",
    "mount_turn_sigma_deg": "turn_sigma_deg",
    "advice": "advice",
}


def _keys_of(part: Any, keys: Mapping[str, str]) -> dict[str, Any]:
    return {} if part is None else {key: getattr(part, name) for key, name in keys.items()}


def _part_in(end: Mapping[str, Any], kind: Any, keys: Mapping[str, str]) -> Any:
    """Return the part of that kind; None where the record does not have it."""
    known = {name: end[key] for key, name in keys.items() if end.get(key) is not None}
    if next(iter(keys.values())) not in known:
        return None
    return kind(**{n: tuple(v) if isinstance(v, list) else v for n, v in known.items()})


def _last_known(log: FlightLog) -> str:
    if log.phases:
        return f"the log ends in {log.phases[-1].phase}"
    phases = [r["phase"] for r in log.turn_records if r.get("role") == "flown" and r.get("phase")]
    return f"the log ends in {phases[-1]}" if phases else "the log holds no flight"


def phases_text(phases: Sequence[PhaseSpan]) -> str:
    """Return ``APPROACH 3.1 s > SEARCH 0.4 s > ...``; ends, which take no time, by name alone."""
    parts = [f"{p.phase} {p.duration_s:.1f} s" if p.duration_s > 0 else p.phase for p in phases]
    return " > ".join(parts)
