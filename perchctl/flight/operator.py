"""The operator's commands: Ctrl-C, the other signals, and the live page's STOP button."""

from __future__ import annotations

import contextlib
import math
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import FrameType

from perchctl.errors import Interrupted
from perchctl.mission import Operator

AGAIN_S = 0.5  # a second press counts this long after the first
HELD_S = 0.3  # faster presses are one: a key held down repeats at 5 to 33 Hz
DELAY_S = 1.0  # a keyboard waits no longer before it repeats a key; 0.25 to 0.66 s are usual
INSIST_S = 2.0  # who presses on for so long wants the motors stopped
HUNG_S = 10.0  # a stopped flight that has not ended by then hangs
_EPS_S = 1e-9


@dataclass
class OperatorSwitch:
    """Reads Ctrl-C for the planner: one press lands, two stop the motors.

    `press` is Ctrl-C. A second press counts after at least `HELD_S` of silence and `AGAIN_S` after
    the first. The first repetition of a key held down looks the same, so after a silence of up to
    `DELAY_S` a press counts once no other has followed for `HELD_S`. Presses that still follow each
    other `INSIST_S` after the first are a stop as well. `land` is for STOP on the live page and for
    the signals that ask a program to end: it lands however often it comes, and never stops the
    motors. All methods may be called from any thread.

    Until the flight loop listens there is nothing to land, and `HUNG_S` after a stop nothing is
    left to do: then `interrupt` raises `Interrupted`.
    """

    listening: bool = False
    closing: bool = False  # the link
    landing_requested: bool = False
    clock: Callable[[], float] = time.monotonic
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _first_s: float | None = None
    _last_s: float = 0.0
    _second_s: float | None = None
    _stopped_s: float = math.inf

    def read(self) -> Operator:
        with self._lock:
            self._confirm(self.clock())
            if self._stopped_s < math.inf:
                return Operator.STOP
            pressed = self._first_s is not None or self.landing_requested
            return Operator.LAND if pressed else Operator.NONE

    def land(self) -> None:
        self.landing_requested = True

    def press(self) -> None:
        with self._lock:
            now_s = self.clock()
            self._confirm(now_s)
            silent_s = now_s - self._last_s
            if self._first_s is None:
                self._first_s = now_s
            elif silent_s < HELD_S - _EPS_S:  # a key has begun to repeat, or it is hammered
                self._second_s = None
                self._confirm(now_s, now_s - self._first_s >= INSIST_S - _EPS_S)
            elif now_s - self._first_s >= AGAIN_S - _EPS_S:
                self._second_s = now_s
                self._confirm(now_s, silent_s > DELAY_S + _EPS_S)
            self._last_s = now_s

    def interrupt(self) -> None:
        """Raises `Interrupted` on a signal where the loop does not listen; called in the main
        thread."""
        if not self.listening:
            raise Interrupted("interrupted before take-off: nothing was started")
        if not self.closing and self.clock() - self._stopped_s >= HUNG_S:
            raise Interrupted("the stopped flight hung")

    def _confirm(self, now_s: float, insists: bool = False) -> None:
        second_s = self._second_s
        alone = second_s is not None and now_s - second_s >= HELD_S - _EPS_S
        if alone or insists:
            self._stopped_s = min(self._stopped_s, now_s)


# --- Signals that end a flight ---


LANDING_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""End or suspend a program elsewhere; a flight they land."""
_MUTED = (signal.SIGTTOU, signal.SIGTTIN)  # would suspend a flight in a shell's background
_NO_SUSPENDING = "Ctrl-Z does not suspend a flight: landing"


@contextlib.contextmanager
def operator_signals(switch: OperatorSwitch, report: Callable[[str], None]) -> Iterator[None]:
    """Let Ctrl-C press the switch during a flight, and `LANDING_SIGNALS` land (main thread only).

    A separate thread reads the signals from Python's wakeup socket, so they take effect even while
    the main thread hangs in a library. An ignored SIGHUP (nohup) stays ignored. `report` prints a
    line.
    """

    def handler(_signal: int, _frame: FrameType | None) -> None:
        switch.interrupt()

    reader, writer = socket.socketpair()
    writer.setblocking(False)
    listener = threading.Thread(
        target=_listen, args=(reader, switch, report), name="perchctl-signals", daemon=True
    )
    listener.start()
    fd_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    before = {}
    try:
        for name in (signal.SIGINT, *LANDING_SIGNALS):
            if name == signal.SIGINT or signal.getsignal(name) is not signal.SIG_IGN:
                before[name] = signal.signal(name, handler)
        for name in _MUTED:
            before[name] = signal.signal(name, signal.SIG_IGN)
        yield
    finally:
        for name, old in before.items():
            signal.signal(name, old)
        signal.set_wakeup_fd(fd_before)
        writer.close()
        listener.join(1.0)
        reader.close()


def _listen(reader: socket.socket, switch: OperatorSwitch, report: Callable[[str], None]) -> None:
    while numbers := reader.recv(64):
        for number in numbers:
            if number == signal.SIGINT:
                switch.press()
            elif number in LANDING_SIGNALS:
                switch.land()
        if switch.listening and signal.SIGTSTP in numbers:
            # Not from this thread: a terminal that stands still would hold up the signals.
            threading.Thread(target=report, args=(_NO_SUSPENDING,), daemon=True).start()
