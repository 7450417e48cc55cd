"""Motion-JPEG over HTTP: ``http://host:port/path``, read by a thread, newest frame wins."""

from __future__ import annotations

import base64
import http.client
from urllib.parse import SplitResult, unquote, urljoin, urlsplit, urlunsplit

import cv2
import numpy as np

from perchctl.camera.source import Clock
from perchctl.camera.stream import (
    CONNECT_TIMEOUT_S,
    READ_TIMEOUT_S,
    RECONNECT_WAIT_S,
    StreamSource,
)

READ_BYTES = 65536
MAX_PICTURE_BYTES = 8_000_000
MAX_REDIRECTS = 3

_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"
_STANDALONE = frozenset(range(0xD0, 0xD8)) | {0x01}  # markers without a length


def without_password(url: str) -> str:
    """The URL without the name and password that it may hold; other text as it is."""
    scheme, slashes, rest = url.partition("://")
    host, slash, path = rest.partition("/")
    return f"{scheme}{slashes}{host.rpartition('@')[2]}{slash}{path}" if slashes else url


class Damaged(Exception):
    """The bytes at a start-of-image marker are no whole JPEG."""


class JpegSplitter:
    """Cuts a byte stream into whole JPEG pictures; pure.

    Goes by the JPEG's own structure and not by the multipart headers, so wrong
    lengths, odd boundaries and missing headers do no harm, and a picture is out
    with its last byte. A truncated picture is dropped and the search goes on at
    the next start of a picture (after up to 64 kB where the tear cut a length).
    `damaged` counts what was dropped.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.damaged = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Append bytes; the pictures now complete, oldest first."""
        self._buffer += data
        pictures: list[bytes] = []
        while True:
            start = self._buffer.find(_SOI + b"\xff")
            if start < 0:
                del self._buffer[: max(len(self._buffer) - 2, 0)]
                return pictures
            del self._buffer[:start]
            try:
                end = jpeg_end(self._buffer)
            except Damaged:
                self.damaged += 1
                del self._buffer[:2]
                continue
            if end is not None:
                pictures.append(bytes(self._buffer[:end]))
                del self._buffer[:end]
                continue
            if len(self._buffer) <= MAX_PICTURE_BYTES:
                return pictures
            self.damaged += 1
            del self._buffer[:2]


def jpeg_end(data: bytes | bytearray) -> int | None:
    """Length of the JPEG at the start of `data`, or None while it is incomplete.

    Raises Damaged where the structure breaks: a segment that is followed by no
    marker, or another picture's start inside this one.
    """
    at = 2
    while True:
        # Header segments: FF, code, two bytes of length.
        if at + 2 > len(data):
            return None
        code = data[at + 1]
        if data[at] != 0xFF:
            raise Damaged
        if code == 0xFF:  # fill byte
            at += 1
            continue
        if code == 0xD9:
            return at + 2
        if code in _STANDALONE:
            at += 2
            continue
        if code < 0xC0 or code == 0xD8:
            raise Damaged
        if at + 4 > len(data):
            return None
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if length < 2:
            raise Damaged
        at += 2 + length
        if code != 0xDA:
            continue
        # Start of scan: entropy-coded bytes, in which FF is followed by 00 or a restart.
        while True:
            at = data.find(b"\xff", at)
            if at < 0 or at + 1 >= len(data):
                return None
            if data[at + 1] == 0x00 or data[at + 1] in _STANDALONE:
                at += 2
            elif data[at + 1] == 0xFF:
                at += 1
            else:
                break


class MjpegSource(StreamSource):
    """A Motion-JPEG stream (multipart/x-mixed-replace, or bare JPEGs one after another).

    Goes straight to the camera: a proxy for the internet is not for it.
    """

    def __init__(
        self,
        url: str,
        latency_s: float,
        clock: Clock,
        read_timeout_s: float = READ_TIMEOUT_S,
        reconnect_wait_s: float = RECONNECT_WAIT_S,
    ) -> None:
        super().__init__(without_password(url), latency_s, clock, read_timeout_s, reconnect_wait_s)
        self._url = url
        self._start(self._run)

    def _connection(self) -> str:
        return self._connect(self._url, MAX_REDIRECTS)

    def _connect(self, url: str, redirects: int) -> str:
        """One connection until it ends; why it ended."""
        parts = urlsplit(url)
        kind = (
            http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        )
        timeout_s = self._read_timeout_s if self._count else CONNECT_TIMEOUT_S
        connection = kind(parts.hostname or "", parts.port, timeout=timeout_s)
        try:
            connection.connect()
            self._socket = connection.sock
            if self._stop.is_set():
                return "closed"
            path = urlunsplit(("", "", parts.path or "/", parts.query, ""))
            connection.request("GET", path, headers=_headers(parts))
            response = connection.getresponse()
            location = response.getheader("Location")
            if response.status in (301, 302, 303, 307, 308) and location and redirects > 0:
                return self._connect(urljoin(url, location), redirects - 1)
            if response.status != 200:
                gone = response.status in (401, 403, 404, 410)
                self.not_found = gone and self._count == 0
                return f"the server answers {response.status} {response.reason}"
            self._socket.settimeout(self._read_timeout_s)
            self._read(response)
            return "the stream ended"
        finally:
            self._socket = None
            connection.close()

    def _read(self, response: http.client.HTTPResponse) -> None:
        splitter = JpegSplitter()
        earlier = self.damaged
        while not self._stop.is_set():
            data = response.read1(READ_BYTES)
            if not data:
                return
            pictures = splitter.feed(data)
            self.damaged = earlier + splitter.damaged
            # If the network delivered several at once only the newest is worth decoding.
            for picture in reversed(pictures):
                image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
                if image is not None:
                    self._put(image)
                    break
                self.damaged += 1


def _headers(parts: SplitResult) -> dict[str, str]:
    headers = {"Accept": "multipart/x-mixed-replace, image/jpeg, */*", "Connection": "close"}
    if parts.username is not None:
        secret = f"{unquote(parts.username)}:{unquote(parts.password or '')}".encode()
        headers["Authorization"] = "Basic " + base64.b64encode(secret).decode("ascii")
    return headers
