"""A stream's pictures through the pipeline, as far as the mounting is measured by them."""

from __future__ import annotations

import zlib

import numpy as np
from scipy.spatial.transform import Rotation

from perchctl.calibration.mounting.recording import SeenPose
from perchctl.camera import HealthState, assess_frame
from perchctl.geometry import R_MARKER_TARGET, Array
from perchctl.profile import Profile
from perchctl.vision import (
    MARKERS,
    CameraModel,
    Frame,
    MarkerPose,
    PipelineOutput,
    PipelineState,
    camera_profile,
    make_pipeline,
    pictures,
    step,
)


class PoseReader:
    """Reads the target's pose from each frame, and remembers what the pipeline must.

    `mirrored` counts the pictures in which a target was seen mirrored only. `outlines` are
    those of the newest picture, a marker's name and corners (4, 2) px; `trouble` is what keeps
    it from being searched.
    """

    def __init__(self, profile: Profile, camera: CameraModel, live: bool) -> None:
        # A pipeline that knows nothing of how the camera is mounted.
        bare = camera_profile(profile).model_copy(update={"pose": profile.pose})
        self._pipeline = make_pipeline(bare, camera)
        self._live = live
        self._state = PipelineState()
        self._health = HealthState()
        self.mirrored = 0
        self.outlines: tuple[tuple[str, Array], ...] = ()
        self.trouble = ""

    def look(self, frame: Frame) -> list[SeenPose]:
        """Return the target's poses in a frame: one, or one in each of its two fields."""
        self._health, judged = assess_frame(self._health, frame, self._live)
        if judged.kind == "repeated":
            return []
        self.outlines, self.trouble = (), ""
        if not judged.usable:
            self.trouble = judged.text
            if judged.kind in ("frozen", "snow"):
                return []
        self._state, found = pictures(self._state, frame, self._pipeline)
        seen = []
        for picture in found:
            self._state, output = step(self._state, picture, None, self._pipeline)
            self.mirrored += output.detections.mirrored and not output.poses
            named = ((name, output.detections.get(name)) for name in MARKERS)
            self.outlines = tuple((name, d.corners_px) for name, d in named if d is not None)
            pose = _best_pose(output, picture.t_s)
            if pose is not None:
                seen.append(pose)
        return seen


def pose_basis(profile: Profile, camera: CameraModel) -> str:
    """Return what poses rest on beside the pictures, in words: the printed sizes and the lens."""
    sides_mm = [f"{1e3 * m.side_m:g}" for m in (profile.target.large, profile.target.small)]
    K = camera.K
    lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.ravel(camera.dist)]
    number = zlib.crc32(np.round(np.array(lens, dtype=np.float64), 6).tobytes())
    return f"markers of {' and '.join(sides_mm)} mm, calibration {number:08x}"


def _best_pose(output: PipelineOutput, t_s: float) -> SeenPose | None:
    """Return the surest of a picture's poses, None without one.

    Args:
        t_s: the camera's own timestamp of the picture.
    """
    joint = output.poses.get("joint")
    single = [pose for pose in output.poses.values() if pose.camera_cov is not None]
    pose = joint or min(single, key=_uncertainty, default=None)
    if pose is None:
        return None
    cov = pose.camera_cov
    if cov is not None:
        J = np.eye(6)
        J[:3, :3] = _left_jacobian(pose.rvec_rad)
        cov = J @ cov @ J.T
    return SeenPose(
        t_s=t_s,
        rotation_cam_target=Rotation.from_rotvec(pose.rvec_rad).as_matrix() @ R_MARKER_TARGET,
        position_cam_target_m=pose.tvec_m,
        covariance=cov if cov is not None and np.isfinite(cov).all() else None,
    )


def _uncertainty(pose: MarkerPose) -> float:
    return float("inf") if pose.camera_cov is None else float(np.trace(pose.camera_cov[:3, :3]))


def _left_jacobian(v: Array) -> Array:
    """Return the change (3, 3) of a small rotation on the left of the one with the vector v
    (3,)."""
    angle = float(np.linalg.norm(v))
    K = np.cross(np.eye(3), v)
    if angle < 1e-6:
        return np.asarray(np.eye(3) + 0.5 * K)
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + a * K + b * (K @ K))
