"""The pictures of a flight, out of its recording."""

from __future__ import annotations

import json
import zlib
from collections.abc import Container, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from numpy.typing import NDArray

from perchctl.camera import decode_picture
from perchctl.errors import InvalidValue
from perchctl.log.recording.messages import FRAME, IMAGE
from perchctl.log.recording.walk import Walked, walk


class Picture(NamedTuple):
    """One frame: its number and time of exposure on the loop's clock, as the source gave
    them, and the grey picture (height, width) that the pipeline saw."""

    number: int
    t_s: float
    image: NDArray[np.uint8]


def pictures_in(
    path: Path, exact: bool, numbers: Container[int] | None = None
) -> Iterator[Picture]:
    """As `perchctl.log.recording.recorded_pictures`, of the recording itself."""
    data: Walked | None = None
    for each in walk(path, (IMAGE, FRAME)):
        if each.topic == IMAGE:
            data = each
        elif data is not None and data.sequence == each.sequence:
            frame = json.loads(each.data)
            if numbers is None or frame["number"] in numbers:
                yield _picture(path, data, frame, exact)
            data = None


def _picture(path: Path, data: Walked, frame: dict[str, Any], exact: bool) -> Picture:
    try:
        grey = decode_picture(CompressedImage.FromString(data.data).data)
    except ValueError as error:
        raise InvalidValue(f"{path}: picture {frame['number']} {error}") from None
    if exact and zlib.crc32(grey.data) != frame["crc32"]:
        raise InvalidValue(
            f"{path}: picture {frame['number']} decodes to other pixels here than in the flight: "
            f"another version of OpenCV decoded it there"
        )
    return Picture(frame["number"], frame["t_s"], grey)
