"""The pipeline on the way to contact, where the picture cuts both markers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, Profile
from perchctl.vision import (
    Attitude,
    Detection,
    Frame,
    PipelineOutput,
    PipelineState,
    estimate_pose,
    project,
    square_corners,
    step,
)
from perchctl.vision.pose import make_pose_setup
from tests.helpers.target_picture import CAMERA, pose_of, render

# Of the target in the camera: beside the gear along width and height, and under it.
SIDEWAYS = {"width": (-0.030, 0.002), "height": (0.001, -0.030), "under": (0.002, 0.001)}
NEAREST_M = {"width": 0.025, "height": 0.033, "under": 0.012}
STEP_M = 0.003


def ascent(
    build: Any, along: str, with_attitude: bool, cut: bool = True
) -> list[tuple[float, PipelineOutput]]:
    """The camera's distance, and what its picture gave."""
    setup = build(detector=DetectorConfig(cut=cut))
    x, y = SIDEWAYS[along]
    state, out = PipelineState(), []
    for k, z in enumerate(np.arange(0.075, NEAREST_M[along], -STEP_M)):
        image = render(*pose_of(x, y, z, 0.02 * k / 20), noise=4.0, blur_px=1.0, seed=k)
        attitude = Attitude(k / 30, 0.0, 0.0, 0.0, (0.0, 0.0, -z)) if with_attitude else None
        state, output = step(state, Frame(k, k / 30, image), attitude, setup)
        out.append((float(z), output))
    return out


def errors_m(rows: list[tuple[float, PipelineOutput]], along: str) -> Array:
    return np.array([next(iter(o.poses.values())).e_m - (*SIDEWAYS[along], z) for z, o in rows])


@pytest.mark.parametrize(
    "along",
    [
        "height",
        pytest.param("width", marks=pytest.mark.long),
        pytest.param("under", marks=pytest.mark.long),
    ],
)
def test_an_ascent_is_measured_to_the_end(build: Any, along: str) -> None:
    rows = ascent(build, along, with_attitude=along != "under")
    assert all(o.target is not None and o.target.measured for _, o in rows)
    cut = [(z, o) for z, o in rows if o.detections.small.cov_px2 is not None]  # type: ignore[union-attr]
    assert len(cut) >= 2
    assert np.abs(errors_m(cut, along)).max() < 1e-4
    # Of the corners' own noise alone: no print is wrong here.
    claimed = np.array([next(iter(o.poses.values())).sigma_m for _, o in cut])
    assert ((errors_m(cut, along) / claimed) ** 2).mean() < 2.0
    assert claimed.max() < 5e-4


@pytest.mark.long
def test_without_it_the_last_centimetres_are_blind(build: Any) -> None:
    rows = ascent(build, "height", with_attitude=True, cut=False)
    assert not any(o.poses for z, o in rows if z < 0.05)


def test_a_pose_heeds_the_covariance_of_its_corners() -> None:
    """What is off in the direction in which the corners are vague moves the pose little, and
    the pose claims as much as they do."""
    setup = make_pose_setup(Profile().pose, Profile().target, np.eye(4), (0.0, 0.0, 0.0), CAMERA)
    true = pose_of(0.0, -0.01, 0.05, 0.1)
    at = project(square_corners(0.025), *true, CAMERA)
    vague = np.tile([0.0, 1.0], 4)  # all of them together, along the picture's height
    cov = 0.02**2 * np.eye(8) + 4.0 * np.outer(vague, vague)
    off = at + 2.0 * vague.reshape(4, 2)

    def pose(cov_px2: Array | None) -> Any:
        seen = Detection("small", off, 0.02, True, cov_px2=cov_px2)
        return estimate_pose([seen], 0.0, None, setup)

    heedless, heeding = pose(None), pose(cov)
    assert heeding.sigma_m[1] > 5.0 * heedless.sigma_m[1]
    assert heeding.sigma_m[1] > 3.0 * heeding.sigma_m[0]
    assert abs(heeding.e_m[1] + 0.01) < 3.0 * heeding.sigma_m[1]
    assert abs(heedless.e_m[1] + 0.01) > 4.0 * heedless.sigma_m[1]
