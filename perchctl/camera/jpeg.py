"""Find the end and the declared size of a JPEG in a byte stream, and decode any image to pixels.
Pure.

Data from a radio may be damaged anywhere. If two wrong bytes declare a size of 32000x32000,
decoding takes gigabytes and minutes, so the size is checked before an image from a stream is
decoded.
"""

from __future__ import annotations

import re
import struct

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PICTURE_BYTES = 8_000_000
"""Largest size of an image in a stream, bytes. An image that is longer is dropped."""
MOST_STREAM_PX = 4096 * 4096
"""Largest number of pixels of an image in a stream: more than any flying camera has, and decoded
within 0.2 s."""

_SCAN_END = re.compile(rb"\xff[^\x00\x01\xd0-\xd7\xff]")
"""Matches the first marker after entropy-coded data; within the data, FF is only followed by 00 or
is part of a restart marker."""
_START, _END = b"\xff\xd8\xff", b"\xff\xd9"
_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
_FRAME_HEADER_CODES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Marker codes of a frame header, which contains length, precision, height and width, in this
order."""


def jpeg_end_and_size(data: bytes | bytearray) -> tuple[int, tuple[int, int]] | None:
    """Return the length of the JPEG at the start of `data`, and its width and height; None if it is
    incomplete.

    For a damaged JPEG (a marker is missing, or another image begins), return the offset of the
    damage, and (0, 0) as the size.
    """
    at, size_px, in_scan = 2, (0, 0), False
    while True:
        if in_scan:
            found = _SCAN_END.search(data, at)
            if found is None:
                return None
            at = found.start()
        if at + 2 > len(data):
            return None
        code = data[at + 1]
        if data[at] == code == 0xFF:
            at += 1  # a fill byte
            continue
        if data[at] != 0xFF or code < 0xC0 or code == _SOI:
            return at, (0, 0)
        if code == _EOI:
            return at + 2, size_px
        if at + 9 > len(data):
            return None
        if code in _FRAME_HEADER_CODES:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            size_px = width, height
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        in_scan = code == _SOS


class JpegSplitter:
    """Cuts a byte stream into whole JPEG images.

    The splitter follows the structure of the JPEGs, not the multipart headers. Wrong lengths and
    bad or missing headers therefore do no harm, and an image is complete as soon as its last byte
    arrives.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[tuple[bytes, tuple[int, int]]]:
        """Append bytes and return the images that they complete, oldest first, each as JPEG bytes
        and (width, height)."""
        self._buffer += data
        pictures: list[tuple[bytes, tuple[int, int]]] = []
        if self._buffer.find(_END, max(len(self._buffer) - len(data) - 1, 0)) < 0:
            self._bound()
            return pictures  # the new bytes do not contain the end of an image
        while (start := self._buffer.find(_START)) >= 0:
            del self._buffer[:start]
            extent = jpeg_end_and_size(self._buffer)
            if extent is None:
                break
            end, size_px = extent
            if all(size_px):
                pictures.append((bytes(self._buffer[:end]), size_px))
            # The damage may be the beginning of the next image, so the search continues from there.
            del self._buffer[:end]
        else:
            del self._buffer[:-2]  # half a start marker may be left at the end
        self._bound()
        return pictures

    def _bound(self) -> None:
        """Drop the buffered image if it exceeds the size limit before its end has arrived."""
        if len(self._buffer) > MAX_PICTURE_BYTES:
            self._buffer.clear()


SENSOR_GREY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
"""OpenCV's flags for a grey image on the sensor's grid. A camera stores how it was held as an
orientation tag for viewers; an image rotated by this tag would no longer fit the calibration."""


def decode_grey(data: bytes) -> NDArray[np.uint8] | None:
    """Decode any bytes to a grey image on the sensor's grid, ignoring the orientation tag. Returns
    None if OpenCV cannot decode them; never raises an exception."""
    if not data:
        return None  # OpenCV raises an error for an empty array
    try:
        image = cv2.imdecode(np.frombuffer(_as_stored(data), np.uint8), SENSOR_GREY)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)


_TIFF_BYTE_ORDER = {b"II*\0": "<", b"MM\0*": ">"}
_TIFF_ORIENTATION = 274


def _as_stored(data: bytes) -> bytes:
    """Return a TIFF with its orientation tag set to 1, since OpenCV's TIFF reader rotates the image
    despite the flag to ignore that tag; return any other image unchanged."""
    order = _TIFF_BYTE_ORDER.get(bytes(data[:4]))
    if order is None:
        return data
    try:
        (start,) = struct.unpack_from(f"{order}I", data, 4)
        (entries,) = struct.unpack_from(f"{order}H", data, start)
        for at in range(start + 2, start + 2 + 12 * entries, 12):
            if struct.unpack_from(f"{order}H", data, at) == (_TIFF_ORIENTATION,):
                upright = bytearray(data)
                struct.pack_into(f"{order}H", upright, at + 8, 1)
                return bytes(upright)
    except struct.error:
        pass  # damaged: OpenCV decides
    return data
