"""The steps of a frame, from picture to detections."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig, aruco_dictionary
from perchctl.vision import Frame, project, square_corners
from perchctl.vision.markers.detect import (
    Picture,
    around,
    between,
    detect_markers,
    follow,
    predicted_corners,
    with_motion,
)
from perchctl.vision.markers.detector import MIRROR_INDEX, make_aruco_detector
from perchctl.vision.markers.search import misfit
from perchctl.vision.types import Detection, Detections
from tests.helpers.markers import POSE, SETUP, blurry, both, box, corners, followed, frame, paste
from tests.helpers.target_picture import CAMERA, pose_of, render


def test_finds_both_markers_at_their_corners() -> None:
    rvec, tvec = pose_of(0.03, -0.02, 0.4, 0.7, 0.05, -0.1)
    found = detect_markers(frame(render(rvec, tvec)), None, SETUP, CAMERA)
    assert found.full_frame
    assert not found.mirrored
    for name, side in (("large", 0.150), ("small", 0.025)):
        detection = found.get(name)
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
        a, b = first.get(name), again.get(name)
        assert np.abs(a.corners_px - b.corners_px).max() < 0.1


def test_a_decoy_of_either_marker_is_dropped() -> None:
    image = render(*pose_of(-0.15, 0.0, 0.5))
    true_large = project(square_corners(0.150), *pose_of(-0.15, 0.0, 0.5), CAMERA)
    paste(image, "DICT_4X4_1000", 997, (430, 60), 100)
    paste(image, "DICT_ARUCO_ORIGINAL", 5, (450, 300), 60)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert np.abs(found.large.corners_px - true_large).max() < 0.2
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
        assert before.edge_shift.shift_px > 0.1
        assert np.abs(before.large.corners_px - true).max() < 0.08
        ages.append(before.edge_shift.age)
    assert ages == wanted


def bytes_of(stream: list[Detections]) -> list[bytes | None]:
    """All corners of a stream's markers."""
    markers = [each for found in stream for each in (found.large, found.small)]
    return [None if each is None else each.corners_px.tobytes() for each in markers]


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
    assert [*map(bytes_of, interleaved)] == [bytes_of(alone(first)), bytes_of(alone(second))]


def test_a_marker_like_its_own_mirror_image_gives_no_hint() -> None:
    target = TargetConfig(small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=0, side_m=0.025))
    usual = make_aruco_detector(DetectorConfig(), TargetConfig())
    assert [len(d.bytesList) for d in usual.dictionaries] == [1 + MIRROR_INDEX, 1 + MIRROR_INDEX]
    setup = make_aruco_detector(DetectorConfig(), target)
    bits = aruco_dictionary("DICT_ARUCO_ORIGINAL")
    grid = cv2.aruco.Dictionary.getBitsFromByteList(np.ascontiguousarray(bits.bytesList[0:1]), 5)
    symmetric = any(np.array_equal(np.rot90(grid, k), grid[:, ::-1]) for k in range(4))
    assert symmetric
    assert [len(d.bytesList) for d in setup.dictionaries] == [1 + MIRROR_INDEX, 1]


def test_correction_bits_are_the_profiles() -> None:
    grid = cv2.aruco.Dictionary.getBitsFromByteList(
        np.ascontiguousarray(aruco_dictionary("DICT_ARUCO_ORIGINAL").bytesList[5:6]), 5
    )
    for wrong in range(4):
        bits = grid.copy()
        bits.ravel()[[6, 12, 18][:wrong]] ^= 1
        cells = np.pad(bits, 1)
        image = np.full((480, 640), 230, np.uint8)
        image[150:290, 250:390] = np.where(np.kron(cells, np.ones((20, 20))) > 0, 230, 20)
        for allowed in range(4):
            setup = make_aruco_detector(
                DetectorConfig(correction_bits_small=allowed), TargetConfig()
            )
            found = detect_markers(frame(image), None, setup, CAMERA)
            assert (found.small is not None) == (wrong <= allowed), (wrong, allowed)


# --- Markers where they are expected, and the large one around a small one ---------------------


@pytest.mark.parametrize("shift_px", [0.0, 1.0, 2.5])
def test_expected_markers_are_verified_and_refined(shift_px: float) -> None:
    seen = followed(render(*POSE, noise=3.0), both(shift_px=shift_px))
    assert set(seen) == {"large", "small"}
    assert seen["large"].refined
    assert np.abs(seen["large"].corners_px - corners("large")).max() < 0.1
    assert np.abs(seen["small"].corners_px - corners("small")).max() < 0.4


def test_other_cells_other_turns_and_mirror_images_are_not_verified() -> None:
    image = render(*POSE)
    other = make_aruco_detector(
        DetectorConfig(),
        TargetConfig(
            large=MarkerConfig(dictionary="DICT_4X4_1000", id=16, side_m=0.150),
            small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=7, side_m=0.025),
        ),
    )
    assert followed(image, both(), other.patterns) == {}
    for k in (1, 2, 3):
        turned = {name: np.roll(quad, k, axis=0) for name, quad in both().items()}
        assert followed(image, turned) == {}
    mirrored = {name: quad[::-1] for name, quad in both().items()}
    assert followed(image, mirrored) == {}
    empty = np.full_like(image, 120)
    assert followed(empty, both()) == {}


def test_a_small_marker_too_small_for_lines_is_seen_in_its_place() -> None:
    pose = pose_of(0.05, 0.0, 1.0, 0.4)
    expected = {"large": corners("large", pose)}
    seen = followed(render(*pose, noise=3.0), expected)
    assert not seen["small"].refined
    assert np.abs(seen["small"].corners_px - corners("small", pose)).max() < 0.5
    alone = render(*pose, markers=("large",), noise=3.0)
    assert set(followed(alone, expected)) == {"large"}


@pytest.mark.parametrize("cover", ["corner", "stripe", "none"])
def test_a_partly_covered_large_marker_is_measured_by_the_small_one(cover: str) -> None:
    pose = pose_of(0.05, 0.02, 0.6, 0.5, 0.05, -0.05)
    image = render(*pose, noise=2.0)
    true = corners("large", pose)
    if cover == "corner":
        x, y = np.rint(true[1]).astype(int)
        image[y - 14 : y + 10, x - 12 : x + 14] = 40
    elif cover == "stripe":
        a, b = true[0] * 0.6 + true[3] * 0.4, true[1] * 0.7 + true[2] * 0.3
        a, b = a + 1.6 * (a - b), b + 1.6 * (b - a)
        # beside the small marker, across two sides of the large one
        offset = 0.34 * (true[3] - true[0])
        ends = [tuple(np.rint(p + offset).astype(int).tolist()) for p in (a, b)]
        cv2.line(image, ends[0], ends[1], 50, 4)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert np.abs(found.large.corners_px - true).max() < 0.3


def test_around_a_lone_small_marker_there_is_no_large_one() -> None:
    pose = pose_of(0.02, 0.0, 0.5, 0.3)
    image = render(*pose, markers=("small",))
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.small is not None
    assert found.large is None
    seen = follow(Picture(image, None, SETUP, CAMERA), {"small": corners("small", pose)})
    assert around(Picture(image, None, SETUP, CAMERA), seen["small"]) is None


@pytest.mark.parametrize("seed", range(4))
def test_a_large_marker_that_is_cut_off_is_looked_for_around_the_small_one(seed: int) -> None:
    """As both are expected 6 px aside of where they are, as a vehicle in motion has it."""
    rng = np.random.default_rng(seed)
    pose = pose_of(*rng.uniform(-0.004, 0.004, 2), 0.12, rng.uniform(-math.pi, math.pi))
    image = render(*pose, noise=3.0, seed=seed)
    turn = rng.uniform(-math.pi, math.pi)
    off_px = 6.0 * np.array([math.cos(turn), math.sin(turn)])
    expected = {name: quad + off_px for name, quad in both(pose).items()}
    seen = followed(image, expected)
    assert seen["small"].refined
    assert np.abs(seen["large"].corners_px - corners("large", pose)).max() < 0.5


def test_a_near_target_that_has_moved_on_is_looked_for_nearby() -> None:
    pose = pose_of(0.0, 0.0, 0.16, 0.4)
    expected = both(pose, shift_px=25.0)
    found = detect_markers(frame(render(*pose, noise=3.0)), None, SETUP, CAMERA, expected)
    for name in ("large", "small"):
        assert np.abs(found.get(name).corners_px - corners(name, pose)).max() < 0.2


# --- Motion from picture to picture ------------------------------------------------------------


def seen(large: tuple[float, float], t_s: float = 0.0) -> Detections:
    return Detections(0, t_s, Detection("large", box(*large, 80.0), 0.1, True))


def test_corners_move_on_as_they_moved() -> None:
    moving = replace(seen((300, 200)), velocity_px_s=np.array([600.0, -300.0]))
    expected = predicted_corners(moving, 0.1)
    assert np.allclose(expected["large"].mean(axis=0), [360.0, 170.0])
    stale = predicted_corners(moving, 0.9)
    assert np.allclose(stale["large"].mean(axis=0), [300.0, 200.0])
    assert predicted_corners(None, 0.1) == {}


def test_motion_is_that_between_two_pictures() -> None:
    first = seen((300, 200))
    second = with_motion(seen((306, 197), 0.05), first)
    assert np.allclose(predicted_corners(second, 0.1)["large"].mean(axis=0), [312.0, 194.0])
    for earlier in (None, Detections(0, 0.0), replace(first, t_s=-1.0), replace(first, t_s=0.05)):
        still = with_motion(seen((306, 197), 0.05), earlier)
        assert still.velocity_px_s is None
        assert still.flow_px_s == {}


def test_nothing_is_between_two_targets() -> None:
    """A frame's two fields, of which each shows another one."""
    fields = [
        Detections(0, 0.0, large=Detection("large", box(x, 100, 60), 0.1, refined=True))
        for x in (100.0, 400.0)
    ]
    mean = between(*fields)
    assert mean.large.corners_px[:, 0].mean() == pytest.approx(100.0)
