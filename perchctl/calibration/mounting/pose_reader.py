"""Read the target's poses from a stream of images, for measuring the mounting."""

from __future__ import annotations

import cv2
import numpy as np

from perchctl.calibration.mounting.recording import TargetPose
from perchctl.camera import VERDICT_TEXTS
from perchctl.geometry import R_MARKER_TARGET, Array
from perchctl.perception import Perception
from perchctl.profile import Profile
from perchctl.vision import (
    MARKERS,
    CameraModel,
    Frame,
    MarkerPose,
    PipelineOutput,
    make_camera_only_profile,
    make_pipeline,
    target_rotation_translation_cov_cam,
)


class PoseReader:
    """Reads the target's pose from each frame of a stream.

    `mirrored` counts the images that show only a mirrored target. For the newest image, `outlines`
    contains the markers' names and corners, (4, 2) px each, and `trouble` names the image's defect,
    or is empty.
    """

    def __init__(self, profile: Profile, camera: CameraModel, live: bool) -> None:
        # This pipeline knows nothing about the camera's mounting.
        bare = make_camera_only_profile(profile).model_copy(update={"pose": profile.pose})
        self._perception = Perception(make_pipeline(bare, camera), bare)
        self._live = live
        self.mirrored = 0
        self.outlines: tuple[tuple[str, Array], ...] = ()
        self.trouble = ""

    def read_poses(self, frame: Frame) -> list[TargetPose]:
        """Return the target's poses in a frame: at most one, or one per field of an interlaced
        frame."""
        judged = self._perception.health.assess(frame, self._live)
        if judged == "repeated":
            return []
        self.outlines = ()
        self.trouble = "" if judged == "ok" else VERDICT_TEXTS[judged]
        if judged in ("frozen", "snow"):
            return []
        seen = []
        for picture, output in self._perception.process_fields(frame):
            self.mirrored += output.detections.is_mirrored_marker_seen and not output.poses
            named = ((name, output.detections.get(name)) for name in MARKERS)
            self.outlines = tuple((name, d.corners_px) for name, d in named if d is not None)
            pose = _best_pose(output, picture.t_s)
            if pose is not None:
                seen.append(pose)
        return seen


def _best_pose(output: PipelineOutput, t_s: float) -> TargetPose | None:
    pose = output.poses.get("joint") or min(output.poses.values(), key=_uncertainty, default=None)
    if pose is None or pose.rvec_tvec_cov is None or not np.isfinite(pose.rvec_tvec_cov).all():
        return None
    R = np.asarray(cv2.Rodrigues(pose.rvec_rad)[0], dtype=np.float64)
    return TargetPose(
        t_s, R @ R_MARKER_TARGET, pose.tvec_m, target_rotation_translation_cov_cam(pose)
    )


def _uncertainty(pose: MarkerPose) -> float:
    return (
        float("inf") if pose.rvec_tvec_cov is None else float(np.trace(pose.rvec_tvec_cov[:3, :3]))
    )
