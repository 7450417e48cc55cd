"""Read a motion-capture system with the library `motioncapture`, in a separate process.

The systems differ in how they report a hidden body. Vicon, OptiTrack and Qualisys send complete
frames and leave out a hidden body. VRPN sends one body at a time and nothing for a hidden one, and
does not report that its server is gone, so with VRPN only silence can be detected.
"""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from perchctl.children import Channel, connect_to_parent, spawn, wait_or_kill
from perchctl.errors import ConnectionFailed, broken_motion_capture
from perchctl.extensions import make_extension
from perchctl.positioning.feed import BodyPose, CaptureFrame, CaptureSource, PositionFeed
from perchctl.profile import PositioningConfig

CAPTURE_SILENT_S = 0.3
"""Time without a frame after which the system counts as silent, s."""
LATE_S = 0.5
"""Time after a burst of late frames during which the burst is reported as the reason why no frame
is used, s."""
KEPT = 64
"""Largest number of frames that wait to be read; older ones are dropped."""
LONGEST_LINE = 300
"""Largest number of bytes read from one line of the child's output."""
UP_TIMEOUT_S = 15.0
"""Timeout for the start of the child's Python, s. The start has a timeout of its own, so that a
slow computer is not mistaken for a silent motion-capture system."""
_END_TIMEOUT_S = 2.0
_PORT_OPTION = {"qualisys": "port", "optitrack": "port_command"}
CAPTURE_PROGRAM = "from perchctl.positioning.capture import serve_parent; serve_parent()"


@dataclass(frozen=True)
class CaptureSetup:
    """The connection settings for the child process: the library's name for the system, and
    options.

    `skip_empty`: drop frames without a body, which the library also returns if nothing has arrived.
    """

    kind: str
    options: dict[str, str] = field(default_factory=dict)
    skip_empty: bool = False
    timeout_s: float = 5.0


@dataclass(frozen=True)
class CaptureFailure:
    """A failure of the library, with its message; `is_loaded` is False if Python cannot import
    it."""

    text: str
    is_loaded: bool = True


@dataclass(frozen=True)
class LateFrames:
    """Reports frames after a pause of `pause_s`, which are not used because it is unknown how long
    they waited. `count` is the number of frames that arrived at once after the previous pause; 0 if
    there was no such burst."""

    count: int
    pause_s: float

    def error(self, who: str) -> ConnectionFailed:
        """Return an error that says what is wrong with the motion-capture system `who`, and what to
        do."""
        if self.count == 0:
            return ConnectionFailed(
                f"{who} has paused for {self.pause_s:.2f} s: frames after a pause may be old, "
                "so they are not used"
            )
        if self.count == 1:
            return ConnectionFailed(
                f"{who} sends a frame only every {self.pause_s:.2f} s, so its frames are not used",
                "set its rate to at least 50 Hz",
            )
        return ConnectionFailed(
            f"{who} sends its frames late, in bursts ({self.count} at once after "
            f"{self.pause_s:.2f} s), so they are not used",
            "connect it by cable",
        )


def capture_setup(config: PositioningConfig) -> CaptureSetup:
    """Return the connection settings for the child process. Vicon and VRPN expect the port as part
    of the host name, the other systems as a separate option."""
    options = {"hostname": config.host.strip()}
    name, colon, port = options["hostname"].rpartition(":")
    if colon and config.system in _PORT_OPTION and port.isdecimal():
        options = {"hostname": name, _PORT_OPTION[config.system]: port}
    return CaptureSetup(config.system, options, config.system == "vrpn", config.connect_timeout_s)


def open_capture(
    config: PositioningConfig, clock: Callable[[], float] = time.monotonic
) -> CaptureSource:
    """Connect to the motion-capture system and return it once its first frame has arrived. For your
    own source, ``my_module:MySource``, the class is called with `clock` and `config`.

    Raises InvalidValue, UsageError if the library cannot be loaded, and ConnectionFailed if there
    is no answer within `config.connect_timeout_s`.
    """
    PositionFeed.check_config(config)
    if ":" in config.system:
        own: CaptureSource = make_extension(
            config.system, "positioning.system", CaptureSource, clock, config
        )
        return own
    return MotionCapture(capture_setup(config), config.label, config.body, clock)


class MotionCapture:
    """A `perchctl.positioning.feed.CaptureSource` that reads the system in a child process, which
    `close` ends.

    `who` is the system's name in messages; `poll` prefers a frame that contains `body`. The
    constructor waits for the first frame. The constructor raises ConnectionFailed, or UsageError if
    the library cannot be loaded.
    """

    def __init__(
        self, setup: CaptureSetup, who: str, body: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._setup, self._who, self._body, self._clock = setup, who, body, clock
        self._frames: deque[CaptureFrame] = deque(maxlen=KEPT)
        self._framed_s: float | None = None
        self._late: tuple[float, LateFrames] | None = None  # arrival time and message
        self._settled = threading.Event()  # set by the first frame, or if the child ends before it
        self._closed = False
        self._ended: str | None = None
        self._failed: CaptureFailure | None = None
        self._last_line = ""
        self._child, self._channel = spawn(CAPTURE_PROGRAM, subprocess.PIPE)
        self._threads = [threading.Thread(target=self._read_output, daemon=True)]
        self._threads[0].start()
        try:
            self._begin()
        except BaseException:
            self.close()
            raise

    def poll(self, now_s: float) -> CaptureFrame | None:
        """Return the newest frame since the last call, preferably one with the body; None if there
        is no frame."""
        frames = self.frames()
        return next((f for f in reversed(frames) if self._body in f.bodies), None) or (
            frames[-1] if frames else None
        )

    def frames(self) -> list[CaptureFrame]:
        """Return all frames since the last `frames` or `poll`, oldest first."""
        return [self._frames.popleft() for _ in range(len(self._frames))]

    def problem(self, now_s: float) -> str | None:
        error = self.error(now_s)
        return None if error is None else str(error)

    def error(self, now_s: float) -> ConnectionFailed | None:
        """Return the problem as an error object with separate advice."""
        if self._ended is not None:
            return ConnectionFailed(self._ended)
        silent_s = 0.0 if self._framed_s is None else now_s - self._framed_s
        if self._late is not None and now_s - self._late[0] <= LATE_S and silent_s > QUEUE_PAUSE_S:
            return self._late[1].error(self._who)
        if silent_s <= CAPTURE_SILENT_S:
            return None
        what = "no body" if self._setup.skip_empty else "no frame"
        return ConnectionFailed(f"{self._who} has sent {what} for {silent_s:.1f} s")

    def close(self) -> None:
        """End the child process, with a timeout, whatever its library is doing."""
        self._closed = True
        if self._child.poll() is None:
            self._child.kill()
        wait_or_kill(self._child, _END_TIMEOUT_S)
        for thread in self._threads:
            thread.join(_END_TIMEOUT_S)
        self._channel.close()
        if self._child.stdout is not None and not self._threads[0].is_alive():
            self._child.stdout.close()

    def _begin(self) -> None:
        try:
            self._channel.receive(UP_TIMEOUT_S)
        except (EOFError, OSError):
            raise ConnectionFailed(
                f"no {self._who}: its reader did not start{self._words()}"
            ) from None
        self._channel.send(self._setup)
        reading = threading.Thread(
            target=self._read_frames, args=(self._channel,), name="perchctl-capture", daemon=True
        )
        self._threads.append(reading)
        reading.start()
        if not self._settled.wait(self._setup.timeout_s):
            if self._late is not None:
                raise self._late[1].error(self._who)
            raise ConnectionFailed(
                f"no {self._who}: no frame within {self._setup.timeout_s:g} s{self._words()}",
                "check that it streams, that positioning.host is right, and that no firewall "
                "blocks it",
            )
        if self._failed is not None and not self._failed.is_loaded:
            raise broken_motion_capture(self._failed.text)
        if self._ended is not None:
            raise ConnectionFailed(self._ended)

    def _read_frames(self, channel: Channel) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                message: tuple[float, Bodies] | LateFrames | CaptureFailure = channel.receive()
                if isinstance(message, LateFrames):
                    self._late = self._clock(), message
                    continue
                if isinstance(message, CaptureFailure):
                    self._failed = message
                    failed = "" if self._framed_s is None else " failed"
                    self._ended = f"{self._gone()}{failed}: {message.text}"
                    continue
                now_s = self._clock()
                poses = {name: BodyPose(*body) for name, body in message[1].items()}
                self._frames.append(CaptureFrame(min(message[0], now_s), poses))
                self._framed_s = now_s
                self._settled.set()
        if self._ended is None and not self._closed:
            wait_or_kill(self._child, _END_TIMEOUT_S)
            self._threads[0].join(_END_TIMEOUT_S)
            code = self._child.poll()
            how = "" if code is None else f" with code {code}"
            self._ended = f"{self._gone()}: its reader ended{how}{self._words()}"
        self._settled.set()

    def _gone(self) -> str:
        return f"{'no ' if self._framed_s is None else ''}{self._who}"

    def _read_output(self) -> None:
        """Read all output, so that the child never blocks, and keep its last line."""
        output = self._child.stdout
        assert output is not None
        for raw in iter(lambda: output.readline(LONGEST_LINE), b""):
            line = raw.decode(errors="replace").strip()
            self._last_line = line or self._last_line

    def _words(self) -> str:
        return f": {self._last_line}" if self._last_line else ""


# --- The child process that runs the motion-capture library ---
# With some systems, the library waits in `connect` forever without letting any other thread of its
# process run; with others, it ends the process without a message (docs/positioning.md). In a child
# process, neither of these failures stops the flight.


START_TIMEOUT_S = 30.0
"""Time for which the child waits for its `CaptureSetup`, s."""
MOST_HZ = 500.0
"""Largest frame rate, Hz. No system is faster; faster frames are not measurements and would keep
the parent busy."""
QUEUE_PAUSE_S = 0.1
"""Length of a pause after which the library may return frames that waited in its queue, s."""
AT_ONCE_S = 1e-3
"""Interval between frames below which they must have waited in the queue, s. No system sends this
fast."""

Bodies = dict[str, tuple[tuple[float, float, float], tuple[float, float, float, float]]]
"""Position and quaternion (w, x, y, z) by name; no objects of the library cross the process
boundary."""


def serve_parent() -> None:
    """Send the system's frames to the parent process until the parent ends or the library fails."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = connect_to_parent()
    setup = channel.receive(START_TIMEOUT_S)
    is_loaded = False
    # A library that blocks all threads survives the end of the parent, but not this timer.
    faulthandler.dump_traceback_later(setup.timeout_s + 1.0, exit=True)
    try:
        import motioncapture

        is_loaded, options = True, setup.options
        if setup.kind == "optitrack":  # OptiTrack's reader does not resolve host names
            options = options | {"hostname": socket.gethostbyname(options["hostname"])}
        client = motioncapture.connect(setup.kind, options)
        faulthandler.cancel_dump_traceback_later()
        threading.Thread(target=_end_with, args=(channel,), daemon=True).start()
        _pass_on(client, channel, setup.skip_empty)
    except Exception as error:  # errors of the library, or of its imports
        with contextlib.suppress(OSError):  # the parent may have ended
            channel.send(CaptureFailure(str(error) or type(error).__name__, is_loaded))


def _pass_on(client: Any, channel: Channel, partial: bool) -> None:
    """Pass frames on to the parent as they arrive, but never a frame of unknown age.

    After a pause, the library may return frames that waited in its queue. The first frame after the
    pause, and each one that follows without a wait, is therefore not sent, and the parent receives
    the reason.
    """
    sent_s, behind = -1.0, False
    # time of the first and the newest frame since the last pause, and their number
    began_s, newest_s, count = -1.0, -1.0, 0
    while True:
        asked_s = time.monotonic()
        client.waitForNextFrame()
        now_s = time.monotonic()
        waited_s = now_s - asked_s
        if waited_s > QUEUE_PAUSE_S:
            is_burst = newest_s - began_s < QUEUE_PAUSE_S
            channel.send(LateFrames(count if is_burst else 0, waited_s))
            began_s, count = now_s, 0
        newest_s, count = now_s, count + 1
        behind = waited_s > QUEUE_PAUSE_S or (behind and waited_s < AT_ONCE_S)
        if behind or now_s - sent_s < 1.0 / MOST_HZ:
            continue
        bodies: Bodies = {}
        for name, body in client.rigidBodies.items():
            (x, y, z), q = map(float, body.position), body.rotation
            bodies[str(name)] = (x, y, z), (float(q.w), float(q.x), float(q.y), float(q.z))
        if bodies or not partial:
            sent_s = now_s
            channel.send((now_s, bodies))


def _end_with(channel: Channel) -> None:
    """End this process when the parent ends, even if the library is blocked. The parent sends no
    more messages."""
    with contextlib.suppress(EOFError, OSError):
        channel.recv()
    os._exit(0)
