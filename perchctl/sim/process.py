"""The simulated vehicle as a separate process: a Crazyflie on UDP, its camera on HTTP.

Ctrl-C on the terminal does not reach the child, which ends with its parent.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import signal
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

from perchctl.children import SharedTime
from perchctl.errors import ConnectionFailed, InvalidValue, TimedOut
from perchctl.sim.scenario import Scenario

ANSWER_TIMEOUT_S = 60.0
"""Timeout for an answer, s. The timeout must also suffice for `advance`, which takes one second per
30 s of simulated time."""
_STOP_TIMEOUT_S = 5.0
_CONTEXT = multiprocessing.get_context("spawn")


def _serve_parent(*arguments: Any) -> None:
    from perchctl.sim.host import serve_parent  # loads the physics, in the child only

    serve_parent(*arguments)


class SimProcess:
    """Handle of a running simulated vehicle; a context manager. The handle also has the methods
    that `perchctl.sim.host.VehicleHost.call_method` finds in the child.

    All methods may be called from any thread. They raise `ConnectionFailed` if the child is gone,
    `TimedOut` if it does not answer, and `InvalidValue` if it refuses a call.

    Attributes:
        uri: address for cflib.
        stream_url: address of the video; "" without a camera.
        capture: the motion-capture system's kind and address for `motioncapture`, or None.
        shared_time: with the `pace` "realtime", the simulated time that has been reached, and the
            time up to which the simulator may advance.
        pid: process ID of the child.
    """

    uri = stream_url = ""
    capture: tuple[str, str] | None = None

    def __init__(self, pace: str, scenario: Scenario, settings: dict[str, Any]) -> None:
        self._lock = threading.Lock()
        self.shared_time = _CONTEXT.RawValue(SharedTime, 0.0, math.inf)
        self._channel, childs = _CONTEXT.Pipe()
        arguments = (childs, self.shared_time, pace, scenario, settings)
        self._child = _CONTEXT.Process(target=_serve_parent, args=arguments, daemon=True)
        # The child starts with Ctrl-C blocked, until it has detached from the terminal.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._child.start()
        except OSError as error:
            raise ConnectionFailed(f"the simulated vehicle could not start: {error}") from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            childs.close()
        self.pid = self._child.pid
        self.uri, self.stream_url, self.capture = self._receive()

    @classmethod
    def start(
        cls,
        scenario: Scenario | None = None,
        pace: Literal["realtime", "stepped"] = "realtime",
        **settings: Any,
    ) -> SimProcess:
        """Start the vehicle and wait until it answers. With the `pace` "stepped", only `advance`
        lets time pass.

        `settings` are further arguments of `VehicleHost`.
        """
        return cls(pace, scenario or Scenario(), settings)

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("_"):
            raise AttributeError(name)
        return partial(self._ask, name)

    def stop(self) -> None:
        """End the vehicle's process. May be called twice."""
        self._channel.close()
        self._child.join(_STOP_TIMEOUT_S)
        self._child.kill()

    def __enter__(self) -> SimProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def _ask(self, name: str, *arguments: Any, **named: Any) -> Any:
        with self._lock:
            with contextlib.suppress(OSError):  # the child is gone and does not answer
                self._channel.send((name, arguments, named))
            good, result = self._receive()
        if not good:
            raise InvalidValue(f"the simulated vehicle refused {name!r}: {result}")
        return result

    def _receive(self) -> Any:
        try:
            answer = self._channel.recv() if self._channel.poll(ANSWER_TIMEOUT_S) else None
        except (EOFError, OSError):
            answer = "its process has ended"
        if answer is None:
            self.stop()
            raise TimedOut(f"the simulated vehicle did not answer within {ANSWER_TIMEOUT_S:.0f} s")
        if isinstance(answer, str):
            self.stop()
            raise ConnectionFailed(f"the simulated vehicle has stopped: {answer}")
        return answer
