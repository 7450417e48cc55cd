"""A target that is the positioning system: poses of it, as a picture would give them."""

from __future__ import annotations

import numpy as np

from perchctl.calibration import profile_camera
from perchctl.geometry import Array, Place, rot_z, wrap_rad
from perchctl.profile import Profile, load_profile
from perchctl.vision import MarkerPose, PoseSetup, VehicleState

TARGET_ONLY: Profile = load_profile("target_only")
SETUP: PoseSetup = PoseSetup(
    TARGET_ONLY.pose, TARGET_ONLY.target, TARGET_ONLY.camera.mount.T_body_cam, (0.01, -0.02, 0.03),
    profile_camera(TARGET_ONLY.camera),
)  # fmt: skip


def attitude(
    t_s: float, position_m: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw_rad: float = 0.0,
    roll_rad: float = 0.0, pitch_rad: float = 0.0,
) -> VehicleState:  # fmt: skip
    return VehicleState(t_s, roll_rad, pitch_rad, yaw_rad, position_m)


def seen(target: Place, at: VehicleState, sigma_m: float = 0.002) -> MarkerPose:
    """The target from a vehicle that is truly at `at`."""
    way_m: Array = rot_z(at.yaw_rad).T @ (target.position_m - np.array(at.position_m))
    e_m = way_m - at.R_level_body @ SETUP.gear_body_m
    return MarkerPose(
        source="joint", t_s=at.t_s, rvec_rad=np.zeros(3), tvec_m=e_m, e_m=e_m,
        e_yaw_rad=wrap_rad(target.yaw_rad - at.yaw_rad), sigma_m=np.full(3, sigma_m),
        sigma_yaw_rad=0.01, rms_reprojection_px=0.1,
    )  # fmt: skip
