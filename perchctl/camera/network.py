"""Cameras over a network: ``http://`` (Motion-JPEG) and ``rtsp://``, each read by a thread.

PyAV's mpjpeg reader is not used for Motion-JPEG: if no length precedes an image, the reader returns
the image only when the next one begins, a whole period late.
"""

from __future__ import annotations

import math
import re
from base64 import b64encode
from collections import deque
from contextlib import closing, suppress
from http.client import HTTPResponse
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import unquote, urlsplit, urlunsplit
from urllib.request import (
    HTTPDigestAuthHandler,
    HTTPPasswordMgrWithDefaultRealm,
    ProxyHandler,
    Request,
    build_opener,
    parse_http_list,
    parse_keqv_list,
)

from perchctl.camera.jpeg import MOST_STREAM_PX, JpegSplitter, decode_grey
from perchctl.camera.source import Clock, LiveSource
from perchctl.errors import NotFound

# --- Motion-JPEG over HTTP ---


READ_BYTES = 65536
_HEADERS = {"Accept": "multipart/x-mixed-replace, image/jpeg, */*"}
_NOT_MENDED = (401, 403, 404, 410)
"""HTTP status codes after which another attempt would fail as well."""
_NAME_AND_PASSWORD = "add the user name and password, as in http://NAME:PASSWORD@HOST/PATH"
_DIGEST = re.compile(r"(?:^|,\s*)Digest\s+", re.IGNORECASE)


class MjpegSource(LiveSource):
    """A Motion-JPEG stream (multipart/x-mixed-replace, or bare JPEGs one after another).

    The source gives up at once if the server rejects the user name and password. The user name and
    password are sent only when the camera asks for them (digest with MD5, or basic), and never to a
    redirected address. Proxy settings are ignored.
    """

    silent_advice = "close other programs that use it: many cameras serve only one at a time"

    def __init__(self, url: str, latency_s: float, clock: Clock) -> None:
        super().__init__(url, latency_s, clock)
        parts = urlsplit(url)
        self._bare = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
        self._name_and_password = unquote(parts.username or ""), unquote(parts.password or "")

    def _connection(self) -> str:
        try:
            with closing(self._opened()) as response:
                self._connected()
                self._read(response)
        except HTTPError as refused:
            refused.close()
            reason = f"the server answered {refused.code} {refused.reason}"
            if refused.code in _NOT_MENDED:
                advice = _NAME_AND_PASSWORD if refused.code == 401 else ""
                raise NotFound(f"{self._name}: {reason}", advice) from None
            self._connected()
            self._note(reason)
            return reason
        return "the stream ended"

    def _opened(self) -> HTTPResponse:
        """Return the server's response. Credentials are sent only once, when the camera asks for
        them, because cameras lock out clients that send them repeatedly."""
        opener, request = build_opener(ProxyHandler({})), Request(self._bare, headers=_HEADERS)
        response: HTTPResponse
        try:
            response = opener.open(request, timeout=self.read_timeout_s)
        except HTTPError as refused:
            asked = ", ".join(refused.headers.get_all("WWW-Authenticate") or [])
            answer = self._answer(asked, request) if any(self._name_and_password) else None
            if refused.code != 401 or answer is None:
                raise
            refused.close()
            request.add_unredirected_header("Authorization", answer)
            response = opener.open(request, timeout=self.read_timeout_s)
        return response

    def _answer(self, asked: str, request: Request) -> str | None:
        """Return the Authorization header: a digest if the camera accepts one, since basic
        authentication reveals the password. Returns None if the library supports none of the
        camera's digest algorithms."""
        digests = _DIGEST.split(asked)[1:]
        if not digests:
            return "Basic " + b64encode(":".join(self._name_and_password).encode()).decode()
        passwords = HTTPPasswordMgrWithDefaultRealm()
        passwords.add_password(None, request.full_url, *self._name_and_password)
        handler = HTTPDigestAuthHandler(passwords)
        for digest in digests:
            with suppress(ValueError, URLError):  # the library lacks the algorithm
                challenge = parse_keqv_list(parse_http_list(digest))
                return f"Digest {handler.get_authorization(request, challenge)}"
        return None

    def _read(self, response: HTTPResponse) -> None:
        splitter = JpegSplitter()
        while not self._stop.is_set():
            data = response.read1(READ_BYTES)
            if not data:
                return
            if self._arrived == 0:
                kind = response.headers.get("Content-Type", "no content type")
                self._note(
                    f"the server sends {kind}, but no complete JPEG",
                    "check that the address points to the stream itself",
                )
            # If several images arrived at once, only the newest is worth decoding.
            for picture, (width, height) in reversed(splitter.feed(data)):
                if width * height > MOST_STREAM_PX:
                    self._drop(
                        f"the picture size is {width}x{height} px, but at most "
                        f"{MOST_STREAM_PX} px are allowed"
                    )
                    continue
                image = decode_grey(picture)
                if image is not None:
                    self._put(image, encoded=picture)
                    break
                self._drop("the JPEG cannot be decoded")


# --- RTSP, decoded by PyAV ---
# PyAV's open and read have timeouts and report why they failed, unlike OpenCV's FFmpeg backend.


MAX_DAMAGED = 100
"""Number of successive packets that cannot be decoded before the source reconnects."""
DELAY_WINDOW_S = 10.0
CLOCK_SLOW = 0.02
"""Fraction by which a camera's clock may run slow; if it is slower than that, its images seem to
grow older and older."""

_OPTIONS = {
    "rtsp_flags": "prefer_tcp",  # over UDP, a lost packet spoils all images until a keyframe
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
    """Estimates how much longer an image's transfer took than the fastest one in the last 10 s.

    The delay is computed from the camera's timestamps. Without this correction, old images that
    arrive in a burst after a radio stall would seem to be new.
    """

    def __init__(self) -> None:
        self._camera_s = -math.inf
        self._ways: deque[tuple[float, float]] = (
            deque()
        )  # arrival times, each with its transfer time `way_s`

    def extra_delay_s(self, camera_s: float | None, arrival_s: float) -> float:
        """How much longer this image's transfer took than the fastest one's, s; 0 if `camera_s`,
        the camera's timestamp, is None."""
        if camera_s is None:
            return 0.0
        if camera_s < self._camera_s:
            self._ways.clear()
        self._camera_s = camera_s
        way_s = arrival_s * (1.0 - CLOCK_SLOW) - camera_s
        while self._ways and self._ways[-1][1] >= way_s:
            self._ways.pop()  # sliding minimum: the newest value is smaller
        self._ways.append((arrival_s, way_s))
        while self._ways[0][0] < arrival_s - DELAY_WINDOW_S:
            self._ways.popleft()
        return way_s - self._ways[0][1]


class RtspSource(LiveSource):
    """An RTSP stream with any codec that FFmpeg decodes, over TCP if the camera supports it.

    The source gives up at once if the camera rejects the user name and password.
    """

    connect_timeout_s = 5.0
    silent_advice = "close other programs that use it: many cameras serve only one at a time"
    unreached_advice = (
        "check that the address is right, that the camera is on, and that no other program uses it"
    )

    def __init__(self, url: str, latency_s: float, clock: Clock) -> None:
        super().__init__(url, latency_s, clock)
        self._url = url

    def _connection(self) -> str:
        import av  # imported late, since most flights use another camera
        import av.error

        try:
            timeouts_s = (self.connect_timeout_s, self.read_timeout_s)
            with av.open(self._url, options=_OPTIONS, timeout=timeouts_s) as stream:
                return self._read(stream)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            # Leave out the error's text, because it contains the URL with the password.
            name = type(error).__name__
            reason = str(_REASONS.get(name) or getattr(error, "strerror", None) or name)
            if name in _FINAL:
                raise NotFound(f"{self._name}: {reason}", _ADVICE.get(name, "")) from None
            return reason

    def _read(self, stream: Any) -> str:
        """Read from one connection until it ends, and return why it ended. Raises PyAV's errors."""
        import av.error

        if not stream.streams.video:
            self._is_connected = True
            self._note(
                "the stream contains no video", "check that the address points to the video stream"
            )
            return "the stream contains no video"
        self._connected()
        video = stream.streams.video[0]
        # With one decoder thread per frame, images would be delayed by as many frames as there are
        # threads.
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
                self._drop("decoding failed")
                if damaged >= MAX_DAMAGED:
                    return "the pictures cannot be decoded"
                continue
            damaged = 0
            for image, time_s in frames:
                self._put(image, waited_s=delay.extra_delay_s(time_s, self._clock()))
        return "the stream ended"


_FINAL = (
    "HTTPUnauthorizedError",
    "HTTPForbiddenError",
    "HTTPNotFoundError",
    "HTTPBadRequestError",
    "DecoderNotFoundError",
)
"""Names of PyAV's errors after which another attempt would fail as well."""
_REASONS = {
    "HTTPUnauthorizedError": "the camera rejects this user name and password (401)",
    "OSError": "the host cannot be reached, or its name cannot be resolved",
    "ExitError": "no answer in time, or no video in the stream",
    "InvalidDataError": "no answer in time, or not an RTSP answer",
}
"""Texts that replace FFmpeg's less informative ones."""
_ADVICE = {
    "HTTPUnauthorizedError": "write the user name and password as in rtsp://NAME:PASSWORD@HOST/PATH"
}
