"""Land whatever still flies: the last resort of every error path."""

from __future__ import annotations

from collections.abc import Callable

from perchctl.flight.clock import Clock
from perchctl.link.protocol import Link
from perchctl.mission.state import Operator
from perchctl.profile import LandingConfig
from perchctl.vehicle import FLYING, HL_ACTIVE, EmergencyStop, Land, Telemetry

LOOK_S = 0.5
"""For so long a vehicle must be seen with its motors off before a rescue leaves it."""
REPEAT_S = 1.0
PERIOD_S = 0.1


def rescue(
    link: Link,
    clock: Clock,
    landing: LandingConfig,
    operator: Callable[[], Operator],
    known: Telemetry | None,
) -> None:
    """Order a landing and wait for it, bounded. The landing needs no further packet once
    it is under way.

    `known` is the newest telemetry the loop has taken in. On the ground it is looked at
    again for `LOOK_S`: a take-off just ordered does not show at once.
    """
    newest = known
    start_s = clock.now()
    ordered_s: float | None = None
    while clock.now() < start_s + landing.timeout_s:
        if operator() is Operator.STOP:
            link.send(EmergencyStop())
            return
        samples = link.telemetry()
        newest = samples[-1] if samples else newest
        flies = newest is not None and _motors_run(newest)
        if flies and newest is not None and _shall_order(newest, ordered_s, clock.now()):
            duration_s = max(1.0, newest.position_m[2] / landing.speed_mps)
            link.send(Land(-landing.undershoot_m, duration_s))
            ordered_s = clock.now()
        if not flies and clock.now() >= start_s + LOOK_S:
            return
        clock.wait_until(clock.now() + PERIOD_S)


def _motors_run(telemetry: Telemetry) -> bool:
    """In the air, or about to be. The flying bit alone outlives the motors by 2 s, and a
    vehicle that hangs with its motors off shall not start them again."""
    return telemetry.has(HL_ACTIVE) or (telemetry.has(FLYING) and telemetry.thrust >= 1)


def _shall_order(telemetry: Telemetry, ordered_s: float | None, now_s: float) -> bool:
    """Once, and again while the order shows no effect."""
    if ordered_s is None:
        return True
    return not telemetry.has(HL_ACTIVE) and now_s - ordered_s > REPEAT_S
