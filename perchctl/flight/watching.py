"""Observers of a flight. If an observer raises an exception, it is detached and the flight
continues.

A panel, a page, a callback or a log may fail in any tick. The observer is then detached, the other
observers are informed, and the flight continues without it. Two kinds of exceptions are raised
after the loop has landed the vehicle: errors from the judges, because without its judges a
simulated flight would prove nothing, and requests to exit (KeyboardInterrupt, SystemExit).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol, TypeGuard, TypeVar

from perchctl.extensions import error_at
from perchctl.mission import Event, SentCommand, Tick, TickRecord, Watcher
from perchctl.vision import Frame

T = TypeVar("T")

SLOW_WATCHER_S = 0.25
"""Duration above which a call to a watcher is reported, s, because the loop does not control the
flight during the call."""


class FrameWatcher(Watcher, Protocol):
    """A watcher that also receives the camera's frames."""

    def frame(self, frame: Frame) -> None:
        """Receive a frame before it is searched; called before take-off as well."""


class TurnWatcher(Watcher, Protocol):
    """A watcher that receives everything that a flight log contains: also loop iterations (turns)
    without a tick, that is, before take-off or with a discarded decision, and the commands that the
    link sends in the loop's place."""

    def turn(self, turn: TickRecord) -> None: ...

    def sent(self, sent: SentCommand) -> None:
        """Receive a command that was sent in the loop's place. Called in another thread; must not
        block."""

    def note_detached(self, reason: str) -> None:
        """Record in `problem` that nothing more will be written, because writing failed for
        `reason`."""


class Watchers:
    """Passes the frames, events, ticks, turns and sent commands of a flight to each watcher.

    `judges` are never detached. `now` is the loop's clock, `remarks` returns new notes.

    Attributes:
        detached: one sentence for each detached watcher, in the order of detachment.
    """

    def __init__(
        self,
        watchers: Sequence[Watcher],
        now: Callable[[], float],
        remarks: Callable[[], Sequence[str]] = tuple,
        judges: Sequence[Watcher] = (),
    ) -> None:
        self.detached: list[str] = []
        self._active: tuple[Watcher, ...] = (*judges, *watchers)
        self._judges = {id(judge) for judge in judges}
        self._now, self._remarks = now, remarks
        self._lock = threading.Lock()  # `sent` comes from the link's thread
        self._notes: list[str] = []
        self._slow: set[str] = set()
        self._log_problem: str | None = None

    @property
    def have_log(self) -> bool:
        """True if one of the watchers records turns."""
        return any(takes_turns(watcher) for watcher in self._active)

    @property
    def problem(self) -> str | None:
        """The reason why records of the flight are lost; None if no records are lost."""
        for watcher in self._active:
            try:
                if watcher.problem:
                    return watcher.problem
            except Exception as error:
                if id(watcher) in self._judges:
                    raise
                self._detach(watcher, error)
        return self._log_problem

    def frame(self, frame: Frame) -> None:
        for watcher in self._active:
            if takes_frames(watcher):
                self._call(watcher, watcher.frame, frame)

    def event(self, event: Event) -> None:
        for watcher in self._active:
            self._call(watcher, watcher.event, event)

    def tick(self, tick: Tick) -> None:
        for watcher in self._active:
            self._call(watcher, watcher.tick, tick)

    def turn(self, turn: TickRecord) -> None:
        for watcher in self._active:
            if takes_turns(watcher):
                self._call(watcher, watcher.turn, turn)

    def sent(self, sent: SentCommand) -> None:
        """Pass on a command that was sent in the loop's place. Runs in the link's thread and never
        raises, because the next command must still be sent."""
        for watcher in self._active:
            if takes_turns(watcher):
                try:
                    watcher.sent(sent)
                except BaseException as error:  # an exit would end the link's thread
                    self._detach(watcher, error)

    def take_notes(self) -> list[str]:
        """Return the notes for the flight's events that are new since the last call: remarks on the
        recording, and watchers that were slow or detached."""
        try:
            remarks = [*self._remarks()]
        except Exception as error:
            remarks, self._remarks = [], tuple
            self._report(f"perchctl no longer adds notes about this recording: {error_at(error)}")
        with self._lock:
            notes, self._notes = self._notes, []
        return [*remarks, *notes]

    def _call(self, watcher: Watcher, method: Callable[[T], None], value: T) -> None:
        began_s = self._now()
        try:
            method(value)
        except Exception as error:
            if id(watcher) in self._judges:
                raise
            self._detach(watcher, error)
        took_s = self._now() - began_s
        if took_s > SLOW_WATCHER_S and (name := watcher_name(watcher)) not in self._slow:
            self._slow.add(name)
            self._report(f"{name} took {took_s:.1f} s, during which the flight was not controlled")

    def _detach(self, watcher: Watcher, error: BaseException) -> None:
        sentence = f"{watcher_name(watcher)} raised {error_at(error)}"
        with self._lock:
            if all(other is not watcher for other in self._active):
                return  # the other thread has already detached this watcher
            self._active = tuple(other for other in self._active if other is not watcher)
            self.detached.append(f"{sentence}: it was detached, and perchctl continued without it")
            if takes_turns(watcher):  # the loop reports this like any other problem with the log
                self._log_problem = self._log_problem or sentence
                with suppress(Exception):  # the watcher may raise another exception
                    watcher.note_detached(sentence)
                return
        self._report(f"{sentence}: it was detached, and the flight continues")

    def _report(self, note: str) -> None:
        with self._lock:
            self._notes.append(note)


def takes_frames(watcher: Watcher) -> TypeGuard[FrameWatcher]:
    """True for a `FrameWatcher`."""
    return callable(getattr(watcher, "frame", None))


def takes_turns(watcher: Watcher) -> TypeGuard[TurnWatcher]:
    """True for a `TurnWatcher`. `isinstance` is not used, because it would read `problem` and could
    raise an exception."""
    return all(callable(getattr(watcher, name, None)) for name in ("turn", "sent"))


def watcher_name(watcher: Watcher) -> str:
    """The name of a watcher in a message: its attribute `name`, or its class."""
    return str(getattr(watcher, "name", "") or type(watcher).__name__)
