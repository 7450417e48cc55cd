"""The interface of all frame sources, and the code that live and recorded sources share."""

from __future__ import annotations

import math
import re
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable
from urllib.error import URLError

import numpy as np

from perchctl.camera.health import Grey, same_bytes
from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, PerchError, Problem, TimedOut
from perchctl.extensions import error_at
from perchctl.profile import CameraConfig, Profile
from perchctl.vision import CameraModel, Frame, to_grey


class NewestSlot:
    """Keeps the newest image, with the time of its first arrival.

    An image that the receiver repeats does not replace the original until the original has been
    taken, so that the arrival time is kept. After that, the repetition is returned with the same
    index and `Frame.is_repeated`: it shows that the source works, but is not a measurement.
    """

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._last: Grey | None = None
        self.count = 0

    def put(
        self, image: Grey, t_s: float, t_arrival_s: float, encoded: bytes | None = None
    ) -> None:
        """Keep an image with its times of exposure and arrival; `encoded`: its JPEG, if any."""
        if self._last is None or not same_bytes(self._last, image):
            self._last = image
            self._frame = Frame(self.count, t_s, image, t_arrival_s, source_jpeg=encoded)
            self.count += 1
        elif self._frame is None or self._frame.is_repeated:
            self._frame = Frame(self.count - 1, t_s, image, t_arrival_s, is_repeated=True)

    def take(self) -> Frame | None:
        """Return the newest frame; None if it has already been returned."""
        frame, self._frame = self._frame, None
        return frame


Clock = Callable[[], float]

SILENT_AFTER_S = 1.0
"""Time without a new frame after which a live source counts as gone, s."""
CLOSE_WITHIN_S = 3.0
_FRAME_POLL_S = 0.002
_SILENT = "connected, but it sends no data"


@runtime_checkable
class FrameSource(Protocol):
    """A source of frames. Your own class is constructed with the loop's clock and the profile's
    section `camera`. Any error that your class raises counts as a lost camera.

    A live source returns only the newest frame; its `t_s` is the arrival time minus
    `config.start_latency_s`. A recorded source returns one frame per poll, in order, with the times
    in the recording. perchctl converts colour to grey, and flips mirrored frames back.
    """

    @property
    def live(self) -> bool:
        """True for a camera, which runs in real time; False for a recording."""

    @property
    def finished(self) -> bool:
        """True if no more frames will come. A live source never finishes."""

    @property
    def size_px(self) -> tuple[int, int] | None:
        """Width and height of the frames, known once the first one has arrived."""

    def poll(self, now_s: float) -> Frame | None:
        """Return the newest frame (for a recording, the next one); None if no frame has arrived
        since the last call. The flight loop calls this method about 50 times a second, so it must
        not block: a camera that blocks needs its own thread."""

    def problem(self, now_s: float) -> str | None:
        """Return None if the source works at `now_s`, otherwise a sentence with the problem. If
        `now_s` is -inf, report only a permanent failure. perchctl itself detects missing frames."""

    def describe(self) -> str:
        """Name and size as text: ``camera:0 (640x480 px)``."""

    def close(self) -> None: ...


def check_size(size_px: tuple[int, int] | None, camera: CameraModel, source: str) -> None:
    """Raise InvalidValue, which names `source`, if frames and calibration differ in size.

    Frames are not scaled to fit: cropped and scaled modes of a camera may have the same aspect
    ratio, but need different calibrations.
    """
    if size_px is None or size_px == camera.size_px:
        return
    size = f"{size_px[0]}x{size_px[1]} px"
    is_named = size in source  # the description of a recording contains its size
    found = (
        "does not fit the calibration, which"
        if is_named
        else (f"delivers frames of {size}, but the calibration")
    )
    raise InvalidValue(
        f"{source} {found} was made at {camera.size_px[0]}x{camera.size_px[1]} px",
        "set the camera to the calibrated size, or calibrate it at the current size",
    )


def describe_error(error: Exception) -> str:
    """Describe an unforeseen error by its class and its text, without passwords."""
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

    A subclass defines `_connection`, which opens and reads the camera. A connection that has ended
    is reopened after `reconnect_wait_s`, until `max_failures` successive connections have delivered
    no image.

    If a source delivers no image, its message only names causes that the source has observed: it
    did or did not connect (`_connected`), something other than an image arrived (`_note`), or
    images arrived but were dropped (`_drop`).
    """

    live = True
    finished = False
    connect_timeout_s = 3.0
    read_timeout_s = 2.0
    reconnect_wait_s = 0.3
    max_failures = 5.0
    unreached_advice = "check that the address is right and that the camera is on"
    """What to do if no connection can be made."""
    silent_advice = "switch the camera off and on again"
    """What to do if a connection is made but nothing arrives."""

    def __init__(self, name: str, latency_s: float, clock: Clock) -> None:
        self._name = without_password(name)
        self._latency_s = latency_s
        self._clock = clock
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._first = threading.Event()  # set by the first frame, or by an earlier failure
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._slot = NewestSlot()
        self._last_arrival_s = clock()
        self._arrived = 0  # number of images, including a receiver's repetitions
        self._why_silent = ""
        # the newest connection's problem and advice, kept until an image arrives
        self._found = ("", "")
        self._is_connected = False
        self._dropped = 0  # number of unusable images since the last good one
        self._why_dropped = ""
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
        if silent_s > SILENT_AFTER_S:
            why = ": ".join(filter(None, self._finding_and_advice()))
            text = f"{self._name} has delivered no frame for {silent_s:.1f} s"
            return f"{text}: {why}" if why else text
        return None

    def no_first_frame(self, timeout_s: float) -> PerchError:
        """The error for a source that has delivered no frame within `timeout_s`."""
        finding, advice = self._finding_and_advice()
        late = f"{self._name}: no first frame within {timeout_s:g} s"
        found = f"{late}: {finding}" if finding else late
        return TimedOut(found, advice, separator=": ")

    def _finding_and_advice(self) -> tuple[str, str]:
        """Return the problem observed since the last image, and advice."""
        if self._dropped:
            count = f"{self._dropped} so far"
            return f"pictures arrive but are dropped ({count}): {self._why_dropped}", ""
        return self._found if self._found[0] else (self._why_silent, "")

    def describe(self) -> str:
        size = "no frame yet" if self.size_px is None else "{}x{} px".format(*self.size_px)
        return f"{self._name} ({size})"

    def begin(self) -> None:
        """Start the thread that connects and reads."""
        self._thread.start()

    def wait_first_frame(self, timeout_s: float) -> bool:
        """Wait for the first frame; return False if the source fails or the time limit is
        exceeded."""
        self._first.wait(timeout_s)
        return self._arrived > 0

    def close(self) -> None:
        self._stop.set()
        self._thread.join(CLOSE_WITHIN_S)

    def _connection(self) -> str:
        """Open the camera, read it until it ends, and return why it ended. The method calls `_put`
        for each image, checks `_stop`, and may raise any Exception."""
        raise NotImplementedError

    def _run(self) -> None:
        failed = 0
        while not self._stop.is_set():
            before = self._arrived
            self.connections += 1
            self._is_connected, is_unreached = False, True
            try:
                reason = self._connection()
                if self._found[0] == _SILENT:
                    self._note(
                        "connected, but the stream ended without a picture", self.silent_advice
                    )
            except PerchError as error:
                if self._arrived == 0:
                    self._fail(error)
                    return
                reason = str(error)
            except Exception as error:
                # Damaged bytes can cause any error in a library; a new connection may deliver
                # intact bytes.
                reason = describe_error(error)
                is_unreached = isinstance(error, OSError)
            self._why_silent = reason
            if not self._is_connected:
                self._found = (reason, self.unreached_advice if is_unreached else "")
            failed = 0 if self._arrived > before else failed + 1
            if failed >= self.max_failures:
                finding, advice = self._finding_and_advice()
                found = f"{self._name} delivered no picture in {failed} attempts: {finding}"
                kind = TimedOut if self._is_connected else NotFound
                self._fail(kind(found, advice, separator=": "))
                return
            self._stop.wait(self.reconnect_wait_s)

    def _connected(self) -> None:
        """Record that the camera answers, in case nothing else arrives."""
        self._is_connected = True
        self._note(_SILENT, self.silent_advice)

    def _note(self, finding: str, advice: str = "") -> None:
        """Record what this connection has delivered instead of an image, with advice for the
        user."""
        self._found = (finding, advice)

    def _drop(self, why: str) -> None:
        """Record that an image arrived but cannot be used."""
        self._why_dropped, self._dropped = why, self._dropped + 1

    def _put(
        self,
        image: Any,
        *,
        waited_s: float = 0.0,
        began_s: float | None = None,
        encoded: bytes | None = None,
    ) -> None:
        """Keep an image that has just arrived.

        `waited_s`: how much longer than usual its transfer took. `began_s`: arrival time of its
        first byte, from which the latency is subtracted. `encoded`: `Frame.source_jpeg`.
        """
        arrival_s = self._clock()
        t_s = (arrival_s if began_s is None else began_s) - self._latency_s - waited_s
        grey = to_grey(image)
        with self._lock:
            self._slot.put(grey, t_s, arrival_s, encoded)
            self._last_arrival_s = arrival_s
            self._arrived += 1
            self._why_silent, self._found, self._dropped = "", ("", ""), 0
            self.size_px = (grey.shape[1], grey.shape[0])
        self._first.set()

    def _fail(self, error: PerchError) -> None:
        self.failure = error
        self._first.set()


class WrappedSource:
    """Wrapper around a source. Each frame from the inner source is passed to `change`, which must
    not raise an exception and may return another frame. Everything else is passed through."""

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


class GuardedSource:
    """Checks the frames from your own camera class. An error raised by your class, or an invalid
    frame, counts as a lost camera; a live frame that is not newer than the last one is dropped."""

    def __init__(self, source: FrameSource, name: str, clock: Clock) -> None:
        self._source, self._name, self._clock = source, name, clock
        self._first: Frame | None = None
        self._newest_s, self._count = -math.inf, 0
        self._empty_since_s: float | None = None  # time of the first poll after the last frame
        self._failure: str | None = None
        self.live, self.size_px = bool(source.live), source.size_px

    def wait_first_frame(self, timeout_s: float) -> None:
        """Wait for a camera's first frame. If none arrives, close the camera and raise
        ConnectionFailed or TimedOut."""
        end_s = time.monotonic() + timeout_s
        while self.live and (frame := self.poll(self._clock())) is None:
            if self._failure is None and time.monotonic() <= end_s:
                time.sleep(_FRAME_POLL_S)
                continue
            self.close()
            if self._failure is not None:
                raise ConnectionFailed(self._failure)
            raise TimedOut(f"{self._name}: no first frame within {timeout_s:g} s")
        self._first = frame if self.live else None

    @property
    def finished(self) -> bool:
        return self._source.finished

    def poll(self, now_s: float) -> Frame | None:
        frame, self._first = self._first, None
        if frame is None and self._failure is None:
            try:
                frame = self._checked(self._source.poll(now_s))
            except Exception as error:
                self._fail(error)
        empty_s = now_s if self._empty_since_s is None else self._empty_since_s
        self._empty_since_s = empty_s if frame is None else None
        return frame

    def _checked(self, frame: object) -> Frame | None:
        if frame is None:
            return None
        if not isinstance(frame, Frame):
            raise TypeError(f"poll must return a Frame or None, not {type(frame).__name__}")
        now_s = self._clock()
        if self.live and not frame.t_s <= now_s:
            raise ValueError(
                f"a frame's t_s must be in the past, not {frame.t_s} (it is now {now_s})"
            )
        if self.live and frame.t_s <= self._newest_s:
            return None
        self._newest_s, self._count = frame.t_s, self._count + 1
        grey = to_grey(frame.image)
        self.size_px = (grey.shape[1], grey.shape[0])
        arrival_s = frame.t_arrival_s or now_s
        return replace(frame, index=self._count - 1, image=grey, t_arrival_s=arrival_s)

    def problem(self, now_s: float) -> str | None:
        problem, since_s = self._failure, self._empty_since_s
        try:
            problem = problem or self._source.problem(now_s)
        except Exception as error:
            self._fail(error)
        silent_s = 0.0 if since_s is None or not self.live else now_s - since_s
        silent = f"{self._name} has delivered no frame for {silent_s:.1f} s"
        return self._failure or problem or (silent if silent_s > SILENT_AFTER_S else None)

    def _fail(self, error: Exception) -> None:
        self._failure = without_password(f"{self._name}: {error_at(error)}")

    def describe(self) -> str:
        return self._source.describe()

    def close(self) -> None:
        self._source.close()


def mirrored_problem(config: CameraConfig) -> Problem:
    """Return the message that the image is mirrored, with advice that depends on the `config`."""
    advice = "turn mirroring off in the camera, or set camera.mirrored in the profile"
    if config.mirrored:
        advice = (
            "the camera does not mirror the picture, so remove camera.mirrored from the profile"
        )
    return Problem("the picture is mirrored", advice)


def unmirror_frame(frame: Frame) -> Frame:
    """The frame flipped left to right, without its original JPEG bytes."""
    return replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), source_jpeg=None)


# --- User name and password in a stream's URL, which are never shown ---


_START = r"(?:[a-z][a-z0-9+.-]*://|(?:https?|rtsps?):/?)"
_URL = re.compile(_START, re.IGNORECASE)
_URL_AMID = re.compile(rf"({_START})(\S*)", re.IGNORECASE)
_SECRET = re.compile(
    r"""((?:password|passwd|pwd|pass|user-pw)=)(?:"[^"]*"|'[^']*'|[^&#\s]*)""", re.IGNORECASE
)


def without_password(text: str) -> str:
    """Return the text without user names and passwords in URLs, and without the values of
    ``password=`` and similar keys. When in doubt, it removes more rather than less."""
    if start := _URL.match(text):  # treat all of it as one URL, including spaces in the password
        text = start.group() + _without_name(text[start.end() :])
    else:
        text = _URL_AMID.sub(lambda found: found.group(1) + _without_name(found.group(2)), text)
    return _SECRET.sub(r"\1***", text)


def _without_name(rest: str) -> str:
    host, slash, path = rest.partition("/")
    if "@" in host:
        return f"{host.rpartition('@')[2]}{slash}{path}"
    before, _, after = rest.rpartition("@")
    return after if ":" in before else rest  # the password contains a slash


def profile_record(profile: Profile) -> dict[str, Any]:
    """Return all keys of the profile for JSON, with passwords removed. A profile that is read back
    from this record cannot open a camera that needs a password."""
    record = profile.model_dump(mode="json")
    record["camera"]["source"] = without_password(profile.camera.source)
    return record | {"description": without_password(profile.description)}
