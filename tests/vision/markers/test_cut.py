"""Markers that the picture cuts: what is left of the drawing, and the way to contact."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import (
    Frame,
    PipelineOutput,
    PipelineState,
    VehicleState,
    project,
    square_corners,
    step,
)
from perchctl.vision.lens import distort_to_px, undistort_px, undistort_to_normalised
from perchctl.vision.markers.corners import is_inside_image
from perchctl.vision.markers.cut import (
    MAX_TARGET_MEASUREMENT_AGE_TO_TRY_TRUNCATED_FIT_S,
    RigidPose,
    fit_pose,
    fit_truncated_markers,
    is_target_possibly_truncated,
    make_outline,
)
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.detector import DetectorInput
from perchctl.vision.markers.partial import find_visible_edges
from perchctl.vision.types import Detection, Detections, MarkerName
from tests.helpers.markers import SETUP, both, corners, frame, waved
from tests.helpers.target_picture import CAMERA, pose_of, render

# The camera beside the gear along the picture's height and along its width, under it, and so
# far aside that the large marker alone is left.
BESIDE_HEIGHT = pose_of(0.002, -0.030, 0.034, 0.03, 0.01, -0.02)
BESIDE_WIDTH = pose_of(-0.031, 0.003, 0.030, -0.04, 0.0, 0.02)
UNDER = pose_of(0.001, -0.002, 0.014, 0.05, -0.02, 0.01)
ASIDE = pose_of(-0.116, 0.010, 0.105, 0.1, 0.02, 0.02)
LINE = pose_of(-0.045, 0.0, 0.026)  # nothing but one edge, which says nothing of one direction
POSES = {
    "height": BESIDE_HEIGHT,
    "width": BESIDE_WIDTH,
    "under": UNDER,
    "aside": ASIDE,
    "line": LINE,
    "corner": pose_of(-0.092, 0.020, 0.075, 0.1, 0.02, 0.02),
}
SHAPE = (480, 640)


@cache
def picture(name: str) -> NDArray[np.uint8]:
    return render(*POSES[name], noise=4.0, blur_px=1.0)


def seen_before(name: str, age_s: float = 1 / 30) -> Detections:
    """The markers where they are, `age_s` before frame 0."""
    at = both(POSES[name])
    large, small = (Detection(n, at[n], 0.1, True) for n in ("large", "small"))
    return Detections(-1, -age_s, large=large, small=small)


def search_mode(
    name: str, image: NDArray[np.uint8] | None = None, off_px: float = 0.0, age_s: float = 1 / 30
) -> Detections:
    expected = both(POSES[name], off_px)
    image = picture(name) if image is None else image
    return detect_markers(frame(image), seen_before(name, age_s), SETUP, CAMERA, expected)


def nothing(found: Detections) -> bool:
    return found.large is None and found.small is None


@pytest.mark.parametrize(("name", "off_px"), [("height", 25.0), ("width", -30.0), ("under", 20.0)])
def test_corners_follow_from_what_is_left(name: str, off_px: float) -> None:
    true = corners("small", POSES[name])
    assert not is_inside_image(true, SHAPE)
    found = search_mode(name, off_px=off_px).small
    error = undistort_px(found.corners_px, CAMERA) - undistort_px(true, CAMERA)
    assert float(error.ravel() @ np.linalg.solve(found.cov_px2, error.ravel())) < 20.0
    inside = (true >= 0).all(axis=1) & (true <= (639, 479)).all(axis=1)
    assert np.abs(error[inside]).max(initial=0.0) < 0.3


def test_the_large_marker_stands_for_what_shows_nothing_of_the_small_one() -> None:
    found = search_mode("aside", off_px=12.0)
    assert found.small is None
    true = corners("large", ASIDE)
    error = (undistort_px(found.large.corners_px, CAMERA) - undistort_px(true, CAMERA)).ravel()
    assert float(error @ np.linalg.solve(found.large.cov_px2, error)) < 20.0


def test_it_is_never_a_first_sight_nor_one_after_a_while() -> None:
    image, expected = picture("height"), both(BESIDE_HEIGHT)
    assert nothing(detect_markers(frame(image), None, SETUP, CAMERA, expected))
    empty = Detections(-1, -1 / 30)
    assert nothing(detect_markers(frame(image), empty, SETUP, CAMERA, expected))
    assert not nothing(
        search_mode("height", age_s=MAX_TARGET_MEASUREMENT_AGE_TO_TRY_TRUNCATED_FIT_S - 0.01)
    )
    assert nothing(
        search_mode("height", age_s=MAX_TARGET_MEASUREMENT_AGE_TO_TRY_TRUNCATED_FIT_S + 0.01)
    )


def test_a_target_that_was_whole_is_searched_for_wherever_it_is_expected() -> None:
    """A prediction by an estimate that has jumped may be anywhere."""
    whole = pose_of(0.0, 0.0, 0.4, 0.3)
    at = both(whole)
    before = Detections(-1, -1 / 30, *(Detection(n, at[n], 0.1, True) for n in ("large", "small")))
    image = render(*whole, noise=4.0)
    found = detect_markers(frame(image), before, SETUP, CAMERA, both(POSES["under"]))
    for name, one in (("large", found.large), ("small", found.small)):
        assert np.abs(one.corners_px - at[name]).max() < 0.2


def _bare(kind: str) -> NDArray[np.uint8]:
    rng = np.random.default_rng(3)
    if kind == "blank":
        image = np.full(SHAPE, 180.0)
    elif kind == "tiles":
        y, x = np.mgrid[:480, :640]
        image = np.where((x // 90 + y // 70) % 2 == 0, 60.0, 200.0)
    elif kind == "seams":
        image = np.full(SHAPE, 190.0)
        image[200:225] = image[:, 300:330] = 40.0
    else:
        image = np.kron(rng.integers(0, 2, (8, 11)), np.ones((60, 60)))[:480, :640] * 150.0 + 40.0
    soft = cv2.GaussianBlur(image, (0, 0), 1.2) + rng.normal(0.0, 4.0, SHAPE)
    return np.clip(soft, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", ["height", "width", "under", "aside"])
@pytest.mark.parametrize("kind", ["blank", "tiles", "seams", "blocks"])
def test_what_is_not_the_target_is_refused(name: str, kind: str) -> None:
    assert nothing(search_mode(name, _bare(kind)))


@pytest.mark.parametrize("name", ["height", "width", "under"])
def test_other_markers_in_its_place_are_refused(name: str) -> None:
    other = render(
        *POSES[name], blur_px=1.0, noise=4.0,
        markers=(("DICT_4X4_1000", 5, 0.150), ("DICT_ARUCO_ORIGINAL", 300, 0.025)),
    )  # fmt: skip
    assert nothing(search_mode(name, other))


@pytest.mark.parametrize("name", ["height", "width"])
def test_a_plain_square_in_the_small_marker_s_place_is_refused(name: str) -> None:
    """All edges but those of its cells are there."""
    image = render(*POSES[name], blur_px=1.0, noise=4.0, markers=("large",))
    rvec, tvec = POSES[name]
    square_px = project(square_corners(0.025), rvec, tvec, CAMERA)
    cv2.fillConvexPoly(image, np.rint(square_px).astype(np.int32), 30)
    assert nothing(search_mode(name, np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8)))


def test_what_leaves_a_direction_open_is_refused() -> None:
    """With a lens through which its corners could be told."""
    plain = replace(CAMERA, dist=np.zeros(5))
    outline = make_outline(SETUP.patterns["large"].drawing, 0.0, 0.0)
    image = render(*LINE, plain, noise=4.0, blur_px=1.0)
    found = fit_pose(image, _pose("line"), outline, plain)
    assert found.found_edge_point_count == found.visible_edge_point_count
    expected: dict[MarkerName, Array] = {"small": project(square_corners(0.025), *LINE, plain)}
    assert fit_truncated_markers(DetectorInput(image, None, SETUP, plain), expected) == {}
    assert nothing(search_mode("width", waved(picture("width")))), "nor do edges that fit badly"


@pytest.mark.parametrize("name", ["height", "width"])
def test_the_target_elsewhere_is_refused(name: str) -> None:
    """Half a marker away from where it can be."""
    rvec, tvec = POSES[name]
    moved = render(rvec, tvec + np.array((0.011, 0.009, 0.0)), blur_px=1.0, noise=4.0)
    assert nothing(search_mode(name, moved))


def gear(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """The picture with a ragged piece of the vehicle in it, and its mask."""
    mask = np.zeros(SHAPE, dtype=np.uint8)
    outline = np.array([[130, 480], [150, 310], [240, 280], [330, 330], [420, 270], [470, 480]])
    cv2.fillPoly(mask, [outline], 1)
    covered = image.copy()
    covered[mask > 0] = np.where(np.arange(int(mask.sum())) % 40 < 20, 90, 20)
    return covered, cv2.dilate(mask, np.ones((5, 5))).astype(bool)


def test_what_the_gear_covers_counts_neither_way() -> None:
    image, mask = gear(picture("height"))
    true = corners("small", BESIDE_HEIGHT)
    expected = both(BESIDE_HEIGHT, 10.0)
    assert fit_truncated_markers(DetectorInput(image, None, SETUP, CAMERA), expected) == {}
    outline = make_outline(SETUP.patterns["large"].drawing, 0.0, 0.0)
    own = mask.astype(np.uint8)
    fit = fit_pose(image, _pose("height"), outline, CAMERA, own)
    assert fit.found_edge_point_count == fit.visible_edge_point_count
    found = fit_truncated_markers(DetectorInput(image, mask, SETUP, CAMERA), expected)["small"]
    error = (undistort_px(found.corners_px, CAMERA) - undistort_px(true, CAMERA)).ravel()
    assert float(error @ np.linalg.solve(found.cov_px2, error)) < 20.0


def test_markers_behind_the_gear_are_cut() -> None:
    pose = pose_of(0.0, -0.005, 0.06)
    at: dict[MarkerName, Array] = {"small": corners("small", pose)}
    free, hidden = np.zeros(SHAPE, dtype=bool), np.zeros(SHAPE, dtype=bool)
    x, y = at["small"][0].astype(int)
    hidden[: y + 30, : x + 30] = True
    assert not is_target_possibly_truncated(at, SHAPE)
    assert not is_target_possibly_truncated(at, SHAPE, free)
    assert is_target_possibly_truncated(at, SHAPE, hidden)
    assert is_target_possibly_truncated({"small": corners("small", BESIDE_HEIGHT)}, SHAPE, free)
    assert not is_target_possibly_truncated({}, SHAPE)


def _pose(name: str) -> RigidPose:
    """The true pose in units of the large marker's half side, own coordinates' axes."""
    rvec, tvec = POSES[name]
    R = np.asarray(cv2.Rodrigues(rvec)[0], dtype=float)
    return RigidPose(R @ np.diag([1.0, -1.0, -1.0]), tvec / 0.075)


def test_corners_that_the_lens_cannot_image_are_not_given() -> None:
    """Of the large marker alone in view, and its far corners where the lens model has no
    inverse."""
    image, outline = picture("corner"), make_outline(SETUP.patterns["large"].drawing, 0.0, 0.0)
    x = undistort_to_normalised(distort_to_px(np.array([[2.3, 0.6]]), CAMERA), CAMERA)
    assert np.abs(x - (2.3, 0.6)).max() > 1e-2
    found = fit_pose(image, _pose("corner"), outline, CAMERA)
    assert found.found_small_marker_edge_point_count == 0
    assert (
        fit_truncated_markers(DetectorInput(image, None, SETUP, CAMERA), both(POSES["corner"]))
        == {}
    )


def test_a_prediction_may_be_off_in_range() -> None:
    rvec, tvec = BESIDE_HEIGHT
    for growth in (0.93, 1.07):
        expected = both((rvec, tvec * (1.0, 1.0, growth)))
        assert "small" in fit_truncated_markers(
            DetectorInput(picture("height"), None, SETUP, CAMERA), expected
        )


@pytest.mark.parametrize("side_px", [1e6, 1e8, 1e12])
def test_a_square_beyond_all_lenses_shows_no_edges(side_px: float) -> None:
    """Where a lens model throws a near target's far corners overflows a picture's coordinates."""
    square_px = np.array([[side_px, 0.0, 320.0], [0.0, side_px, 240.0], [0.0, 0.0, 1.0]])
    seen = DetectorInput(picture("height"), None, SETUP, CAMERA)
    assert find_visible_edges(seen, square_px, SETUP.patterns["large"]) is None


# --- The pipeline on the way to contact --------------------------------------------------------


# Of the target in the camera: beside the gear along width and height, and under it.
SIDEWAYS = {"width": (-0.030, 0.002), "height": (0.001, -0.030), "under": (0.002, 0.001)}
NEAREST_M = {"width": 0.025, "height": 0.033, "under": 0.012}
STEP_M = 0.003


def ascent(build: Any, along: str, with_attitude: bool) -> list[tuple[float, PipelineOutput]]:
    """The camera's distance, and what its picture gave."""
    setup = build()
    x, y = SIDEWAYS[along]
    state, out = PipelineState(), []
    for k, z in enumerate(np.arange(0.075, NEAREST_M[along], -STEP_M)):
        image = render(*pose_of(x, y, z, 0.02 * k / 20), noise=4.0, blur_px=1.0, seed=k)
        attitude = VehicleState(k / 30, 0.0, 0.0, 0.0, (0.0, 0.0, -z)) if with_attitude else None
        state, output = step(state, Frame(k, k / 30, image), attitude, setup)
        out.append((float(z), output))
    return out


def errors_m(rows: list[tuple[float, PipelineOutput]], along: str) -> Array:
    return np.array([next(iter(o.poses.values())).e_m - (*SIDEWAYS[along], z) for z, o in rows])


@pytest.mark.parametrize(
    "along",
    [
        "height",
        pytest.param("width", marks=pytest.mark.long),
        pytest.param("under", marks=pytest.mark.long),
    ],
)
def test_an_ascent_is_measured_to_the_end(build: Any, along: str) -> None:
    rows = ascent(build, along, with_attitude=along != "under")
    assert all(o.target is not None and o.target.is_measured_in_newest_frame for _, o in rows)
    cut = [(z, o) for z, o in rows if o.detections.small.cov_px2 is not None]
    assert len(cut) >= 2
    assert np.abs(errors_m(cut, along)).max() < 1e-4
    # Of the corners' own noise alone: no print is wrong here.
    claimed = np.array([next(iter(o.poses.values())).sigma_m for _, o in cut])
    assert ((errors_m(cut, along) / claimed) ** 2).mean() < 2.0
    assert claimed.max() < 5e-4
