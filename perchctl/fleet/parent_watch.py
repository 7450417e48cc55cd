"""The operator's word in a vehicle's own process, and what it does without a parent.

The flight loop and the link's watchdog both read the word many times a second. Neither waits for
the parent: a thread of its own takes the orders in, and a parent that is dead or silent is a word
to land. So a vehicle lands too if its loop hangs, and the parent is gone.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from perchctl.fleet.messages import Order
from perchctl.flight import OperatorSwitch
from perchctl.mission import OperatorRequest

PARENT_SILENCE_S = 1.0
"""Without a message for so long, the parent hangs and the vehicle lands. Longer, and nobody can
stop it for longer; shorter, and a busy computer ends flights."""
LONGEST_WATCH_STEP_S = 0.25
"""What one reading of the word may add to the parent's silence. A process that was itself suspended
finds messages waiting once it runs again, but has not taken them in yet. Longer, and its own pause
passes for the parent's; shorter, and a parent's silence is noticed late on a busy computer."""


@dataclass
class ParentSwitch(OperatorSwitch):
    """An `OperatorSwitch` that is operated by the parent's orders.

    `take` and `lose_parent` are called by the thread that reads the orders. Silence is counted from
    the first reading on, by `read`, on `clock`.
    """

    may_take_off: bool = False
    lost: str | None = None
    """Why the vehicle lands without the parent's word, else None."""
    _heard: bool = False
    _silent_s: float = 0.0
    _read_s: float | None = None
    _counting: threading.Lock = field(default_factory=threading.Lock, repr=False)

    def take(self, order: Order) -> None:
        """Take an order in. Its word only adds to what was ordered before; a lost parent that is
        heard again can still cut the motors, but permits nothing."""
        self._heard = True
        if order.word is not OperatorRequest.NONE:
            self.land()
        if order.word is OperatorRequest.STOP:
            self.cut()
        # After the word: permission must not be read before it.
        permitted = order.may_take_off and order.word is OperatorRequest.NONE
        self.may_take_off = permitted and self.lost is None

    def lose_parent(self, why: str = "the parent process is gone") -> None:
        """Land, and never take off: nobody can stop this vehicle any more."""
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
