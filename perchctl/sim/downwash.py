"""The downwash of a hovering vehicle on another vehicle below it.

A hovering quadrotor's four wakes merge into one round turbulent jet (Bauersfeld, Muller, Ziegler,
Coletti and Scaramuzza, "Robotics meets fluid dynamics: a characterization of the induced airflow
below a quadrotor as a turbulent jet", 2024). At a distance s below the rotors and r from their
axis:

    U = sqrt(T / (8 rho pi R^2))                   induced speed of four rotors of thrust T
    d = s / l + 5.82                               distance from the jet's virtual origin
    u = U 10.11 / d / (1 + 0.414 (r / h)^2)^2      its speed, straight down
    h = 0.0767 l d                                 its half-width

If this jet acts as a wind through perchctl's drag model, its force matches the recordings of
Neural-Swarm2 next to the axis, but is too small exactly below a vehicle (Shi, Hoenig, Shi, Yue and
Chung, 2021). Therefore the wind on the axis is the jet's speed times `AXIS_FACTOR`, and the factor
falls to 1 within the width of a vehicle.

Three effects are not modelled: the flow after the jet has met the floor, the air between two
vehicles close to the same ceiling, and jets that tilt with their vehicle.
"""

from __future__ import annotations

import math

AIR_DENSITY_KGPM3 = 1.2
"""Density of air in a room at 20 degC. With this density, the source's vehicle of 42 g has U = 5.06
m/s."""
ROTOR_RADIUS_M = 0.0231
"""Radius of a Crazyflie 2.1's propeller."""
MOTOR_DISTANCE_M = 0.092
"""Distance between the axes of opposite motors, called l in the source."""
ORIGIN = 5.82
"""Height of the jet's virtual origin above the rotors, in units of l."""
DECAY = 10.11
"""Decay of the speed on the axis with distance. Larger: the jet is longer."""
WIDTH = 0.0767
"""Growth of the half-width with distance. Larger: the jet is wider."""
SHAPE = 0.414
"""Shape factor that makes the speed fall to half at the half-width."""
JET_BEGINS_M = 0.25
"""Distance below the rotors at which the measurements of the jet begin, m. Closer to the rotors,
the speed at this distance is used. Smaller: the speeds are higher than any that were measured."""
AXIS_FACTOR = 1.5
"""Factor by which the jet's speed on its axis is multiplied to give the wind that acts on a drag of
0.009 N/(m/s). A vehicle of 42 g then pushes with 6.3 g at 0.5 m, where the recorded vehicles of 34
g feel 5.9 g. Larger: the push exactly below the vehicle is stronger."""
FACTOR_RADIUS_M = 0.05
"""Distance from the axis over which the factor falls to 1, m: half a vehicle. Larger: the push next
to the axis is stronger, although the recordings need no factor at 0.1 m."""
LEAST_MPS = 0.01
"""Speed below which a jet is ignored, m/s, so that vehicles far apart fly exactly as if alone. The
jet has this speed 2 m below its source and 1 m from its axis. Larger: the drag force at this speed
is missing."""


def jet_mps(thrust_n: float, below_m: float, aside_m: float) -> float:
    """Return the downward speed of the air, `below_m` below a vehicle and `aside_m` from its axis;
    `thrust_n` is the total thrust of its rotors. The speed is 0 outside the jet or above the
    vehicle. SI units."""
    if below_m <= 0.0 or thrust_n <= 0.0:
        return 0.0
    rotors_m2 = 8.0 * AIR_DENSITY_KGPM3 * math.pi * ROTOR_RADIUS_M**2
    distance = max(below_m, JET_BEGINS_M) / MOTOR_DISTANCE_M + ORIGIN
    half_width_m = WIDTH * MOTOR_DISTANCE_M * distance
    profile = (1.0 + SHAPE * (aside_m / half_width_m) ** 2) ** -2
    return math.sqrt(thrust_n / rotors_m2) * DECAY / distance * profile


def downwash_mps(thrust_n: float, below_m: float, aside_m: float) -> float:
    """Return the downward wind that acts on a vehicle in this jet; exactly 0 below `LEAST_MPS`."""
    speed_mps = jet_mps(thrust_n, below_m, aside_m)
    if speed_mps < LEAST_MPS:
        return 0.0
    near = math.exp(-((aside_m / FACTOR_RADIUS_M) ** 2))
    return speed_mps * (1.0 + (AXIS_FACTOR - 1.0) * near)
