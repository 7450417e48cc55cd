"""The summary of a flight, as values and as a few lines of text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from perchctl.errors import LogIncomplete
from perchctl.mission import (
    CameraFindings,
    GearToTargetDistance,
    HoverReport,
    Outcome,
    Touchdown,
    VehicleDiagnosis,
    find_transition_diagnosis,
)
from perchctl.record.read import FlightLog
from perchctl.vehicle import NO_BATTERY_READING_V


class RecordingEnd(NamedTuple):
    """Summary of a recording: the file's name, the numbers of stored and of lost images, and the
    reason for the first loss."""

    recording: str
    pictures: int
    pictures_missing: int
    recording_problem: str | None

    @property
    def text(self) -> str:
        """The summary in words."""
        missing = f", {self.pictures_missing} missing" if self.pictures_missing else ""
        why = f" ({self.recording_problem})" if self.recording_problem else ""
        return f"{self.pictures} pictures in {self.recording}{missing}{why}"


NAME_COLUMNS = 11
"""Width of the name column in a summary."""


@dataclass(frozen=True)
class FlightSummary:
    """How one flight ended, and what was measured in it.

    Attributes:
        outcome: ``perched``, ``landed``, ``aborted``, or ``unknown`` for a log
            that ends without its summary.
        cause: the reason for the outcome, such as ``target not found``.
        miss_m: true distance from gear to target centre; None if unknown.
        contact: estimated position error of the contact; None unless the vehicle is hanging.
        touchdown: how the vehicle met the floor, as far as telemetry shows it.
        hover: duration and position errors of a hover; None in a mission that perches.
        lost_records, log_problem: number of lost log records, and why they were lost; 0 and None if
            the log is complete.
        recording: summary of the recording; None without a recording, and in a log that is read
            back.
        simulated: True if the vehicle was simulated; then nothing here is advice for the profile of
            a real vehicle.
        is_profile_suspect: True if, according to the transition that decided the outcome, the
            profile may be wrong.
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
    findings: CameraFindings | None = None
    contact: GearToTargetDistance | None = None
    touchdown: Touchdown | None = None
    hover: HoverReport | None = None
    lost_records: int = 0
    log_problem: str | None = None
    recording: RecordingEnd | None = None
    simulated: bool = False
    is_profile_suspect: bool = False

    @property
    def exit_code(self) -> int:
        """The exit code of the flight or, if only its log is incomplete, the exit code of the log.
        Only for a summary from `LogWatcher.close`, because one that was read back may lack its
        cause."""
        code = Outcome(self.cause).exit_code
        return LogIncomplete.exit_code if code == 0 and self.log_problem is not None else code

    @classmethod
    def from_log(cls, log: FlightLog) -> FlightSummary:
        """The summary from the log's summary record, or from the ticks if that is missing."""
        battery_v = log.column("battery_v")
        known_v = battery_v[battery_v >= NO_BATTERY_READING_V]
        ends = f"ends in {log.phases[-1].phase}" if log.phases else "holds no flight"
        unknown = {"outcome": "unknown", "reason": f"the log {ends}"}
        end: Mapping[str, Any] = log.summary or unknown
        last = log.records[-1] if log.records else {}
        battery_min_v = float(np.min(known_v)) if known_v.size else None
        simulated = is_simulated(log.header)
        findings = _part_in(end, CameraFindings, _FINDINGS)
        if (
            simulated and findings is not None
        ):  # logs written by version 0.3.0 contain advice even in this case
            findings = replace(findings, advice=())
        return cls(
            outcome=str(end.get("outcome", "unknown")),
            reason=str(end.get("reason", "")),
            cause=str(end.get("cause") or ""),
            duration_s=float(end.get("duration_s") or sum(p.duration_s for p in log.phases)),
            attempts=int(end.get("attempts", last.get("attempts")) or 0),
            miss_m=end.get("miss_m"),
            battery_min_v=end.get("battery_min_v") or battery_min_v,
            locked=bool(end.get("locked", False)),
            fell=bool(end.get("fell", False)),
            findings=findings,
            contact=_part_in(end, GearToTargetDistance, _CONTACT),
            touchdown=_part_in(end, Touchdown, _TOUCHDOWN),
            hover=_part_in(end, HoverReport, _HOVER),
            lost_records=int(end.get("lost_records") or 0),
            log_problem=end.get("problem"),
            simulated=simulated,
            is_profile_suspect=any(
                VehicleDiagnosis.PROFILE_MAY_BE_WRONG
                in find_transition_diagnosis(str(event.get("row")))
                for event in log.events
            ),
        )

    def as_record(self) -> dict[str, Any]:
        """The record for `LogWatcher.end`, which adds the number of lost records."""
        return {
            "outcome": self.outcome,
            "cause": self.cause or None,
            "reason": self.reason,
            "duration_s": self.duration_s,
            "attempts": self.attempts,
            "miss_m": self.miss_m,
            **_keys_of(self.contact, _CONTACT),
            **_keys_of(self.touchdown, _TOUCHDOWN),
            **_keys_of(self.hover, _HOVER),
            "battery_min_v": self.battery_min_v,
            "locked": self.locked,
            "fell": self.fell,
            **_keys_of(self.findings, _FINDINGS),
            **({} if self.recording is None else self.recording._asdict()),
        }

    @property
    def is_hover_completed(self) -> bool:
        """True if the vehicle hovered for the whole time, and has landed."""
        return self.cause == Outcome.HOVERED.value and self.outcome == "landed"

    @property
    def reason_text(self) -> str:
        """The reason, followed by the cause if the cause is not the same as the outcome."""
        cause = f"[{self.cause}]" if self.cause and self.cause != self.outcome else ""
        return f"{self.reason} {cause}".strip()

    @property
    def headline(self) -> str:
        """The outcome and its reason."""
        return f"{self.outcome.upper()}: {self.reason_text}".rstrip(": ")

    def text(self, log_path: Path | None = None) -> str:
        """A few lines about the flight, without colour or a final newline."""
        rows = self.rows()
        if log_path is not None:
            rows.append(("log", str(log_path)))
        lines = [f"{name + ':':<{NAME_COLUMNS}}{text}" for name, text in rows]
        return "\n".join([self.headline, *lines])

    def rows(self) -> list[tuple[str, str]]:
        """The name and text of each line below the headline."""
        lines: list[tuple[str, str]] = []
        if self.simulated and self.is_profile_suspect:
            note = (
                "camera and positions were simulated: do not change the profile of a real vehicle"
            )
            lines.append(("note", note))
        if self.miss_m is not None:
            lines.append(
                ("miss", f"{self.miss_m * 1e3:.1f} mm off centre, according to the simulator")
            )
        if self.contact is not None:
            source = ", estimated from the camera" if math.isfinite(self.contact.sigma_m) else ""
            lines.append(("contact", f"{self.contact.text}{source}"))
        if self.hover is not None:
            lines.append(("hover", self.hover.text))
        attempts = f"{self.attempts} attempt{'' if self.attempts == 1 else 's'}"
        lines.append(("flight", f"{self.duration_s:.1f} s, {attempts}"))
        if self.battery_min_v is not None:
            lines.append(("battery", f"{self.battery_min_v:.2f} V at the lowest"))
        if self.findings is not None:  # the measured values, with 95 % intervals
            lines.append(("latency", self.findings.latency_text))
            lines.append(("mounting", f"rotated by {self.findings.rotation_text} (x, y, z)"))
            lines += [("advice", sentence) for sentence in self.findings.advice]
        if self.locked:
            lines.append(("vehicle", "locked by its supervisor: inspect and restart it"))
        if self.touchdown is not None and self.touchdown.is_hard:
            lines.append(("vehicle", self.touchdown.text))
        if self.fell:
            lines.append(("vehicle", "fell"))
        if self.lost_records:
            lines.append(("log lost", f"{self.lost_records} records ({self.log_problem})"))
        elif self.log_problem is not None:
            lines.append(("log lost", f"possibly the last records ({self.log_problem})"))
        if self.recording is not None:
            lines.append(("recording", self.recording.text))
        return lines


def is_simulated(header: Mapping[str, Any]) -> bool:
    """True if a log's header belongs to a simulated vehicle."""
    return str(header.get("uri", "")).startswith("sim://")


# The keys of each part of the summary in the record, and the part's fields, in order.
_CONTACT = {"contact_aside_m": "distance_xy_m", "contact_sigma_m": "sigma_m"}
_TOUCHDOWN = {"touchdown_mps": "speed_mps", "touchdown_g": "peak_g"}
_HOVER = {
    "hover_s": "duration_s",
    "hover_below_m": "hover_distance_below_target_m",
    "hover_rms_m": "gear_to_hover_position_rms_xyz_m",
    "hover_yaw_rms_rad": "yaw_error_rms_rad",
}
_FINDINGS = {
    "latency_s": "measured_latency_s",
    "latency_sigma_s": "latency_sigma_s",
    "mount_turn_deg": "mount_rotation_relative_to_profile_xyz_deg",
    "mount_turn_sigma_deg": "mount_rotation_sigma_xyz_deg",
    "advice": "advice",
}


def _keys_of(part: Any, keys: Mapping[str, str]) -> dict[str, Any]:
    return {} if part is None else {key: getattr(part, name) for key, name in keys.items()}


def _part_in(end: Mapping[str, Any], kind: Any, keys: Mapping[str, str]) -> Any:
    known = {name: end[key] for key, name in keys.items() if end.get(key) is not None}
    if next(iter(keys.values())) not in known:
        return None
    return kind(**{n: tuple(v) if isinstance(v, list) else v for n, v in known.items()})
