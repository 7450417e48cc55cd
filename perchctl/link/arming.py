"""Disarm the vehicle at the end of a session. Every kind of link uses this module.

A vehicle that does not arm itself spins its propellers while it is armed, even on the ground.
`perchctl.flight` arms such a vehicle once everything else is ready. No matter how a session ends on
the ground, the link disarms the vehicle as it closes.
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
"""Time for which the disarm command is repeated, s. Larger: the session ends later if the radio is
dead. Smaller: a short radio dropout may leave the vehicle armed."""
DISARM_PERIOD_S = 0.1
"""Time between two disarm commands, s."""
ANSWERED_S = 0.1
"""Time after the disarm command until telemetry shows its effect, s. The supervisor reacts within
40 ms."""


def disarm(
    newest: Callable[[], Telemetry | None],
    send: Callable[[Arm], object],
    clock: Callable[[], float],
    wait: Callable[[float], object],
    *,
    was_ordered: bool,
) -> bool:
    """Repeat the disarm command to a vehicle on the ground until its telemetry confirms it, for at
    most `DISARM_S`.

    Nothing is sent to a vehicle that arms itself or, unless `was_ordered`, to one that is not
    armed. The command is sent only while fresh telemetry shows that the vehicle is not flying,
    because it would cut the motors in the air. The flying bit stays set for 2 s after the motors
    stop. Returns False if the vehicle may still be armed.

    Args:
        newest: function that returns the newest telemetry, or None if there is none.
        send: function that queues a command for the vehicle, after those that are already waiting.
        clock, wait: functions that return the current time, s, and wait for a number of seconds.
        was_ordered: True if this session has sent `Arm(True)`, which may take effect at any time.
            Only a sample newer than the disarm command then confirms that the vehicle is disarmed.
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
        f"{vehicle} may still be armed: keep away until its propellers have stopped",
        Note,
        stacklevel=3,
    )
