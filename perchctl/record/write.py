"""The flight log: append-only JSON lines, readable after any crash.

Line 1 is the header; then a `tick` and a `turn` record for each turn of the loop (the one
rounded, for people and plots, the other exact and whole), `event` records between them, and one
`summary` at the end. `sent` records hold what went to the vehicle in the loop's place. A flight is
never troubled by its log: in real time a thread of its own writes it, and a write that fails is
remembered in `FlightLogWriter.problem`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Self

from perchctl.errors import InvalidValue
from perchctl.mission import Event, SentCommand, Turn
from perchctl.record.disk import BackgroundWriter, DiskFile, begin_file
from perchctl.record.exact import encode, json_line, to_exact
from perchctl.record.fields import event_record

FSYNC_PERIOD_S = 1.0
CLOSE_TIMEOUT_S = 3.0
MOST_WAITING = 3000
"""Records that may wait for the disk, half a minute of a flight at 50 Hz; more are dropped."""
NO_ANSWER = "the disk does not answer: the flight log lacks its end"
NO_ROOM = "the disk does not keep up with the flight log: records are dropped"


class FlightLogWriter:
    """Writes one flight. Only `open` raises; afterwards look at `problem`.

    Attributes:
        path: the file; `open` adds ``_2``, ``_3``... rather than overwrite one.
        problem: None, or one sentence about the first failure of the disk.
        formless: None, or one sentence about the first record that no line could be made of. It
            alone is lost: the disk is well, and nothing lands for it.
    """

    def __init__(self, path: Path, header_line: bytes, live: bool, file: DiskFile) -> None:
        """Write the header into a new file. Raises OSError."""
        file.write(header_line)
        self.path = path
        self.problem: str | None = None
        self.formless: str | None = None
        self._file = file
        self._writer = BackgroundWriter(MOST_WAITING, "perchctl-log", live)
        self._closed = False
        self._unfinished = 0
        # Below: of the thread that writes.
        self._failed = 0
        self._synced_s = math.inf

    @property
    def lost_records(self) -> int:
        """How many records could not be written."""
        return self._writer.refused + self._failed + self._unfinished

    @property
    def lacks(self) -> str | None:
        """One sentence why the log is not whole, the disk first; None for a whole one."""
        return self.problem or self.formless

    @classmethod
    def open(cls, path: Path, header: Mapping[str, Any], live: bool = False) -> Self:
        """Create the file and its folder and write the header.

        `live` (for flights in real time): a thread of its own writes, and brings the records
        to the disk about once a second of the loop's time; otherwise each record is in the
        file at once. Raises InvalidValue when the file cannot be created: that is before the
        flight, where refusing costs nothing.
        """
        # A replay flies by the profile in the header, so no number of it is rounded.
        line = json_line(to_exact({k: v for k, v in header.items() if v is not None}))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            for free in _free_names(path):
                with suppress(FileExistsError):
                    return begin_file(free, live, partial(cls, free, line, live))
            raise AssertionError("unreachable")
        except OSError as error:
            raise InvalidValue(
                f"{path}: the flight log cannot be created ({error.strerror or error}): free the "
                f"place, or name another folder with --log-dir, or in the profile (log.directory)"
            ) from None

    def write(self, record: Mapping[str, Any]) -> None:
        """Append one tick record (`perchctl.record.fields.tick_record`). Never raises."""
        self._put(partial(encode, {"kind": "tick", **record}), record["t_s"])

    def turn(self, turn: Turn) -> None:
        """Append a whole turn, exactly (`turn_line`). Never raises."""
        self._put(partial(turn_line, turn), turn.t_s)

    def sent(self, sent: SentCommand) -> None:
        """Append what was sent in the loop's place, exactly; from any thread. Never raises."""
        self._put(partial(sent_line, sent), sent.t_s)

    def event(self, event: Event) -> None:
        """Append an event (`perchctl.record.fields.event_record`). Never raises."""
        self._put(partial(encode, {"kind": "event", **event_record(event)}), event.t_s)

    def end(self, summary: Mapping[str, Any] | None = None) -> None:
        """Append the summary, if there is one, and close. Never raises; a second call does
        nothing.

        Waits for a disk that hangs, but for `CLOSE_TIMEOUT_S` at most."""
        if self._closed:
            return
        self._closed = True
        last = partial(self._end, summary)
        self._unfinished = self._writer.finish(last, CLOSE_TIMEOUT_S)
        if self._unfinished:
            self._remember(NO_ANSWER)

    def _put(self, line: Callable[[], bytes], t_s: float) -> None:
        if not self._closed and not self._writer.put(partial(self._record, line, t_s)):
            self._remember(NO_ROOM)

    # The thread that writes, or lockstep.

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
        except Exception as error:  # whatever it is: the thread outlives its record
            self._failed += 1
            why = str(error) or type(error).__name__
            self.formless = self.formless or f"a record has no form in the flight log: {why}"

    def _end(self, summary: Mapping[str, Any] | None) -> None:
        if summary is not None:
            lost_records = self._writer.refused + self._failed
            lost = {"lost_records": lost_records, "problem": self.lacks}
            self._store(partial(encode, {"kind": "summary", **summary, **lost}))
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


# --- where a flight's files lie: the log, and what is beside it by its name ---


def path_beside(log: Path | str, suffix: str) -> Path:
    """Return the path of a log, packed or not, with another ending, such as ``.png``."""
    path = Path(log)
    whole = path.with_suffix("") if path.suffix == ".gz" else path
    return whole.with_name(whole.stem + suffix)


def recording_path(path: Path | str) -> Path:
    """Return the recording's path, by the log's or by its own."""
    return path_beside(path, ".mcap")


def log_path(directory: Path, profile_name: str, started: datetime) -> Path:
    """Return the path of a flight that starts now: ``flight_<UTC yyyymmdd_hhmmss>_<profile>.jsonl``
    in the directory. A campaign names its logs ``flight_seed<seed>.jsonl``."""
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", profile_name).strip("-.") or "profile"
    return directory / f"flight_{started.astimezone(UTC):%Y%m%d_%H%M%S}_{safe[:60]}.jsonl"


def _free_names(path: Path) -> Iterator[Path]:
    """Yield the path, then with ``_2``, ``_3``...; none beside which there is a recording."""
    for number in count(1):
        name = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
        if not recording_path(name).exists():
            yield name
