"""The operator's commands: Ctrl-C, and the live page's STOP button."""

from __future__ import annotations

from dataclasses import dataclass
from types import FrameType

from perchctl.errors import Interrupted
from perchctl.mission.state import Operator


@dataclass
class OperatorSwitch:
    """Ctrl-C as the planner understands it: once lands, twice stops.

    `press` is a signal handler. `land` is for the live page's STOP button: it lands
    as one Ctrl-C does, however often it is pressed, and never adds up to a stop of the motors.

    Until the flight loop listens there is nothing to land, and the first Ctrl-C
    leaves by `Interrupted`.
    """

    listening: bool = False
    presses: int = 0
    landing_requested: bool = False

    def read(self) -> Operator:
        return Operator(min(max(self.presses, int(self.landing_requested)), 2))

    def land(self) -> None:
        self.landing_requested = True

    def press(self, _signal: int = 0, _frame: FrameType | None = None) -> None:
        if not self.listening:
            raise Interrupted("Ctrl-C before take-off: nothing was started")
        self.presses += 1
