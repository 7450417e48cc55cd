"""What a vehicle may be doing, by its newest telemetry. What is old is unknown, and what is
unknown counts as flying: `close` leaves the link by it, a rescue and the watchdog land by it.
"""

from __future__ import annotations

import math

from perchctl.vehicle import FLYING, HL_ACTIVE, LOCKED, Telemetry

FRESH_S = 0.3
"""What is older says nothing of the motors."""


def is_known(newest: Telemetry | None, now_s: float) -> bool:
    return newest is not None and now_s - newest.t_s <= FRESH_S


def knows_its_position(newest: Telemetry | None, now_s: float) -> bool:
    """Whether its place and speed are known too: they come by a packet of their own."""
    if newest is None or now_s - newest.t_s + newest.behind_s > FRESH_S:
        return False
    return all(math.isfinite(v) for v in (*newest.position_m, *newest.velocity_mps))


def may_fly(newest: Telemetry | None, now_s: float) -> bool:
    """Whether a zero setpoint could drop it, or lock it: the flying bit outlives the motors
    by 2 s (docs/firmware.md, "When setpoints stop")."""
    return newest is None or not is_known(newest, now_s) or newest.has(FLYING)


def motors_may_run(newest: Telemetry | None, now_s: float) -> bool:
    """In the air, or about to be. The flying bit alone does not count: a vehicle that hangs
    with its motors off shall not start them again."""
    if newest is None or not is_known(newest, now_s):
        return True
    return newest.has(HL_ACTIVE) or (newest.has(FLYING) and newest.thrust >= 1)


def is_cut(newest: Telemetry | None, now_s: float) -> bool:
    """Whether an emergency stop has come to be: locked, with its motors off."""
    if newest is None or not is_known(newest, now_s):
        return False
    return newest.has(LOCKED) and newest.thrust < 1
