"""Both markers become one target, at one moment of a rolling shutter."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import Array, wrap_rad, yaw_of
from perchctl.profile import MergeConfig, Profile, WeightsConfig
from perchctl.vision import (
    MarkerPose,
    PipelineState,
    PoseSetup,
    make_pipeline,
    pictures,
    step,
)
from perchctl.vision.merge import (
    UNKNOWN_READOUT_S,
    better_conditioned,
    choose_stage,
    disagree,
    merge_pair,
    merge_variance,
    seen_at_once,
    stage_of,
    weight_matrix,
)
from perchctl.vision.types import Detection, Detections, Stage
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
        reprojection_px=0.1,
    )


def test_w_is_equation_9() -> None:
    w = WeightsConfig(x=0.275, y=0.306, z=0.728, yaw=0.469)
    W = weight_matrix(w)
    expected = np.array(
        [
            [0.275, 0.725, 0, 0, 0, 0, 0, 0],
            [0, 0, 0.306, 0.694, 0, 0, 0, 0],
            [0, 0, 0, 0, 0.728, 0.272, 0, 0],
            [0, 0, 0, 0, 0, 0, 0.469, 0.531],
        ]
    )
    assert np.allclose(W, expected)


@given(w=weights, a=vector, b=vector)
def test_position_is_w_times_the_pair_and_lies_between(w, a, b) -> None:
    merged = merge_pair(a, b, w)
    pairs = np.array([a[0], b[0], a[1], b[1], a[2], b[2], a[3], b[3]])  # equation 7
    assert np.allclose(merged[:3], (weight_matrix(w) @ pairs)[:3])
    assert (merged[:3] >= np.minimum(a, b)[:3] - 1e-12).all()
    assert (merged[:3] <= np.maximum(a, b)[:3] + 1e-12).all()


@given(w=weights, a=angle, gap=st.floats(-1.5, 1.5))
def test_yaw_is_merged_on_the_circle(w: WeightsConfig, a: float, gap: float) -> None:
    large, small = np.array([0, 0, 0, a]), np.array([0, 0, 0, wrap_rad(a + gap)])
    merged = merge_pair(large, small, w)[3]
    assert abs(wrap_rad(merged - (a + (1.0 - w.yaw) * gap))) < 1e-9


@given(w=weights)
def test_variances_propagate(w: WeightsConfig) -> None:
    rng = np.random.default_rng(0)
    large = rng.normal(0.0, [1, 2, 3, 0.01], (4000, 4))
    small = rng.normal(0.0, [3, 1, 2, 0.02], (4000, 4))
    merged = large @ np.diag([w.x, w.y, w.z, w.yaw])
    merged += small @ np.diag([1 - w.x, 1 - w.y, 1 - w.z, 1 - w.yaw])
    expected = merge_variance(np.array([1, 4, 9, 1e-4]), np.array([9, 1, 4, 4e-4]), w)
    assert np.allclose(merged.var(axis=0), expected, rtol=0.15)


SEEN = {
    (False, False): Stage.NONE,
    (True, False): Stage.LARGE,
    (False, True): Stage.SMALL,
    (True, True): Stage.BOTH,
}


@pytest.mark.parametrize("z_m", [2.0, 0.26, 0.25, 0.13, 0.12, 0.05, None])
def test_the_stage_is_what_is_seen_or_what_the_range_asks_for_of_it(z_m: float | None) -> None:
    """Equations 4, 6 and 11."""
    for (large, small), stage in SEEN.items():
        assert stage_of(large, small) is stage
        assert choose_stage(large, small, z_m, MergeConfig()) is stage
        asked = choose_stage(large, small, z_m, MergeConfig(stages="range"))
        if stage is Stage.BOTH and z_m is not None:
            far, near = z_m > 0.25, z_m <= 0.12
            assert asked is (Stage.LARGE if far else Stage.SMALL if near else Stage.BOTH)
        else:
            assert asked is stage


def test_markers_disagree_beyond_the_limit_unless_they_are_vague() -> None:
    sure = pose((0.0, 0.0, 0.5))
    assert not disagree(sure, pose((0.0, 0.029, 0.5), name="small"), 0.03)
    assert disagree(sure, pose((0.0, 0.031, 0.5), name="small"), 0.03)
    assert disagree(sure, pose((0.0, 0.0, 0.54), name="small"), 0.03)
    assert not disagree(sure, pose((0.0, 0.0, 0.54), 0.02, "small"), 0.03)


def test_the_better_conditioned_marker_wins() -> None:
    large, small = pose((0, 0, 0.5), 0.001), pose((0, 0, 0.5), 0.004, "small")
    assert better_conditioned(large, small) is large
    assert better_conditioned(pose((0, 0, 0.5), 0.01), small) is small


# --- A rolling shutter's corners, brought to one moment ----------------------------------------


READOUT_S = 0.02
CORNERS = np.array([[100.0, 50.0], [200.0, 50.0], [200.0, 400.0], [100.0, 400.0]])


def shutter(readout_s: float | None) -> PoseSetup:
    values = Profile()
    mount, gear_m = values.camera.mount, values.vehicle.gear_body_m
    return PoseSetup(values.pose, values.target, mount.T_body_cam, gear_m, CAMERA, readout_s)


def moving(corners: Array, velocity_px_s: tuple[float, float]) -> Detections:
    flow = np.tile(velocity_px_s, (4, 1))
    return Detections(
        1, 0.0, large=Detection("large", corners, 0.05, True),
        velocity_px_s=flow[0], flow_px_s={"large": flow},
    )  # fmt: skip


@pytest.mark.parametrize("velocity_px_s", [(300.0, 0.0), (0.0, 300.0), (-200.0, -400.0)])
def test_corners_go_back_to_the_middle_rows_moment(velocity_px_s: tuple[float, float]) -> None:
    """Corners that move evenly, each seen when the shutter's row meets it."""
    v = np.array(velocity_px_s)

    def seen(frame_s: float) -> Array:
        # Row y is exposed at frame_s + (y / 479 - 1/2) R, and the corner is at its y then.
        slope = READOUT_S / 479.0
        t_s = (frame_s + (CORNERS[:, 1] / 479.0 - 0.5) * READOUT_S) / (1.0 - v[1] * slope)
        return np.asarray(CORNERS + v * t_s[:, None])

    now, before = seen(0.0), seen(-0.04)
    flow = (now - before) / 0.04
    found = Detections(1, 0.0, large=Detection("large", now, 0.05, True), flow_px_s={"large": flow})
    (back,) = seen_at_once(found, shutter(READOUT_S))
    assert np.abs(now - CORNERS).max() > 1.0
    assert back.corners_px == pytest.approx(CORNERS, abs=1e-6)


def test_without_motion_or_a_rolling_shutter_nothing_moves() -> None:
    still = Detections(0, 0.0, small=Detection("small", CORNERS, 0.05, True))
    for readout_s in (0.0, READOUT_S, None):
        assert seen_at_once(still, shutter(readout_s)) == [still.small]
    fast = moving(CORNERS, (300.0, 0.0))
    assert seen_at_once(fast, shutter(0.0)) == [fast.large]


def test_an_unknown_shutter_is_an_error_of_all_corners_together() -> None:
    (seen,) = seen_at_once(moving(CORNERS, (300.0, 0.0)), shutter(None))
    assert np.array_equal(seen.corners_px, CORNERS)
    assert seen.common_px[0] == pytest.approx((-300.0 * UNKNOWN_READOUT_S * (0.5 - 50 / 479), 0.0))
    assert (seen.common_px[2] > 0.0)[0]


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
        state, parts = pictures(state, frame, setup)
        for part in parts:
            state, output = step(state, part, None, setup)
            if k < 4:
                continue
            pose = output.poses["joint"]
            R = scene.T_world_cam(part.t_s)[:3, :3].T
            error = np.array(
                [*(pose.tvec_m - scene.target_m(part.t_s)), pose.e_yaw_rad - yaw_of(R)]
            )
            nees.append(error @ np.linalg.solve(pose.cov, error) / 4.0)
            errors.append([*(1000.0 * error[:3]), np.degrees(error[3])])
    return np.sqrt(np.mean(np.square(errors), axis=0)), float(np.mean(nees))


ALONG = {"velocity_mps": (0.2, 0.1, 0.05), "turn_radps": 0.5}
ACROSS = {"velocity_mps": (0.0, 0.2, 0.0), "turn_radps": 0.0}


@pytest.mark.parametrize("motion", [ALONG, ACROSS])
def test_a_known_shutter_does_no_harm(motion: dict[str, Any]) -> None:
    scene = Pass(0.3, **motion, camera_readout_s=READOUT_S)
    known, nees = measured(scene, READOUT_S)
    taken_for_global, _ = measured(scene, 0.0)
    assert (known < [0.06, 0.06, 0.1, 0.04]).all()
    assert nees < 3.0
    # What it would have been: stretched along the columns, or sheared along the rows.
    assert taken_for_global[2] > 1.0 or taken_for_global[3] > 0.2


@pytest.mark.parametrize("motion", [ALONG, ACROSS])
def test_an_unknown_shutter_makes_modest(motion: dict[str, Any]) -> None:
    scene = Pass(0.3, **motion, camera_readout_s=READOUT_S)
    assert measured(scene, None)[1] < 1.5
    assert measured(scene, 0.0)[1] > 2.0


def test_fields_have_a_shutter_each() -> None:
    scene = Pass(0.3, **ACROSS, camera_readout_s=READOUT_S, camera_fields="top")
    known, _ = measured(scene, READOUT_S)
    assert (known < [0.06, 0.06, 0.12, 0.04]).all()
