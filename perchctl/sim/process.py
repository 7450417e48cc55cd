"""The simulated vehicle as a process of its own: a Crazyflie on UDP, its camera on HTTP.

`SimProcess` is the handle in the process that flies, `perchctl.sim.host` runs in the other one.
The child does not share its terminal's Ctrl-C and outlives a killed parent by a few seconds, as a
real vehicle would.
"""

from __future__ import annotations

import contextlib
import math
import subprocess
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Literal, get_args

import numpy as np

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

CLOCK_MARGIN_S = 0.02
"""Simulated time may run so far past the moment that the flight loop waits for."""
LOOP_PATIENCE_S = 2.0
"""The simulator waits so long, on the wall's clock, for a loop that gives no sign of life."""


class SharedTime:
    """Two numbers in a file that both processes map.

    `reached_s` is how far simulated time has come; the simulator writes it. `limit_s` is how far
    it may go; the flight writes it, and infinity lets time run freely. Without a file they belong
    to one process.
    """

    def __init__(self, file: Path | None = None) -> None:
        if file is None:
            self._values = np.array([0.0, math.inf])
        else:
            self._values = np.memmap(file, np.float64, "r+")

    @classmethod
    def create(cls, file: Path) -> SharedTime:
        np.array([0.0, math.inf]).tofile(file)
        return cls(file)

    @property
    def reached_s(self) -> float:
        return float(self._values[0])

    @reached_s.setter
    def reached_s(self, t_s: float) -> None:
        self._values[0] = t_s

    @property
    def limit_s(self) -> float:
        return float(self._values[1])

    @limit_s.setter
    def limit_s(self, t_s: float) -> None:
        self._values[1] = t_s


# --- Messages between the process that flies and the simulated vehicle's, and their settings ---


Pace = Literal["realtime", "stepped"]
START_TIMEOUT_S = 30.0
LINGER_S = 12.0


@dataclass(frozen=True)
class HostSetup:
    """How the simulated vehicle's process is set up.

    `camera` None: no camera and no stream; `capture` None: no motion capture.
    `truth_file`: JSON lines of the true state, 50 a simulated second, also after the
    parent has ended. `heard_file`: JSON lines of every packet that arrived, and who had sent it.
    `linger_s`: how long the vehicle then runs on, in wall-clock time. `time_file`: a
    `SharedTime` of the parent's; None: time runs freely.
    """

    scenario: Scenario = field(default_factory=Scenario)
    pace: Pace = "realtime"
    camera: CameraModel | None = None
    target: TargetConfig | None = None
    capture: CaptureSettings | None = None
    link: LinkOptions = field(default_factory=LinkOptions)
    truth_file: Path | None = None
    heard_file: Path | None = None
    linger_s: float = LINGER_S
    time_file: Path | None = None


# --- The handle --------------------------------------------------------------------------------


ANSWER_TIMEOUT_S = 15.0
SLOWEST_PACE = 20.0
"""Wall-clock seconds allowed for one simulated second of `advance`."""
_STOP_TIMEOUT_S = 5.0
_CHILD = "from perchctl.sim.host import serve_parent; serve_parent()"
REQUESTS = (
    "truth", "set_pose", "move_by_hand", "let_go", "set_battery", "silence", "capture_fault",
    "reboot", "replace_vehicle",
)  # fmt: skip
"""Methods of the child's `VehicleHost` and its `World` that a `SimProcess` has, too."""


class SimProcess:
    """Handle of a running simulated vehicle; a context manager. It has the methods `REQUESTS` of
    `perchctl.sim.host.VehicleHost` and its `World`.

    `uri` is for cflib, `stream_url` for a network camera ("" without a camera), `capture` the
    motion capture's kind and address for `motioncapture` (None without one). `shared_time`
    is how far simulated time has come in real time, and how far it may go. All methods may be
    called from any thread; they raise `ConnectionFailed` when the child is gone and `TimedOut`
    when it does not answer.
    """

    def __init__(
        self,
        child: subprocess.Popen[bytes],
        channel: Channel,
        stderr: IO[bytes],
        shared_time: SharedTime,
    ) -> None:
        self._child = child
        self._channel = channel
        self._stderr = stderr
        self.shared_time = shared_time
        self._lock = threading.Lock()
        self._stopped = False
        self.uri = ""
        self.stream_url = ""
        self.capture: tuple[str, str] | None = None

    @classmethod
    def start(
        cls,
        scenario: Scenario | None = None,
        pace: Pace = "realtime",
        *,
        timeout_s: float = START_TIMEOUT_S,
        **settings: Any,
    ) -> SimProcess:
        """Start the vehicle and wait, for at most `timeout_s`, until it answers.

        `settings` are further fields of `HostSetup`. Raises `ConnectionFailed` when the child
        ends or does not come up, `InvalidValue` for an unknown pace.
        """
        if pace not in get_args(Pace):
            raise InvalidValue(f"pace {pace!r} is unknown, choose 'realtime' or 'stepped'")
        setup = HostSetup(scenario or Scenario(), pace, **settings)
        # Both processes have mapped the file once the child has answered.
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            shared = SharedTime.create(file := Path(folder, "time"))
            return cls._with(replace(setup, time_file=file), shared, timeout_s)

    @classmethod
    def _with(cls, setup: HostSetup, shared: SharedTime, timeout_s: float) -> SimProcess:
        token = new_token()
        stderr = tempfile.TemporaryFile()  # noqa: SIM115 (closed by stop)
        with listen() as listener:
            child = spawn(_CHILD, stderr)
            send_address(child, listener, token)
            channel = accept(listener, token, timeout_s, lambda: child.poll() is None)
        if channel is None:
            raise _gave_up(child, stderr, f"did not come up within {timeout_s:.0f} s")
        process = cls(child, channel, stderr, shared)
        try:
            channel.send(setup)
            answer = channel.receive(timeout_s)
        except (EOFError, OSError):
            channel.close()
            raise _gave_up(child, stderr, "gave no answer") from None
        if isinstance(answer, str):
            process.stop()
            raise ConnectionFailed(f"the simulated vehicle could not start: {answer}")
        process.uri, process.stream_url, process.capture = answer
        return process

    @property
    def pid(self) -> int:
        return self._child.pid

    def is_running(self) -> bool:
        return self._child.poll() is None

    def advance(self, dt_s: float) -> float:
        """Let `dt_s` pass (stepped pace only); the simulated time since the start."""
        if dt_s < 0.0:
            raise InvalidValue(f"time cannot go back ({dt_s} s)")
        allowed_s = ANSWER_TIMEOUT_S + SLOWEST_PACE * dt_s
        return float(self._ask("advance", dt_s, timeout_s=allowed_s))

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name not in REQUESTS:
            raise AttributeError(name)
        return partial(self._ask, name)

    def stop(self) -> None:
        """End the vehicle's process. May be called twice."""
        if self._stopped:
            return
        self._stopped = True
        with contextlib.suppress(PerchError):
            self._ask("stop", timeout_s=_STOP_TIMEOUT_S)
        self._channel.close()
        end(self._child, _STOP_TIMEOUT_S)
        self._stderr.close()

    def __enter__(self) -> SimProcess:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def _ask(
        self, name: str, *arguments: Any, timeout_s: float = ANSWER_TIMEOUT_S, **named: Any
    ) -> Any:
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


def _gave_up(child: subprocess.Popen[bytes], stderr: IO[bytes], why: str) -> ConnectionFailed:
    code = child.poll()
    child.kill()
    child.wait()
    what = f"ended with code {code}" if code is not None else why
    error = ConnectionFailed(f"the simulated vehicle {what}{last_line(stderr)}")
    stderr.close()
    return error
