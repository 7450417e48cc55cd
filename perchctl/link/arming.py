"""Disarm the vehicle at the end of a session, for every kind of link.

A vehicle that does not arm itself spins its propellers while it is armed, even on the ground.
`perchctl.flight` arms it once everything else is ready. Whatever ends the session on the ground,
the link disarms the vehicle as it closes.
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
"""Time for which the order is repeated, s. Larger: without a radio, the end of a session is
delayed. Smaller: a radio that is silent for a moment is given up."""
DISARM_PERIOD_S = 0.1
"""Time between two orders to disarm, s."""
ANSWERED_S = 0.1
"""Time after the order from which a sample shows its effect, s: the supervisor reacts within 40
ms."""


def disarm(
    newest: Callable[[], Telemetry | None],
    send: Callable[[Arm], object],
    clock: Callable[[], float],
    wait: Callable[[float], object],
    *,
    was_ordered: bool,
) -> bool:
    """Disarm a vehicle on the ground until its telemetry confirms it; bounded by `DISARM_S`.

    Nothing is sent to a vehicle that arms itself, or that nobody has armed. The order is sent only
    while fresh telemetry says that the vehicle does not fly: in the air, it would cut the motors.
    The flying bit stays set for 2 s after they stop. Returns False if the vehicle may still be
    armed.

    Args:
        newest: function that returns the newest telemetry, None without any.
        send: function that sends an order to the vehicle, after the orders before it.
        clock, wait: functions that return the present time, s, and wait for some seconds.
        was_ordered: this session has sent `Arm(True)`, which may take effect at any time; then only
            a sample from after the order to disarm counts.
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
    """Warn that the vehicle may still be armed."""
    warnings.warn(
        f"{vehicle} may still be armed: keep away until its propellers stand still",
        Note,
        stacklevel=3,
    )
