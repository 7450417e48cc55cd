"""Receive the operator's commands in a vehicle's own process, and land if the parent is gone.

The flight loop and the link's watchdog both read the current command many times a second. Neither
the loop nor the watchdog waits for the parent: a separate thread receives the orders, and if the
parent is dead or silent, the command is to land. A vehicle therefore also lands if its loop hangs
and the parent is gone.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from perchctl.fleet.messages import Order
from perchctl.flight import OperatorSwitch
from perchctl.mission import OperatorRequest

PARENT_SILENCE_S = 1.0
"""Time without a message after which the parent counts as hanging and the vehicle lands, s. Longer:
the vehicle flies for longer while nobody can stop it. Shorter: a busy computer ends flights."""
LONGEST_WATCH_STEP_S = 0.25
"""Largest time by which one reading of the command may increase the parent's silence, s. After a
suspension, this process has not yet read the messages that are waiting for it. Longer: this process
mistakes its own pause for the parent's silence. Shorter: on a busy computer, a parent's silence is
noticed late."""

PERMISSION_FRESH_S = 0.5
"""Age up to which a permission to climb counts, s; it is repeated every `BEAT_S`. Longer: a climb
may begin although a neighbour has come near in the meantime. Shorter: a busy computer delays
climbs."""


@dataclass
class ParentSwitch(OperatorSwitch):
    """An `OperatorSwitch` that is operated by the parent's orders.

    `take` and `lose_parent` are called by the thread that receives the orders. `read` measures the
    parent's silence on `clock`, starting with its first call.
    """

    may_take_off: bool = False
    lost: str | None = None
    """Why the vehicle is landing without an order from the parent; None if it is not."""
    _newest: Order = field(default_factory=Order)
    _heard: bool = False
    _silent_s: float = 0.0
    _read_s: float | None = None
    _counting: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def take(self, order: Order) -> None:
        """Process an order. The command in an order cannot revoke an earlier one. If orders arrive
        again from a parent that was considered lost, they can still cut the motors, but cannot give
        permission."""
        self._heard = True
        self._newest = order
        if order.word is not OperatorRequest.NONE:
            self.land()
        if order.word is OperatorRequest.CUT_MOTORS:
            self.cut()
        # Set after the command, so that no reader sees the permission without the command.
        permitted = order.may_take_off and order.word is OperatorRequest.NONE
        self.may_take_off = permitted and self.lost is None

    def climb_withheld(self) -> str | None:
        """Return why the climb to the target must not begin; None if there is a fresh
        permission."""
        order = self._newest
        if self.lost is not None:
            return self.lost
        if not 0.0 <= self.clock() - order.sent_s <= PERMISSION_FRESH_S:
            return "the newest order from the parent process is too old"
        return None if order.may_climb else order.why_not_climb or "the fleet is not flying"

    def lose_parent(self, why: str = "the parent process is gone") -> None:
        """Land, or never take off, because nobody can stop this vehicle any more."""
        self.lost = self.lost or why
        self.may_take_off = False
        self.land()

    def read(self) -> OperatorRequest:
        with self._counting:
            now_s, before_s = self.clock(), self._read_s
            if self._heard or before_s is None:
                self._heard, self._silent_s = False, 0.0
            else:
                self._silent_s += min(now_s - before_s, LONGEST_WATCH_STEP_S)
            self._read_s = now_s
            is_silent = self._silent_s > PARENT_SILENCE_S
        if is_silent:
            self.lose_parent(f"the parent process has been silent for {PARENT_SILENCE_S:g} s")
        return super().read()
