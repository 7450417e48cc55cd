"""A marker's drawing laid over the picture: for what edges and bits no longer show.

Where blur has run the cells together, or cells are a few pixels wide, the picture of
the whole marker still is its drawing, blurred and lit. Gauss-Newton finds the
homography together with the light (`perchctl.vision.markers.light`) and the blur. What
does not look like the drawing then, cell by cell, is not the marker.

The increment p of the homography H in a round is H (1 + P), with P's terms in the order
of its rows and its last one 0. Coordinates are the marker's own, see
`perchctl.vision.markers.square`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.values import replace
from perchctl.vision.camera_model import undistort_px
from perchctl.vision.markers.drawing import Drawing
from perchctl.vision.markers.grid import (
    Grid,
    Patch,
    lens_shift_px,
    make_grid,
    patch_around,
    read,
    through_lens,
)
from perchctl.vision.markers.light import Light, fit_light, lit_jacobian
from perchctl.vision.markers.likeness import likeness, pattern_seen, repeated, worst_cell
from perchctl.vision.markers.products import gram
from perchctl.vision.markers.rendered import BEND, Rendered, rendered
from perchctl.vision.markers.square import UNIT, corner_jacobian, from_unit, mapped
from perchctl.vision.types import CameraModel

_MAX_GRID, _MIN_GRID = 44, 18
_GRID_PX = 0.8  # picture pixels from node to node
_ROUNDS = 12
_HOPE_ROUNDS, _LEAST_HOPE = 4, 0.7
"""A marker's likeness is above 0.9 after two rounds; what is still far from it is none."""
_STILL_PX = 0.05  # the round after such a step moves a tenth of that, mostly
_LENS_PX = 0.3  # what the lens does is computed anew after this way
_MAX_INCREMENT = 0.5  # of a round; beyond it the fit has broken down
# How far shape may leave its start, as standard deviations, per unit of the marker's
# half side: turns and scales; then the perspective, which a few pixels hardly show.
_SHAPE_SIGMA, _VIEW_SIGMA = 0.2, 0.03
_BEND_SIGMA = 0.5  # of the tone curve, in units of the gain
_MIN_BLUR_PX, _MAX_BLUR_CELLS = 0.35, 1.6
_MOST_BLUR_STEP = 0.5  # of a round: of the blur's square; a node's square at least
_BLUR_STEP, _BLUR_STEP_CELLS = 0.05, 0.02
"""A change of blur draws nothing anew that is smaller than both: as a share of it, and in cells.
A blur of half a cell that is 5 % off leaves more than codewords differ by."""
_MIN_GAIN = 10.0  # grey levels from black to white
_MIN_SIDE_PX, _MAX_SIDE_PX = 4.0, 2000.0
_SHAPE, _BLUR, _LIGHT = slice(0, 8), 8, 9  # unknowns: the increment, blur, those of light
_PRIOR: Array = (
    np.array(
        [_SHAPE_SIGMA, _SHAPE_SIGMA, 1e3, _SHAPE_SIGMA, _SHAPE_SIGMA, 1e3, _VIEW_SIGMA, _VIEW_SIGMA]
    )
    ** -2.0
)  # of the increment's terms; the place is free


@dataclass(frozen=True, eq=False)
class Alignment:
    """corners_px (4, 2) and their spread; `likeness` is the correlation with the
    drawing, `pattern` that of what a black square of the same size would leave over,
    `strength` the height of the pattern's bits over the border's, `worst_cell` the
    largest mean departure of a cell, in units of the gain."""

    corners_px: Array
    sigma_px: float
    likeness: float
    pattern: float
    strength: float
    worst_cell: float
    flip: float
    flip_sigma: float
    blur_px: float
    gain: float
    moved_px: float


@dataclass(frozen=True, eq=False)
class _Scene:
    """What stays the same through all rounds: the picture, the nodes at which it is read,
    the homography to start with and the lens's shift of the nodes through it, and the
    drawing."""

    patch: Patch
    grid: Grid
    camera: CameraModel
    H: Array
    lens_px: Array
    drawing: Drawing
    side_px: float
    node_px: float
    cell_px: float


@dataclass(frozen=True, eq=False)
class _Fit:
    """The state of the fit: homography to pinhole pixels, the sum of its increments (8,),
    the offset that the lens makes of it at the nodes and the way since that was computed,
    the drawing with its blur, and whether it stands still after so many rounds."""

    H: Array
    total: Array
    offset_px: Array
    since_lens_px: float
    rendered: Rendered
    rounds: int = 0
    still: bool = False


@dataclass(frozen=True, eq=False)
class _Equations:
    """The light in which a fit looks most like the picture's grey values, what it leaves
    over, the changes J with the unknowns, and the normal equations N x = g of the next
    increment, per unit of noise."""

    grey: Array
    light: Light
    error: Array
    J: Array
    noise: float
    N: Array
    g: Array


def align(
    image: NDArray[np.uint8],
    start_px: Array,
    drawing: Drawing,
    camera: CameraModel,
    blur_px: float = 1.0,
) -> Alignment | None:
    """Lay the drawing over the picture, starting with corners `start_px` (4, 2) and a blur.

    None where the marker leaves the picture, has no contrast, is not alike at all, or the fit
    breaks down.
    """
    start = undistort_px(start_px, camera)
    scene = _scene(image, start, drawing, camera)
    if scene is None:
        return None
    fit = _first_fit(blur_px, scene)
    while True:
        fit = _seen_through_lens(fit, scene)
        equations = _equations(fit, scene)
        if equations is None:
            return None
        if fit.rounds == _HOPE_ROUNDS and likeness(equations.grey, equations.error) < _LEAST_HOPE:
            return None
        step = _solved(equations)
        if step is None:
            return None
        fit = _stepped(fit, step, scene)
        if fit.still or fit.rounds == _ROUNDS:
            # What the last round left over, its step being next to nothing.
            return _alignment(fit, equations, scene, start_px)


def _scene(
    image: NDArray[np.uint8], start: Array, drawing: Drawing, camera: CameraModel
) -> _Scene | None:
    """None where corners `start` (4, 2), pinhole px, are no marker inside the picture."""
    if not np.isfinite(start).all():
        return None
    sides = np.hypot(*(start - np.roll(start, 1, axis=0)).T)
    side_px, reach = float(sides.mean()), drawing.reach
    if float(sides.min()) < _MIN_SIDE_PX or side_px > _MAX_SIDE_PX:
        return None
    n = int(np.clip(math.ceil(reach * side_px / _GRID_PX), _MIN_GRID, _MAX_GRID))
    grid, H = make_grid(n, reach), from_unit(start)
    lens_px = lens_shift_px(grid, H, camera)
    patch = patch_around(image, grid, H, lens_px)
    if patch is None:
        return None
    return _Scene(
        patch=patch,
        grid=grid,
        camera=camera,
        H=H,
        lens_px=lens_px,
        drawing=drawing,
        side_px=side_px,
        node_px=reach * side_px / n,
        cell_px=side_px / len(drawing.cells),
    )


def _possible_blur_px(blur_px: float, scene: _Scene) -> float:
    return min(max(blur_px, _MIN_BLUR_PX), _MAX_BLUR_CELLS * scene.cell_px)


def _first_fit(blur_px: float, scene: _Scene) -> _Fit:
    blur_px = _possible_blur_px(blur_px, scene)
    return _Fit(
        H=scene.H,
        total=np.zeros(8),
        offset_px=scene.lens_px - scene.patch.first[:, None],
        since_lens_px=0.0,
        rendered=_rendered(blur_px, scene),
    )


def _rendered(blur_px: float, scene: _Scene) -> Rendered:
    return rendered(scene.drawing, scene.grid.n, blur_px / scene.node_px)


def _seen_through_lens(fit: _Fit, scene: _Scene) -> _Fit:
    """With the lens computed anew if the fit has moved away from where it was."""
    if fit.since_lens_px <= _LENS_PX:
        return fit
    offset_px = lens_shift_px(scene.grid, fit.H, scene.camera) - scene.patch.first[:, None]
    return replace(fit, offset_px=offset_px, since_lens_px=0.0)


def _equations(fit: _Fit, scene: _Scene) -> _Equations | None:
    """None without contrast. 16 or 17 unknowns: shape, blur and light."""
    grey = read(scene.patch, scene.grid, fit.H, fit.offset_px)
    light = fit_light(fit.rendered, grey)
    gain = light.gain
    if gain < _MIN_GAIN:
        return None
    error = grey - light.grey
    changes = lit_jacobian(fit.rendered, light)
    J = np.concatenate([changes, light.rows, error[None]])
    noise = max(float((error**2).mean()), 1.0)
    products = gram(J) / noise
    J, N, g = J[:-1], products[:-1, :-1], products[:-1, -1]
    bend = _LIGHT + BEND
    N[_BLUR, _BLUR] += 1.0  # about a node's width a round
    N[bend, bend] += (_BEND_SIGMA * gain) ** -2.0
    g[bend] -= light.coefficients[BEND] * (_BEND_SIGMA * gain) ** -2.0
    N[range(_LIGHT, len(g)), range(_LIGHT, len(g))] += 1e-6
    N[range(8), range(8)] += _PRIOR
    g[_SHAPE] -= _PRIOR * fit.total
    return _Equations(grey, light, error, J, noise, N, g)


def _solved(equations: _Equations) -> Array | None:
    """The step of all unknowns, None where it is not one that can be trusted."""
    try:
        step = np.asarray(np.linalg.solve(equations.N, equations.g), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    p = step[_SHAPE]
    return step if np.isfinite(p).all() and np.abs(p).max() <= _MAX_INCREMENT else None


def _stepped(fit: _Fit, step: Array, scene: _Scene) -> _Fit:
    """The fit one step on."""
    p = step[_SHAPE]
    H = fit.H @ np.array([[1 + p[0], p[1], p[2]], [p[3], 1 + p[4], p[5]], [p[6], p[7], 1.0]])
    H /= H[2, 2]
    moved_px = 0.5 * scene.side_px * float(np.abs(p[:6]).max())
    since_lens_px = fit.since_lens_px + moved_px
    sigma2 = fit.rendered.sigma**2
    most = max(1.0, _MOST_BLUR_STEP * sigma2)
    squared = sigma2 + float(np.clip(step[_BLUR], -most, most))
    wanted_px = _possible_blur_px(math.sqrt(max(squared, 1e-3)) * scene.node_px, scene)
    blur_px = fit.rendered.sigma * scene.node_px
    least_px = min(_BLUR_STEP * blur_px, _BLUR_STEP_CELLS * scene.cell_px)
    redraw = abs(wanted_px - blur_px) > least_px
    return replace(
        fit,
        H=H,
        total=fit.total + p,
        since_lens_px=since_lens_px,
        rendered=_rendered(wanted_px, scene) if redraw else fit.rendered,
        rounds=fit.rounds + 1,
        still=not redraw and moved_px < _STILL_PX and since_lens_px <= _LENS_PX,
    )


def _alignment(fit: _Fit, equations: _Equations, scene: _Scene, start_px: Array) -> Alignment:
    drawing, grid, light, error = scene.drawing, scene.grid, equations.light, equations.error
    corners_px = through_lens(mapped(fit.H, UNIT).T, scene.camera).T
    pattern = pattern_seen(fit.rendered, equations.grey, light)
    many = repeated(error.reshape(grid.n, grid.n))
    inverse = np.asarray(np.linalg.inv(equations.N))
    covariance = inverse[_SHAPE, _SHAPE] * many
    cells = cells_seen(
        drawing.cells,
        fit.rendered.soft_cells,
        error,
        equations.J,
        inverse / equations.noise,
        many * equations.noise,
        light.gain,
    )
    J = corner_jacobian(fit.H)
    return Alignment(
        corners_px=corners_px,
        sigma_px=math.sqrt(max(float(np.trace(J @ covariance @ J.T)) / 8.0, 0.0)),
        likeness=likeness(equations.grey, error),
        pattern=pattern.correlation,
        strength=pattern.strength,
        worst_cell=worst_cell(error / light.gain, grid, len(drawing.cells)),
        flip=cells.flip,
        flip_sigma=cells.sigma,
        blur_px=fit.rendered.sigma * scene.node_px,
        gain=light.gain,
        moved_px=float(np.abs(corners_px - start_px).max()),
    )


# --- Which of a drawing's cells the picture contradicts ----------------------------------------
# The mean over a cell shows a wrong bit as long as blur is smaller than the cell. Beyond that a
# wrong bit is spread over its neighbours, and shape, blur and light of the fit take a part of
# what it leaves over. So each cell is looked for as it would look: blurred, and without what the
# fit's unknowns explain (a matched filter).


@dataclass(frozen=True)
class CellsSeen:
    """flip: by how much the cell that is most against it has the other colour, 0 (drawn
    as it is seen) to 1 (the bit is wrong); sigma: the least certain cell's spread."""

    flip: float
    sigma: float


def cells_seen(
    cells: Array, soft: Array, error: Array, J: Array, inverse: Array, noise: float, gain: float
) -> CellsSeen:
    """What a fit leaves over, cell by cell.

    Args:
        cells: the drawing's, (m, m), 1 = white.
        soft: share of each row (and column) of cells in each node, blurred, (n, m).
        error: grey values minus the fit, (n * n,).
        J: changes of the grey values with the fit's unknowns, (k, n * n).
        inverse: of the fit's normal matrix with its priors, (k, k), per unit of noise.
        noise: variance of a node's grey value, of nodes that measure on their own.
        gain: grey levels from black to white.
    """
    n, m = soft.shape
    seen = gain * (soft.T @ error.reshape(n, n) @ soft).ravel()
    shared = gain * (soft.T @ J.reshape(-1, n, n) @ soft).reshape(-1, m * m)
    squared = (soft**2).sum(axis=0)
    energy = gain**2 * np.outer(squared, squared).ravel()
    taken = np.einsum("ij,ij->j", shared, inverse.dot(shared))
    own = np.maximum(energy - taken, 1e-9 * energy + 1e-12)
    flips = np.where(cells.ravel() > 0.5, -1.0, 1.0) * seen / own
    return CellsSeen(float(flips.max()), math.sqrt(noise / float(own.min())))
