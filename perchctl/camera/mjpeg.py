"""Motion-JPEG over HTTP: ``http://host:port/path``, read by a thread, newest frame wins."""

from __future__ import annotations

import http.client
import ssl
from dataclasses import replace
from urllib.parse import SplitResult, urljoin, urlsplit, urlunsplit

from perchctl.camera.credentials import (
    Challenge,
    answer,
    challenge_of,
    credentials_of,
    without_password,
)
from perchctl.camera.jpeg import MOST_STREAM_PX, JpegSplitter, grey_pixels, size_in
from perchctl.camera.source import Clock, Grey
from perchctl.camera.stream import (
    CONNECT_TIMEOUT_S,
    READ_TIMEOUT_S,
    RECONNECT_WAIT_S,
    StreamSource,
)

READ_BYTES = 65536
MAX_REDIRECTS = 3
MOST_REQUESTS = 3
"""One that is answered by what to answer to, once more where that was too old."""

_HEADERS = {"Accept": "multipart/x-mixed-replace, image/jpeg, */*", "Connection": "close"}


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
                target = redirected(url, location)
                if why := _unsafe(url, target):
                    self.not_found = self._count == 0
                    return why
                return self._connect(target, redirects - 1)
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
            # If the network delivered several at once only the newest is worth decoding.
            for picture in reversed(splitter.feed(data)):
                image = self._decoded(picture)
                if image is not None:
                    self._put(image, encoded=picture)
                    break
                splitter.damaged += 1
            self.damaged = earlier + splitter.damaged

    def _decoded(self, picture: bytes) -> Grey | None:
        """The JPEG's pixels; None if it is damaged, or says a size above `MOST_STREAM_PX`."""
        size_px = size_in(picture)
        if size_px is None:
            return None
        width, height = size_px
        if width * height > MOST_STREAM_PX:
            self._why_silent = (
                f"its pictures say {width}x{height} px, and at most {MOST_STREAM_PX:,} pixels are "
                f"decoded; set the camera to a smaller size"
            )
            return None
        return grey_pixels(picture)


def redirected(url: str, location: str) -> str:
    """Where to go: name and password go along to the same host only, and never from https to
    another scheme."""
    before, after = urlsplit(url), urlsplit(urljoin(url, location))
    same = (before.hostname, before.port) == (after.hostname, after.port)
    kept = same and after.scheme in (before.scheme, "https")
    if kept and after.username is None and before.username is not None:
        after = after._replace(netloc=f"{before.netloc.rpartition('@')[0]}@{after.netloc}")
    return urlunsplit(after)


def _unsafe(url: str, target: str) -> str:
    """Why a redirect is not followed; an empty string if it is."""
    scheme, shown = urlsplit(target).scheme, without_password(target)
    if scheme == "http" and urlsplit(url).scheme == "https":
        return (
            f"the server redirects from https to {shown}, where pictures and password are not "
            f"encrypted; name that address in camera.source if you accept that"
        )
    if scheme not in ("http", "https"):
        return f"the server redirects to {shown}; name that address in camera.source"
    return ""


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
