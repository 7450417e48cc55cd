"""Network cameras: ``rtsp://host/path``, decoded by a thread, newest frame wins.

PyAV's open and read both end in time, and say why they failed; OpenCV's FFmpeg says neither.
"""

from __future__ import annotations

import contextlib
import http.client
import math
import socket
from collections import deque
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from perchctl.camera.credentials import (
    Challenge,
    answer,
    challenge_of,
    credentials_of,
    without_password,
)
from perchctl.camera.jpeg import MOST_STREAM_PX
from perchctl.camera.source import Clock
from perchctl.camera.stream import READ_TIMEOUT_S, RECONNECT_WAIT_S, StreamSource

CONNECT_TIMEOUT_S = 5.0
RTSP_PORT = 554
MOST_ANSWER_BYTES = 65536
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


class Waiting:
    """How long a picture was under way beyond the fastest of the last ten seconds; pure.

    The camera's own time of a picture tells it. What piles up behind a radio that stalls
    comes in a heap, and would look as if it had just been taken. Where the camera's time goes
    backwards, as when its clock is set back, it starts anew, and one set forward makes the next
    picture the fastest.
    """

    def __init__(self) -> None:
        self._camera_s = -math.inf
        self._ways: deque[tuple[float, float]] = deque()  # arrival, and `way_s`

    def of(self, camera_s: float | None, arrival_s: float) -> float:
        """s; 0 where the camera gives no time."""
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

    def __init__(
        self,
        url: str,
        latency_s: float,
        clock: Clock,
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
        read_timeout_s: float = READ_TIMEOUT_S,
        reconnect_wait_s: float = RECONNECT_WAIT_S,
    ) -> None:
        super().__init__(without_password(url), latency_s, clock, read_timeout_s, reconnect_wait_s)
        self._url = url
        self._timeouts_s = (connect_timeout_s, read_timeout_s)
        self._start(self._run)

    def _connection(self) -> str:
        import av  # late: most flights have another camera
        import av.error

        # Before the first picture is before the flight: later it would cost pictures.
        if self._count == 0 and (target := redirect_of(self._url, self._timeouts_s[0])):
            self.not_found = True
            return (
                f"the server redirects to {without_password(target)}, which would get the name "
                f"and password; name that address in camera.source"
            )
        try:
            with av.open(self._url, options=_OPTIONS, timeout=self._timeouts_s) as stream:
                return self._read(stream)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            self.not_found = self._count == 0 and isinstance(error, _gone(av.error))
            # Asking is unbounded: only before the first picture, which is before the flight.
            return (self._count == 0 and unresolved(self._url)) or _reason(error)

    def _read(self, stream: Any) -> str:
        """One connection until it ends; why it ended. Errors: those of PyAV."""
        import av.error

        if not stream.streams.video:
            return "the stream has no picture in it"
        video = stream.streams.video[0]
        # A thread for each frame would hold back as many frames as there are threads.
        video.thread_type = "NONE"
        video.codec_context.options = {"max_pixels": str(MOST_STREAM_PX)}
        waiting, damaged = Waiting(), 0
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
                self._put(image, waited_s=waiting.of(time_s, self._clock()))
        return "the stream ended"


def redirect_of(url: str, timeout_s: float) -> str:
    """The other host or port to which the server redirects a URL with name and password; an empty
    string if there is none. FFmpeg would follow, and take name and password along."""
    parts = urlsplit(url)
    who = credentials_of(parts)
    if who is None or parts.hostname is None:
        return ""
    asked = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
    challenge: Challenge | None = None
    failures = (OSError, ValueError, IndexError, http.client.HTTPException)
    with (
        contextlib.suppress(*failures),  # FFmpeg will say why
        socket.create_connection((parts.hostname, parts.port or RTSP_PORT), timeout_s) as server,
        server.makefile("rb") as answers,
    ):
        # Once more with name and password, if they are asked for.
        for number, method in enumerate(("OPTIONS", "DESCRIBE", "DESCRIBE"), start=1):
            request = f"{method} {asked} RTSP/1.0\r\nCSeq: {number}\r\n"
            if challenge is not None:
                request += f"Authorization: {answer(challenge, who, method, asked)}\r\n"
            server.sendall(f"{request}\r\n".encode())
            status = int(answers.readline(MOST_ANSWER_BYTES).split()[1])
            headers = http.client.parse_headers(answers)
            answers.read(min(int(headers.get("Content-Length", 0)), MOST_ANSWER_BYTES))
            if 300 <= status < 400:
                target = urlsplit(headers.get("Location", ""))
                same = (target.hostname, target.port or RTSP_PORT) == (
                    parts.hostname, parts.port or RTSP_PORT
                )  # fmt: skip
                return "" if same else urlunsplit(target)
            if status == 401 and challenge is None:
                challenge = challenge_of(headers.get_all("WWW-Authenticate") or [])
    return ""


def unresolved(url: str) -> str:
    """Why the host's name is none, which FFmpeg calls an input/output error; else nothing. May
    take as long as the system's own asking."""
    host = urlsplit(url).hostname or ""
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:  # the latter: a name that can be none
        why = getattr(error, "strerror", None) or "it is no host's name"
        return f"the host name {host!r} cannot be resolved ({why}): correct it, or give the address"
    return ""


def _gone(errors: Any) -> tuple[type[Exception], ...]:
    """What trying again would not mend."""
    return (
        errors.HTTPUnauthorizedError,
        errors.HTTPForbiddenError,
        errors.HTTPNotFoundError,
        errors.HTTPBadRequestError,
        errors.ProtocolNotFoundError,
        errors.DecoderNotFoundError,
    )


def _reason(error: Exception) -> str:
    """Without the URL that FFmpeg's own texts have in them, the password too."""
    name = type(error).__name__
    return _REASONS.get(name) or str(getattr(error, "strerror", None) or name)


_REASONS = {
    "HTTPUnauthorizedError": "it wants another name or password (401), as in "
    "rtsp://NAME:PASSWORD@HOST/PATH (@ is %40 there, : is %3A)",
    "HTTPForbiddenError": "this name may not see the stream (403)",
    "HTTPNotFoundError": "there is no such stream (404); look for the path in its manual",
    "ConnectionRefusedError": "connection refused",
    "ExitError": "no answer in time",
    "InvalidDataError": "no answer in time, or none of RTSP",
    "TimeoutError": "no answer in time",
}
