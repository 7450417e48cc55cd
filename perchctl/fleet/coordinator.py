"""The parent of a fleet: it receives the vehicles' messages, sends orders, and ends processes that
hang. The parent has no flight logic.

`Coordinator.step` does one round without waiting; `run` repeats it in a separate thread, so that
neither a blocked terminal nor an unanswered question can delay a stop. If a round hangs, no more
orders are sent, and every vehicle lands by itself.

If a round raises an exception, its decisions can no longer be trusted, and
`Coordinator.step_stopping` permanently replaces `step`. `step_stopping` orders all vehicles to land
or, on the operator's command, to cut their motors, and needs neither the plan nor the vehicles'
reports.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Protocol

from perchctl.errors import InvalidValue, PerchError, SafetyAbort
from perchctl.extensions import error_at
from perchctl.fleet.dispatch import (
    HUNG_S,
    NearPair,
    VehicleView,
    are_all_ready,
    decide,
    find_near_pairs,
    find_unwatched,
)
from perchctl.fleet.messages import BEAT_S, Order, Result, Stage, Status, VehicleOutcome
from perchctl.fleet.outcome import LOOK_FIRST, worst_code
from perchctl.fleet.plan import FleetPlan
from perchctl.flight import OperatorSwitch
from perchctl.mission import OperatorRequest

ROUND_S = 0.02
"""Time between two rounds, s. Longer: a stop is delayed for longer. Shorter: the rounds use too
much computing time."""
START_HUNG_S = 60.0
"""Time after which a process that has not sent anything yet is killed, s. On a busy computer,
loading its libraries takes half a minute, and nothing is armed before all vehicles are ready.
Longer: the operator waits longer for a process that hangs during its start. Shorter: a busy
computer cannot start a fleet."""
LOOP_HUNG_S = 60.0
"""Time without an iteration (turn) of its flight loop after which a process is killed, s. This time
is longer than a landing by the watchdog takes, including closing the link and the log. Longer: the
fleet waits needlessly."""


class Child(Protocol):
    """The process of one vehicle, as the parent sees it. No method waits."""

    def send(self, order: Order) -> None:
        """Send an order, or drop it if the buffer is full; the next order has the same content."""

    def newest(self) -> tuple[Status | None, float]:
        """Return the newest status, and the time of the last message by `time.monotonic`."""

    def result(self) -> Result | None:
        """Return the result of the process once it has sent one and has ended."""

    def fault(self) -> str | None:
        """Return what was wrong with a message from the process, in words; None if all messages
        were valid."""

    def end_of_process(self) -> str | None:
        """Return how the process ended without a result, in words; None while it is running."""

    def kill(self) -> None:
        """End the process at once."""


class Coordinator:
    """Flies a fleet according to its plan. `confirm`, `land` and `views` may be used from any
    thread.

    Attributes:
        started: True once the first group has been given permission to take off.
        reasons: why vehicles were ordered to land, unless the operator ordered it.
        near_pairs: pairs that were ordered to land because they came too close to each other.
        unwatched: vehicles in the air whose distance to another one is currently unknown.
        rounds: the number of rounds so far; it does not change while the thread hangs.
        failure: the error that a round has raised, after which all vehicles are ordered to land;
            otherwise None.
    """

    def __init__(
        self,
        plan: FleetPlan,
        children: Mapping[str, Child],
        switch: OperatorSwitch,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.started = False
        self.reasons: dict[str, str] = {}
        self.near_pairs: tuple[NearPair, ...] = ()
        self.unwatched: tuple[str, ...] = ()
        self.rounds = 0
        self.failure: str | None = None
        self._plan, self._children, self._switch, self._clock = plan, children, switch, clock
        self._confirmed = False
        # Vehicles in the order of `land` calls. This is a dict because adding a key is atomic, and
        # the keyboard and the page may call `land` at the same time.
        self._landed: dict[str, None] = {}
        self._were_near: frozenset[str] = frozenset()
        self._garbled: frozenset[str] = frozenset()
        self._results: dict[str, Result] = {}
        self._views = tuple(VehicleView(name=name) for name in children)
        self._sent: dict[str, Order] = {}
        self._sent_s: dict[str, float] = {}
        self._begun_s = clock()
        self._may_have_flown: set[str] = set()

    # --- Queries and commands, from any thread ---

    @property
    def views(self) -> tuple[VehicleView, ...]:
        """What is known about each vehicle, in the order of the fleet file."""
        return self._views

    @property
    def are_ready(self) -> bool:
        """True if all vehicles are currently ready."""
        return are_all_ready(self._views)

    @property
    def has_ended(self) -> bool:
        """True once every vehicle has ended."""
        return all(view.result is not None for view in self._views)

    def confirm(self) -> None:
        """Record the operator's confirmation: the flights begin as soon as all vehicles are ready
        at the same time."""
        self._confirmed = True

    def land(self, name: str) -> None:
        """Land one vehicle. A vehicle that is still on the floor can no longer take off. Raises
        InvalidValue if no vehicle in the fleet has this name."""
        if name not in self._children:
            known = ", ".join(self._children)
            raise InvalidValue(f"the fleet has no vehicle {name!r}; it has {known}")
        self._landed[name] = None

    # --- One round ---

    def step(self) -> None:
        """Receive all messages, decide, and send each order that is new or due."""
        now_s = self._clock()
        self._views = tuple(
            self._heard(name, child, now_s) for name, child in self._children.items()
        )
        # Read only once per round: if a second read returned a new command to land, the permission
        # to start would already have been given.
        word = self._switch.read()
        if self._confirmed and are_all_ready(self._views) and word is OperatorRequest.NONE:
            self.started = True
        self._watch_distances()
        self._watch_messages()
        landed = {*tuple(self._landed), *self._were_near, *self._garbled}
        decision = decide(self._plan, self._views, started=self.started, word=word, landed=landed)
        for name, why in decision.reasons.items():
            self.reasons.setdefault(name, why)
        for name, order in decision.orders.items():
            self._send(name, order, now_s)
        self.rounds += 1

    def run(self, until: threading.Event) -> None:
        """Repeat `step` until `until` is set; after a round that raised an exception, repeat
        `step_stopping`."""
        while not until.wait(ROUND_S):
            if self.failure is None:
                try:
                    self.step()
                except Exception as error:
                    self.failure = error_at(error)
            if self.failure is not None:
                self.step_stopping()

    def step_stopping(self) -> None:
        """Order all vehicles to land or, on the operator's command, to cut their motors, and
        receive the messages that can still be received. An error with one vehicle does not prevent
        the orders to the others."""
        now_s, word = self._clock(), self._switch.read()
        order = Order(
            word=OperatorRequest.CUT_MOTORS
            if word is OperatorRequest.CUT_MOTORS
            else OperatorRequest.LAND
        )
        for name in self._children:
            with contextlib.suppress(Exception):
                self._send(name, order, now_s)
        views = []
        for before in self._views:
            try:
                view = self._heard(before.name, self._children[before.name], now_s)
            except Exception:
                view = replace(before, silent_s=before.silent_s + ROUND_S)
            views.append(view)
        self._views = tuple(views)
        self.rounds += 1

    def _watch_distances(self) -> None:
        """Land both vehicles of a pair that came too close. The landing continues even after they
        have moved apart again."""
        self.unwatched = find_unwatched(self._plan, self._views)
        for pair in find_near_pairs(self._plan, self._views):
            both = {pair.first, pair.second}
            if not any(both == {each.first, each.second} for each in self.near_pairs):
                self.near_pairs = (*self.near_pairs, pair)
            for name in both - self._were_near:
                self.reasons.setdefault(name, pair.why(name))
            self._were_near |= both

    def _watch_messages(self) -> None:
        """Land each vehicle that has sent an invalid message, since its state is then unknown."""
        for name, child in self._children.items():
            fault = child.fault()
            if fault is not None and name not in self._garbled:
                self._garbled |= {name}
                self.reasons.setdefault(name, fault)

    def _heard(self, name: str, child: Child, now_s: float) -> VehicleView:
        status, heard_s = child.newest()
        silent_s = now_s - max(heard_s, self._begun_s)
        if status is not None and status.stage is Stage.FLYING:
            self._may_have_flown.add(name)
        if name not in self._results:
            result = child.result() or self._lost(name, child, status, silent_s)
            if result is not None:
                if name in self._were_near | self._garbled and result.exit_code != 0:
                    code = worst_code((result.exit_code, SafetyAbort.exit_code))
                    result = replace(result, exit_code=code)
                self._results[name] = _explained(result, self.reasons.get(name))
        return VehicleView(
            name=name, status=status, silent_s=silent_s, result=self._results.get(name)
        )

    def _lost(
        self, name: str, child: Child, status: Status | None, silent_s: float
    ) -> Result | None:
        """Return a result for a process that has ended without sending one, or that hangs and is
        therefore killed."""
        problem = child.end_of_process()
        loop_age_s = 0.0 if status is None or status.loop_age_s is None else status.loop_age_s
        if problem is None and silent_s > (START_HUNG_S if status is None else HUNG_S):
            problem = f"its process has not answered for {silent_s:.0f} s and was killed"
        elif problem is None and loop_age_s > LOOP_HUNG_S:
            problem = (
                f"its flight loop has not responded for {loop_age_s:.0f} s, so its process was "
                "killed"
            )
        if problem is None:
            return None
        child.kill()
        if name not in self._may_have_flown:
            return Result(
                exit_code=PerchError.exit_code, outcome=VehicleOutcome.FAILED, reason=problem
            )
        return Result(
            exit_code=SafetyAbort.exit_code,
            outcome=VehicleOutcome.FAILED,
            reason=f"{problem}: {LOOK_FIRST}",
            has_flown=True,
            log=None if status is None else status.log,
        )

    def _send(self, name: str, order: Order, now_s: float) -> None:
        due = now_s - self._sent_s.get(name, float("-inf")) >= BEAT_S - ROUND_S / 2
        if name not in self._results and (due or order != self._sent.get(name)):
            self._sent[name], self._sent_s[name] = order, now_s
            if order.may_take_off:  # the process may have been lost before it reported the take-off
                self._may_have_flown.add(name)
            self._children[name].send(replace(order, sent_s=now_s))


def _explained(result: Result, why: str | None) -> Result:
    """Return the result, with the reason `why`, for a vehicle that the parent has landed or has not
    permitted to fly."""
    if why is None or result.exit_code == 0:
        return result
    return replace(result, reason=f"{why}: {result.reason}")
