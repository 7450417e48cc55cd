"""The steps of a frame, from picture to detections."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.profile import DetectorConfig, TargetConfig
from perchctl.vision import Detections, Frame, make_aruco_detector, project, square_corners
from perchctl.vision.markers.blurred import hidden_in_blur
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.search import misfit, search
from tests.helpers.markers import SETUP, blurry, both, box, frame, paste
from tests.helpers.target_picture import CAMERA, pose_of, render


def test_finds_both_markers_at_their_corners() -> None:
    rvec, tvec = pose_of(0.03, -0.02, 0.4, 0.7, 0.05, -0.1)
    found = detect_markers(frame(render(rvec, tvec)), None, SETUP, CAMERA)
    assert found.full_frame
    assert not found.mirrored
    for name, side in (("large", 0.150), ("small", 0.025)):
        detection = found.get(name)  # type: ignore[arg-type]
        assert detection is not None
        assert detection.refined
        true = project(square_corners(side), rvec, tvec, CAMERA)
        assert np.abs(detection.corners_px - true).max() < 0.15


def test_a_picture_without_a_target_gives_nothing() -> None:
    image = np.random.default_rng(0).integers(60, 190, (480, 640)).astype(np.uint8)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.large is None
    assert found.small is None
    assert found.velocity_px_s is None


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("markers", [("large", "small"), ("large",), ("small",)])
def test_a_mirrored_picture_is_recognised_and_not_measured(
    axis: int, markers: tuple[str, ...]
) -> None:
    """By either marker: far away the small one cannot be read."""
    picture = render(*pose_of(0.0, 0.0, 0.3, 0.4), markers=markers)
    image = np.ascontiguousarray(np.flip(picture, axis=axis))
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.mirrored
    assert found.large is None
    assert found.small is None


def test_tracks_in_a_window_and_falls_back_within_the_same_frame() -> None:
    first = detect_markers(frame(render(*pose_of(0.0, 0.0, 0.5))), None, SETUP, CAMERA)
    near = detect_markers(frame(render(*pose_of(0.01, 0.0, 0.5)), 1), first, SETUP, CAMERA)
    assert not near.full_frame
    assert near.large is not None
    assert near.velocity_px_s is not None
    assert near.velocity_px_s[0] == pytest.approx(0.01 / 0.5 * 400 * 30, rel=0.05)
    far = detect_markers(frame(render(*pose_of(-0.25, 0.15, 0.5)), 2), near, SETUP, CAMERA)
    assert far.full_frame
    assert far.large is not None
    assert far.small is not None


def test_window_and_whole_picture_give_the_same_corners() -> None:
    image = render(*pose_of(0.05, 0.02, 0.5, 1.0), noise=5.0)
    first = detect_markers(frame(image), None, SETUP, CAMERA)
    again = detect_markers(frame(image, 1), first, SETUP, CAMERA)
    assert first.full_frame
    assert not again.full_frame
    for name in ("large", "small"):
        a, b = first.get(name), again.get(name)  # type: ignore[arg-type]
        assert a is not None
        assert b is not None
        assert np.abs(a.corners_px - b.corners_px).max() < 0.1


def test_a_decoy_of_either_marker_is_dropped() -> None:
    image = render(*pose_of(-0.15, 0.0, 0.5))
    true_large = project(square_corners(0.150), *pose_of(-0.15, 0.0, 0.5), CAMERA)
    paste(image, "DICT_4X4_1000", 997, (430, 60), 100)
    paste(image, "DICT_ARUCO_ORIGINAL", 5, (450, 300), 60)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - true_large).max() < 0.2
    assert found.small is not None
    assert misfit(found.large.corners_px, found.small.corners_px, SETUP.ratio) < 0.5


def test_foreign_markers_are_not_taken() -> None:
    image = np.full((480, 640), 120, np.uint8)
    paste(image, "DICT_4X4_1000", 314, (60, 60), 120)
    paste(image, "DICT_ARUCO_ORIGINAL", 1, (300, 200), 70)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.large is None
    assert found.small is None


def grown(grey: np.ndarray, clipped: bool) -> np.ndarray:
    """White that has grown over black: by a tone curve, or by all that is lost above white."""
    tone = grey * 1.7 if clipped else 240.0 * (grey / 205.0) ** 0.5
    return np.clip(tone, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("clipped", "wanted"),
    [
        (False, [0, 1, 2, 3, 4, 0, 1]),
        # By how much depends on the place's own light, that is not in the picture any more.
        (True, [0] * 7),
    ],
)
def test_a_measured_shift_of_all_edges_holds_for_some_more_pictures(
    clipped: bool, wanted: list[int]
) -> None:
    pose = pose_of(0.02, 0.01, 0.5, 0.6)
    bright = grown(render(*pose, blur_px=0.9).astype(np.float64), clipped)
    true = project(square_corners(0.150), *pose, CAMERA)
    before, ages = None, []
    for k in range(7):
        before = detect_markers(frame(bright, k), before, SETUP, CAMERA)
        assert before.edge_shift is not None
        assert before.edge_shift.shift_px > 0.1
        assert before.large is not None
        assert np.abs(before.large.corners_px - true).max() < 0.08
        ages.append(before.edge_shift.age)
    assert ages == wanted


def snapshot(value: Any) -> Any:
    """All of a value's content, for comparison: dataclasses, arrays, OpenCV's objects."""
    if is_dataclass(value):
        return {f.name: snapshot(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, cv2.aruco.Dictionary):
        return snapshot((value.bytesList, value.markerSize, value.maxCorrectionBits))
    if isinstance(value, dict):
        return {key: snapshot(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [snapshot(each) for each in value]
    assert value is None or isinstance(value, (bool, int, float, str)), type(value)
    return value


def streams() -> list[list[Frame]]:
    """Two of different sizes, each with pictures that are followed, searched and blurred, and
    one without a target."""
    blurred_far, _ = blurry(26.0, 3.0, 0)
    near = [render(*pose_of(x, 0.0, 0.4, 0.3), noise=2.0) for x in (0.0, 0.01, -0.12)]
    far = [render(*pose_of(x, 0.02, 0.9, 1.0), noise=2.0) for x in (0.0, 0.02, 0.3)]
    one = [*near, np.full_like(near[0], 120), blurred_far, near[0]]
    two = [blurred_far, far[0], far[1], np.full_like(far[0], 90), far[2], far[0]]
    return [
        [frame(image, k) for k, image in enumerate(one)],
        [frame(image[:420], k) for k, image in enumerate(two)],
    ]


def test_two_streams_through_one_setup_do_not_disturb_each_other() -> None:
    setup = make_aruco_detector(DetectorConfig(), TargetConfig())
    before = snapshot(setup)
    first, second = streams()

    def alone(stream: list[Frame]) -> list[Detections]:
        last, found = None, []
        for each in stream:
            last = detect_markers(
                each, last, make_aruco_detector(DetectorConfig(), TargetConfig()), CAMERA
            )
            found.append(last)
        return found

    lasts: list[Detections | None] = [None, None]
    interleaved: list[list[Detections]] = [[], []]
    for pair in zip(first, second, strict=True):
        for k, each in enumerate(pair):
            found = detect_markers(each, lasts[k], setup, CAMERA)
            interleaved[k].append(found)
            lasts[k] = found
    for results in interleaved:
        assert {d.full_frame for d in results if d.large is not None} == {True, False}
    assert snapshot(interleaved) == snapshot([alone(first), alone(second)])
    assert snapshot(setup) == before


def test_searches_of_every_kind_leave_the_setup_as_it_was() -> None:
    setup = make_aruco_detector(DetectorConfig(), TargetConfig())
    before = snapshot(setup)
    for image in (render(*pose_of(0.0, 0.0, 0.4)), blurry(26.0, 3.0, 0)[0]):
        search(image, {}, setup)
        search(image, both(pose_of(0.0, 0.0, 0.4)), setup)
        search(image, {"small": box(300.0, 240.0, 20.0)}, setup)
        hidden_in_blur(image, setup, CAMERA)
    assert snapshot(setup) == before
