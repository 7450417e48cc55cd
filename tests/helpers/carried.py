"""The way on which a hand takes the vehicle, as `perchctl check --lift` asks for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from perchctl.geometry import Array, rotation_from_quaternion, rotation_from_rpy, rpy_from_rotation

Place = tuple[float, float, float]


class Stop(NamedTuple):
    """Reached `after_s` after the one before, at rest."""

    after_s: float
    position_m: Place
    rpy_rad: Place = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Stops:
    """The way of a hand through all stops: its place and R_world_body by those at which it took the
    vehicle and the time since; at the last it is held."""

    stops: tuple[Stop, ...]

    def __call__(self, place_m: Place, R: Array, t_s: float) -> tuple[Array, Array]:
        a, b = np.asarray(place_m), np.asarray(rpy_from_rotation(R))
        for after_s, *stop in self.stops:
            c, d = map(np.asarray, stop)
            share = min(max(t_s / after_s, 0.0), 1.0)
            # At both ends neither speed nor acceleration.
            share = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            if share < 1.0:
                return a + share * (c - a), rotation_from_rpy(*(b + share * (d - b)).tolist())
            a, b, t_s = c, d, t_s - after_s
        return a, rotation_from_rpy(*b.tolist())


class Hand:
    """Moves the vehicle of a `perchctl.sim.world.World` from where it is along a way; the sensors
    feel all of it."""

    def __init__(self, way: Stops) -> None:
        self._way = way
        self._start: tuple[float, Place, Array] | None = None

    def __call__(self, world: Any) -> None:
        if self._start is None:
            place_m = world.x_m, world.y_m, world.z_m
            self._start = world.t_s, place_m, rotation_from_quaternion(world.quaternion)
        began_s, *start = self._start
        t_s, dt_s = world.t_s - began_s, 1e-4
        before, here, after = (self._way(*start, t_s + k * dt_s) for k in (-1, 0, 1))
        turn = before[1].T @ after[1]  # so small a turn is its own vector
        rates = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / (2.0 * dt_s)
        world.set_state(*here, (after[0] - before[0]) / (2.0 * dt_s), rates)
        world.set_acceleration(*((after[0] - 2.0 * here[0] + before[0]) / dt_s**2).tolist())


def lifted_and_turned(home: Place, yaw_rad: float = 0.0) -> Stops:
    """What `perchctl check --lift` asks for: up by 30 cm, turned by 90 deg, tilted forward and
    aside, put back."""
    x, y, z = home
    up, tilt, quarter = (x, y, z + 0.3), math.radians(30.0), 0.5 * math.pi
    return Stops((
        Stop(1.2, up, (0.0, 0.0, yaw_rad)),
        Stop(1.5, up, (0.0, 0.0, yaw_rad + quarter)),
        Stop(0.9, up, (0.0, tilt, yaw_rad + quarter)),
        Stop(1.2, up, (tilt, 0.0, yaw_rad + quarter)),
        Stop(1.5, up, (0.0, 0.0, yaw_rad)),
        Stop(1.2, home, (0.0, 0.0, yaw_rad)),
    ))  # fmt: skip
