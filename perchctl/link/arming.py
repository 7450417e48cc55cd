"""Disarming at the end of a session, for each kind of link.

A vehicle that does not arm itself turns its propellers for as long as it is armed, on the ground,
too. `perchctl.flight` arms it once everything else is ready; whatever ends the session on the
ground, the link disarms it as it closes.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

from perchctl.errors import Note
from perchctl.vehicle import (
    ARMED,
    AUTO_ARM,
    FLYING,
    Arm,
    Telemetry,
    is_fresh,
)

DISARM_S = 2.0
"""The order is repeated for so long. A longer time delays the end of a session without a radio, a
shorter one gives up on a radio that is silent for a moment."""
DISARM_PERIOD_S = 0.1
ANSWERED_S = 0.1
"""A sample that is so much younger than the order shows its effect: the supervisor has 40 ms."""


def disarm(
    newest: Callable[[], Telemetry | None],
    send: Callable[[Arm], object],
    clock: Callable[[], float],
    wait: Callable[[float], object],
    *,
    was_ordered: bool,
) -> bool:
    """Disarm a vehicle on the ground until its telemetry says so; bounded by `DISARM_S`.

    Nothing is sent to a vehicle that arms itself, or that nobody has armed. The order is sent only
    while fresh telemetry says that the vehicle does not fly: in the air it would cut the motors,
    and the flying bit outlives them by 2 s. Returns False if the vehicle may still be armed.

    Args:
        newest: the newest telemetry, None if there was none.
        send: hands an order to the vehicle, behind those before it.
        clock, wait: the present time, s, and how to let seconds pass.
        was_ordered: this session has sent `Arm(True)`, which may take effect any moment: then only
            a sample from after the order to disarm is believed.
    """
    end_s, ordered_s = clock() + DISARM_S, None
    while True:
        sample, now_s = newest(), clock()
        if sample is None or sample.has_bit(AUTO_ARM):
            return True
        if not sample.has_bit(ARMED) and not was_ordered:
            return True
        answered = ordered_s is not None and sample.t_s >= ordered_s + ANSWERED_S
        if answered and not sample.has_bit(ARMED):
            return True
        if now_s >= end_s:
            return False
        if is_fresh(sample, now_s) and not sample.has_bit(FLYING):
            send(Arm(False))
            ordered_s = now_s if ordered_s is None else ordered_s
        wait(DISARM_PERIOD_S)


def warn_of_armed(vehicle: str) -> None:
    """Tell people that the vehicle may still be armed."""
    warnings.warn(
        f"{vehicle} may still be armed: keep away until its propellers stand still",
        Note,
        stacklevel=3,
    )
