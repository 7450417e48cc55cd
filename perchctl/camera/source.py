"""What every frame source offers, and what live and recorded ones share."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol
from urllib.error import URLError

import cv2
import numpy as np

from perchctl.camera.credentials import without_password
from perchctl.camera.health import Grey, same_bytes
from perchctl.errors import InvalidValue, PerchError, TimedOut
from perchctl.profile import CameraConfig
from perchctl.vision import CameraModel, Frame


class NewestSlot:
    """Keeps the newest picture, with the time of its first arrival.

    A picture that the receiver repeats does not replace the original until the original is taken,
    so the arrival time stays. Afterwards the repeat is given with the same index and
    `Frame.repeated`: a sign of life, not a measurement.
    """

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._last: Grey | None = None
        self.count = 0

    def put(
        self, image: Grey, t_s: float, t_arrival_s: float, encoded: bytes | None = None
    ) -> None:
        """Keep a picture with its times of exposure and arrival; `encoded`: its JPEG, if any."""
        if self._last is None or not same_bytes(self._last, image):
            self._last = image
            self._frame = Frame(self.count, t_s, image, t_arrival_s, encoded=encoded)
            self.count += 1
        elif self._frame is None or self._frame.repeated:
            self._frame = Frame(self.count - 1, t_s, image, t_arrival_s, repeated=True)

    def take(self) -> Frame | None:
        """The newest frame; None if it was returned already."""
        frame, self._frame = self._frame, None
        return frame


Clock = Callable[[], float]

SILENT_AFTER_S = 1.0
"""A live source without a new frame for so long counts as gone."""
CLOSE_WITHIN_S = 3.0


class FrameSource(Protocol):
    """A source of frames.

    A live source keeps only the newest frame and stamps it when it arrives; a
    recorded one gives every frame once, at the pace it is polled, with the times
    of the recording.
    """

    @property
    def live(self) -> bool: ...

    @property
    def finished(self) -> bool:
        """True if no frame will come any more; a live source never finishes."""

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Width and height of the frames, once the first has come."""

    def poll(self, now_s: float) -> Frame | None:
        """The newest frame (recorded: the next); None if none came since the last call."""

    def problem(self, now_s: float) -> str | None:
        """A sentence if the source is lost at `now_s`, else None."""

    def describe(self) -> str: ...

    def close(self) -> None: ...


def to_grey(image: Any) -> Grey:
    """A contiguous 8-bit grey picture of grey, BGR or BGRA, 8 or 16 bits."""
    if image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    if image.ndim == 3 and image.shape[2] == 1:
        image = image[:, :, 0]
    if image.ndim == 3:
        code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        image = cv2.cvtColor(image, code)
    return np.ascontiguousarray(image, np.uint8)


def check_size(size_px: tuple[int, int] | None, camera: CameraModel, source: str) -> None:
    """Raises InvalidValue, which names `source`, if frames and calibration differ in size.

    Frames are not scaled to fit: cropped and scaled modes of a camera may have the same aspect
    ratio, but need different calibrations.
    """
    if size_px is None or size_px == camera.size_px:
        return
    raise InvalidValue(
        f"{source} delivers frames of {size_px[0]}x{size_px[1]} px, but the calibration was made "
        f"at {camera.size_px[0]}x{camera.size_px[1]} px; set the camera to that size or "
        f"calibrate it at this one"
    )


def describe_error(error: Exception) -> str:
    """Describe an unforeseen error by class and text, without passwords."""
    if isinstance(error, URLError) and isinstance(error.reason, Exception):
        error = error.reason
    if isinstance(error, TimeoutError):
        return "no answer in time"
    if isinstance(error, ConnectionRefusedError):
        return "connection refused"
    text = " ".join(without_password(str(error)).split())
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class LiveSource:
    """A live source: a thread reads the camera, and the loop polls the newest frame.

    A subclass defines `_connection`, which opens and reads the camera. A connection that ended is
    made again after `reconnect_wait_s`, until `max_failures` in a row brought no picture.
    """

    live = True
    finished = False
    connect_timeout_s = 3.0
    read_timeout_s = 2.0
    reconnect_wait_s = 0.3
    max_failures = 5.0

    def __init__(self, name: str, latency_s: float, clock: Clock) -> None:
        self._name = without_password(name)
        self._latency_s = latency_s
        self._clock = clock
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._first = threading.Event()  # set by the first frame, or by failing before it
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._slot = NewestSlot()
        self._last_arrival_s = clock()
        self._arrived = 0  # pictures, a receiver's repetitions too
        self._why_silent = ""
        self.connections = 0
        self.failure: PerchError | None = None
        self.size_px: tuple[int, int] | None = None

    def poll(self, now_s: float) -> Frame | None:
        with self._lock:
            return self._slot.take()

    def problem(self, now_s: float) -> str | None:
        with self._lock:
            if self.failure is not None:
                return str(self.failure)
            silent_s = now_s - self._last_arrival_s
            why = f": {self._why_silent}" if self._why_silent else ""
        if silent_s > SILENT_AFTER_S:
            return f"{self._name} has delivered no frame for {silent_s:.1f} s{why}"
        return None

    def describe(self) -> str:
        size = "no frame yet" if self.size_px is None else "{}x{} px".format(*self.size_px)
        return f"{self._name} ({size})"

    def begin(self) -> None:
        """Start the thread that connects and reads."""
        self._thread.start()

    def wait_first_frame(self, timeout_s: float) -> bool:
        """Wait for the first frame; False if the source fails or the time is over."""
        self._first.wait(timeout_s)
        return self._arrived > 0

    def close(self) -> None:
        self._stop.set()
        self._thread.join(CLOSE_WITHIN_S)

    def _connection(self) -> str:
        """Open the camera, read it until it ends, and return why it ended. It calls `_put` for
        each picture, looks at `_stop`, and may raise any Exception."""
        raise NotImplementedError

    def _run(self) -> None:
        failed = 0
        while not self._stop.is_set():
            before = self._arrived
            self.connections += 1
            try:
                reason = self._connection()
            except PerchError as error:
                if self._arrived == 0:
                    self._fail(error)
                    return
                reason = str(error)
            except Exception as error:
                # Whatever damaged bytes do to a library: a new connection may bring whole ones.
                reason = describe_error(error)
            self._why_silent = reason
            failed = 0 if self._arrived > before else failed + 1
            if failed >= self.max_failures:
                self._fail(TimedOut(f"{self._name} gave no picture in {failed} attempts: {reason}"))
                return
            self._stop.wait(self.reconnect_wait_s)

    def _put(
        self,
        image: Any,
        *,
        waited_s: float = 0.0,
        began_s: float | None = None,
        encoded: bytes | None = None,
    ) -> None:
        """Keep a picture that has arrived now.

        `waited_s`: its time under way beyond the usual. `began_s`: start of its arrival; the
        latency counts from there. `encoded`: as in `Frame`.
        """
        arrival_s = self._clock()
        t_s = (arrival_s if began_s is None else began_s) - self._latency_s - waited_s
        grey = to_grey(image)
        with self._lock:
            self._slot.put(grey, t_s, arrival_s, encoded)
            self._last_arrival_s = arrival_s
            self._arrived += 1
            self._why_silent = ""
            self.size_px = (grey.shape[1], grey.shape[0])
        self._first.set()

    def _fail(self, error: PerchError) -> None:
        self.failure = error
        self._first.set()


class WrappedSource:
    """Wrapper of a source. Each frame of the inner source is passed to `change`, which must not
    raise and may return a frame to give instead; all else is the inner source's."""

    def __init__(
        self, source: FrameSource, change: Callable[[Frame], Frame | None] = lambda frame: None
    ) -> None:
        self._source, self._change = source, change

    @property
    def inner(self) -> FrameSource:
        return self._source

    @property
    def live(self) -> bool:
        return self._source.live

    @property
    def finished(self) -> bool:
        return self._source.finished

    @property
    def size_px(self) -> tuple[int, int] | None:
        return self._source.size_px

    def poll(self, now_s: float) -> Frame | None:
        frame = self._source.poll(now_s)
        return None if frame is None else self._change(frame) or frame

    def problem(self, now_s: float) -> str | None:
        return self._source.problem(now_s)

    def describe(self) -> str:
        return self._source.describe()

    def close(self) -> None:
        self._source.close()


def mirrored_note(config: CameraConfig) -> str:
    """A sentence: the picture is mirrored, and how to correct the profile with `config`."""
    advice = "switch that off in the camera, or set camera.mirrored in the profile"
    if config.mirrored:
        advice = "the camera does not mirror, so take camera.mirrored out of the profile"
    return f"the picture is mirrored: {advice}"


def unmirror_frame(frame: Frame) -> Frame:
    """The frame flipped left to right, without its original JPEG bytes."""
    return replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), encoded=None)
