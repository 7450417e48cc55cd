"""Recordings of a hand-held vehicle without any picture: true poses, and what is laid upon them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from perchctl.calibration import MountingRecording
from perchctl.calibration.mounting.recording import MountingPart, TargetPose
from perchctl.profile import Profile, load_profile
from tests.helpers.hand import Hand, R_target_cam, attitudes, cam_target_m, draw_hand

BARE_STREAM = 431
TURN_SIGMA_RAD = np.radians((0.15, 0.15, 0.05))
PLACE_SHARE = np.array((0.0005, 0.0005, 0.001))
"""Of the distance: about as rendered pictures give them."""


@cache
def profile() -> Profile:
    return load_profile("sim")


def hand(
    part: MountingPart, seed: int = 0, seconds: float = 21.0, latency_s: float | None = None
) -> Hand:
    """Slower pictures than the profile's, and a print that is true."""
    drawn = replace(draw_hand(profile(), part, seed, seconds), size_error=0.0)
    scenario = replace(drawn.scenario, camera_rate_hz=15.0)
    if latency_s is not None:
        scenario = replace(scenario, camera_latency_s=latency_s)
    return replace(drawn, scenario=scenario)


def seen(
    held: Hand, errors: bool = True, wrong: float = 0.0, claimed: float = 1.0, salt: int = 0
) -> MountingRecording:
    """The part as a pipeline would have seen it.

    Args:
        errors: noise, jitter and losses as in flight; False: all true.
        wrong: share of poses that are off by tens of degrees and centimetres.
        claimed: by which factor the poses' covariances are too large.
    """
    scene = held.scenario
    rng = np.random.default_rng([held.seed, BARE_STREAM, salt])
    exposed_s = np.arange(0.15, held.seconds, 1.0 / scene.camera_rate_hz)
    exposed_s = exposed_s[rng.random(len(exposed_s)) >= (scene.camera_drop_rate if errors else 0)]
    R = R_target_cam(held, exposed_s).transpose(0, 2, 1)
    p = -np.einsum("nij,nj->ni", R, cam_target_m(held, exposed_s)) / (1.0 + held.size_error)
    stamped_s = exposed_s + scene.camera_latency_s
    far = np.linalg.norm(p, axis=1)[:, None]
    sigma = np.hstack([np.broadcast_to(TURN_SIGMA_RAD, p.shape), PLACE_SHARE * far])
    if errors:
        jitter = np.clip(rng.normal(size=len(p)), -2.5, 2.5) * scene.camera_jitter_s
        stamped_s = np.maximum.accumulate(stamped_s + jitter)
        noise = rng.normal(size=sigma.shape) * sigma
        R, p = Rotation.from_rotvec(noise[:, :3]).as_matrix() @ R, p + noise[:, 3:]
    for k in np.flatnonzero(rng.random(len(p)) < wrong):
        R[k] = Rotation.from_rotvec(rng.normal(size=3) * 0.5).as_matrix() @ R[k]
        p[k] = p[k] + rng.normal(size=3) * 0.02
    poses = [
        TargetPose(float(t), R[k], p[k], np.diag(claimed * sigma[k] ** 2))
        for k, t in enumerate(stamped_s)
    ]
    return MountingRecording(held.part, attitudes(held, errors), poses)
