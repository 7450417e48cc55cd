from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig
from perchctl.profile.dictionaries import predefined
from perchctl.vision.camera_model import project
from perchctl.vision.markers.detect import (
    choose,
    detect,
    make_detector,
    misfit,
    predicted_corners,
    search_window,
)
from perchctl.vision.pose import square
from perchctl.vision.types import Detection, Detections, Frame
from tests.helpers.target_picture import CAMERA, pose_of, render

SETUP = make_detector(DetectorConfig(), TargetConfig())
RATIO = SETUP.ratio


def frame(image: NDArray[np.uint8], index: int = 0) -> Frame:
    return Frame(index, index / 30.0, image)


def paste(image: NDArray[np.uint8], dictionary: str, index: int, at: tuple[int, int], side: int):
    marker = cv2.aruco.generateImageMarker(predefined(dictionary), index, side)
    x, y = at
    image[y - 12 : y + side + 12, x - 12 : x + side + 12] = 230
    image[y : y + side, x : x + side] = np.where(marker > 0, 230, 20)


def box(cx: float, cy: float, side: float) -> Array:
    h = side / 2
    return np.array([[-h, -h], [h, -h], [h, h], [-h, h]]) + np.array([cx, cy])


def seen(large: Array | None = None, small: Array | None = None, t_s: float = 0.0) -> Detections:
    return Detections(
        0,
        t_s,
        None if large is None else Detection("large", large, 0.1, True),
        None if small is None else Detection("small", small, 0.1, True),
    )


def test_finds_both_markers_at_their_corners() -> None:
    rvec, tvec = pose_of(0.03, -0.02, 0.4, 0.7, 0.05, -0.1)
    found = detect(frame(render(rvec, tvec)), None, SETUP, CAMERA)
    assert found.full_frame
    assert not found.mirrored
    for name, side in (("large", 0.150), ("small", 0.025)):
        detection = found.get(name)  # type: ignore[arg-type]
        assert detection is not None
        assert detection.refined
        true = project(square(side), rvec, tvec, CAMERA)
        assert np.abs(detection.corners_px - true).max() < 0.15


def test_a_picture_without_a_target_gives_nothing() -> None:
    image = np.random.default_rng(0).integers(60, 190, (480, 640)).astype(np.uint8)
    found = detect(frame(image), None, SETUP, CAMERA)
    assert found.large is None
    assert found.small is None
    assert found.velocity_px_s is None


@pytest.mark.parametrize("axis", [0, 1])
def test_a_mirrored_picture_is_recognised_and_not_measured(axis: int) -> None:
    image = np.ascontiguousarray(np.flip(render(*pose_of(0.0, 0.0, 0.3, 0.4)), axis=axis))
    found = detect(frame(image), None, SETUP, CAMERA)
    assert found.mirrored
    assert found.large is None
    assert found.small is None


def test_a_small_marker_like_its_own_mirror_image_gives_no_hint() -> None:
    target = TargetConfig(small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=0, side_m=0.025))
    assert make_detector(DetectorConfig(), TargetConfig()).mirror_index == 1
    setup = make_detector(DetectorConfig(), target)
    bits = predefined("DICT_ARUCO_ORIGINAL")
    grid = cv2.aruco.Dictionary.getBitsFromByteList(np.ascontiguousarray(bits.bytesList[0:1]), 5)
    symmetric = any(np.array_equal(np.rot90(grid, k), grid[:, ::-1]) for k in range(4))
    assert symmetric
    assert setup.mirror_index is None


def test_correction_bits_are_what_the_profile_says() -> None:
    grid = cv2.aruco.Dictionary.getBitsFromByteList(
        np.ascontiguousarray(predefined("DICT_ARUCO_ORIGINAL").bytesList[5:6]), 5
    )
    for wrong in range(4):
        bits = grid.copy()
        bits.ravel()[[6, 12, 18][:wrong]] ^= 1
        cells = np.pad(bits, 1)
        image = np.full((480, 640), 230, np.uint8)
        image[150:290, 250:390] = np.where(np.kron(cells, np.ones((20, 20))) > 0, 230, 20)
        for allowed in range(4):
            setup = make_detector(DetectorConfig(correction_bits_small=allowed), TargetConfig())
            found = detect(frame(image), None, setup, CAMERA)
            assert (found.small is not None) == (wrong <= allowed), (wrong, allowed)


def test_tracks_in_a_window_and_falls_back_within_the_same_frame() -> None:
    first = detect(frame(render(*pose_of(0.0, 0.0, 0.5))), None, SETUP, CAMERA)
    near = detect(frame(render(*pose_of(0.01, 0.0, 0.5)), 1), first, SETUP, CAMERA)
    assert not near.full_frame
    assert near.large is not None
    assert near.velocity_px_s is not None
    assert near.velocity_px_s[0] == pytest.approx(0.01 / 0.5 * 400 * 30, rel=0.05)
    far = detect(frame(render(*pose_of(-0.25, 0.15, 0.5)), 2), near, SETUP, CAMERA)
    assert far.full_frame
    assert far.large is not None
    assert far.small is not None


def test_window_and_whole_picture_give_the_same_corners() -> None:
    image = render(*pose_of(0.05, 0.02, 0.5, 1.0), noise=5.0)
    first = detect(frame(image), None, SETUP, CAMERA)
    again = detect(frame(image, 1), first, SETUP, CAMERA)
    assert first.full_frame
    assert not again.full_frame
    for name in ("large", "small"):
        a, b = first.get(name), again.get(name)  # type: ignore[arg-type]
        assert a is not None
        assert b is not None
        assert np.abs(a.corners_px - b.corners_px).max() < 0.1


def test_motion_in_the_picture_moves_the_window() -> None:
    moving = replace(seen(box(300, 200, 80)), velocity_px_s=np.array([600.0, -300.0]))
    expected = predicted_corners(moving, 0.1)
    assert np.allclose(expected["large"].mean(axis=0), [360.0, 170.0])
    stale = predicted_corners(moving, 0.9)
    assert np.allclose(stale["large"].mean(axis=0), [300.0, 200.0])
    assert predicted_corners(None, 0.1) == {}


def test_the_window_leaves_room_for_the_large_marker_around_the_small_one() -> None:
    window = search_window({"small": box(300, 240, 20)}, RATIO, (480, 640))
    assert window is not None
    left, top, right, bottom = window
    assert left <= 240
    assert right >= 360
    assert top <= 180
    assert bottom >= 300
    close = search_window({"small": box(300, 240, 90)}, RATIO, (480, 640))
    assert close is not None
    assert (close[2] - close[0]) * (close[3] - close[1]) < 0.4 * 640 * 480
    assert search_window({"large": box(320, 240, 430)}, RATIO, (480, 640)) is None


def test_a_decoy_of_either_marker_is_dropped() -> None:
    image = render(*pose_of(-0.15, 0.0, 0.5))
    true_large = project(square(0.150), *pose_of(-0.15, 0.0, 0.5), CAMERA)
    paste(image, "DICT_4X4_1000", 997, (430, 60), 100)
    paste(image, "DICT_ARUCO_ORIGINAL", 5, (450, 300), 60)
    found = detect(frame(image), None, SETUP, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - true_large).max() < 0.2
    assert found.small is not None
    assert misfit(found.large.corners_px, found.small.corners_px, RATIO) < 0.5


def test_foreign_markers_are_not_taken() -> None:
    image = np.full((480, 640), 120, np.uint8)
    paste(image, "DICT_4X4_1000", 314, (60, 60), 120)
    paste(image, "DICT_ARUCO_ORIGINAL", 1, (300, 200), 70)
    found = detect(frame(image), None, SETUP, CAMERA)
    assert found.large is None
    assert found.small is None


@pytest.mark.parametrize(
    ("large", "small", "expected", "result"),
    [
        ([box(200, 200, 60)], [box(200, 200, 10)], {}, {"large": 0, "small": 0}),
        ([box(200, 200, 60), box(400, 300, 60)], [box(400, 300, 10)], {}, {"large": 1, "small": 0}),
        # wrong size and wrong place: the small marker is dropped
        ([box(200, 200, 60)], [box(200, 200, 20)], {}, {"large": 0}),
        ([box(200, 200, 60)], [box(300, 200, 10)], {}, {"large": 0}),
        # turned by a quarter: not this target
        ([box(200, 200, 60)], [np.roll(box(200, 200, 10), 1, axis=0)], {}, {"large": 0}),
        # two of the same and nothing to tell them apart
        ([], [box(200, 200, 30), box(400, 200, 30)], {}, {}),
        ([], [box(200, 200, 30)], {}, {"small": 0}),
        # the last sight decides
        ([], [box(200, 200, 30), box(400, 200, 30)], {"small": box(410, 205, 30)}, {"small": 1}),
        ([box(100, 100, 60)], [box(400, 200, 30)], {"small": box(410, 205, 30)}, {"small": 0}),
        ([], [box(400, 200, 10)], {"large": box(405, 200, 60)}, {"small": 0}),
    ],
)
def test_choice_among_candidates(large, small, expected, result) -> None:  # type: ignore[no-untyped-def]
    chosen = choose({"large": large, "small": small}, expected, RATIO)
    pools = {"large": large, "small": small}
    assert set(chosen) == set(result)
    for name, index in result.items():
        assert chosen[name] is pools[name][index]  # type: ignore[index]


def test_what_one_picture_told_of_its_edges_holds_for_some_more() -> None:
    pose = pose_of(0.02, 0.01, 0.5, 0.6)
    bright = np.clip(render(*pose, blur_px=0.9) * 1.7, 0, 255).astype(np.uint8)
    true = project(square(0.150), *pose, CAMERA)
    before, ages = None, []
    for k in range(7):
        before = detect(frame(bright, k), before, SETUP, CAMERA)
        assert before.edge_shift is not None
        assert before.edge_shift.shift_px > 0.1
        assert before.large is not None
        assert np.abs(before.large.corners_px - true).max() < 0.08
        ages.append(before.edge_shift.age)
    assert ages == [0, 1, 2, 3, 4, 0, 1]
