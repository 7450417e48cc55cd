"""What a simulated motion-capture system is like, and what goes wrong in it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.geometry import Array

_AXES = re.compile(r"([+-])([xyz])([+-])([xyz])([+-])([xyz])")
TRUE_AXES = "+x+y+z"
Y_UP = "+x+z-y"
"""The capture's second axis is up, as some systems have it out of the box."""
SWAPPED_XY = "+y-x+z"
"""The capture's axes lie a quarter turn from those along which its bodies were defined."""
MILLIMETRES_PER_M = 1000.0


@dataclass(frozen=True)
class OtherBody:
    """A rigid body that is not the vehicle: it stands, or swings by `swing_m` about its place."""

    name: str
    position_m: tuple[float, float, float]
    swing_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    period_s: float = 4.0


@dataclass(frozen=True)
class CaptureFault:
    """What is wrong for a time; as it stands, nothing.

    Attributes:
        occluded: the vehicle's body is not seen.
        frozen: all bodies stay where they were seen last, to the last digit.
        gone: no frame is sent.
        swapped: the vehicle's body and the first other one have changed names.
        scale: of all positions; 1000 is millimetres.
        mirrored: positions with y's sign turned, as a left-handed program sends them.
        axes: the capture's axes in the world's, such as `+x+z-y`; None: as in the settings.
        late_s: more than the settings' delay.
        rate_hz: at most so many frames a second.
    """

    occluded: bool = False
    frozen: bool = False
    gone: bool = False
    swapped: bool = False
    scale: float = 1.0
    mirrored: bool = False
    axes: str | None = None
    late_s: float = 0.0
    rate_hz: float = math.inf

    def __post_init__(self) -> None:
        if self.axes is not None:
            axes_matrix(self.axes)


@dataclass(frozen=True)
class CaptureSettings:
    """A motion-capture system as a lab has it; SI, its world that of the state estimate.

    Attributes:
        body: the vehicle's rigid body, `body_*` its axes and origin in the vehicle's axes.
        rate_hz: of its cameras.
        delay_s, jitter_s: from an exposure to the frame's arrival; one sigma of it.
        position_noise_m, attitude_noise_rad: one sigma, each axis.
        axes: the capture's axes in the world's.
        heading_rad, origin_m: of the simulator's world in the capture's.
        faults: (from s, to s, what), on the simulation's clock.
    """

    body: str = "crazyflie"
    body_rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    body_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    others: tuple[OtherBody, ...] = (OtherBody("wand", (1.2, -0.9, 0.05)),)
    rate_hz: float = 120.0
    delay_s: float = 0.01
    jitter_s: float = 0.0005
    position_noise_m: float = 0.001
    attitude_noise_rad: float = 0.005
    axes: str = TRUE_AXES
    heading_rad: float = 0.0
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    faults: tuple[tuple[float, float, CaptureFault], ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        axes_matrix(self.axes)
        if not self.rate_hz > 0.0:
            raise InvalidValue(f"a motion capture at {self.rate_hz:g} Hz sees nothing")
        if len(set(self.names)) < len(self.names):
            raise InvalidValue(f"two rigid bodies have one name: {', '.join(self.names)}")

    @property
    def names(self) -> tuple[str, ...]:
        """Of all rigid bodies, the vehicle's first."""
        return (self.body, *(other.name for other in self.others))


def axes_matrix(axes: str) -> Array:
    """(3, 3): world vector to the capture's. Errors: InvalidValue for what is no right-handed
    set of axes."""
    parts = _AXES.fullmatch(axes)
    matrix = np.zeros((3, 3))
    if parts is not None:
        for row in range(3):
            sign, axis = parts.group(2 * row + 1), parts.group(2 * row + 2)
            matrix[row, "xyz".index(axis)] = 1.0 if sign == "+" else -1.0
    if round(float(np.linalg.det(matrix))) != 1:
        raise InvalidValue(f"axes {axes!r} are none; right-handed ones are such as {Y_UP!r}")
    return matrix
