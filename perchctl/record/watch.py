"""The flight log as a watcher of the loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perchctl.camera import FrameSource, WrappedSource
from perchctl.mission import FlightReport, Tick
from perchctl.profile import Profile
from perchctl.record.fields import tick_record
from perchctl.record.header import make_header
from perchctl.record.summary import FlightSummary, RecordingEnd
from perchctl.record.write import FlightLogWriter, log_path, recording_path
from perchctl.vehicle import NO_BATTERY_READING_V

if TYPE_CHECKING:
    from perchctl.record.recorder import Recorder

Truth = tuple[tuple[float, float, float], float]
"""The body's true position (world, m) and the gear's true miss (m)."""


class LogWatcher(FlightLogWriter):
    """Writes every tick and event of a loop that it watches; its problem is the log's.

    `truth`, where a simulation sets it, gives what is true at the time of the tick. A recording
    goes with it where one is wanted: its pictures come through `watched`, and what is wrong with
    it is in `remarks`, never in `problem`.
    """

    truth: Callable[[], Truth] | None = None
    recorder: Recorder | None = None
    _battery_min_v: float | None = None
    _ticks = 0
    _has_remarked = False

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
        log = cls.open(path, header, live)
        if record:
            from perchctl.record.recorder import Recorder

            try:
                log.recorder = Recorder.open(recording_path(log.path), header, profile, live)
            except BaseException:
                log.end()
                log.path.unlink(missing_ok=True)
                raise
        return log

    def watched(self, source: FrameSource) -> FrameSource:
        """Return the same source; the frames that it gives are recorded, where that is wanted."""
        return source if self.recorder is None else WrappedSource(source, self.recorder.frame)

    def remarks(self) -> list[str]:
        """Return what is new about the recording, a sentence, once a flight."""
        problem = None if self.recorder is None else self.recorder.problem
        if problem is None or self._has_remarked:
            return []
        self._has_remarked = True
        return [problem]

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
        self.write(record)
        if tick.turn is not None:
            self.turn(tick.turn)
        if self.recorder is not None:
            self.recorder.tick(record)

    def close(
        self, report: FlightReport | None = None, miss_m: float | None = None, fell: bool = False
    ) -> FlightSummary | None:
        """Write the summary and close; without a report (the flight raised) only close. Return the
        summary.

        The log comes first: a recording's disk that hangs holds up its own end only."""
        if report is None:
            self.end()
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
            findings=report.findings,
            contact=report.contact,
            touchdown=report.touchdown,
        )
        self.end(summary.as_record())
        return replace(
            summary,
            lost_records=self.lost_records,
            log_problem=self.lacks,
            recording=self._ended_recording(),
        )

    def abandon(self, reason: str) -> None:
        """Close the log of a flight that failed. One that never began leaves no file."""
        self.end({"outcome": "failed", "reason": reason})
        self._ended_recording()
        if not self.begun:
            self.path.unlink(missing_ok=True)
            if self.recorder is not None:
                self.recorder.path.unlink(missing_ok=True)

    def _ended_recording(self) -> RecordingEnd | None:
        return None if self.recorder is None else self.recorder.close()
