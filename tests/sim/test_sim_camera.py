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
from perchctl.sim import CONTROL_PERIOD_S, Renderer, Scenario, SimulatedVehicle
from perchctl.sim.camera import DeliveredFrame, SimCamera
from perchctl.sim.optics import Picture
from perchctl.sim.renderer import Exposure
from perchctl.vision import CameraModel


def pose_at(t_s: float) -> Array:
    return make_T(np.eye(3), (0.1 * t_s, 0.0, 1.0))


SMALL = CameraModel((320, 240), np.array([[190.0, 0, 160], [0, 190, 120], [0, 0, 1]]), np.zeros(5))


class Stub:
    """Stands for the renderer: a picture of its index and of the pose at mid-exposure."""

    camera = SimpleNamespace(size_px=(2, 2))

    def __init__(self) -> None:
        self.rendered: list[int] = []

    def expose(self, shots: Sequence[Exposure], frame_index: int = 0) -> Any:
        self.rendered.append(frame_index)
        (poses,) = shots[0].row_poses
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
)


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


@pytest.mark.parametrize(
    "fields", ["progressive", "top", pytest.param("bottom", marks=pytest.mark.long)]
)
def test_each_row_of_a_rolling_shutter_shows_its_own_moment(fields: str) -> None:
    """Of a frame, and of a field."""
    readout_s = 0.02
    rolling = replace(STILL, camera_readout_s=readout_s, camera_fields=fields)
    frame, middle_s = first_frame(rolling, TURN_RADPS)
    late_s = {"progressive": 0.0, "top": -0.01, "bottom": 0.01}[fields]  # of the first row's field
    for row in (100, 180, 181, 239, 300, 301, 380):  # through the target
        field_s = late_s if row % 2 == 0 else -late_s
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
