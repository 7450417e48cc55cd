"""The flight log: append-only JSON lines, readable after any crash.

Line 1 is the header; then a `tick` and a `turn` record for each turn of the loop (the one
rounded, for people and plots, the other exact and whole), `event` records between them, and one
`summary` at the end, followed by what became of the `recording`. `sent` records hold what went to
the vehicle in the loop's place. A flight is never troubled by its
log: in real time a thread of its own writes it, and a write that fails is remembered
in `FlightLogWriter.problem`.
"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.mission import Event, SentCommand, Turn
from perchctl.record.disk import BackgroundWriter, DiskFile
from perchctl.record.exact import encode, json_line, to_exact
from perchctl.record.fields import event_record

FSYNC_PERIOD_S = 1.0
RETRY_PERIOD_S = 1.0
CLOSE_TIMEOUT_S = 3.0
BEHIND_S = 30.0
"""Of a flight may wait for the disk; more is dropped."""
RECORDS_A_TURN = 2
TURNS_SHARE = 0.8
"""Of the queue, beyond which turns are dropped: what is left is for ticks and events."""
DEFAULT_LOOP_HZ = 50.0
NO_ANSWER = "the disk does not answer: the flight log lacks its end"


class FlightLogWriter:
    """Writes one flight. Only `open` raises; afterwards look at `problem`.

    Attributes:
        path: the file; `open` adds ``_2``, ``_3``... rather than overwrite one.
        problem: None, or one sentence about the first failure of the disk.
        formless: None, or one sentence about the first record that no line could be made of. It
            alone is lost: the disk is well, and nothing lands for it.
        lost_records: how many could not be written.
    """

    def __init__(self, path: Path, file: DiskFile, writer: BackgroundWriter) -> None:
        self.path = path
        self.problem: str | None = None
        self.formless: str | None = None
        self._file = file
        self._writer = writer
        self._closed = self._concluded = False
        self._dropped = 0  # by the loop's thread, and by the link's
        self._dropping = threading.Lock()
        # Below: of the thread that writes.
        self._failed = 0
        self._synced_s: float | None = None
        self._failed_s: float | None = None

    @property
    def lost_records(self) -> int:
        return self._dropped + self._failed

    @property
    def lacks(self) -> str | None:
        """One sentence why the log is not whole, the disk first; None for a whole one."""
        return self.problem or self.formless

    @classmethod
    def open(
        cls,
        path: Path,
        header: Mapping[str, Any],
        live: bool = False,
        none_beside: tuple[str, ...] = (),
        loop_hz: float = DEFAULT_LOOP_HZ,
    ) -> FlightLogWriter:
        """Create the file and its folder and write the header.

        `none_beside`: suffixes of files of the same name that must not be there, either.

        `live` (for flights in real time): a thread of its own writes, and brings the records
        to the disk about once a second of the loop's time; otherwise each record is in the
        file at once. `loop_hz`: how fast turns come. Raises InvalidValue when the file cannot
        be created: that is before the flight, where refusing costs nothing.
        """
        make_log_folder(path.parent)
        try:
            file, free = new_file(path, none_beside, live)
        except OSError as error:
            raise InvalidValue(cannot_start(path, error)) from None
        try:
            file.write(_header_line(header))
            most = math.ceil(BEHIND_S * RECORDS_A_TURN * loop_hz)
            # Last: a thread would be left behind by what fails after it.
            return cls(free, file, BackgroundWriter(most, "perchctl-log", live))
        except BaseException as error:
            file.close()
            free.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise InvalidValue(cannot_start(path, error)) from None
            raise

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one tick record (`perchctl.record.fields.tick_record`). Never raises."""
        self._put(partial(encode, {"kind": "tick", **record}), record["t_s"])

    def turn(self, turn: Turn) -> None:
        """Append a whole turn, exactly (`turn_line`). Never raises."""
        self._put(partial(turn_line, turn), turn.t_s, TURNS_SHARE)

    def sent(self, sent: SentCommand) -> None:
        """Append what was sent in the loop's place, exactly; from any thread. Never raises."""
        self._put(partial(sent_line, sent), sent.t_s)

    def event(self, event: Event) -> None:
        """Append an event (`perchctl.record.fields.event_record`). Never raises."""
        self._put(partial(encode, {"kind": "event", **event_record(event)}), event.t_s)

    def conclude(self, summary: Mapping[str, Any]) -> None:
        """Append the summary and bring it to the disk; live, the thread does so while the caller
        goes on. Nothing but `close` may follow. Never raises."""
        if not self._closed and not self._concluded:
            self._concluded = True
            self._writer.put(partial(self._summarise, summary), math.inf)

    def close(
        self,
        summary: Mapping[str, Any] | None = None,
        recording: Mapping[str, Any] | None = None,
    ) -> None:
        """Append the summary, if there is one, and what became of a recording, and close. Never
        raises; a second call does nothing.

        Waits for a disk that hangs, but for `CLOSE_TIMEOUT_S` at most."""
        if self._closed:
            return
        if summary is not None:
            self.conclude(summary)
        self._closed = True
        end = partial(self._end, recording)
        left = self._writer.finish(end, CLOSE_TIMEOUT_S, self._release_file)
        if left:
            self._drop(left - 1)  # the end itself is no record
            self._remember(NO_ANSWER)

    def _summarise(self, summary: Mapping[str, Any]) -> None:
        lost = {"lost_records": self.lost_records, "problem": self.lacks}
        self._failed_s = None  # one last try, whatever happened before
        self._store(partial(encode, {"kind": "summary", **summary, **lost}), None)
        self._sync_to_disk()

    def _end(self, recording: Mapping[str, Any] | None) -> None:
        if recording is not None:
            self._store(partial(encode, {"kind": "recording", **recording}), None)
        self._sync_to_disk()
        self._release_file()

    def _release_file(self) -> None:
        with suppress(OSError):
            self._file.close()

    def _drop(self, count: int = 1) -> None:
        with self._dropping:
            self._dropped += count

    def _put(self, line: Callable[[], bytes], t_s: float, share: float = 1.0) -> None:
        if self._closed or self._concluded:
            self._drop()
        elif not self._writer.put(partial(self._store, line, t_s), share):
            self._drop()
            self._remember("the disk does not keep up with the flight log: records are dropped")

    def _store(self, line: Callable[[], bytes], t_s: float | None) -> None:
        if self._is_waiting(t_s):
            self._failed += 1
            return
        try:
            self._file.write(line())
        except OSError as error:
            self._failed += 1
            self._failed_s = t_s
            self._remember(_explain(error))
            return
        except Exception as error:  # whatever it is: the thread outlives its record
            self._failed += 1
            self.formless = self.formless or _formless(error)
            return
        self._failed_s = None
        if t_s is not None:
            self._sync_sometimes(t_s)

    def _is_waiting(self, t_s: float | None) -> bool:
        """True shortly after a failure: a failing disk is slow, so it is left alone for a while."""
        if t_s is None or self._failed_s is None:
            return False
        return t_s - self._failed_s < RETRY_PERIOD_S

    def _sync_sometimes(self, t_s: float) -> None:
        if self._synced_s is None:
            self._synced_s = t_s
        if t_s - self._synced_s >= FSYNC_PERIOD_S:
            self._synced_s = t_s
            self._sync_to_disk()

    def _sync_to_disk(self) -> None:
        try:
            self._file.flush()
        except OSError as error:
            self._remember(_explain(error))

    def _remember(self, problem: str) -> None:
        if self.problem is None:
            self.problem = problem


def _header_line(header: Mapping[str, Any]) -> bytes:
    """Return the header as a line; a replay flies by the profile in it, so no number is rounded."""
    return json_line(to_exact({k: v for k, v in header.items() if v is not None}))


def sent_line(sent: SentCommand) -> bytes:
    """Return what was sent in the loop's place as one line of the log, exact."""
    return json_line({"kind": "sent", **to_exact(sent)})


def turn_line(turn: Turn) -> bytes:
    """Return a turn as one line of the log, whole and exact, by the fields of
    `perchctl.mission.Turn`."""
    record = {"kind": "turn", **to_exact(turn)}
    obs, samples = turn.observation, turn.taken.late or turn.taken.samples
    if obs is not None and samples and obs.telemetry is samples[-1]:
        del record["observation"]["telemetry"]  # it stands in the same line already
    return json_line(record)


def _explain(error: OSError) -> str:
    return f"the flight log cannot be written: {error.strerror or error}"


def _formless(error: Exception) -> str:
    return f"a record has no form in the flight log: {str(error) or type(error).__name__}"


# --- where a flight's files lie: the log, and what is beside it by its name ---------------------

PACKED = ".gz"
_ELSEWHERE = "name another folder with --log-dir, or in the profile (log.directory)"


def path_beside(log: Path | str, suffix: str) -> Path:
    """Return the path of a log, packed or not, with another ending, such as ``.png``."""
    path = Path(log)
    whole = path.with_suffix("") if path.suffix == PACKED else path
    return whole.with_name(whole.stem + suffix)


def log_path(directory: Path, profile_name: str, started: datetime) -> Path:
    """Return the path of a flight that starts now: ``flight_<UTC yyyymmdd_hhmmss>_<profile>.jsonl``
    in the directory. A campaign names its logs ``flight_seed<seed>.jsonl``."""
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", profile_name).strip("-.") or "profile"
    return directory / f"flight_{started.astimezone(UTC):%Y%m%d_%H%M%S}_{safe[:60]}.jsonl"


def make_log_folder(directory: Path) -> None:
    """Make the folder where it is missing. Errors: InvalidValue."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "it is a file" if directory.is_file() else error.strerror or str(error)
        raise InvalidValue(f"{directory} cannot hold flight logs ({why}): {_ELSEWHERE}") from None


def new_file(path: Path, none_beside: tuple[str, ...], sync: bool) -> tuple[DiskFile, Path]:
    """Create a file that did not exist before, by `path`'s name or the next free one;
    `none_beside` are suffixes of files of the same name that must not be there, either. Raises
    OSError."""
    for number in count(1):
        free = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
        if any(path_beside(free, suffix).exists() for suffix in none_beside):
            continue
        with suppress(FileExistsError):
            return DiskFile.new(free, sync), free
    raise AssertionError("unreachable")


def cannot_start(path: Path, error: OSError) -> str:
    return (
        f"{path}: the flight log cannot be created ({error.strerror or error}): free the place, "
        f"or {_ELSEWHERE}"
    )


RECORDING_SUFFIX = ".mcap"


def recording_path(path: Path | str) -> Path:
    """Return the recording's path, by the log's or by its own."""
    return path_beside(path, RECORDING_SUFFIX)
