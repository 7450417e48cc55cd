"""Reading an MCAP file from its beginning, as far as it goes: a killed flight's has no index."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lz4.frame import LZ4FrameDecompressor
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from zstandard import ZstdDecompressor, ZstdError

from perchctl.errors import InvalidValue, NotFound

MOST_CHUNK_BYTES = 64_000_000
"""Of a record, and of what a chunk unfolds to: a flight's has 4 MB and one picture. A few bytes
may unfold to gigabytes."""
_TORN = (McapError, ValueError, RuntimeError, struct.error, UnicodeDecodeError, ZstdError)
"""What the libraries raise for a record that is cut or damaged; lz4's errors among them."""


@dataclass(frozen=True)
class Walked:
    """One message as it lies in the file."""

    topic: str
    sequence: int
    log_ns: int
    data: bytes


def walk(path: Path, topics: Sequence[str]) -> Iterator[Walked]:
    """The messages of the topics in the file's order, up to its end or its first torn record.

    Errors: NotFound where there is no file, InvalidValue where it is no MCAP file.
    """
    names: dict[int, str] = {}
    for record in _records(path):
        if isinstance(record, Channel):
            names[record.id] = record.topic
        elif isinstance(record, Message) and names.get(record.channel_id) in topics:
            yield Walked(names[record.channel_id], record.sequence, record.log_time, record.data)


def _unfolded(path: Path, chunk: Chunk) -> Chunk:
    """The chunk without compression. Errors: InvalidValue where it is too large; those of
    `_TORN`."""
    if chunk.compression == "lz4":
        unpacker = LZ4FrameDecompressor()
        data = unpacker.decompress(chunk.data, max_length=MOST_CHUNK_BYTES + 1)
    elif chunk.compression == "zstd":
        with ZstdDecompressor().stream_reader(chunk.data) as reader:
            data = reader.read(MOST_CHUNK_BYTES + 1)
    else:
        data = chunk.data
    if len(data) > MOST_CHUNK_BYTES:
        raise _too_large(path)
    if len(data) != chunk.uncompressed_size:
        raise EndOfFile
    return replace(chunk, compression="", data=data)


def _too_large(path: Path) -> InvalidValue:
    return InvalidValue(
        f"{path}: a part of it has more than {MOST_CHUNK_BYTES / 1e6:g} MB, and no recording of "
        f"perchctl has so much in one: take the original"
    )


def _records(path: Path) -> Iterator[McapRecord]:
    try:
        stream = path.open("rb")
    except FileNotFoundError:
        raise NotFound(
            f"recording {path} does not exist: a flight is recorded with --record"
        ) from None
    except OSError as error:
        raise NotFound(f"recording {path} cannot be read: {error.strerror}") from None
    with stream:
        reader = StreamReader(
            stream, validate_crcs=True, emit_chunks=True, record_size_limit=MOST_CHUNK_BYTES
        )
        records = iter(reader.records)
        first = True
        while True:
            inner: Sequence[McapRecord] = ()
            try:
                record = next(records)
                if isinstance(record, Chunk):
                    inner = breakup_chunk(_unfolded(path, record), validate_crc=True)
            except StopIteration:
                return
            except RecordLengthLimitExceeded as error:
                left_bytes = path.stat().st_size - stream.tell()
                stream.seek(-8, os.SEEK_CUR)
                if int.from_bytes(stream.read(8), "little") > left_bytes:
                    return  # torn: it leads behind the file's end
                raise _too_large(path) from error
            except (InvalidMagic, *_TORN) as error:
                if first:
                    raise InvalidValue(
                        f"{path} is no recording: it does not begin as an MCAP file does"
                    ) from error
                return
            first = False
            yield from inner or (record,)
