"""Hover thrust: what the motors give, 0..65535, when the vehicle neither rises nor sinks.

It is the reference of each proof of contact, and of a descent by thrust. There are four estimators,
each for what it is good at:

- `ImuMotion.hover_thrust`: thrust divided by the specific force, at any time in flight. Fast, and
  wrong by the accelerometer's scale, and while something carries the vehicle.
- `quiet_mean`: slow mean of the thrust in quiet flight. Precise, and only in the open.
- `at_loss`: the best guess at the moment from which on nothing else is learned.
- `in_descent`: follows a descent by thrust within a share of its first value, since a sagging
  battery and the wind change it by a few percent.
"""

from __future__ import annotations

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.contact import LEAST_POSITION_THRUST

HOVER_WITHIN = 0.2
"""Share by which quiet thrust may differ from the mean; if it does by more, the ceiling or a hand
holds the vehicle."""
QUIET_MEMORY_S = 1.5
"""Time in which the mean follows quiet thrust. Larger: a sagging battery is followed late."""
DESCENT_MEMORY_S = 0.3
"""Time in which a descent's hover thrust follows what is felt. Larger: it sinks too fast for longer
in a wind. Smaller: vibration changes the thrust."""
DESCENT_WITHIN = 0.12
"""Share of its first value by which a descent may correct a learned hover thrust. Larger: what
touches something learns it. Smaller: a weak battery sinks too fast."""
UNLEARNED_WITHIN = 0.35
"""The same of one that was never learned."""
LATEST_S = 1.0
"""Older telemetry shows nothing of the present thrust."""
LEAST_FELT_G = 0.7
"""Thrust divided by the specific force is hover thrust while the force is between this and
`MOST_FELT_G`. Smaller: a blow or a fall teaches it."""
MOST_FELT_G = 1.3
LEAST_PROPORTIONAL_PART = 0.5
"""Share of the first hover thrust below which thrust is not proportional to force."""
LEAST_DIVISOR_G = 0.75
"""Bounds of the specific force that a single sample's thrust is divided by."""
MOST_DIVISOR_G = 1.5


def quiet_mean(b: Belief) -> float:
    """The mean with one more tick of quiet flight; the thrust felt so far if it is the first."""
    thrust, old = b.telemetry.thrust, b.hover_thrust
    if old == 0.0:
        return b.imu.hover_thrust or thrust
    if abs(thrust / old - 1.0) > HOVER_WITHIN:
        return old  # held by the ceiling, or by a hand
    part = min(1.0, (b.obs.t_s - b.t_s) / QUIET_MEMORY_S)
    return old + part * (thrust - old)


def at_loss(b: Belief) -> float:
    """Hover thrust as learned, else as felt in flight, else by this one sample."""
    tel = b.telemetry
    divisor_g = min(MOST_DIVISOR_G, max(LEAST_DIVISOR_G, tel.acc_z_g))
    measured = max(LEAST_POSITION_THRUST, tel.thrust / divisor_g)
    return b.hover_thrust or b.imu.hover_thrust or measured


def in_descent(b: Belief, *, first: float, within: float, felt_floor: bool, dt_s: float) -> float:
    """Hover thrust `dt_s` later in a descent that began with `first`; unchanged where the floor or
    a magnet may carry a part of the weight, or the telemetry shows nothing of it."""
    tel = b.telemetry
    old = b.hover_thrust
    shows = (
        LEAST_FELT_G <= tel.acc_z_g <= MOST_FELT_G and tel.thrust >= LEAST_PROPORTIONAL_PART * first
    )
    if b.attitude_age_s > LATEST_S or not shows:
        return old
    if b.is_in_magnet_reach or felt_floor:
        return old
    felt = tel.thrust / tel.acc_z_g
    memory_s = DESCENT_MEMORY_S if within == DESCENT_WITHIN else 0.5 * DESCENT_MEMORY_S
    hover = old + (felt - old) * min(1.0, dt_s / memory_s)
    return min((1.0 + within) * first, max((1.0 - within) * first, hover))
