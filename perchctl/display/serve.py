"""A page on 127.0.0.1 with content and buttons, served over HTTP in separate threads.

The flight only stores values here. An error in the page's threads is stored in `problem` and never
raised.
"""

from __future__ import annotations

import hmac
import json
import secrets
import sys
import threading
import time
from collections.abc import Callable, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import urlsplit

READS_S, LAST_READ_S = 2.5, 1.0
"""If a browser has polled in the last `READS_S` seconds, it gets `LAST_READ_S` seconds to read the
final state before the page closes."""


class Page:
    """Serves one page on localhost until closed; subclasses define its content.

    Args:
        title: heading of the page.
        orders: the functions that the buttons call in a thread of the page, keyed by the button's
            name. ``land`` and ``cut`` concern all vehicles; if both are None, there are no buttons.

    `url` contains the token that the buttons need.
    """

    HTML: ClassVar[str]
    """The page's file, with placeholders for the style and script that all pages share."""
    HAS_STREAM: ClassVar[bool] = False
    """True if the page streams images, which `jpeg_after` returns."""

    def __init__(
        self,
        title: str,
        orders: Mapping[str, Callable[[], object] | None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.title = title
        self.token = secrets.token_urlsafe(16)
        self.problem: str | None = None
        self.closed = False
        self._orders = dict(orders)
        self._ordered: set[str] = set()
        self._clock = clock
        self._changed = threading.Condition()
        self._describe: Callable[[], dict[str, Any]] = dict
        self._state_s: float | None = None  # None: no update is due
        self._read_s: float | None = None
        self._card: dict[str, Any] | None = None
        self._server = PageServer(self)
        self.url = f"http://127.0.0.1:{self.port}/?token={self.token}"
        self._thread = threading.Thread(
            target=self._server.serve_forever,
            kwargs={"poll_interval": 0.1},
            name="page",
            daemon=True,
        )
        self._thread.start()

    @property
    def port(self) -> int:
        """The port on which the page is served."""
        return int(self._server.server_address[1])

    # --- For the flight: these methods neither wait nor raise ---

    def set_state(self, describe: Callable[[], dict[str, Any]], *, live: bool = True) -> None:
        """Show the values that `describe` returns; `describe` is called when a browser polls.

        With `live`, the page warns if `set_state` is no longer called.
        """
        self._describe = describe
        self._state_s = self._clock() if live else None

    def end(self, card: dict[str, Any]) -> None:
        """Show a card (outcome, good, reason, rows) over the last image and values. If a browser is
        polling, wait up to a second for it to fetch the card."""
        with self._changed:
            self._card, self._state_s = card, None
            read_s = self._read_s
            if read_s is not None and self._clock() - read_s < READS_S:
                self._changed.wait_for(lambda: self.closed, LAST_READ_S)

    # --- For the server's threads ---

    def state(self) -> dict[str, Any]:
        """The values that the page polls: the keys of `describe` (rows of name, text and
        optional bar: start, end in 0..1 and is_enough; note, phase, battery, over), title, orders
        (``none``, ``ready``, ``land`` or ``cut`` once that was ordered, ``over``), age_s of the
        values (None if no update is due), and the card of `end`, or None."""
        try:
            described = self._describe()
        except Exception as error:
            self.store_error(error)
            described = {}
        if self._orders["land"] is None:
            orders = "none"
        elif described.get("over") or self._card is not None:
            orders = "over"
        else:
            orders = next((name for name in ("cut", "land") if name in self._ordered), "ready")
        now_s, state_s = self._clock(), self._state_s
        self._read_s = now_s
        return described | {
            "title": self.title,
            "orders": orders,
            "age_s": None if state_s is None else round(max(0.0, now_s - state_s), 2),
            "card": self._card,
            "page_problem": self.problem,
        }

    def picture(self, name: str) -> bytes | None:
        """The newest image with this name as a JPEG; None if there is currently none. The call may
        block for a second."""
        return None

    def jpeg_after(self, number: int) -> tuple[int, bytes] | None:
        """Wait for an image newer than `number`; return its number and JPEG, or None on a
        timeout."""
        return None

    def has_button(self, name: str) -> bool:
        """True if the page may have a button with this name."""
        return name in self._orders

    def may_order(self, token: str) -> bool:
        """True if the token is the one in `url`."""
        given, own = token.encode("utf-8", "replace"), self.token.encode()
        return hmac.compare_digest(given, own)

    def order(self, name: str) -> bool:
        """Press the button ``land`` or ``cut``; False if there is no such button. Pressing it again
        changes nothing."""
        act = self._orders.get(name)
        if act is None:
            return False
        act()
        self._ordered.add(name)
        return True

    def store_error(self, error: BaseException) -> None:
        self.problem = f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """End the streams and free the port; waits at most 2 s."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(2.0)


# --- HTTP server of the live page: only on the loopback interface, and only under its names ---
# A website open in the same browser can also send requests to 127.0.0.1. Therefore the Host header
# must name this machine (a rebound DNS name does not), and a button needs the token from the
# printed address, in a header that a foreign site cannot send. No response header permits a foreign
# site to read the responses.


HOSTS = ("127.0.0.1", "localhost", "::1")
TOKEN_HEADER = "X-Perchctl-Token"
LEAST_PERIOD_S = 0.04
"""Shortest time between two images for one browser, s: 25 per second are enough for the eye."""
_CLIENT_TIMEOUT_S = 5.0
_BOUNDARY = "perchctlpicture"


def _read(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def is_loopback(host: str | None) -> bool:
    """True if a Host header names this machine. The port is ignored, because it may be
    forwarded."""
    if not host:
        return False
    try:
        return urlsplit(f"//{host}").hostname in HOSTS
    except ValueError:
        return False


class PageServer(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, page: Page) -> None:
        self.page = page
        self.html = _read(page.HTML)
        for place in ("common.css", "common.js"):
            self.html = self.html.replace(f"{{{{{place}}}}}", _read(place))
        super().__init__(("127.0.0.1", 0), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Store an error in the page's `problem`, unless the browser just disconnected."""
        error = sys.exception()
        if error is not None and not isinstance(error, OSError):
            self.page.store_error(error)


class _Handler(BaseHTTPRequestHandler):
    timeout = _CLIENT_TIMEOUT_S
    server: PageServer
    server_version = "perchctl"
    sys_version = ""

    def do_GET(self) -> None:
        if not self._from_here():
            return
        parts = urlsplit(self.path).path.split("/", 2)[1:]
        match parts:
            case [""]:
                self._send_page()
            case ["state"]:
                state = json.dumps(self.server.page.state())
                # Browsers do not read NaN and Infinity.
                readable = json.loads(state, parse_constant=lambda _name: None)
                self._send(200, "application/json", json.dumps(readable).encode())
            case ["stream"] if self.server.page.HAS_STREAM:
                self._send_stream()
            case ["picture", *name]:
                jpeg = self.server.page.picture("".join(name))
                if jpeg is None:
                    self._refuse(404, "there is no picture at the moment")
                else:
                    self._send(200, "image/jpeg", jpeg)
            case _:
                self._refuse(404, "not found: this server has /, /state, /stream and /picture")

    def do_POST(self) -> None:
        if not self._from_here():
            return
        page, name = self.server.page, urlsplit(self.path).path.removeprefix("/")
        if not page.has_button(name):
            self._refuse(404, "only buttons accept POST requests")
        elif not page.may_order(self.headers.get(TOKEN_HEADER, "")):
            self._refuse(403, "this button needs the token from the address that perchctl printed")
        elif not page.order(name):
            self._refuse(403, "this page has no buttons: nothing is flying")
        else:
            self._send(200, "application/json", json.dumps({"ordered": name}).encode())

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing, because requests should not clutter the terminal."""

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
        self._send(200, "text/html; charset=utf-8", html.encode(), policy)

    def _send_stream(self) -> None:
        self._head(200, f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.end_headers()
        self.wfile.write(f"--{_BOUNDARY}\r\n".encode())
        page, number = self.server.page, 0
        while not page.closed:
            newest = page.jpeg_after(number)
            if newest is None:
                continue
            number, jpeg = newest
            head = f"Content-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n"
            # Send the next boundary together with the image; otherwise a browser shows each image
            # only when the next one arrives.
            self.wfile.write(head.encode() + jpeg + f"\r\n--{_BOUNDARY}\r\n".encode())
            time.sleep(LEAST_PERIOD_S)

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
