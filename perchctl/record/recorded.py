"""Read the images of a flight from its recording. The file is read from the beginning, because the
recording of a flight that was killed has no index."""

from __future__ import annotations

import json
import struct
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.exceptions import InvalidMagic, McapError
from mcap.records import Channel, McapRecord, Message
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray
from zstandard import ZstdError

from perchctl.camera import decode_picture
from perchctl.errors import InvalidValue, NotFound
from perchctl.record.messages import FRAME, IMAGE
from perchctl.record.write import recording_path

MOST_RECORD_BYTES = 64_000_000
"""A chunk in a flight's recording contains 4 MB and one image; if a record claims to be longer than
this limit, its length is damaged."""
_TORN = (McapError, ValueError, RuntimeError, struct.error, ZstdError)
"""Exceptions that the libraries raise for a truncated or damaged record, including lz4's."""


class RecordedPicture(NamedTuple):
    """One frame: its number, its exposure time on the loop's clock as reported by the source, and
    the grey image (height, width) that the pipeline processed."""

    number: int
    t_s: float
    image: NDArray[np.uint8]


def recorded_pictures(
    path: Path | str, numbers: Container[int] | None = None
) -> Iterator[RecordedPicture]:
    """Yield the images `(number, t_s, image)`, oldest first, of a recording, or of the recording
    next to a log. A truncated last image is left out.

    If `numbers` is given, only these frames are decoded. Errors, raised when the first image is
    requested: NotFound if there is no recording; InvalidValue for any other file.
    """
    path = recording_path(path)
    for frame, message in recorded_frames(path):
        if message is None or not (numbers is None or frame["number"] in numbers):
            continue
        try:
            grey = decode_picture(message.data)
        except ValueError as error:
            raise InvalidValue(f"{path}: picture {frame['number']} {error}") from None
        yield RecordedPicture(frame["number"], frame["t_s"], grey)


def recorded_frames(path: Path) -> Iterator[tuple[dict[str, Any], CompressedImage | None]]:
    """Yield each frame's record in a recording, and its image (None if it was not stored).

    Errors: NotFound if there is no file, InvalidValue if it is not an MCAP file.
    """
    topics: dict[int, str] = {}
    image: Message | None = None
    for record in _records(path):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message) and topics.get(record.channel_id) == IMAGE:
            image = record
        elif isinstance(record, Message) and topics.get(record.channel_id) == FRAME:
            is_its = image is not None and image.sequence == record.sequence
            picture = CompressedImage.FromString(image.data) if image and is_its else None
            yield json.loads(record.data), picture
            image = None


def _records(path: Path) -> Iterator[McapRecord]:
    try:
        stream = path.open("rb")
    except FileNotFoundError:
        raise NotFound(f"recording {path} does not exist: fly with --record to make one") from None
    except OSError as error:
        raise NotFound(f"recording {path} cannot be read: {error.strerror}") from None
    with stream:
        reader = StreamReader(stream, validate_crcs=True, record_size_limit=MOST_RECORD_BYTES)
        is_empty = True
        try:
            for record in reader.records:
                is_empty = False
                yield record
        except (InvalidMagic, *_TORN) as error:
            if is_empty:
                raise InvalidValue(
                    f"{path} is not a recording: it does not begin like an MCAP file"
                ) from error
