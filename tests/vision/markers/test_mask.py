"""The vehicle's own gear in the picture: `camera.mask`, from the file to the corners."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.geometry import Array
from perchctl.profile import Profile, load_profile
from perchctl.vision import Detections, Frame, MarkerName, field_picture, make_pipeline
from perchctl.vision.markers.corners import from_unit, mapped
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.detector import filled, hidden_in, hides, make_mask
from tests.helpers.markers import POSE, SETUP, corners, followed, frame
from tests.helpers.target_picture import CAMERA, pose_of, render

W, H = CAMERA.size_px
TRUE = corners("large")


def over(*ends: tuple[float, float], width: int = 22) -> NDArray[np.bool_]:
    """A leg between two points."""
    drawn = np.zeros((H, W), np.uint8)
    a, b = (tuple(round(v) for v in end) for end in ends)
    cv2.line(drawn, a, b, 1, width)
    return drawn > 0


def behind(image: NDArray[np.uint8], covered: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The picture with the leg before it, dark, and a little smaller than its mask."""
    inner = cv2.erode(covered.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return np.where(inner, 25, image).astype(np.uint8)


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
    covered = LEGS[name]
    assert hides(covered, TRUE)
    setup = replace(SETUP, mask=make_mask(covered))
    image = behind(render(*POSE, noise=2.0), covered)
    before: Detections | None = None
    for k in range(2):
        before = detect_markers(frame(image, k), before, setup, CAMERA)
        assert before.large is not None
        assert before.large.cov_px2 is not None
        assert np.abs(before.large.corners_px - TRUE).max() < 0.2


def test_where_it_is_expected_a_hidden_cell_is_unknown_and_not_wrong() -> None:
    pattern = SETUP.patterns["large"]
    black = np.flatnonzero(pattern.inner & ~pattern.white)[0]
    spots = mapped(from_unit(TRUE), pattern.spots[pattern.owner == black])
    x, y = spots.mean(axis=0)
    covered = over((x, y), (x, y), width=40)
    image = filled(behind(render(*POSE, noise=2.0), covered), covered)
    expected: dict[MarkerName, Array] = {"large": TRUE + 1.0}
    seen = followed(image, expected, hidden=covered)
    assert np.abs(seen["large"].corners_px - TRUE).max() < 0.2
    assert "large" not in followed(image, expected)


@pytest.mark.parametrize("name", sorted(LEGS))
def test_what_a_leg_covers_counts_for_nothing(name: str) -> None:
    """Whatever grey the gear has, the same is found."""
    covered = LEGS[name]
    setup = replace(SETUP, mask=make_mask(covered))
    found = []
    for grey in (0, 120, 255):
        image = np.where(covered, grey, render(*POSE, noise=2.0)).astype(np.uint8)
        large = detect_markers(frame(image), None, setup, CAMERA).large
        assert large is not None
        found.append(large.corners_px)
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])


def test_a_field_shows_the_gear_in_the_rows_beside_it_too() -> None:
    covered = LEGS["corner"]
    mask = make_mask(covered)
    image = np.where(covered, 0, 200).astype(np.uint8)
    for first_row, name in ((0, "top"), (1, "bottom")):
        field = field_picture(image, first_row)
        hidden = hidden_in(Frame(0, 0.0, field, fields=name), mask)  # type: ignore[arg-type]
        assert hidden is not None
        assert (field[~hidden] == 200).all()
    whole = hidden_in(Frame(0, 0.0, image, fields="whole"), mask)
    assert whole is not None
    assert np.array_equal(whole, covered)


def test_the_fields_of_a_woven_frame_are_measured_behind_a_leg() -> None:
    covered = LEGS["across a corner"]
    top, bottom = (render(*pose_of(0.03 + x, -0.02, 0.35, 0.7, 0.05, -0.08)) for x in (-2e-3, 2e-3))
    woven = top.copy()
    woven[1::2] = bottom[1::2]
    setup = replace(SETUP, mask=make_mask(covered))
    seen = Frame(0, 0.0, behind(woven, covered), fields="woven")
    found = detect_markers(seen, None, setup, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - TRUE).max() < 0.2


def test_what_is_filled_in_makes_no_edge() -> None:
    image = np.full((H, W), 180, np.uint8)
    covered = LEGS["corner"]
    assert np.abs(filled(behind(image, covered), covered).astype(int) - 180).max() <= 1
    everything = np.ones((H, W), np.bool_)
    everything[:, :4] = False
    assert np.abs(filled(image, everything).astype(int) - 180).max() <= 1


def test_hides_is_about_the_marker_and_the_white_around_it() -> None:
    assert not hides(None, TRUE)
    assert not hides(over((0, 0), (60, 10)), TRUE)
    assert not hides(LEGS["corner"], TRUE + 5000.0)
    assert not hides(LEGS["corner"], np.full((4, 2), np.nan))
    # Beside the marker, within its bounding box.
    turned = corners("large", pose_of(0.0, 0.0, 0.5, np.pi / 4))
    corner = tuple(turned.min(axis=0) + 4.0)
    assert not hides(over(corner, corner, width=5), turned)


# --- the file ---------------------------------------------------------------------------


def profile_with(folder: Path, image: NDArray[np.uint8] | None, **camera: object) -> Profile:
    """A profile in a folder, with the mask beside it."""
    if image is not None:
        cv2.imwrite(str(folder / "gear.png"), image)
    keys = "".join(f", {key}: {value}" for key, value in camera.items())
    (folder / "mine.yaml").write_text(f"extends: sim\ncamera: {{mask: gear.png{keys}}}\n")
    return load_profile(str(folder / "mine.yaml"))


def test_a_mask_stands_beside_its_profile(tmp_path: Path) -> None:
    drawn = np.zeros((H, W), np.uint8)
    drawn[:40, :70] = 255
    mask = make_pipeline(profile_with(tmp_path, drawn), CAMERA).detector.mask
    assert mask is not None
    assert np.array_equal(mask.whole, drawn > 0)
    turned = make_pipeline(profile_with(tmp_path, drawn, mirrored="true"), CAMERA).detector.mask
    assert turned is not None
    assert np.array_equal(turned.whole, drawn[:, ::-1] > 0)
    assert make_pipeline(Profile(), CAMERA).detector.mask is None


WHITE, BLACK = np.full((H, W), 255, np.uint8), np.zeros((H, W), np.uint8)


@pytest.mark.parametrize(
    ("image", "error", "told"),
    [
        (None, NotFound, "does not exist"),
        (WHITE[:240, :320], InvalidValue, "320x240 px, but the calibration was made at 640x480"),
        (WHITE, InvalidValue, "covers 100 % of the picture, at most 75 %"),
        (BLACK, InvalidValue, "covers nothing"),
    ],
)
def test_a_mask_that_cannot_be_is_one_sentence(
    image: NDArray[np.uint8] | None, error: type[PerchError], told: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=told) as caught:
        make_pipeline(profile_with(tmp_path, image), CAMERA)
    assert "gear.png" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mask_that_is_no_picture_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "gear.png").write_text("legs")
    with pytest.raises(InvalidValue, match="cannot be read as a picture"):
        make_pipeline(profile_with(tmp_path, None), CAMERA)
