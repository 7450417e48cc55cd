"""The rigid bodies as a MuJoCo model: floor, ceiling, and the vehicle with its gear."""

from __future__ import annotations

import math
from typing import Any

import mujoco

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

FRAME_HALF_M = (0.035, 0.035, 0.012)
REST_HEIGHT_M = FRAME_HALF_M[2]
GEAR_RADIUS_M = 0.006
# Crazyflie 2.1 at 27 g; scaled by mass.
INERTIA_REFERENCE_KG = 0.027
INERTIA_REFERENCE_KGM2 = (1.66e-5, 1.67e-5, 2.93e-5)

_MODEL = """
<mujoco>
  <option timestep="{dt}" gravity="0 0 -{g}" cone="elliptic" impratio="10" iterations="30"/>
  <default><geom solref="0.006 1" solimp="0.95 0.99 0.0005" friction="1 0.003 0.0005"
    condim="4"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="30 30 1"/>
    <geom name="ceiling" type="plane" size="30 30 1" pos="0 0 {ceiling}" quat="0 1 0 0"/>
    <body name="vehicle" pos="0 0 {rest}">
      <freejoint/>
      <inertial pos="0 0 0" mass="{mass}" diaginertia="{inertia}"/>
      <geom name="frame" type="box" size="{frame}"/>
      <geom name="gear" type="cylinder" size="{radius} 0.002" pos="{gear}"/>
    </body>
  </worldbody>
</mujoco>
"""


def extent_m(scenario: Scenario) -> float:
    """How far from its centre any part of the vehicle is, at most."""
    gear = math.dist(scenario.gear_body_m, (0.0, 0.0, 0.0)) + math.hypot(GEAR_RADIUS_M, 0.004)
    return max(math.hypot(*FRAME_HALF_M), gear)


def build_model(scenario: Scenario) -> Any:
    """A `mujoco.MjModel` with the geoms "floor", "ceiling", "frame" and "gear".

    The inertia is the Crazyflie 2.1's, scaled by mass; the gear's cylinder ends at its tip.
    """
    mass = scenario.mass_kg
    scale = mass / INERTIA_REFERENCE_KG
    gear = scenario.gear_body_m
    return mujoco.MjModel.from_xml_string(
        _MODEL.format(
            dt=CONTROL_PERIOD_S,
            g=GRAVITY_MPS2,
            ceiling=scenario.ceiling_z_m,
            rest=REST_HEIGHT_M,
            mass=mass,
            inertia=" ".join(repr(i * scale) for i in INERTIA_REFERENCE_KGM2),
            frame=" ".join(map(repr, FRAME_HALF_M)),
            radius=GEAR_RADIUS_M,
            gear=f"{gear[0]!r} {gear[1]!r} {gear[2] - 0.002!r}",
        )
    )
