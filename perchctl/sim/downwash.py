"""The air that one hovering vehicle blows onto another below it.

A hovering quadrotor's four wakes merge into one round turbulent jet (Bauersfeld, Muller, Ziegler,
Coletti and Scaramuzza, "Robotics meets fluid dynamics: a characterization of the induced airflow
below a quadrotor as a turbulent jet", 2024). With s below the rotors and r aside of their axis:

    U = sqrt(T / (8 rho pi R^2))                   induced speed of four rotors of thrust T
    d = s / l + 5.82                               distance from the jet's virtual origin
    u = U 10.11 / d / (1 + 0.414 (r / h)^2)^2      its speed, straight down
    h = 0.0767 l d                                 its half-width

As a wind on perchctl's drag this pushes less than Neural-Swarm2's recordings show exactly below a
vehicle, and as much as they show at its side (Shi, Hoenig, Shi, Yue and Chung, 2021). Hence on the
axis the wind is `AXIS_FACTOR` of the jet, and the factor vanishes within the width of a vehicle.

Not modelled: what the jet does once it meets the floor, the air between two vehicles close under
one ceiling, and jets that lean with their vehicle.
"""

from __future__ import annotations

import math

AIR_DENSITY_KGPM3 = 1.2
"""Of a room at 20 degC; with it the source's 42 g give U = 5.06 m/s."""
ROTOR_RADIUS_M = 0.0231
"""Crazyflie 2.1's propeller."""
MOTOR_DISTANCE_M = 0.092
"""Between the axes of opposite motors, the source's length l."""
ORIGIN = 5.82
"""Of the virtual origin above the rotors, in l."""
DECAY = 10.11
"""Of the speed on the axis with the distance. Larger: a longer jet."""
WIDTH = 0.0767
"""Half-width for each distance. Larger: a wider jet."""
SHAPE = 0.414
"""With it the speed falls to half at the half-width."""
JET_BEGINS_M = 0.25
"""The jet is measured from here on; nearer, the speed of here counts. Smaller: faster air than
anyone measured."""
AXIS_FACTOR = 1.5
"""Of the jet on its axis as a wind on a drag of 0.009 N/(m/s): 6.3 g at 0.5 m with 42 g, where the
recordings' vehicles of 34 g feel 5.9 g. Larger: a harder push exactly below."""
FACTOR_RADIUS_M = 0.05
"""Aside, in which the factor falls towards 1: half a vehicle. Larger: a harder push beside the
axis; 0.1 m beside it the recordings need no factor."""
LEAST_MPS = 0.01
"""A slower jet is none, so that vehicles far from each other fly as if alone, to the last bit. The
source's speed 2 m below and 1 m aside. Larger: a push of that size on its drag is missed."""


def jet_mps(thrust_n: float, below_m: float, aside_m: float) -> float:
    """Speed of the air straight down, `below_m` below and `aside_m` aside of a vehicle whose rotors
    give `thrust_n` together; 0 beside or above it. SI units."""
    if below_m <= 0.0 or thrust_n <= 0.0:
        return 0.0
    rotors_m2 = 8.0 * AIR_DENSITY_KGPM3 * math.pi * ROTOR_RADIUS_M**2
    distance = max(below_m, JET_BEGINS_M) / MOTOR_DISTANCE_M + ORIGIN
    half_width_m = WIDTH * MOTOR_DISTANCE_M * distance
    profile = (1.0 + SHAPE * (aside_m / half_width_m) ** 2) ** -2
    return math.sqrt(thrust_n / rotors_m2) * DECAY / distance * profile


def downwash_mps(thrust_n: float, below_m: float, aside_m: float) -> float:
    """The wind straight down that a vehicle in that jet feels; exactly 0 below `LEAST_MPS`."""
    speed_mps = jet_mps(thrust_n, below_m, aside_m)
    if speed_mps < LEAST_MPS:
        return 0.0
    near = math.exp(-((aside_m / FACTOR_RADIUS_M) ** 2))
    return speed_mps * (1.0 + (AXIS_FACTOR - 1.0) * near)
