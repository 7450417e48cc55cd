"""Interlaced pictures: found out, taken apart and measured, against a known truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perchctl.geometry import Array
from perchctl.vision import (
    Frame,
    PictureKind,
    Pipeline,
    PipelineState,
    deinterlace,
    estimate_pose,
    step,
)
from perchctl.vision.fields import deinterlace_frame, interpolate_field, is_combed
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.types import InterlacingState
from tests.helpers.interlaced import Pass
from tests.helpers.target_picture import CAMERA, pose_of, render

Build = Callable[..., Pipeline]


def woven_frames(count: int, first: str = "top", **scenario: Any) -> tuple[Pass, list[Frame]]:
    scene = Pass(camera_fields=first, **scenario)
    return scene, list(scene.frames(count))


# --- Fields ------------------------------------------------------------------------------------


@pytest.mark.parametrize("first_row", [0, 1])
def test_a_field_at_full_height_keeps_everything_in_its_place(first_row: int) -> None:
    """Half a row's offset would move the whole picture."""
    rows = np.arange(48.0)
    truth = np.rint(127.0 + 100.0 * np.sin(rows / 7.0))[:, None].repeat(32, axis=1)
    picture = interpolate_field(truth.astype(np.uint8), first_row)
    assert np.array_equal(picture[first_row::2], truth[first_row::2])
    assert np.abs(picture[4:-4] - truth[4:-4]).max() <= 1.0
    assert np.abs(picture[[0, -1]] - truth[[0, -1]]).max() <= 20.0  # one row on, at the rims


# --- Combed or not -----------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["top", "bottom"])
@pytest.mark.parametrize("below_m", [0.1, 0.3, 1.0])
def test_two_moments_in_one_picture_are_seen(below_m: float, first: str) -> None:
    _, frames = woven_frames(2, first, below_m=below_m, camera_noise_sigma=8.0)
    assert all(is_combed(frame.image) for frame in frames)


@pytest.mark.parametrize(
    "analogue",
    [
        0.0,
        pytest.param(0.3, marks=pytest.mark.long),
        pytest.param(0.6, marks=pytest.mark.long),
        0.9,
    ],
)
@pytest.mark.parametrize("below_m", [0.08, pytest.param(0.4, marks=pytest.mark.long), 1.6])
def test_a_whole_picture_is_never_taken_for_two(below_m: float, analogue: float) -> None:
    for noise in (0.0, 7.0):
        scene = Pass(below_m, camera_noise_sigma=noise, extra={"analogue": analogue})
        for frame in scene.frames(3):
            assert not is_combed(frame.image)


def test_noise_and_snow_and_nothing_are_not_combed() -> None:
    rng = np.random.default_rng(2)
    snow = rng.integers(0, 256, (480, 640)).astype(np.uint8)
    noise = np.clip(120 + rng.normal(0, 12, (480, 640)), 0, 255).astype(np.uint8)
    for image in (snow, noise, np.full((480, 640), 90, np.uint8), snow[:6]):
        assert not is_combed(image)


# --- Order and time ----------------------------------------------------------------------------


def kinds(state: InterlacingState, frames: list[Frame]) -> list[Any]:
    found = []
    for frame in frames:
        state, parts = deinterlace_frame(state, frame)
        found.append(tuple(part.picture_kind for part in parts))
    return found


@pytest.mark.parametrize("first", ["top", "bottom"])
@pytest.mark.parametrize(
    "velocity_mps",
    [
        (0.2, 0.0, 0.0),
        pytest.param((0.0, 0.15, 0.0), marks=pytest.mark.long),
        (0.0, -0.05, 0.0),
        pytest.param((0.1, 0.1, 0.2), marks=pytest.mark.long),
    ],
)
def test_the_order_is_found_within_a_few_frames(
    first: PictureKind, velocity_mps: tuple[float, float, float]
) -> None:
    """Motion along the columns too, where a row of the one field lies between two of the other."""
    scene = Pass(0.25, velocity_mps, turn_radps=0.0, camera_fields=first)
    found = kinds(InterlacingState(), list(scene.frames(6)))
    second = "bottom" if first == "top" else "top"
    assert found[0] == ("woven",)
    assert found[5] == (first, second)
    assert set(found) <= {("woven",), (first, second)}


def test_a_changed_order_is_found() -> None:
    """A receiver that loses its lock may come back with its fields exchanged."""
    _, tops = woven_frames(5, "top")
    _, bottoms = woven_frames(12, "bottom")
    later = [replace(frame, t_s=frame.t_s + 1.0) for frame in bottoms]
    found = kinds(InterlacingState(), tops + later)
    assert found[4] == ("top", "bottom")
    assert found[-1] == ("bottom", "top")


@pytest.mark.parametrize(
    ("period_s", "apart_s"), [(1 / 25, 0.02), (1 / 30, 1 / 60), (1 / 60, 1 / 120), (1 / 12, 1 / 24)]
)
def test_fields_are_half_a_period_apart(period_s: float, apart_s: float) -> None:
    """Found from times that jitter, of frames of which some are lost."""
    rng = np.random.default_rng(6)
    _, frames = woven_frames(3)
    state = InterlacingState(is_top_field_first=True)
    index = 0
    for k in range(40):
        index += 1 + (rng.random() < 0.1)
        t_s = index * period_s + rng.normal(0.0, 0.03 * period_s)
        state, parts = deinterlace_frame(state, replace(frames[k % 3], t_s=t_s))
    early, late = parts
    assert (early.t_s + late.t_s) / 2.0 == pytest.approx(t_s)
    assert late.t_s - early.t_s == pytest.approx(apart_s, rel=0.03)


# --- The target --------------------------------------------------------------------------------


def measured(scene: Pass, frames: list[Frame], setup: Pipeline) -> tuple[list[Array], int]:
    """Errors, mm, of the poses at their pictures' own times, and the number of pictures."""
    state, errors, count = PipelineState(), [], 0
    for frame in frames:
        state, parts = deinterlace(state, frame, setup)
        for part in parts:
            count += 1
            state, output = step(state, part, None, setup)
            if output.poses:
                pose = next(iter(output.poses.values()))
                assert pose.t_s == part.t_s
                errors.append((pose.tvec_m - scene.target_m(part.t_s)) * 1000.0)
    return errors, count


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_each_field_is_measured_at_its_own_time(build: Build, first: str) -> None:
    scene, frames = woven_frames(12, first, below_m=0.25)
    setup = build()
    errors, count = measured(scene, frames, setup)
    assert count >= 20
    assert len(errors) == count
    # Taken as a moment 10 ms off, the target would be 2 mm aside.
    assert (np.median(np.abs(errors), axis=0) < [0.03, 0.03, 0.08]).all()
    assert np.sqrt(np.mean(np.square(errors[6:]), axis=0)).max() < 0.1


@pytest.mark.parametrize("kind", ["top", pytest.param("bottom", marks=pytest.mark.long)])
def test_sides_along_the_rows_of_a_field_claim_what_interpolation_does_to_them(
    build: Build, kind: PictureKind
) -> None:
    """Between rows that are 2 px apart a sharp edge is taken for too high or too low."""
    setup = build()
    first_row = 0 if kind == "top" else 1
    squares: dict[str, list[float]] = {"claimed": [], "as elsewhere": []}
    for k in range(12):
        T = pose_of(0.0, 0.0005 * k, 0.4)
        image = render(*T, noise=2.0, seed=k)
        field = Frame(0, 0.0, interpolate_field(image, first_row), picture_kind=kind)
        seen = detect_markers(field, None, setup.detector_setup, CAMERA).large
        assert seen.horizontal_side_deinterlacing_sigma_px > 0.0
        for name, d in (
            ("claimed", seen),
            ("as elsewhere", replace(seen, horizontal_side_deinterlacing_sigma_px=0.0)),
        ):
            pose = estimate_pose([d], 0.0, None, setup.pose_setup)
            e = pose.tvec_m - T[1]
            squares[name].append(
                float(e @ np.linalg.solve(pose.level_frame_xyz_yaw_cov[:3, :3], e)) / 3.0
            )
    assert 0.2 < np.mean(squares["claimed"]) < 2.0
    assert np.mean(squares["as elsewhere"]) > 3.0
