"""Edges, lines and corners with a known place, and the cells that verify them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from perchctl.geometry import Array
from perchctl.vision import project, square_corners
from perchctl.vision.markers.corners import (
    OPENCV_DETECTOR_CORNER_SIGMA_PX,
    SUBPIX_CORNER_SIGMA_PX,
    refine_subpix,
)
from perchctl.vision.markers.edge_fit import refine_corners_by_lines
from perchctl.vision.markers.pattern import has_matching_cells, make_cells_along_border
from tests.helpers.markers import POSE, SETUP, corners, waved
from tests.helpers.target_picture import CAMERA, bits_of, pose_of, render

# --- Corners by lines --------------------------------------------------------------------------


RIMS = {6: bits_of("DICT_4X4_1000", 997), 7: bits_of("DICT_ARUCO_ORIGINAL", 5)}
RIMS = {cells: make_cells_along_border(bits) for cells, bits in RIMS.items()}
POSES = [
    (0.0, 0.0, 0.24, 0.0, 0.0, 0.0),
    (0.02, -0.01, 0.24, 0.5, 0.05, -0.08),
    (-0.03, 0.02, 0.30, 2.9, 0.1, 0.1),
    (0.05, 0.04, 0.45, -1.2, -0.15, 0.05),
    (0.10, -0.05, 0.60, 1.0, 0.0, 0.2),
]


def true_corners(rvec: Array, tvec: Array, side_m: float) -> Array:
    return project(square_corners(side_m), rvec, tvec, CAMERA)


def inwards(corners: Array, amount: float) -> Array:
    centre = corners.mean(axis=0)
    out = corners - centre
    return corners - amount * out / np.linalg.norm(out, axis=1, keepdims=True)


def errors(noise: float, blur_px: float, cells: int, side_m: float) -> Array:
    """(radial bias, error) of each corner over all poses, raw corners 0.5 px inwards."""
    rows = []
    for index, values in enumerate(POSES):
        rvec, tvec = pose_of(*values)
        image = render(rvec, tvec, noise=noise, blur_px=blur_px, seed=index)
        true = true_corners(rvec, tvec, side_m)
        raw = inwards(true, 0.5) + np.random.default_rng(index).normal(0.0, 0.3, (4, 2))
        result = refine_corners_by_lines(image, raw[None], [RIMS[cells]], CAMERA)[0]
        assert result.are_corners_fitted
        out = true - true.mean(axis=0)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        error = result.corners_px - true
        rows += [[(error[i] * out[i]).sum(), *error[i]] for i in range(4)]
    return np.array(rows)


@pytest.mark.parametrize(("cells", "side_m"), [(6, 0.150), (7, 0.025)])
@pytest.mark.parametrize(
    ("noise", "blur_px"),
    [pytest.param(0.0, 0.6, marks=pytest.mark.long), (0.0, 1.2), (10.0, 0.7)],
)
def test_lines_find_corners_without_bias(
    cells: int, side_m: float, noise: float, blur_px: float
) -> None:
    poses = errors(noise, blur_px, cells, side_m)
    poses = poses if side_m > 0.1 else poses[:12]  # beyond 30 cm its cells are 4 px and less
    assert abs(poses[:, 0].mean()) < (0.03 if noise else 0.02)
    assert np.sqrt((poses[:, 1:] ** 2).mean()) < (0.08 if noise else 0.03)


@pytest.mark.parametrize(
    "off_px",
    [pytest.param(4.0, marks=pytest.mark.long), pytest.param(6.0, marks=pytest.mark.long), 6.5],
)
def test_sides_near_the_ends_of_their_profiles_are_where_they_are(off_px: float) -> None:
    """As where a vehicle in motion has its target expected, in the last decimetres."""
    fitted = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        rvec, tvec = pose_of(*rng.uniform(-0.01, 0.01, 2), 0.18, rng.uniform(-3.1, 3.1))
        image = render(rvec, tvec, noise=3.0, blur_px=0.8, seed=seed)
        true = true_corners(rvec, tvec, 0.150)
        turn = rng.uniform(-np.pi, np.pi)
        raw = true + off_px * np.array([np.cos(turn), np.sin(turn)])
        result = refine_corners_by_lines(image, raw[None], [RIMS[6]], CAMERA)[0]
        if result is not None:
            fitted += 1
            assert np.abs(result.corners_px - true).max() < 0.1
    assert fitted >= 3


@pytest.mark.parametrize("curl", [-0.02, 0.02])
def test_a_sheet_that_curls_shifts_no_edges(curl: float) -> None:
    """It narrows or widens the large marker's border as glare would. The small marker is hardly
    moved, and not by what that border shows."""
    rvec, tvec = pose_of(0.0, 0.0, 0.2, 0.0, 0.0, 0.0)
    image = render(rvec, tvec, blur_px=0.8)
    large, small = (true_corners(rvec, tvec, side_m) for side_m in (0.150, 0.025))
    centre = small.mean(axis=0)
    reach_px = float(np.linalg.norm(large - centre, axis=1).mean())
    way = np.stack(np.meshgrid(*(np.arange(n) for n in image.shape[::-1])), axis=2) - centre
    squared = (way**2).sum(axis=2, keepdims=True) / reach_px**2
    at = (centre + way * (1.0 - curl * squared)).astype(np.float32)
    curled = np.asarray(cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC), np.uint8)
    found = refine_corners_by_lines(curled, np.stack([large, small]), [RIMS[6], RIMS[7]], CAMERA)[1]
    out = (small - centre) / np.linalg.norm(small - centre, axis=1, keepdims=True)
    assert found.are_corners_fitted
    assert abs(float(((found.corners_px - small) * out).sum(axis=1).mean())) < 0.08


def spoilt(image: Array, light: str) -> Array:
    if light == "gamma":
        return np.rint(255.0 * (image / 255.0) ** 0.5).astype(np.uint8)
    return np.clip(image * 1.7, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("light", ["gamma", "clipped"])
def test_a_shift_that_all_edges_share_is_taken_out(light: str) -> None:
    """White that grows over black: the border's width shows by how much."""
    biases, raw_biases = [], []
    closed = {
        n: replace(
            r,
            are_two_cells_next_to_border_white=np.zeros_like(r.are_two_cells_next_to_border_white),
        )
        for n, r in RIMS.items()
    }
    for values in POSES:
        rvec, tvec = pose_of(*values)
        image = spoilt(render(rvec, tvec, blur_px=0.9), light)
        true = true_corners(rvec, tvec, 0.150)
        out = true - true.mean(axis=0)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        for rims, rows in ((RIMS, biases), (closed, raw_biases)):
            result = refine_corners_by_lines(image, true[None], [rims[6]], CAMERA)[0]
            assert result.are_corners_fitted
            rows.append(((result.corners_px - true) * out).sum(axis=1).mean())
            assert abs(rows[-1]) < 4.0 * np.hypot(
                result.remaining_edge_shift_sigma_px, result.sigma_px
            )
    assert abs(np.mean(raw_biases)) > 0.12
    assert abs(np.mean(biases)) < 0.03


def test_what_is_no_square_or_flat_has_no_lines_and_keeps_near_to_the_raw_corners() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    raw = np.array([[200.0, 200.0], [260.0, 205.0], [255.0, 262.0], [198.0, 258.0]])
    for image, most_px in ((noise, 6.5), (np.full_like(noise, 128), 1e-5)):
        assert refine_corners_by_lines(image, raw[None], [RIMS[6]], CAMERA) == [None]
        result = refine_subpix(image, raw, 6)
        assert not result.are_corners_fitted
        assert np.linalg.norm(result.corners_px - raw, axis=1).max() < most_px
        assert result.sigma_px in (OPENCV_DETECTOR_CORNER_SIGMA_PX, SUBPIX_CORNER_SIGMA_PX)
    waves = waved(render(*POSE, noise=2.0))
    assert refine_corners_by_lines(waves, corners("large")[None], [RIMS[6]], CAMERA) == [None]


# --- Cells -------------------------------------------------------------------------------------


def test_every_single_cell_counts() -> None:
    image = render(*POSE)
    pattern = SETUP.patterns["large"]
    assert has_matching_cells(image, corners("large"), pattern)
    H = cv2.getPerspectiveTransform(
        np.array([[0, 0], [6, 0], [6, 6], [0, 6]], dtype=np.float32),
        corners("large").astype(np.float32),
    )
    central = {(r, c) for r in (2, 3) for c in (2, 3)}
    for row in range(6):
        for column in range(6):
            if (row, column) in central:
                continue  # the small marker covers part of these
            spoilt = image.copy()
            cell = np.array([[column, row], [column + 1, row], [column + 1, row + 1],
                             [column, row + 1]], dtype=np.float64)  # fmt: skip
            quad = cv2.perspectiveTransform(cell[:, None], H)[:, 0]
            grey = int(image[tuple(np.rint(quad.mean(axis=0)[::-1]).astype(int))])
            cv2.fillConvexPoly(spoilt, np.rint(quad).astype(np.int32), 30 if grey > 120 else 205)
            assert not has_matching_cells(spoilt, corners("large"), pattern), (row, column)
