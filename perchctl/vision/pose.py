"""From corners to the target's pose relative to the gear.

All solving is done in pixels of a pinhole with the camera's `K`, from corners that
were undistorted. A planar marker has two tilts with nearly the same picture; which
one is true is decided by the vehicle's roll and pitch (the target lies level) or by
the tilt of the frame before. The position comes from the camera-frame translation,
turned level by the vehicle's roll and pitch, never from the marker's own axes: at
1.15 m that is 0.5 mm against 40 mm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from perchctl.geometry import R_MARKER_TARGET, Array, finite, yaw_of
from perchctl.profile import PoseConfig, TargetConfig
from perchctl.values import replace
from perchctl.vision.camera_model import undistort_px
from perchctl.vision.points import Points, make_points
from perchctl.vision.solve import (
    PoseCandidate,
    Scored,
    TiltPrior,
    covariance,
    flat,
    gauss_newton,
    lift_of,
    mirror_solution,
    solve,
)
from perchctl.vision.types import MARKERS, Attitude, CameraModel, Detection, MarkerName, MarkerPose

_ATTITUDE_TILT_RAD = math.radians(6.0)  # mounting, estimate and ceiling together
_PREVIOUS_TILT_RAD = math.radians(10.0)  # between two frames
_CURLED_CHI2 = 3.0  # of both markers' corners on a flat sheet, a degree of freedom
_EXPLAINED = 0.5  # of that is left where the sheet's curl is what it comes from
_Source = Literal["large", "small", "joint"]

__all__ = [
    "PoseSetup",
    "estimate_pose",
    "level_rotation",
    "make_pose_setup",
    "mirror_solution",
    "normal_cam",
    "rotation_matrix",
    "rotation_vector",
    "square_corners",
]


@dataclass(frozen=True, eq=False)
class PoseSetup:
    """`object_points` (4, 3) m in marker axes, in the order of the corners."""

    config: PoseConfig
    object_points: dict[MarkerName, Array]
    T_body_cam: Array
    gear_body_m: Array
    camera: CameraModel
    readout_s: float | None = 0.0  # of the camera's shutter; None: not known
    size_sigma: float = 0.0  # of the printed sizes, a share of them
    curl_per_m: float = 0.0  # of the sheet: lift over the square of the way from its centre

    @cached_property
    def all_points(self) -> Array:
        """Of both markers, the large one's first, (8, 3)."""
        return np.concatenate([self.object_points[name] for name in MARKERS])

    @cached_property
    def lift(self) -> dict[MarkerName, Array]:
        """Of each marker's corners, on a sheet that curls."""
        return {n: lift_of(points, self.curl_per_m) for n, points in self.object_points.items()}

    @cached_property
    def all_lift(self) -> Array:
        """Of both."""
        return lift_of(self.all_points, self.curl_per_m)


def make_pose_setup(
    config: PoseConfig,
    target: TargetConfig,
    T_body_cam: Array,
    gear_body_m: Sequence[float] | Array,
    camera: CameraModel,
    readout_s: float | None = 0.0,
) -> PoseSetup:
    """The constants of pose estimation, from the profile and the calibrated camera."""
    return PoseSetup(
        config=config,
        object_points={
            "large": square_corners(target.large.side_m),
            "small": square_corners(target.small.side_m),
        },
        T_body_cam=np.asarray(T_body_cam, dtype=np.float64),
        gear_body_m=np.asarray(gear_body_m, dtype=np.float64),
        camera=camera,
        readout_s=readout_s,
        size_sigma=target.size_sigma,
        curl_per_m=target.curl_per_m,
    )


def square_corners(side_m: float) -> Array:
    """Corners TL TR BR BL of a marker in its own axes, (4, 3)."""
    h = side_m / 2.0
    return np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])


def level_rotation(attitude: Attitude | None) -> Array:
    """``R_level_body`` (3, 3); without an attitude the vehicle counts as level."""
    return np.eye(3) if attitude is None else attitude.R_level_body


def estimate_pose(
    detections: Sequence[Detection],
    t_s: float,
    attitude: Attitude | None,
    setup: PoseSetup,
    previous_normal_cam: Array | None = None,
    start: PoseCandidate | None = None,
) -> MarkerPose | None:
    """The pose from one marker's corners, or from both markers' corners at once.

    `start` is a pose of the same frame whose tilt is already decided (the joint one):
    it is refined on these corners instead of solving anew.
    None where the corners give no pose: no finite solution in front of the camera, or
    a reprojection error (RMS over the corners) above `pose.max_reprojection_px`.
    """
    points = _points(detections, setup)
    if points is None:
        return None
    R_level_body = level_rotation(attitude)
    if attitude is not None:
        R_level_cam = R_level_body.dot(setup.T_body_cam[:3, :3])
        prior = TiltPrior(-R_level_cam[2], _ATTITUDE_TILT_RAD)
    else:
        prior = TiltPrior(previous_normal_cam, _PREVIOUS_TILT_RAD)
    solution = _continued(points, start, prior, setup.config) or _solved(
        points, prior, setup.config
    )
    if solution is None:
        return None
    source = "joint" if len(detections) > 1 else detections[0].marker
    pose = _level_pose(source, t_s, solution, points, R_level_body, setup)
    if source != "joint" or pose.chi2 < _CURLED_CHI2 or setup.curl_per_m == 0.0:
        return pose
    if any(d.lying_sigma_px > 0.0 for d in detections):
        return pose  # sides between interpolated rows look curled
    # No flat sheet has both markers where they are. One that curls may, or the corners err.
    points = replace(points, curled=True)
    settled = _continued(points, solution, prior, setup.config)
    if settled is None:
        return pose
    bent = _level_pose(source, t_s, settled, points, R_level_body, setup)
    return replace(bent, chi2=pose.chi2) if bent.chi2 < _EXPLAINED * pose.chi2 else pose


def _points(detections: Sequence[Detection], setup: PoseSetup) -> Points | None:
    """The corners through a pinhole, None where the lens cannot have imaged them."""
    if len(detections) > 1:
        object_m, lift = setup.all_points, setup.all_lift
        raw_px = np.concatenate([d.corners_px for d in detections])
    else:
        marker, raw_px = detections[0].marker, detections[0].corners_px
        object_m, lift = setup.object_points[marker], setup.lift[marker]
    image_px = undistort_px(raw_px, setup.camera)
    if not finite(image_px):
        return None
    return make_points(detections, object_m, image_px, setup.camera.K, lift)


def _continued(
    points: Points, start: PoseCandidate | None, prior: TiltPrior, config: PoseConfig
) -> Scored | None:
    """The solution next to a start, None where there is none that fits."""
    if start is None or not config.refine:
        return None
    solution = gauss_newton(points, start)
    if solution is None or not _fits(solution, config) or prior.contradicts(solution):
        return None
    return solution


def _solved(points: Points, prior: TiltPrior, config: PoseConfig) -> Scored | None:
    """The solution without a start, None where none fits."""
    solution = solve(points, config.solver, config.refine, prior)
    if not _fits(solution, config) and config.solver != "sqpnp":
        # EPnP and IPPE fail on exactly frontal views, which is where hovering happens.
        solution = solve(points, "sqpnp", config.refine, prior)
    return solution if _fits(solution, config) else None


def _fits(solution: Scored | None, config: PoseConfig) -> bool:
    return solution is not None and solution.rms_px <= config.max_reprojection_px


def _level_pose(
    source: _Source,
    t_s: float,
    solution: Scored,
    points: Points,
    R_level_body: Array,
    setup: PoseSetup,
) -> MarkerPose:
    """The solution, relative to the gear in the level frame, with its covariance there."""
    R_body_cam, t_body_cam_m = setup.T_body_cam[:3, :3], setup.T_body_cam[:3, 3]
    R_level_cam = R_level_body.dot(R_body_cam)
    R, dR = (np.asarray(m, dtype=np.float64) for m in cv2.Rodrigues(solution.rvec))
    cov, chi2, curl = covariance(points, solution)
    e_m = R_level_body.dot(R_body_cam.dot(solution.tvec) + t_body_cam_m - setup.gear_body_m)
    heading = R_level_cam.dot(R).dot(R_MARKER_TARGET)
    G = np.zeros((4, 6))  # change of (e, e_yaw) with (rvec, tvec)
    G[:3, 3:] = R_level_cam
    G[3, :3] = _yaw_gradient(R_level_cam, heading, dR)
    cov_e = G.dot(cov).dot(G.T)
    # A target that is larger by a share is farther away by that share of the way to it.
    print_cam = np.array([setup.size_sigma * solution.tvec, curl[3:]])
    print_m = R_level_cam.dot(print_cam.T)
    cov_e[:3, :3] += print_m.dot(print_m.T)
    sigma = np.sqrt(np.maximum(cov_e.diagonal(), 0.0))
    return MarkerPose(
        source=source,
        t_s=t_s,
        rvec_rad=solution.rvec,
        tvec_m=solution.tvec,
        e_m=e_m,
        e_yaw_rad=yaw_of(heading),
        sigma_m=sigma[:3],
        sigma_yaw_rad=float(sigma[3]),
        reprojection_px=solution.rms_px,
        chi2=chi2,
        cov=cov_e,
        print_m=print_m,
        camera_cov=cov,
    )


def rotation_matrix(rvec: Array) -> Array:
    return np.asarray(cv2.Rodrigues(rvec)[0], dtype=np.float64)


def rotation_vector(R: Array) -> Array:
    """The rotation vector (3,) rad of a rotation matrix (3, 3)."""
    return flat(cv2.Rodrigues(R)[0])


def normal_cam(pose: MarkerPose) -> Array:
    """The marker's z axis (out of the paper) in camera axes, (3,)."""
    return np.asarray(cv2.Rodrigues(pose.rvec_rad)[0][:, 2])


def _yaw_gradient(R_level_cam: Array, heading: Array, dR: Array) -> Array:
    """Change of atan2(h[1, 0], h[0, 0]) with rvec through ``dR/drvec`` (3, 9); the
    target's x axis is the marker's. (3,)"""
    dx = dR.reshape(3, 3, 3)[:, :, 0].dot(R_level_cam.T)  # (rvec component, level axis)
    hx, hy = float(heading[0, 0]), float(heading[1, 0])
    return np.asarray((hx * dx[:, 1] - hy * dx[:, 0]) / max(hx * hx + hy * hy, 1e-12))
