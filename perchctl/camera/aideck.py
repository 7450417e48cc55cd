"""The AI-deck's camera over Wi-Fi: ``aideck://HOST[:PORT]``, read by a thread that keeps the newest
frame.

HOST is 192.168.4.1 if the deck is its own access point. The deck's GAP8 must run Bitcraze's example
`wifi-img-streamer`, which sends raw or JPEG images of 324x244.

The stream consists of packets in Bitcraze's CPX format: 16 bits for the length of the rest of the
packet, one byte for routing, one byte for the function, and the data. An image is sent as one
packet with a header, ``<BHHBBI`` (magic 0xBC, width, height, depth, format, size), and further
packets with the image data until `size` bytes have arrived. (cflib's own reader blocks forever if
the deck disappears.)
"""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass
from typing import BinaryIO
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera.jpeg import decode_grey, jpeg_end_and_size
from perchctl.camera.source import Clock, LiveSource

PORT = 5000
STALLED_S = 2.0
"""An image is dropped if it takes longer than this, s, from its first to its last byte."""
MAX_PACKET_BYTES = 1022
"""Largest packet length, bytes: the size of the deck's buffers (its MTU)."""
MOST_SIDE_PX = 1024

# Keep the buffer small, because data that waits in it while the reader stalls is time-stamped too
# late.
_RECEIVE_BYTES = 131072
_PACKET = struct.Struct("<HBB")
_HEADER = struct.Struct("<BHHBBI")
_MAGIC, _RAW, _JPEG = 0xBC, 0, 1
_APP = 5
_FUNCTIONS = (1, 2, 3, 4, _APP, 14, 15)


@dataclass
class _Picture:
    """A partly received image: the content of its header, and the `data` received so far.

    `began_s` is the arrival time of its first byte.
    """

    began_s: float
    width: int
    height: int
    is_jpeg: bool
    size: int
    data: bytearray

    def decode(self) -> tuple[NDArray[np.uint8], bytes | None] | str:
        """Return the grey image (h, w), and its JPEG if it was sent as a JPEG; or return the reason
        why it cannot be used. Bytes after the end of a JPEG are padding."""
        shape, data = (self.height, self.width), bytes(self.data)
        if not self.is_jpeg:
            if len(data) != self.size:
                return f"{len(data)} bytes arrived, but the header announces {self.size}"
            return np.frombuffer(data, np.uint8).reshape(shape), None
        extent = jpeg_end_and_size(data)
        if extent is None:
            return "the JPEG is incomplete: its end is missing"
        end, (width, height) = extent
        if not (width and height):
            return "the JPEG is damaged"
        if (width, height) != (self.width, self.height):
            announced = f"{self.width}x{self.height}"
            return f"the JPEG is {width}x{height} px, but the header announces {announced}"
        image = decode_grey(data[:end])
        if image is None or image.shape != shape:
            return "the JPEG cannot be decoded"
        return image, data[:end]


class AiDeckSource(LiveSource):
    """Bitcraze's image streamer: CPX packets over TCP, raw or JPEG images.

    An image's time is the arrival time of its first byte minus `latency_s`, because the deck sends
    the header at the exposure; the transfer of a raw image takes 60 ms or more. An image's arrival
    time is the arrival time of its last byte. Incomplete images are dropped; an invalid packet ends
    the connection, and the source reconnects.
    """

    unreached_advice = (
        "check that this computer is on the deck's Wi-Fi network and that the address is right"
    )
    silent_advice = "switch the Crazyflie off and on again"

    def __init__(self, url: str, latency_s: float, clock: Clock) -> None:
        super().__init__(url, latency_s, clock)
        parts = urlsplit(url)
        self._address = parts.hostname, parts.port or PORT
        self._grey = MosaicFilter()
        self._picture: _Picture | None = None

    def _connection(self) -> str:
        with socket.create_connection(self._address, self.connect_timeout_s) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
            connection.settimeout(self.read_timeout_s)
            self._picture = None
            self._connected()
            with connection.makefile("rb") as stream:
                return self._read(stream)

    def _read(self, stream: BinaryIO) -> str:
        """Read packets until the stream ends, and return why it ended."""
        while not self._stop.is_set():
            head = stream.read(_PACKET.size)
            came_s = self._clock()
            if len(head) < _PACKET.size:
                return "the stream ended"
            length, _, function = _PACKET.unpack(head)
            if not 2 <= length <= MAX_PACKET_BYTES or function not in _FUNCTIONS:
                self._note(
                    "the data is not in the format of Bitcraze's wifi-img-streamer",
                    "check that the deck runs wifi-img-streamer",
                )
                return "a packet is not in the format of wifi-img-streamer"
            data = stream.read(length - 2)
            if self._picture is None and self._arrived == 0:
                self._note(
                    "data arrives, but no picture", "check that the deck runs wifi-img-streamer"
                )
            if function == _APP:
                self._take(data, came_s)
        return "closed"

    def _take(self, data: bytes, came_s: float) -> None:
        header = _header_of(data, came_s)
        if header is not None:
            self._picture = header
            return
        picture = self._picture
        if picture is None:
            return
        picture.data += data
        if len(picture.data) < picture.size:
            return
        self._picture = None
        took_s = self._clock() - picture.began_s
        if took_s > STALLED_S:
            self._drop(f"the transfer took {took_s:.1f} s")
            return
        decoded = picture.decode()
        if isinstance(decoded, str):
            self._drop(decoded)
            return
        image, encoded = decoded
        grey = self._grey(image)
        if grey is not image:  # a colour mosaic was removed from the image
            encoded = None
        self._put(grey, began_s=picture.began_s, encoded=encoded)


def _header_of(data: bytes, came_s: float) -> _Picture | None:
    """Return the image that starts with this packet; None if the packet is not a header."""
    if len(data) != _HEADER.size:
        return None
    magic, width, height, depth, kind, size = _HEADER.unpack(data)
    sides_fit = 0 < width <= MOST_SIDE_PX and 0 < height <= MOST_SIDE_PX
    if magic != _MAGIC or depth != 1 or not sides_fit:
        return None
    if kind == _RAW and size == width * height:
        return _Picture(came_s, width, height, False, size, bytearray())
    if kind == _JPEG and 4 <= size <= 2 * width * height + 2048:
        return _Picture(came_s, width, height, True, size, bytearray())
    return None


# --- The colour mosaic of a camera whose images are delivered as grey ---
# The pixels have colour filters in blocks of two by two. The pattern of the filters is visible in
# raw images and in grey JPEG images.


LEAST_MOSAIC_SHARE = 0.04
"""Smallest difference between the mean grey levels of the filters, relative to their mean, that
shows a mosaic. A grey sensor has less than 1 %, a mosaic 20 % or more."""
LEAST_MOSAIC_LEVELS = 1.5
PICTURES_IN_A_ROW = 3
_KERNEL = np.array([0.25, 0.5, 0.25], np.float32)


def has_mosaic(image: NDArray[np.uint8]) -> bool:
    """True if the mean brightness differs between the four pixels of a 2x2 colour mosaic."""
    means = [float(image[row::2, column::2].mean()) for row in (0, 1) for column in (0, 1)]
    return max(means) - min(means) > max(LEAST_MOSAIC_SHARE * sum(means) / 4.0, LEAST_MOSAIC_LEVELS)


def remove_mosaic(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image smoothed to grey: a quarter red, half green, a quarter blue.

    The weights 1 2 1 along rows and columns cancel any pattern with a period of two pixels, so this
    works for each order of the colour filters, and for a JPEG.
    """
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_8U, _KERNEL, _KERNEL), np.uint8)


class MosaicFilter:
    """Removes the colour mosaic from a stream's images once one of them has shown a mosaic."""

    def __init__(self) -> None:
        self._in_a_row = 0

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self._in_a_row < PICTURES_IN_A_ROW:
            self._in_a_row = self._in_a_row + 1 if has_mosaic(image) else 0
        return remove_mosaic(image) if self._in_a_row else image
