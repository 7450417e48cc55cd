"""Land whatever still flies: the last resort of every error path."""

from __future__ import annotations

from collections.abc import Callable

from perchctl.flight.clock import Clock
from perchctl.flight.history import is_finite
from perchctl.link.evidence import is_known, motors_may_run
from perchctl.link.protocol import Link, ToldSent, tell_nobody
from perchctl.mission.landing import (
    LEAST_ORDERS,
    MAX_ORDERS,
    PEEL_BELOW_M,
    PEEL_BLIND_S,
    PEELED_M,
    REPEAT_ORDER_S,
    own_landing,
)
from perchctl.mission.sent import Sent
from perchctl.mission.state import Operator
from perchctl.profile import LandingConfig
from perchctl.vehicle import HL_ACTIVE, Command, EmergencyStop, PositionSetpoint, Telemetry

LOOK_S = 0.5
"""For so long a vehicle must be seen with its motors off before a rescue leaves it."""
PERIOD_S = 0.1


def rescue(
    link: Link,
    clock: Clock,
    landing: LandingConfig,
    operator: Callable[[], Operator],
    known: Telemetry | None,
    ground_z_m: float = 0.0,
    flown_s: float = 0.0,
    held_m: float | None = None,
    blind_s: float = 0.0,
    told: ToldSent = tell_nobody,
) -> bool:
    """Order a landing and wait for it, bounded; whether the motors were seen off at the end.
    The landing needs no further packet once it is under way.

    `known` is the newest telemetry the loop has taken in, `ground_z_m` the height of the
    ground in the estimate, `flown_s` for how long it has flown, `blind_s` for how long without the
    positions from outside that it needs. What the ceiling held at
    `held_m` is first peeled off: its own landing would run by the clock, and end up there. On
    the ground it is looked at again for `LOOK_S`: a take-off just begun does not show at once.
    `told` is given what was sent.
    """

    def send(command: Command) -> None:
        link.send(command)
        told(Sent(clock.now(), "rescue", command))

    newest = known
    start_s = off_since_s = clock.now()
    ordered_s, orders = -REPEAT_ORDER_S, 0
    while clock.now() < start_s + landing.timeout_s:
        now_s = clock.now()
        if operator() is Operator.STOP:
            send(EmergencyStop())  # the link's guard repeats it
            return False
        samples = link.telemetry()
        newest = next((s for s in reversed(samples) if is_finite(s)), newest)
        if motors_may_run(newest, now_s):
            off_since_s = now_s
            if orders == 0 and now_s < start_s + PEEL_BLIND_S:
                peel = _peel(newest, now_s, held_m)
                if peel is not None:
                    send(peel)
                    clock.wait_until(now_s + PERIOD_S)
                    continue
            under_way = newest is not None and is_known(newest, now_s) and newest.has(HL_ACTIVE)
            seen = under_way and orders >= LEAST_ORDERS
            due = orders == 0 or (not seen and now_s - ordered_s > REPEAT_ORDER_S)
            if due and orders < MAX_ORDERS:
                gone_s = blind_s + now_s - start_s if blind_s > 0.0 else 0.0
                send(own_landing(landing, ground_z_m, flown_s, newest, gone_s))
                ordered_s, orders = now_s, orders + 1
        elif now_s - off_since_s >= LOOK_S:
            return True
        clock.wait_until(now_s + PERIOD_S)
    return False


def _peel(newest: Telemetry | None, now_s: float, held_m: float | None) -> PositionSetpoint | None:
    """Below where it was held, until it is seen there."""
    if newest is None or held_m is None:
        return None
    x, y, z = newest.position_m
    if is_known(newest, now_s) and z < held_m - PEELED_M:
        return None
    return PositionSetpoint(x, y, held_m - PEEL_BELOW_M, newest.yaw_rad)
