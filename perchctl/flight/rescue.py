"""Land whatever still flies: the last resort of every error path."""

from __future__ import annotations

from collections.abc import Callable

from perchctl.flight.clock import Clock
from perchctl.link.protocol import Link
from perchctl.mission.landing import landing_time_s
from perchctl.mission.state import Operator
from perchctl.profile import LandingConfig
from perchctl.vehicle import FLYING, HL_ACTIVE, EmergencyStop, Land, Telemetry

LOOK_S = 0.5
"""For so long a vehicle must be seen with its motors off before a rescue leaves it."""
FRESH_S = 0.3
"""What is older says nothing of the motors: unknown counts as flying."""
REPEAT_S, MAX_ORDERS = 1.0, 5
PERIOD_S = 0.1


def rescue(
    link: Link,
    clock: Clock,
    landing: LandingConfig,
    operator: Callable[[], Operator],
    known: Telemetry | None,
    ground_z_m: float = 0.0,
) -> None:
    """Order a landing and wait for it, bounded. The landing needs no further packet once
    it is under way.

    `known` is the newest telemetry the loop has taken in, `ground_z_m` the height of the
    ground in the estimate. On the ground it is looked at again for `LOOK_S`: a take-off just
    begun does not show at once.
    """
    newest = known
    start_s = off_since_s = clock.now()
    ordered_s, orders = -REPEAT_S, 0
    while clock.now() < start_s + landing.timeout_s:
        now_s = clock.now()
        if operator() is Operator.STOP:
            link.send(EmergencyStop())
            return
        samples = link.telemetry()
        newest = samples[-1] if samples else newest
        unknown = newest is None or now_s - newest.t_s > FRESH_S
        if unknown or newest is None or _motors_run(newest):
            off_since_s = now_s
            under_way = not unknown and newest is not None and newest.has(HL_ACTIVE)
            due = orders == 0 or (not under_way and now_s - ordered_s > REPEAT_S)
            if due and orders < MAX_ORDERS:
                link.send(landing_order(landing, ground_z_m, newest))
                ordered_s, orders = now_s, orders + 1
        elif now_s - off_since_s >= LOOK_S:
            return
        clock.wait_until(now_s + PERIOD_S)


def landing_order(landing: LandingConfig, ground_z_m: float, newest: Telemetry | None) -> Land:
    """To below the ground, slow enough at touchdown."""
    floor_m = ground_z_m - landing.undershoot_m
    height_m = 1.0 if newest is None else max(0.0, newest.position_m[2] - floor_m)
    return Land(floor_m, landing_time_s(height_m))


def _motors_run(telemetry: Telemetry) -> bool:
    """In the air, or about to be. The flying bit alone outlives the motors by 2 s, and a
    vehicle that hangs with its motors off shall not start them again."""
    return telemetry.has(HL_ACTIVE) or (telemetry.has(FLYING) and telemetry.thrust >= 1)
