"""Laws of the simulated camera's schedule; its fields, rolling shutter and changing light, each
against pictures of a single moment."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array, make_T, rot_z
from perchctl.profile import TargetConfig
from perchctl.sim import (
    CONTROL_PERIOD_S,
    Renderer,
    Scenario,
    SimCamera,
    SimulatedVehicle,
)
from perchctl.sim.camera import DeliveredFrame, Shutter
from perchctl.sim.optics import Picture
from perchctl.sim.renderer import Shot, blended
from perchctl.vision import CameraModel


def pose_at(t_s: float) -> Array:
    return make_T(np.eye(3), (0.1 * t_s, 0.0, 1.0))


SMALL = CameraModel((320, 240), np.array([[190.0, 0, 160], [0, 190, 120], [0, 0, 1]]), np.zeros(5))


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


def test_with_the_renderer_the_same_seed_gives_the_same_bytes() -> None:
    scene = Scenario(seed=11, camera_drop_rate=0.2)

    def flight() -> list[bytes]:
        camera = SimCamera(scene, Renderer(scene, SMALL, TargetConfig()))
        for k in range(1, 200):
            camera.advance(k * CONTROL_PERIOD_S, pose_at)
        return [f.image.tobytes() for f in camera.take()]

    first = flight()
    assert len(first) > 5
    assert first == flight()


@pytest.mark.parametrize("receiver_hz", [None, 7.0, 15.0])
def test_a_picture_shows_the_target_where_it_was(receiver_hz: float | None) -> None:
    """Also one that a receiver still holds."""
    still, moved = (
        SimulatedVehicle(Scenario(seed=3, camera_receiver_hz=receiver_hz), SMALL, TargetConfig())
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


# --- When each row is exposed, and in what light ------------------------------------------------


K = np.array([[380.0, 0.0, 319.5], [0.0, 380.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = CameraModel((640, 480), K, np.zeros(5))
STILL = Scenario(
    seed=5, camera_rate_hz=25.0, camera_noise_sigma=0.0, camera_exposure_s=0.0,
    camera_jitter_s=0.0, T_body_cam_true=tuple(map(tuple, np.eye(4))),
)  # fmt: skip
SPEED_MPS, TURN_RADPS, BELOW_M = 0.3, 0.5, 0.3


def pose(t_s: float, turn_radps: float = 0.0) -> Array:
    """Under the target, moving along x (the picture's rows) and turning."""
    place_m = (SPEED_MPS * (t_s - 0.1), 0.0, STILL.ceiling_z_m - BELOW_M)
    return make_T(rot_z(turn_radps * (t_s - 0.1)), place_m)


def first_frame(scenario: Scenario, turn_radps: float = 0.0) -> tuple[Picture, float]:
    """The first frame and its middle moment."""
    camera = SimCamera(scenario, Renderer(scenario, CAMERA, TargetConfig()))
    for step in range(1, 200):
        camera.advance(step * CONTROL_PERIOD_S, lambda t: pose(t, turn_radps))
        if frames := camera.take():
            return frames[0].image, frames[0].t_exposure_s
    raise AssertionError("no frame")


def at_once(t_s: float, turn_radps: float = 0.0) -> Picture:
    """The whole picture of one moment."""
    return Renderer(STILL, CAMERA, TargetConfig()).render([pose(t_s, turn_radps)])


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_each_field_shows_its_own_moment(first: str) -> None:
    frame, middle_s = first_frame(replace(STILL, camera_fields=first), TURN_RADPS)
    early, late = (at_once(middle_s + d, TURN_RADPS) for d in (-0.01, 0.01))
    top, bottom = (early, late) if first == "top" else (late, early)
    assert np.array_equal(frame[0::2], top[0::2])
    assert np.array_equal(frame[1::2], bottom[1::2])
    assert not np.array_equal(early, late)


def test_blended_fields_show_both_moments_in_each_row() -> None:
    woven, _ = first_frame(replace(STILL, camera_fields="top"), TURN_RADPS)
    frame, _ = first_frame(replace(STILL, camera_fields="top", camera_blended=True), TURN_RADPS)
    assert np.array_equal(frame, blended(woven))
    mean = (woven[1:-3:2] / 4.0 + woven[2:-2:2] / 2.0 + woven[3:-1:2] / 4.0).astype(np.float32)
    assert np.abs(frame[2:-2:2] - mean).max() <= 0.5


@pytest.mark.parametrize("fields", ["progressive", "bottom"])
def test_each_row_of_a_rolling_shutter_shows_its_own_moment(fields: str) -> None:
    """Of a frame, and of a field."""
    readout_s = 0.02
    rolling = replace(STILL, camera_readout_s=readout_s, camera_fields=fields)
    frame, middle_s = first_frame(rolling, TURN_RADPS)
    for row in (100, 180, 181, 239, 300, 301, 380):  # through the target
        field_s = 0.0 if fields == "progressive" else 0.01 if row % 2 == 0 else -0.01
        t_s = middle_s + field_s + readout_s * (row / 479 - 0.5)
        here = at_once(t_s, TURN_RADPS)[row].astype(int)
        wrong = at_once(t_s + readout_s / 4, TURN_RADPS)[row].astype(int)
        error = np.abs(frame[row] - here).mean()
        assert error < 0.5
        assert error < 0.2 * np.abs(frame[row] - wrong).mean()


def test_lamps_make_bands_of_a_rolling_shutter() -> None:
    scenario = replace(STILL, camera_readout_s=0.02, camera_flicker=0.2)
    plain, _ = first_frame(replace(STILL, camera_readout_s=0.02))
    frame, _ = first_frame(scenario)
    measured = frame[:, 20:40].mean(axis=1) / plain[:, 20:40].mean(axis=1)
    # Two swings of the lamp within the read-out.
    swing = np.exp(2j * math.pi * 2.0 * np.arange(480) / 479)
    depth = 2.0 * abs((measured * swing).mean())
    assert depth == pytest.approx(0.2, abs=0.02)
    assert measured.mean() == pytest.approx(1.0, abs=0.02)


def test_a_hunting_exposure_changes_whole_pictures_slowly() -> None:
    shutter = Shutter(replace(STILL, camera_pumping=0.3))
    times = np.arange(0.0, 5.0, 0.04)
    light = [shutter.shots(float(t), lambda t: np.eye(4), 480)[0].light for t in times]
    assert all(rows is not None and np.ptp(rows) < 1e-9 for rows in light)
    level = np.array([rows[0] for rows in light if rows is not None])
    assert 1.25 < level.max() <= 1.3
    assert 0.7 <= level.min() < 0.75
    assert np.abs(np.diff(level)).max() < 0.2


def test_a_frame_comes_after_its_last_light_and_looks_no_further_back_than_its_first() -> None:
    slow = replace(
        STILL, camera_fields="top", camera_readout_s=0.02, camera_exposure_s=0.008,
        camera_latency_s=0.0,
    )  # fmt: skip
    camera = SimCamera(slow, Renderer(slow, CAMERA, TargetConfig()))
    assert camera.exposed_s == pytest.approx(0.048)
    now_s = 0.0

    def pose_at(t_s: float) -> Array:
        assert now_s - camera.exposed_s - CONTROL_PERIOD_S <= t_s <= now_s + 1e-9
        return pose(t_s)

    arrived = []
    for step in range(1, 80):
        now_s = step * CONTROL_PERIOD_S
        camera.advance(now_s, pose_at)
        arrived += camera.take()
    assert len(arrived) >= 2
    for frame in arrived:
        assert frame.t_arrival_s >= frame.t_exposure_s + 0.024 - 1e-9
