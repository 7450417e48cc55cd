"""Markers of which a part cannot be seen: what is measured of them, and what is claimed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig
from perchctl.vision import Detections, Frame, MarkerName, PipelineState, make_aruco_detector, step
from perchctl.vision.markers.corners import from_unit, mapped
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.partial import (
    KnownBy,
    fit_partly,
    may_show_enough,
    seen_partly,
    visible_cells_agree,
)
from perchctl.vision.markers.search import search
from tests.helpers.markers import POSE, SETUP, corners, followed, frame
from tests.helpers.target_picture import CAMERA, pose_of, render

Grey = NDArray[np.uint8]
W, H = CAMERA.size_px
LARGE = SETUP.patterns["large"]


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
    assert large is not None
    assert large.cov_px2 is not None
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
        assert found.large is not None
        # A pixel of a corner beyond the picture may be a millimetre of the target.
        assert np.abs(found.large.corners_px - corners("large", pose)).max() < 0.3
    assert np.abs(squares).max() < 4.0
    assert np.mean(np.square(squares)) < 2.0


def test_corners_out_of_sight_are_claimed_to_be_known_less() -> None:
    pose = cut(0.1, 1)
    found = detect_markers(frame(render(*pose, noise=2.0)), None, SETUP, CAMERA).large
    assert found is not None
    assert found.cov_px2 is not None
    spread = np.sqrt(np.diagonal(found.cov_px2).reshape(4, 2).sum(axis=1))
    gone = int(corners("large", pose)[:, 0].argmin())
    assert spread[gone] > 1.1 * np.delete(spread, gone).max()


@pytest.mark.parametrize("share", [0.02, 0.04, 0.25, 0.4])
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
        assert found.large is not None
        assert np.abs(found.large.corners_px - true).max() < 0.03
    seen = seen_partly(image, true + 1.0, LARGE, CAMERA, "bits")
    assert seen is not None
    assert np.abs(seen.corners_px - true).max() < 0.03


def test_what_the_edge_cut_off_is_not_taken_unless_its_cells_are_seen() -> None:
    """Both markers decoded, but the large one does not look as it should."""
    pose = cut(0.03, 0)
    image = render(*pose, noise=2.0)
    assert set(search(image, {}, SETUP).corners_px) == {"large", "small"}
    large = MarkerConfig(dictionary="DICT_4X4_1000", id=16, side_m=0.150)
    other = make_aruco_detector(DetectorConfig(), TargetConfig(large=large)).patterns["large"]
    setup = replace(SETUP, patterns={**SETUP.patterns, "large": other})
    found = detect_markers(frame(image), None, setup, CAMERA)
    assert found.large is None
    assert found.small is not None


def test_a_pose_from_a_cut_marker_is_as_good_as_it_claims(build: Callable[..., object]) -> None:
    setup = build()
    for seed in range(4):
        pose = cut(0.04, seed)
        image = render(*pose, noise=2.0, seed=seed)
        output = step(PipelineState(), Frame(0, 0.0, image), None, setup)[1]  # type: ignore[arg-type]
        joint = output.poses["joint"]
        assert joint.cov is not None
        error = joint.e_m - pose[1]
        assert np.abs(error).max() < 6e-4
        assert error @ np.linalg.solve(joint.cov[:3, :3], error) < 16.0


@pytest.mark.parametrize("share", [0.005, 0.08])
def test_a_cut_marker_is_verified_where_it_is_expected(share: float) -> None:
    pose = cut(share, 2)
    image = render(*pose, noise=2.0)
    near: dict[MarkerName, Array] = {"large": corners("large", pose) + 2.0}
    seen = followed(image, near)
    assert np.abs(seen["large"].corners_px - corners("large", pose)).max() < 0.3
    other = render(*pose, markers=(("DICT_4X4_1000", 16, 0.150), "small"))
    assert "large" not in followed(other, near)


def test_a_marker_that_leaves_the_picture_is_followed_out_of_it() -> None:
    poses = [pose_of(-x, 0.03, 0.4, 0.3) for x in np.linspace(0.24, 0.3, 7)]
    assert beyond(poses[0]) < 0.0 < beyond(poses[-1]) < 0.15
    before: Detections | None = None
    for k, pose in enumerate(poses):
        before = detect_markers(frame(render(*pose, noise=2.0), k), before, SETUP, CAMERA)
        assert before.large is not None
        assert np.abs(before.large.corners_px - corners("large", pose)).max() < 0.3


@pytest.mark.parametrize("radius", [0.12, 0.2, 0.3])
@pytest.mark.parametrize("corner", range(4))
def test_a_highlight_on_a_corner_leaves_three_sides(radius: float, corner: int) -> None:
    pose = pose_of(0.03, -0.02, 0.35, 0.7 + corner, 0.05, -0.08)
    true = corners("large", pose)
    side = float(np.linalg.norm(true[0] - true[1]))
    centre = true[corner] + 0.1 * (true.mean(axis=0) - true[corner])
    image = glaring(render(*pose, noise=2.0), centre, radius * side)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    assert found.large is not None
    assert np.abs(found.large.corners_px - true).max() < 0.3
    if found.large.cov_px2 is not None:
        assert np.abs(sigmas(found, pose)).max() < 4.0
    again = detect_markers(frame(image, 1), found, SETUP, CAMERA)
    assert again.large is not None
    assert np.abs(again.large.corners_px - true).max() < 0.3


def test_the_way_of_the_last_round_is_not_taken_for_spread() -> None:
    """From wherever the fit starts, it claims the same."""
    image, true = render(*POSE, noise=2.0), corners("large")
    spreads = []
    for off_px in (0.0, 0.5, 1.5, 3.0):
        found = fit_partly(image, true + off_px, LARGE, CAMERA)
        assert found is not None
        spreads.append(found.sigma_px)
    assert max(spreads) < 1.03 * min(spreads)


def test_what_is_hidden_is_no_edge() -> None:
    """A bar along a whole side: without that side, the inner edge of its border is left."""
    image, true = render(*POSE, noise=2.0), corners("large")
    ends = [tuple(int(v) for v in np.rint(p)) for p in true[:2] + 2.0]
    cv2.line(image, ends[0], ends[1], 90, 9)
    covered = np.zeros_like(image)
    cv2.line(covered, ends[0], ends[1], 1, 13)
    for off_px in (0.0, 3.0):
        found = seen_partly(image, true + off_px, LARGE, CAMERA, "bits", covered > 0)
        assert found is not None
        assert np.abs(found.corners_px - true).max() < 0.2


@pytest.mark.parametrize("light_grey", [200.0, 800.0])
def test_light_over_most_of_two_sides_moves_no_corner(light_grey: float) -> None:
    image, true = render(*POSE, noise=2.0), corners("large")
    side = float(np.linalg.norm(true[0] - true[1]))
    bright = glaring(image, true[2] + 0.05 * (true[0] - true[2]), 0.55 * side, light_grey)
    found = fit_partly(bright, true + 1.0, LARGE, CAMERA)
    assert found is not None
    assert np.abs(found.corners_px - true).max() < 0.3


def test_a_cell_in_glaring_light_is_unknown_and_not_wrong() -> None:
    image, true = render(*POSE, noise=2.0), corners("large")
    black = np.flatnonzero(LARGE.inner & ~LARGE.white)[0]
    spots = mapped(from_unit(true), LARGE.spots[LARGE.owner == black])
    side = float(np.linalg.norm(true[0] - true[1]))
    bright = glaring(image, spots.mean(axis=0), side / 9.0)
    found = seen_partly(bright, true, LARGE, CAMERA, "track")
    assert found is not None
    assert np.abs(found.corners_px - true).max() < 0.1
    grey = np.where(bright > image + 20, 200, image).astype(np.uint8)  # white paper instead
    assert seen_partly(grey, true, LARGE, CAMERA, "track") is None


def test_other_cells_are_not_the_marker_whatever_else_is_hidden() -> None:
    pose = pose_of(0.02, 0.01, 0.4, 0.3)
    image = render(*pose, markers=(("DICT_4X4_1000", 16, 0.150),))
    ways: tuple[KnownBy, ...] = ("bits", "track", "other")
    for known_by in ways:
        assert seen_partly(image, corners("large", pose), LARGE, CAMERA, known_by) is None
    turned = np.roll(corners("large", pose), 1, axis=0)
    right = render(*pose)
    assert seen_partly(right, turned, LARGE, CAMERA, "other") is None
    assert seen_partly(right, corners("large", pose), LARGE, CAMERA, "bits") is not None


def test_a_code_that_may_be_another_one_is_not_told_by_its_bits_alone() -> None:
    """Two bits hidden: other codewords differ in no more."""
    pose = pose_of(0.0, 0.0, 0.4)
    image, true = render(*pose), corners("large", pose)
    covered = np.zeros((H, W), np.bool_)
    cell = float(np.linalg.norm(true[1] - true[0])) / 6.0
    x, y = true[0] + 1.05 * cell
    covered[round(y) : round(y + 0.9 * cell), round(x) : round(x + 1.9 * cell)] = True
    assert seen_partly(image, true, LARGE, CAMERA, "bits", covered) is None
    assert seen_partly(image, true, LARGE, CAMERA, "track", covered) is not None


@pytest.mark.parametrize("grey", [0, 128, 255])
def test_nothing_is_fitted_to_no_contrast(grey: int) -> None:
    flat = np.full((H, W), grey, np.uint8)
    assert fit_partly(flat, corners("large"), LARGE, CAMERA) is None
    assert fit_partly(flat, np.full((4, 2), np.nan), LARGE, CAMERA) is None
    assert fit_partly(flat, corners("large") + 5000.0, LARGE, CAMERA) is None


@pytest.mark.parametrize("z_m", [0.11, 0.12, 0.13])
def test_a_marker_that_fills_the_picture_is_known_by_its_cells_as_the_lens_bends_them(
    z_m: float,
) -> None:
    # The vehicle's last centimetres: the large marker's corners are beyond the picture, and its
    # middle is 20 px from where a square with these corners would have it.
    for x_m, y_m in ((-0.022, 0.0), (-0.02, 0.012), (0.025, -0.01)):
        pose = pose_of(x_m, y_m, z_m, 0.05)
        true = corners("large", pose)
        found = seen_partly(render(*pose, noise=2.0), true + 3.0, LARGE, CAMERA, "track")
        assert found is not None
        assert np.abs(found.corners_px - true).max() < 0.5


@pytest.mark.long
@pytest.mark.parametrize("known_by", ["track", "bits", "other"])
def test_where_cells_cannot_be_enough_no_fit_is_tried(known_by: KnownBy) -> None:
    # Of what a fit from 10 px beside would have taken, nothing is turned down beforehand.
    tried = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        pose = pose_of(*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.1, 0.3), rng.uniform(-3, 3))
        start = corners("large", pose) + rng.uniform(-10.0, 10.0, 2)
        agree = visible_cells_agree(
            render(*pose), corners("large", pose), LARGE, CAMERA, None, known_by
        )
        may = may_show_enough(start, (H, W), LARGE, CAMERA, known_by, 20.0)
        assert may or not agree
        tried.append(may)
    assert 0 < sum(tried) < len(tried)
