from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.geometry import wrap_rad
from perchctl.profile import MergeConfig, WeightsConfig
from perchctl.vision import MarkerPose, Stage, better_conditioned
from perchctl.vision.merge import (
    choose_stage,
    disagree,
    merge_pair,
    merge_variance,
    stage_by_range,
    stage_of,
    weight_matrix,
)

unit = st.floats(0.0, 1.0)
weights = st.builds(WeightsConfig, x=unit, y=unit, z=unit, yaw=unit)
metre = st.floats(-2.0, 2.0)
angle = st.floats(-math.pi, math.pi)
vector = st.tuples(metre, metre, metre, angle).map(np.array)


def pose(
    e_m: tuple[float, float, float], sigma_m: float = 0.001, name: str = "large"
) -> MarkerPose:
    return MarkerPose(
        source=name,  # type: ignore[arg-type]
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


@given(w=weights, v=vector)
def test_two_equal_poses_merge_to_themselves(w: WeightsConfig, v: np.ndarray) -> None:
    merged = merge_pair(v, v, w)
    assert np.allclose(merged[:3], v[:3], atol=1e-12)
    assert abs(wrap_rad(float(merged[3] - v[3]))) < 1e-9


@given(w=weights, a=vector, b=vector)
def test_position_is_w_times_the_pair_and_lies_between(w, a, b) -> None:  # type: ignore[no-untyped-def]
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


def test_the_papers_weight_at_180_deg() -> None:
    large, small = np.zeros(4), np.zeros(4)
    large[3], small[3] = math.radians(179.0), math.radians(-179.0)
    merged = merge_pair(large, small, WeightsConfig(yaw=0.469))[3]
    assert math.degrees(wrap_rad(merged - math.pi)) == pytest.approx(0.062, abs=1e-6)


@given(w=weights)
def test_variances_propagate(w: WeightsConfig) -> None:
    rng = np.random.default_rng(0)
    large = rng.normal(0.0, [1, 2, 3, 0.01], (4000, 4))
    small = rng.normal(0.0, [3, 1, 2, 0.02], (4000, 4))
    merged = large @ np.diag([w.x, w.y, w.z, w.yaw])
    merged += small @ np.diag([1 - w.x, 1 - w.y, 1 - w.z, 1 - w.yaw])
    expected = merge_variance(np.array([1, 4, 9, 1e-4]), np.array([9, 1, 4, 4e-4]), w)
    assert np.allclose(merged.var(axis=0), expected, rtol=0.15)


@pytest.mark.parametrize(
    ("large", "small", "stage"),
    [
        (False, False, Stage.NONE),
        (True, False, Stage.LARGE),
        (False, True, Stage.SMALL),
        (True, True, Stage.BOTH),
    ],
)
def test_stage_by_what_is_seen(large: bool, small: bool, stage: Stage) -> None:
    assert stage_of(large, small) is stage
    for z in (0.05, 0.2, 0.5, None):
        assert choose_stage(large, small, z, MergeConfig()) is stage


@pytest.mark.parametrize(
    ("z_m", "stage"),
    [
        (2.0, Stage.LARGE),
        (1.15, Stage.LARGE),
        (0.26, Stage.LARGE),
        (0.25, Stage.BOTH),
        (0.2, Stage.BOTH),
        (0.13, Stage.BOTH),
        (0.12, Stage.SMALL),
        (0.05, Stage.SMALL),
    ],
)
def test_stage_by_range(z_m: float, stage: Stage) -> None:
    config = MergeConfig(stages="range")
    assert stage_by_range(z_m, config) is stage
    assert choose_stage(True, True, z_m, config) is stage
    assert choose_stage(True, False, z_m, config) is Stage.LARGE  # what is there is used
    assert choose_stage(False, True, z_m, config) is Stage.SMALL


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
