"""Run your own link to a vehicle in threads that isolate its errors and hangs from the flight."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress

from perchctl.errors import ConnectionFailed, TimedOut
from perchctl.extensions import error_at
from perchctl.link.arming import disarm, warn_of_armed
from perchctl.link.protocol import LANDING_WAIT_S, Guard, SentCallback, VehicleLink, ignore_sent
from perchctl.link.sender import LIBRARY_HANG_S, Sender
from perchctl.link.telemetry import FIRST_SAMPLE_TIMEOUT_S
from perchctl.vehicle import (
    Arm,
    Command,
    ExternalPosition,
    Idle,
    Telemetry,
    is_armed_by_request,
    may_be_flying,
)

READ_PERIOD_S = 0.005
"""Time between two reads of your own link, s."""
SAMPLE_AHEAD_S = 0.1
"""Largest time by which a sample may be ahead of the loop's clock, s; a sample that is further
ahead comes from another clock."""


class GuardedLink:
    """`perchctl.link.protocol.Link` around your own link.

    A reader thread asks your link for telemetry and problems, and the threads of the `Sender` pass
    commands to it and call the watchdog, so that nothing waits for a call that hangs. An exception,
    an invalid sample, or a call longer than `LIBRARY_HANG_S` counts as a lost link until it works
    again; exceptions in `send` count once they have persisted for `LIBRARY_HANG_S`.
    """

    def __init__(self, inner: VehicleLink, clock: Callable[[], float]) -> None:
        self._inner, self._clock, self.decks = inner, clock, inner.decks
        self._lock = threading.Lock()
        self._waiting: list[Telemetry] = []  # samples that the loop has not taken yet
        self._newest: Telemetry | None = None
        self._trouble: str | None = (
            None  # the link's own problem or exception in the reader's last cycle
        )
        self._answered_s: float | None = None  # when the reader's last cycle ended
        self._was_armed = False  # armed by a command of this session
        self._first_sample, self._closing = threading.Event(), threading.Event()
        self._guard: Guard | None = None
        self._on_sent: SentCallback = ignore_sent
        self._sender = Sender(self._hand_over, self._ask, clock, lambda sent: self._on_sent(sent))

    def connect(self) -> None:
        """Connect, and check that the vehicle is not armed yet.

        Raises TimedOut if no telemetry arrives for this check, and ConnectionFailed if the vehicle
        is armed, because its propellers could spin before the operator has confirmed the flight.
        """
        self._inner.connect()
        self._answered_s = self._clock()
        threading.Thread(target=self._read, name="perchctl-own-link", daemon=True).start()
        if not self._first_sample.wait(FIRST_SAMPLE_TIMEOUT_S) or self._newest is None:
            cause = f": {self._trouble}" if self._trouble else ""
            raise TimedOut(f"your own link is connected but delivers no telemetry{cause}")
        if is_armed_by_request(self._newest.supervisor):
            raise ConnectionFailed(
                "the vehicle of your own link is already armed: keep away from its propellers; "
                "connect must not arm the vehicle, since perchctl sends Arm just before take-off; "
                "if the vehicle arms itself without turning its motors, its telemetry must set the "
                "bit AUTO_ARM"
            )

    def telemetry(self) -> list[Telemetry]:
        with self._lock:
            samples, self._waiting = self._waiting, []
        return samples

    def send(self, command: Command) -> None:
        if not isinstance(command, Idle):
            self._was_armed = self._was_armed or command == Arm(True)
            self._sender.put(command)

    def send_external(self, place: ExternalPosition) -> bool:
        return False

    def problem(self, now_s: float) -> str | None:
        silent_s = 0.0 if self._answered_s is None else now_s - self._answered_s
        hangs = (
            f"telemetry() has not returned for {silent_s:.1f} s"
            if silent_s > LIBRARY_HANG_S
            else None
        )
        return self._sender.trouble() or hangs or self._trouble

    def new_notes(self) -> list[str]:
        """Return messages about harmless failures since the last call."""
        return self._sender.new_notes()

    def set_guard(self, guard: Guard, on_sent: SentCallback = ignore_sent) -> None:
        self._guard, self._on_sent = guard, on_sent

    def close(self) -> None:
        """Wait until the vehicle is no longer flying, with a timeout; then disarm it and close the
        inner link."""
        self._sender.drain(1.0)
        end_s = time.monotonic() + (0.0 if self._answered_s is None else LANDING_WAIT_S)
        while may_be_flying(self._newest, self._clock()) and time.monotonic() < end_s:
            time.sleep(0.05)
        disarmed = disarm(
            lambda: self._newest,
            lambda order: self._sender.put(order, "farewell"),
            self._clock,
            time.sleep,
            was_ordered=self._was_armed,
        )
        self._closing.set()
        self._sender.stop()
        with suppress(Exception):  # the flight is over, and its report must still be written
            self._inner.close()
        if self._was_armed and not disarmed:
            warn_of_armed("the vehicle of your own link")

    def _hand_over(self, command: Command) -> None:
        try:
            self._inner.send(command)
        except BaseException as error:
            # The sender counts the error and retries; SystemExit would end its thread.
            raise RuntimeError(f"send() raised {error_at(error)}") from error

    def _ask(self) -> Command | None:
        with self._lock:
            newest, waiting = self._newest, tuple(self._waiting)
        return None if self._guard is None else self._guard(self._clock(), newest, waiting)

    def _read(self) -> None:
        """Read until the link is closed, even after errors, since a landing needs the telemetry."""
        while not self._closing.wait(READ_PERIOD_S):
            try:
                samples = [self._checked(sample) for sample in self._inner.telemetry()]
                with self._lock:
                    self._waiting += samples
                    self._newest = samples[-1] if samples else self._newest
                if samples:
                    self._first_sample.set()
                self._trouble = self._inner.problem(self._clock())
            except BaseException as error:
                self._trouble = f"telemetry() or problem() raised {error_at(error)}"
            self._answered_s = self._clock()

    def _checked(self, sample: object) -> Telemetry:
        if not isinstance(sample, Telemetry):
            raise TypeError(f"a sample must be a Telemetry, not {type(sample).__name__}")
        if not sample.t_s <= self._clock() + SAMPLE_AHEAD_S:
            raise ValueError(f"a sample's t_s must be in the past, not {sample.t_s}")
        return sample
