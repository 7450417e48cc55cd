"""Rotation and translation from corners: closed forms, then least squares in which each
corner counts as it was measured (`perchctl.vision.points`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from perchctl.geometry import Array, finite
from perchctl.vision.points import Points

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
# What a movement of corners departs from linear is its square over their distances, 20 px or more.
_SMALL_MOVE_PX = 0.3


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """rvec (3,) rad and tvec (3,) m of the marker in the camera."""

    rvec: Array
    tvec: Array


@dataclass(frozen=True, eq=False)
class Scored(PoseCandidate):
    """A candidate with the corners' errors (n, 2) and their Jacobian (2n, 6) with (rvec,
    tvec)."""

    error_px: Array
    jacobian: Array

    @property
    def rms_px(self) -> float:
        """Over the corners."""
        flat = self.error_px.ravel()
        return math.sqrt(float(flat.dot(flat)) / len(self.error_px))


@dataclass(frozen=True, eq=False)
class TiltPrior:
    """The marker's normal (3,) as far as it is known, camera axes, to `spread_rad`."""

    normal_cam: Array | None
    spread_rad: float

    def contradicts(self, candidate: PoseCandidate) -> bool:
        """Whether it is known and further away than its spread."""
        return (
            self.normal_cam is not None
            and tilt_rad(candidate.rvec, self.normal_cam) > self.spread_rad
        )


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


def gauss_newton(points: Points, start: PoseCandidate) -> Scored | None:
    """Gauss-Newton with each corner's own spread, from a start that is near (the frame
    before); None where it does not settle within some steps."""
    candidate: PoseCandidate = start
    before = math.inf
    W = points.whitening
    for _ in range(_MAX_STEPS):
        scored = _scored(candidate, points)
        A, error = W.dot(scored.jacobian), W.dot(scored.error_px.ravel())
        B, weighed = A, error
        if points.curled:
            weight = weight_with(_curl(points, scored))
            B, weighed = weight @ A, weight @ error
        cost = float(error.dot(weighed))
        if cost > before * (1.0 + 1e-6) + 1e-9 or not math.isfinite(cost):
            return None
        g = B.T.dot(error)
        # OpenCV's is three times as fast on matrices of this size.
        regular, solved = cv2.solve(B.T.dot(A), g[:, None], flags=cv2.DECOMP_CHOLESKY)
        if not regular:
            return None
        step = solved[:, 0]
        gain = float(step.dot(g))  # of the step, in squared standard deviations
        moved_px = scored.jacobian.dot(step).reshape(-1, 2)
        small = gain < _SMALL_GAIN or float(np.abs(moved_px).max()) < _SMALL_MOVE_PX
        if small and max(map(abs, step.tolist())) < _SMALL_STEP:
            # Errors are linear in such a step.
            error_px = scored.error_px - moved_px
            rvec, tvec = scored.rvec - step[:3], scored.tvec - step[3:]
            return Scored(rvec, tvec, error_px, scored.jacobian)
        if gain < 1e-4 + 1e-6 * cost:
            return scored
        candidate, before = (
            PoseCandidate(candidate.rvec - step[:3], candidate.tvec - step[3:]),
            cost,
        )
        if not _usable(candidate):
            return None
    return None


def covariance(points: Points, scored: Scored) -> tuple[Array, float, Array]:
    """Of (rvec, tvec), (6, 6), the squared error per degree of freedom, and by how much one
    standard deviation of the sheet's curl moves them, (6,).

    The covariance is that of the corners' noise, grown as far as the residuals show that they
    spread more than they claim, and what common shifts do to the pose, and a twist; not the curl.
    """
    W = points.whitening
    A, error = W.dot(scored.jacobian), W.dot(scored.error_px.ravel())
    freedom = len(error) - 6
    curl = _curl(points, scored)
    weight = weight_with(curl) if points.curled else None
    B, weighed = (A, error) if weight is None else (weight @ A, weight @ error)
    regular, inverse = cv2.invert(B.T.dot(A), flags=cv2.DECOMP_CHOLESKY)
    if not regular:
        return np.full((6, 6), np.inf), math.inf, np.zeros(6)
    gain = inverse.dot(B.T)
    chi2 = float(error.dot(weighed))
    growth = max((_TRUST + chi2) / (_TRUST + freedom), 0.7)
    common = gain.dot(points.shift)
    noise = inverse if weight is None else gain @ gain.T
    cov = noise * growth + common.dot(common.T)
    curled, twisted = gain.dot(curl).T
    if weight is not None:
        cov += np.multiply.outer(twisted, twisted)
    return cov, chi2 / freedom, curled


def _curl(points: Points, scored: Scored) -> Array:
    lift = np.zeros((len(points.whitening), 2)) if points.lift is None else points.lift
    curl: Array = points.whitening.dot(moved_by(lift, scored.rvec, scored.jacobian))
    return curl


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


def _closed_form(points: Points, solver: Solver) -> list[PoseCandidate]:
    if solver == "ippe_square" and len(points.object_m) != 4:
        solver = "ippe"
    try:
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(
            points.object_m, points.image_px, points.K, None, flags=_FLAGS[solver]
        )
    except cv2.error:
        return []  # degenerate corners: all on one line, or on one point
    candidates = [PoseCandidate(flat(r), flat(t)) for r, t in zip(rvecs, tvecs, strict=True)]
    return [candidate for candidate in candidates if _usable(candidate)]


def _usable(candidate: PoseCandidate) -> bool:
    rvec, tvec = candidate.rvec, candidate.tvec
    return bool(finite(rvec) and finite(tvec) and tvec[2] > 0.0)


def _refined(points: Points, start: PoseCandidate) -> PoseCandidate:
    first = start.rvec.reshape(3, 1).copy(), start.tvec.reshape(3, 1).copy()
    try:
        rvec, tvec = cv2.solvePnPRefineLM(points.object_m, points.image_px, points.K, None, *first)
    except cv2.error:
        return start
    return PoseCandidate(flat(rvec), flat(tvec))


def _scored(candidate: PoseCandidate, points: Points) -> Scored:
    rvec, tvec = candidate.rvec, candidate.tvec
    projected, jacobian = cv2.projectPoints(points.object_m, rvec, tvec, points.K, None)
    error: Array = projected.reshape(-1, 2) - points.image_px
    return Scored(rvec, tvec, error, np.asarray(jacobian[:, :6], dtype=np.float64))


def _other_tilt(scored: Scored, points: Points) -> list[Scored]:
    """The best candidate near the mirror solution, if there is one."""
    rvec = mirror_solution(scored.rvec, scored.tvec)
    if rvec is None:
        return []
    turned = _refined(points, PoseCandidate(rvec, scored.tvec))
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


# --- A sheet that is not flat: what its curl does to corners, and what they are worth then -----
# Corners that curl has moved err together, and those far from the centre err most: a joint pose of
# both markers rests on the small one as far as the large one may be off.


def lift_of(object_m: Array, curl_per_m: float) -> Array:
    """How far corners (n, 3) are out of the sheet's plane at one standard deviation of each kind
    of curl, (2n, 2) m, for x and y of each: the whole rim to one side, or two corners of it to
    one and two to the other. A sheet rolled about any axis is as much of one as of the other."""
    x, y = object_m[:, 0], object_m[:, 1]
    lift: Array = curl_per_m * np.stack([x * x + y * y, math.sqrt(2.0) * x * y], axis=1)
    return lift.repeat(2, axis=0)


def moved_by(lift: Array, rvec: Array, jacobian: Array) -> Array:
    """By how much `lift` moves the corners in the picture, (2n, 2), where a change of (rvec,
    tvec) moves them by `jacobian` (2n, 6)."""
    normal_cam = cv2.Rodrigues(rvec)[0][:, 2]
    # A corner out of the sheet's plane is where a target moved along its normal would have it.
    moved: Array = jacobian[:, 3:].dot(normal_cam)[:, None] * lift
    return moved


def weight_with(curl: Array) -> Array:
    """The inverse covariance (2n, 2n) of errors of unit spread that have `curl` (2n, k), one
    standard deviation each, among them."""
    inner = np.linalg.inv(np.eye(curl.shape[1]) + curl.T @ curl)
    weight: Array = np.eye(len(curl)) - curl @ inner @ curl.T
    return weight
