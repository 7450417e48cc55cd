"""The AI-deck's camera over Wi-Fi: ``aideck://HOST[:PORT]``, read by a thread, newest frame wins.

HOST is 192.168.4.1 where the deck is its own access point. Bitcraze's example `wifi-img-streamer`
has to be in the deck's GAP8; it sends raw or JPEG pictures of 324x244.
"""

from __future__ import annotations

import re
import socket
import struct
from dataclasses import dataclass
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera.credentials import without_password
from perchctl.camera.jpeg import Damaged, grey_pixels, jpeg_end, size_in
from perchctl.camera.network import StreamSource
from perchctl.camera.source import Clock
from perchctl.errors import InvalidValue

PORT = 5000
FORM = "aideck://HOST[:5000]"
CONNECT_TIMEOUT_S = 3.0

# What waits unread would be taken for new: the kernel holds back the deck instead.
_RECEIVE_BYTES = 131072
_READ_BYTES = 4 * _RECEIVE_BYTES
_HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|[0-9A-Fa-f:]+")


def aideck_address(spec: str) -> tuple[str, int]:
    """Return host and port of ``aideck://HOST[:PORT]``. Raises InvalidValue."""
    wrong = InvalidValue(
        f"camera source {without_password(spec)!r} is no AI-deck's address; write {FORM}, as in "
        f"aideck://192.168.4.1"
    )
    try:
        parts = urlsplit(spec)
        port = PORT if parts.port is None else parts.port
    except ValueError:
        raise wrong from None
    host = parts.hostname or ""
    more = parts.username or parts.path.strip("/") or parts.query or parts.fragment
    if parts.scheme != "aideck" or not _HOST_NAME.fullmatch(host) or port == 0 or more:
        raise wrong
    return host, port


class AiDeckSource(StreamSource):
    """Bitcraze's image streamer: CPX packets over TCP, raw or JPEG pictures.

    A picture's time is that of its first byte less `latency_s`: the deck sends the header as soon
    as the picture is taken, and only the transfer behind it, of 60 ms and more for a raw one,
    hangs on the air. Its age of arrival is the last byte's.
    """

    no_picture_s = 5.0
    """Bytes that come for so long without a whole picture end the connection."""

    def __init__(self, host: str, port: int, latency_s: float, clock: Clock) -> None:
        super().__init__(f"aideck://{host}:{port}", latency_s, clock)
        self._address = host, port
        self.bytes_seen = 0
        self._grey = MosaicFilter()

    def _connection(self) -> str:
        family = socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
            connection.settimeout(CONNECT_TIMEOUT_S)
            connection.connect(self._address)
            connection.settimeout(self.read_timeout_s)
            return self._read(connection)

    def _read(self, connection: socket.socket) -> str:
        """Read until the stream ends, and return why it ended."""
        splitter = CpxSplitter()
        earlier, last_s = self.damaged, self._clock()
        while not self._stop.is_set():
            data = connection.recv(_READ_BYTES)
            now_s = self._clock()
            self.bytes_seen += len(data)
            if not data:
                return "the stream ended" if splitter.pictures else _nothing(splitter)
            for picture in reversed(splitter.feed(data, now_s)):
                image = decoded(picture)
                if image is not None:
                    last_s = now_s
                    grey = self._grey(image)
                    as_came = picture.is_jpeg and grey is image  # no mosaic was taken out of it
                    encoded = picture.data if as_came else None
                    self._put(grey, began_s=picture.began_s, encoded=encoded)
                    break
                splitter.damaged += 1
            self.damaged = earlier + splitter.damaged
            if now_s - last_s > self.no_picture_s:
                return _nothing(splitter)
        return "closed"


def _nothing(splitter: CpxSplitter) -> str:
    """Say why a connection brought no picture."""
    if splitter.bytes_seen == 0:
        return "the deck took the connection and sent nothing; switch the Crazyflie off and on"
    return (
        f"{splitter.bytes_seen} bytes came, and no whole picture as Bitcraze's wifi-img-streamer "
        f"sends them; is that the program in the deck?"
    )


def decoded(picture: CpxPicture) -> NDArray[np.uint8] | None:
    """Return the grey picture (height, width); None if a JPEG cannot be decoded, or says another
    size than the deck's header, which allows `MOST_SIDE_PX`."""
    shape = (picture.height, picture.width)
    if not picture.is_jpeg:
        return np.frombuffer(picture.data, np.uint8).reshape(shape)
    # One picture's header never comes with another's bytes; nor is a damaged size decoded.
    if size_in(picture.data) != (picture.width, picture.height):
        return None
    image = grey_pixels(picture.data)
    return image if image is not None and image.shape == shape else None


# --- A colour camera's mosaic in what is delivered as a grey picture ---
# The sensor's pixels look through colour filters, two by two, and a raw picture, or a JPEG that
# was made of one as if it were grey, has their pattern all over it. Corners measured on it are
# off by up to 6 times as much, and a fifth of the far markers is not found (`benchmarks/aideck.py
# --mosaic`).


LEAST_SHARE = 0.04
"""By which the four filters' mean greys differ, over their mean: two pixels of a grey sensor that
lie side by side differ by less than 1 % over a whole picture, a mosaic's by 20 % and more."""
LEAST_LEVELS = 1.5
PICTURES_IN_A_ROW = 3

_KERNEL = np.array([0.25, 0.5, 0.25], np.float32)


def has_mosaic(image: NDArray[np.uint8]) -> bool:
    """Return whether the pixels of the four places of a two by two pattern differ in brightness."""
    means = [float(image[row::2, column::2].mean()) for row in (0, 1) for column in (0, 1)]
    return max(means) - min(means) > max(LEAST_SHARE * sum(means) / 4.0, LEAST_LEVELS)


def without_mosaic(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return each pixel's grey with its neighbours: a quarter red, half green, a quarter blue.

    The weights 1 2 1 along rows and columns cancel whatever repeats every two pixels, so it holds
    for each order of the filters, and for a picture that was flipped or is a JPEG; OpenCV's own
    conversions err by half as much again after a JPEG, and need the order.
    """
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_8U, _KERNEL, _KERNEL), np.uint8)


class MosaicFilter:
    """Takes the mosaic out of a stream's pictures, from the first picture that shows one."""

    def __init__(self) -> None:
        self._in_a_row = 0

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._in_a_row < PICTURES_IN_A_ROW:
            self._in_a_row = self._in_a_row + 1 if has_mosaic(image) else 0
        return without_mosaic(image) if self._in_a_row else image


# --- An AI-deck's pictures, cut out of the bytes of its TCP stream ------------------------------
# The stream is packets of Bitcraze's CPX: 16 bits of length, which counts what follows them, then
# one byte of routing, one of function, and the data. A picture is a packet with its header,
# ``<BHHBBI``: magic 0xBC, width, height, depth, format, size; then packets of chunks until `size`
# bytes have come. Nothing has a checksum. cflib's own reader of these packets blocks for ever when
# the deck goes away and cannot find its way back after a broken length, so it is not used.


MAX_PACKET_BYTES = 1022
"""Largest length of a packet: the deck's buffers hold no more (its MTU)."""
MOST_SIDE_PX = 1024
STALLED_S = 2.0
"""A picture that takes longer from its first byte to its last is dropped."""

_PACKET = struct.Struct("<HBB")
_HEADER = struct.Struct("<BHHBBI")
_MAGIC, _RAW, _JPEG = 0xBC, 0, 1
_HOST, _SENDERS, _APP = 3, (1, 2, 4), 5
_FUNCTIONS = (1, 2, 3, 4, _APP, 14, 15)
_NOT_RESERVED = 0x7F
_START_BYTES = _PACKET.size + _HEADER.size
_START = re.compile(
    re.escape(struct.pack("<H", 2 + _HEADER.size)) + rb"[\x00-\x7f]\x05\xbc.{10}", re.DOTALL
)


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
    """Cuts whole pictures out of the bytes.

    A picture counts only if its packets are complete: each a packet that the deck may send, no
    other picture's header amid them, raw chunks of one length but for the last, `size` bytes to
    the byte, and a JPEG whose structure ends there. Otherwise it is dropped (`damaged`), and the
    search for the next header begins right behind its own header: a wrong length costs no picture
    but the one that it is in. The packets of other functions are passed over. The bytes since the
    current picture's header are held, for `STALLED_S` at most.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._came: list[tuple[int, float]] = []  # the count of bytes at each time
        self._at = 0  # how far the packets of the picture at the buffer's start have been read
        self._chunks: list[bytes] = []
        self.damaged = 0
        self.bytes_seen = 0
        self.pictures = 0

    def feed(self, data: bytes, t_s: float) -> list[CpxPicture]:
        """Append bytes that came at `t_s`, and return the pictures now complete, oldest first."""
        self._buffer += data
        self.bytes_seen += len(data)
        self._came.append((self.bytes_seen, t_s))
        pictures: list[CpxPicture] = []
        while (found := _START.search(self._buffer)) is not None:
            if found.start() > 0:
                self._drop(found.start())
            try:
                picture = self._joined(t_s)
            except Damaged:
                self.damaged += 1
                self._drop(1)
                continue
            if picture is None:
                break
            pictures.append(picture)
            self._drop(self._at)
        else:
            self._drop(max(len(self._buffer) - _START_BYTES + 1, 0))
        self.pictures += len(pictures)
        return pictures

    def _joined(self, t_s: float) -> CpxPicture | None:
        """Read on through the packets of the picture at the buffer's start, and return it; None
        while it is not whole. Raises Damaged."""
        header = _header_of(bytes(self._buffer[_PACKET.size : _START_BYTES]))
        began_s = self._came[0][1]
        if header is None or t_s - began_s > STALLED_S:
            raise Damaged(0)
        while len(self._buffer) >= self._at + _PACKET.size:
            length, routing, function = _PACKET.unpack_from(self._buffer, self._at)
            if not _is_packet(length, routing, function):
                raise Damaged(self._at)
            begin, end = self._at + _PACKET.size, self._at + 2 + length
            if len(self._buffer) < end:
                break
            is_header, self._at = self._at == 0, end
            payload = bytes(self._buffer[begin:end])
            if is_header or function != _APP or not payload:
                continue
            self._chunks.append(payload)
            have = sum(map(len, self._chunks))
            # A JPEG is sent in three parts, and its structure shows where one is missing.
            is_odd = not header.is_jpeg and len(payload) != len(self._chunks[0])
            if (
                _header_of(payload) is not None
                or have > header.size
                or (is_odd and have < header.size)
            ):
                raise Damaged(begin)
            if have == header.size:
                picture = b"".join(self._chunks)
                if header.is_jpeg and not _is_jpeg(picture):
                    raise Damaged(begin)
                return CpxPicture(began_s, header.width, header.height, header.is_jpeg, picture)
        return None

    def _drop(self, count: int) -> None:
        """Remove bytes from the buffer's start, and begin anew with what is then there."""
        del self._buffer[:count]
        self._at, self._chunks = 0, []
        dropped = self.bytes_seen - len(self._buffer)
        while self._came and self._came[0][0] <= dropped:
            del self._came[0]


def _is_jpeg(data: bytes) -> bool:
    """Return whether the bytes are one JPEG from its start to its end."""
    try:
        return data.startswith(b"\xff\xd8") and jpeg_end(data) == len(data)
    except Damaged:
        return False


def _is_packet(length: int, routing: int, function: int) -> bool:
    """Return whether the deck may send such a packet to a computer."""
    return (
        _PACKET.size - 2 <= length <= MAX_PACKET_BYTES
        and routing == routing & _NOT_RESERVED
        and routing & 0x07 == _HOST
        and (routing >> 3) & 0x07 in _SENDERS
        and function in _FUNCTIONS  # its two upper bits are the version, which is 0
    )


def _header_of(payload: bytes) -> _Header | None:
    """Return the picture's header that a packet holds; None where it holds none."""
    if len(payload) != _HEADER.size:
        return None
    magic, width, height, depth, kind, size = _HEADER.unpack(payload)
    sides_fit = 0 < width <= MOST_SIDE_PX and 0 < height <= MOST_SIDE_PX
    if magic != _MAGIC or depth != 1 or not sides_fit:
        return None
    if kind == _RAW and size == width * height:
        return _Header(width, height, False, size)
    if kind == _JPEG and 4 <= size <= 2 * width * height + 2048:
        return _Header(width, height, True, size)
    return None
