"""The pictures of a flight, out of its recording: read from the beginning, as far as the file goes,
as a killed flight's has no index."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Container, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from lz4.frame import LZ4FrameDecompressor
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from numpy.typing import NDArray
from zstandard import ZstdDecompressor, ZstdError

from perchctl.camera import decode_picture
from perchctl.errors import InvalidValue, NotFound
from perchctl.record.recording_file import FRAME, IMAGE
from perchctl.record.write import recording_path

MOST_CHUNK_BYTES = 64_000_000
"""Of a record, and of what a chunk unfolds to: a flight's has 4 MB and one picture. A few bytes
may unfold to gigabytes."""
_TORN = (McapError, ValueError, RuntimeError, struct.error, UnicodeDecodeError, ZstdError)
"""What the libraries raise for a record that is cut or damaged; lz4's errors among them."""


class Picture(NamedTuple):
    """One frame: its number and time of exposure on the loop's clock, as the source gave
    them, and the grey picture (height, width) that the pipeline saw."""

    number: int
    t_s: float
    image: NDArray[np.uint8]


def recorded_pictures(
    path: Path | str, *, exact: bool = True, numbers: Container[int] | None = None
) -> Iterator[Picture]:
    """Yield the pictures `(number, t_s, image)`, oldest first, of a recording or of the log that it
    lies beside; of one that was cut off, those that are whole.

    Args:
        exact: every picture must be the flight's to the bit.
        numbers: only the frames of these, the others are not decoded; None is all.

    Errors, with the first picture: NotFound without a recording; InvalidValue where it is none,
    and where this computer's decoder makes other pixels of a JPEG than the flight's did.
    """
    path = recording_path(path)
    for frame, message in recorded_frames(path):
        if message is None or not (numbers is None or frame["number"] in numbers):
            continue
        try:
            grey = decode_picture(message.data)
        except ValueError as error:
            raise InvalidValue(f"{path}: picture {frame['number']} {error}") from None
        if exact and zlib.crc32(grey.data) != frame["crc32"]:
            raise InvalidValue(
                f"{path}: picture {frame['number']} decodes to other pixels here than in the "
                f"flight: another version of OpenCV decoded it there"
            )
        yield Picture(frame["number"], frame["t_s"], grey)


def recorded_frames(path: Path) -> Iterator[tuple[dict[str, Any], CompressedImage | None]]:
    """Yield each frame of a recording as `frame_record` has it, with its picture where it was kept.

    Errors: NotFound where there is no file, InvalidValue where it is no MCAP file.
    """
    image: Message | None = None
    for topic, message in _messages(path, (IMAGE, FRAME)):
        if topic == IMAGE:
            image = message
            continue
        is_its = image is not None and image.sequence == message.sequence
        picture = CompressedImage.FromString(image.data) if image is not None and is_its else None
        yield json.loads(message.data), picture
        image = None


def _messages(path: Path, topics: Sequence[str]) -> Iterator[tuple[str, Message]]:
    """Yield the topics' messages in the file's order, up to its end or its first torn record."""
    names: dict[int, str] = {}
    for record in _records(path):
        if isinstance(record, Channel):
            names[record.id] = record.topic
        elif isinstance(record, Message) and names.get(record.channel_id) in topics:
            yield names[record.channel_id], record


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


def _unfolded(path: Path, chunk: Chunk) -> Chunk:
    """Return the chunk without compression. Errors: InvalidValue where it is too large; those of
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
