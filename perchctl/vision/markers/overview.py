"""A picture at a glance: small, through a pinhole, beside what a drawing would look like there.

It tells how far a prediction is off, and whether the picture looks like the drawing, where
too little of a marker is in view for its corners.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort, undistort
from perchctl.vision.markers.likeness import likeness
from perchctl.vision.markers.outline import PAPER, Texture
from perchctl.vision.markers.square import mapped
from perchctl.vision.types import CameraModel

Grey = NDArray[np.float32]

_NODES = 80  # across the picture, about
_FINE = 2  # samples for a node, in both directions
_WIDEST = 1.5  # normalised: 56 degrees off the axis
_RIM_POINTS = 40
_REACHED = 1.02
_SEARCHED = 6  # nodes to each side
_LEAST_NODES = 200  # that show paper


@dataclass(frozen=True, eq=False)
class Lattice:
    """Nodes of a pinhole's picture, `step` apart in normalised coordinates, the first at
    `first`; how far from the axis the picture `reaches`, beyond which a lens model may fold
    back; where the samples that make up a node are read in the reduced picture, which has
    `size` (width, height); and the nodes that are in the picture (rows, columns)."""

    first: Array
    step: float
    reach: float
    x: Grey
    y: Grey
    size: tuple[int, int]
    inside: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Overview:
    """Grey values at a lattice's nodes (rows, columns), and which of them are the picture's and
    not covered."""

    lattice: Lattice
    grey: Grey
    seen: NDArray[np.bool_]


@lru_cache(maxsize=8)
def lattice_of(camera: CameraModel) -> Lattice:
    w, h = camera.size_px
    s = np.linspace(0.0, 1.0, _RIM_POINTS)
    low, high = np.zeros_like(s), np.ones_like(s)
    rim = np.concatenate([np.stack(p, 1) for p in ((s, low), (s, high), (low, s), (high, s))])
    rays = undistort(rim * (w - 1.0, h - 1.0), camera)
    rays = np.clip(np.nan_to_num(rays, nan=0.0), -_WIDEST, _WIDEST)
    reach = _REACHED * float(np.hypot(*rays.T).max())
    step = w / (_NODES * float(camera.K[0, 0]))
    nodes = np.maximum(np.ceil(np.ptp(rays, axis=0) / step).astype(int), 1)
    fine = [rays.min(axis=0)[k] + step * ((np.arange(_FINE * nodes[k]) + 0.5) / _FINE)
            for k in (0, 1)]  # fmt: skip
    x, y = np.meshgrid(*fine)
    at = distort(np.stack([x.ravel(), y.ravel()], axis=1), camera)
    inside = np.isfinite(at).all(axis=1) & (np.hypot(x, y).ravel() < reach)
    inside &= (at > 0.0).all(axis=1) & (at < (w - 1, h - 1)).all(axis=1)
    at = np.where(inside[:, None], at, -1e3)
    every = max(round(w / (_FINE * _NODES)), 1)
    size = (max(w // every, 1), max(h // every, 1))
    reduced = ((at + 0.5) * (size[0] / w, size[1] / h) - 0.5).astype(np.float32)
    shape = (int(nodes[1]), _FINE, int(nodes[0]), _FINE)
    flat = x.shape
    return Lattice(
        first=rays.min(axis=0) + step / 2.0,
        step=step,
        reach=reach,
        x=np.ascontiguousarray(reduced[:, 0].reshape(flat)),
        y=np.ascontiguousarray(reduced[:, 1].reshape(flat)),
        size=size,
        inside=inside.reshape(shape).all(axis=(1, 3)),
    )


def overview_of(
    image: NDArray[np.uint8], camera: CameraModel, mask: NDArray[np.uint8] | None = None
) -> Overview:
    """Of a picture; what `mask` (its shape, 0: free) covers is not seen."""
    lattice = lattice_of(camera)
    seen = lattice.inside
    if mask is not None:
        covered = (mask != 0).astype(np.float32)
        seen = seen & (_looked_up(covered, lattice) < 1e-3)
    return Overview(lattice, _looked_up(image, lattice), seen)


def _looked_up(picture: NDArray[np.uint8] | Grey, lattice: Lattice) -> Grey:
    small = cv2.resize(picture, lattice.size, interpolation=cv2.INTER_AREA).astype(np.float32)
    fine = cv2.remap(small, lattice.x, lattice.y, cv2.INTER_LINEAR)
    return _coarse(np.asarray(fine, np.float32))


def _coarse(fine: Grey) -> Grey:
    rows, columns = (n // _FINE for n in fine.shape)
    return np.asarray(cv2.resize(fine, (columns, rows), interpolation=cv2.INTER_AREA), np.float32)


def drawn_over(H: Array, texture: Texture, lattice: Lattice, margin: int = 0) -> Grey:
    """Whiteness of the drawing at the lattice's nodes and `margin` more all around; H (3, 3)
    maps own coordinates to normalised ones."""
    step = lattice.step / _FINE
    start = lattice.first - 0.5 * (lattice.step - step) - margin * lattice.step
    G = np.array([[1.0 / step, 0.0, -start[0] / step], [0.0, 1.0 / step, -start[1] / step],
                  [0.0, 0.0, 1.0]])  # fmt: skip
    M = G @ H @ np.linalg.inv(texture.T)
    rows, columns = lattice.inside.shape
    size = (_FINE * (columns + 2 * margin), _FINE * (rows + 2 * margin))
    fine = cv2.warpPerspective(
        texture.white,
        M,
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=1.0,
    )
    return _coarse(np.asarray(fine, np.float32))


def drift_of(H: Array, texture: Texture, view: Overview) -> tuple[Array, float]:
    """How far the picture is from the drawing through H, (2,) normalised, to a node; and the
    correlation there."""
    lattice = view.lattice
    wide = drawn_over(H, texture, lattice, _SEARCHED)
    mask = view.seen.astype(np.float32)
    score = cv2.matchTemplate(wide, view.grey, cv2.TM_CCOEFF_NORMED, mask=mask)
    score = np.where(np.isfinite(score) & (np.abs(score) <= 1.001), score, -1.0)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    drift = (_SEARCHED - np.array([column, row], dtype=np.float64)) * lattice.step
    return drift, float(score[row, column])


def looks_like(H: Array, texture: Texture, view: Overview) -> tuple[float, float]:
    """Likeness of the picture with the drawing through H in its best light, where there is
    paper; and that light's gain, grey levels from black to white."""
    lattice = view.lattice
    rows, columns = np.nonzero(view.seen)
    at = lattice.first + lattice.step * np.stack([columns, rows], axis=1).astype(np.float64)
    on = np.abs(mapped(np.asarray(np.linalg.inv(H), np.float64), at)).max(axis=1) < PAPER
    if np.count_nonzero(on) < _LEAST_NODES:
        return 0.0, 0.0
    white = drawn_over(H, texture, lattice)[rows[on], columns[on]].astype(np.float64)
    grey = view.grey[rows[on], columns[on]].astype(np.float64)
    x, y = (at[on] - at[on].mean(axis=0)).T
    A = np.stack([np.ones_like(x), x, y, white, white * x, white * y], axis=1)
    light = np.linalg.solve(A.T @ A + 1e-6 * np.eye(6), A.T @ grey)
    gain = float(light[3])
    if not math.isfinite(gain):
        return 0.0, 0.0
    return likeness(grey, grey - A @ light), gain
