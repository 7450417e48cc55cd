"""The target's pose from the edges that are in view, where its markers are cut by the picture.

The drawing of both markers (`perchctl.vision.markers.outline`) is laid over the picture: at
places along its edges the edge of the picture is looked for across them, and Gauss-Newton
turns and moves the drawing until both agree. Its unknowns are those of a rigid body, not those
of a homography: a part of a drawing does not show eight of them. What it does not show of the
tilt is taken from the prediction, with that one's spread.

Lengths are in units of the large marker's half side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.camera_model import distort
from perchctl.vision.markers.outline import Outline
from perchctl.vision.markers.overview import lattice_of
from perchctl.vision.markers.profiles import MIDDLES, sample
from perchctl.vision.markers.square import UNIT
from perchctl.vision.types import CameraModel

# Of the profiles, by rounds. An ascent blurs edges near the picture's rim by several pixels.
_REACH_PX = (14.0, 10.0, 8.0, 8.0, 8.0, 8.0)
_REACH_CELLS, _LEAST_REACH_PX = 0.4, 3.0
_STILL_PX, _SETTLED_PX = 0.02, 0.5  # no other round follows; without this it is no fit
_LEAST_CONTRAST, _LEAST_SHARE = 8.0, 0.35  # grey levels; of the median
_LEAST_PLACES = 24
_TUKEY, _FLOOR_PX = 3.5, 0.15
_TAILS = 1.3  # what robust weights take away from a residual's square
_LENS_PX = 0.02  # by which a whole line may be off, of lens and light
_TILT_RAD, _TURN_RAD, _PLACE = math.radians(2.0), math.radians(20.0), 1.0  # of a prediction
_SHIFT_PX = 0.15  # by which white may have grown over black
_PRIOR: Array = np.array([_TILT_RAD, _TILT_RAD, _TURN_RAD, _PLACE, _PLACE, _PLACE]) ** -2.0
_SHIFT = 6  # the unknown after the rigid body's


@dataclass(frozen=True, eq=False)
class RigidPose:
    """R (3, 3) and t (3,) of the drawing in the camera."""

    R: Array
    t: Array

    @property
    def H(self) -> Array:
        """Own coordinates to normalised ones, (3, 3)."""
        return np.column_stack([self.R[:, 0], self.R[:, 1], self.t])


@dataclass(frozen=True, eq=False)
class Visible:
    """A pose with its covariance (6, 6) of turn and move; how many places along edges were in
    view, how many showed their edge, how many of these are the small marker's; and the spread
    of a single place."""

    pose: RigidPose
    cov: Array
    in_view: int
    shown: int
    small: int
    residual_px: float


@dataclass(frozen=True, eq=False)
class _Places:
    """Of an outline, in the picture: at (n, 2) px and unit normal (n, 2) from black to white,
    changes J (n, 6) along it with turn and move, px for a unit across (n,), and which of the
    outline's they are (n,)."""

    at: Array
    normal: Array
    J: Array
    px: Array
    index: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Round:
    """The step of all unknowns (7,), the inverse of their normal matrix, the places' weights
    (n,) and changes J (n, 7), and the variance of one place, px^2."""

    step: Array
    inverse: Array
    weight: Array
    J: Array
    variance: float


def fitted(
    image: NDArray[np.uint8],
    start: RigidPose,
    outline: Outline,
    print_sigma: Array,
    camera: CameraModel,
    mask: NDArray[np.uint8] | None = None,
) -> Visible | None:
    """The pose in which the outline's edges are the picture's, from one a few pixels off.

    `print_sigma` (n,) is by how much each place's line may be printed off its place. None
    where too few edges are in view, or the fit breaks down.
    """
    pose, total, found, moved_px = start, np.zeros(6), None, math.inf
    for reach_px in _REACH_PX:
        places = _in_view(pose, outline, reach_px, image.shape, camera, mask)
        if len(places.index) < _LEAST_PLACES:
            return None
        half_px = np.minimum(reach_px, _REACH_CELLS * outline.cell[places.index] * places.px)
        offset_px, shows = _offsets(image, places, half_px)
        if np.count_nonzero(shows) < _LEAST_PLACES:
            return None
        found = _solved(places, offset_px, shows, total)
        if found is None:
            return None
        pose, total = _moved(pose, found.step[:6]), total + found.step[:6]
        moved_px = float(np.abs(places.J @ found.step[:6]).max())
        if moved_px < _STILL_PX:
            break
    if found is None or moved_px > _SETTLED_PX or pose.t[2] <= 0.0:
        return None
    return _visible(pose, found, places, outline, print_sigma)


def foreseen(
    pose: RigidPose, outline: Outline, print_sigma: Array, camera: CameraModel
) -> Visible | None:
    """What `fitted` would make of a picture without a flaw, taken in that pose."""
    places = _in_view(pose, outline, _REACH_PX[0], camera.size_px[::-1], camera, None)
    n = len(places.index)
    if n < _LEAST_PLACES:
        return None
    found = _solved(places, np.zeros(n), np.ones(n, dtype=np.bool_), np.zeros(6))
    return None if found is None else _visible(pose, found, places, outline, print_sigma)


def _in_view(
    pose: RigidPose,
    outline: Outline,
    reach_px: float,
    shape: tuple[int, ...],
    camera: CameraModel,
    mask: NDArray[np.uint8] | None,
) -> _Places:
    """The places at which a whole profile is in the picture, and not covered."""
    h, w = shape[:2]
    X = np.column_stack([outline.at, np.zeros(len(outline.at))]) @ pose.R.T + pose.t
    ahead = X[:, 2] > 0.05
    x = X[:, :2] / np.where(ahead, X[:, 2], 1.0)[:, None]
    near = np.flatnonzero(ahead & (np.hypot(*x.T) < lattice_of(camera).reach))
    at = distort(x[near], camera)
    room = reach_px + 1.0
    inside = ((at >= room) & (at <= np.array([w - 1.0, h - 1.0]) - room)).all(axis=1)
    near, at = near[inside], at[inside]
    X, x = X[near], x[near]
    # The lens's own change, (n, 2, 2), by small steps.
    small = 1e-4
    D = np.stack(
        [(distort(x + step, camera) - at) / small for step in (np.array([small, 0.0]),
                                                               np.array([0.0, small]))],
        axis=2,
    )  # fmt: skip
    # A point's change with turn (about the drawing's centre) and move: dx / d(X), (n, 2, 3).
    P = np.zeros((len(x), 2, 3))
    P[:, 0, 0] = P[:, 1, 1] = 1.0 / X[:, 2]
    P[:, :, 2] = -x / X[:, 2:]
    A = D @ P
    across = outline.normal[near]
    along = np.stack([-across[:, 1], across[:, 0]], axis=1)
    tangent = np.einsum("nij,nj->ni", A, along @ pose.R[:, :2].T)
    towards = np.einsum("nij,nj->ni", A, across @ pose.R[:, :2].T)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1)
    normal /= np.maximum(np.hypot(*normal.T), 1e-12)[:, None]
    px = (normal * towards).sum(axis=1)
    normal *= np.sign(px)[:, None]
    move = np.einsum("ni,nij->nj", normal, A)
    turn = np.cross(X - pose.t, move)  # (w x r) . m = w . (r x m)
    free = np.ones(len(near), dtype=np.bool_)
    if mask is not None:
        for way in (-1.0, -0.5, 0.0, 0.5, 1.0):
            x_px, y_px = np.rint(at + way * reach_px * normal).astype(np.intp).T
            free &= mask[y_px, x_px] == 0
    return _Places(
        at=at[free],
        normal=normal[free],
        J=np.concatenate([turn, move], axis=1)[free],
        px=np.abs(px)[free],
        index=near[free],
    )


def _offsets(
    image: NDArray[np.uint8], places: _Places, half_px: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """How far along its normal each place's edge is in the picture, (n,) px, and whether there
    is one from dark to bright."""
    half_px = np.maximum(half_px, _LEAST_REACH_PX)
    grey = sample(image, places.at[:, None], places.normal[:, None], half_px)[:, 0]
    gradient = np.diff(grey, axis=1).astype(np.float64)
    u = half_px[:, None] * MIDDLES.astype(np.float64)
    mass = gradient * np.exp(-0.5 * (u / (0.5 * half_px[:, None])) ** 2)
    total = mass.sum(axis=1)
    contrast = grey[:, -1].astype(np.float64) - grey[:, 0]
    least = max(_LEAST_CONTRAST, _LEAST_SHARE * float(np.median(contrast)))
    shows = (contrast > least) & (total > 0.25 * least)
    offset_px = (mass * u).sum(axis=1) / np.where(shows, total, 1.0)
    return np.clip(offset_px, -half_px, half_px), shows


def _solved(
    places: _Places, offset_px: Array, shows: NDArray[np.bool_], total: Array
) -> _Round | None:
    """A robust step of turn, move and the common shift of edges (white over black)."""
    J = np.concatenate([places.J, -np.ones((len(offset_px), 1))], axis=1)
    prior = np.append(_PRIOR, _SHIFT_PX**-2.0)
    pull = np.append(-_PRIOR * total, 0.0)
    weight = shows.astype(np.float64)
    variance = 1.0
    step = np.zeros(7)
    for _ in range(4):
        error = offset_px - J @ step
        size = np.abs(error)
        scale = max(1.4826 * float(np.median(size[shows])), _FLOOR_PX)
        weight = np.maximum(1.0 - (size / (_TUKEY * scale)) ** 2, 0.0) ** 2 * shows
        mass = float(weight.sum())
        if mass < 0.5 * _LEAST_PLACES:
            return None
        variance = max(_TAILS * float(weight @ error**2) / mass, 1e-3)
        N = (J * weight[:, None]).T @ J / variance + np.diag(prior)
        try:
            inverse = np.linalg.inv(N)
        except np.linalg.LinAlgError:
            return None
        step = inverse @ (J.T @ (weight * offset_px) / variance + pull)
        if not np.isfinite(step).all():
            return None
    return _Round(step, inverse, weight, J, variance)


def _moved(pose: RigidPose, step: Array) -> RigidPose:
    turn = np.asarray(cv2.Rodrigues(step[:3])[0], dtype=np.float64)
    return RigidPose(turn @ pose.R, pose.t + step[3:])


def _covariance(found: _Round, places: _Places, outline: Outline, print_sigma: Array) -> Array:
    """Of turn and move (6, 6): of each place's own noise, of what moves a line as a whole, and
    of the prediction."""
    J, w, variance = found.J, found.weight, found.variance
    line = outline.line[places.index]
    common_px = np.hypot(print_sigma[places.index] * places.px, _LENS_PX)
    by_line = np.zeros((int(line.max()) + 1, J.shape[1]))
    np.add.at(by_line, line, J * (w * common_px)[:, None])
    middle = variance * (J * (w**2)[:, None]).T @ J + by_line.T @ by_line
    prior = np.diag(np.append(_PRIOR, _SHIFT_PX**-2.0))
    cov = found.inverse @ (middle / variance**2 + prior) @ found.inverse
    return np.asarray(cov[:6, :6])


def _visible(
    pose: RigidPose, found: _Round, places: _Places, outline: Outline, print_sigma: Array
) -> Visible:
    shown = found.weight > 0.0
    return Visible(
        pose=pose,
        cov=_covariance(found, places, outline, print_sigma),
        in_view=len(shown),
        shown=int(np.count_nonzero(shown)),
        small=int(np.count_nonzero(shown & outline.small[places.index])),
        residual_px=math.sqrt(found.variance),
    )


def corners_of(pose: RigidPose, half: float, camera: CameraModel) -> tuple[Array, Array] | None:
    """Corners (4, 2) of the square of that half side, normalised, and their changes (8, 6) with
    turn and move, pixels of a pinhole; None where one is beside or behind the camera."""
    r = np.column_stack([half * UNIT, np.zeros(4)]) @ pose.R.T
    X = r + pose.t
    if X[:, 2].min() <= 0.0:
        return None
    x = X[:, :2] / X[:, 2:]
    J = np.zeros((8, 6))
    for k in range(4):
        P = np.array([[1.0, 0.0, -x[k, 0]], [0.0, 1.0, -x[k, 1]]]) / X[k, 2]
        P = camera.K[:2, :2] @ P
        J[2 * k : 2 * k + 2, :3] = np.cross(r[k], P)
        J[2 * k : 2 * k + 2, 3:] = P
    return x, J
