"""The way on which a hand takes the vehicle, as `perchctl check --lift` asks for it."""

from __future__ import annotations

import math

from perchctl.sim.world import Stop


def lifted_and_turned(home: tuple[float, float, float], yaw_rad: float = 0.0) -> tuple[Stop, ...]:
    """What `perchctl check --lift` asks for: up by 30 cm, turned by 90 deg, tilted forward and
    aside, put back."""
    x, y, z = home
    up, tilt, quarter = (x, y, z + 0.3), math.radians(30.0), 0.5 * math.pi
    return (
        Stop(1.2, up, (0.0, 0.0, yaw_rad)),
        Stop(1.5, up, (0.0, 0.0, yaw_rad + quarter)),
        Stop(0.9, up, (0.0, tilt, yaw_rad + quarter)),
        Stop(1.2, up, (tilt, 0.0, yaw_rad + quarter)),
        Stop(1.5, up, (0.0, 0.0, yaw_rad)),
        Stop(1.2, home, (0.0, 0.0, yaw_rad)),
    )
