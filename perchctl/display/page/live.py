"""The live page: newest picture and numbers, on 127.0.0.1, from threads of its own.

The loop only leaves references in a newest-value slot; drawing, JPEG and HTTP happen in
the page's threads, and what fails there is remembered in `problem`, never raised.
"""

from __future__ import annotations

import hmac
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import cv2

from perchctl.display.page.server import PageServer
from perchctl.display.page.sketch import Sketch, draw_flat, draw_sketch
from perchctl.errors import InvalidValue
from perchctl.vision import CameraModel

JPEG_QUALITY = 80
WAIT_S = 0.5
READS_S, LAST_READ_S = 2.5, 2.0
"""A reader that asked so recently is waited for so long at the end, until it has the last state."""
_RATE_FRAMES = 30  # over which the frame rate is taken
_RATE_STALE_S = 1.0

PageState = dict[str, Any]


class LivePage:
    """Serves one page until closed.

    Args:
        camera: for drawing the axes.
        title: heading of the page.
        port: 0 lets the operating system choose.
        on_stop: called by the STOP button, from a thread of the page; None: no button.

    `url` holds the token that STOP needs. Errors: InvalidValue for a port in use.
    """

    def __init__(
        self,
        camera: CameraModel,
        title: str,
        port: int = 0,
        on_stop: Callable[[], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.camera = camera
        self.title = title
        self.token = secrets.token_urlsafe(16)
        self.problem: str | None = None
        self.closed = False
        self.opened = threading.Event()
        self._on_stop = on_stop
        self._stop_requested = False
        self._clock = clock
        self._changed = threading.Condition()
        self._drawing = threading.Lock()
        self._sketch: Sketch | None = None
        self._number = 0
        self._frame: int | None = None
        self._times: deque[float] = deque(maxlen=_RATE_FRAMES)
        self._jpegs: dict[bool, tuple[int, bytes]] = {}
        self._describe: Callable[[], PageState] = dict
        self._told_s: float | None = None  # None: nothing is due
        self._read_s: float | None = None
        self._card: PageState | None = None
        self._card_read = False
        try:
            self._server = PageServer(self, port)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise InvalidValue(
                f"port {port} on 127.0.0.1 cannot be used ({reason}); choose another with "
                f"--view-port, or leave that out"
            ) from None
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}/?token={self.token}"
        self._thread = threading.Thread(
            target=self._server.serve_forever,
            kwargs={"poll_interval": 0.1},
            name="page",
            daemon=True,
        )
        self._thread.start()

    # --- for the loop: neither waits nor raises ------------------------------

    def show(self, frame: int, sketch: Sketch) -> None:
        """The newest picture; the same `frame` again replaces it."""
        with self._changed:
            if frame != self._frame:
                self._times.append(self._clock())
            self._frame, self._sketch = frame, sketch
            self._number += 1
            self._changed.notify_all()

    def tell(self, describe: Callable[[], PageState], *, live: bool = True) -> None:
        """The newest numbers; formatted only when a reader polls. While they are `live`, others
        are due at once, and the page says when they stay away."""
        self._describe = describe
        self._told_s = self._clock() if live else None

    def end(self, card: PageState) -> None:
        """How it ended: what it shows now stays, with this card. Waits, bounded, until a reader
        that is there has it."""
        with self._changed:
            self._card, self._told_s = card, None
            read_s = self._read_s
            if read_s is not None and self._clock() - read_s < READS_S:
                self._changed.wait_for(lambda: self._card_read or self.closed, LAST_READ_S)

    @property
    def stop_requested(self) -> bool:
        return self._stop_requested

    # --- for the server's threads --------------------------------------------

    def state(self) -> PageState:
        """What the page polls: `describe`'s keys (rows of a name, a text and, for a bar, a share
        0..1; note, phase, battery, over, stop_did), and title, rate_hz, stop (``none``, ``ready``,
        ``requested``, ``over``), age_s of these numbers (None where no others are due), card
        (`end`'s, or None)."""
        try:
            described = self._describe()
        except Exception as error:
            self.remember(error)
            described = {}
        if self._on_stop is None:
            stop = "none"
        elif described.get("over") or self._card is not None:
            stop = "over"
        else:
            stop = "requested" if self._stop_requested else "ready"
        fixed = {"title": self.title, "rate_hz": round(self.rate_hz(), 1), "stop": stop}
        fixed["flat"] = self._is_there(-1, flat=True)  # there is a picture without distortion
        told_s, card = self._told_s, self._card
        fixed["age_s"] = None if told_s is None else round(max(0.0, self._clock() - told_s), 2)
        fixed["card"] = card
        self._read_s = self._clock()
        return described | fixed | {"page_problem": self.problem}

    def was_read(self, state: PageState) -> None:
        """That state has reached a reader."""
        if state.get("card") is not None:
            with self._changed:
                self._card_read = True
                self._changed.notify_all()

    def rate_hz(self) -> float:
        """Frames a second, 0 once none has come for a second."""
        with self._changed:
            times, now_s = list(self._times), self._clock()
        if len(times) < 2 or now_s - times[-1] > _RATE_STALE_S or times[-1] <= times[0]:
            return 0.0
        return (len(times) - 1) / (times[-1] - times[0])

    def jpeg_after(self, number: int, flat: bool = False) -> tuple[int, bytes] | None:
        """The newest picture if newer than `number`, drawn; or the same `flat`, without the
        lens's distortion. None when none came for a while."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._is_there(number, flat), WAIT_S)
            newest, sketch = self._number, self._sketch
            if sketch is None or not self._is_there(number, flat):
                return None
        with self._drawing:  # once, for all readers
            known = self._jpegs.get(flat)
            if known is None or known[0] < newest:
                picture = draw_flat(sketch) if flat else draw_sketch(sketch, self.camera)
                if picture is None:
                    return None
                quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
                ok, jpeg = cv2.imencode(".jpg", picture, quality)
                if not ok:
                    return None
                known = self._jpegs[flat] = (newest, jpeg.tobytes())
            return known

    def _is_there(self, number: int, flat: bool) -> bool:
        """Whether a picture newer than `number` has come, and can be drawn `flat`."""
        sketch = self._sketch
        if sketch is None or self._number <= number:
            return False
        return not flat or sketch.flat_places_px is not None

    def pause(self, seconds: float) -> bool:
        """Wait, less when the page closes; True when it has."""
        with self._changed:
            return self._changed.wait_for(lambda: self.closed, seconds)

    def may_stop(self, token: str) -> bool:
        given, own = token.encode("utf-8", "replace"), self.token.encode()
        return self._on_stop is not None and hmac.compare_digest(given, own)

    def stop(self) -> None:
        """The STOP button; pressing it again changes nothing."""
        with self._changed:
            first, self._stop_requested = not self._stop_requested, True
        if first and self._on_stop is not None:
            self._on_stop()

    def remember(self, error: BaseException) -> None:
        self.problem = f"{type(error).__name__}: {error}"

    def close(self) -> None:
        """End the streams and free the port; bounded."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(2.0)
