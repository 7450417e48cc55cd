"""The operator's commands: Ctrl-C, other signals, the space bar and the live page's buttons.

Each press of Ctrl-C reaches the program as one signal, and so does each automatic repeat while the
key is held down. The program can tell them apart only by their timing:

========================================================  ==========================================
presses                                                   order
========================================================  ==========================================
one                                                       land
two, less than `SAME_PRESS_S` apart                       land
two, `SAME_PRESS_S` to `LONGEST_DELAY_S` apart, no third  land, and stop `KEY_REPEAT_WAIT_S` after
                                                          the second: it was not a key repeat
a second one later than that                              stop at once
three within a second, not spaced as a key repeats        stop at once
spaced as a key repeats                                   land for a second after the first; the
                                                          first press after that stops
spaced as a key repeats, and let go within that second    land if no hand presses like that
                                                          (`_is_surely_key`), else stop
========================================================  ==========================================

A held key waits 0.25 to 1 s and then repeats 5 to 33 times a second, evenly (terminals on Linux:
after 250 to 660 ms, every 30 to 92 ms). A person presses a key 3 to 10 times a second, unevenly,
and the first interval is no longer than the next ones. If either a held key or a hand could have
caused the presses, they count as a stop, because a falling vehicle does less harm than one that
flies on against the operator's command.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import signal
import socket
import termios
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from perchctl.errors import Interrupted
from perchctl.mission import OperatorRequest

STOP_HELP = "Press Ctrl-C to land. Press it again to cut the motors."
KEY_HELP = "The space bar cuts the motors at once."
"""How the operator stops a flight. Every help text, panel, page and document uses these
sentences."""

SAME_PRESS_S = 0.3
"""Two presses that are closer together than this count as one, s. Larger: a quick second press is
missed."""
LONGEST_DELAY_S = 1.0
"""Longest time for which a keyboard waits before it repeats a key, s. Within this time, a second
press may be the first repeat of a held key. Larger: it takes longer until a held key does more than
land the vehicle, and evenly repeated presses stop the motors later."""
SHORTEST_DELAY_S = 0.25
"""Shortest time for which a keyboard waits before it repeats a key, s. Smaller: more presses by
hand are mistaken for a held key."""
SLOWEST_REPEAT_S = 0.2
"""Longest time between two repeats of a key, s. Larger: the stop by a second press is delayed."""
KEY_JITTER_S = 0.02
"""Longest delay with which a busy computer reads a repeat, s. Larger: more presses by hand are
mistaken for a held key."""
KEY_REPEAT_WAIT_S = SLOWEST_REPEAT_S + KEY_JITTER_S + 0.01
"""Time after which a key that is still held must have repeated."""
FASTER_THAN_A_HAND_S = 0.08
"""Mean interval below which repeats must come from a held key, s. Larger: more presses by hand are
mistaken for a held key."""
SHORTEST_FAST_DELAY_S = 0.15
"""Shortest initial delay of a key whose mean repeat interval is below `FASTER_THAN_A_HAND_S`
(``xset r rate 200 50``), s."""
LONGER_THAN_REPEATS = 1.2
"""Lowest ratio of a key's initial delay to the mean interval of its repeats. Presses by hand have
similar intervals throughout."""
SURE_REPEATS, SURELY_LONGER = 4, 2.0
"""If there are at least this many even repeats, and the first interval is at least this many times
as long as their mean interval, the presses must come from a held key, even at a rate that a hand
can reach."""
STOP_HANG_S = 10.0
"""Time within which a stopped flight must end, s. After that, the flight counts as hanging."""
_EPS_S = 1e-9


@dataclass
class OperatorSwitch:
    """The operator's command for planner and watchdog, according to the table above.

    `press` handles Ctrl-C. `land` handles the Land button on the live page and the signals that ask
    a program to end: it lands the vehicle, never stops the motors, and may be repeated. `cut`
    handles the space bar and the Cut motors button: it stops the motors at once. All methods may be
    called from any thread.

    `interrupt` raises `Interrupted` if the flight loop is not listening yet, because there is
    nothing to land, and once `STOP_HANG_S` has passed after a stop, because nothing is left to do.
    """

    listening: bool = False
    closing: bool = False  # True while the link is being closed
    landing_requested: bool = False
    clock: Callable[[], float] = time.monotonic
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)
    _presses_s: list[float] = field(default_factory=list)  # recorded until they amount to a stop
    _stopped_s: float = math.inf

    def read(self) -> OperatorRequest:
        with self._lock:
            self._decide(self.clock())
            if self._stopped_s < math.inf:
                return OperatorRequest.CUT_MOTORS
            pressed = bool(self._presses_s) or self.landing_requested
            return OperatorRequest.LAND if pressed else OperatorRequest.NONE

    def land(self) -> None:
        self.landing_requested = True

    def cut(self) -> None:
        with self._lock:
            self._stopped_s = min(self._stopped_s, self.clock())

    def press(self, count: int = 1) -> None:
        """Record that Ctrl-C was pressed `count` times since the last call. The exact times are
        unknown, so the presses are assumed to be evenly spaced, like presses by hand."""
        with self._lock:
            now_s = self.clock()
            self._decide(now_s)
            since_s = self._presses_s[-1] if self._presses_s else now_s
            for number in range(count):
                if self._stopped_s == math.inf:
                    self._presses_s.append(since_s + (now_s - since_s) * (number + 1) / count)
                    self._decide(now_s)

    def interrupt(self) -> None:
        """Raise `Interrupted` if a signal arrives while the loop does not read commands; called in
        the main thread."""
        if not self.listening:
            raise Interrupted("interrupted before take-off: nothing was started")
        if not self.closing and self.clock() - self._stopped_s >= STOP_HANG_S:
            raise Interrupted("the flight did not end after the motors were cut")

    def _decide(self, now_s: float) -> None:
        if self._stopped_s == math.inf and _is_stop(self._presses_s, now_s):
            self._stopped_s = now_s


def _is_stop(presses_s: Sequence[float], now_s: float) -> bool:
    """True if these presses, with no further press until `now_s`, stop the motors. Once true, it
    stays true."""
    if len(presses_s) < 2:
        return False
    first_s, last_s = presses_s[0], presses_s[-1]
    if last_s - first_s >= LONGEST_DELAY_S - _EPS_S:
        return True
    if len(presses_s) == 2 and last_s - first_s < SAME_PRESS_S - _EPS_S:
        return False
    if not _may_be_key(presses_s):
        return True
    return now_s - last_s >= KEY_REPEAT_WAIT_S - _EPS_S and not _is_surely_key(presses_s)


def _may_be_key(presses_s: Sequence[float]) -> bool:
    """True if a single held key can have caused these presses (two or more)."""
    delay_s, repeats_s = presses_s[1] - presses_s[0], presses_s[1:]
    mean_s = _mean_gap_s(repeats_s)
    if len(repeats_s) > 1 and mean_s <= FASTER_THAN_A_HAND_S:
        return delay_s >= SHORTEST_FAST_DELAY_S - KEY_JITTER_S
    return (
        delay_s >= SHORTEST_DELAY_S - KEY_JITTER_S - _EPS_S
        and mean_s <= SLOWEST_REPEAT_S + KEY_JITTER_S + _EPS_S
        and delay_s >= LONGER_THAN_REPEATS * mean_s
        and _are_even(repeats_s)
    )


def _is_surely_key(presses_s: Sequence[float]) -> bool:
    """True if these presses, which a held key may have caused, cannot be separate presses by
    hand."""
    delay_s, repeats_s = presses_s[1] - presses_s[0], presses_s[1:]
    mean_s = _mean_gap_s(repeats_s)
    if len(repeats_s) < 2:
        return False
    even = len(repeats_s) >= SURE_REPEATS and delay_s >= SURELY_LONGER * mean_s
    return even or mean_s <= FASTER_THAN_A_HAND_S


def _mean_gap_s(times_s: Sequence[float]) -> float:
    return (times_s[-1] - times_s[0]) / (len(times_s) - 1) if len(times_s) > 1 else 0.0


def _are_even(times_s: Sequence[float]) -> bool:
    """True if these times fit multiples of one period, each up to `KEY_JITTER_S` late. Two times
    that are ``k`` periods and ``d`` seconds apart limit the period to ``(d +- KEY_JITTER_S) /
    k``."""
    pairs = [
        (later_s - earlier_s, k)
        for i, earlier_s in enumerate(times_s)
        for k, later_s in enumerate(times_s[i + 1 :], 1)
    ]
    least_s = max(((d - KEY_JITTER_S) / k for d, k in pairs), default=0.0)
    most_s = min(((d + KEY_JITTER_S) / k for d, k in pairs), default=0.0)
    return least_s <= most_s + _EPS_S


# --- Signals that end a flight ---


LANDING_SIGNALS = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)
"""Signals that end or suspend other programs; when a flight receives one, it lands."""
_MUTED = (signal.SIGTTOU, signal.SIGTTIN)  # would suspend a flight that runs in the background
_NO_SUSPENDING = "Ctrl-Z cannot suspend a flight: landing"


@contextlib.contextmanager
def operator_signals(switch: OperatorSwitch, report: Callable[[str], None]) -> Iterator[None]:
    """During a flight, connect Ctrl-C to the switch and let `LANDING_SIGNALS` land the vehicle
    (main thread only).

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
        if presses := numbers.count(signal.SIGINT):
            switch.press(presses)
        if any(number in LANDING_SIGNALS for number in numbers):
            switch.land()
        if switch.listening and signal.SIGTSTP in numbers:
            # The line is not printed from this thread, because the thread would block if Ctrl-S had
            # stopped the terminal's output.
            threading.Thread(target=report, args=(_NO_SUSPENDING,), daemon=True).start()


# --- The key that cuts the motors ---


_KEY = b" "
_KEYS_AT_ONCE = 1024


@contextlib.contextmanager
def cut_key(
    switch: OperatorSwitch, terminal: int, on_keys: Callable[[bytes], None] = lambda keys: None
) -> Iterator[bool]:
    """Let the space bar cut the motors while the block runs.

    Yields True if this is possible, that is, if the file descriptor is a terminal with this process
    in the foreground; otherwise nothing is changed.

    `on_keys` is called with all keys in another thread and must return at once. Keys take effect
    without Enter and are not echoed; Ctrl-C and Ctrl-Z still cause signals. Keys pressed before or
    during the block are discarded, so that a stale one neither cuts the motors nor reaches the
    shell. The terminal is restored however the block ends.
    """
    before = _terminal_mode(terminal)
    if before is None:
        yield False
        return
    waker, wakes = os.pipe()
    keys = threading.Thread(
        target=_read_keys,
        args=(switch, terminal, waker, on_keys),
        name="perchctl-keys",
        daemon=True,
    )
    try:
        _set_mode(terminal, _keys_mode(before))
        keys.start()
        yield True
    finally:
        os.close(wakes)
        if keys.ident is not None:
            keys.join(1.0)
        os.close(waker)
        _set_mode(terminal, before)


def _terminal_mode(terminal: int) -> list[Any] | None:
    """Return the terminal's mode if this process may read keys from it; otherwise None."""
    with contextlib.suppress(OSError, ValueError, termios.error):
        if os.tcgetpgrp(terminal) == os.getpgrp():
            return termios.tcgetattr(terminal)
    return None


def _keys_mode(mode: list[Any]) -> list[Any]:
    changed = [*mode[:6], list(mode[6])]
    changed[3] &= ~(termios.ICANON | termios.ECHO)
    changed[6][termios.VMIN], changed[6][termios.VTIME] = 1, 0
    return changed


def _set_mode(terminal: int, mode: list[Any]) -> None:
    """Set a terminal's mode and discard pending keys. Does not wait for the output, which Ctrl-S
    may have stopped. Does nothing if the terminal is gone."""
    with contextlib.suppress(OSError, termios.error):
        termios.tcsetattr(terminal, termios.TCSANOW, mode)
        termios.tcflush(terminal, termios.TCIFLUSH)


def _read_keys(
    switch: OperatorSwitch, terminal: int, waker: int, on_keys: Callable[[bytes], None]
) -> None:
    with contextlib.suppress(OSError, ValueError):  # the terminal is closed
        while True:
            ready, _, _ = select.select([terminal, waker], [], [])
            if waker in ready:
                return
            keys = os.read(terminal, _KEYS_AT_ONCE)
            if _KEY in keys:
                switch.cut()
            if not keys:
                return
            on_keys(keys)
