"""Laws of the simulated camera's schedule."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array, make_T
from perchctl.profile import TargetConfig
from perchctl.sim import (
    CONTROL_PERIOD_S,
    Renderer,
    Scenario,
    SimCamera,
    SimulatedVehicle,
)
from perchctl.sim.camera import DeliveredFrame
from perchctl.sim.renderer import Shot
from perchctl.vision import CameraModel


def pose_at(t_s: float) -> Array:
    return make_T(np.eye(3), (0.1 * t_s, 0.0, 1.0))


class Stub:
    """Stands for the renderer: a picture of its index and of the pose at mid-exposure."""

    camera = SimpleNamespace(size_px=(2, 2))

    def __init__(self) -> None:
        self.rendered: list[int] = []

    def expose(self, shots: Sequence[Shot], frame_index: int = 0) -> Any:
        self.rendered.append(frame_index)
        (poses,) = shots[0].rows
        middle = poses[len(poses) // 2]
        return np.array([[frame_index, round(middle[0, 3] * 1e6)]])


def run(
    scene: Scenario, until_s: float = 4.0, step_s: float = CONTROL_PERIOD_S
) -> tuple[list[DeliveredFrame], Stub]:
    stub = Stub()
    camera = SimCamera(scene, cast(Renderer, stub))
    frames = []
    for k in range(1, round(until_s / step_s) + 1):
        camera.advance(k * step_s, pose_at)
        new = camera.take()
        assert all(f.t_arrival_s <= k * step_s for f in new)
        frames += new
    return frames, stub


scenarios = st.builds(
    Scenario,
    seed=st.integers(0, 2**32 - 1),
    camera_rate_hz=st.sampled_from([15.0, 30.0, 60.0]),
    camera_latency_s=st.floats(0.0, 0.2),
    camera_jitter_s=st.floats(0.0, 0.05),
    camera_drop_rate=st.sampled_from([0.0, 0.1, 0.5]),
    camera_exposure_s=st.floats(0.0, 0.015),
    camera_burst=st.one_of(st.none(), st.tuples(st.floats(0.0, 1.0), st.integers(0, 20))),
    camera_freeze_at_s=st.one_of(st.none(), st.floats(0.0, 1.5)),
    camera_gone_at_s=st.one_of(st.none(), st.floats(0.0, 1.5)),
)


@settings(max_examples=20, deadline=None, derandomize=True)
@given(scenarios)
def test_one_that_mirrors_gives_the_same_pictures_flipped(scene: Scenario) -> None:
    plain, _ = run(scene, 0.6, 0.005)
    mirrored, _ = run(replace(scene, camera_mirrored=True), 0.6, 0.005)
    for one, other in zip(plain, mirrored, strict=True):
        assert (one.t_arrival_s, one.index) == (other.t_arrival_s, other.index)
        assert (one.image[:, ::-1] == other.image).all()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(scenarios)
def test_laws_of_the_schedule(scene: Scenario) -> None:
    frames, stub = run(scene, 1.5, 0.005)
    exposures = [f.t_exposure_s for f in frames]
    arrivals = [f.t_arrival_s for f in frames]
    assert all(b > a for a, b in pairwise(exposures))
    assert all(b >= a for a, b in pairwise(arrivals))
    for f in frames:
        assert f.t_arrival_s >= f.t_exposure_s + scene.camera_exposure_s / 2 - 1e-9
        if scene.camera_gone_at_s is not None:
            assert f.t_arrival_s < scene.camera_gone_at_s
        if scene.camera_freeze_at_s is None or f.t_exposure_s < scene.camera_freeze_at_s:
            assert f.image[0, 0] == f.index
            assert f.image[0, 1] == round(0.1 * f.t_exposure_s * 1e6)
    # A regular rate with the camera's own phase.
    phases = [t - f.index / scene.camera_rate_hz for f, t in zip(frames, exposures, strict=True)]
    assert np.ptp(phases) < 1e-9 if phases else True
    assert len(stub.rendered) == len(set(stub.rendered))


@settings(max_examples=25, deadline=None, derandomize=True)
@given(scenarios, st.sampled_from([0.002, 0.011, 0.033]))
def test_the_steps_of_advance_change_nothing(scene: Scenario, step_s: float) -> None:
    fine, _ = run(scene, 0.99, 0.001)
    coarse, _ = run(scene, 0.99, step_s)
    assert len(coarse) <= len(fine)
    for a, b in zip(fine, coarse, strict=False):
        assert (a.t_arrival_s, a.t_exposure_s, a.index) == (b.t_arrival_s, b.t_exposure_s, b.index)
        assert np.array_equal(a.image, b.image)


def test_faults_change_no_other_frame() -> None:
    plain, _ = run(Scenario(seed=8))
    burst, stub = run(Scenario(seed=8, camera_burst=(1.0, 12)))
    lost = {f.index for f in plain} - {f.index for f in burst}
    assert len(lost) == 12
    assert max(lost) - min(lost) == 11
    assert min(f.t_exposure_s for f in plain if f.index in lost) >= 1.0
    assert not lost & set(stub.rendered), "lost frames need no picture"
    by_index = {f.index: f for f in plain}
    assert all(np.array_equal(f.image, by_index[f.index].image) for f in burst)


def test_latency_and_jitter_have_the_scenarios_size() -> None:
    frames, _ = run(Scenario(seed=2, camera_latency_s=0.06, camera_jitter_s=0.004), 20.0, 0.01)
    delays = np.array([f.t_arrival_s - f.t_exposure_s for f in frames])
    assert delays.mean() == pytest.approx(0.06, abs=0.001)
    assert delays.std() == pytest.approx(0.004, rel=0.15)


def test_the_drop_rate_is_kept() -> None:
    frames, stub = run(Scenario(seed=2, camera_drop_rate=0.3), 30.0, 0.02)
    assert len(frames) / (30.0 * 30.0) == pytest.approx(0.7, abs=0.05)
    assert len(stub.rendered) < 0.75 * 900


def test_a_frozen_camera_repeats_its_last_picture() -> None:
    frames, stub = run(Scenario(seed=1, camera_freeze_at_s=2.0))
    late = [f for f in frames if f.t_exposure_s >= 2.0]
    last_good = [f for f in frames if f.t_exposure_s < 2.0][-1]
    assert len(late) > 40
    assert all(np.array_equal(f.image, last_good.image) for f in late)
    assert max(stub.rendered) == last_good.index


def test_with_the_renderer_the_same_seed_gives_the_same_bytes() -> None:
    K = np.array([[190.0, 0, 160], [0, 190, 120], [0, 0, 1]])
    model = CameraModel((320, 240), K, np.zeros(5))
    scene = Scenario(seed=11, camera_drop_rate=0.2)

    def flight() -> list[bytes]:
        camera = SimCamera(scene, Renderer(scene, model, TargetConfig()))
        for k in range(1, 200):
            camera.advance(k * CONTROL_PERIOD_S, pose_at)
        return [f.image.tobytes() for f in camera.take()]

    first = flight()
    assert len(first) > 5
    assert first == flight()


@pytest.mark.parametrize("receiver_hz", [None, 7.0, 15.0])
def test_a_picture_shows_the_target_where_it_was(receiver_hz: float | None) -> None:
    """Also one that a receiver still holds."""
    K = np.array([[190.0, 0, 160], [0, 190, 120], [0, 0, 1]])
    model = CameraModel((320, 240), K, np.zeros(5))
    still, moved = (
        SimulatedVehicle(Scenario(seed=3, camera_receiver_hz=receiver_hz), model, TargetConfig())
        for _ in range(2)
    )
    pictures = []
    for vehicle in (still, moved):
        vehicle.advance_to(0.5)
        if vehicle is moved:
            vehicle.move_target((0.3, 0.0))
        vehicle.advance_to(0.9)
        assert vehicle.camera is not None
        pictures.append([(f.t_exposure_s, f.image) for f in vehicle.camera.take()])
    same = [(t_s, np.array_equal(a, b)) for (t_s, a), (_, b) in zip(*pictures, strict=True)]
    assert any(not equal for _, equal in same)
    assert all(equal == (t_s < 0.496) for t_s, equal in same)
