"""The AI-deck's camera over Wi-Fi: ``aideck://HOST[:PORT]``, read by a thread, newest frame wins.

HOST is 192.168.4.1 where the deck is its own access point. Bitcraze's example `wifi-img-streamer`
has to be in the deck's GAP8; it sends raw or JPEG pictures of 324x244.
"""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera.cpx import CpxPicture, CpxSplitter
from perchctl.camera.credentials import without_password
from perchctl.camera.jpeg import grey_pixels, size_in
from perchctl.camera.source import Clock
from perchctl.camera.stream import (
    CONNECT_TIMEOUT_S,
    READ_TIMEOUT_S,
    RECONNECT_WAIT_S,
    StreamSource,
)
from perchctl.errors import InvalidValue

PORT = 5000
FORM = "aideck://HOST[:5000]"
NO_PICTURE_S = 5.0
"""Bytes that come for so long without a whole picture end the connection."""

# What waits unread would be taken for new: the kernel holds back the deck instead.
_RECEIVE_BYTES = 131072
_READ_BYTES = 4 * _RECEIVE_BYTES
_COLOURS: dict[str, bool | None] = {"auto": None, "yes": True, "no": False}
_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9._-]*[A-Za-z0-9])?|[0-9A-Fa-f:]+")


@dataclass(frozen=True)
class AiDeckAddress:
    """`colour`: whether the camera has a colour mosaic; None is found out by its pictures."""

    host: str
    port: int = PORT
    colour: bool | None = None


def aideck_address(spec: str) -> AiDeckAddress:
    """Of ``aideck://HOST[:PORT][?colour=auto|yes|no]``. Errors: InvalidValue."""
    wrong = InvalidValue(
        f"camera source {without_password(spec)!r} is no AI-deck's address; write {FORM}, as in "
        f"aideck://192.168.4.1, and behind it ?colour=yes or ?colour=no where the picture "
        f"does not tell"
    )
    try:
        parts = urlsplit(spec)
        port = PORT if parts.port is None else parts.port
        given = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    except ValueError:
        raise wrong from None
    options = dict(given)
    colour = options.pop("colour", "auto")
    if (
        parts.scheme != "aideck"
        or not _HOST.fullmatch(parts.hostname or "")
        or port == 0
        or parts.username is not None
        or parts.path not in ("", "/")
        or parts.fragment
        or options
        or colour not in _COLOURS
    ):
        raise wrong
    return AiDeckAddress(str(parts.hostname), port, _COLOURS[colour])


class AiDeckSource(StreamSource):
    """Bitcraze's image streamer: CPX packets over TCP, raw or JPEG pictures.

    A picture's time is that of its first byte less `latency_s`: the deck sends the header as soon
    as the picture is taken, and only the transfer behind it, of 60 ms and more for a raw one,
    hangs on the air. Its age of arrival is the last byte's.
    """

    def __init__(
        self,
        address: AiDeckAddress,
        latency_s: float,
        clock: Clock,
        read_timeout_s: float = READ_TIMEOUT_S,
        reconnect_wait_s: float = RECONNECT_WAIT_S,
        no_picture_s: float = NO_PICTURE_S,
    ) -> None:
        name = f"aideck://{address.host}:{address.port}"
        super().__init__(name, latency_s, clock, read_timeout_s, reconnect_wait_s)
        self._address = address
        self._no_picture_s = no_picture_s
        self.bytes_seen = 0
        self._grey = MosaicFilter(address.colour)
        self._start(self._run)

    def _connection(self) -> str:
        with socket.socket(_family(self._address.host), socket.SOCK_STREAM) as connection:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)
            connection.settimeout(CONNECT_TIMEOUT_S)
            connection.connect((self._address.host, self._address.port))
            self._socket = connection
            try:
                if self._stop.is_set():
                    return "closed"
                connection.settimeout(self._read_timeout_s)
                return self._read(connection)
            finally:
                self._socket = None

    def _read(self, connection: socket.socket) -> str:
        """Until the stream ends; why it did."""
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
            if now_s - last_s > self._no_picture_s:
                return _nothing(splitter)
        return "closed"


def _nothing(splitter: CpxSplitter) -> str:
    if splitter.bytes_seen == 0:
        return "the deck took the connection and sent nothing; switch the Crazyflie off and on"
    return (
        f"{splitter.bytes_seen} bytes came, and no whole picture as Bitcraze's wifi-img-streamer "
        f"sends them; is that the program in the deck?"
    )


def decoded(picture: CpxPicture) -> NDArray[np.uint8] | None:
    """Grey (height, width); None if a JPEG cannot be decoded, or says another size than the
    deck's header, which allows `MOST_SIDE_PX`."""
    shape = (picture.height, picture.width)
    if not picture.is_jpeg:
        return np.frombuffer(picture.data, np.uint8).reshape(shape)
    # One picture's header never comes with another's bytes; nor is a damaged size decoded.
    if size_in(picture.data) != (picture.width, picture.height):
        return None
    image = grey_pixels(picture.data)
    return image if image is not None and image.shape == shape else None


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


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
    """Whether the pixels (height, width) of the four places of a two by two pattern differ."""
    means = [float(image[row::2, column::2].mean()) for row in (0, 1) for column in (0, 1)]
    return max(means) - min(means) > max(LEAST_SHARE * sum(means) / 4.0, LEAST_LEVELS)


def without_mosaic(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Grey of each pixel with its neighbours, a quarter red, a half green, a quarter blue.

    The weights 1 2 1 along rows and columns cancel whatever repeats every two pixels, so it holds
    for each order of the filters, and for a picture that was flipped or is a JPEG; OpenCV's own
    conversions err by half as much again after a JPEG, and have to be told the order.
    """
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_8U, _KERNEL, _KERNEL), np.uint8)


class MosaicFilter:
    """Takes the mosaic out of a stream's pictures; None: where one is found, and from then on."""

    def __init__(self, colour: bool | None = None) -> None:
        self.colour = colour
        self._in_a_row = 0

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        if self.colour is None:
            self._in_a_row = self._in_a_row + 1 if has_mosaic(image) else 0
            if self._in_a_row >= PICTURES_IN_A_ROW:
                self.colour = True
        return without_mosaic(image) if self.colour or self._in_a_row else image
