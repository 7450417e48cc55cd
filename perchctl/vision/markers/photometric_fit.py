"""A marker's drawing laid over the picture: for what edges and bits no longer show.

Where blur has run the cells together, or cells are a few pixels wide, the picture of
the whole marker still is its drawing, blurred and lit. Gauss-Newton finds the
homography together with the light and the blur. What does not look like the drawing then, cell
by cell, is not the marker.

The increment p of the homography H in a round is H (1 + P), with P's terms in the order
of its rows and its last one 0. Coordinates are the marker's own, see
`perchctl.vision.markers.corners`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.values import replace
from perchctl.vision.lens import distort, undistort_px
from perchctl.vision.markers.corners import UNIT, corner_jacobian, from_unit, mapped
from perchctl.vision.markers.pattern import (
    EDGE,
    Drawing,
    sheets,
    soft_cells,
    softened,
    square,
)
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


# --- How much the picture looks like a drawing that was fitted to it ---------------------------


@dataclass(frozen=True)
class PatternSeen:
    """Correlation and height of the inner pattern, beyond what a plain square explains."""

    correlation: float
    strength: float


def pattern_seen(drawing: Rendered, grey: Array, light: Light) -> PatternSeen:
    """In the picture's grey values (n * n,): what no plain square explains of them."""
    plain = drawing.plain
    A = plain.products + 1e-9 * np.eye(len(plain.products))
    both = light.rows[GAIN], grey
    b = np.stack([onto(plain.rows, each) for each in both], axis=1)
    shares = np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    bits, seen = (each - mixed(plain.rows, shares[:, k]) for k, each in enumerate(both))
    energy, product = float((bits * bits).sum()), float((bits * seen).sum())
    scale = math.sqrt(energy * float((seen * seen).sum()))
    if scale < 1e-9:
        return PatternSeen(0.0, 0.0)
    return PatternSeen(product / scale, product / max(energy, 1e-9) / light.gain)


def likeness(grey: Array, error: Array) -> float:
    """Correlation of the picture with the fit that leaves `error` over."""
    spread = grey - grey.mean()
    explained = 1.0 - float((error**2).sum()) / max(float((spread**2).sum()), 1e-9)
    return math.sqrt(max(explained, 0.0))


def repeated(error: Array) -> float:
    """How many neighbouring nodes measure the same: from the correlation along rows and
    columns (n, n) of what is left (nodes closer than a pixel; blur that is not round)."""
    energy = max(float((error * error).mean()), 1e-9)
    factor = 1.0
    for a, b in ((error[1:], error[:-1]), (error[:, 1:], error[:, :-1])):
        r = min(max(float((a * b).mean()) / energy, 0.0), 0.9)
        factor *= (1.0 + r) / (1.0 - r)
    return factor


def worst_cell(error: Array, grid: Grid, n_cells: int) -> float:
    """Largest mean departure over a cell."""
    index, count = _cells_of(grid, n_cells)
    total = np.bincount(index, weights=error, minlength=n_cells**2 + 1)[:-1]
    return float(np.abs(total / count).max())


@lru_cache(maxsize=32)
def _cells_of(grid: Grid, n_cells: int) -> tuple[NDArray[np.intp], Array]:
    """Of each node the cell's number, behind the last one's around the marker, and how many
    nodes each cell has."""
    x, y = ((g + 1.0) * 0.5 * n_cells for g in (grid.u, grid.v))
    inside = (x >= 0) & (x < n_cells) & (y >= 0) & (y < n_cells)
    own = y.astype(np.intp) * n_cells + x.astype(np.intp)
    index = np.where(inside, own, n_cells**2)
    count = np.bincount(index, minlength=n_cells**2 + 1)[:-1]
    return index, np.maximum(count, 1.0)


# --- The light on a marker: what turns its drawing into grey values ----------------------------
# Offset and gain, their slopes over the marker, the bend of the tone curve (clipped white,
# gamma) and the grey beyond the sheet. All of them shift edges if left out.


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


# --- A grid over a marker in its own coordinates, and the picture read at its nodes ------------


_FEW = 9  # a side


@dataclass(frozen=True, eq=False)
class Grid:
    """n by n nodes, `axis` (n,) in both directions; u, v and 1 of each node, (3, n * n)."""

    n: int
    axis: Array
    uv1: Array

    @property
    def u(self) -> Array:
        u: Array = self.uv1[0]
        return u

    @property
    def v(self) -> Array:
        v: Array = self.uv1[1]
        return v


@dataclass(frozen=True, eq=False)
class Patch:
    """A part of the picture: its grey values and its first pixel (x, y)."""

    grey: NDArray[np.float32]
    first: NDArray[np.intp]


@lru_cache(maxsize=64)
def make_grid(n: int, reach: float) -> Grid:
    """Nodes in the middle of n by n equal parts of the square from -reach to reach."""
    axis = reach * ((2.0 * np.arange(n) + 1.0) / n - 1.0)
    return Grid(n, axis, _crossings(axis))


def _crossings(axis: Array) -> Array:
    u, v = np.meshgrid(axis, axis)
    return np.stack([u.ravel(), v.ravel(), np.ones(u.size)])


def projected(H: Array, uv1: Array) -> Array:
    """Own coordinates (3, n) through a homography to pinhole pixels, x and y (2, n)."""
    q = H.dot(uv1)
    return np.asarray(q[:2] / q[2])


def through_lens(pin_px: Array, camera: CameraModel) -> Array:
    """Pinhole pixels (2, n) to pixels of the real lens."""
    K = camera.K
    rays = np.empty((pin_px.shape[1], 2))
    rays[:, 1] = (pin_px[1] - K[1, 2]) / K[1, 1]
    rays[:, 0] = (pin_px[0] - K[0, 2] - K[0, 1] * rays[:, 1]) / K[0, 0]
    return distort(rays, camera).T


def lens_shift_px(grid: Grid, H: Array, camera: CameraModel) -> Array:
    """How far the lens moves each node that is seen through H, (2, n * n). A lens moves
    neighbours alike: it is computed for a few nodes, and the rest by the polynomial through
    these."""
    uv1, between = _few(grid)
    pin = projected(H, uv1)
    shift = (through_lens(pin, camera) - pin).reshape(2, _FEW, _FEW)
    return np.asarray((between @ shift @ between.T).reshape(2, -1))


@lru_cache(maxsize=64)
def _few(grid: Grid) -> tuple[Array, Array]:
    """Chebyshev's nodes over the grid (3, _FEW^2), and the weights (n, _FEW) that a row's nodes
    give to its values there."""
    reach = float(grid.axis[-1])
    x = chebyshev.chebpts2(_FEW)
    degree = _FEW - 1
    through = np.linalg.inv(chebyshev.chebvander(x, degree))
    return _crossings(reach * x), chebyshev.chebvander(grid.axis / reach, degree) @ through


def patch_around(image: NDArray[np.uint8], grid: Grid, H: Array, lens_px: Array) -> Patch | None:
    """The part of the picture that the nodes may reach, None where they leave it."""
    h, w = image.shape
    x, y = projected(H, grid.uv1) + lens_px
    least, most = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    if not (least.min() >= -1.0 and (most <= (w, h)).all()):
        return None
    room = 0.15 * float((most - least).max()) + 3.0
    low = np.clip(least - room, 0, (w - 2, h - 2)).astype(np.intp)
    high = np.clip(most + room + 1.0, low + 2, (w, h)).astype(np.intp)
    return Patch(image[low[1] : high[1], low[0] : high[0]].astype(np.float32), low)


def read(patch: Patch, grid: Grid, H: Array, offset_px: Array) -> Array:
    """Grey values at the nodes, (n * n,); `offset_px` (2, n * n) is the lens's shift less the
    patch's first pixel."""
    at = (projected(H, grid.uv1) + offset_px).astype(np.float32)
    x, y = at.reshape(2, grid.n, grid.n)
    grey = cv2.remap(patch.grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, dtype=np.float64).ravel()


# --- Products of long rows, a value for each node of a square grid -----------------------------
# They are taken block by block: large products wake threads, which cost more than they
# save, and far more on a busy machine.


_BLOCK = 256  # values of a row


@dataclass(frozen=True, eq=False)
class Basis:
    """Rows (k, n) by which pictures are explained, and their products (k, k)."""

    rows: Array
    products: Array


def make_basis(rows: Array) -> Basis:
    return Basis(rows, gram(rows))


def gram(rows: Array) -> Array:
    """Products (k, k) of rows (k, n) with each other."""
    k, n = rows.shape
    whole = n - n % _BLOCK
    blocks = rows[:, :whole].reshape(k, -1, _BLOCK).transpose(1, 0, 2)
    rest = rows[:, whole:]
    total = np.matmul(blocks, blocks.transpose(0, 2, 1)).sum(axis=0)
    return np.asarray(total + rest.dot(rest.T))


def onto(rows: Array, values: Array) -> Array:
    """Products (k,) of the rows (k, n) with values (n,)."""
    return np.asarray(np.einsum("kn,n->k", rows, values))


def mixed(rows: Array, coefficients: Array) -> Array:
    """The rows (k, n) times coefficients (k,)."""
    return np.asarray(np.einsum("kn,k->n", rows, coefficients))


# --- A marker's drawing at the nodes of a grid, blurred, with all that follows from that alone ---
# From picture to picture a marker's size and blur hardly change, so blur comes in steps, finer than
# anything that a fit can tell, and what belongs to one is kept.


_STEP = 0.02  # of the blur
# Rows of the light: offset and its slopes, gain and its slopes, bend, what is beyond the sheet.
OFFSET, OFFSET_U, OFFSET_V, GAIN, GAIN_U, GAIN_V, BEND, BEYOND = range(8)


@dataclass(frozen=True, eq=False)
class Rendering:
    """A sheet at the nodes (n * n,) with its changes (9, n * n) with the eight terms of
    a homography's increment and with the blur's square."""

    value: Array
    jacobian: Array


@dataclass(frozen=True, eq=False)
class Rendered:
    """The drawing's sheets, blurred by `sigma` nodes: the paper, and perhaps what is beyond it."""

    drawing: Drawing
    grid: Grid
    sigma: float

    @cached_property
    def sheets(self) -> tuple[Rendering, ...]:
        sharp = sheets(self.drawing, self.grid.n)
        return tuple(_blurred(each, self.sigma, self.grid.axis) for each in sharp)

    @cached_property
    def light(self) -> Basis:
        """What light makes of the drawing: rows (7 or 8, n * n), the last one only with a
        sheet's end."""
        u, v, white = self.grid.u, self.grid.v, self.sheets[0].value
        rows = [np.ones_like(u), u, v, white, white * u, white * v, white * (1.0 - white)]
        return make_basis(np.stack(rows + [sheet.value for sheet in self.sheets[1:]]))

    @cached_property
    def plain(self) -> Basis:
        """What light makes of a black square of the drawing's size, without its slopes and
        bend: rows (4 or 5, n * n)."""
        soft = softened(square(len(self.drawing.cells), self.grid.n), self.sigma)
        black = soft[EDGE:-EDGE, EDGE:-EDGE].reshape(1, -1)
        rows = self.light.rows
        return make_basis(np.concatenate([rows[:GAIN], black, rows[BEYOND:]]))

    @cached_property
    def soft_cells(self) -> Array:
        """Share of each row (or column) of cells in each node, (n, cells)."""
        half_node = self.drawing.reach / self.grid.n
        return soft_cells(self.drawing, self.grid.axis, half_node, self.sigma)


def rendered(drawing: Drawing, n: int, sigma: float) -> Rendered:
    """At n by n nodes over the drawing's reach, blurred by about `sigma` nodes."""
    return _rendered_at_step(drawing, n, round(math.log(sigma) / _STEP))


@lru_cache(maxsize=16)
def _rendered_at_step(drawing: Drawing, n: int, step: int) -> Rendered:
    return Rendered(drawing, make_grid(n, drawing.reach), math.exp(_STEP * step))


def _blurred(sharp: NDArray[np.float32], sigma: float, axis: Array) -> Rendering:
    """A sheet blurred by sigma nodes, and its changes, per unit of the drawing."""
    soft = softened(sharp, sigma)
    step = float(axis[1] - axis[0])
    e, n = EDGE, len(axis)
    middle = slice(e, e + n)
    left, right = soft[middle, e - 1 : e + n - 1], soft[middle, e + 1 : e + n + 1]
    up, down = soft[e - 1 : e + n - 1, middle], soft[e + 1 : e + n + 1, middle]
    value = soft[middle, middle]
    du, dv = np.float32(0.5 / step) * (right - left), np.float32(0.5 / step) * (down - up)
    laplace = left + right + up + down - 4.0 * value
    u, v = axis.astype(np.float32), axis.astype(np.float32)[:, None]
    along = u * du + v * dv
    changes = np.empty((9, n, n))
    for part, one, other in (
        (0, u, du), (1, v, du), (3, u, dv), (4, v, dv), (6, -u, along), (7, -v, along),
    ):  # fmt: skip
        np.multiply(-one, other, out=changes[part])
    changes[2], changes[5], changes[8] = -du, -dv, 0.5 * laplace
    return Rendering(value.ravel().astype(np.float64), changes.reshape(9, n * n))
