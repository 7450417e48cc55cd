"""What teaches the hover thrust, the reference of each proof of contact and of a descent by thrust.

Its filter (`perchctl.mission.belief.thrust`) measures the thrust in quiet flight
(`learn_in_quiet_flight`), and in a descent by thrust the thrust for each g that the accelerometer
reads (`learn_in_descent`). Where neither was ever measured, `known` gives what has been felt in
flight, with the spread that this has. It is wrong while something carries a part of the weight
unnoticed, and by the accelerometer's scale after a long descent.
"""

from __future__ import annotations

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.thrust import FELT_SIGMA, LEAST_POSITION_THRUST, HoverThrust
from perchctl.values import replace

DESCENT_DRIFT = 0.067
"""The same in a descent by thrust, where wind and battery change it. Larger: vibration changes the
thrust. Smaller: it sinks too fast for longer in a wind."""
UNSURE_SIGMA = 0.12
"""Spread of what was felt where it is not known whether the vehicle flew then, or was carried."""
DESCENT_SIGMA = 0.04
"""Spread that a descent begins with, at least. Larger: what touches something learns it. Smaller: a
weak battery sinks too fast."""
MOST_SIGMAS = 3.0
"""So many of these a descent may correct it by."""
QUIET_WITHIN = 0.2
"""Share by which quiet thrust may differ; if it does by more, the ceiling or a hand holds the
vehicle."""
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


def known(b: Belief) -> HoverThrust:
    """The estimate; where there is none, what was felt in flight, else what one sample shows."""
    if b.hover.thrust > 0.0:
        return b.hover
    tel = b.telemetry
    divisor_g = min(MOST_DIVISOR_G, max(LEAST_DIVISOR_G, tel.acc_z_g))
    sample = max(LEAST_POSITION_THRUST, tel.thrust / divisor_g)
    return HoverThrust(b.imu.hover_thrust or sample, UNSURE_SIGMA)


def learn_in_quiet_flight(b: Belief, dt_s: float) -> HoverThrust:
    """The estimate after a tick in which the thrust is hover thrust; `dt_s` since the sample
    before, 0 if this one is not new."""
    thrust, old = b.telemetry.thrust, b.hover
    if old.thrust == 0.0:
        return HoverThrust(b.imu.hover_thrust or thrust, FELT_SIGMA)
    if abs(thrust / old.thrust - 1.0) > QUIET_WITHIN:
        return old  # held by the ceiling, or by a hand
    return old.with_measured(thrust, dt_s)


def learn_in_descent(b: Belief, dt_s: float) -> HoverThrust:
    """The estimate after a tick of a descent by thrust, `dt_s` as in `learn_in_quiet_flight`;
    unchanged where the floor or a magnet may carry a part of the weight, or the telemetry shows
    nothing of it."""
    tel, old = b.telemetry, known(b)
    first, sigma = old.first or (old.thrust, max(DESCENT_SIGMA, old.sigma))
    old = replace(old, first=(first, sigma))
    shows = (
        LEAST_FELT_G <= tel.acc_z_g <= MOST_FELT_G and tel.thrust >= LEAST_PROPORTIONAL_PART * first
    )
    felt_floor = b.sent.floor_felt_s is not None
    if b.attitude_age_s > LATEST_S or not shows or b.is_in_magnet_reach or felt_floor:
        return old
    new = old.after(dt_s, DESCENT_DRIFT).with_measured(tel.thrust / tel.acc_z_g, dt_s)
    most = MOST_SIGMAS * sigma
    return replace(new, thrust=min((1.0 + most) * first, max((1.0 - most) * first, new.thrust)))
