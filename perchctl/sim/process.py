"""The simulated vehicle as a process of its own: a Crazyflie on UDP, its camera on HTTP.

`SimProcess` is the handle in the process that flies, `perchctl.sim.host` runs in the other one.
The child does not share its terminal's Ctrl-C and outlives a killed parent by a few seconds, as a
real vehicle would.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import mmap
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import IO, Any, ClassVar, Literal

from perchctl.children import (
    Channel,
    accept,
    end,
    last_line,
    listen,
    new_token,
    send_address,
    spawn,
)
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError, TimedOut
from perchctl.profile import TargetConfig
from perchctl.sim.capture import CaptureSettings
from perchctl.sim.crtp import LinkOptions
from perchctl.sim.scenario import Scenario
from perchctl.vision import CameraModel

LOOP_PATIENCE_S = 2.0
"""The simulator waits so long, on the wall's clock, for a loop that gives no sign of life."""


class SharedTime(ctypes.Structure):
    """How far simulated time has come and may go, where both processes see it.

    Attributes:
        reached_s: written by the simulator.
        limit_s: written by the flight; infinity lets time run freely.
    """

    MARGIN_S: ClassVar = 0.02
    """Simulated time may run so far past the moment that the flight loop waits for."""

    reached_s: float
    limit_s: float
    _fields_ = (("reached_s", ctypes.c_double), ("limit_s", ctypes.c_double))

    @classmethod
    def free(cls) -> SharedTime:
        """Return a time for one process alone, which waits for nobody."""
        return cls(0.0, math.inf)

    @classmethod
    def mapped(cls, file: Path) -> SharedTime:
        """Return the time that the file holds, for each process that maps it."""
        with file.open("r+b") as opened:
            return cls.from_buffer(mmap.mmap(opened.fileno(), ctypes.sizeof(cls)))


START_TIMEOUT_S = 30.0


@dataclass(frozen=True)
class HostSetup:
    """How the simulated vehicle's process is set up.

    Attributes:
        pace: "realtime", or "stepped": time passes by `SimProcess.advance` only.
        camera: None: no camera and no stream.
        capture: None: no motion capture.
        truth_file: JSON lines of the true state, 50 a simulated second, also after the parent has
            ended.
        time_file: a `SharedTime` of the parent's; None: time runs freely.
    """

    scenario: Scenario = field(default_factory=Scenario)
    pace: Literal["realtime", "stepped"] = "realtime"
    camera: CameraModel | None = None
    target: TargetConfig | None = None
    capture: CaptureSettings | None = None
    link: LinkOptions = field(default_factory=LinkOptions)
    truth_file: Path | None = None
    time_file: Path | None = None


ANSWER_TIMEOUT_S = 60.0
"""Also of `advance`, which takes a second for half a minute."""
_STOP_TIMEOUT_S = 5.0
_CHILD = "from perchctl.sim.host import serve_parent; serve_parent()"


class SimProcess:
    """Handle of a running simulated vehicle; a context manager. It has the methods of the child's
    `perchctl.sim.host.VehicleHost`, and of its server, its world and its motion capture.

    All methods may be called from any thread; they raise `ConnectionFailed` when the child is
    gone, `TimedOut` when it does not answer, and `InvalidValue` when it refuses.

    Attributes:
        uri: for cflib.
        stream_url: for a network camera; "" without a camera.
        capture: the motion capture's kind and address for `motioncapture`; None without one.
        shared_time: how far simulated time has come in real time, and how far it may go.
        pid: of the child.
    """

    uri = stream_url = ""
    capture: tuple[str, str] | None = None

    def __init__(self, setup: HostSetup, timeout_s: float) -> None:
        self._lock = threading.Lock()
        self._stopped = False
        self._stderr: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115 (closed by stop)
        # Both processes have mapped the file once the child has answered.
        with (
            listen() as listener,
            tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        ):
            file = Path(folder, "time")
            file.write_bytes(bytes(SharedTime.free()))
            self.shared_time = SharedTime.mapped(file)
            self._child = spawn(_CHILD, self._stderr)
            token = new_token()
            send_address(self._child, listener, token)
            channel = accept(listener, token, timeout_s, lambda: self._child.poll() is None)
            if channel is None:
                raise self._gave_up(f"did not come up within {timeout_s:.0f} s")
            self._channel: Channel = channel
            try:
                channel.send(replace(setup, time_file=file))
                answer = channel.receive(timeout_s)
            except (EOFError, OSError):
                channel.close()
                raise self._gave_up("gave no answer") from None
        self.pid = self._child.pid
        if isinstance(answer, str):
            self.stop()
            raise ConnectionFailed(f"the simulated vehicle could not start: {answer}")
        self.uri, self.stream_url, self.capture = answer

    @classmethod
    def start(
        cls,
        scenario: Scenario | None = None,
        pace: Literal["realtime", "stepped"] = "realtime",
        *,
        timeout_s: float = START_TIMEOUT_S,
        **settings: Any,
    ) -> SimProcess:
        """Start the vehicle and wait, for at most `timeout_s`, until it answers.

        `settings` are further fields of `HostSetup`. Raises `ConnectionFailed` when the child
        ends or does not come up.
        """
        return cls(HostSetup(scenario or Scenario(), pace, **settings), timeout_s)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._ask, name)

    def stop(self) -> None:
        """End the vehicle's process. May be called twice."""
        if self._stopped:
            return
        self._stopped = True
        with contextlib.suppress(PerchError):
            self._ask("stop")
        self._channel.close()
        end(self._child, _STOP_TIMEOUT_S)
        self._stderr.close()

    def __enter__(self) -> SimProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _ask(self, name: str, *arguments: Any, **named: Any) -> Any:
        timeout_s = _STOP_TIMEOUT_S if name == "stop" else ANSWER_TIMEOUT_S
        with self._lock:
            try:
                self._channel.send((name, arguments, named))
                good, result = self._channel.receive(timeout_s)
            except TimeoutError:
                raise TimedOut(
                    f"the simulated vehicle did not answer {name!r} within {timeout_s:.0f} s"
                ) from None
            except (EOFError, OSError):
                raise ConnectionFailed(
                    f"the simulated vehicle has ended{last_line(self._stderr)}"
                ) from None
        if not good:
            raise InvalidValue(f"the simulated vehicle refused {name!r}: {result}")
        return result

    def _gave_up(self, why: str) -> ConnectionFailed:
        code = self._child.poll()
        end(self._child, 0.0)
        what = f"ended with code {code}" if code is not None else why
        error = ConnectionFailed(f"the simulated vehicle {what}{last_line(self._stderr)}")
        self._stderr.close()
        return error
