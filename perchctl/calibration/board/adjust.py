"""The camera and all board poses together: bundle adjustment, its outliers and its covariance.

The minimum is that of `cv2.calibrateCamera`; corners may weigh differently, a fisheye is solved
by the same code, and the derivatives stay for the covariance. For each lens that is tried, every
board takes the pose that fits best; `scipy.optimize.least_squares` then moves the few lens
parameters alone (variable projection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from perchctl.calibration.board.detect import MIN_CORNERS, BoardView, Rejection
from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.vision import CameraModel, undistort

# --- Lens models -----------------------------------------------------------------------------


ModelName = Literal["plumb_bob", "rational_polynomial", "fisheye"]
MODEL_NAMES: tuple[ModelName, ...] = get_args(ModelName)  # the simplest first
PARAMETERS: dict[str, tuple[str, ...]] = {
    "plumb_bob": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": (
        "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"
    ),
    "fisheye": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}  # fmt: skip
_PRIOR_PX = 0.05
_PRIOR_SPREAD = 5.0
"""k1, k2, k3 and k4, k5, k6 of the rational model nearly cancel; left alone they run off
together, to poles beside the picture. They are held at 0 +- 5 as if by one corner."""


def make_camera(model: str, size_px: tuple[int, int], parameters: Array) -> CameraModel:
    """Return a camera from fx, fy, cx, cy and the distortion, in the order of `PARAMETERS`."""
    return CameraModel(size_px, _matrix(parameters), np.array(parameters[4:], np.float64), model)


def _matrix(parameters: Array) -> Array:
    """Return the camera matrix (3, 3)."""
    K = np.eye(3)
    K[[0, 1], [0, 1]] = parameters[:2]
    K[:2, 2] = parameters[2:4]
    return K


def parameters_of(camera: CameraModel) -> Array:
    """Return the lens parameters of a camera, in the order of `PARAMETERS`; four coefficients of
    plumb_bob get k3 = 0."""
    K, dist = camera.K, camera.dist
    if camera.model == "plumb_bob" and dist.size == 4:
        dist = np.append(dist, 0.0)
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], dist])


def prior_of(model: str) -> Array:
    """Return how strongly each lens parameter is pulled to zero, (p,), in px^2 of cost."""
    names = PARAMETERS[model]
    held = ("k1", "k2", "k3", "k4", "k5", "k6") if model == "rational_polynomial" else ()
    return np.array([(_PRIOR_PX / _PRIOR_SPREAD) ** 2 * (name in held) for name in names])


def project_with_derivatives(
    model: str, parameters: Array, pose: Array, points_m: Array
) -> tuple[Array, Array, Array]:
    """Return the pixels (n, 2) of points (n, 3) at a pose (rvec and tvec, (6,)), and their
    derivatives (2 n, p) by the lens and (2 n, 6) by the pose."""
    p = len(parameters)
    K, dist = _matrix(parameters), np.ascontiguousarray(parameters[4:])
    points, rvec, tvec = np.ascontiguousarray(points_m), pose[:3].copy(), pose[3:].copy()
    if model == "fisheye":
        image, J = cv2.fisheye.projectPoints(points.reshape(-1, 1, 3), rvec, tvec, K, dist)
        lens, outside = J[:, :p], J[:, p : p + 6]
    else:
        image, J = cv2.projectPoints(points, rvec, tvec, K, dist)
        lens, outside = J[:, 6 : 6 + p], J[:, :6]
    pixels = np.asarray(image, np.float64).reshape(-1, 2)
    return pixels, np.asarray(lens, np.float64), np.asarray(outside, np.float64)


def pixel_grid(size_px: tuple[int, int], columns: int = 17, rows: int = 13) -> Array:
    """Return pixels over the whole image with its rims, (columns * rows, 2)."""
    x, y = np.meshgrid(
        np.linspace(0, size_px[0] - 1, columns), np.linspace(0, size_px[1] - 1, rows)
    )
    return np.column_stack([x.ravel(), y.ravel()])


# --- Bundle adjustment -----------------------------------------------------------------------


_FOCAL_GUESSES = np.geomspace(0.3, 2.4, 8)  # of the longer side of the picture
_MOST_STARTS = 2
_POSE_STEPS = 12
_POSE_STILL = 1e-10  # gain, as a share of the cost
_IMPOSSIBLE_PX = 1e4  # residual of a lens for which a board has no pose


class NoSolution(ArithmeticError):
    """No camera fits the corners, from whichever start."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A minimum of the adjustment.

    Attributes:
        parameters: of the lens, (p,), in the order of `PARAMETERS`.
        poses: rvec and tvec of each view's board in the camera frame, (v, 6).
        residuals: found minus modelled corners of each view, (n, 2) each.
        jacobians: derivatives of each view's pixels, by the lens (2 n, p) and the pose (2 n, 6).
        weights: of each view's corners, (n,) each.
    """

    model: str
    size_px: tuple[int, int]
    parameters: Array
    poses: Array
    residuals: tuple[Array, ...]
    jacobians: tuple[tuple[Array, Array], ...]
    weights: tuple[Array, ...]

    @property
    def camera(self) -> CameraModel:
        """The lens as a camera model."""
        return make_camera(self.model, self.size_px, self.parameters)

    @property
    def cost(self) -> float:
        """The weighted sum of squares, px^2, with the prior's."""
        squares = [
            (w[:, None] * r**2).sum() for w, r in zip(self.weights, self.residuals, strict=True)
        ]
        return float(np.sum(squares) + prior_of(self.model) @ self.parameters**2)

    @property
    def rms_px(self) -> float:
        """Over all corners: root mean of squared distances, as OpenCV's."""
        return float(np.sqrt((np.concatenate(self.residuals) ** 2).sum(axis=1).mean()))

    def view_rms_px(self) -> Array:
        """Return the RMS distance of each view, (v,) px."""
        return np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in self.residuals])

    def reduced_blocks(self) -> list[tuple[Array, Array]]:
        """Return what each view tells of the lens once its pose is free: the weighted derivative
        (2 n, p) with the pose's part projected out, and the weighted residuals (2 n,)."""
        blocks = []
        for r, (A, B), w in zip(self.residuals, self.jacobians, self.weights, strict=True):
            root = np.sqrt(np.repeat(w, 2))[:, None]
            Q, _ = np.linalg.qr(B * root)
            Aw = A * root
            blocks.append((Aw - Q @ (Q.T @ Aw), root[:, 0] * r.ravel()))
        return blocks


def start_fit(views: Sequence[BoardView], model: str) -> Fit:
    """Solve from nothing, by the focal lengths that fit best without any distortion.

    Raises NoSolution.
    """
    w, h = size_px = views[0].size_px
    starts = []
    for f in _FOCAL_GUESSES * max(w, h):
        straight = np.zeros(len(PARAMETERS[model]))
        straight[:4] = f, f, (w - 1) / 2, (h - 1) / 2
        posed = poses_only(views, make_camera(model, size_px, straight))
        if posed is not None:
            starts.append(posed)
    starts.sort(key=lambda start: start.cost)
    ends = [_minimum(views, start, evaluations=25) for start in starts[:_MOST_STARTS]]
    found = [end for end in ends if end is not None]
    if not found:
        raise NoSolution(f"no {model} camera fits the corners")
    return refit(views, min(found, key=lambda fit: fit.cost))


def refit(
    views: Sequence[BoardView],
    near: Fit,
    weights: Sequence[Array] | None = None,
    kept: NDArray[np.bool_] | None = None,
) -> Fit:
    """Solve again from a fit of these views, or of more, of which these are those `kept` (v,);
    with other corners' weights. Raises NoSolution."""
    poses = near.poses if kept is None else near.poses[kept]
    start = _posed(views, near.model, near.parameters, poses, weights)
    fit = None if start is None else _minimum(views, start)
    if fit is None:
        raise NoSolution("the adjustment diverged")
    return fit


def poses_only(views: Sequence[BoardView], camera: CameraModel) -> Fit | None:
    """Return the best poses for a camera held fixed; None where a view does not fit it at all."""
    poses = [_first_pose(view, camera) for view in views]
    found = [pose for pose in poses if pose is not None]
    if len(found) < len(views):
        return None
    return _posed(views, camera.model, parameters_of(camera), np.array(found))


def _minimum(views: Sequence[BoardView], start: Fit, evaluations: int = 60) -> Fit | None:
    """Return the minimum to which the lens parameters lead from `start`, with its weights; None
    where it is no camera."""
    newest = start
    root_prior = np.sqrt(prior_of(start.model))

    def at(parameters: Array) -> Fit | None:
        nonlocal newest
        if not np.array_equal(parameters, newest.parameters):
            fit = _posed(views, start.model, parameters, newest.poses, start.weights)
            if fit is None:
                return None
            newest = fit
        return newest

    def residuals(parameters: Array) -> Array:
        fit = at(parameters)
        if fit is None:
            return np.full(sum(2 * len(v) for v in views) + len(parameters), _IMPOSSIBLE_PX)
        weighted = [
            np.sqrt(w)[:, None] * -r for w, r in zip(fit.weights, fit.residuals, strict=True)
        ]
        return np.concatenate([*(part.ravel() for part in weighted), root_prior * parameters])

    def derivative(parameters: Array) -> Array:
        fit = at(parameters)
        assert fit is not None  # derivatives are asked for where a step was accepted
        return np.concatenate([*(A for A, _ in fit.reduced_blocks()), np.diag(root_prior)])

    found = least_squares(
        residuals, start.parameters, derivative, method="lm", x_scale="jac", ftol=1e-9, xtol=1e-9,
        max_nfev=evaluations,
    )  # fmt: skip
    return at(found.x)


def _posed(
    views: Sequence[BoardView],
    model: str,
    parameters: Array,
    poses: Array,
    weights: Sequence[Array] | None = None,
) -> Fit | None:
    """Return the fit of a lens with the poses that are best for it, from nearby ones (v, 6)."""
    if parameters[0] <= 0.0 or parameters[1] <= 0.0:
        return None
    weights = tuple(np.ones(len(v)) for v in views) if weights is None else tuple(weights)
    ends = [
        _best_pose(view, model, parameters, pose, w)
        for view, pose, w in zip(views, poses, weights, strict=True)
    ]
    good = [end for end in ends if end is not None]
    if len(good) < len(ends):
        return None
    return Fit(
        model,
        views[0].size_px,
        np.array(parameters),
        np.array([pose for pose, *_ in good]),
        tuple(r for _, r, *_ in good),
        tuple((A, B) for *_, A, B in good),
        weights,
    )


def _best_pose(
    view: BoardView, model: str, parameters: Array, pose: Array, weight: Array
) -> tuple[Array, Array, Array, Array] | None:
    """Return the pose (6,) by Gauss-Newton, its residuals (n, 2) and derivatives by the lens and
    the pose; None where the board is not in view."""
    twice = np.repeat(weight, 2)[:, None]
    best: tuple[Array, Array, Array, Array] | None = None
    best_cost, trial = np.inf, pose
    step: Array = np.zeros(6)
    for _ in range(_POSE_STEPS):
        try:
            pixels, A, B = project_with_derivatives(model, parameters, trial, view.object_m)
        except cv2.error:
            return best
        r = view.corners_px - pixels
        cost = float((weight[:, None] * r**2).sum())
        if not (np.isfinite(cost) and trial[5] > 0.0) and best is None:
            return None
        if cost < best_cost and trial[5] > 0.0:
            gain = best_cost - cost
            best, best_cost, pose = (trial, r, A, B), cost, trial
            if gain <= _POSE_STILL * cost:
                break
            weighted = B * twice
            try:
                step = np.asarray(np.linalg.solve(B.T @ weighted, weighted.T @ r.ravel()))
            except np.linalg.LinAlgError:
                return best
        else:
            step = step / 4.0
            if np.abs(step).max() < 1e-9:
                break
        trial = pose + step
    return best


def _first_pose(view: BoardView, camera: CameraModel) -> Array | None:
    """Return the board's rvec and tvec (6,) as a known camera sees it, or None."""
    normalised = undistort(view.corners_px, camera)
    good = np.isfinite(normalised).all(axis=1) & (np.abs(normalised) < 50.0).all(axis=1)
    if good.sum() < 4:
        return None
    for method in (cv2.SOLVEPNP_IPPE, cv2.SOLVEPNP_SQPNP):  # IPPE fails on frontal boards
        try:
            found, rvec, tvec = cv2.solvePnP(
                view.object_m[good], normalised[good], np.eye(3), None, flags=method
            )
        except cv2.error:
            return None
        pose = np.concatenate([rvec.ravel(), tvec.ravel()]) if found else np.full(6, np.nan)
        if np.isfinite(pose).all() and pose[5] > 0.0:
            return pose
    return None


# --- Outliers --------------------------------------------------------------------------------
# 1. The camera is solved with weights 1 / (1 + (r / 3s)^2)^2, r a corner's distance from the
#    model and s the median spread, repeated, so that outliers do not bend the solution
#    that judges them.
# 2. A corner is rejected when r > 5 times the spread of its view (at least that of all
#    views), and r > 0.3 px.
# 3. A view is rejected when the RMS of its remaining corners is above 2.5 times the median
#    view's and above 0.1 px, when more than a quarter of its corners were rejected, or
#    when fewer than 6 remain.
# 4. What remains is solved with equal weights, and 2 to 3 are repeated until nothing changes.
#
# When more than a third of the views would go, nothing is rejected and calibration is
# refused: then not the views are wrong, but the board, its size or the lens.


CORNER_FACTOR = 5.0
CORNER_FLOOR_PX = 0.3
VIEW_FACTOR = 2.5
VIEW_FLOOR_PX = 0.1
MAX_CORNERS_OUT = 0.25
MAX_VIEWS_OUT = 1.0 / 3.0
_MEDIAN_OF_RAYLEIGH = 1.1774  # median distance of a round Gaussian with spread 1
_MIN_SPREAD_PX = 0.01
_REJECTION_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Robust:
    """A fit of the views kept, without their rejected corners, and what was left out."""

    fit: Fit
    views: tuple[BoardView, ...]
    rejections: tuple[Rejection, ...]


def weighted_fit(views: Sequence[BoardView], model: str) -> tuple[Fit, float]:
    """Return the solution that outliers do not bend (step 1), and its median spread s in px."""
    fit = start_fit(views, model)
    spread = _spread_px(fit.residuals)
    for _ in range(12):
        weights = [
            (1.0 + (np.linalg.norm(r, axis=1) / (3.0 * spread)) ** 2) ** -2 for r in fit.residuals
        ]
        fit = refit(views, fit, weights)
        before, spread = spread, _spread_px(fit.residuals)
        if abs(spread - before) < 0.01 * before:
            break
    return fit, spread


def reject_outliers(views: Sequence[BoardView], start: Fit) -> Robust:
    """Leave outliers out (steps 2 to 4), from the weighted solution of all views. Raises
    InvalidValue when too many go."""
    whole = {view.name: view for view in views}
    kept, fit = list(views), start
    out_views: dict[str, str] = {}
    for k in range(_REJECTION_ROUNDS):
        masks, reasons = _find_outliers(kept, fit, whole)
        out_views |= reasons
        if len(out_views) > MAX_VIEWS_OUT * len(views):
            named = ", ".join(list(out_views)[:4]) + (", ..." if len(out_views) > 4 else "")
            raise InvalidValue(
                f"{len(out_views)} of {len(views)} views do not fit one camera "
                f"({named}): is the board flat and --board its true layout, and were "
                f"zoom and focus left alone between the pictures?"
            )
        if k > 0 and not reasons and all(mask.all() for mask in masks):
            break
        stays = np.array([view.name not in reasons for view in kept])
        kept = [
            view.keep(mask)
            for view, mask, stay in zip(kept, masks, stays, strict=True)
            if stay
        ]  # fmt: skip
        fit = refit(kept, fit, kept=stays)
    rejections = [Rejection(name, reason) for name, reason in out_views.items()]
    for view in kept:
        out = np.setdiff1d(whole[view.name].ids, view.ids)
        if len(out):
            reason = f"{len(out)} corners are off by more than {CORNER_FACTOR:g} times the view's "
            rejections.append(Rejection(view.name, f"{reason}spread", tuple(out.tolist())))
    return Robust(fit, tuple(kept), tuple(rejections))


def _find_outliers(
    views: Sequence[BoardView], fit: Fit, whole: dict[str, BoardView]
) -> tuple[list[NDArray[np.bool_]], dict[str, str]]:
    """Return the corners to keep in each view, and the views to leave out with the reason."""
    overall = _spread_px(fit.residuals)
    masks, rms = [], []
    for r in fit.residuals:
        distance = np.linalg.norm(r, axis=1)
        limit = max(CORNER_FACTOR * max(overall, _spread_px([r])), CORNER_FLOOR_PX)
        mask = distance <= limit
        masks.append(mask)
        rms.append(float(np.sqrt((distance[mask] ** 2).mean())) if mask.any() else np.inf)
    median = float(np.median(rms))
    limit = max(VIEW_FACTOR * median, VIEW_FLOOR_PX)
    reasons = {}
    for view, mask, view_rms in zip(views, masks, rms, strict=True):
        left, had = int(mask.sum()), len(whole[view.name])
        if view_rms > limit:
            reasons[view.name] = f"RMS {view_rms:.2f} px, the median view has {median:.2f}"
        elif had - left > MAX_CORNERS_OUT * had:
            reasons[view.name] = f"{had - left} of its {had} corners are outliers"
        elif left < MIN_CORNERS:
            reasons[view.name] = f"only {left} good corners remain"
    return masks, reasons


def _spread_px(residuals: Sequence[Array]) -> float:
    """Return the spread of one coordinate in px, from the median distance."""
    distances = np.linalg.norm(np.concatenate(residuals), axis=1)
    return max(float(np.median(distances)) / _MEDIAN_OF_RAYLEIGH, _MIN_SPREAD_PX)


# --- How far the lens parameters may be off ----------------------------------------------------
# Two estimates are made. The first takes the corners' errors as independent: the residuals'
# variance times the inverse of the normal equations. The second uses the views: errors
# within a view go together (blur, a bent board, a moving camera), so each view is left out
# once, in the linear approximation, and the spread of those solutions is the covariance
# (the jackknife over clusters). In every direction of parameter space the larger of the
# two counts.


def lens_covariance(fit: Fit) -> Array:
    """Return the covariance of the lens parameters (p, p), infinite where the views leave one
    free."""
    blocks = fit.reduced_blocks()
    p = len(fit.parameters)
    information = np.sum([A.T @ A for A, _ in blocks], axis=0) + np.diag(prior_of(fit.model))
    # Unlike units (px and coefficients) are brought to one scale.
    d = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-30))
    scaled = information * np.outer(d, d)
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < 1e-13:
        return np.diag(np.full(p, np.inf))
    rows = sum(len(r) for _, r in blocks)
    noise2 = sum(float(r @ r) for _, r in blocks) / max(rows - p - 6 * len(blocks), 1)
    independent = noise2 * (vectors / values) @ vectors.T
    return _larger(independent, _jackknife(blocks, scaled, d)) * np.outer(d, d)


def _jackknife(blocks: list[tuple[Array, Array]], scaled: Array, d: Array) -> Array:
    """Return the spread of the solutions without one view each, in scaled parameters, (p, p)."""
    p, v = len(d), len(blocks)
    floor = 1e-3 * np.linalg.eigvalsh(scaled)[0]
    moves = []
    for A, r in blocks:
        As = A * d
        # A view that alone fixes a direction would be infinite: the floor keeps it finite.
        values, vectors = np.linalg.eigh(scaled - As.T @ As)
        moves.append((vectors / np.maximum(values, floor)) @ (vectors.T @ (As.T @ r)))
    spread = np.array(moves) - np.mean(moves, axis=0)
    return np.asarray((v - 1) / v * spread.T @ spread) if v > 1 else np.zeros((p, p))


def _larger(a: Array, b: Array) -> Array:
    """Return the smallest covariance that is nowhere below a, and as large as b along each axis
    in which b exceeds a (axes of b in units of a)."""
    root = np.linalg.cholesky(a + 1e-15 * np.trace(a) * np.eye(len(a)))
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    lifted = root @ vectors
    return np.asarray((lifted * np.maximum(values, 1.0)) @ lifted.T)
