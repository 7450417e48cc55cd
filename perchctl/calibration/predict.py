"""What a calibration's error means: in pixels over the image, in mm at the target.

The pose solve takes up a part of a wrong calibration: a wrong focal length becomes a
wrong height, not a wrong angle. So the error at the target is not the ray's error times
the distance but the change of the solved position. For a target at a place, with J the
derivative of its corners by its pose and L by the lens, a lens error d moves the solved
pose by -(J'J)^-1 J'L d; its translation is the error at the target's centre. Draws of d
from the parameters' covariance give the 95 % lines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.bundle import poses_only
from perchctl.calibration.enough import is_covered
from perchctl.calibration.lens import (
    parameters_of,
    pixel_derivatives,
    pixel_grid,
    project_with_derivatives,
    rays_of,
)
from perchctl.calibration.types import BoardView, RangeError
from perchctl.geometry import Array
from perchctl.vision import CameraModel, distort, project, undistort

RANGES_M = (0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.75, 1.0, 1.25, 1.5)
LARGE_M, SMALL_M = 0.150, 0.025
CONFIDENCE = 0.95
DRAWS = 600
_CURVE_DEG = np.linspace(0.0, 85.0, 1200)  # from the axis; wider lenses are not drawn further
_TURNED = np.array([np.pi, 0.0, 0.0])  # the marker's z towards the camera
_SQUARE: Array = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


def draws(covariance: Array, seed: int = 0) -> Array:
    """Lens errors as the covariance has them, (DRAWS, p); the same for the same seed."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    normal = np.random.default_rng(seed).standard_normal((DRAWS, len(covariance)))
    return np.asarray(normal @ root.T)


def predict_errors(
    camera: CameraModel,
    covariance: Array,
    ranges_m: Sequence[float] = RANGES_M,
    covered: NDArray[np.bool_] | None = None,
) -> tuple[RangeError, ...]:
    """95 % lines of the target's position error at each distance, where all of the target
    lies in `covered` cells of the picture (None: anywhere), and straight ahead."""
    errors = draws(covariance)
    result = []
    for z_m in ranges_m:
        there = places(camera, z_m, covered)
        moved = np.array([_absorbed(camera, place, z_m) @ errors.T for place in there])
        mm = 1e3 * np.linalg.norm(moved, axis=1)  # (places, draws), the axis first
        worst = float(np.quantile(mm.max(axis=0), CONFIDENCE))
        result.append(RangeError(z_m, worst, float(np.quantile(mm[0], CONFIDENCE))))
    return tuple(result)


def position_errors_mm(
    camera: CameraModel,
    truth: CameraModel,
    z_m: float,
    covered: NDArray[np.bool_] | None = None,
) -> Array:
    """How far a target seen by `truth` is from where `camera` puts it, at each of the
    places of `truth`; the first is on the axis, (n,) mm."""
    errors = []
    for place in places(truth, z_m, covered):
        corners_m = target_m(truth, place, z_m)
        seen = project(corners_m, _TURNED, place, truth)
        view = BoardView("", truth.size_px, np.arange(len(corners_m)), corners_m, seen)
        solved = poses_only([view], camera)
        errors.append(
            np.inf if solved is None else 1e3 * np.linalg.norm(solved.poses[0, 3:] - place)
        )
    return np.array(errors)


def places(camera: CameraModel, z_m: float, covered: NDArray[np.bool_] | None = None) -> Array:
    """Target centres at that depth, (n, 3): straight ahead, then over the whole picture
    wherever all corners of a marker are in view; with `covered`, in covered cells."""
    middles = undistort(pixel_grid(camera.size_px, 9, 7), camera)
    found = [np.array([0.0, 0.0, z_m])]
    sizes = (LARGE_M, SMALL_M)
    for side_m in sizes:
        for x, y in middles:
            place = np.array([x * z_m, y * z_m, z_m])
            if np.isfinite(place).all() and _in_view(camera, place, side_m):
                found.append(place)
        if len(found) > 1:  # the large marker decides as long as it fits anywhere
            break
    if covered is not None:
        found[1:] = [place for place in found[1:] if _is_covered(camera, place, z_m, covered)]
    return np.array(found)


def target_m(camera: CameraModel, place: Array, z_m: float) -> Array:
    """The corners in the target's own axes that are in view there, (4 or 8, 3)."""
    sides = [side_m for side_m in (LARGE_M, SMALL_M) if _in_view(camera, place, side_m)]
    return np.concatenate([_SQUARE * side_m for side_m in sides or [SMALL_M]])


def ray_errors_px(camera: CameraModel, covariance: Array) -> tuple[float, float, Array]:
    """95 % lines of the RMS and of the largest error of fixed rays over the image, in px,
    and the 95 % line at each pixel of `pixel_grid` (n,), NaN where the lens images no ray."""
    rays = undistort(pixel_grid(camera.size_px), camera)
    # Where the lens model folds back, no ray is imaged.
    good = np.abs(distort(rays, camera) - pixel_grid(camera.size_px)).max(axis=1) < 0.5
    L = pixel_derivatives(camera, rays_of(rays[good]))
    moved = np.einsum("nkp,dp->dnk", L, draws(covariance))
    distance2 = (moved**2).sum(axis=2)
    each = np.full(len(rays), np.nan)
    each[good] = np.sqrt(np.quantile(distance2, CONFIDENCE, axis=0))
    rms = float(np.quantile(np.sqrt(distance2.mean(axis=1)), CONFIDENCE))
    return rms, float(np.quantile(np.sqrt(distance2.max(axis=1)), CONFIDENCE)), each


def distortion_curve(
    camera: CameraModel, covariance: Array, far_px: Array
) -> tuple[Array, Array, Array]:
    """From the image's centre towards centre + `far_px` (2,), or to where the lens model folds
    back: pixels from the centre, the lens's shift and its 95 % line in px, (n,) each."""
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    outward = far_px / np.linalg.norm(far_px)
    along = outward / focal
    rays = np.tan(np.radians(_CURVE_DEG))[:, None] * along / np.linalg.norm(along)
    r_px = (distort(rays, camera) - camera.K[:2, 2]) @ outward
    ends = ~np.isfinite(r_px) | (np.gradient(r_px) <= 0.0) | (r_px > np.linalg.norm(far_px))
    count = max(2, int(np.argmax(ends))) if ends.any() else len(r_px)
    rays, r_px = rays[:count], r_px[:count]
    L = pixel_derivatives(camera, rays_of(rays)).copy()
    L[:, :, :4] = 0.0  # the band is of the distortion alone
    moved = np.einsum("nkp,dp,k->nd", L, draws(covariance), outward)
    return r_px, r_px - (rays * focal) @ outward, 1.96 * moved.std(axis=1)


def ray_difference_px(camera: CameraModel, truth: CameraModel) -> Array:
    """Distance in px between where two cameras image the same rays, over `pixel_grid` of
    the second, (n,); NaN where a ray cannot be had."""
    grid = pixel_grid(truth.size_px)
    rays = undistort(grid, truth)
    result = np.full(len(grid), np.nan)
    good = np.isfinite(rays).all(axis=1)
    there = project(rays_of(rays[good]), np.zeros(3), np.zeros(3), camera)
    result[good] = np.linalg.norm(there - grid[good], axis=1)
    return result


def _in_view(camera: CameraModel, place: Array, side_m: float) -> bool:
    pixels = project(_SQUARE * side_m, _TURNED, place, camera)
    w, h = camera.size_px
    inside = (pixels >= 0).all() and (pixels <= (w - 1, h - 1)).all()
    if not inside:
        return False
    # Far outside its field a lens polynomial folds back into the picture.
    again = undistort(pixels, camera)
    straight = (_SQUARE * side_m)[:, :2] * (1.0, -1.0) + place[:2]
    return bool(np.allclose(again, straight / place[2], atol=1e-3))


def _is_covered(camera: CameraModel, place: Array, z_m: float, covered: NDArray[np.bool_]) -> bool:
    seen = project(target_m(camera, place, z_m), _TURNED, place, camera)
    return is_covered(covered, seen, camera.size_px)


def _absorbed(camera: CameraModel, place: Array, z_m: float) -> Array:
    """The solved translation's change by a change of the lens parameters, (3, p)."""
    pose = np.concatenate([_TURNED, place])[None]
    corners_m = target_m(camera, place, z_m)
    [(_, L, J)] = project_with_derivatives(camera.model, parameters_of(camera), pose, [corners_m])
    L, J = L.reshape(-1, L.shape[2]), J.reshape(-1, 6)
    # Corners stay where they are, so the pose moves against the lens.
    return np.asarray(-np.linalg.lstsq(J, L, rcond=None)[0][3:], dtype=np.float64)
