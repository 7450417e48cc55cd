"""The flight log as a watcher of the loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perchctl.camera import FrameSource, WrappedSource
from perchctl.mission import Event, FlightReport, SentCommand, Tick, Turn
from perchctl.profile import Profile
from perchctl.record.fields import event_record, tick_record
from perchctl.record.header import make_header
from perchctl.record.read import PhaseSpan
from perchctl.record.summary import FlightSummary, RecordingEnd
from perchctl.record.write import FlightLogWriter, log_path, recording_path
from perchctl.vehicle import NO_BATTERY_READING_V

if TYPE_CHECKING:
    from perchctl.record.recorder import Recorder

Truth = tuple[tuple[float, float, float], float]
"""The body's true position (world, m) and the gear's true miss (m)."""


class LogWatcher:
    """Writes every tick and event; its problem is the log's.

    `truth`, where a simulation sets it, gives what is true at the time of the tick. A recording
    goes with it where one is wanted: its pictures come through `watched`, and what is wrong with
    it is in `remarks`, never in `problem`.
    """

    def __init__(self, writer: FlightLogWriter, recorder: Recorder | None = None) -> None:
        self.writer = writer
        self._recorder = recorder
        self.truth: Callable[[], Truth] | None = None
        self._battery_min_v: float | None = None
        self._ticks = 0
        self._has_remarked = False

    @classmethod
    def lockstep(cls, path: Path, profile: Profile, seed: int, record: bool = False) -> LogWatcher:
        """Open the log of a simulated flight: the same seed gives the same bytes. Errors:
        InvalidValue."""
        header = make_header(profile, uri="sim://", source="sim:", seed=seed, lockstep=True)
        return cls._opened(path, header, profile, record, live=False)

    @classmethod
    def real_time(
        cls,
        directory: Path,
        profile: Profile,
        uri: str,
        source: str,
        seed: int | None = None,
        record: bool = False,
    ) -> LogWatcher:
        """Open a new log in `directory`, which a thread of its own writes. Errors: InvalidValue."""
        started, t0_s = datetime.now(UTC), time.monotonic()
        header = make_header(profile, uri=uri, source=source, seed=seed, started=started, t0_s=t0_s)
        path = log_path(directory, profile.name, started)
        return cls._opened(path, header, profile, record, live=True)

    @classmethod
    def _opened(
        cls, path: Path, header: Mapping[str, Any], profile: Profile, record: bool, live: bool
    ) -> LogWatcher:
        writer = FlightLogWriter.open(path, header, live)
        if not record:
            return cls(writer)
        from perchctl.record.recorder import Recorder

        try:
            return cls(writer, Recorder.open(recording_path(writer.path), header, profile, live))
        except BaseException:
            writer.close()
            writer.path.unlink(missing_ok=True)
            raise

    def watched(self, source: FrameSource) -> FrameSource:
        """Return the same source; the frames that it gives are recorded, where that is wanted."""
        return source if self._recorder is None else WrappedSource(source, self._recorder.frame)

    def remarks(self) -> list[str]:
        """Return what is new about the recording, a sentence, once a flight."""
        problem = None if self._recorder is None else self._recorder.problem
        if problem is None or self._has_remarked:
            return []
        self._has_remarked = True
        return [problem]

    @property
    def path(self) -> Path:
        return self.writer.path

    @property
    def begun(self) -> bool:
        """True if the flight has begun; `abandon` leaves no file of one that has not."""
        return self._ticks > 0

    def tick(self, tick: Tick) -> None:
        """Write a tick, with its turn and the simulation's truth. Never raises."""
        self._ticks += 1
        battery_v = tick.telemetry.battery_v
        if battery_v >= NO_BATTERY_READING_V:
            self._battery_min_v = min(battery_v, self._battery_min_v or battery_v)
        position_m, miss_m = (None, None) if self.truth is None else self.truth()
        record = tick_record(tick, position_m, miss_m)
        self.writer.write(record)
        if tick.turn is not None:
            self.writer.turn(tick.turn)
        if self._recorder is not None:
            self._recorder.tick(record)

    def turn(self, turn: Turn) -> None:
        """Write a turn that has no tick."""
        self.writer.turn(turn)

    def sent(self, sent: SentCommand) -> None:
        """Write what was sent in the loop's place; from any thread, and without waiting."""
        self.writer.sent(sent)

    def event(self, event: Event) -> None:
        self.writer.event(event)
        if self._recorder is not None:
            self._recorder.event(event_record(event))

    def close(
        self, report: FlightReport | None = None, miss_m: float | None = None, fell: bool = False
    ) -> FlightSummary | None:
        """Write the summary and close; without a report (the flight raised) only close. Return the
        summary.

        The log comes first: a recording's disk that hangs holds up its own end only."""
        if report is None:
            self.writer.close()
            self._ended_recording()
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
            contact=report.contact,
            touchdown=report.touchdown,
        )
        self.writer.close(summary.as_record())
        return replace(
            summary,
            lost_records=self.writer.lost_records,
            log_problem=self.writer.lacks,
            recording=self._ended_recording(),
        )

    def abandon(self, reason: str) -> None:
        """Close the log of a flight that failed. One that never began leaves no file."""
        self.writer.close({"outcome": "failed", "reason": reason})
        recording = self._ended_recording()
        if not self.begun:
            self.path.unlink(missing_ok=True)
            if recording is not None:
                recording.path.unlink(missing_ok=True)

    def _ended_recording(self) -> RecordingEnd | None:
        return None if self._recorder is None else self._recorder.close()

    @property
    def problem(self) -> str | None:
        return self.writer.problem


def spans_of(report: FlightReport) -> tuple[PhaseSpan, ...]:
    """Return the report's history as stays in phases."""
    starts = report.history
    times_s = [event.t_s - starts[0].t_s for event in starts]
    ends_s = [*times_s[1:], *times_s[-1:]]
    return tuple(
        PhaseSpan(event.phase.value if event.phase else "", start_s, end_s, event.reason)
        for event, start_s, end_s in zip(starts, times_s, ends_s, strict=True)
    )
