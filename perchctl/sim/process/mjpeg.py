"""The simulated camera's picture over HTTP, as a network camera would send it.

One part of a multipart answer is one JPEG; a slow client skips frames, the newest wins.
"""

from __future__ import annotations

import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import cv2

from perchctl.errors import ConnectionFailed
from perchctl.sim.surfaces import Picture

PATH = "/stream.mjpg"
JPEG_QUALITY = 92
_BOUNDARY = "perchctlframe"
_WAIT_S = 0.5
_CLIENT_TIMEOUT_S = 5.0


class _Newest:
    """The newest picture; encoded once, by the first client that requests it."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._encoding = threading.Lock()
        self._image: Picture | None = None
        self._number = 0
        self._encoded: tuple[int, bytes] = (0, b"")
        self.closed = False

    def put(self, image: Picture) -> None:
        with self._changed:
            self._image = image
            self._number += 1
            self._changed.notify_all()

    def close(self) -> None:
        with self._changed:
            self.closed = True
            self._changed.notify_all()

    def after(self, number: int) -> tuple[int, bytes] | None:
        """The first picture newer than `number`, as JPEG; None when none came for a while."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._number > number, _WAIT_S)
            newest, image = self._number, self._image
        if image is None or newest <= number:
            return None
        with self._encoding:
            if self._encoded[0] < newest:
                ok, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
                if not ok:
                    return None
                self._encoded = (newest, jpeg.tobytes())
            return self._encoded


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, port: int) -> None:
        self.newest = _Newest()
        super().__init__(("127.0.0.1", port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away is no error."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    timeout = _CLIENT_TIMEOUT_S
    server: _Server

    def do_GET(self) -> None:
        if self.path.split("?", 1)[0] != PATH:
            self.send_error(404, f"the stream is at {PATH}")
            return
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.flush()
        number = 0
        while not self.server.newest.closed:
            answer = self.server.newest.after(number)
            if answer is None:
                continue
            number, jpeg = answer
            self.wfile.write(
                f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\n"
                f"Content-Length: {len(jpeg)}\r\n\r\n".encode()
                + jpeg
                + b"\r\n"
            )

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not worth a line on the terminal."""


class MjpegServer:
    """Serves the newest of the published pictures on loopback.

    `port` 0 lets the operating system choose. Raises ConnectionFailed when it is taken.
    """

    def __init__(self, port: int = 0) -> None:
        try:
            self._server = _Server(port)
        except OSError as error:
            raise ConnectionFailed(
                f"TCP port {port} on 127.0.0.1 cannot be used ({error.strerror}): choose another"
            ) from None
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}{PATH}"
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True
        )
        self._thread.start()

    def publish(self, image: Picture) -> None:
        """Grey uint8 (h, w). Costs nothing while nobody watches."""
        self._server.newest.put(image)

    def close(self) -> None:
        self._server.newest.close()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
