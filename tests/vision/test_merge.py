"""Both markers become one target, at one moment of a rolling shutter."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import Array, wrap_rad, yaw_of
from perchctl.profile import Profile, WeightsConfig
from perchctl.vision import MarkerPose, PipelineState, deinterlace, make_pipeline, step
from perchctl.vision.merge import are_marker_positions_inconsistent, merge_xyz_yaw
from tests.helpers.interlaced import Pass
from tests.helpers.target_picture import CAMERA

unit = st.floats(0.0, 1.0)
weights = st.builds(WeightsConfig, x=unit, y=unit, z=unit, yaw=unit)
metre = st.floats(-2.0, 2.0)
angle = st.floats(-math.pi, math.pi)
vector = st.tuples(metre, metre, metre, angle).map(np.array)


def pose(
    e_m: tuple[float, float, float], sigma_m: float = 0.001, name: str = "large"
) -> MarkerPose:
    return MarkerPose(
        source=name,
        t_s=0.0,
        rvec_rad=np.zeros(3),
        tvec_m=np.zeros(3),
        e_m=np.array(e_m),
        e_yaw_rad=0.0,
        sigma_m=np.full(3, sigma_m),
        sigma_yaw_rad=0.01,
        rms_reprojection_px=0.1,
    )


@given(w=weights, a=vector, b=vector)
def test_position_is_w_times_the_pair_and_lies_between(w, a, b) -> None:
    merged = merge_xyz_yaw(a, b, w)
    of_large = np.array([w.x, w.y, w.z])  # equation 9
    assert np.allclose(merged[:3], of_large * a[:3] + (1.0 - of_large) * b[:3])
    assert (merged[:3] >= np.minimum(a, b)[:3] - 1e-12).all()
    assert (merged[:3] <= np.maximum(a, b)[:3] + 1e-12).all()


@given(w=weights, a=angle, gap=st.floats(-1.5, 1.5))
def test_yaw_is_merged_on_the_circle(w: WeightsConfig, a: float, gap: float) -> None:
    large, small = np.array([0, 0, 0, a]), np.array([0, 0, 0, wrap_rad(a + gap)])
    merged = merge_xyz_yaw(large, small, w)[3]
    assert abs(wrap_rad(merged - (a + (1.0 - w.yaw) * gap))) < 1e-9


def test_markers_disagree_beyond_the_limit_unless_they_are_vague() -> None:
    sure = pose((0.0, 0.0, 0.5))
    assert not are_marker_positions_inconsistent(sure, pose((0.0, 0.029, 0.5), name="small"), 0.03)
    assert are_marker_positions_inconsistent(sure, pose((0.0, 0.031, 0.5), name="small"), 0.03)
    assert are_marker_positions_inconsistent(sure, pose((0.0, 0.0, 0.54), name="small"), 0.03)
    assert not are_marker_positions_inconsistent(sure, pose((0.0, 0.0, 0.54), 0.02, "small"), 0.03)


# --- A rolling shutter's corners, brought to one moment ----------------------------------------


READOUT_S = 0.02


def measured(scene: Pass, readout_s: float | None) -> tuple[Array, float]:
    """RMS of x, y, z (mm) and yaw (deg) once motion is known, and the mean normalised squared
    error a degree of freedom."""
    values: dict[str, Any] = {
        "camera": {"mount": {"position_m": [0, 0, 0]}, "readout_s": readout_s},
        "vehicle": {"gear_body_m": [0, 0, 0]},
        "target": {"size_sigma": 0.0, "curl_per_m": 0.0},
    }
    setup = make_pipeline(Profile.model_validate(values), CAMERA)
    state, errors, nees = PipelineState(), [], []
    for k, frame in enumerate(scene.frames(12)):
        state, parts = deinterlace(state, frame, setup)
        for part in parts:
            state, output = step(state, part, None, setup)
            if k < 4:
                continue
            pose = output.poses["joint"]
            R = scene.T_world_cam(part.t_s)[:3, :3].T
            error = np.array(
                [*(pose.tvec_m - scene.target_m(part.t_s)), pose.e_yaw_rad - yaw_of(R)]
            )
            nees.append(error @ np.linalg.solve(pose.level_frame_xyz_yaw_cov, error) / 4.0)
            errors.append([*(1000.0 * error[:3]), np.degrees(error[3])])
    return np.sqrt(np.mean(np.square(errors), axis=0)), float(np.mean(nees))


ALONG = {"velocity_mps": (0.2, 0.1, 0.05), "turn_radps": 0.5}
ACROSS = {"velocity_mps": (0.0, 0.2, 0.0), "turn_radps": 0.0}


@pytest.mark.parametrize("motion", [ALONG, pytest.param(ACROSS, marks=pytest.mark.long)])
def test_a_known_shutter_does_no_harm(motion: dict[str, Any]) -> None:
    scene = Pass(0.3, **motion, camera_readout_s=READOUT_S)
    known, nees = measured(scene, READOUT_S)
    taken_for_global, _ = measured(scene, 0.0)
    assert (known < [0.06, 0.06, 0.1, 0.04]).all()
    assert nees < 3.0
    # What it would have been: stretched along the columns, or sheared along the rows.
    assert taken_for_global[2] > 1.0 or taken_for_global[3] > 0.2


@pytest.mark.parametrize("motion", [pytest.param(ALONG, marks=pytest.mark.long), ACROSS])
def test_an_unknown_shutter_makes_modest(motion: dict[str, Any]) -> None:
    scene = Pass(0.3, **motion, camera_readout_s=READOUT_S)
    assert measured(scene, None)[1] < 1.5
    assert measured(scene, 0.0)[1] > 2.0
