"""Rotation and translation from corners: closed forms, then least squares in which each
corner counts as it was measured.

Corners that are intersections of fitted lines do not err on their own: a line is off
by an offset and a tilt, and moves the corners at both of its ends. Its two ends have
errors across it of variance s^2 with a correlation of -1/2, so half the line's offset
is known to s/2 and its tilt to s sqrt(3)/2. `whitening` turns corner errors into these
independent ones. A shift of all edges by the same number of pixels (clipped white, ink)
is left out of the fit, where small markers' own faults would feed it, but not out of the
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from perchctl.geometry import Array, finite
from perchctl.vision.types import Detection

Solver = Literal["sqpnp", "iterative", "epnp", "ippe", "ippe_square"]

_FLAGS = {
    "sqpnp": cv2.SOLVEPNP_SQPNP,
    "iterative": cv2.SOLVEPNP_ITERATIVE,
    "epnp": cv2.SOLVEPNP_EPNP,
    "ippe": cv2.SOLVEPNP_IPPE,
    "ippe_square": cv2.SOLVEPNP_IPPE_SQUARE,
}
_MIN_FLIP_RAD = math.radians(2.0)  # closer solutions are one
_MIN_SCORE_SIGMA_PX = 0.05  # lens and print set a floor to what residuals can show
_MAX_STEPS = 8
_TRUST = 8.0  # degrees of freedom that the claimed spread is worth beside the residuals

_SMALL_GAIN, _SMALL_STEP = 1.0, 0.005  # rad and m
_BEFORE = np.array([3, 0, 1, 2])
_START = np.arange(4)  # side k runs from corner k ...
_END = np.array([1, 2, 3, 0])  # ... to corner k + 1
_ROWS = np.concatenate([2 * np.tile(_START, 4), 2 * np.tile(_START, 4) + 1])
_COLUMNS = np.concatenate([2 * _START, 2 * _START + 1, 2 * _END, 2 * _END + 1] * 2)


@dataclass(frozen=True, eq=False)
class Candidate:
    """rvec (3,) rad and tvec (3,) m of the marker in the camera."""

    rvec: Array
    tvec: Array


@dataclass(frozen=True, eq=False)
class Scored(Candidate):
    """A candidate with the corners' errors (n, 2) and their Jacobian (2n, 6) with (rvec,
    tvec)."""

    error_px: Array
    jacobian: Array

    @property
    def rms_px(self) -> float:
        """Over the corners."""
        return math.sqrt(float((self.error_px * self.error_px).sum()) / len(self.error_px))


@dataclass(frozen=True, eq=False)
class TiltPrior:
    """The marker's normal (3,) as far as it is known, camera axes, to `spread_rad`."""

    normal_cam: Array | None
    spread_rad: float

    def contradicts(self, candidate: Candidate) -> bool:
        """Whether it is known and further away than its spread."""
        return (
            self.normal_cam is not None
            and tilt_rad(candidate.rvec, self.normal_cam) > self.spread_rad
        )


@dataclass(frozen=True, eq=False)
class Points:
    """object_m (n, 3) and image_px (n, 2) of a pinhole K; sigma_px (n,); whitening
    (2n, 2n) makes errors independent and of unit spread; shift (2n, k): one standard deviation
    each of what moves corners together, whitened: the shift that all edges share, the
    detections' `common_px`, and what shakes the rows of each."""

    object_m: Array
    image_px: Array
    sigma_px: Array
    whitening: Array
    shift: Array
    K: Array


def make_points(
    detections: Sequence[Detection], object_m: Array, image_px: Array, K: Array
) -> Points:
    n, m = len(image_px), len(detections)
    W, shift = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, 2 + 2 * m))
    corners_px = image_px.reshape(m, 4, 2)
    normals = _outward_normals(corners_px)
    sigma_px = np.array([d.sigma_px for d in detections])
    # A corner moves a pixel along the normals of both of its sides.
    moved = (normals + normals.take(_BEFORE, axis=1)).reshape(m, 8)
    for i, d in enumerate(detections):
        rows, corners = slice(8 * i, 8 * i + 8), corners_px[i]
        shift[rows, 0] = d.shift_sigma_px * moved[i]
        if d.cov_px2 is not None:
            W[rows, rows] = _whitened(d.cov_px2)
        elif d.refined:
            spread_px = d.sigma_px if d.lying_sigma_px == 0.0 else _lying_px(d, corners)
            W[_ROWS + 8 * i, _COLUMNS + 8 * i] = _of_lines(normals[i], spread_px)
        else:
            W[range(8 * i, 8 * i + 8), range(8 * i, 8 * i + 8)] = 1.0 / d.sigma_px
        if d.common_px is not None:
            shift[rows, 1] = d.common_px.ravel()
        if d.row_sigma_px > 0.0:
            # As of a line: half to all of its rows alike, and a slant.
            down = corners[:, 1] - corners[:, 1].mean()
            down /= max(float(np.abs(down).max()), 1e-9)
            along_x = slice(8 * i, 8 * i + 8, 2)
            shift[along_x, 2 + 2 * i] = 0.5 * d.row_sigma_px
            shift[along_x, 3 + 2 * i] = 0.5 * math.sqrt(3.0) * d.row_sigma_px * down
    return Points(object_m, image_px, sigma_px.repeat(4), W, W @ shift, K)


def _outward_normals(corners: Array) -> Array:
    """Unit normals (m, 4, 2) of the sides of m squares, whichever way round these are."""
    side = corners.take(_END, axis=1) - corners
    x, y = side[..., 0], side[..., 1]
    length = np.maximum(np.hypot(x, y), 1e-9)
    length = np.copysign(length, (x[:, 0] * y[:, 1] - y[:, 0] * x[:, 1])[:, None])
    normals = np.empty_like(side)
    np.divide(y, length, out=normals[..., 0])
    np.divide(x, -length, out=normals[..., 1])
    return normals


def _whitened(cov_px2: Array) -> Array:
    """(8, 8): what makes errors of that covariance independent and of unit spread."""
    try:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(cov_px2)), dtype=np.float64)
    except np.linalg.LinAlgError:
        return np.diag(1.0 / np.sqrt(np.maximum(np.diagonal(cov_px2), 1e-6)))


def _lying_px(d: Detection, corners: Array) -> Array:
    """Spread of the sides, (4,): the more of a side lies along the rows, the worse. Over
    several rows errors of interpolation cancel out."""
    way = corners.take(_END, axis=0) - corners
    lying = np.abs(way[:, 0]) / np.maximum(np.hypot(way[:, 0], way[:, 1]), 1e-9)
    rows = 0.5 * math.pi * np.abs(way[:, 1])
    return np.asarray(np.hypot(d.sigma_px, d.lying_sigma_px * lying / np.hypot(1.0, rows)))


def _of_lines(normals: Array, sigma_px: float | Array) -> Array:
    """Whitening of the corners of four fitted lines with normals (4, 2), by the offset and the
    tilt of each, at `_ROWS` and `_COLUMNS`; `sigma_px` of all or of each, (4,)."""
    across = (normals.T / sigma_px).ravel()
    tilt = across / math.sqrt(3.0)
    return np.concatenate([across, across, -tilt, tilt])


def solve(points: Points, solver: Solver, refine: bool, prior: TiltPrior) -> Scored | None:
    """The better of both tilts, None without a finite one in front of the camera, or where
    a solver other than ``sqpnp`` gives a start from which nothing settles.
    """
    candidates = _closed_form(points, solver)
    if refine:
        candidates = [_refined(points, c) for c in candidates]
    scored = [_scored(c, points) for c in candidates if _usable(c)]
    if not scored:
        return None
    best = _likeliest(scored, points, prior)
    if not refine:
        return best
    if prior.normal_cam is None or prior.contradicts(best):
        best = _likeliest([best, *_other_tilt(best, points)], points, prior)
    # The unweighted optimum is near enough for errors to be linear; where they are not,
    # a weaker solver than SQPnP has led astray.
    settled = gauss_newton(points, best)
    return best if settled is None and solver == "sqpnp" else settled


def gauss_newton(points: Points, start: Candidate) -> Scored | None:
    """Gauss-Newton with each corner's own spread, from a start that is near (the frame
    before); None where it does not settle within some steps."""
    candidate: Candidate = start
    before = math.inf
    W = points.whitening
    for _ in range(_MAX_STEPS):
        scored = _scored(candidate, points)
        A, error = W @ scored.jacobian, W @ scored.error_px.ravel()
        cost = float(error @ error)
        if cost > before * (1.0 + 1e-6) + 1e-9 or not math.isfinite(cost):
            return None
        g = A.T @ error
        try:
            step = np.linalg.solve(A.T @ A, g)
        except np.linalg.LinAlgError:
            return None
        gain = float(step @ g)  # of the step, in squared standard deviations
        if gain < _SMALL_GAIN and float(np.abs(step).max()) < _SMALL_STEP:
            # Errors are linear in such a step.
            error_px = scored.error_px - (scored.jacobian @ step).reshape(-1, 2)
            rvec, tvec = scored.rvec - step[:3], scored.tvec - step[3:]
            return Scored(rvec, tvec, error_px, scored.jacobian)
        if gain < 1e-4 + 1e-6 * cost:
            return scored
        candidate, before = Candidate(candidate.rvec - step[:3], candidate.tvec - step[3:]), cost
        if not _usable(candidate):
            return None
    return None


def covariance(points: Points, scored: Scored, normal_cam: Array) -> tuple[Array, float, Array]:
    """Of (rvec, tvec), (6, 6), the squared error per degree of freedom, and by how much the
    sheet's curl moves them, (6,), of a place r from its centre being r^2 off its plane.

    The covariance is the inverse information, grown as far as the residuals show that the
    corners spread more than they claim, and what common shifts do to the pose; not the curl.
    """
    A, error = points.whitening @ scored.jacobian, points.whitening @ scored.error_px.ravel()
    freedom = len(error) - 6
    try:
        inverse = np.linalg.inv(A.T @ A)
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.inf), math.inf, np.zeros(6)
    chi2 = float(error @ error)
    growth = max((_TRUST + chi2) / (_TRUST + freedom), 0.7)
    common = inverse @ (A.T @ points.shift)
    # A corner out of the sheet's plane is where a target moved along its normal would have it.
    lift = (points.object_m[:, :2] ** 2).sum(axis=1)
    lifted = (scored.jacobian[:, 3:] @ normal_cam) * lift.repeat(2)
    curl = inverse @ (A.T @ (points.whitening @ lifted))
    return inverse * growth + common @ common.T, chi2 / freedom, curl


def mirror_solution(rvec: Array, tvec: Array) -> Array | None:
    """The other tilt: the normal mirrored at the line of sight; None where both agree."""
    R = cv2.Rodrigues(rvec)[0]
    normal, sight = R[:, 2], tvec / np.linalg.norm(tvec)
    other = 2.0 * float(normal @ sight) * sight - normal
    axis = np.array(  # normal x other
        [
            normal[1] * other[2] - normal[2] * other[1],
            normal[2] * other[0] - normal[0] * other[2],
            normal[0] * other[1] - normal[1] * other[0],
        ]
    )
    sine, cosine = float(np.linalg.norm(axis)), float(normal @ other)
    angle = math.atan2(sine, cosine)
    if angle < _MIN_FLIP_RAD or sine < 1e-9:
        return None
    turn = cv2.Rodrigues(axis / sine * angle)[0]
    return flat(cv2.Rodrigues(turn @ R)[0])


def flat(values: Any) -> Array:
    return np.asarray(values, dtype=np.float64).ravel()


def tilt_rad(rvec: Array, expected_cam: Array) -> float:
    """Angle between the marker's normal and the expected one."""
    normal = cv2.Rodrigues(rvec)[0][:, 2]
    return math.acos(max(-1.0, min(1.0, float(normal @ expected_cam))))


def _closed_form(points: Points, solver: Solver) -> list[Candidate]:
    if solver == "ippe_square" and len(points.object_m) != 4:
        solver = "ippe"
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            points.object_m, points.image_px, points.K, None, flags=_FLAGS[solver]
        )
    except cv2.error:
        return []  # degenerate corners: all on one line, or on one point
    candidates = [Candidate(flat(r), flat(t)) for r, t in zip(rvecs, tvecs, strict=True)]
    return [candidate for candidate in candidates if _usable(candidate)]


def _usable(candidate: Candidate) -> bool:
    rvec, tvec = candidate.rvec, candidate.tvec
    return bool(finite(rvec) and finite(tvec) and tvec[2] > 0.0)


def _refined(points: Points, start: Candidate) -> Candidate:
    first = start.rvec.reshape(3, 1).copy(), start.tvec.reshape(3, 1).copy()
    try:
        rvec, tvec = cv2.solvePnPRefineLM(points.object_m, points.image_px, points.K, None, *first)
    except cv2.error:
        return start
    return Candidate(flat(rvec), flat(tvec))


def _scored(candidate: Candidate, points: Points) -> Scored:
    rvec, tvec = candidate.rvec, candidate.tvec
    projected, jacobian = cv2.projectPoints(points.object_m, rvec, tvec, points.K, None)
    error: Array = projected.reshape(-1, 2) - points.image_px
    return Scored(rvec, tvec, error, np.asarray(jacobian[:, :6], dtype=np.float64))


def _other_tilt(scored: Scored, points: Points) -> list[Scored]:
    """The best candidate near the mirror solution, if there is one."""
    rvec = mirror_solution(scored.rvec, scored.tvec)
    if rvec is None:
        return []
    turned = _refined(points, Candidate(rvec, scored.tvec))
    return [_scored(turned, points)] if _usable(turned) else []


def _likeliest(scored: list[Scored], points: Points, prior: TiltPrior) -> Scored:
    """By the squared errors of corners and tilt, in units of their spread."""
    if len(scored) == 1:
        return scored[0]
    sigma = np.maximum(points.sigma_px, _MIN_SCORE_SIGMA_PX)[:, None]

    def cost(s: Scored) -> float:
        total = float(((s.error_px / sigma) ** 2).sum())
        if prior.normal_cam is not None:
            total += (tilt_rad(s.rvec, prior.normal_cam) / prior.spread_rad) ** 2
        return total

    return min(scored, key=cost)
