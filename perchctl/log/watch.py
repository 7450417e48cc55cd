"""The flight log as a watcher of the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from perchctl.log.fields import tick_record
from perchctl.log.read import PhaseSpan
from perchctl.log.summary import FlightSummary
from perchctl.log.write import FlightLogWriter, log_path, make_header
from perchctl.mission.watch import Event, FlightReport, Tick
from perchctl.profile import Profile
from perchctl.vehicle import NO_BATTERY_READING_V

Truth = tuple[tuple[float, float, float], float]
"""The body's true position (world, m) and the gear's true miss (m)."""


class LogWatcher:
    """Writes every tick and event; its problem is the log's.

    `truth`, where a simulation sets it, gives what is true at the time of the tick.
    """

    def __init__(self, writer: FlightLogWriter) -> None:
        self.writer = writer
        self.truth: Callable[[], Truth] | None = None
        self._battery_min_v: float | None = None
        self._ticks = 0

    @classmethod
    def lockstep(cls, path: Path, profile: Profile, seed: int) -> LogWatcher:
        """For a simulated flight: the same seed gives the same bytes. Errors: InvalidValue."""
        header = make_header(profile, uri="sim://", source="sim:", seed=seed, lockstep=True)
        return cls(FlightLogWriter.open(path, header))

    @classmethod
    def real_time(
        cls, directory: Path, profile: Profile, uri: str, source: str, seed: int | None = None
    ) -> LogWatcher:
        """A new file in `directory`, written behind the flight.

        Errors: InvalidValue."""
        started = datetime.now(UTC)
        header = make_header(profile, uri=uri, source=source, seed=seed, started=started)
        path = log_path(directory, profile.name, started)
        return cls(FlightLogWriter.open(path, header, live=True))

    @property
    def path(self) -> Path:
        return self.writer.path

    def tick(self, tick: Tick) -> None:
        self._ticks += 1
        battery_v = tick.telemetry.battery_v
        if battery_v >= NO_BATTERY_READING_V:
            self._battery_min_v = min(battery_v, self._battery_min_v or battery_v)
        position_m, miss_m = (None, None) if self.truth is None else self.truth()
        self.writer.write(flight_record(tick, position_m, miss_m))

    def event(self, event: Event) -> None:
        self.writer.event(event)

    def close(
        self, report: FlightReport | None = None, miss_m: float | None = None, fell: bool = False
    ) -> FlightSummary | None:
        """Write the summary and close; without a report (the flight raised) only close."""
        if report is None:
            self.writer.close()
            return None
        summary = FlightSummary(
            outcome=report.phase.value.lower(),
            reason=report.reason,
            cause=report.outcome.value,
            duration_s=report.duration_s,
            attempts=report.attempts,
            miss_m=miss_m,
            battery_min_v=self._battery_min_v,
            locked=report.locked,
            fell=fell,
            phases=spans_of(report),
            findings=report.findings,
        )
        self.writer.close(summary.as_record())
        lost, problem = self.writer.lost_records, self.writer.problem
        return replace(summary, lost_records=lost, log_problem=problem)

    def abandon(self, reason: str) -> None:
        """Close the log of a flight that failed. One that never began leaves no file."""
        self.writer.close({"outcome": "failed", "reason": reason})
        if not self._ticks:
            self.path.unlink(missing_ok=True)

    @property
    def problem(self) -> str | None:
        return self.writer.problem


def spans_of(report: FlightReport) -> tuple[PhaseSpan, ...]:
    """The report's history as stays in phases."""
    starts = report.history
    if not starts:
        return ()
    ends = [event.t_s for event in starts[1:]] + [starts[-1].t_s]
    return tuple(
        PhaseSpan(event.phase.value if event.phase else "", event.t_s, end_s, event.reason)
        for event, end_s in zip(starts, ends, strict=True)
    )


def flight_record(
    tick: Tick,
    true_position_m: tuple[float, float, float] | None = None,
    true_miss_m: float | None = None,
) -> dict[str, Any]:
    """The tick as a record; with the truth of a simulation."""
    return tick_record(
        t_s=tick.t_s,
        telemetry=tick.telemetry,
        output=tick.output,
        target=tick.target,
        phase=tick.state.phase.value,
        reason=tick.state.reason,
        command=tick.command,
        hold=tick.state.hold,
        attempts=tick.state.attempts,
        loop_late_s=tick.loop_late_s,
        camera_age_s=tick.camera_age_s,
        telemetry_age_s=tick.telemetry_age_s,
        consistency=tick.consistency,
        delay_used_s=tick.delay_used_s,
        outside=tick.outside,
        battery=tick.state.battery,
        true_position_m=true_position_m,
        true_miss_m=true_miss_m,
    )
