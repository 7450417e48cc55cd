"""A thread that hands commands to a blocking library, so the flight loop never blocks.

Setpoints coalesce (only the newest counts), and one that has waited too long is dropped;
orders keep their place. `stuck_s` is the heartbeat: for how long the present hand-over has
been hanging. In between the thread asks its `guard` what has to be sent while the loop hangs.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from perchctl.link.protocol import ToldSent, tell_nobody
from perchctl.mission.sent import Sent, SentBy
from perchctl.vehicle import Command, PositionSetpoint, RawThrust

_STREAMED = (PositionSetpoint, RawThrust)
STALE_S = 0.25
"""A setpoint that has waited longer, behind a command that hung, is for another moment."""
GUARD_PERIOD_S = 0.05


class Sender:
    """`guard` gives the command to send of itself, None almost always; asked in the thread,
    every `GUARD_PERIOD_S` and after each command. `told` is given what the loop did not put in,
    once it is handed over."""

    def __init__(
        self,
        hand_over: Callable[[Command], None],
        guard: Callable[[], Command | None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        told: ToldSent = tell_nobody,
    ) -> None:
        self._hand_over = hand_over
        self._guard = guard
        self._clock = clock
        self._told = told
        self._queue: deque[tuple[float, Command, SentBy | None]] = deque()
        self._ready = threading.Condition()
        self._busy_since_s: float | None = None
        self._running = True
        self.problem: str | None = None
        self._thread = threading.Thread(target=self._run, name="perchctl-sender", daemon=True)
        self._thread.start()

    def put(self, command: Command, by: SentBy | None = None) -> None:
        """`by`: who sends it in the loop's place."""
        with self._ready:
            if self._queue and isinstance(self._queue[-1][1], _STREAMED):
                self._queue.pop()
            self._queue.append((self._clock(), command, by))
            self._ready.notify()

    def stuck_s(self) -> float:
        """Seconds for which one command has been in the library's hands; 0 when idle."""
        since = self._busy_since_s
        return 0.0 if since is None else self._clock() - since

    def drain(self, timeout_s: float) -> bool:
        """Wait until everything is handed over; False when that takes too long."""
        end_s = time.monotonic() + timeout_s
        with self._ready:
            while self._queue or self._busy_since_s is not None:
                left_s = end_s - time.monotonic()
                if left_s <= 0:
                    return False
                self._ready.wait(left_s)
        return True

    def stop(self) -> None:
        with self._ready:
            self._running = False
            self._ready.notify_all()
        self._thread.join(timeout=1.0)

    def _run(self) -> None:
        asked_s = self._clock()
        while True:
            with self._ready:
                if self._running and not self._queue:
                    self._ready.wait(GUARD_PERIOD_S)
                if not self._running:
                    return
                waiting = self._next()
            try:
                if waiting is not None:
                    self._give(*waiting)
                if self._clock() - asked_s >= GUARD_PERIOD_S:
                    asked_s = self._clock()
                    self._send_for_guard()
            except Exception as error:  # the library's, whatever it is: reported by `problem`
                self.problem = f"a command could not be sent: {error}"
            with self._ready:
                self._busy_since_s = None
                self._ready.notify_all()

    def _next(self) -> tuple[Command, SentBy | None] | None:
        while self._queue:
            put_s, command, by = self._queue.popleft()
            if isinstance(command, _STREAMED) and self._clock() - put_s > STALE_S:
                continue
            self._busy_since_s = self._clock()
            return command, by
        return None

    def _send_for_guard(self) -> None:
        command = self._guard()
        if command is not None:
            self._busy_since_s = self._clock()
            self._give(command, "watchdog")

    def _give(self, command: Command, by: SentBy | None) -> None:
        at_s = self._clock()
        self._hand_over(command)
        if by is not None:
            with suppress(Exception):  # whatever looks on: the next command goes out all the same
                self._told(Sent(at_s, by, command))
