"""A marker's square by the edges of its drawing, to a hundredth of a pixel.

The cells of a marker and the paper around it meet in hundreds of places. At each of them the edge
of the picture is looked for across the drawing's own, along a profile through the lens, and
Gauss-Newton moves the square until both agree. A blur that is equal on both flanks of an edge
does not move it. White that is clipped, glares or went through a gamma curve moves all edges
from white towards black, by the same number of pixels: that shift is an unknown, too.

One fit serves a marker that is wholly seen, one of which the picture's edge, glare or the
vehicle's gear hides a part, and the whole target where the picture cuts both of its markers
(`perchctl.vision.markers.cut`). What is not seen follows from what is, and the covariance says
how well.

The increment p of the homography H in a round is H (1 + P), with P's terms in the order of its
rows and its last one 0. Coordinates are the marker's own, see `perchctl.vision.markers.corners`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array, finite
from perchctl.vision.lens import distort, reach_of, undistort
from perchctl.vision.markers.corners import (
    UNIT,
    RefinedCorners,
    corner_jacobian,
    from_unit,
    mapped,
    mean_side_px,
)
from perchctl.vision.markers.detector import Covered
from perchctl.vision.markers.pattern import Outline, Pattern
from perchctl.vision.types import CameraModel

ROOM_PX = 2.0
"""To the picture's edge, where blur would need what is beyond it."""
INNER_CELL_PX = 5.0
"""Smaller cells blend: of these only the border's outer edge is fitted."""
CLIPPED_GREY = 248.0
CLIPPED_SIGMA_PX = 0.1  # where white is clipped, edges move, not all alike
CLIPPED_SHARE = 0.05  # of the profiles

_STEPS = 16  # gradient samples in each profile
_OFFSETS = np.linspace(-1.0, 1.0, _STEPS + 1).astype(np.float32)
_MIDDLES: Array = 0.5 * (_OFFSETS[1:] + _OFFSETS[:-1]).astype(np.float64)
_REACH_CELLS, _LEAST_REACH_PX = 0.45, 1.75
_FIRST_REACH_CELLS = 0.85  # of the border, beside which the next edge is a cell away
_REACH_PX, _REACH_BLURS = 7.0, 4.0
_CLOSER = 3.0  # times, from round to round, a start that may be far off
_MOST_BLUR = 0.8  # of the window, squared
_WINDOW = 0.45  # sigma, of a profile's reach
_ROUNDS = 8
_STILL_PX, _SETTLED_PX = (
    0.05,
    0.5,
)  # no other round follows: it would move a tenth; without this no fit
_LEAST_CONTRAST, _LEAST_SHARE = 8.0, 0.35  # grey levels; of the upper quarter's
_LEAST_PLACES = 20
_NOISE = 0.25  # of a profile's steepest rise
_TUKEY, _LEAST_SCALE_PX = 3.5, 0.06
_TAILS = 1.3  # what robust weights take away from a residual's square
_MAX_STEP = 0.5
_LEAST_INFORMATION = 1.0  # of an increment: none is larger
_SHIFT_PX, _CLIPPED_SHIFT_PX = 0.15, 0.4  # by which white may have grown over black
_LINE_PX = 0.015  # by which a whole line may be off, of lens and light
_LEAST_ROWS = 2.0  # times the variance of edges along the rows shows that rows shake
_FLOOR_PX = 0.01
_BEND, _BEND_BLURS = 0.6, 2.0  # what the next edge, a cell away, does to one; in units of blur
_REACH = 0.0022  # px for a cubed pixel of blur: profiles are too short for wide edges


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """A square H (3, 3), own coordinates to normalised ones, and what it rests on.

    Attributes:
        cov: covariance (8, 8) of its increment.
        in_view, shown, small: how many places along edges were in view, how many of these
            showed their edge, and how many of those are the small marker's.
        residual_px: spread of a single place.
        blur_px: of the edges, a standard deviation: of the softer and of the sharper direction.
        clipped: share of the profiles that end in clipped white.
    """

    H: Array
    cov: Array
    in_view: int
    shown: int
    small: int
    residual_px: float
    blur_px: tuple[float, float]
    clipped: float


@dataclass(frozen=True, eq=False)
class _View:
    """What a round looks at: the picture, where it is `hidden`, and the outline through the
    square H (3, 3) and its edges' shift so far; how far the profiles reach, and the blur."""

    image: NDArray[np.uint8]
    camera: CameraModel
    hidden: Covered | None
    outline: Outline
    H: Array
    shift_px: float
    reach_px: float
    blur_px: float

    @cached_property
    def cells_px(self) -> Array:
        """Width of the cell at each of the outline's places, if all of them were as far away as
        the centre, (n,)."""
        return self.outline.cell * _scale_px(self.H, self.camera)


@dataclass(frozen=True, eq=False)
class _Places:
    """Of an outline, in the picture: at (n, 2) px and unit normal (n, 2) from black to white,
    changes J (n, 8) along it with the increment, width of a cell there (n,) px, what each is
    worth (n,), and which of the outline's they are (n,)."""

    at: Array
    normal: Array
    J: Array
    cell_px: Array
    worth: Array
    index: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class _Edges:
    """offset_px (n,): each place's edge along its normal; which show one, (n,); the blur's
    square of each direction (2,), px^2, and the share of profiles that end in clipped white."""

    offset_px: Array
    shows: NDArray[np.bool_]
    blur2: Array
    clipped: float


@dataclass(frozen=True, eq=False)
class _Round:
    """The step of all unknowns (9,), the inverse of their normal matrix, the places' weights
    (n,), changes J (n, 9) and errors left (n,) px, and the variance of one place, px^2."""

    step: Array
    inverse: Array
    weight: Array
    J: Array
    error: Array
    variance: float


def fit_edges(
    image: NDArray[np.uint8],
    start: Array,
    outline: Outline,
    camera: CameraModel,
    hidden: Covered | None = None,
    prior: Array | None = None,
    off_px: float = _REACH_PX,
) -> EdgeFit | None:
    """The square whose edges are the picture's, from one a few pixels off.

    Args:
        start: own coordinates to normalised ones, (3, 3).
        hidden: (h, w), where pixels show something else.
        prior: information (8, 8) about the sum of all increments; None: nothing is known.
        off_px: how far the start may be off.

    None where too few edges are in view, or the fit breaks down.
    """
    H, total, shift_px, blur_px = start, np.zeros(8), 0.0, math.inf
    known = np.zeros((8, 8)) if prior is None else prior
    for k in range(_ROUNDS):
        reach_px = max(off_px / _CLOSER**k, _REACH_PX)
        view = _View(image, camera, hidden, outline, H, shift_px, reach_px, blur_px)
        # Where the next edge is nearer than the start may be off, the border leads.
        leads = k == 0 and off_px > _REACH_CELLS * float(view.cells_px.min())
        seen = (_look(view, leads=True) if leads else None) or _look(view, leads=False)
        if seen is None:
            return None
        places, edges = seen
        blur_px = math.sqrt(float(edges.blur2.max()))
        found = _solved(places, edges, known, total, shift_px, first=k == 0)
        if found is None:
            return None
        p = found.step[:8]
        H = H @ np.array([[1 + p[0], p[1], p[2]], [p[3], 1 + p[4], p[5]], [p[6], p[7], 1.0]])
        H /= H[2, 2]
        total, shift_px = total + p, shift_px + float(found.step[8])
        moved_px = float(np.abs(places.J @ p).max())
        still = moved_px < _STILL_PX and k > 0 and reach_px == _REACH_PX
        if still or (k == _ROUNDS - 1 and moved_px < _SETTLED_PX):
            return _fit(H, found, edges, places, outline, known)
    return None


def _look(view: _View, leads: bool) -> tuple[_Places, _Edges] | None:
    """The edges at the places in view, all of them or the border's that `leads`; None where too
    few are shown."""
    places = _in_view(view, leads)
    if len(places.index) < _LEAST_PLACES:
        return None
    # Not to the next edge, nor beyond the blur.
    cells = _FIRST_REACH_CELLS if leads else _REACH_CELLS
    half_px = np.minimum(view.reach_px, cells * places.cell_px)
    if view.reach_px == _REACH_PX:
        half_px = np.minimum(half_px, _REACH_BLURS * view.blur_px)
    half_px = np.maximum(half_px, _LEAST_REACH_PX)
    edges = (_rises if leads else _offsets)(view, places, half_px)
    return (places, edges) if np.count_nonzero(edges.shows) >= _LEAST_PLACES else None


def _fit(
    H: Array, found: _Round, edges: _Edges, places: _Places, outline: Outline, known: Array
) -> EdgeFit:
    shown = found.weight > 0.0
    blurs_px = np.sqrt(edges.blur2)
    return EdgeFit(
        H=H,
        cov=_covariance(found, places, outline, known),
        in_view=len(shown),
        shown=int(np.count_nonzero(shown)),
        small=int(np.count_nonzero(shown & outline.small[places.index])),
        residual_px=math.sqrt(found.variance),
        blur_px=(float(blurs_px.max()), float(blurs_px.min())),
        clipped=edges.clipped,
    )


def foreseen(H: Array, outline: Outline, camera: CameraModel, prior: Array) -> EdgeFit | None:
    """What `fit_edges` would make of a picture without a flaw of that square."""
    blank = np.zeros(camera.size_px[::-1], np.uint8)
    places = _in_view(_View(blank, camera, None, outline, H, 0.0, _REACH_PX, 1.0), leads=False)
    n = len(places.index)
    if n < _LEAST_PLACES:
        return None
    edges = _Edges(np.zeros(n), np.ones(n, np.bool_), np.ones(2), 0.0)
    found = _solved(places, edges, prior, np.zeros(8), 0.0, first=True)
    return None if found is None else _fit(H, found, edges, places, outline, prior)


def _in_view(view: _View, leads: bool) -> _Places:
    """The places at which a whole profile is in the picture, and not hidden; only the border's
    where it `leads`, or where cells are small."""
    H, outline, camera, hidden = view.H, view.outline, view.camera, view.hidden
    (h, w), reach_px = view.image.shape, view.reach_px
    at = outline.at @ H[:, :2].T + H[:, 2]
    d = at[:, 2]
    chosen = d > 0.05 * H[2, 2]
    rays = at[:, :2] / np.where(chosen, d, 1.0)[:, None]
    chosen &= np.hypot(rays[:, 0], rays[:, 1]) < reach_of(camera)
    chosen &= outline.border if leads else outline.border | (view.cells_px > INNER_CELL_PX * d)
    index = np.flatnonzero(chosen)
    rays, d, across = rays[index], d[index], outline.normal[index]
    # How a place moves with its own coordinates, as if the lens did not bend: that is enough for
    # the way to look and for a step that is followed by another.
    by_u, by_v = ((H[:2, k] - rays * H[2, k]) * _focal(camera) / d[:, None] for k in (0, 1))
    tangent = by_v * across[:, :1] - by_u * across[:, 1:]
    length = np.maximum(np.hypot(tangent[:, 0], tangent[:, 1]), 1e-12)
    normal = np.stack([tangent[:, 1], -tangent[:, 0]], axis=1) / length[:, None]
    px = (normal * (by_u * across[:, :1] + by_v * across[:, 1:])).sum(axis=1)
    normal *= np.sign(px)[:, None]
    px = np.abs(px)
    at = distort(rays, camera)
    # From far off a place counts that is in the picture, later one that is with all its profile.
    room_px = np.minimum(reach_px, _FIRST_REACH_CELLS * outline.cell[index] * px)
    room_px = np.where(reach_px > _REACH_PX, ROOM_PX, room_px)
    room = room_px[:, None] * np.abs(normal) + 1.0
    free = ((at >= room) & (at <= np.array([w - 1.0, h - 1.0]) - room)).all(axis=1)
    if hidden is not None:
        for way in (-1.0, -0.5, 0.0, 0.5, 1.0):
            x, y = np.rint(at + way * reach_px * normal).T
            x, y = np.clip(x, 0, w - 1).astype(np.intp), np.clip(y, 0, h - 1).astype(np.intp)
            free &= ~hidden[y, x]
    index, px = index[free], px[free]
    return _Places(
        at=at[free],
        normal=normal[free],
        J=outline.J[index] * px[:, None],
        cell_px=outline.cell[index] * px,
        # Profiles nearer to each other than a pixel measure the same.
        worth=np.minimum(1.0, outline.spacing[index] * length[free]),
        index=index,
    )


def _focal(camera: CameraModel) -> Array:
    return np.array([camera.K[0, 0], camera.K[1, 1]])


def _rises(view: _View, places: _Places, half_px: Array) -> _Edges:
    """Where the edges are, roughly, by the middle of all that rises along profiles that reach far:
    what falls there is the next edge."""
    grey = _sample(view.image, places.at, places.normal, half_px)
    rise = np.maximum(np.diff(grey, axis=1).astype(np.float64), 0.0)
    rise *= rise > _NOISE * rise.max(axis=1, keepdims=True)
    total = rise.sum(axis=1)
    shows = total > _least_contrast(total)
    total = np.where(shows, total, 1.0)
    u = half_px[:, None] * _MIDDLES
    offset_px = (rise * u).sum(axis=1) / total
    spread2 = (rise * (u - offset_px[:, None]) ** 2).sum(axis=1) / total
    blur2 = _median(spread2[shows]) if shows.any() else 1.0
    return _Edges(offset_px, shows, np.array([blur2, blur2]), 0.0)


def _least_contrast(contrast: Array) -> float:
    """What an edge must have of the grey levels of those that have most."""
    quarter = 3 * len(contrast) // 4
    return max(_LEAST_CONTRAST, _LEAST_SHARE * float(np.partition(contrast, quarter)[quarter]))


def _offsets(view: _View, places: _Places, half_px: Array) -> _Edges:
    """Where the edges are, by the centroid of the gradient under a window around the place where
    the square and the shift so far have them."""
    shifted = places.at - view.shift_px * places.normal
    grey = _sample(view.image, shifted, places.normal, half_px)
    gradient = np.diff(grey, axis=1).astype(np.float64)
    u = half_px[:, None] * _MIDDLES
    window2 = (_WINDOW * half_px) ** 2
    mass = gradient * np.exp(-0.5 * u * u / window2[:, None])
    total = mass.sum(axis=1)
    contrast = grey[:, -1].astype(np.float64) - grey[:, 0]
    least = _least_contrast(contrast)
    shows = (contrast > least) & (total > 0.25 * least)
    total = np.where(shows, total, 1.0)
    centroid = (mass * u).sum(axis=1) / total
    moment = (mass * (u - centroid[:, None]) ** 2).sum(axis=1) / total
    # The second moment under a Gaussian window w gives 1/m2 = 1/blur^2 + 1/w^2.
    moment = np.clip(moment, 0.01, _MOST_BLUR * window2)
    each2 = moment * window2 / (window2 - moment)
    lying = np.abs(places.normal[:, 1]) > np.abs(places.normal[:, 0])
    both = [each2[shows & way] for way in (lying, ~lying)]
    blur2 = np.array([_median(each) if len(each) else 1.0 for each in both])
    # The window pulls the centroid towards its own middle: undo that.
    pull = 1.0 + np.where(lying, blur2[0], blur2[1]) / window2
    offset_px = np.clip(centroid * pull, -half_px, half_px) - view.shift_px
    return _Edges(offset_px, shows, blur2, float(np.mean(grey[:, -1] > CLIPPED_GREY)))


def _sample(
    image: NDArray[np.uint8], at: Array, normal: Array, half_px: Array
) -> NDArray[np.float32]:
    """Grey values along profiles, (n, steps + 1): bilinear, the picture's rim repeated outside.

    On float pictures OpenCV 5 interpolates at the exact position; on bytes, other
    releases round it to 1/32 px, which is as large as the spread that is aimed at.
    """
    h, w = image.shape
    reach = float(half_px.max()) + 2.0
    (x0, y0), (x1, y1) = at.min(axis=0).tolist(), at.max(axis=0).tolist()
    left, top = min(max(int(x0 - reach), 0), w - 2), min(max(int(y0 - reach), 0), h - 2)
    right, bottom = min(int(x1 + reach) + 1, w), min(int(y1 + reach) + 1, h)
    patch = image[top : max(bottom, top + 2), left : max(right, left + 2)].astype(np.float32)
    way = (half_px[:, None] * normal).astype(np.float32)
    x = (at[:, :1] - left).astype(np.float32) + way[:, :1] * _OFFSETS
    y = (at[:, 1:] - top).astype(np.float32) + way[:, 1:] * _OFFSETS
    grey = cv2.remap(patch, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(grey, dtype=np.float32)


def _solved(
    places: _Places, edges: _Edges, known: Array, total: Array, shift_px: float, first: bool
) -> _Round | None:
    """A robust step of the square and of the common shift of edges (white over black)."""
    offset_px, shows = edges.offset_px + shift_px, edges.shows
    J = np.concatenate([places.J, -np.ones((len(offset_px), 1))], axis=1)
    prior, pull = np.zeros((9, 9)), np.zeros(9)
    prior[:8, :8], pull[:8] = known, -known @ total
    shift_prior = _shift_prior(edges)
    prior[8, 8], pull[8] = shift_prior, -shift_prior * shift_px
    prior[range(8), range(8)] += _LEAST_INFORMATION
    worth = places.worth * shows
    weight, error = worth, offset_px
    # At first errors show where the square is, not which places are wrong.
    for robust in (not first, True):
        if robust:
            size = np.abs(error)
            scale = max(1.4826 * _median(size[shows]), _LEAST_SCALE_PX)
            weight = worth * np.maximum(1.0 - (size / (_TUKEY * scale)) ** 2, 0.0) ** 2
        mass = float(weight.sum())
        if mass < 0.5 * _LEAST_PLACES * float(worth.max()):
            return None
        variance = max(_TAILS * float(weight @ error**2) / mass, 1e-4)
        weighed = (J * weight[:, None]).T
        try:
            inverse = np.linalg.inv(weighed @ J / variance + prior)
        except np.linalg.LinAlgError:
            return None
        step = inverse @ (weighed @ offset_px / variance + pull)
        error = offset_px - J @ step
    if not (finite(step) and np.abs(step[:8]).max() < _MAX_STEP):
        return None
    return _Round(step, inverse, weight, J, error, variance)


def _median(values: Array) -> float:
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _shift_prior(edges: _Edges) -> float:
    sigma_px = _CLIPPED_SHIFT_PX if edges.clipped > CLIPPED_SHARE else _SHIFT_PX
    return 1.0 / sigma_px**2


def _covariance(found: _Round, places: _Places, outline: Outline, known: Array) -> Array:
    """Of the increment (8, 8): of each place's own noise, of what moves a line as a whole, and
    of what was known before."""
    J, w, variance = found.J, found.weight, found.variance
    line = outline.line[places.index]
    by_line = np.zeros((int(line.max()) + 1, 9))
    np.add.at(by_line, line, J * (w * _LINE_PX)[:, None])
    middle = variance * (J * w[:, None]).T @ J + by_line.T @ by_line
    row_px = _row_px(found, places)
    if row_px > 0.0:
        row = places.at[:, 1].astype(np.intp)
        by_row = np.zeros((int(row.max()) + 1, 9))
        np.add.at(by_row, row, J * (w * row_px * places.normal[:, 0])[:, None])
        middle += by_row.T @ by_row
    prior = np.zeros((9, 9))
    prior[:8, :8], prior[8, 8] = known, _SHIFT_PX**-2.0
    cov = found.inverse @ (middle / variance**2 + prior) @ found.inverse
    return np.asarray(cov[:8, :8])


def _row_px(found: _Round, places: _Places) -> float:
    """Spread of what shakes a picture's rows, each along itself, as an analogue link does: it
    moves the edges across a row, all of them alike, and those along it not. 0 where the errors of
    both do not show it."""
    upright, squared = places.normal[:, 0] ** 2, found.error**2
    across, along = (
        float(w @ squared) / max(float(w.sum()), 1e-9)
        for w in (found.weight * upright, found.weight * (1.0 - upright))
    )
    return math.sqrt(across - along) if across > _LEAST_ROWS * max(along, 1e-6) else 0.0


def _scale_px(H: Array, camera: CameraModel) -> float:
    """Pixels for a unit at the centre of a square H (3, 3)."""
    scale = 0.5 * (math.hypot(*H[:2, 0]) + math.hypot(*H[:2, 1])) / abs(float(H[2, 2]))
    return scale * float(camera.K[0, 0])


# --- One marker by its edges -------------------------------------------------------------------


_MAX_RESIDUAL_PX = 0.6
_MIN_SHOWN, _MIN_SHOWN_PARTLY = 0.75, 0.6  # of the places in view
_MIN_CELL_PX, _LEAST_PARTLY_CELL_PX = 1.5, 4.0
_MAX_SIGMA = 0.02  # of the side: vaguer corners are no measurement
_MOST_OFF_PX = 20.0  # of a part of a marker from its start: no edges lead a fit farther


def refine_by_edges(
    image: NDArray[np.uint8],
    start_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    hidden: Covered | None = None,
    partly: bool = False,
) -> RefinedCorners | None:
    """The marker near to corners `start_px` (4, 2); with `partly` some of it may be outside of
    the picture, or `hidden` (h, w).

    None where these are no edges of such a marker, or what is seen of them does not determine
    its corners. Nothing is said about its cells.
    """
    start = undistort(start_px, camera)
    cell_px = mean_side_px(start_px) / pattern.cells
    if not finite(start) or not cell_px > (_LEAST_PARTLY_CELL_PX if partly else _MIN_CELL_PX):
        return None
    found = fit_edges(image, from_unit(start), pattern.outline, camera, hidden if partly else None)
    least = _MIN_SHOWN_PARTLY if partly else _MIN_SHOWN
    if (
        found is None
        or found.residual_px > _MAX_RESIDUAL_PX
        or found.shown < least * found.in_view
        or found.blur_px[0] > 0.9 * max(cell_px, 1.5)
    ):
        return None
    refined = corners_of(found, 1.0, pattern, camera, whole=not partly)
    if refined is None:
        return None
    off_px = float(np.hypot(*(refined.corners_px - start_px).T).max())
    if partly:
        assert refined.cov_px2 is not None
        vaguest_px = math.sqrt(float(np.diagonal(refined.cov_px2).max()))
        near = off_px < _MOST_OFF_PX and vaguest_px < _MAX_SIGMA * mean_side_px(start_px)
    else:
        near = off_px < max(1.6, 0.6 * cell_px)
    return refined if near else None


def corners_of(
    found: EdgeFit, half: float, pattern: Pattern, camera: CameraModel, whole: bool
) -> RefinedCorners | None:
    """The corners of the marker of that half side, with their covariance in pixels of a
    pinhole; None where one is beside or behind the camera."""
    if (found.H[2, :2] @ (half * UNIT).T + found.H[2, 2]).min() <= 0.0:
        return None
    corners_px = distort(mapped(found.H, half * UNIT), camera)
    J = corner_jacobian(camera.K @ found.H, half)
    blur_px = max(found.blur_px[0], 1e-3)
    cell_px = 2.0 * half * _scale_px(found.H, camera) / pattern.cells
    bend_px = 0.0
    if cell_px < INNER_CELL_PX * 2.0:
        bend_px = _BEND * blur_px * math.exp(-cell_px / (_BEND_BLURS * blur_px))
    clipped_px = CLIPPED_SIGMA_PX if found.clipped > CLIPPED_SHARE else 0.0
    floor_px = math.hypot(_FLOOR_PX, bend_px, _REACH * blur_px**3, clipped_px)
    cov_px2 = J @ found.cov @ J.T + floor_px**2 * np.eye(8)
    variance_px2 = float(np.trace(cov_px2)) / 8.0
    if not (finite(corners_px) and finite(cov_px2) and variance_px2 > 0.0):
        return None
    return RefinedCorners(
        corners_px=corners_px,
        sigma_px=math.sqrt(variance_px2),
        refined=True,
        blur_px=found.blur_px,
        cov_px2=cov_px2,
        whole=whole,
    )
