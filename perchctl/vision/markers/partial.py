"""Partial-view fit: measure a marker that is partly invisible because the picture ends in it, light
glares on it, or the vehicle's own gear covers it.

Four lines need all four sides. Here, the whole square is fitted at once to the visible edges: its
sides, and the inner edges of its border, which replace a missing side. Gauss-Newton finds the
increment P of the homography H and the shift d of all edges (white over black) from the distances
r_k, px, between the square's edges and the picture's:

    min sum w_k (r_k - a_k.P - s_k d)^2 + (d - d_0)^2 / sigma_d^2,    H <- H (I + P)

where a_k is the derivative of an edge by P, s_k is -1 for sides and +1 for inner edges, and d_0 is
the shift measured before. The invisible part follows from the visible one; the corners' covariance
(8, 8) px^2, J N^-1 J' times the variance of an edge, says how accurately.

The result is wrong if the boundary of a glare or a shadow runs along a side and is mistaken for it.
It is None if the edges leave a corner with a standard deviation above 2 % of the side, or if the
cells in view are not the marker's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.lens import distort, pinhole_px, undistort, undistort_px
from perchctl.vision.markers.corners import (
    BEFORE,
    NEXT,
    OUT,
    UNIT,
    RefinedCorners,
    apply_homography,
    doubled_area,
    homography_from_unit,
    homography_jacobian,
    increment_homography,
    mean_side_px,
    side_lengths_px,
    within,
)
from perchctl.vision.markers.detector import Picture, is_hidden
from perchctl.vision.markers.edge_fit import (
    MIN_LINE_SIGMA_PX,
    PROFILES,
    STEPS,
    Floats,
    NeighbourEdges,
    locate_edges,
    neighbour_edges,
    profile_places,
    profile_reaches_px,
    sample_profiles,
    shift_prior_px,
    side_profiles,
)
from perchctl.vision.markers.pattern import CELL_MARGIN, MIN_CONTRAST, MOST_CELLS, Pattern
from perchctl.vision.types import CameraModel, EdgeShift, MarkerName

LEAST_CELL_PX = 4.0  # with smaller cells, a part of a side contains no information
_PART_ROUNDS, _PART_STILL_PX = 5, 0.05
_MAX_RESIDUAL_PX = 0.6
_MAX_BLUR = 0.9  # share of the window
_MOST_PART_SIGMA = 0.02  # share of the side: less certain corners are no measurement
_LEAST_SHIFT_SIGMA_PX = 0.01
_TAILS = 1.3  # compensates the reduction of squared residuals by robust weights
_MAX_STEP = 0.5
_MOST_OFF_PX = 20.0  # from the start, three windows away: edges cannot move a fit further


def fit_partly_seen(
    picture: Picture,
    name: MarkerName,
    start_px: Array,
    known_by: KnownBy,
    known: EdgeShift | None = None,
) -> RefinedCorners | None:
    """Fit the whole marker near corners `start_px` (4, 2), which may be outside the picture.

    `known_by` says what identifies the marker; `known` is the shift of all edges, if measured
    before. None if the visible part does not determine the corners, or if its cells are not the
    marker's.
    """
    pattern, camera = picture.setup.patterns[name], picture.camera
    if not mean_side_px(start_px) / pattern.rim.cells >= LEAST_CELL_PX:
        return None
    # Enough cells must be in the picture, wherever the fit may end.
    spots = _within(_spots_px(start_px, pattern, camera), picture.image.shape, _MOST_OFF_PX)
    if not _enough(_known(spots, pattern), pattern, known_by):
        return None
    start = undistort_px(start_px, camera)
    if not np.isfinite(start).all() or side_lengths_px(start).min() < 1.0:
        return None
    H = homography_from_unit(start)
    for k in range(_PART_ROUNDS):
        seen = seen_edges(picture, H, pattern)
        if seen is None:
            return None
        A, N, g = _equations(seen, known or EdgeShift(0.0, shift_prior_px(seen.white_grey)))
        step = np.asarray(np.linalg.solve(N, g), dtype=np.float64)
        p = step[:8]
        if not (np.isfinite(p).all() and np.abs(p).max() < _MAX_STEP):
            return None
        H = increment_homography(H, p)
        if k > 0 and float(np.abs(p[:6]).max() * seen.scale_px.mean()) < _PART_STILL_PX:
            break
    assert seen is not None
    left_px = seen.offset_px - (step @ A).reshape(seen.offset_px.shape)
    found = _corners(H, seen, left_px, N, pattern, camera)
    if found is None or not _cells_agree(picture, found.corners_px, pattern, known_by):
        return None
    return found


def is_wholly_seen(picture: Picture, found: RefinedCorners) -> bool:
    """True if no part of the marker is hidden or outside the picture."""
    room_px = ROOM_PX + found.blur_px
    return within(found.corners_px, picture.image.shape, room_px) and not is_hidden(
        picture.hidden, found.corners_px
    )


def _equations(seen: SeenEdges, prior: EdgeShift) -> tuple[Array, Array, Array]:
    """Return the derivatives (9, rows * n) of the edges by the terms of `homography_jacobian` and
    by the shift of all edges, px; and their normal equations (9, 9), (9,), per px^2 of an edge's
    variance."""
    u, v = seen.points[..., 0], seen.points[..., 1]
    nx, ny = OUT[seen.side].T[..., None] * seen.scale_px[:, None]
    A = np.empty((9, *u.shape))
    A[0], A[1], A[2] = nx * u, nx * v, nx
    A[3], A[4], A[5] = ny * u, ny * v, ny
    across = A[0] + A[4]
    A[6], A[7] = -u * across, -v * across
    # The model's edge moves with the square, the observed edge with the shift.
    A[8] = np.where(seen.side_distance < 1.0, 1.0, -1.0)[:, None]
    A = A.reshape(9, -1)
    # Profiles closer to each other than a pixel measure the same edge.
    worth = np.minimum(1.0, 2.0 * seen.scale_px * seen.side_distance / PROFILES)
    weighted = A * (seen.weight * worth[:, None]).ravel()
    N, g = weighted.dot(A.T), weighted.dot(seen.offset_px.ravel())
    # Until it is known, an edge's standard deviation is assumed to be a tenth of a pixel.
    certain = (0.1 / prior.sigma_px) ** 2
    N[8, 8] += certain
    g[8] += certain * prior.shift_px
    N[range(8), range(8)] += 1e-6
    return A, N, g


def _corners(
    H: Array, seen: SeenEdges, left: Array, N: Array, pattern: Pattern, camera: CameraModel
) -> RefinedCorners | None:
    """Return the corners of the square H (3, 3), with their covariance from the residuals of the
    edges, px (rows, n), and the normal matrix (9, 9); None if the corners are too uncertain."""
    w = seen.weight
    mass = w.sum(axis=1)
    used = mass > 0.0
    if not used.any() or (seen.blur[used] > _MAX_BLUR).any():
        return None
    if float((w * left**2).sum() / w.sum()) > _MAX_RESIDUAL_PX**2:
        return None
    mean = (w * left).sum(axis=1) / np.maximum(mass, 1e-9)
    scatter = float((w * (left - mean[:, None]) ** 2).sum() / w.sum())
    chi2 = float((mean**2 * mass).sum()) / max(scatter, MIN_LINE_SIGMA_PX**2)
    freedom = max(2.0 * np.count_nonzero(used) - 9.0, 1.0)
    noise2 = max(_TAILS * scatter * max(chi2 / freedom, 1.0), MIN_LINE_SIGMA_PX**2)
    pinhole = apply_homography(H, UNIT)
    corners_px = distort(apply_homography(np.asarray(np.linalg.inv(camera.K)), pinhole), camera)
    side_px = mean_side_px(pinhole)
    cell_px = side_px / pattern.rim.cells
    # The square alone; `shift_sigma_px` covers the uncertainty of the shift of all edges.
    J = homography_jacobian(H)
    cov_px2: Array = J @ np.linalg.inv(N[:8, :8]) @ J.T * noise2
    floor2 = MIN_LINE_SIGMA_PX**2 + (pattern.rim.tolerance * cell_px) ** 2
    cov_px2 = cov_px2 + np.eye(8) * (floor2 + 0.25 * np.exp(cell_px * (-2.0 / 1.8)))
    vaguest_px = math.sqrt(float(np.diagonal(cov_px2).max()))
    if not (vaguest_px < _MOST_PART_SIGMA * side_px and np.isfinite(corners_px).all()):
        return None
    shift_sigma_px = math.sqrt(noise2 * float(np.linalg.inv(N)[8, 8]))
    return RefinedCorners(
        corners_px=corners_px,
        sigma_px=math.sqrt(float(np.trace(cov_px2)) / 8.0),
        refined=True,
        shift_sigma_px=min(
            max(shift_sigma_px, _LEAST_SHIFT_SIGMA_PX), shift_prior_px(seen.white_grey)
        ),
        cov_px2=cov_px2,
    )


# --- Identify a marker from its visible cells ---


KnownBy = Literal["bits", "track", "other"]
"""What identifies a marker: its cells alone, its previous position, or the other marker."""
_LEAST_KNOWN = 0.6  # share of all cells
# above white, as a share of the contrast; as bright as possible
_GLARE, _BRIGHTEST_GREY = 0.25, 250.0
_UNKNOWN_BITS: dict[KnownBy, int] = {"bits": 1, "track": 4}  # other codewords differ in two bits
_INVERTED_PX = 0.5  # the lens model is valid where its inverse exists


def _cells_agree(picture: Picture, corners_px: Array, pattern: Pattern, known_by: KnownBy) -> bool:
    """True if the visible cells without glare have their colours; `known_by` decides how many
    must."""
    image, hidden = picture.image, picture.hidden
    h, w = image.shape
    at = _spots_px(corners_px, pattern, picture.camera)
    near = np.rint(np.clip(np.nan_to_num(at), 0.0, (w - 1, h - 1))).astype(np.intp)
    seen = _within(at, image.shape, 0.0)
    if hidden is not None:
        seen &= ~hidden[near[:, 1], near[:, 0]]
    grey = image[near[:, 1], near[:, 0]].astype(np.float64)
    white_spots = pattern.is_white[pattern.spot_cells]
    if not ((seen & white_spots).any() and (seen & ~white_spots).any()):
        return False
    high = float(np.median(grey[seen & white_spots]))
    low = float(np.median(grey[seen & ~white_spots]))
    contrast = high - low
    if contrast < MIN_CONTRAST:
        return False
    seen &= grey <= high + _GLARE * contrast
    if high < _BRIGHTEST_GREY - _GLARE * contrast:
        seen &= grey < _BRIGHTEST_GREY
    count = np.bincount(pattern.spot_cells, weights=seen)
    means = np.bincount(pattern.spot_cells, weights=grey * seen) / np.maximum(count, 1.0)
    known = _known(seen, pattern)
    share = (means - 0.5 * (high + low)) / contrast * np.where(pattern.is_white, 1.0, -1.0)
    wrong = np.count_nonzero(known & (share < CELL_MARGIN))
    most_wrong = 0
    if known_by == "other":
        most_wrong = math.floor((1.0 - MOST_CELLS) * np.count_nonzero(known & pattern.is_inner))
    return bool(wrong <= most_wrong) and _enough(known, pattern, known_by)


def _spots_px(corners_px: Array, pattern: Pattern, camera: CameraModel) -> Array:
    """Return the spots of a marker with corners (4, 2) in the distorted picture, (n, 2); NaN
    outside the lens model. A marker that fills the picture is not a quadrilateral in it."""
    rays = undistort(corners_px, camera)
    if not np.isfinite(rays).all():
        return np.full((len(pattern.spots), 2), np.nan)
    spots = apply_homography(homography_from_unit(rays), pattern.spots)
    at = distort(spots, camera)
    near = np.abs(undistort(at, camera) - spots).max(axis=1) * camera.K[0, 0] < _INVERTED_PX
    return np.where(near[:, None], at, np.nan)


def _within(at_px: Array, shape: tuple[int, ...], room_px: float) -> NDArray[np.bool_]:
    """Return which points (n, 2) are in the picture, or at most `room_px` outside."""
    h, w = shape[:2]
    inside = (at_px >= -room_px) & (at_px <= (w - 1 + room_px, h - 1 + room_px))
    return np.asarray(inside.all(axis=1))


def _known(seen: NDArray[np.bool_], pattern: Pattern) -> NDArray[np.bool_]:
    """Return which cells (cells,) show at least half of their spots (n,)."""
    known: NDArray[np.bool_] = (
        np.bincount(pattern.spot_cells, weights=seen) >= 0.5 * pattern.spots_per_cell
    )
    return known


def _enough(known: NDArray[np.bool_], pattern: Pattern, known_by: KnownBy) -> bool:
    most_unknown = len(known) if known_by == "other" else _UNKNOWN_BITS[known_by]
    return bool(
        np.count_nonzero(pattern.is_inner & ~known) <= most_unknown
        and np.count_nonzero(known) >= _LEAST_KNOWN * len(known)
    )


# --- The visible edges of a marker: its sides, and the inner edges of its border ---


ROOM_PX = 2.0
"""Distance to the picture's edge, px, within which blur would need pixels outside the picture."""
_INNER_CELL_PX = 6.0  # cell of a border whose inner and outer edges are separate
_TOO_BRIGHT, _TOO_DARK = 0.2, 0.5  # shares of the contrast: black inside, white outside
_LEAST_PART_CONTRAST = 10.0
_MIN_WEIGHT = 3.0  # of a side's profiles
_LEAST_EDGES = 4  # a square has eight unknowns, and an edge determines two
_FAR_PX = 1e6
_SEARCH_STEPS: Array = np.linspace(-1.0, 1.0, STEPS // 2 + 1)[:, None]


@dataclass(frozen=True, eq=False)
class SeenEdges:
    """Edges measured in one round of the fit.

    Per profile (rows, n): point in the marker's coordinates (rows, n, 2), outward offset from the
    square's edge, weight. Per row (rows,): number of the side, distance of the edge from the centre
    in half sides, pixels per half side across it, blur in units of the window. `white_grey` is the
    grey level of white paper.
    """

    points: Array
    offset_px: Array
    weight: Array
    side: NDArray[np.intp]
    side_distance: Array
    scale_px: Array
    blur: Array
    white_grey: float


def seen_edges(picture: Picture, H: Array, pattern: Pattern) -> SeenEdges | None:
    """Return the edges near the square projected by H (3, 3) to pixels; None if too few are
    visible."""
    camera, cells, corners = picture.camera, pattern.rim.cells, apply_homography(H, UNIT)
    sides_px = side_lengths_px(corners)
    if not (np.isfinite(corners).all() and sides_px.min() > 1.0):
        return None
    cell_px = float(sides_px.mean()) / cells
    rings = (1.0, 1.0 - 2.0 / cells) if cell_px > _INNER_CELL_PX else (1.0,)
    at = np.repeat(rings, 4)
    side = np.arange(len(at)) % 4
    to_rays: Array = np.linalg.inv(camera.K) @ H
    starts = np.stack([apply_homography(to_rays, r * UNIT) for r in rings])
    scale_px = (0.25 * (sides_px[BEFORE] + sides_px[NEXT]))[side]
    s = profile_places(sides_px[side] * at)
    ends = starts[:, NEXT].reshape(-1, 2)
    origin, normal = side_profiles(starts.reshape(-1, 2), ends, s, camera)
    if not (np.abs(origin) < _FAR_PX).all():
        return None  # far outside, a lens model may yield any position, even NaN
    # White is outside the marker, and inside its border.
    turn = float(np.sign(doubled_area(corners[None])[0]))
    normal *= (turn * np.where(at < 1.0, -1.0, 1.0))[:, None, None]
    near_px, half_px = profile_reaches_px(np.full(len(at), cell_px))
    depth_px = 2.0 * scale_px / cells
    around = neighbour_edges(s, [pattern.rim], pattern.rim, depth_px)
    free = around.possible & _in_view(picture, origin, normal, near_px)
    kept = np.flatnonzero(np.count_nonzero(free, axis=1) >= _MIN_WEIGHT)
    if len(kept) < _LEAST_EDGES:
        return None
    side, at, scale_px = side[kept], at[kept], scale_px[kept]
    origin, normal, free = origin[kept], normal[kept], free[kept]
    near_px, half_px = near_px[kept], half_px[kept]
    grey = sample_profiles(picture.image, origin, normal, half_px)
    lit = _unspoilt(grey, free, near_px, half_px)
    if lit is None:
        return None
    good, white = lit
    around = NeighbourEdges(depth_px[kept], around.inside[kept], around.outside[kept], good)
    offset_px, weight, blur_px = locate_edges(grey, half_px, near_px, around)
    weight = np.where(good, weight, 0.0)
    weight[weight.sum(axis=1) < _MIN_WEIGHT] = 0.0
    found = undistort((origin + offset_px[..., None] * normal).reshape(-1, 2), camera)
    own = apply_homography(np.asarray(np.linalg.inv(H)), pinhole_px(found, camera)).reshape(
        origin.shape
    )
    if not np.isfinite(own).all():
        return None
    far = np.einsum("rni,ri->rn", own, OUT[side]) - at[:, None]
    return SeenEdges(
        points=own,
        offset_px=far * scale_px[:, None],
        weight=weight,
        side=side,
        side_distance=at,
        scale_px=scale_px,
        blur=blur_px / near_px,
        white_grey=white,
    )


def _in_view(picture: Picture, origin: Array, normal: Array, near_px: Array) -> NDArray[np.bool_]:
    hidden, (h, w) = picture.hidden, picture.image.shape
    # A profile is in the picture if both of its ends are.
    reach, last = near_px[:, None, None] * np.abs(normal), (w - 1 - ROOM_PX, h - 1 - ROOM_PX)
    x_and_y = (origin - reach >= ROOM_PX) & (origin + reach <= last)
    seen = x_and_y[..., 0] & x_and_y[..., 1]
    if hidden is not None and seen.any():
        at = origin[:, :, None] + near_px[:, None, None, None] * _SEARCH_STEPS * normal[:, :, None]
        pixel = np.rint(np.clip(np.nan_to_num(at), 0.0, (w - 1, h - 1))).astype(np.intp)
        seen &= ~hidden[pixel[..., 1], pixel[..., 0]].any(axis=2)
    return np.asarray(seen)


def _unspoilt(
    grey: Floats, free: NDArray[np.bool_], near_px: Array, half_px: Array
) -> tuple[NDArray[np.bool_], float] | None:
    """Return which profiles (rows, n) change from black to white, and the grey level of white
    paper."""
    # At half the window from the edge, blur has ended and no neighbour begins.
    off = max(1, round(0.5 * STEPS * float((0.6 * near_px / half_px)[0])))
    dark, bright = grey[:, :, STEPS // 2 - off], grey[:, :, STEPS // 2 + off]
    black, white = (float(np.median(each[free])) for each in (dark, bright))
    contrast = white - black
    if contrast < _LEAST_PART_CONTRAST:
        return None
    good = (dark < black + _TOO_BRIGHT * contrast) & (bright > white - _TOO_DARK * contrast)
    return free & good, white
