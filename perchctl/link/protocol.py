"""The link's protocol: what a flight needs of a vehicle's link."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from perchctl.mission import SentCommand
from perchctl.vehicle import Command, ExternalPosition, MeasuredBy, Telemetry

SentCallback = Callable[[SentCommand], None]
"""Called with what a link sends in the loop's place; neither waits nor raises."""


def ignore_sent(sent: SentCommand) -> None:
    """A `SentCallback` that does nothing with what was sent."""
    return


class Guard(Protocol):
    """Decides what is sent while the flight loop is silent."""

    def poll(
        self, now_s: float, newest: Telemetry | None, waiting: Sequence[Telemetry] = ()
    ) -> Command | None:
        """Return what the link has to send now in the loop's place, None almost always.

        Called about every 50 ms, in a thread of the link's own where it has one, but not while a
        command waits that cannot go out; `newest` is the newest telemetry that has arrived,
        and `waiting` what the loop has not taken in yet, oldest first."""


class Link(Protocol):
    """A vehicle: simulated in lockstep, or behind cflib.

    All methods are called from the flight loop's thread. Errors are
    `perchctl.errors.ConnectionFailed`, `NotFound` or `TimedOut`.
    """

    def connect(self) -> None:
        """Connect, check the firmware, set parameters, unlock the thrust. Bounded."""

    def measured_by(self) -> MeasuredBy:
        """Return what tells the connected vehicle, on the ground, where it is. Bounded, but it may
        take a second."""

    def telemetry(self) -> list[Telemetry]:
        """Return the samples that arrived since the last call, oldest first."""

    def send(self, command: Command) -> None:
        """Hand one command to the vehicle. Never blocks for long."""

    def external(self, place: ExternalPosition) -> bool:
        """Hand a position from outside to the vehicle's estimator, at once or not at all: it is
        never queued behind anything, and raises nothing. Returns True if it went out. Called from
        a thread of its own."""

    def problem(self, now_s: float) -> str | None:
        """Return None while the link works, otherwise one sentence with the cause."""

    def set_guard(self, guard: Guard, on_sent: SentCallback = ignore_sent) -> None:
        """Ask `guard` regularly from now on, until the link is closed. `on_sent` is called, once it
        is on its way, with each command that the link sends in the loop's place: its guard's, an
        order once more over a link that was lost, and the farewell; from the link's own thread
        where it has one."""

    def close(self) -> None:
        """Leave the vehicle safe: closes only when it is not flying (bounded wait)."""
