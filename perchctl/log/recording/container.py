"""The MCAP file of a recording: topics, schemas, chunks, and a disk that may fail.

The messages are Foxglove's protobuf ones, with the definitions of Foxglove's own package: a
picture stays the bytes that it came as, which the JSON variant of the same schemas would make a
third longer. What is perchctl's own is JSON.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from google.protobuf.message import Message
from mcap.data_stream import RecordBuilder
from mcap.records import DataEnd, Footer
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from mcap_protobuf.schema import register_schema

import perchctl
from perchctl.log.recording.shapes import SCHEMAS

CHUNK_BYTES = 4_000_000


class Stream(Protocol):
    """What a container is written to. All but `tell` may raise OSError."""

    def write(self, data: bytes) -> int: ...

    def tell(self) -> int: ...

    def flush(self) -> None: ...

    def free_bytes(self) -> int: ...

    def close(self) -> None: ...


class DiskStream:
    """A file that holds whole records only: a write that fails leaves nothing of itself."""

    def __init__(self, path: Path, sync: bool = True) -> None:
        """A new file; `sync`: what is flushed is on the disk, not only with the system.
        Raises OSError, where one is there already, too."""
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
        self._fd = os.open(path, flags, 0o644)
        self._path = path
        self._sync = sync
        self._good_bytes = 0

    def write(self, data: bytes) -> int:
        done = 0
        view = memoryview(data)
        try:
            while done < len(data):
                done += os.write(self._fd, view[done:])
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, self._good_bytes)
                os.lseek(self._fd, self._good_bytes, os.SEEK_SET)
            raise
        self._good_bytes += done
        return done

    def tell(self) -> int:
        return self._good_bytes

    def flush(self) -> None:
        if not self._sync:
            return
        try:
            os.fsync(self._fd)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a pipe, a special file
                raise

    def free_bytes(self) -> int:
        return shutil.disk_usage(self._path).free

    def close(self) -> None:
        os.close(self._fd)


class Container:
    """Messages in, chunks out. Every method but `give_up` may raise OSError."""

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)  # type: ignore[arg-type]
        self._channels: dict[str, int] = {}
        self._pending_bytes = 0
        self._closed = False
        self._writer.start(library=f"perchctl {perchctl.__version__}")

    @property
    def size_bytes(self) -> int:
        """On the disk, with what waits for it, as far as it is known."""
        return self._stream.tell() + self._pending_bytes

    def say(self, topic: str, ns: int, message: Message, sequence: int = 0) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            schema = register_schema(self._writer, type(message))
            channel = self._writer.register_channel(topic, MessageEncoding.Protobuf, schema)
            self._channels[topic] = channel
        self._add(channel, ns, message.SerializeToString(), sequence)

    def say_json(self, topic: str, ns: int, data: bytes, sequence: int = 0) -> None:
        """A message of one of `SCHEMAS`."""
        channel = self._channels.get(topic)
        if channel is None:
            name, schema = SCHEMAS[topic]
            text = json.dumps(schema).encode()
            number = self._writer.register_schema(name, SchemaEncoding.JSONSchema, text)
            channel = self._writer.register_channel(topic, MessageEncoding.JSON, number)
            self._channels[topic] = channel
        self._add(channel, ns, data, sequence)

    def attach(self, name: str, ns: int, data: Any) -> None:
        """A JSON file in the file."""
        text = json.dumps(data).encode()
        self._writer.add_attachment(ns, ns, name, "application/json", text)

    def flush(self) -> None:
        """What was said so far is on the disk when this returns."""
        self._writer.flush()
        self._pending_bytes = 0

    def free_bytes(self) -> int:
        return self._stream.free_bytes()

    def finish(self) -> None:
        """With the index; nothing can be said any more."""
        self._writer.finish()
        self._stream.flush()
        self._closed = True
        self._stream.close()

    def give_up(self) -> None:
        """End the file where its last whole record ends, without an index: the disk failed.
        One that was ended stays as it is."""
        if self._closed:
            return
        self._closed = True
        end = RecordBuilder()
        DataEnd(0).write(end)
        Footer(summary_start=0, summary_offset_start=0, summary_crc=0).write(end)
        with suppress(OSError):
            self._stream.write(end.end() + MCAP0_MAGIC)
            self._stream.flush()
        with suppress(OSError):
            self._stream.close()

    def _add(self, channel: int, ns: int, data: bytes, sequence: int) -> None:
        before = self._stream.tell()
        self._writer.add_message(channel, ns, data, ns, sequence)
        self._pending_bytes += len(data)
        if self._stream.tell() != before:  # a chunk was full
            self._pending_bytes = 0
