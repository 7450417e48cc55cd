"""Measurements for the hover-thrust filter (`perchctl.mission.belief.thrust`).

Hover thrust is the reference for every proof of contact and for a descent by thrust. In quiet
flight the filter measures the thrust itself (`learn_in_quiet_flight`); in a descent by thrust it
measures thrust divided by specific force (`learn_in_descent`). Before either has happened,
`best_estimate` falls back on the accelerometer, with a larger standard deviation. The estimate is
wrong while something carries part of the weight unnoticed, and after a long descent by the scale
error of the accelerometer.
"""

from __future__ import annotations

import math

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.thrust import FELT_SIGMA, LEAST_POSITION_THRUST, HoverThrust
from perchctl.values import replace

DESCENT_DRIFT = 0.067
"""Random walk of the hover thrust in a descent by thrust, as a share per square root of a second.
Larger: vibration changes the thrust. Smaller: in wind the vehicle sinks too fast for longer."""
UNSURE_SIGMA = 0.12
"""Standard deviation, as a share, of an estimate by the accelerometer alone when the vehicle may
have been carried. Larger: a descent may correct it further. Smaller: a wrong one persists."""
DESCENT_SIGMA = 0.04
"""Smallest standard deviation, as a share, at the start of a descent. Larger: contact with an
obstacle teaches a wrong value. Smaller: with a weak battery the vehicle sinks too fast."""
MOST_SIGMAS = 3.0
"""Largest correction in a descent, in standard deviations at its start. Larger and smaller: as for
`DESCENT_SIGMA`."""
QUIET_WITHIN = 0.2
"""Largest share by which quiet thrust may differ from the estimate; beyond it, the ceiling or a
hand holds the vehicle. Larger: a held vehicle teaches a wrong value. Smaller: a real change is
rejected."""
ROTOR_LAG_S = 0.06
"""Time constant with which the rotors follow an order (docs/firmware.md, real flights 50 to 80 ms).
Larger or smaller: a step of the thrust teaches a wrong hover thrust."""
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


def best_estimate(b: Belief) -> HoverThrust:
    """Return the estimate; without one, the mean by the accelerometer; without that, the value of
    the newest sample."""
    if b.hover.thrust > 0.0:
        return b.hover
    tel = b.telemetry
    divisor_g = min(MOST_DIVISOR_G, max(LEAST_DIVISOR_G, tel.acc_z_g))
    sample = max(LEAST_POSITION_THRUST, tel.thrust / divisor_g)
    return HoverThrust(b.imu.hover_thrust or sample, UNSURE_SIGMA)


def lagged_thrust(b: Belief, dt_s: float) -> float:
    """The thrust, 0..65535, that the rotors give `dt_s` after the sample before: a first-order lag
    behind what is read."""
    before, read = b.lagged_thrust, b.telemetry.thrust
    if before is None:
        return read
    return before + (1.0 - math.exp(-dt_s / ROTOR_LAG_S)) * (read - before)


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
    tel, old = b.telemetry, best_estimate(b)
    thrust = tel.thrust if b.lagged_thrust is None else b.lagged_thrust
    first, sigma = old.first or (old.thrust, max(DESCENT_SIGMA, old.sigma))
    old = replace(old, first=(first, sigma))
    shows = LEAST_FELT_G <= tel.acc_z_g <= MOST_FELT_G and thrust >= LEAST_PROPORTIONAL_PART * first
    felt_floor = b.sent.floor_felt_s is not None
    if b.attitude_age_s > LATEST_S or not shows or b.is_in_magnet_reach or felt_floor:
        return old
    new = old.after(dt_s, DESCENT_DRIFT).with_measured(thrust / tel.acc_z_g, dt_s)
    most = MOST_SIGMAS * sigma
    return replace(new, thrust=min((1.0 + most) * first, max((1.0 - most) * first, new.thrust)))
