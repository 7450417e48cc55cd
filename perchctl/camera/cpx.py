"""An AI-deck's pictures, cut out of the bytes of its TCP stream; pure.

The stream is packets of Bitcraze's CPX: 16 bits of length, which counts what follows them, then
one byte of routing, one of function, and the data. A picture is a packet with its header,
``<BHHBBI``: magic 0xBC, width, height, depth, format, size; then packets of chunks until `size`
bytes have come. Nothing has a checksum. cflib's own reader of these packets blocks for ever when
the deck goes away and cannot find its way back after a broken length, so it is not used.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

from perchctl.camera.jpeg import Damaged, jpeg_end

MAX_PACKET_BYTES = 1022
"""That a length may count: the deck's buffers hold no more (its MTU)."""
MOST_SIDE_PX = 1024
STALLED_S = 2.0
"""A picture that takes longer from its first byte to its last is dropped."""

_PACKET = struct.Struct("<HBB")
_HEADER = struct.Struct("<BHHBBI")
_MAGIC, _RAW, _JPEG = 0xBC, 0, 1
_HOST, _SENDERS, _APP = 3, (1, 2, 4), 5
_FUNCTIONS = (1, 2, 3, 4, _APP, 14, 15)
_NOT_RESERVED, _LAST_BIT = 0x7F, 0x40
_START_BYTES = _PACKET.size + _HEADER.size
_START = re.compile(
    re.escape(struct.pack("<H", 2 + _HEADER.size)) + rb"[\x00-\x7f]\x05\xbc", re.DOTALL
)
_MOST_OTHER_BYTES = 65536  # of other functions' packets amid one picture


@dataclass(frozen=True)
class CpxPicture:
    """A whole picture: `data` are a JPEG's bytes, or width x height of the raw sensor's.

    `began_s` is when its first byte came, on the clock of `CpxSplitter.feed`.
    """

    began_s: float
    width: int
    height: int
    is_jpeg: bool
    data: bytes


@dataclass(frozen=True)
class _Header:
    width: int
    height: int
    is_jpeg: bool
    size: int


class CpxSplitter:
    """Cuts the bytes into whole pictures.

    A picture counts only if its packets follow one another without a break: each a packet that
    the deck may send, chunks of one length but for the last, no other picture's header amid them,
    `size` bytes to the byte, and a JPEG whose structure ends there. Otherwise it is dropped
    (`damaged`), and the search for the next header goes on right behind its own, so a wrong
    length costs no picture but the one that it is in. Other functions' packets are passed over.
    What is held is bounded by one picture's size.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._dropped_bytes = 0  # that have left the buffer, so that a place keeps its number
        self._came: list[tuple[int, float]] = []  # up to which place, at what time
        self._header: _Header | None = None
        self._at = 0
        self._chunks: list[bytes] = []
        self._have = 0
        self._other_bytes = 0
        self.damaged = 0
        self.bytes_seen = 0
        self.pictures = 0

    def feed(self, data: bytes, t_s: float) -> list[CpxPicture]:
        """Append bytes that came at `t_s`; the pictures now complete, oldest first."""
        self._buffer += data
        self.bytes_seen += len(data)
        self._came.append((self.bytes_seen, t_s))
        pictures: list[CpxPicture] = []
        while self._header is not None or self._find_header():
            try:
                picture = self._walk(t_s)
            except Damaged:
                self._drop(1)
                self.damaged += 1
                continue
            if picture is None:
                break
            self.pictures += 1
            pictures.append(picture)
        return pictures

    def _find_header(self) -> bool:
        start = 0
        while (found := _START.search(self._buffer, start)) is not None:
            start = found.start()
            if len(self._buffer) - start < _START_BYTES:
                self._drop(start)
                return False
            self._header = _header_of(self._buffer, start)
            if self._header is not None:
                self._drop(start, keep_header=True)
                self._at = _START_BYTES
                return True
            start += 1
        self._drop(max(len(self._buffer) - _START_BYTES, 0))
        return False

    def _walk(self, t_s: float) -> CpxPicture | None:
        """On through the packets of the picture at the buffer's start; None while it is not
        whole. Raises Damaged."""
        header = self._header
        assert header is not None
        began_s = self._came_at(self._dropped_bytes)
        if t_s - began_s > STALLED_S:
            raise Damaged
        while self._have < header.size:
            if len(self._buffer) < self._at + _PACKET.size:
                return None
            length, routing, function = _PACKET.unpack_from(self._buffer, self._at)
            if not _is_packet(length, routing, function):
                raise Damaged
            begin, end = self._at + _PACKET.size, self._at + 2 + length
            if function != _APP or length == _PACKET.size - 2:  # an empty one leads nowhere
                self._other_bytes += 2 + length
                if self._other_bytes > _MOST_OTHER_BYTES:
                    raise Damaged
            elif len(self._buffer) >= end:
                if _header_of(self._buffer, self._at) is not None:
                    raise Damaged
                self._take(bytes(self._buffer[begin:end]), header)
            if len(self._buffer) < end:
                return None
            self._at = end
        picture = b"".join(self._chunks)
        if header.is_jpeg and (picture[:2] != b"\xff\xd8" or jpeg_end(picture) != len(picture)):
            raise Damaged
        self._drop(self._at)
        return CpxPicture(began_s, header.width, header.height, header.is_jpeg, picture)

    def _take(self, chunk: bytes, header: _Header) -> None:
        self._have += len(chunk)
        if self._have > header.size:
            raise Damaged
        is_last = self._have == header.size
        first = len(self._chunks[0]) if self._chunks else len(chunk)
        # A JPEG is sent in three parts, and its structure shows where one is missing.
        if chunk and not header.is_jpeg and len(chunk) != first and not is_last:
            raise Damaged
        if chunk:
            self._chunks.append(chunk)

    def _drop(self, count: int, keep_header: bool = False) -> None:
        del self._buffer[:count]
        self._dropped_bytes += count
        while len(self._came) > 1 and self._came[0][0] <= self._dropped_bytes:
            del self._came[0]
        if not keep_header:
            self._header = None
        self._chunks, self._have, self._other_bytes = [], 0, 0

    def _came_at(self, place: int) -> float:
        return next((t_s for until, t_s in self._came if place < until), self._came[-1][1])


def _is_packet(length: int, routing: int, function: int) -> bool:
    """One that the deck may send to a computer."""
    return (
        _PACKET.size - 2 <= length <= MAX_PACKET_BYTES
        and routing == routing & _NOT_RESERVED
        and routing & 0x07 == _HOST
        and (routing >> 3) & 0x07 in _SENDERS
        and function in _FUNCTIONS  # its two upper bits are the version, which is 0
    )


def _header_of(data: bytes | bytearray, at: int) -> _Header | None:
    """The picture's header in the packet at that place; None where it is none."""
    if len(data) < at + _START_BYTES:
        return None
    length, routing, function = _PACKET.unpack_from(data, at)
    if length != 2 + _HEADER.size or function != _APP or not _is_packet(length, routing, function):
        return None
    magic, width, height, depth, kind, size = _HEADER.unpack_from(data, at + _PACKET.size)
    if magic != _MAGIC or depth != 1 or not _is_size(width, height):
        return None
    if kind == _RAW and size == width * height:
        return _Header(width, height, False, size)
    if kind == _JPEG and 4 <= size <= 2 * width * height + 2048:
        return _Header(width, height, True, size)
    return None


def _is_size(width: int, height: int) -> bool:
    return 0 < width <= MOST_SIDE_PX and 0 < height <= MOST_SIDE_PX
