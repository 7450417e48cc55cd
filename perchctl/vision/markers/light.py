"""The light on a marker: what turns its drawing into grey values.

Offset and gain, their slopes over the marker, the bend of the tone curve (clipped white,
gamma) and the grey beyond the sheet. All of them shift edges if left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.vision.markers.drawing import Rendering
from perchctl.vision.markers.grid import Grid
from perchctl.vision.markers.products import gram, mixed

# Columns: offset and its slopes, gain and its slopes, bend, and what is beyond the sheet.
OFFSET, OFFSET_U, OFFSET_V, GAIN, GAIN_U, GAIN_V, BEND, BEYOND = range(8)


@dataclass(frozen=True, eq=False)
class Light:
    """columns (n * n, 7 or 8), without a sheet's end the last one is absent, and their
    coefficients, in grey levels."""

    columns: Array
    coefficients: Array

    @property
    def gain(self) -> float:
        """Grey levels from black to white."""
        return float(self.coefficients[GAIN])

    @property
    def grey(self) -> Array:
        """What the drawing looks like in this light, (n * n,)."""
        return mixed(self.columns, self.coefficients)


def fit_light(renderings: Sequence[Rendering], grey: Array, grid: Grid) -> Light:
    """The light that explains grey values (n * n,) best: of the drawing, and after it
    perhaps of what is beyond its sheet."""
    u, v, white = grid.u, grid.v, renderings[0].value
    columns = [np.ones_like(u), u, v, white, white * u, white * v, white * (1.0 - white)]
    columns += [rendering.value for rendering in renderings[1:]]
    light: Array = np.stack([*columns, grey], axis=1)
    products = gram(light, light)
    A = products[:-1, :-1] + 1e-6 * np.eye(len(columns))
    A[BEND, BEND] += 1e-3 * len(u)  # no bend unless it is seen
    return Light(light[:, :-1], np.asarray(np.linalg.solve(A, products[:-1, -1]), np.float64))


def lit_jacobian(renderings: Sequence[Rendering], light: Light, grid: Grid) -> Array:
    """Changes (n * n, 9) of the grey values with the homography's increment and the blur's
    square, in this light."""
    c, gain = light.coefficients, light.gain
    bend = min(max(float(c[BEND]) / gain, -0.9), 0.9)
    slope = gain + c[GAIN_U] * grid.u + c[GAIN_V] * grid.v
    slope = slope * (1.0 + bend * (1.0 - 2.0 * renderings[0].value))
    change: Array = renderings[0].jacobian * slope[:, None]
    for rendering, height in zip(renderings[1:], c[BEYOND:], strict=True):
        change += rendering.jacobian * height
    return change
