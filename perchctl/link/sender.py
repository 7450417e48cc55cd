"""Pass commands to a library that may block, fail or hang without ever blocking the flight loop.

There are two threads. The first thread passes commands to the library in pieces (a landing is four
packets) and may hang there. The second thread never calls the library: it asks the `guard` for a
command to send while the loop hangs, and it replaces the first thread with a new one if that hangs.
No error ends either thread.

Setpoints coalesce: only the newest is kept. Setpoints and arming requests that have waited too long
are dropped. Other commands keep their place in the queue until the library has accepted them,
however long that takes. An emergency stop replaces all waiting commands.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from perchctl.link.protocol import SentCallback, ignore_sent
from perchctl.mission import SentCommand
from perchctl.vehicle import Arm, Command, EmergencyStop, PositionSetpoint, RawThrust

_STREAMED = (PositionSetpoint, RawThrust)
_EXPIRING = (*_STREAMED, Arm)
"""Commands that are valid only for a short time: dropped when stale, and never repeated
automatically. A late arming request would spin the propellers after the session has ended."""
STALE_COMMAND_S = 0.25
"""Waiting time after which such a command is stale, s, for example behind a command that hangs."""
GUARD_PERIOD_S = 0.05
"""Period of the second thread, s."""
LIBRARY_HANG_S = 0.5
"""Longest time for which a call into the library may last, or for which such calls may fail, s
(docs/firmware.md, "Silence")."""
SEND_RETRY_S = 0.002
"""Time until a piece that the library did not accept is offered again, s: about the duration of one
radio packet."""
NOTED_EVERY_S = 1.0
"""Shortest time between messages about errors, s."""


@dataclass(eq=False)
class _Waiting:
    """A command from `put` until the library has accepted all of it.

    `rest` is None until the first attempt, then the pieces that are still to be passed on; `begun`
    is True once a piece has been passed on.
    """

    put_s: float
    command: Command
    by: str | None
    rest: deque[Any] | None = None
    begun: bool = False


class Sender:
    """Passes commands to a library, from the creation of this object until `stop`.

    `hand_over` passes one piece to the library; it returns False if there is no room, and the piece
    is then offered again. `guard` returns the command to send in the loop's place, usually None.
    `on_sent` is called with each such command once the library has accepted it.

    `pieces` splits a command. `tend` maintains the link, and must not block: the guard's thread
    calls it after the guard, with `stuck_s`, and with True if the library has held one piece, or
    raised errors, for longer than `LIBRARY_HANG_S`. `spare` is called by the first thread when no
    command waits; it may pass on another packet, and then returns True.

    `errors` counts the failed attempts to send.
    """

    def __init__(
        self,
        hand_over: Callable[[Any], bool | None],
        guard: Callable[[], Command | None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        on_sent: SentCallback = ignore_sent,
        *,
        pieces: Callable[[Command], Sequence[Any]] = lambda command: (command,),
        tend: Callable[[float, bool], None] = lambda stuck_s, hangs: None,
        spare: Callable[[], bool] = lambda: False,
    ) -> None:
        self._hand_over = hand_over
        self._guard = guard
        self._clock = clock
        self._on_sent = on_sent
        self._pieces = pieces
        self._tend = tend
        self._spare = spare
        self._queue: deque[_Waiting] = deque()
        self._ready = threading.Condition()
        self._stopped = threading.Event()  # separate, so that a command does not wake the guard
        # when the next piece began to wait for the library
        self._waiting_since_s: float | None = None
        self._called_s: float | None = None  # when the current call into the library began
        self._held_since_s: float | None = (
            None  # the call that had already lasted too long at the last check
        )
        self._raised = False  # True if the library raised an error at the last attempt
        self._last: tuple[float, Command] | None = None
        self._running = True
        self.errors, self._error = 0, ""
        self._failing_since_s: float | None = None  # first error since the last success
        self._keeper_error: str | None = None  # error in the second thread's last cycle
        self._noted, self._noted_s = 0, -math.inf  # state of the messages about errors
        with self._ready:
            self._start_worker()
        self._keeper = threading.Thread(target=self._keep, name="perchctl-guard", daemon=True)
        self._keeper.start()

    def put(self, command: Command, by: str | None = None) -> None:
        """Queue a command. `by` is the name of the sender if it is not the loop."""
        with self._ready:
            if isinstance(command, EmergencyStop):
                self._queue.clear()  # earlier commands are obsolete
            elif self._queue and self._is_replaced(self._queue[-1], command):
                self._queue.pop()
            self._queue.append(_Waiting(self._clock(), command, by))
            if self._waiting_since_s is None:
                self._waiting_since_s = self._clock()
            self._ready.notify_all()

    def repeat_order(self, since_s: float) -> None:
        """Queue the newest command other than a setpoint again if it was passed on after `since_s`,
        because it may have been lost."""
        with self._ready:
            if self._last is None:
                return
            handed_s, command = self._last
            overtaken = any(not isinstance(w.command, _EXPIRING) for w in self._queue)
        if handed_s >= since_s and not overtaken and not isinstance(command, _EXPIRING):
            self.put(command, "reconnect")

    def stuck_s(self) -> float:
        """Return the time for which no waiting command has been accepted, s; 0 if no command is
        waiting."""
        since_s = self._waiting_since_s
        return 0.0 if since_s is None else self._clock() - since_s

    def trouble(self) -> str | None:
        """Return the reason why commands cannot be sent, in one sentence; None if they can."""
        if self._keeper_error is not None:
            return self._keeper_error
        since_s = self._failing_since_s
        if since_s == -math.inf:
            return f"a command could not be sent: {self._error}"
        if since_s is not None and self._clock() - since_s > LIBRARY_HANG_S:
            failing_s = self._clock() - since_s
            return f"no command could be sent for {failing_s:.1f} s: {self._error}"
        if self.stuck_s() > LIBRARY_HANG_S:
            return f"no command has been sent for {self.stuck_s():.1f} s"
        return None

    def new_notes(self) -> list[str]:
        """Return a sentence with the number of errors if there are new ones, at most once a
        second."""
        now_s, errors = self._clock(), self.errors
        if errors == self._noted or now_s - self._noted_s < NOTED_EVERY_S:
            return []
        self._noted, self._noted_s = errors, now_s
        times = "once" if errors == 1 else f"{errors} times"
        return [f"sending a command has failed {times} so far and was retried: {self._error}"]

    def drain(self, timeout_s: float) -> bool:
        """Wait until all commands are passed on; return False after `timeout_s`."""
        end_s = time.monotonic() + timeout_s
        with self._ready:
            while self._queue:
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    return False
                self._ready.wait(left_s)
        return True

    def stop(self) -> None:
        with self._ready:
            self._running = False
            self._ready.notify_all()
        self._stopped.set()
        for thread in (self._worker, self._keeper):
            thread.join(timeout=1.0)

    # --- first thread ---

    def _start_worker(self) -> None:
        worker = threading.Thread(target=self._work, name="perchctl-sender", daemon=True)
        worker.start()  # if it fails, the old thread stays, and the next check tries again
        self._called_s, self._worker = None, worker

    def _work(self) -> None:
        pause_s = 0.0
        while True:
            with self._ready:
                if pause_s > 0.0:
                    self._ready.wait(pause_s)
                if not self._is_mine():
                    return
                waiting = self._next()
                self._called_s = self._clock()
            try:
                pause_s = 0.0
                if waiting is not None:
                    pause_s = self._send(waiting)
                elif not self._spare():
                    pause_s = GUARD_PERIOD_S
                self._raised = False
            except BaseException as error:  # any error from the library; this thread continues
                self._note_error(error)
                if waiting is not None and self._failing_since_s is None:
                    self._failing_since_s = self._clock()
                self._raised, pause_s = True, GUARD_PERIOD_S
            with self._ready:
                if not self._is_mine():
                    return
                self._called_s = None
                if waiting is None and self._queue:
                    pause_s = 0.0  # a command arrived meanwhile

    def _note_error(self, error: BaseException) -> None:
        self.errors += 1
        self._error = (str(error).strip() or type(error).__name__).splitlines()[0]

    def _is_mine(self) -> bool:
        """True while this thread is the current worker, False once it has been replaced because it
        hung."""
        return self._running and self._worker is threading.current_thread()

    def _next(self) -> _Waiting | None:
        """Return the first command; it stays queued until the library has accepted all of it."""
        while self._queue:
            first = self._queue[0]
            stale = self._clock() - first.put_s > STALE_COMMAND_S
            if not (stale and isinstance(first.command, _EXPIRING)):
                return first
            self._queue.popleft()
        self._done()
        return None

    def _send(self, waiting: _Waiting) -> float:
        """Pass on the next piece if there is room. Return how long to pause, s."""
        at_s = self._clock()
        if waiting.rest is None:
            try:
                waiting.rest = deque(self._pieces(waiting.command))
            except Exception:
                # a retry cannot succeed: drop the command and report the problem at once
                self._remove(waiting)
                self._failing_since_s = -math.inf
                raise
        if waiting.rest and self._hand_over(waiting.rest[0]) is False:
            return SEND_RETRY_S
        with self._ready:
            if not self._is_mine():
                return 0.0  # the next thread has started with the same piece
            self._called_s = self._failing_since_s = None
            if waiting.rest:
                waiting.rest.popleft()
            waiting.begun = True
            self._waiting_since_s = self._clock()
            if waiting.rest:
                return 0.0
            self._last = at_s, waiting.command
            self._remove(waiting)
        if waiting.by is not None:
            # any error from an observer; the next command is still sent
            with suppress(Exception):
                self._on_sent(SentCommand(at_s, waiting.by, waiting.command))
        return 0.0

    def _remove(self, waiting: _Waiting) -> None:
        with self._ready:
            with suppress(ValueError):  # an emergency stop has replaced it
                self._queue.remove(waiting)
            if not self._queue:
                self._done()

    def _done(self) -> None:
        self._waiting_since_s = None
        self._ready.notify_all()

    def _is_replaced(self, last: _Waiting, command: Command) -> bool:
        """True if a new command replaces this one: any command replaces a setpoint, and a command
        of the same type replaces any other command if no piece of it has been sent."""
        if isinstance(last.command, _STREAMED):
            return True
        return not last.begun and type(last.command) is type(command)

    # --- second thread ---

    def _keep(self) -> None:
        while not self._stopped.wait(GUARD_PERIOD_S):
            failed: str | None = None
            for part in (self._look_after_worker, self._run_guard):
                try:
                    part()
                except BaseException as error:  # any error; this thread continues
                    failed = f"link supervision failed: {error}"
            self._keeper_error = failed

    def _look_after_worker(self) -> None:
        called_s, stuck_s = self._called_s, self.stuck_s()
        too_long = called_s is not None and self._clock() - called_s > LIBRARY_HANG_S
        # Two checks are required: after the computer was suspended, every call seems too long at
        # the first check.
        hangs = too_long and called_s == self._held_since_s
        self._held_since_s = called_s if too_long else None
        try:
            self._tend(stuck_s, hangs or (self._raised and stuck_s > LIBRARY_HANG_S))
        finally:
            with self._ready:
                if self._running and hangs and self._called_s == called_s:
                    self._start_worker()

    def _run_guard(self) -> None:
        if self.stuck_s() > GUARD_PERIOD_S:
            return
        command = self._guard()
        if command is not None:
            self.put(command, "watchdog")
