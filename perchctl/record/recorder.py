"""Records a flight while it flies: pictures, calibration, transforms, ticks and events.

The flight hands over what it has and goes on: a thread of its own encodes and writes. The
recording is not the log: what it loses is counted and said, and nothing lands for it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.profile import Profile
from perchctl.record.disk import BackgroundWriter, DiskFile, Stream
from perchctl.record.recording_file import RecordingFile, encoded, frame_record
from perchctl.record.summary import RecordingEnd
from perchctl.vision import Frame

CLOSE_TIMEOUT_S = 5.0
MOST_BEHIND = 1500
"""Turns that may wait for the disk, half a minute of a flight."""
MOST_PICTURE_BYTES = 64_000_000
"""That the pictures among them may hold in memory."""
FLUSH_PERIOD_S = 1.0
RESERVE_BYTES = 200_000_000
"""Left free on the disk: it is the flight log's, without which the vehicle would have to land."""
GOES_ON = "the flight and its log go on"


@dataclass(eq=False)
class _Turn:
    """What one turn of the loop hands over to the thread that writes."""

    frame: Frame | None = None
    events: list[Mapping[str, Any]] = field(default_factory=list)
    tick: Mapping[str, Any] | None = None

    @property
    def held_bytes(self) -> int:
        """Bytes in memory while it waits; a frame that repeats holds its picture too."""
        frame = self.frame
        return 0 if frame is None else frame.image.nbytes + len(frame.encoded or b"")


class Recorder:
    """Writes one flight's recording. Only `open` raises. `frame`, `tick` and `event` are called
    by the loop, and cost it no more than a place in a queue.

    Live, a turn is handed over at its end, with its frame: the thread works while the loop
    sleeps. Otherwise (lockstep) everything is written at once, and nothing is ever dropped.
    """

    def __init__(
        self, path: Path, stream: Stream, header: Mapping[str, Any], profile: Profile, live: bool
    ) -> None:
        """Begin the file. Raises OSError; NotFound and InvalidValue for the calibration."""
        self.path = path
        self._most_bytes = profile.log.max_mb * 1_000_000
        self._remarks: deque[str] = deque()
        self._problem: str | None = None
        # Of the loop's thread.
        self._writer = BackgroundWriter(MOST_BEHIND, "perchctl-recording", live)
        self._turn = _Turn()
        self._pictures = 0
        self._handed_bytes = 0
        self._closed = False
        # Of the thread that writes.
        self._file = RecordingFile(stream, header, profile)
        self._over = self._full = False
        self._done_bytes = 0
        self._flushed_s: float | None = None
        self._flushed_pictures = 0

    @classmethod
    def open(
        cls, path: Path, header: Mapping[str, Any], profile: Profile, live: bool = False
    ) -> Recorder:
        """Begin a new file beside the log. Errors: NotFound, InvalidValue, before the flight."""
        try:
            stream = DiskFile.new(path, sync=live)
        except OSError as error:
            raise _cannot_begin(path, error) from None
        try:
            return cls(path, stream, header, profile, live)
        except BaseException as error:
            stream.close()
            path.unlink(missing_ok=True)
            if isinstance(error, OSError):
                raise _cannot_begin(path, error) from None
            raise

    def frame(self, frame: Frame) -> None:
        """Record a frame that the source gave. Never raises."""
        if self._closed:
            return
        self._pictures += not frame.repeated
        if self._turn.frame is not None:  # before take-off no tick hands it over
            self._hand_over()
        self._turn.frame = frame

    def event(self, record: Mapping[str, Any]) -> None:
        """Record an event (`perchctl.record.fields.event_record`). Never raises."""
        if not self._closed:
            self._turn.events.append(record)

    def tick(self, record: Mapping[str, Any]) -> None:
        """Record a tick (`perchctl.record.fields.tick_record`), which ends a turn. Never raises."""
        if not self._closed:
            self._turn.tick = record
            self._hand_over()

    def take_remarks(self) -> list[str]:
        """Return what went wrong since the last call, a sentence each, each once a flight."""
        new = []
        while self._remarks:
            new.append(self._remarks.popleft())
        return new

    def close(self) -> RecordingEnd:
        """End the file and return what became of it; a second call only returns that. Waits for a
        disk that hangs, but for `CLOSE_TIMEOUT_S` at most. Never raises."""
        if not self._closed:
            self._hand_over()
            self._closed = True
            if self._writer.finish(self._end, CLOSE_TIMEOUT_S, self._file.give_up):
                self._over = True
                self._remember("the disk does not answer: the recording lacks its end")
        kept = self._flushed_pictures
        return RecordingEnd(self.path, kept, self._pictures - kept, self._problem)

    def _hand_over(self) -> None:
        turn, self._turn = self._turn, _Turn()
        if self._over:
            return
        size = turn.held_bytes
        if self._handed_bytes - self._done_bytes + size > MOST_PICTURE_BYTES:
            turn.frame, size = None, 0
            self._note_lag("pictures are missing in it")
        self._handed_bytes += size
        if not self._writer.put(partial(self._write, turn)):
            self._handed_bytes -= size
            self._note_lag("turns are missing in it")

    def _note_lag(self, what: str) -> None:
        self._remember(f"the disk does not keep up with the recording: {what}")

    # The thread that writes, or lockstep.

    def _write(self, turn: _Turn) -> None:
        self._done_bytes += turn.held_bytes
        if self._over:
            return
        try:
            self._written(turn)
        except Exception as error:  # whatever it is, it is no matter of the flight's
            self._fail(error)

    def _written(self, turn: _Turn) -> None:
        file = self._file
        if turn.frame is not None:
            kept = None if self._full or turn.frame.repeated else encoded(turn.frame)
            if kept is not None and file.size_bytes + len(kept[0]) > self._most_bytes:
                self._full, kept = True, None
                self._remember(
                    f"the recording is full (log.max_mb in the profile, "
                    f"{self._most_bytes / 1e6:g}): it goes on without pictures"
                )
            file.frame(frame_record(turn.frame), kept)
        for event in turn.events:
            file.event(event)
        if turn.tick is not None:
            file.tick(turn.tick)
        now_s = file.newest_s
        if self._flushed_s is None or now_s - self._flushed_s >= FLUSH_PERIOD_S:
            self._flushed_s = now_s
            self._flush()

    def _flush(self) -> None:
        self._file.flush()
        self._flushed_pictures = self._file.pictures
        free = self._file.free_bytes()
        if free < RESERVE_BYTES:
            self._over = True
            self._remember(
                f"the recording has ended: {free / 1e6:.0f} MB are left on its disk, and "
                f"{RESERVE_BYTES / 1e6:.0f} are kept for the log; {GOES_ON}"
            )
            self._file.finish()

    def _fail(self, error: Exception) -> None:
        self._over = True
        why = f"{type(error).__name__}: {error}"
        if isinstance(error, OSError):
            why = error.strerror or str(error)
        self._remember(f"the recording has ended ({why}): {GOES_ON}")
        self._file.give_up()

    def _end(self) -> None:
        if self._over:
            return
        try:
            self._file.finish()
            self._flushed_pictures = self._file.pictures
        except Exception as error:
            self._fail(error)
        self._over = True

    def _remember(self, sentence: str) -> None:
        if self._problem is None:
            self._problem = sentence
            self._remarks.append(sentence)


def _cannot_begin(path: Path, error: OSError) -> InvalidValue:
    return InvalidValue(
        f"{path}: the recording cannot be begun ({error.strerror or error}): free the place, or "
        f"fly with --no-record"
    )
