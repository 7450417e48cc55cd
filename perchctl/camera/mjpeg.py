"""Motion-JPEG over HTTP: ``http://host:port/path``, read by a thread, newest frame wins."""

from __future__ import annotations

import http.client
import ssl
from dataclasses import replace
from urllib.parse import SplitResult, urljoin, urlsplit, urlunsplit

import cv2
import numpy as np

from perchctl.camera.credentials import (
    Challenge,
    answer,
    challenge_of,
    credentials_of,
    without_password,
)
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
MOST_REQUESTS = 3
"""One that is answered by what to answer to, once more where that was too old."""

_HEADERS = {"Accept": "multipart/x-mixed-replace, image/jpeg, */*", "Connection": "close"}
_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"
_STANDALONE = frozenset(range(0xD0, 0xD8)) | {0x01}  # markers without a length


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

    Given up at once, too, where the server wants another name and password. They are sent
    as it asks for them, digest or basic, and to no other host. Goes straight to the camera:
    a proxy for the internet is not for it.
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
        self._challenge: Challenge | None = None
        self._start(self._run)

    def _connection(self) -> str:
        try:
            return self._connect(self._url, MAX_REDIRECTS)
        except ssl.SSLCertVerificationError as error:
            self.not_found = self._count == 0
            return _untrusted(error)

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
            response = self._answered(connection, parts)
            location = response.getheader("Location")
            if response.status in (301, 302, 303, 307, 308) and location and redirects > 0:
                return self._connect(_redirected(url, location), redirects - 1)
            if response.status != 200:
                gone = response.status in (401, 403, 404, 410)
                self.not_found = gone and self._count == 0
                hint = _hint(response, parts)
                return f"the server answers {response.status} {response.reason}{hint}"
            self._socket.settimeout(self._read_timeout_s)
            self._read(response)
            return "the stream ended"
        finally:
            self._socket = None
            connection.close()

    def _answered(
        self, connection: http.client.HTTPConnection, parts: SplitResult
    ) -> http.client.HTTPResponse:
        """The response; with name and password once the server has asked for them, or has
        refused the nameless without asking (403)."""
        path = urlunsplit(("", "", parts.path or "/", parts.query, ""))
        who = credentials_of(parts)
        for _ in range(MOST_REQUESTS):
            headers = dict(_HEADERS)
            if who is not None and self._challenge is not None:
                headers["Authorization"] = answer(self._challenge, who, "GET", path)
                self._challenge = replace(self._challenge, count=self._challenge.count + 1)
            connection.request("GET", path, headers=headers)
            response = connection.getresponse()
            asked = _challenge(response)
            # After an answer 403 is the last word: nobody asked for less than a digest then.
            asks = response.status == 401 or (response.status == 403 and self._challenge is None)
            if not asks or who is None or asked is None:
                break
            # A nonce of an earlier connection may be too old: a new one is answered once more.
            if self._challenge is not None and asked.asks_the_same(self._challenge):
                break
            self._challenge = asked
            connection.close()
            connection.connect()
            self._socket = connection.sock
        return response

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
                    self._put(image, encoded=picture)
                    break
                self.damaged += 1


def _redirected(url: str, location: str) -> str:
    """Where to go: name and password go along to the same host only."""
    before, after = urlsplit(url), urlsplit(urljoin(url, location))
    same = (before.hostname, before.port) == (after.hostname, after.port)
    if same and after.username is None and before.username is not None:
        after = after._replace(netloc=f"{before.netloc.rpartition('@')[0]}@{after.netloc}")
    return urlunsplit(after)


def _challenge(response: http.client.HTTPResponse) -> Challenge | None:
    """What the server asks for; one that does not say so gets the simplest."""
    headers = response.headers.get_all("WWW-Authenticate")
    return challenge_of(headers) if headers else Challenge(digest=False)


def _hint(response: http.client.HTTPResponse, parts: SplitResult) -> str:
    if response.status != 401:
        return ""
    if parts.username is None:
        return "; it wants a name and a password, as in http://NAME:PASSWORD@HOST/PATH"
    if _challenge(response) is None:
        return ", and asks for no basic or digest authentication; others are not known here"
    return "; check the name and the password in the URL (@ is %40 there, : is %3A)"


def _untrusted(error: ssl.SSLCertVerificationError) -> str:
    return (
        f"its certificate is not trusted ({error.verify_message or 'not verified'}); name a file "
        f"with that certificate in the environment variable SSL_CERT_FILE, or use http://"
    )
