"""The methods that find corners in a frame, and the table of them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import make_T
from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig, aruco_dictionary
from perchctl.sim import Renderer, Scenario
from perchctl.target import draw_target
from perchctl.vision import project, square_corners
from perchctl.vision.markers import detect
from perchctl.vision.markers.detect import (
    CORNER_METHODS,
    average_field_detections,
    detect_markers,
    find_corners,
    find_large_marker_around_small,
    refine_expected_markers,
)
from perchctl.vision.markers.detector import DetectorInput, make_detector_setup
from perchctl.vision.markers.pattern import GRID_MARGIN_FOR_BLUR_NODES, render_cells
from perchctl.vision.markers.search import nesting_error_to_tolerance_ratio
from perchctl.vision.types import Detection, Detections
from tests.helpers.corner_views import VIEWS, View, findings
from tests.helpers.markers import POSE, SETUP, both, box, corners, followed, frame, paste
from tests.helpers.target_picture import CAMERA, pose_of, render


def test_noise_and_foreign_markers_are_no_target() -> None:
    noise = np.random.default_rng(0).integers(60, 190, (480, 640)).astype(np.uint8)
    foreign = np.full((480, 640), 120, np.uint8)
    paste(foreign, "DICT_4X4_1000", 314, (60, 60), 120)
    paste(foreign, "DICT_ARUCO_ORIGINAL", 1, (300, 200), 70)
    for image in (noise, foreign):
        assert detect_markers(frame(image), None, SETUP, CAMERA).markers == []


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("markers", [("large", "small"), ("large",), ("small",)])
def test_a_mirrored_picture_is_recognised_and_not_measured(
    axis: int, markers: tuple[str, ...]
) -> None:
    """By either marker: far away the small one cannot be read."""
    picture = render(*pose_of(0.0, 0.0, 0.3, 0.4), markers=markers)
    image = np.ascontiguousarray(np.flip(picture, axis=axis))
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.is_mirrored_marker_seen
    assert found.large is None
    assert found.small is None


def test_a_decoy_of_either_marker_is_dropped() -> None:
    image = render(*pose_of(-0.15, 0.0, 0.5))
    true_large = project(square_corners(0.150), *pose_of(-0.15, 0.0, 0.5), CAMERA)
    paste(image, "DICT_4X4_1000", 997, (430, 60), 100)
    paste(image, "DICT_ARUCO_ORIGINAL", 5, (450, 300), 60)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert np.abs(found.large.corners_px - true_large).max() < 0.2
    assert (
        nesting_error_to_tolerance_ratio(
            found.large.corners_px, found.small.corners_px, SETUP.small_to_large_side_ratio
        )
        < 0.5
    )


def test_one_wrong_cell_of_the_small_marker_is_corrected_and_no_more() -> None:
    grid = cv2.aruco.Dictionary.getBitsFromByteList(
        np.ascontiguousarray(aruco_dictionary("DICT_ARUCO_ORIGINAL").bytesList[5:6]), 5
    )
    for wrong in range(3):
        bits = grid.copy()
        bits.ravel()[[6, 12, 18][:wrong]] ^= 1
        cells = np.pad(bits, 1)
        image = np.full((480, 640), 230, np.uint8)
        image[150:290, 250:390] = np.where(np.kron(cells, np.ones((20, 20))) > 0, 230, 20)
        found = detect_markers(frame(image), None, SETUP, CAMERA)
        assert (found.small is not None) == (wrong <= 1), wrong


# --- Markers where they are expected, and the large one around a small one ---------------------


@pytest.mark.parametrize("shift_px", [0.0, 1.0, 2.5])
def test_expected_markers_are_verified_and_refined(shift_px: float) -> None:
    seen = followed(render(*POSE, noise=3.0), both(shift_px=shift_px))
    assert set(seen) == {"large", "small"}
    assert seen["large"].are_corners_fitted
    assert np.abs(seen["large"].corners_px - corners("large")).max() < 0.1
    assert np.abs(seen["small"].corners_px - corners("small")).max() < 0.4


def test_other_cells_other_turns_and_mirror_images_are_not_verified() -> None:
    image = render(*POSE)
    other = make_detector_setup(
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
    seen = refine_expected_markers(
        DetectorInput(image, None, SETUP, CAMERA), {"small": corners("small", pose)}
    )
    assert (
        find_large_marker_around_small(DetectorInput(image, None, SETUP, CAMERA), seen["small"])
        is None
    )


# --- Motion from picture to picture ------------------------------------------------------------


def test_nothing_is_between_two_targets() -> None:
    """A frame's two fields, of which each shows another one."""
    fields = [
        Detections(0, 0.0, large=Detection("large", box(x, 100, 60), 0.1, are_corners_fitted=True))
        for x in (100.0, 400.0)
    ]
    mean = average_field_detections(*fields)
    assert mean.large.corners_px[:, 0].mean() == pytest.approx(100.0)


# --- The table of methods ----------------------------------------------------------------------


EACH_VIEW = pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.method)


def test_each_method_has_a_name_and_a_view_of_its_own() -> None:
    assert [view.method for view in VIEWS] == [method.name for method in CORNER_METHODS]
    assert len({method.name for method in CORNER_METHODS}) == len(CORNER_METHODS)


@EACH_VIEW
def test_each_method_finds_the_corners_in_its_view(view: View) -> None:
    found = {method.name: after for method, after in findings(view)}
    measured = found[view.method].corners[view.marker]
    in_view = ((view.true_px >= 0.0) & (view.true_px <= (639.0, 479.0))).all(axis=1)
    assert measured.are_corners_fitted
    assert np.abs(measured.corners_px - view.true_px)[in_view].max() < view.within_px


# Without the half-size search the search in the full picture finds the same, later.
@pytest.mark.parametrize(
    "view",
    [view for view in VIEWS if view.method != "Half-size search"],
    ids=lambda view: view.method,
)
def test_without_its_row_a_method_is_missed(view: View, monkeypatch: pytest.MonkeyPatch) -> None:
    with_it = find_corners(view.picture, view.prior).corners[view.marker]
    rest = tuple(method for method in CORNER_METHODS if method.name != view.method)
    monkeypatch.setattr(detect, "CORNER_METHODS", rest)
    without = find_corners(view.picture, view.prior).corners.get(view.marker)
    assert without is None or not np.array_equal(without.corners_px, with_it.corners_px)


# --- Other ids than the default ones ------------------------------------------------------------


def target_with(large_id: int, small_id: int = 254) -> TargetConfig:
    return TargetConfig(
        large=MarkerConfig(dictionary="DICT_4X4_1000", id=large_id, side_m=0.150),
        small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=small_id, side_m=0.025),
    )


def from_the_floor(target: TargetConfig, number: int) -> NDArray[np.uint8]:
    """What a camera on the floor sees of the target, 2.3 m above it."""
    scenario = Scenario(
        ceiling_z_m=2.3, target_xy_m=(0.1, 0.1), target_yaw_rad=0.7 * number, seed=number
    )
    renderer = Renderer(scenario, CAMERA, target)
    return renderer.render([make_T(np.eye(3), (0.0, 0.0, 0.0))], frame_index=number)


@pytest.mark.parametrize("large_id", [997, 145, 300, 10])
def test_a_marker_is_fitted_as_it_is_printed(large_id: int) -> None:
    """Whatever colour its centre has, under the small marker and its ring."""
    target = target_with(large_id)
    drawing = make_detector_setup(DetectorConfig(), target).patterns["large"].drawing
    n = 240
    axis = (2.0 * np.arange(n) + 1.0) / n - 1.0
    inner = slice(GRID_MARGIN_FOR_BLUR_NODES, -GRID_MARGIN_FOR_BLUR_NODES)
    white = render_cells(drawing, axis, 1.0 / n)[inner, inner]
    printed = 1.0 - draw_target(target).ink_coverage(n / target.large.side_m, n)
    assert np.abs(white - printed).max() < 1e-5


def test_targets_are_found_from_the_floor_whatever_their_ids() -> None:
    """And none is taken for the one whose codeword is nearest."""
    bits = [target_with(i).large.bits for i in range(1000)]
    found, taken = [], 0
    for large_id in range(0, 1000, 33):
        target = target_with(large_id)
        setup = make_detector_setup(DetectorConfig(), target)

        def cells_apart(i: int, own: int = large_id) -> int:
            return min(int((np.rot90(bits[i], k) != bits[own]).sum()) for k in range(4))

        near = min((i for i in range(1000) if i != large_id), key=cells_apart)
        for number in range(2):
            image = from_the_floor(target, number)
            found.append(detect_markers(frame(image), None, setup, CAMERA).large is not None)
        other = from_the_floor(target_with(near), 0)
        taken += bool(detect_markers(frame(other), None, setup, CAMERA).markers)
    assert np.mean(found) > 0.9
    assert taken == 0
