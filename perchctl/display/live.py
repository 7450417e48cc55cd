"""The live page: newest picture and numbers, on 127.0.0.1, from threads of its own.

The loop only leaves references in a newest-value slot; drawing, JPEG and HTTP happen in
the page's threads, and what fails there is remembered in `problem`, never raised.
"""

from __future__ import annotations

import contextlib
import hmac
import json
import math
import secrets
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import MARKERS, CameraModel, Frame, PipelineOutput, project

LIVE_JPEG_QUALITY = 80
LIVE_WAIT_S = 0.5
READS_S, LAST_READ_S = 2.5, 1.0
"""A reader that asked so recently is given so long at the end to read the last state."""
_PICTURE_STALE_S = 1.0


class LivePage:
    """Serves one page on localhost until closed.

    Args:
        camera: projects the axes to draw.
        title: heading of the page.
        on_land: called by the button Land, from a thread of the page; None: no buttons.
        on_cut: called by the button Cut motors, likewise.

    `url` holds the token that the buttons need.
    """

    def __init__(
        self,
        camera: CameraModel,
        title: str,
        on_land: Callable[[], None] | None = None,
        on_cut: Callable[[], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.camera = camera
        self.title = title
        self.token = secrets.token_urlsafe(16)
        self.problem: str | None = None
        self.closed = False
        self._orders = {"land": on_land, "cut": on_cut}
        self._ordered: set[str] = set()
        self._clock = clock
        self._changed = threading.Condition()
        self._drawing = threading.Lock()
        self._sketch: Sketch | None = None
        self._number = 0
        self._picture_s = -math.inf
        self._jpeg: tuple[int, bytes] | None = None
        self._describe: Callable[[], dict[str, Any]] = dict
        self._state_s: float | None = None  # None: nothing is due
        self._read_s: float | None = None
        self._card: dict[str, Any] | None = None
        self._server = PageServer(self)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/?token={self.token}"
        self._thread = threading.Thread(
            target=self._server.serve_forever,
            kwargs={"poll_interval": 0.1},
            name="page",
            daemon=True,
        )
        self._thread.start()

    # --- for the loop: neither waits nor raises ---

    def show(self, sketch: Sketch) -> None:
        """Show `sketch` until the next call."""
        with self._changed:
            self._picture_s, self._sketch = self._clock(), sketch
            self._number += 1
            self._changed.notify_all()

    def set_state(self, describe: Callable[[], dict[str, Any]], *, live: bool = True) -> None:
        """Show the values that `describe` returns; it is called when a browser polls.

        With `live`, the page warns when `set_state` is no longer called.
        """
        self._describe = describe
        self._state_s = self._clock() if live else None

    def end(self, card: dict[str, Any]) -> None:
        """Show a card (outcome, good, reason, rows) over the last picture and values. Waits up
        to a second for a polling browser to get the card."""
        with self._changed:
            self._card, self._state_s = card, None
            read_s = self._read_s
            if read_s is not None and self._clock() - read_s < READS_S:
                self._changed.wait_for(lambda: self.closed, LAST_READ_S)

    # --- for the server's threads ---

    def state(self) -> dict[str, Any]:
        """The values that the page polls: the keys of `describe` (rows of name, text and optional
        bar: start, end in 0..1 and is_enough; note, phase, battery, over), title, fresh (whether
        pictures come), orders (``none``, ``ready``, ``land`` or ``cut`` once that was ordered,
        ``over``), age_s of the values (None if no update is due), and the card of `end`, or None.
        """
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
            "fresh": now_s - self._picture_s < _PICTURE_STALE_S,
            "orders": orders,
            "age_s": None if state_s is None else round(max(0.0, now_s - state_s), 2),
            "card": self._card,
            "page_problem": self.problem,
        }

    def jpeg_after(self, number: int) -> tuple[int, bytes] | None:
        """Wait for a picture newer than `number`; return its number and JPEG, or None on a
        timeout."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._number > number, LIVE_WAIT_S)
            newest, sketch = self._number, self._sketch
            if sketch is None or newest <= number:
                return None
        with self._drawing:  # once, for all readers
            if self._jpeg is None or self._jpeg[0] < newest:
                picture = draw_sketch(sketch, self.camera)
                quality = [cv2.IMWRITE_JPEG_QUALITY, LIVE_JPEG_QUALITY]
                ok, jpeg = cv2.imencode(".jpg", picture, quality)
                if not ok:
                    return None
                self._jpeg = (newest, jpeg.tobytes())
            return self._jpeg

    def may_order(self, token: str) -> bool:
        """True if the token is the one of `url`."""
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


@contextlib.contextmanager
def live_page(
    camera: CameraModel,
    title: str,
    enabled: bool,
    report: Callable[[str], None],
    on_land: Callable[[], None] | None = None,
    on_cut: Callable[[], None] | None = None,
) -> Iterator[LivePage | None]:
    """Serve a page during the block; yield None unless `enabled`. `report` prints the address, and
    at the end the page's problem if any. `on_land`, `on_cut`: as in `LivePage`."""
    if not enabled:
        yield None
        return
    page = LivePage(camera, title, on_land, on_cut)
    report(
        f"live page{' (with buttons to land and to cut the motors)' if on_cut else ''}: {page.url}"
    )
    try:
        yield page
    finally:
        page.close()
        if page.problem is not None:
            report(f"the live page failed: {page.problem}")


# --- HTTP of the live page: on loopback only, and only under loopback's names ---
# A site in the same browser can send requests to 127.0.0.1 too. So the Host header must
# name this machine (a rebound DNS name does not), a button needs the token of the printed
# address, in a header that a foreign site may not send, and nothing allows its reading.


HOSTS = ("127.0.0.1", "localhost", "::1")
TOKEN_HEADER = "X-Perchctl-Token"
LEAST_PERIOD_S = 0.04
"""Between two pictures to one reader: 25 a second are enough for eyes."""
_CLIENT_TIMEOUT_S = 5.0
_BOUNDARY = "perchctlpicture"
_HTML = Path(__file__).with_name("page.html")


def is_loopback(host: str | None) -> bool:
    """True if a Host header names this machine, whatever the port (it may be forwarded)."""
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

    def __init__(self, page: LivePage) -> None:
        self.page = page
        self.html = _HTML.read_text(encoding="utf-8")
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
        match urlsplit(self.path).path:
            case "/":
                self._send_page()
            case "/state":
                state = json.dumps(self.server.page.state())
                # A browser reads no NaN and no Infinity.
                readable = json.loads(state, parse_constant=lambda _name: None)
                self._send(200, "application/json", json.dumps(readable).encode())
            case "/stream":
                self._send_stream()
            case _:
                self._refuse(404, "there is /, /state and /stream")

    def do_POST(self) -> None:
        if not self._from_here():
            return
        page, name = self.server.page, urlsplit(self.path).path.removeprefix("/")
        if name not in ("land", "cut"):
            self._refuse(404, "only /land and /cut take a POST")
        elif not page.may_order(self.headers.get(TOKEN_HEADER, "")):
            self._refuse(403, "this button needs the token of the address that perchctl printed")
        elif not page.order(name):
            self._refuse(403, "this page has no buttons: nothing flies")
        else:
            self._send(200, "application/json", json.dumps({"ordered": name}).encode())

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing: requests are not worth a line on the terminal."""

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
            # The next boundary goes out with the picture, or a browser shows it one late.
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


# --- The picture with what was found in it: outlines and the target's axes ---


# Blue, green, red.
_OUTLINE = {"large": (0, 200, 255), "small": (255, 200, 0)}
_AXES = ((60, 60, 255), (60, 220, 60), (255, 120, 60))
_OTHER = (255, 255, 255)
_SUBPIXEL_BITS = 4
AXES_OF_SIDE = 0.5
"""Length of the drawn axes, in sides of the large marker."""
_DRAWABLE_PX = 8000.0  # beyond this a line's end shows nothing, and would overflow


@dataclass(frozen=True, eq=False)
class Sketch:
    """A picture with the overlay to draw on it, which is done outside the flight loop.

    Attributes:
        image: grey (h, w) uint8; not changed by drawing.
        outlines: name and corners (4, 2) px of each marker.
        pose: the target's rvec (3,) and tvec (3,) in the camera frame, and the length of its axes
            in m; None: no axes.
    """

    image: NDArray[np.uint8]
    outlines: tuple[tuple[str, Array], ...] = ()
    pose: tuple[Array, Array, float] | None = None


def make_sketch(frame: Frame, output: PipelineOutput | None, large_side_m: float) -> Sketch:
    """The frame with its marker outlines and the axes of the target's pose; only the frame
    if `output` is None. `large_side_m` is the side of the large marker."""
    if output is None or output.detections.frame_index != frame.index:
        return Sketch(frame.image)
    found = ((name, output.detections.get(name)) for name in MARKERS)
    poses = output.poses
    pose = next((poses[name] for name in ("joint", "large", "small") if name in poses), None)
    return Sketch(
        frame.image,
        tuple((name, seen.corners_px) for name, seen in found if seen is not None),
        None if pose is None else (pose.rvec_rad, pose.tvec_m, AXES_OF_SIDE * large_side_m),
    )


def draw_sketch(sketch: Sketch, camera: CameraModel) -> NDArray[np.uint8]:
    """The picture with its overlay, BGR (h, w, 3) uint8. Lines far outside the picture, and
    axes with a tip behind the camera, are left out."""
    picture = np.asarray(cv2.cvtColor(sketch.image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for name, corners in sketch.outlines:
        _draw_line(picture, np.vstack([corners, corners[:1]]), _OUTLINE.get(name, _OTHER), 1)
    if sketch.pose is not None:
        rvec, tvec, length_m = sketch.pose
        ends = np.vstack([np.zeros(3), np.eye(3) * length_m])
        depth = (ends @ np.asarray(cv2.Rodrigues(rvec)[0]).T + tvec)[:, 2]
        if (depth > 1e-3).all():
            points = project(ends, rvec, tvec, camera)
            for tip, colour in zip(points[1:], _AXES, strict=True):
                _draw_line(picture, np.vstack([points[0], tip]), colour, 2)
    return picture


def _draw_line(
    picture: NDArray[np.uint8], points_px: Array, colour: tuple[int, int, int], width: int
) -> None:
    if np.abs(points_px).max() < _DRAWABLE_PX:  # and so no number is missing
        fixed = np.rint(points_px * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.polylines(picture, [fixed], False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
