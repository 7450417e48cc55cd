"""The light on a marker: what turns its drawing into grey values.

Offset and gain, their slopes over the marker, the bend of the tone curve (clipped white,
gamma) and the grey beyond the sheet. All of them shift edges if left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.vision.markers.products import mixed, onto
from perchctl.vision.markers.rendered import BEND, BEYOND, GAIN, GAIN_U, GAIN_V, Rendered


@dataclass(frozen=True, eq=False)
class Light:
    """rows (7 or 8, n * n), without a sheet's end the last one is absent, and their
    coefficients, in grey levels."""

    rows: Array
    coefficients: Array

    @property
    def gain(self) -> float:
        """Grey levels from black to white."""
        return float(self.coefficients[GAIN])

    @property
    def grey(self) -> Array:
        """What the drawing looks like in this light, (n * n,)."""
        return mixed(self.rows, self.coefficients)


def fit_light(drawing: Rendered, grey: Array) -> Light:
    """The light that explains grey values (n * n,) best."""
    light = drawing.light
    A = light.products + 1e-6 * np.eye(len(light.products))
    A[BEND, BEND] += 1e-3 * len(grey)  # no bend unless it is seen
    coefficients = np.linalg.solve(A, onto(light.rows, grey))
    return Light(light.rows, np.asarray(coefficients, np.float64))


def lit_jacobian(drawing: Rendered, light: Light) -> Array:
    """Changes (9, n * n) of the grey values with the homography's increment and the blur's
    square, in this light."""
    c, gain, grid = light.coefficients, light.gain, drawing.grid
    bend = min(max(float(c[BEND]) / gain, -0.9), 0.9)
    slope = gain + c[GAIN_U] * grid.u + c[GAIN_V] * grid.v
    slope = slope * (1.0 + bend * (1.0 - 2.0 * drawing.sheets[0].value))
    change: Array = drawing.sheets[0].jacobian * slope
    for sheet, height in zip(drawing.sheets[1:], c[BEYOND:], strict=True):
        change += sheet.jacobian * height
    return change
