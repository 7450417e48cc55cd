"""Records a flight while it flies: pictures, transforms, ticks and events.

The flight hands over what it has and goes on: a thread of its own encodes and writes. The
recording is not the log: what it loses is counted and said, and nothing lands for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.profile import Profile
from perchctl.record.disk import BackgroundWriter, DiskFile, Job
from perchctl.record.recording_file import RecordingFile, encoded, frame_record
from perchctl.record.summary import RecordingEnd
from perchctl.vision import Frame

CLOSE_TIMEOUT_S = 5.0
MOST_WAITING_BYTES = 64_000_000
"""What may wait for the disk holds so much memory."""
TURN_BYTES = 10_000
"""Of a turn without its picture."""
FLUSH_PERIOD_S = 1.0
RESERVE_BYTES = 200_000_000
"""Left free on the disk: it is the flight log's, without which the vehicle would have to land."""


class Recorder:
    """Writes one flight's recording. Only `open` raises. `frame`, `tick` and `event` are called
    by the loop, and cost it no more than a place in a queue.

    Live, a turn is handed over at its end, with its frame: the thread works while the loop
    sleeps. Otherwise (lockstep) everything is written at once, and nothing is ever dropped.

    Attributes:
        problem: None, or one sentence about the first thing that the recording lacks.
    """

    def __init__(
        self, path: Path, stream: DiskFile, header: Mapping[str, Any], profile: Profile, live: bool
    ) -> None:
        """Begin the file. Raises OSError."""
        self.path = path
        self.problem: str | None = None
        # Of the loop's thread.
        self._writer = BackgroundWriter(MOST_WAITING_BYTES, "perchctl-recording", live)
        self._turn: list[Job] = []
        self._turn_bytes = TURN_BYTES
        self._pictures = 0
        self._closed = False
        # Of the thread that writes.
        self._file = RecordingFile(stream, header, profile)
        self._most_bytes = profile.log.max_mb * 1_000_000
        self._over = False
        self._flushed_s = -math.inf
        self._flushed_pictures = 0

    @classmethod
    def open(
        cls, path: Path, header: Mapping[str, Any], profile: Profile, live: bool = False
    ) -> Recorder:
        """Begin a new file beside the log. Errors: InvalidValue, before the flight."""
        try:
            stream = DiskFile(path, sync=live)
            try:
                return cls(path, stream, header, profile, live)
            except BaseException:
                stream.close()
                path.unlink(missing_ok=True)
                raise
        except OSError as error:
            raise InvalidValue(
                f"{path}: the recording cannot be begun ({error.strerror or error}): free the "
                f"place, or fly with --no-record"
            ) from None

    def frame(self, frame: Frame) -> None:
        """Record a frame that the source gave. Never raises."""
        self._hand_over()  # before take-off no tick does
        self._pictures += not frame.repeated
        self._turn.append(partial(self._store, frame))
        # A frame that repeats holds its picture too.
        self._turn_bytes += frame.image.nbytes + len(frame.encoded or b"")

    def event(self, record: Mapping[str, Any]) -> None:
        """Record an event (`perchctl.record.fields.event_record`). Never raises."""
        self._turn.append(partial(self._file.event, record))

    def tick(self, record: Mapping[str, Any]) -> None:
        """Record a tick (`perchctl.record.fields.tick_record`), which ends a turn. Never raises."""
        self._turn.append(partial(self._file.tick, record))
        self._hand_over()

    def close(self) -> RecordingEnd:
        """End the file and return what became of it; a second call only returns that. Waits for a
        disk that hangs, but for `CLOSE_TIMEOUT_S` at most. Never raises."""
        if not self._closed:
            self._hand_over()
            self._closed = True
            if self._writer.finish(partial(self._attempt, self._finish), CLOSE_TIMEOUT_S):
                self._remember("the disk does not answer: the recording lacks its end")
        kept = self._flushed_pictures
        return RecordingEnd(self.path, kept, self._pictures - kept, self.problem)

    def _hand_over(self) -> None:
        turn, size = self._turn, self._turn_bytes
        self._turn, self._turn_bytes = [], TURN_BYTES
        if turn and not self._writer.put(partial(self._attempt, *turn, self._flush), size):
            self._remember("the disk does not keep up with the recording: parts of it are missing")

    def _remember(self, sentence: str) -> None:
        self.problem = self.problem or sentence

    # The thread that writes, or lockstep.

    def _attempt(self, *jobs: Job) -> None:
        """Do the jobs unless the recording has ended; it ends with one that fails."""
        if self._over:
            return
        try:
            for job in jobs:
                job()
        except Exception as error:  # whatever it is, it is no matter of the flight's
            why = f"{type(error).__name__}: {error}"
            if isinstance(error, OSError):
                why = error.strerror or str(error)
            self._end(why)
            self._file.close()

    def _store(self, frame: Frame) -> None:
        self._file.frame(frame_record(frame), None if frame.repeated else encoded(frame))

    def _flush(self) -> None:
        """Bring to the disk, once a second, what was written; end a recording that is too large."""
        file = self._file
        if file.newest_s - self._flushed_s < FLUSH_PERIOD_S:
            return
        self._flushed_s = file.newest_s
        file.flush()
        self._flushed_pictures = file.pictures
        free_bytes = file.free_bytes()
        if file.size_bytes > self._most_bytes:
            self._end(f"it is full: log.max_mb in the profile is {self._most_bytes / 1e6:g}")
        elif free_bytes < RESERVE_BYTES:
            self._end(f"its disk's last {free_bytes / 1e6:.0f} MB are left to the log")
        if self._over:
            file.finish()

    def _finish(self) -> None:
        self._file.finish()
        self._flushed_pictures = self._file.pictures
        self._over = True

    def _end(self, why: str) -> None:
        self._over = True
        self._remember(f"the recording has ended ({why}): the flight and its log go on")
