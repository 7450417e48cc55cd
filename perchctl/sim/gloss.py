"""A glossy print: the reflection of a lamp in it, which moves with the viewpoint.

- Where a ray from the camera, mirrored at the print, meets the lamp, the print is brightest.
  Around it the brightness falls as the slopes of a smooth but not flat surface are spread:
  Beckmann's lobe over the half-way direction, with `SLOPE` its rms slope.
- How bright: varnish reflects 4 % at right angles (a refractive index of 1.5). A bulb of 800 lm
  and 10 cm shines with 8000 cd/m^2, of which 4 % are 3.8 times what white paper has under
  300 lx; spread over the lobe of a print that is not quite flat, 0.2 to 2 paper whites are left.
- The reflection lies upon the ink as upon the paper, so that at one paper white and more both
  are saturated, and the pattern is gone there.

It is worked out for the middle of the exposure: a highlight has no edges to blur.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.sim.optics import COARSE_PX, Picture, RayGrid, plane_map, trace
from perchctl.sim.sheets import PAPER_GREY

SLOPE = 0.03
_LEAST_GREY = 0.5


def lobe(points_m: NDArray[np.float32], eye_m: Array, lamp_m: Array) -> NDArray[np.float32]:
    """The reflection's brightness, 1 at its peak.

    Args:
        points_m: on the print (..., 2), its own axes (z up, away from the viewer).
        eye_m, lamp_m: the camera and the lamp (3,) in these axes, both below (z < 0).
    """
    at = np.concatenate([points_m, np.zeros((*points_m.shape[:-1], 1), np.float32)], axis=-1)
    half = _unit(np.asarray(eye_m, np.float32) - at) + _unit(np.asarray(lamp_m, np.float32) - at)
    slope2 = (half[..., 0] ** 2 + half[..., 1] ** 2) / np.maximum(half[..., 2] ** 2, 1e-9)
    return np.asarray(np.exp(-slope2 / SLOPE**2), np.float32)


def shone_upon(
    picture: Picture,
    coarse: RayGrid,
    T_target_cam: Array,
    lamp_m: Array,
    gloss: float,
    half_side_m: float,
) -> Picture:
    """The picture, at the coarse grid's padded size, with the lamp's reflection in the sheet
    (written into it).

    Args:
        T_target_cam: (4, 4), in the middle of the exposure.
        lamp_m: (3,) in the target's axes.
        gloss: the peak, in whites of the paper.
        half_side_m: of the sheet.
    """
    eye_m = T_target_cam[:3, 3]
    if gloss <= 0.0 or eye_m[2] >= 0.0 or lamp_m[2] >= 0.0:
        return picture
    nodes, _ = trace(coarse, plane_map(T_target_cam))
    inside_m = half_side_m - np.abs(nodes).max(axis=2)
    step_m = np.abs(np.diff(nodes, axis=1, append=nodes[:, -1:])).max(axis=2)
    grey = np.minimum(gloss * PAPER_GREY * lobe(nodes, eye_m, lamp_m), 255.0)
    shown = (grey > _LEAST_GREY) & (inside_m > -2.0 * step_m)
    if not shown.any():
        return picture
    rows, cols = np.flatnonzero(shown.any(axis=1)), np.flatnonzero(shown.any(axis=0))
    top, left = max(rows[0] - 1, 0), max(cols[0] - 1, 0)
    bottom = min(max(rows[-1], rows[0] + 1), len(nodes) - 2)
    right = min(max(cols[-1], cols[0] + 1), nodes.shape[1] - 2)
    if bottom <= top or right <= left:
        return picture
    window = (slice(top, bottom + 2), slice(left, right + 2))
    light = _full(np.rint(grey[window]).astype(np.uint8))
    if (inside_m[window] < step_m[window]).any():
        # Over one pixel at the sheet's edge the reflection ends.
        px = inside_m[window] * (COARSE_PX / np.maximum(step_m[window], 1e-6))
        cover = np.clip(_full(np.clip(px, -100.0, 100.0).astype(np.float32)) + 0.5, 0.0, 1.0)
        light = np.asarray(cv2.multiply(light, cover, dtype=cv2.CV_8U), np.uint8)
    area = picture[top * COARSE_PX : bottom * COARSE_PX, left * COARSE_PX : right * COARSE_PX]
    area[:] = cv2.add(area, light)
    return picture


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True), np.float32)


def _full(nodes: Any) -> Any:
    """Of values at the coarse nodes of a window, those at each pixel between its outermost."""
    values = cv2.resize(nodes, None, fx=COARSE_PX, fy=COARSE_PX)
    return np.ascontiguousarray(values[COARSE_PX:-COARSE_PX, COARSE_PX:-COARSE_PX])
