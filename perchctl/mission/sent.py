"""A command that went to the vehicle in the loop's place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from perchctl.vehicle import Command

SentBy = Literal["watchdog", "rescue", "reconnect", "farewell"]


@dataclass(frozen=True)
class SentCommand:
    """One that no turn of the loop decided. Handed to the link at `t_s`, on the loop's clock: as
    of any packet, whether it arrives is not known.

    Attributes:
        by: ``watchdog`` while the loop is silent, and the operator's stop; ``rescue`` after an
            error; ``reconnect``, an order once more over a link that was lost; ``farewell``, the
            zero setpoint with which the link is closed.
    """

    t_s: float
    by: SentBy
    command: Command
