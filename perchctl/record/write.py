"""The flight log: append-only JSON lines, readable after any crash.

Line 1 is the header. Each iteration of the flight loop (turn) adds a `turn` record (exact and
complete) and, if the vehicle was flown, a `tick` record (rounded, for reading and plotting), with
`event` and `sent` records between them. The last line is the `summary`. An error in writing the log
never disturbs the flight.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perchctl.errors import InvalidValue
from perchctl.mission import Event, FlightReport, SentCommand, Tick, TickRecord
from perchctl.profile import Profile
from perchctl.record.disk import BackgroundWriter, DiskFile, create_file
from perchctl.record.exact import encode_line, json_line, to_exact_json
from perchctl.record.fields import event_record, tick_record
from perchctl.record.header import make_header
from perchctl.record.summary import FlightSummary, RecordingEnd, is_simulated
from perchctl.vehicle import NO_BATTERY_READING_V
from perchctl.vision import Frame

if TYPE_CHECKING:
    from perchctl.record.recorder import Recorder

FSYNC_PERIOD_S = 1.0
LOG_CLOSE_TIMEOUT_S = 3.0
MOST_WAITING = 3000
"""Number of records that may wait for the disk: half a minute of a flight at 50 Hz. Further records
are dropped."""
NO_ANSWER = "the disk does not respond: the end of the flight log is missing"
NO_ROOM = "the disk cannot keep up with the flight log: records are dropped"

Truth = tuple[tuple[float, float, float], float]
"""The body's true position (world, m) and the gear's true miss (m)."""


class LogWatcher:
    """Writes the log of one flight and, optionally, its recording.

    Only opening the log raises exceptions. Later failures are reported by `problem`, and failures
    of the recording by `remarks`.

    Attributes:
        path: the log file; `open` adds ``_2``, ``_3``... to the name rather than overwrite a file.
        problem: None, or one sentence about the first failure of the disk, or about the error that
            made the flight detach its log.
        unencodable: None, or one sentence about the first record that could not be encoded. Only
            that record is lost, and the flight continues.
        truth: function that returns the true state at a tick; set by a simulation.
        simulated: True if the header belongs to a simulated vehicle.
        recorder: records the camera's frames; None without a recording.
    """

    name = "the flight log"

    def __init__(self, path: Path, header_line: bytes, live: bool, file: DiskFile) -> None:
        """Write the header into a new file. Raises OSError."""
        file.write(header_line)
        self.path = path
        self.problem: str | None = None
        self.unencodable: str | None = None
        self.truth: Callable[[], Truth] | None = None
        self.simulated = False
        self.recorder: Recorder | None = None
        self._battery_min_v: float | None = None
        self._ticks = 0
        self._has_remarked = False
        self._file = file
        self._writer = BackgroundWriter(MOST_WAITING, "perchctl-log", live)
        self._closed = False
        self._unfinished = self._unmade = 0
        # Used by the writer thread:
        self._failed = 0
        self._synced_s = math.inf

    @property
    def lost_records(self) -> int:
        """The number of records that could not be written."""
        return self._writer.refused_jobs + self._failed + self._unfinished + self._unmade

    @property
    def loss_reason(self) -> str | None:
        """The reason why the log is incomplete, in one sentence; None if it is complete. A disk
        failure takes precedence over other reasons."""
        return self.problem or self.unencodable

    @classmethod
    def open(cls, path: Path, header: Mapping[str, Any], live: bool = False) -> LogWatcher:
        """Create the file and its folder and write the header.

        `live`: a background thread writes, and syncs about once a second; otherwise each record is
        written at once. Raises InvalidValue, before the flight.
        """
        # A replay uses the profile in the header, so its numbers are not rounded.
        line = json_line(to_exact_json({k: v for k, v in header.items() if v is not None}))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            for free in _free_names(path):
                with suppress(FileExistsError):
                    log = create_file(free, live, partial(cls, free, line, live))
                    log.simulated = is_simulated(header)
                    return log
            raise AssertionError("unreachable")
        except OSError as error:
            raise InvalidValue(
                f"{path}: the flight log cannot be created ({error.strerror or error}): check "
                "its disk and folder, or name another folder with --log-dir or log.directory"
            ) from None

    @classmethod
    def open_lockstep(
        cls,
        path: Path,
        profile: Profile,
        seed: int,
        record: bool = False,
        fault: str | None = None,
    ) -> LogWatcher:
        """Open the log of a simulated flight. The same seed gives the same bytes. `fault` describes
        the injected fault, if any. Errors: InvalidValue."""
        header = make_header(
            profile, uri="sim://", source="sim:", seed=seed, fault=fault, lockstep=True
        )
        return cls._opened(path, header, profile, record, live=False)

    @classmethod
    def open_real_time(
        cls,
        directory: Path,
        profile: Profile,
        uri: str,
        source: str,
        seed: int | None = None,
        record: bool = False,
    ) -> LogWatcher:
        """Open a new log in `directory`, written by a separate thread. Errors: InvalidValue."""
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

    def frame(self, frame: Frame) -> None:
        """Record a camera frame, if there is a recorder. Never raises an exception."""
        if self.recorder is not None:
            self.recorder.write_frame(frame)

    def remarks(self) -> list[str]:
        """The recording's problem in one sentence, returned once; otherwise an empty list."""
        problem = None if self.recorder is None else self.recorder.problem
        if problem is None or self._has_remarked:
            return []
        self._has_remarked = True
        return [problem]

    @property
    def has_begun(self) -> bool:
        """True if the flight has begun; `abandon` deletes the log of a flight that has not."""
        return self._ticks > 0

    def tick(self, tick: Tick) -> None:
        """Write a tick, with its turn and the simulation's truth. Never raises."""
        self._ticks += 1
        record = None
        try:
            battery_v = tick.telemetry.battery_v
            if battery_v >= NO_BATTERY_READING_V:
                self._battery_min_v = min(battery_v, self._battery_min_v or battery_v)
            position_m, miss_m = (None, None) if self.truth is None else self.truth()
            record = tick_record(tick, position_m, miss_m)
            self.write(record)
        except Exception as error:  # any error: only this record is lost
            self._unmade += 1
            self._remember_unencodable(error)
        self.turn(tick.record)
        if self.recorder is not None and record is not None:
            self.recorder.write_tick(record)

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one tick record (`perchctl.record.fields.tick_record`). Never raises."""
        self._put(partial(encode_line, {"kind": "tick", **record}), record["t_s"])

    def turn(self, turn: TickRecord) -> None:
        """Append the exact record of a turn (`turn_line`). Never raises an exception."""
        self._put(partial(turn_line, turn), turn.t_s)

    def sent(self, sent: SentCommand) -> None:
        """Append the exact record of a command that was sent outside of loop turns. May be called
        from any thread. Never raises an exception."""
        self._put(partial(sent_line, sent), sent.t_s)

    def event(self, event: Event) -> None:
        """Append an event (`perchctl.record.fields.event_record`). Never raises."""
        try:
            line = partial(encode_line, {"kind": "event", **event_record(event)})
            self._put(line, event.t_s)
        except Exception as error:  # any error: only this record is lost
            self._unmade += 1
            self._remember_unencodable(error)

    def note_detached(self, reason: str) -> None:
        """Record that the flight writes no more records, because writing one raised an
        exception."""
        self._remember(reason)

    def close(
        self, report: FlightReport | None = None, miss_m: float | None = None, fell: bool = False
    ) -> FlightSummary | None:
        """Write the summary and close. Without a report, that is, if the flight raised an
        exception, only close. Return the summary."""
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
            locked=report.is_locked_by_supervisor,
            fell=fell,
            findings=report.findings,
            contact=report.gear_to_target_at_last_contact,
            touchdown=report.touchdown,
            hover=report.hover,
            simulated=self.simulated,
            is_profile_suspect=report.is_profile_suspect,
        )
        self.end(summary.as_record())
        return replace(
            summary,
            lost_records=self.lost_records,
            log_problem=self.loss_reason,
            recording=self._ended_recording(),
        )

    def abandon(self, reason: str) -> None:
        """Close the log of a flight that failed; delete it if the flight never began."""
        self.end({"outcome": "failed", "reason": reason})
        self._ended_recording()
        if not self.has_begun:
            self.path.unlink(missing_ok=True)
            if self.recorder is not None:
                self.recorder.path.unlink(missing_ok=True)

    def _ended_recording(self) -> RecordingEnd | None:
        return None if self.recorder is None else self.recorder.close()

    def end(self, summary: Mapping[str, Any] | None = None) -> None:
        """Append the summary, if any, and close. Never raises an exception; a second call does
        nothing.

        Waits at most `LOG_CLOSE_TIMEOUT_S` for the disk."""
        if self._closed:
            return
        self._closed = True
        last = partial(self._end, summary)
        self._unfinished = self._writer.finish(last, LOG_CLOSE_TIMEOUT_S)
        if self._unfinished:
            self._remember(NO_ANSWER)

    def _put(self, line: Callable[[], bytes], t_s: float) -> None:
        if not self._closed and not self._writer.put(partial(self._record, line, t_s)):
            self._remember(NO_ROOM)

    # --- Run by the writer thread, or in lockstep ---

    def _record(self, line: Callable[[], bytes], t_s: float) -> None:
        self._store(line)
        self._synced_s = min(self._synced_s, t_s)
        if t_s - self._synced_s >= FSYNC_PERIOD_S:
            self._synced_s = t_s
            self._sync_to_disk()

    def _store(self, line: Callable[[], bytes]) -> None:
        try:
            self._file.write(line())
        except OSError as error:
            self._failed += 1
            self._remember(_explain(error))
        except Exception as error:  # any error: the thread must not end because of one record
            self._failed += 1
            self._remember_unencodable(error)

    def _end(self, summary: Mapping[str, Any] | None) -> None:
        if summary is not None:
            # Even if waiting for the disk timed out, all earlier records have been written by now.
            problem = None if self.problem == NO_ANSWER else self.problem
            lost_records = self._writer.refused_jobs + self._failed + self._unmade
            lost = {"lost_records": lost_records, "problem": problem or self.unencodable}
            self._store(partial(encode_line, {"kind": "summary", **summary, **lost}))
        self._sync_to_disk()
        with suppress(OSError):
            self._file.close()

    def _sync_to_disk(self) -> None:
        try:
            self._file.flush()
        except OSError as error:
            self._remember(_explain(error))

    def _remember(self, problem: str) -> None:
        self.problem = self.problem or problem

    def _remember_unencodable(self, error: Exception) -> None:
        why = str(error) or type(error).__name__
        self.unencodable = (
            self.unencodable or f"a record cannot be encoded for the flight log: {why}"
        )


def sent_line(sent: SentCommand) -> bytes:
    """One exact line of the log for a command that was sent outside of loop turns."""
    return json_line({"kind": "sent", **to_exact_json(sent)})


def turn_line(turn: TickRecord) -> bytes:
    """One exact line of the log for a turn, with the fields of `perchctl.mission.TickRecord`."""
    record = {"kind": "turn", **to_exact_json(turn)}
    obs, samples = turn.observation, turn.inputs.late_samples or turn.inputs.samples
    if obs is not None and samples and obs.telemetry is samples[-1]:
        del record["observation"]["telemetry"]  # already contained in the same line
    return json_line(record)


def _explain(error: OSError) -> str:
    return f"the flight log cannot be written: {error.strerror or error}"


# --- Paths of a flight's files: the log, and the files next to it with the same name ---


def path_beside(log: Path | str, suffix: str) -> Path:
    """Return the path of a log, compressed or not, with another suffix, such as ``.png``."""
    path = Path(log)
    whole = path.with_suffix("") if path.suffix == ".gz" else path
    return whole.with_name(whole.stem + suffix)


def recording_path(path: Path | str) -> Path:
    """The path of the recording that belongs to a log; the path of a recording is returned
    unchanged."""
    return path_beside(path, ".mcap")


def log_path(directory: Path, profile_name: str, started: datetime) -> Path:
    """The path of a new flight's log: ``flight_<UTC yyyymmdd_hhmmss>_<profile>.jsonl``
    in the directory. A campaign names its logs ``flight_seed<seed>.jsonl``."""
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", profile_name).strip("-.") or "profile"
    return directory / f"flight_{started.astimezone(UTC):%Y%m%d_%H%M%S}_{safe[:60]}.jsonl"


def _free_names(path: Path) -> Iterator[Path]:
    for number in count(1):
        name = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
        if not recording_path(name).exists():
            yield name
