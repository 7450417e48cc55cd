"""Record images, transforms and ticks during a flight.

The flight hands over its data and continues; a separate thread encodes and writes the data. The
recording is less important than the log: lost data is counted and reported, but never makes the
vehicle land.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from google.protobuf.message import Message
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

import perchctl
from perchctl.errors import InvalidValue
from perchctl.profile import Profile
from perchctl.record.disk import BackgroundWriter, DiskFile, Job, create_file
from perchctl.record.exact import encode_line
from perchctl.record.messages import (
    CORNERS,
    FRAME,
    IMAGE,
    NS,
    TF,
    TICK,
    TICK_SCHEMA,
    corners_message,
    fixed_transforms,
    image_message,
    moving_transforms,
    to_stamp,
)
from perchctl.record.summary import RecordingEnd
from perchctl.vision import Frame

CHUNK_BYTES = 4_000_000
RECORDING_CLOSE_TIMEOUT_S = 5.0
MOST_WAITING_BYTES = 64_000_000
"""Largest amount of memory for data that waits for the disk, bytes."""
TURN_BYTES = 10_000
"""Size of a turn without its image, bytes."""
FLUSH_PERIOD_S = 1.0
RESERVE_BYTES = 200_000_000
"""Space that the recording leaves free on the disk, bytes. If the flight log runs out of space, the
vehicle may have to land."""


class Recorder:
    """Writes the recording of one flight. Only `open` raises exceptions.

    The loop calls `write_frame` and `write_tick`. If `live`, both only fill a queue; at the end of
    each loop iteration (turn), a thread writes its data while the loop sleeps. In lockstep
    everything is written at once, and nothing is dropped.

    Attributes:
        problem: None, or one sentence about the first data that is missing from the recording.
    """

    def __init__(
        self, path: Path, stream: DiskFile, header: Mapping[str, Any], profile: Profile, live: bool
    ) -> None:
        """Begin the file, with the start times in the log's header. Raises OSError."""
        self.path = path
        self.problem: str | None = None
        # Used by the loop's thread:
        self._writer = BackgroundWriter(MOST_WAITING_BYTES, "perchctl-recording", live)
        self._turn: list[Job] = []
        self._turn_bytes = TURN_BYTES
        self._pictures = 0
        self._closed = False
        # Used by the writer thread:
        self._stream = stream
        sink: Any = stream  # not all of IO[bytes], but enough for the writer
        self._mcap = Writer(sink, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._mcap.start(library=f"perchctl {perchctl.__version__}")
        self._channels: dict[str, int] = {}
        self._mounts = fixed_transforms(profile)
        self._newest_s = self._t0_s = float(header["t0_s"])
        started = header.get("started_utc")
        self._started_ns = NS * round(datetime.fromisoformat(started).timestamp()) if started else 0
        self._first_s: float | None = None
        self._most_bytes = profile.log.max_mb * 1_000_000
        self._written_bytes = self._written_pictures = 0
        self._over = False
        self._flushed_s = -math.inf
        self._flushed_pictures = 0

    @classmethod
    def open(
        cls, path: Path, header: Mapping[str, Any], profile: Profile, live: bool = False
    ) -> Recorder:
        """Begin a new file next to the log. Errors: InvalidValue, before the flight."""
        try:
            return create_file(path, live, lambda stream: cls(path, stream, header, profile, live))
        except OSError as error:
            raise InvalidValue(
                f"{path}: the recording cannot be created ({error.strerror or error}): check "
                "its disk and folder, or fly with --no-record"
            ) from None

    def write_frame(self, frame: Frame) -> None:
        """Record a frame from the source. Never raises an exception."""
        self._hand_over()  # in flight, `write_tick` does this; before take-off, there are no ticks
        self._pictures += not frame.is_repeated
        self._turn.append(partial(self._write_frame, frame))
        # A repeated frame also contains its image.
        self._turn_bytes += frame.image.nbytes + len(frame.source_jpeg or b"")

    def write_tick(self, record: Mapping[str, Any]) -> None:
        """Record a tick (`perchctl.record.fields.tick_record`), which ends a turn. Never raises an
        exception."""
        self._turn.append(partial(self._write_tick, record))
        self._hand_over()

    def close(self) -> RecordingEnd:
        """End the file and return its summary; further calls do nothing. Waits at most
        `RECORDING_CLOSE_TIMEOUT_S` for the disk. Never raises an exception."""
        if not self._closed:
            self._hand_over()
            self._closed = True
            if self._writer.finish(partial(self._attempt, self._finish), RECORDING_CLOSE_TIMEOUT_S):
                self._remember("the disk does not respond: the end of the recording is missing")
        kept = self._flushed_pictures
        return RecordingEnd(self.path.name, kept, self._pictures - kept, self.problem)

    def _hand_over(self) -> None:
        turn, size = self._turn, self._turn_bytes
        self._turn, self._turn_bytes = [], TURN_BYTES
        if turn and not self._writer.put(partial(self._attempt, *turn, self._flush), size):
            self._remember("the disk cannot keep up with the recording: parts of it are missing")

    def _remember(self, sentence: str) -> None:
        self.problem = self.problem or sentence

    # --- Run by the writer thread, or in lockstep ---

    def _attempt(self, *jobs: Job) -> None:
        if self._over:
            return
        try:
            for job in jobs:
                job()
        except Exception as error:  # no error here may affect the flight
            why = f"{type(error).__name__}: {error}"
            if isinstance(error, OSError):
                why = error.strerror or str(error)
            self._end(why)
            with suppress(OSError):
                self._stream.close()  # no index: the file ends with its last complete record

    def _write_frame(self, frame: Frame) -> None:
        number = frame.index & 0xFFFFFFFF
        about = {
            "number": frame.index,
            "t_s": frame.t_s,
            "t_arrival_s": frame.t_arrival_s,
            "repeated": frame.is_repeated,
        }
        self._newest_s, ns = frame.t_arrival_s, self._ns(frame.t_arrival_s)
        if not frame.is_repeated:
            self._add(IMAGE, ns, image_message(self._ns(frame.t_s), frame), number)
            self._written_pictures += 1
        # The times are not rounded, because a replay needs them exactly.
        self._add(FRAME, ns, json.dumps(about).encode(), number)

    def _write_tick(self, record: Mapping[str, Any]) -> None:
        t_s, exposed_s = float(record["t_s"]), record.get("frame_t_s")
        self._newest_s, ns = t_s, self._ns(t_s)
        first_s = self._first_s = t_s if self._first_s is None else self._first_s
        for mount in self._mounts:
            mount.timestamp.CopyFrom(to_stamp(ns))
        sampled_ns = self._ns(t_s - (record.get("tel_age_s") or 0.0))
        transforms = [*self._mounts, *moving_transforms(ns, sampled_ns, record)]
        self._add(TF, ns, FrameTransforms(transforms=transforms))
        shown = {**record, "t_s": t_s - first_s}
        if exposed_s is not None:
            self._add(CORNERS, ns, corners_message(self._ns(exposed_s), record))
            shown["frame_t_s"] = exposed_s - first_s
        self._add(TICK, ns, encode_line(shown)[:-1])

    def _flush(self) -> None:
        if self._newest_s - self._flushed_s < FLUSH_PERIOD_S:
            return
        self._flushed_s = self._newest_s
        self._mcap.flush()
        self._flushed_pictures = self._written_pictures
        free_bytes = self._stream.free_bytes()
        if self._written_bytes > self._most_bytes:
            self._end(
                f"it reached the limit log.max_mb in the profile, {self._most_bytes / 1e6:g} MB"
            )
        elif free_bytes < RESERVE_BYTES:
            self._end(f"the last {free_bytes / 1e6:.0f} MB of the disk are reserved for the log")
        if self._over:
            self._finish()

    def _finish(self) -> None:
        self._over = True
        self._mcap.finish()
        self._stream.flush()
        self._stream.close()
        self._flushed_pictures = self._written_pictures

    def _end(self, why: str) -> None:
        self._over = True
        self._remember(f"the recording has ended ({why}): the flight and its log continue")

    def _ns(self, t_s: float) -> int:
        """Convert a time on the loop's clock to nanoseconds since 1970; a flight in lockstep begins
        at 0. Earlier times become 0, the earliest time in MCAP."""
        return max(0, self._started_ns + round((t_s - self._t0_s) * NS))

    def _add(self, topic: str, ns: int, message: Message | bytes, sequence: int = 0) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._new_channel(topic, message)
        data = message if isinstance(message, bytes) else message.SerializeToString()
        self._mcap.add_message(channel, ns, data, ns, sequence)
        self._written_bytes += len(data)

    def _new_channel(self, topic: str, message: Message | bytes) -> int:
        if isinstance(message, bytes):
            schema = json.dumps(TICK_SCHEMA if topic == TICK else {"type": "object"}).encode()
            name = f"perchctl.{topic.rpartition('/')[2].capitalize()}"
            number = self._mcap.register_schema(name, SchemaEncoding.JSONSchema, schema)
            return self._mcap.register_channel(topic, MessageEncoding.JSON, number)
        number = register_schema(self._mcap, type(message))
        return self._mcap.register_channel(topic, MessageEncoding.Protobuf, number)
