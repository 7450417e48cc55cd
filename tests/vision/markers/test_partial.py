"""Markers of which a part cannot be seen: beyond the picture, in glaring light, behind the gear."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, MarkerConfig, Profile, TargetConfig, load_profile
from perchctl.vision import Frame, make_pipeline
from perchctl.vision.fields import interpolate_field
from perchctl.vision.lens import undistort_px
from perchctl.vision.markers.corners import (
    RefinedCorners,
    apply_homography,
    homography_from_centred_square,
)
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.detector import (
    DetectorInput,
    is_any_marker_part_hidden,
    make_detector_setup,
    make_hidden_mask,
)
from perchctl.vision.markers.partial import (
    IdentificationEvidence,
    find_visible_edges,
    fit_partly_visible_marker,
)
from perchctl.vision.markers.search import search_for_markers
from perchctl.vision.types import Detections, MarkerName
from tests.helpers.markers import POSE, SETUP, corners, followed, frame, waved
from tests.helpers.target_picture import CAMERA, pose_of, render

Grey = NDArray[np.uint8]
W, H = CAMERA.size_px
LARGE = SETUP.patterns["large"]


def partly(
    image: Grey,
    start_corners_px: Array,
    identified_by: IdentificationEvidence,
    hidden: NDArray[np.bool_] | None = None,
) -> RefinedCorners | None:
    """The large marker by what is seen of it."""
    return fit_partly_visible_marker(
        DetectorInput(image, hidden, SETUP, CAMERA), "large", start_corners_px, identified_by
    )


def beyond(pose: tuple[Array, Array], name: MarkerName = "large") -> float:
    """How far the marker reaches beyond the picture, in terms of its side."""
    c = corners(name, pose)
    out = max(float(-c.min()), float((c - (W - 1, H - 1)).max()))
    return out / float(np.linalg.norm(c - np.roll(c, 1, axis=0), axis=1).mean())


def cut(share: float, seed: int, yaw: float | None = None) -> tuple[Array, Array]:
    """A pose with a corner of the large marker so far beyond the picture's left or lower edge."""
    rng = np.random.default_rng(seed)
    z, turn, other = rng.uniform(0.25, 0.6), rng.uniform(-math.pi, math.pi), rng.uniform(-0.1, 0.1)
    roll, pitch = rng.uniform(-0.05, 0.05, 2) if yaw is None else (0.0, 0.0)
    yaw = turn if yaw is None else yaw
    low, high = 0.0, 1.2 * z
    for _ in range(30):
        middle = 0.5 * (low + high)
        x, y = (-middle, other) if seed % 2 else (other, middle)
        pose = pose_of(x, y, z, yaw, roll, pitch)
        low, high = (middle, high) if beyond(pose) < share else (low, middle)
    return pose


def glaring(image: Grey, centre: Array, radius_px: float, light_grey: float = 800.0) -> Grey:
    """With a highlight, of 800 grey levels far beyond white."""
    x, y = np.meshgrid(np.arange(W) - centre[0], np.arange(H) - centre[1])
    light = 0.5 * light_grey * (1.0 - np.tanh((np.hypot(x, y) / radius_px - 1.0) / 0.12))
    return np.clip(image + light, 0, 255).astype(np.uint8)


def sigmas(found: Detections, pose: tuple[Array, Array]) -> Array:
    """The corners' errors of the large marker in units of what is claimed, in its own axes."""
    large = found.large
    error = (large.corners_px - corners("large", pose)).ravel()
    values, axes = np.linalg.eigh(large.cov_px2)
    return np.asarray(axes.T @ error / np.sqrt(values))


@pytest.mark.parametrize("share", [0.01, 0.04, 0.1])
def test_a_marker_that_the_picture_cuts_is_measured_by_what_is_left_of_it(share: float) -> None:
    squares = []
    for seed in range(4):
        pose = cut(share, seed)
        found = detect_markers(frame(render(*pose, noise=2.0, seed=seed)), None, SETUP, CAMERA)
        squares.append(sigmas(found, pose))
        # A pixel of a corner beyond the picture may be a millimetre of the target.
        assert np.abs(found.large.corners_px - corners("large", pose)).max() < 0.3
    assert np.abs(squares).max() < 4.0
    assert np.mean(np.square(squares)) < 2.0


@pytest.mark.parametrize(
    "share", [0.02, *(pytest.param(share, marks=pytest.mark.long) for share in (0.04, 0.25)), 0.4]
)
def test_the_edge_of_the_picture_is_taken_for_no_side(share: float) -> None:
    """Alone, the large marker is measured or refused, and never made smaller than it is."""
    measured = 0
    for seed in range(4):
        pose = cut(share, seed)
        image = render(*pose, markers=("large",), noise=2.0, seed=seed)
        found = detect_markers(frame(image), None, SETUP, CAMERA).large
        if found is not None:
            assert np.abs(found.corners_px - corners("large", pose)).max() < 0.3
        measured += found is not None
    assert share > 0.2 or measured > 1


@pytest.mark.parametrize("share", [-0.02, -0.01, -0.005, 0.0, 0.005])
def test_a_side_along_the_edge_of_the_picture_is_not_drawn_inwards(share: float) -> None:
    """Blur needs what is beyond the edge: lines alone err by 1 to 2.4 px here."""
    pose = cut(share, 1, yaw=0.0)
    true, image = corners("large", pose), render(*pose, blur_px=2.0)
    first = detect_markers(frame(image), None, SETUP, CAMERA)
    for found in (first, detect_markers(frame(image, 1), first, SETUP, CAMERA)):
        assert np.abs(found.large.corners_px - true).max() < 0.03
    seen = partly(image, true + 1.0, "bits")
    assert np.abs(seen.corners_px - true).max() < 0.03


def test_what_the_edge_cut_off_is_not_taken_unless_its_cells_are_seen() -> None:
    """Both markers decoded, but the large one does not look as it should."""
    pose = cut(0.03, 0)
    image = render(*pose, noise=2.0)
    assert set(search_for_markers(DetectorInput(image, None, SETUP, CAMERA), {}).corners_px) == {
        "large",
        "small",
    }
    large = MarkerConfig(dictionary="DICT_4X4_1000", id=16, side_m=0.150)
    other = make_detector_setup(DetectorConfig(), TargetConfig(large=large)).patterns["large"]
    setup = replace(SETUP, patterns={**SETUP.patterns, "large": other})
    found = detect_markers(frame(image), None, setup, CAMERA)
    assert found.large is None
    assert found.small is not None


@pytest.mark.parametrize("share", [0.005, 0.08])
def test_a_cut_marker_is_verified_where_it_is_expected(share: float) -> None:
    pose = cut(share, 2)
    image = render(*pose, noise=2.0)
    near: dict[MarkerName, Array] = {"large": corners("large", pose) + 2.0}
    seen = followed(image, near)
    assert np.abs(seen["large"].corners_px - corners("large", pose)).max() < 0.3
    other = render(*pose, markers=(("DICT_4X4_1000", 16, 0.150), "small"))
    assert "large" not in followed(other, near)


@pytest.mark.parametrize("radius", [0.12, pytest.param(0.2, marks=pytest.mark.long), 0.3])
@pytest.mark.parametrize(
    "corner", [0, *(pytest.param(corner, marks=pytest.mark.long) for corner in (1, 2)), 3]
)
def test_a_highlight_on_a_corner_leaves_three_sides(radius: float, corner: int) -> None:
    pose = pose_of(0.03, -0.02, 0.35, 0.7 + corner, 0.05, -0.08)
    true = corners("large", pose)
    side = float(np.linalg.norm(true[0] - true[1]))
    centre = true[corner] + 0.1 * (true.mean(axis=0) - true[corner])
    image = glaring(render(*pose, noise=2.0), centre, radius * side)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert np.abs(found.large.corners_px - true).max() < 0.3
    if found.large.cov_px2 is not None:
        assert np.abs(sigmas(found, pose)).max() < 4.0
    again = detect_markers(frame(image, 1), found, SETUP, CAMERA)
    assert np.abs(again.large.corners_px - true).max() < 0.3


def test_a_cell_in_glaring_light_is_unknown_and_not_wrong() -> None:
    image, true = render(*POSE, noise=2.0), corners("large")
    black = np.flatnonzero(LARGE.is_cell_inside_border & ~LARGE.is_cell_white)[0]
    spots = apply_homography(
        homography_from_centred_square(true),
        LARGE.sample_points_half_sides[LARGE.sample_cell_index == black],
    )
    side = float(np.linalg.norm(true[0] - true[1]))
    bright = glaring(image, spots.mean(axis=0), side / 9.0)
    found = partly(bright, true, "track")
    assert np.abs(found.corners_px - true).max() < 0.1
    grey = np.where(bright > image + 20, 200, image).astype(np.uint8)  # white paper instead
    assert partly(grey, true, "track") is None


def test_other_cells_are_not_the_marker_whatever_else_is_hidden() -> None:
    pose = pose_of(0.02, 0.01, 0.4, 0.3)
    image = render(*pose, markers=(("DICT_4X4_1000", 16, 0.150),))
    ways: tuple[IdentificationEvidence, ...] = ("bits", "track", "other_marker")
    for identified_by in ways:
        assert partly(image, corners("large", pose), identified_by) is None
    turned = np.roll(corners("large", pose), 1, axis=0)
    right = render(*pose)
    assert partly(right, turned, "other_marker") is None
    assert partly(right, corners("large", pose), "bits") is not None
    assert partly(waved(right), corners("large", pose), "bits") is None


def test_a_code_that_may_be_another_one_is_not_told_by_its_bits_alone() -> None:
    """Two bits hidden: other codewords differ in no more."""
    pose = pose_of(0.0, 0.0, 0.4)
    image, true = render(*pose), corners("large", pose)
    covered = np.zeros((H, W), np.bool_)
    cell = float(np.linalg.norm(true[1] - true[0])) / 6.0
    x, y = true[0] + 1.05 * cell
    covered[round(y) : round(y + 0.9 * cell), round(x) : round(x + 1.9 * cell)] = True
    assert partly(image, true, "bits", covered) is None
    assert partly(image, true, "track", covered) is not None


# --- The vehicle's own gear in the picture: `camera.mask`, from the file to the corners --------


TRUE = corners("large")


def over(*ends: tuple[float, float], width: int = 22) -> NDArray[np.bool_]:
    """A leg between two points."""
    drawn = np.zeros((H, W), np.uint8)
    a, b = (tuple(round(v) for v in end) for end in ends)
    cv2.line(drawn, a, b, 1, width)
    return drawn > 0


def middle(a: int, b: int) -> tuple[float, float]:
    x, y = 0.5 * (TRUE[a] + TRUE[b])
    return float(x), float(y)


LEGS = {
    "corner": over((float(TRUE[1][0]) + 20, float(TRUE[1][1]) + 5), (W, H / 2)),
    "across a corner": over(middle(0, 1), middle(1, 2)),
    "side": over(tuple(TRUE[2]), tuple(TRUE[3])),
}


@pytest.mark.parametrize("name", sorted(LEGS))
def test_behind_a_leg_the_marker_is_measured_by_the_rest(name: str) -> None:
    """Whatever grey the gear has, the same is found."""
    covered = LEGS[name]
    assert is_any_marker_part_hidden(covered, TRUE)
    bare, at = render(*POSE, noise=2.0), homography_from_centred_square(undistort_px(TRUE, CAMERA))
    seen = [
        find_visible_edges(DetectorInput(bare, gear, SETUP, CAMERA), at, LARGE)
        for gear in (None, covered)
    ]
    whole, rest = (edges.profile_weight.sum() for edges in seen)
    assert (rest < 0.95 * whole) == (name != "corner"), "no side that is hidden counts"
    setup, found = replace(SETUP, static_hidden_mask=covered), []
    for grey in (0, 120, 255):
        image = np.where(covered, grey, render(*POSE, noise=2.0)).astype(np.uint8)
        before: Detections | None = None
        for k in range(2):
            before = detect_markers(frame(image, k), before, setup, CAMERA)
            assert before.large.cov_px2 is not None
            assert np.abs(before.large.corners_px - TRUE).max() < 0.2
        found.append(before.large.corners_px)
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])


def test_a_field_shows_the_gear_in_the_rows_beside_it_too() -> None:
    covered = LEGS["corner"]
    image = np.where(covered, 0, 200).astype(np.uint8)
    for first_row, name in ((0, "top"), (1, "bottom")):
        field = interpolate_field(image, first_row)
        hidden = make_hidden_mask(Frame(0, 0.0, field, picture_kind=name), covered)
        assert hidden is not None
        assert (field[~hidden] == 200).all()
    whole = make_hidden_mask(Frame(0, 0.0, image, picture_kind="whole"), covered)
    assert whole is not None
    assert np.array_equal(whole, covered)


# --- the file ----------------------------------------------------------------------------------


def profile_with(folder: Path, image: Grey | str | None, **camera: object) -> Profile:
    """A profile in a folder, with the mask beside it."""
    if isinstance(image, str):
        (folder / "gear.png").write_text(image)
    elif image is not None:
        cv2.imwrite(str(folder / "gear.png"), image)
    keys = "".join(f", {key}: {value}" for key, value in camera.items())
    (folder / "mine.yaml").write_text(f"extends: sim\ncamera: {{mask: gear.png{keys}}}\n")
    return load_profile(str(folder / "mine.yaml"))


def test_a_mask_stands_beside_its_profile(tmp_path: Path) -> None:
    drawn = np.zeros((H, W), np.uint8)
    drawn[:40, :70] = 255
    mask = make_pipeline(profile_with(tmp_path, drawn), CAMERA).detector_setup.static_hidden_mask
    assert np.array_equal(mask, drawn > 0)
    turned = make_pipeline(
        profile_with(tmp_path, drawn, mirrored="true"), CAMERA
    ).detector_setup.static_hidden_mask
    assert np.array_equal(turned, drawn[:, ::-1] > 0)
    assert make_pipeline(Profile(), CAMERA).detector_setup.static_hidden_mask is None


@pytest.mark.parametrize("image", [None, np.full((H, W), 255, np.uint8)])
def test_a_mask_that_is_given_replaces_that_of_the_profile(
    image: Grey | None, tmp_path: Path
) -> None:
    """Also where the profile names none, or a file that could not be used."""
    given = np.zeros((H, W), np.bool_)
    given[:40, :70] = True
    named = Profile() if image is None else profile_with(tmp_path, image)
    assert np.array_equal(
        make_pipeline(named, CAMERA, given).detector_setup.static_hidden_mask, given
    )


WHITE, BLACK = np.full((H, W), 255, np.uint8), np.zeros((H, W), np.uint8)


@pytest.mark.parametrize(
    ("image", "error", "told"),
    [
        (None, NotFound, "does not exist"),
        ("legs", InvalidValue, "cannot be read as an image"),
        (WHITE[:240, :320], InvalidValue, "320x240 px, but the calibration was made at 640x480"),
        (WHITE, InvalidValue, "covers 100 % of the image, but at most 75 %"),
        (BLACK, InvalidValue, "covers nothing"),
    ],
)
def test_a_mask_that_cannot_be_is_one_sentence(
    image: Grey | str | None, error: type[PerchError], told: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=told) as caught:
        make_pipeline(profile_with(tmp_path, image), CAMERA)
    assert "gear.png" in str(caught.value)
    assert "\n" not in str(caught.value)
