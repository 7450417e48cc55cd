"""Cameras over a network: ``http://`` (Motion-JPEG) and ``rtsp://``, each read by a thread.

They connect, read, and connect again, with a limit; the newest frame wins. PyAV's mpjpeg reader
is not used for Motion-JPEG: without a length in front of each picture it gives one out with the
next one's first bytes, a whole period late (41 ms instead of 0.2 ms at 25 Hz).
"""

from __future__ import annotations

import contextlib
import http.client
import math
import socket
import ssl
from collections import deque
from typing import Any
from urllib.parse import SplitResult, urljoin, urlsplit, urlunsplit

from perchctl.camera.credentials import (
    Challenge,
    answer,
    challenge_of,
    credentials_of,
    without_password,
)
from perchctl.camera.jpeg import MOST_STREAM_PX, JpegSplitter, grey_pixels
from perchctl.camera.source import Clock, LiveSource, one_line

MAX_FAILED_CONNECTIONS = 5
"""Connections in a row that bring no picture before the source gives up."""


class StreamSource(LiveSource):
    """Reconnects when the stream ends, stalls or breaks; gives up after
    `MAX_FAILED_CONNECTIONS` in a row without a picture, or at once when the server
    answers that there is no such stream before the first picture came (`not_found`).

    It connects from `begin` until `close`. A subclass has `_connection`, and sets `_socket` in it.
    `damaged` counts the pictures that were dropped.
    """

    connect_timeout_s = 3.0
    read_timeout_s = 2.0
    reconnect_wait_s = 0.3

    def __init__(self, url: str, latency_s: float, clock: Clock) -> None:
        super().__init__(without_password(url), latency_s, clock)
        self._url = url
        self._socket: socket.socket | None = None
        self.not_found = False
        self.connections = 0
        self.damaged = 0

    def begin(self) -> None:
        """Connect, and read in a thread."""
        self._start(self._run)

    def close(self) -> None:
        self._stop.set()
        self._wake()
        super().close()

    def _wake(self) -> None:
        """End a read that waits for bytes."""
        current = self._socket
        if current is not None:
            with contextlib.suppress(OSError):
                current.shutdown(socket.SHUT_RDWR)

    def _connection(self) -> str:
        """Read one connection until it ends; return why it ended. It may raise any Exception."""
        raise NotImplementedError

    def _run(self) -> None:
        failed = 0
        while not self._stop.is_set():
            before = self._arrived
            self.connections += 1
            try:
                reason = self._connection()
            except Exception as error:
                # Whatever damaged bytes do to a library: a new connection may bring whole ones.
                reason = _reason(error)
            if self.not_found:
                self._fail(f"{self._name}: {reason}")
                return
            failed = 0 if self._arrived > before else failed + 1
            if failed >= MAX_FAILED_CONNECTIONS:
                self._fail(f"{self._name} gave no picture in {failed} attempts: {reason}")
                return
            self._stop.wait(self.reconnect_wait_s)


def _reason(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if isinstance(error, ConnectionRefusedError):
        return "connection refused"
    if isinstance(error, (OSError, http.client.HTTPException, ValueError)):
        return str(error) or type(error).__name__
    return one_line(error)


# --- Motion-JPEG over HTTP ----------------------------------------------------------------------


READ_BYTES = 65536

_HEADERS = {"Accept": "multipart/x-mixed-replace, image/jpeg, */*", "Connection": "close"}
_REDIRECTS = (301, 302, 303, 307, 308)


class MjpegSource(StreamSource):
    """A Motion-JPEG stream (multipart/x-mixed-replace, or bare JPEGs one after another).

    It gives up at once, too, where the server wants another name and password, or redirects to
    another address. Name and password are sent once the server asks for them, digest or basic.
    It goes straight to the camera: a proxy for the internet is not for it.
    """

    def _connection(self) -> str:
        parts = urlsplit(self._url)
        kind = (
            http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        )
        timeout_s = self.read_timeout_s if self._count else self.connect_timeout_s
        connection = kind(parts.hostname or "", parts.port, timeout=timeout_s)
        try:
            response = self._answered(connection, parts)
            if self._stop.is_set():
                return "closed"
            refusal = _refusal(response, parts)
            if response.status in (401, 403, 404, 410, *_REDIRECTS):
                self.not_found = self._count == 0
            if refusal:
                return refusal
            if self._socket is not None:
                self._socket.settimeout(self.read_timeout_s)
            self._read(response)
            return "the stream ended"
        except ssl.SSLCertVerificationError as error:
            self.not_found = self._count == 0
            return (
                f"its certificate is not trusted ({error.verify_message or 'not verified'}); name "
                f"a file with that certificate in the environment variable SSL_CERT_FILE, or use "
                f"http://"
            )
        finally:
            self._socket = None
            connection.close()

    def _answered(
        self, connection: http.client.HTTPConnection, parts: SplitResult
    ) -> http.client.HTTPResponse:
        """Return the response, with name and password once the server has asked for them, or has
        refused the nameless without asking (403)."""
        path = urlunsplit(("", "", parts.path or "/", parts.query, ""))
        headers = dict(_HEADERS)
        while True:
            connection.connect()
            self._socket = connection.sock
            if self._stop.is_set():  # `close` came before there was a socket to shut down
                raise ConnectionError("closed")
            connection.request("GET", path, headers=headers)
            response = connection.getresponse()
            who, challenge = credentials_of(parts), _challenge(response)
            if (
                response.status not in (401, 403)
                or who is None
                or challenge is None
                or "Authorization" in headers
            ):
                return response
            headers["Authorization"] = answer(challenge, who, "GET", path)
            connection.close()

    def _read(self, response: http.client.HTTPResponse) -> None:
        splitter = JpegSplitter()
        earlier = self.damaged
        while not self._stop.is_set():
            data = response.read1(READ_BYTES)
            if not data:
                return
            # If the network delivered several at once only the newest is worth decoding.
            for picture, extent in reversed(splitter.feed(data)):
                width, height = extent.size_px
                image = grey_pixels(picture) if width * height <= MOST_STREAM_PX else None
                if image is not None:
                    self._put(image, encoded=picture)
                    break
                splitter.damaged += 1
            self.damaged = earlier + splitter.damaged


def _challenge(response: http.client.HTTPResponse) -> Challenge | None:
    """Return what the server asks for; one that does not name it gets the simplest."""
    headers = response.headers.get_all("WWW-Authenticate")
    return challenge_of(headers) if headers else Challenge(digest=False)


def _refusal(response: http.client.HTTPResponse, parts: SplitResult) -> str:
    """Say why an answer holds no stream; an empty string if it holds one."""
    if response.status == 200:
        return ""
    location = response.getheader("Location")
    if response.status in _REDIRECTS and location:
        shown = without_password(urljoin(parts.geturl(), location))
        return f"the server redirects to {shown}; name that address in camera.source"
    hint = ""
    if response.status == 401 and parts.username is None:
        hint = "; it wants a name and a password, as in http://NAME:PASSWORD@HOST/PATH"
    elif response.status == 401 and _challenge(response) is None:
        hint = ", and asks for no basic or digest authentication; others are not known here"
    elif response.status == 401:
        hint = "; check the name and the password in the URL (@ is %40 there, : is %3A)"
    return f"the server answers {response.status} {response.reason}{hint}"


# --- RTSP, decoded by PyAV: its open and read end in time, and say why they failed; OpenCV's
# FFmpeg says neither.


MAX_DAMAGED = 100
"""Packets in a row that cannot be decoded before it connects anew."""
WINDOW_S = 10.0
CLOCK_SLOW = 0.02
"""By which a camera's clock may run slow before its pictures look older than they are. Allowing
for it is safer than a short window: that would forget the fastest amid a heap."""

_OPTIONS = {
    "rtsp_flags": "prefer_tcp",  # a lost packet costs every picture up to the next whole one
    "fflags": "nobuffer",
    "flags": "low_delay",
    "max_delay": "0",
    "reorder_queue_size": "0",
    "analyzeduration": "200000",
    "probesize": "200000",
    "fpsprobesize": "0",
    "allowed_media_types": "video",
}


class TransferDelay:
    """Tells how long a picture was under way beyond the fastest of the last ten seconds.

    Pure. The camera's own time of a picture shows the delay. What piles up behind a radio that
    stalls comes in a heap, and would look as if it had just been taken. Where the camera's time
    goes backwards, as when its clock is set back, it starts anew, and one set forward makes the
    next picture the fastest.
    """

    def __init__(self) -> None:
        self._camera_s = -math.inf
        self._ways: deque[tuple[float, float]] = deque()  # arrival, and `way_s`

    def waited_s(self, camera_s: float | None, arrival_s: float) -> float:
        """Return the delay beyond the fastest picture's, s; 0 where the camera gives no time."""
        if camera_s is None:
            return 0.0
        if camera_s < self._camera_s:
            self._ways.clear()
        self._camera_s = camera_s
        way_s = arrival_s * (1.0 - CLOCK_SLOW) - camera_s
        while self._ways and self._ways[-1][1] >= way_s:
            self._ways.pop()  # a window's minimum: none of these will be it any more
        self._ways.append((arrival_s, way_s))
        while self._ways[0][0] < arrival_s - WINDOW_S:
            self._ways.popleft()
        return way_s - self._ways[0][1]


class RtspSource(StreamSource):
    """An RTSP stream of any codec that FFmpeg decodes, over TCP where the camera can.

    Given up at once, too, where the camera wants another name and password.
    """

    connect_timeout_s = 5.0

    def _connection(self) -> str:
        import av  # late: most flights have another camera
        import av.error

        try:
            timeouts_s = (self.connect_timeout_s, self.read_timeout_s)
            with av.open(self._url, options=_OPTIONS, timeout=timeouts_s) as stream:
                return self._read(stream)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            self.not_found = self._count == 0 and isinstance(error, _gone(av.error))
            return _ffmpeg_reason(error)

    def _read(self, stream: Any) -> str:
        """Read one connection until it ends, and return why. Raises PyAV's errors."""
        import av.error

        if not stream.streams.video:
            return "the stream has no picture in it"
        video = stream.streams.video[0]
        # A thread for each frame would hold back as many frames as there are threads.
        video.thread_type = "NONE"
        video.codec_context.options = {"max_pixels": str(MOST_STREAM_PX)}
        delay, damaged = TransferDelay(), 0
        for packet in stream.demux(video):
            if self._stop.is_set():
                return "closed"
            try:
                frames = [(f.to_ndarray(format="gray"), f.time) for f in packet.decode()[-1:]]
            except (av.error.FFmpegError, ValueError):
                damaged += 1
                self.damaged += 1
                if damaged >= MAX_DAMAGED:
                    return "its pictures cannot be decoded"
                continue
            damaged = 0
            for image, time_s in frames:
                self._put(image, waited_s=delay.waited_s(time_s, self._clock()))
        return "the stream ended"


def _gone(errors: Any) -> tuple[type[Exception], ...]:
    """Return the errors of PyAV that another attempt would not mend."""
    return (
        errors.HTTPUnauthorizedError,
        errors.HTTPForbiddenError,
        errors.HTTPNotFoundError,
        errors.HTTPBadRequestError,
        errors.ProtocolNotFoundError,
        errors.DecoderNotFoundError,
    )


def _ffmpeg_reason(error: Exception) -> str:
    """Say what went wrong without FFmpeg's own texts, which hold the URL with its password."""
    name = type(error).__name__
    return _REASONS.get(name) or str(getattr(error, "strerror", None) or name)


_REASONS = {
    "HTTPUnauthorizedError": "it wants another name or password (401), as in "
    "rtsp://NAME:PASSWORD@HOST/PATH (@ is %40 there, : is %3A)",
    "HTTPForbiddenError": "this name may not see the stream (403)",
    "HTTPNotFoundError": "there is no such stream (404); look for the path in its manual",
    "ConnectionRefusedError": "connection refused",
    "OSError": "the host cannot be reached, or its name is unknown: correct it",
    "ExitError": "no answer in time",
    "InvalidDataError": "no answer in time, or none of RTSP",
    "TimeoutError": "no answer in time",
}
