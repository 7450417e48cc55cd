"""Fields, rolling shutter and changing light, each against pictures of a single moment."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from perchctl.geometry import Array, make_T, rot_z
from perchctl.profile import TargetConfig
from perchctl.sim import (
    CONTROL_PERIOD_S,
    Renderer,
    Scenario,
    SimCamera,
)
from perchctl.sim.camera import FLICKER_HZ, Shutter
from perchctl.sim.optics import Picture
from perchctl.sim.renderer import blended
from perchctl.vision import CameraModel

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


def test_each_row_of_a_rolling_shutter_shows_its_own_moment() -> None:
    readout_s = 0.02
    frame, middle_s = first_frame(replace(STILL, camera_readout_s=readout_s), TURN_RADPS)
    for row in (100, 180, 239, 300, 380):  # through the target
        t_s = middle_s + readout_s * (row / 479 - 0.5)
        here = at_once(t_s, TURN_RADPS)[row].astype(int)
        wrong = at_once(t_s + readout_s / 4, TURN_RADPS)[row].astype(int)
        error = np.abs(frame[row] - here).mean()
        assert error < 0.5
        assert error < 0.2 * np.abs(frame[row] - wrong).mean()


def test_a_field_is_read_out_row_by_row_too() -> None:
    both = replace(STILL, camera_fields="bottom", camera_readout_s=0.02)
    frame, middle_s = first_frame(both, TURN_RADPS)
    for row in (180, 181, 300, 301):
        field_s = 0.01 if row % 2 == 0 else -0.01
        t_s = middle_s + field_s + 0.02 * (row / 479 - 0.5)
        assert np.abs(frame[row] - at_once(t_s, TURN_RADPS)[row].astype(int)).mean() < 0.5


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


def test_an_exposure_of_one_swing_sees_no_lamps() -> None:
    whole = replace(STILL, camera_flicker=0.5, camera_exposure_s=1.0 / FLICKER_HZ)
    for t_s in (0.1, 0.102, 0.105, 0.107):
        (shot,) = Shutter(whole).shots(t_s, lambda t: np.eye(4), 480)
        assert shot.light is not None
        assert np.abs(shot.light - 1.0).max() < 1e-9


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
