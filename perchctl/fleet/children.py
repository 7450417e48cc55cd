"""The processes of a fleet's vehicles, as the parent sees them."""

from __future__ import annotations

import contextlib
import select
import threading
import time
from pathlib import Path

from perchctl.children import last_line, spawn, wait_or_kill
from perchctl.errors import InvalidValue
from perchctl.extensions import error_at
from perchctl.fleet.messages import Order, Result, Status, find_fault
from perchctl.flight import FlyOptions

PROCESS_END_TIMEOUT_S = 5.0
"""Time for a process to end after it has sent its result, s. Longer: the fleet ends later. Shorter:
a process that is only slow is killed."""
# Before it loads the libraries, the child reports that it is running.
VEHICLE_PROGRAM = (
    "from perchctl.children import connect_to_parent; channel = connect_to_parent(); "
    "from perchctl.fleet.vehicle_process import main; main(channel)"
)


class VehicleProcess:
    """The process of one vehicle. The process runs in its own session, so that the terminal's
    Ctrl-C does not reach it. The output of the process is written to a file in the flight's folder.

    A thread receives the messages from the process. If the process is stopped in the middle of a
    message, only this thread is blocked. An invalid message is dropped, and `fault` says why.
    """

    def __init__(self, name: str, options: FlyOptions) -> None:
        """Start the process. Raises InvalidValue if the folder cannot be written, and OSError if no
        process can be started."""
        self._status: Status | None = None
        self._result: Result | None = None
        self._heard_s = time.monotonic()
        self._fault: str | None = None
        self._closed = False
        self._output_path = Path(options.log_dir) / f"{name}.txt"
        try:
            self._output_path.parent.mkdir(parents=True, exist_ok=True)
            self._output = self._output_path.open("wb+")
        except OSError as error:
            raise InvalidValue(
                f"{self._output_path} cannot be written ({error.strerror}): name another folder "
                f"with --log-dir"
            ) from None
        self._process, self._channel = spawn(VEHICLE_PROGRAM, self._output)
        self.pid = self._process.pid
        # the process has already ended, which is detected elsewhere
        with contextlib.suppress(OSError):
            self._channel.send(options)
        self._reader = threading.Thread(target=self._read, name=f"fleet-{name}", daemon=True)
        self._reader.start()

    def send(self, order: Order) -> None:
        """Send an order, or drop it if the buffer is full: a stopped process reads nothing, and
        must not block the parent, which also serves the other vehicles."""
        with contextlib.suppress(OSError, ValueError):
            if select.select([], [self._channel], [], 0.0)[1]:
                self._channel.send(order)

    def newest(self) -> tuple[Status | None, float]:
        return self._status, self._heard_s

    def result(self) -> Result | None:
        return self._result

    def fault(self) -> str | None:
        return self._fault

    def end_of_process(self) -> str | None:
        if self._reader.is_alive() or self._result is not None:
            return None
        # A process that has lost its connection lands its vehicle, so it must not be killed yet.
        code = self._process.poll()
        if code is None:
            return None
        how = f"signal {-code}" if code < 0 else f"exit {code}"
        return f"its process has ended unexpectedly ({how}){last_line(self._output)}"

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> None:
        """End the process, with a timeout, and delete its output file if that is empty. May be
        called twice."""
        if self._closed:
            return
        self._closed = True
        wait_or_kill(self._process, PROCESS_END_TIMEOUT_S if self._result is not None else 0.0)
        self._reader.join(PROCESS_END_TIMEOUT_S)
        self._channel.close()
        with contextlib.suppress(OSError):
            is_empty = self._output.seek(0, 2) == 0
            self._output.close()
            if is_empty:
                self._output_path.unlink()

    def _read(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while self._result is None:
                self._take_message()

    def _take_message(self) -> None:
        """Receive the next message. Raises EOFError or OSError if the process is gone."""
        try:
            message = self._channel.receive()
        except (EOFError, OSError):
            raise
        except Exception as error:  # any error that unpickling raises
            self._fault = f"its process sent an unreadable message ({error_at(error)})"
            return
        self._heard_s = time.monotonic()
        fault = None if message is None else find_fault(message)  # None: the process is running
        if fault is not None:
            self._fault = f"its process sent {fault}"
        elif isinstance(message, Status):
            self._status = message
        elif isinstance(message, Result):
            self._result = message
