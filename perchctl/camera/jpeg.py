"""A JPEG's structure: where it ends, what size it says, and its pixels; pure.

What a radio or a file delivers may be damaged anywhere. Two bytes that say a size of 32000x32000
cost a decoder gigabytes and minutes, so the size is read before anything is decoded.
"""

from __future__ import annotations

import re

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PICTURE_BYTES = 8_000_000
"""Of a picture in a stream; one that does not end within them is dropped."""
MOST_STREAM_PX = 4096 * 4096
"""Of a picture in a stream: more than any camera that flies gives, and decoded within 0.2 s."""

_START = re.compile(rb"\xff\xd8\xff[\xc0-\xcf\xda-\xff]")
"""The start of a picture, and the marker of a segment or a fill byte behind it."""
_SCAN_END = re.compile(rb"\xff[^\x00\x01\xd0-\xd7\xff]")
"""The first marker behind entropy-coded bytes, in which FF is followed by 00 or a restart."""
_NO_FILL = re.compile(rb"[^\xff]")
"""A marker's code: any number of fill bytes FF may stand in front of it."""
_MARKER = re.compile(rb"\xff[^\x00\xff]")
_SOI, _EOI, _SOS = 0xD8, 0xD9, 0xDA
_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})
"""Markers without a length."""
_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Start of frame: behind its length and precision stand height and width."""


class Damaged(Exception):
    """The bytes at a start-of-image marker are no whole JPEG; `at`: where its structure breaks."""

    def __init__(self, at: int = 0) -> None:
        super().__init__(at)
        self.at = at


class JpegWalk:
    """Follows the structure of one JPEG whose bytes come in pieces, and touches each byte once."""

    def __init__(self, start: int = 0) -> None:
        """`start`: place of the picture's first byte."""
        self.start = start
        self._at = start + 2
        self._in_scan = False

    def moved(self, by: int) -> None:
        """Shift all places after so many bytes in front of the picture were taken away."""
        self.start -= by
        self._at -= by

    def end(self, data: bytes | bytearray, until: int) -> int | None:
        """Place behind the picture's last byte; None if that does not lie before `until`.

        Raises Damaged where a segment is followed by no marker, or another picture begins.
        """
        while True:
            if self._in_scan:
                found = _SCAN_END.search(data, self._at, until)
                if found is None:
                    self._at = max(self._at, until - 1)  # half a marker may stand there
                    return None
                self._at, self._in_scan = found.start(), False
            if self._at + 2 > until:
                return None
            if data[self._at] != 0xFF:
                raise Damaged(self._at)
            found = _NO_FILL.search(data, self._at + 1, until)
            if found is None:
                self._at = until - 1
                return None
            code, behind = data[found.start()], found.end()
            if code == _EOI:
                return behind
            if code in _STANDALONE:
                self._at = behind
                continue
            if code < 0xC0 or code == _SOI:
                raise Damaged(behind - 2)
            if behind + 2 > until:
                self._at = behind - 2
                return None
            length = int.from_bytes(data[behind : behind + 2], "big")
            if length < 2:
                raise Damaged(behind)
            self._at = behind + length
            self._in_scan = code == _SOS


class JpegSplitter:
    """Cuts a byte stream into whole JPEG pictures.

    It follows the JPEG's own structure instead of the multipart headers. Wrong lengths, odd
    boundaries and missing headers therefore do no harm, and a picture is out with its last byte.
    The pictures do not depend on the pieces in which the bytes come. A damaged picture is dropped,
    and the search goes on where its structure breaks: up to 64 kB later if the damage is in a
    segment's length. So no byte is read twice. At most `MAX_PICTURE_BYTES` and one piece are held.
    `damaged` counts the pictures that were dropped.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._walk: JpegWalk | None = None
        self.damaged = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Append bytes; return the pictures that are complete now, oldest first."""
        self._buffer += data
        pictures: list[bytes] = []
        done = 0
        while (walk := self._walk or self._found(done)) is not None:
            most = walk.start + MAX_PICTURE_BYTES
            try:
                end = walk.end(self._buffer, min(len(self._buffer), most))
            except Damaged as damage:
                # The start of the next picture may be what broke this one's structure.
                done = max(damage.at - 2, walk.start + 2)
                self.damaged += 1
                self._walk = None
                continue
            if end is not None:
                pictures.append(bytes(self._buffer[walk.start : end]))
                done = end
            elif len(self._buffer) >= most:
                self.damaged += 1
                done = most
            else:
                self._walk = walk
                self._drop(walk.start)
                return pictures
            self._walk = None
        # The next start may stand half in this piece.
        self._drop(max(len(self._buffer) - 3, done))
        return pictures

    def _found(self, since: int) -> JpegWalk | None:
        found = _START.search(self._buffer, since)
        return None if found is None else JpegWalk(found.start())

    def _drop(self, count: int) -> None:
        del self._buffer[:count]
        if self._walk is not None:
            self._walk.moved(count)


def jpeg_end(data: bytes | bytearray) -> int | None:
    """Return the length of the JPEG at the start of `data`; None if it is incomplete. Raises
    Damaged."""
    return JpegWalk().end(data, len(data))


def size_in(data: bytes | bytearray) -> tuple[int, int] | None:
    """Return width and height that a JPEG says in front of its pixels; None if it says none."""
    at = 2
    # As the decoder: what is no marker is passed over.
    while (marker := _MARKER.search(data, at)) is not None:
        code, behind = data[marker.end() - 1], marker.end()
        if code in (_EOI, _SOS):
            return None
        if code in _SIZES:
            if behind + 7 > len(data):
                return None
            height = int.from_bytes(data[behind + 3 : behind + 5], "big")
            return int.from_bytes(data[behind + 5 : behind + 7], "big"), height
        if code in _STANDALONE or code == _SOI:
            at = behind
        else:
            at = behind + max(int.from_bytes(data[behind : behind + 2], "big"), 2)
    return None


def grey_pixels(data: bytes | bytearray) -> NDArray[np.uint8] | None:
    """Return the grey picture of any file's bytes; None if OpenCV cannot decode them. Whatever the
    bytes are, it raises nothing."""
    if not data:
        return None  # of an empty array OpenCV makes an error
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)
