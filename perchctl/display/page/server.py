"""HTTP of the live page: on loopback only, and only under loopback's names.

A site in the same browser can send requests to 127.0.0.1 too. So the Host header must
name this machine (a rebound DNS name does not), STOP needs the token of the printed
address, in a header that a foreign site may not send, and nothing allows its reading.
"""

from __future__ import annotations

import json
import secrets
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

HOSTS = ("127.0.0.1", "localhost", "::1")
TOKEN_HEADER = "X-Perchctl-Token"
MAX_STREAMS = 8
LEAST_PERIOD_S = 0.04
"""Between two pictures to one reader: 25 a second are enough for eyes."""
_CLIENT_TIMEOUT_S = 5.0
_BOUNDARY = "perchctlpicture"
_HTML = Path(__file__).with_name("page.html")


def is_loopback(host: str | None) -> bool:
    """Whether a Host header names this machine, whatever the port (it may be forwarded)."""
    if not host:
        return False
    try:
        return urlsplit(f"//{host}").hostname in HOSTS
    except ValueError:
        return False


class Content(Protocol):
    """What the server needs of the page that it serves: `perchctl.display.page.live`."""

    opened: threading.Event
    closed: bool

    def state(self) -> dict[str, Any]: ...

    def was_read(self, state: dict[str, Any]) -> None: ...

    def jpeg_after(self, number: int, flat: bool = False) -> tuple[int, bytes] | None: ...

    def pause(self, seconds: float) -> bool: ...

    def may_stop(self, token: str) -> bool: ...

    def stop(self) -> None: ...

    def remember(self, error: BaseException) -> None: ...


class PageServer(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, page: Content, port: int) -> None:
        self.page = page
        self.html = _HTML.read_text(encoding="utf-8")
        self.streams = threading.BoundedSemaphore(MAX_STREAMS)
        super().__init__(("127.0.0.1", port), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader that goes away is no error; others are kept in the page's `problem`."""
        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            self.page.remember(error)


class _Handler(BaseHTTPRequestHandler):
    timeout = _CLIENT_TIMEOUT_S
    server: PageServer
    server_version = "perchctl"
    sys_version = ""

    def do_GET(self) -> None:
        if not self._from_here():
            return
        wanted = urlsplit(self.path).path
        match wanted:
            case "/":
                self._send_page()
            case "/state":
                state = self.server.page.state()
                self._send(200, "application/json", json.dumps(state).encode())
                self.server.page.was_read(state)
            case "/stream" | "/flat":
                self._send_stream(flat=wanted == "/flat")
            case _:
                self._refuse(404, "there is /, /state, /stream and /flat")

    def do_POST(self) -> None:
        if not self._from_here():
            return
        page = self.server.page
        if urlsplit(self.path).path != "/stop":
            self._refuse(404, "only /stop takes a POST")
        elif not page.may_stop(self.headers.get(TOKEN_HEADER, "")):
            self._refuse(403, "STOP needs the token of the address that perchctl printed")
        else:
            page.stop()
            self._send(200, "application/json", b'{"stop": "requested"}')

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not worth a line on the terminal."""

    def _from_here(self) -> bool:
        origin = self.headers.get("Origin")
        foreign = origin is not None and urlsplit(origin).hostname not in HOSTS
        if is_loopback(self.headers.get("Host")) and not foreign:
            return True
        self._refuse(403, "this page is for 127.0.0.1 only")
        return False

    def _send_page(self) -> None:
        nonce = secrets.token_urlsafe(12)
        policy = (
            f"default-src 'none'; img-src 'self'; connect-src 'self'; base-uri 'none'; "
            f"form-action 'none'; frame-ancestors 'none'; "
            f"style-src 'nonce-{nonce}'; script-src 'nonce-{nonce}'"
        )
        html = self.server.html.replace("{{nonce}}", nonce)
        self.server.page.opened.set()
        self._send(200, "text/html; charset=utf-8", html.encode(), policy)

    def _send_stream(self, flat: bool) -> None:
        if not self.server.streams.acquire(blocking=False):
            self._refuse(503, f"{MAX_STREAMS} others are looking already")
            return
        try:
            self._stream(flat)
        finally:
            self.server.streams.release()

    def _stream(self, flat: bool) -> None:
        self._head(200, f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.end_headers()
        self.wfile.write(f"--{_BOUNDARY}\r\n".encode())
        page, number = self.server.page, 0
        while not page.closed:
            newest = page.jpeg_after(number, flat)
            if newest is None:
                continue
            number, jpeg = newest
            head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            # The next boundary goes out with the picture, or a browser shows it one late.
            self.wfile.write(head.encode() + jpeg + f"\r\n--{_BOUNDARY}\r\n".encode())
            page.pause(LEAST_PERIOD_S)

    def _refuse(self, status: int, why: str) -> None:
        self._send(status, "text/plain; charset=utf-8", f"{why}\n".encode())

    def _send(self, status: int, kind: str, body: bytes, policy: str | None = None) -> None:
        self._head(status, kind)
        self.send_header("Content-Length", str(len(body)))
        if policy is not None:
            self.send_header("Content-Security-Policy", policy)
        self.end_headers()
        self.wfile.write(body)

    def _head(self, status: int, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
