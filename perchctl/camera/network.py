"""Cameras over a network: ``http://`` (Motion-JPEG) and ``rtsp://``, each read by a thread.

PyAV's mpjpeg reader is not used for Motion-JPEG: without a length in front of each picture it
gives one out with the next one's first bytes, a whole period late (41 ms instead of 0.2 ms at
25 Hz).
"""

from __future__ import annotations

import math
import ssl
from collections import deque
from contextlib import closing
from http.client import HTTPResponse
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import urljoin, urlsplit, urlunsplit
from urllib.request import HTTPRedirectHandler, ProxyHandler, Request, build_opener

from perchctl.camera.credentials import authorization, without_password
from perchctl.camera.jpeg import MOST_STREAM_PX, JpegSplitter, grey_pixels
from perchctl.camera.source import Clock, LiveSource
from perchctl.errors import NotFound

# --- Motion-JPEG over HTTP --------------------------------------------


READ_BYTES = 65536
_HEADERS = {"Accept": "multipart/x-mixed-replace, image/jpeg, */*"}
_REDIRECTS = (301, 302, 303, 307, 308)


class _NoRedirects(HTTPRedirectHandler):
    """Takes a redirect for a refusal: another host would get the name and the password."""

    def redirect_request(self, *_: Any) -> None:
        return None


class MjpegSource(LiveSource):
    """A Motion-JPEG stream (multipart/x-mixed-replace, or bare JPEGs one after another).

    It gives up at once, too, where the server wants another name and password, or redirects to
    another address. Name and password are sent once the server asks for them, digest or basic.
    It goes straight to the camera: a proxy for the internet is not for it.
    """

    def __init__(self, url: str, latency_s: float, clock: Clock) -> None:
        super().__init__(url, latency_s, clock)
        self._url = url

    def _connection(self) -> str:
        try:
            with closing(self._opened()) as response:
                self._read(response)
        except HTTPError as refused:
            with refused:
                reason = _refusal(refused, self._url)
            if refused.code in (401, 403, 404, 410, *_REDIRECTS):
                raise NotFound(f"{self._name}: {reason}") from None
            return reason
        except URLError as error:
            if not isinstance(error.reason, ssl.SSLCertVerificationError):
                raise
            raise NotFound(
                f"{self._name}: its certificate is not trusted ({error.reason.verify_message}); "
                f"name a file with that certificate in the environment variable SSL_CERT_FILE, or "
                f"use http://"
            ) from None
        return "the stream ended"

    def _opened(self) -> HTTPResponse:
        """Return the stream's response, with name and password once the server has asked for them.
        Raises HTTPError for any other answer."""
        parts = urlsplit(self._url)
        bare = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
        opener = build_opener(ProxyHandler({}), _NoRedirects)
        request = Request(bare, headers=_HEADERS)
        try:
            response: HTTPResponse = opener.open(request, timeout=self.read_timeout_s)
        except HTTPError as refused:
            asked = refused.headers.get_all("WWW-Authenticate") or []
            given = authorization(asked, request, parts) if refused.code == 401 else None
            if given is None:
                raise
            refused.close()
            request.add_unredirected_header("Authorization", given)
            response = opener.open(request, timeout=self.read_timeout_s)
        return response

    def _read(self, response: HTTPResponse) -> None:
        splitter = JpegSplitter()
        while not self._stop.is_set():
            data = response.read1(READ_BYTES)
            if not data:
                return
            # If the network delivered several at once only the newest is worth decoding.
            for picture, extent in reversed(splitter.feed(data)):
                width, height = extent.size_px
                image = grey_pixels(picture) if 0 < width * height <= MOST_STREAM_PX else None
                if image is not None:
                    self._put(image, encoded=picture)
                    break


def _refusal(refused: HTTPError, url: str) -> str:
    """Say why an answer holds no stream."""
    hint = ""
    if refused.code in _REDIRECTS:
        to = without_password(urljoin(url, refused.headers.get("Location", "")))
        hint = f": it redirects to {to}; name that address in camera.source"
    elif refused.code == 401:
        hint = (
            "; write a name and a password that it takes, for basic or digest authentication by "
            "MD5, as in http://NAME:PASSWORD@HOST/PATH (@ is %40 there, : is %3A)"
        )
    return f"the server answers {refused.code} {refused.reason}{hint}"


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


class RtspSource(LiveSource):
    """An RTSP stream of any codec that FFmpeg decodes, over TCP where the camera can.

    Given up at once, too, where the camera wants another name and password.
    """

    connect_timeout_s = 5.0

    def __init__(self, url: str, latency_s: float, clock: Clock) -> None:
        super().__init__(url, latency_s, clock)
        self._url = url

    def _connection(self) -> str:
        import av  # late: most flights have another camera
        import av.error

        try:
            timeouts_s = (self.connect_timeout_s, self.read_timeout_s)
            with av.open(self._url, options=_OPTIONS, timeout=timeouts_s) as stream:
                return self._read(stream)
        except (av.error.FFmpegError, OSError, ValueError) as error:
            # Without FFmpeg's own texts, which hold the URL with its password.
            name = type(error).__name__
            if name in _FINAL:
                raise NotFound(f"{self._name}: {_FINAL[name]}") from None
            return str(_PASSING.get(name) or getattr(error, "strerror", None) or name)

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
                if damaged >= MAX_DAMAGED:
                    return "its pictures cannot be decoded"
                continue
            damaged = 0
            for image, time_s in frames:
                self._put(image, waited_s=delay.waited_s(time_s, self._clock()))
        return "the stream ended"


_FINAL = {
    "HTTPUnauthorizedError": "it wants another name or password (401), as in "
    "rtsp://NAME:PASSWORD@HOST/PATH (@ is %40 there, : is %3A)",
    "HTTPForbiddenError": "this name may not see the stream (403)",
    "HTTPNotFoundError": "there is no such stream (404); look for the path in its manual",
    "HTTPBadRequestError": "it does not understand the request (400)",
    "DecoderNotFoundError": "its pictures are in a form that FFmpeg cannot decode",
}
"""PyAV's errors that another attempt would not mend, by name."""
_PASSING = {
    "ConnectionRefusedError": "connection refused",
    "OSError": "the host cannot be reached, or its name is unknown: correct it",
    "ExitError": "no answer in time",
    "InvalidDataError": "no answer in time, or none of RTSP",
    "TimeoutError": "no answer in time",
}
