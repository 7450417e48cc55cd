"""Edges, lines and corners with a known place, and the cells that verify them."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.geometry import Array
from perchctl.vision import MARKERS, project, square_corners
from perchctl.vision.markers.corners import (
    RAW_SIGMA_PX,
    SUBPIX_SIGMA_PX,
    UNIT,
    completed,
    from_unit,
    mapped,
    nested,
    to_unit,
)
from perchctl.vision.markers.edge_fit import (
    ALONG,
    PROFILES,
    STEPS,
    Edges,
    Surroundings,
    locate,
    refine,
)
from perchctl.vision.markers.pattern import (
    cells_agree,
    cells_mostly_agree,
    resemblance,
    rim_of_bits,
)
from tests.helpers.markers import POSE, SETUP, box, corners
from tests.helpers.target_picture import CAMERA, bits_of, pose_of, render

HALF_PX, NEAR_PX, DEPTH_PX = 7.0, 7.0, 12.0
OFFSETS: Array = HALF_PX * np.linspace(-1.0, 1.0, STEPS + 1)


def soft_step(x: Array, blur_px: float) -> Array:
    return 0.5 * (1.0 + np.vectorize(math.erf)(x / (math.sqrt(2.0) * blur_px)))


def located(
    place_px: Array,
    blur_px: float,
    *,
    far_side: bool = False,
    noise: float = 0.0,
    shown: slice = slice(None),
) -> Edges:
    """One row of profiles (n,) with the edge at `place_px`; with `far_side`, white ends
    a cell further out. Others than those `shown` count for nothing."""
    x = OFFSETS - place_px[:, None]
    white = soft_step(x, blur_px)
    if far_side:
        white -= soft_step(x - DEPTH_PX, blur_px)
    grey = 30.0 + 170.0 * white
    grey += np.random.default_rng(0).normal(0.0, 1.0, grey.shape) * noise
    none = np.zeros((1, PROFILES))
    possible = np.zeros((1, PROFILES), dtype=np.bool_)
    possible[0, shown] = True
    around = Surroundings(
        depth_px=np.array([DEPTH_PX]),
        inside=none,
        outside=none + 1.0 if far_side else none,
        possible=possible,
    )
    return locate(grey[None].astype(np.float32), np.array([HALF_PX]), np.array([NEAR_PX]), around)


@pytest.mark.parametrize("blur_px", [0.8, 1.2, 2.0])
@pytest.mark.parametrize("place_px", [-1.3, 0.0, 0.4])
def test_a_lone_edge_is_found_with_its_blur(place_px: float, blur_px: float) -> None:
    edges = located(place_px + 0.5 * ALONG, blur_px)
    assert np.abs(edges.offset_px[0] - place_px - 0.5 * ALONG).max() < 0.02
    assert (edges.weight > 0.5).all()
    assert edges.blur_px[0] == pytest.approx(blur_px, rel=0.2)


def test_a_neighbouring_edge_does_not_push_it_away() -> None:
    edges = located(np.zeros(PROFILES), 2.0, far_side=True)
    assert np.abs(edges.offset_px).max() < 0.03


def test_profiles_with_an_edge_elsewhere_are_outliers() -> None:
    place = np.zeros(PROFILES)
    place[5:9] = 3.0
    edges = located(place, 1.0)
    assert (edges.weight[0, 5:9] == 0.0).all()
    assert (np.delete(edges.weight[0], range(5, 9)) > 0.5).all()


@given(
    shown=st.integers(3, PROFILES).flatmap(
        lambda n: st.integers(0, PROFILES - n).map(lambda first: slice(first, first + n))
    ),
    place_px=st.floats(-4.0, 4.0),
    slope_px=st.floats(-0.5, 0.5),
    blur_px=st.floats(0.7, 1.5),
)
def test_a_side_of_which_little_is_shown_is_found_all_the_same(
    shown: slice, place_px: float, slope_px: float, blur_px: float
) -> None:
    """Of a marker that the picture cuts off: wherever the rest of the side would be."""
    place = place_px + slope_px * ALONG
    edges = located(place, blur_px, noise=4.0, shown=shown)
    weight = edges.weight[0]
    assert weight.sum() > 1.0
    assert abs(float((weight * (edges.offset_px[0] - place)).sum() / weight.sum())) < 0.2


# --- Corners by lines --------------------------------------------------------------------------


RIMS = {6: bits_of("DICT_4X4_1000", 997), 7: bits_of("DICT_ARUCO_ORIGINAL", 5)}
RIMS = {cells: rim_of_bits(bits) for cells, bits in RIMS.items()}
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


def errors(noise: float, blur_px: float, method: str, cells: int, side_m: float) -> Array:
    """(radial bias, error) of each corner over all poses, raw corners 0.5 px inwards."""
    rows = []
    for index, values in enumerate(POSES):
        rvec, tvec = pose_of(*values)
        image = render(rvec, tvec, noise=noise, blur_px=blur_px, seed=index)
        true = true_corners(rvec, tvec, side_m)
        raw = inwards(true, 0.5) + np.random.default_rng(index).normal(0.0, 0.3, (4, 2))
        result = refine(image, raw[None], [RIMS[cells]], CAMERA, method)[0]
        assert result.refined == (method == "line")
        out = true - true.mean(axis=0)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        error = result.corners_px - true
        rows += [[(error[i] * out[i]).sum(), *error[i]] for i in range(4)]
    return np.array(rows)


@pytest.mark.parametrize(("cells", "side_m"), [(6, 0.150), (7, 0.025)])
@pytest.mark.parametrize("blur_px", [0.6, 1.2])
def test_lines_find_corners_without_bias(cells: int, side_m: float, blur_px: float) -> None:
    poses = errors(0.0, blur_px, "line", cells, side_m)
    poses = poses if side_m > 0.1 else poses[:12]  # beyond 30 cm its cells are 4 px and less
    assert abs(poses[:, 0].mean()) < 0.02
    assert np.sqrt((poses[:, 1:] ** 2).mean()) < 0.03


def test_lines_are_calm_in_noise() -> None:
    poses = errors(10.0, 0.7, "line", 6, 0.150)
    assert abs(poses[:, 0].mean()) < 0.03
    assert np.sqrt((poses[:, 1:] ** 2).mean()) < 0.08


@pytest.mark.parametrize("off_px", [4.0, 6.0, 6.5])
def test_sides_near_the_ends_of_their_profiles_are_where_they_are(off_px: float) -> None:
    """As where a vehicle in motion has its target expected, in the last decimetres."""
    fitted = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        rvec, tvec = pose_of(*rng.uniform(-0.01, 0.01, 2), 0.18, rng.uniform(-3.1, 3.1))
        image = render(rvec, tvec, noise=3.0, blur_px=0.8, seed=seed)
        true = true_corners(rvec, tvec, 0.150)
        turn = rng.uniform(-np.pi, np.pi)
        raw = true + off_px * np.array([np.cos(turn), np.sin(turn)])
        result = refine(image, raw[None], [RIMS[6]], CAMERA, "line")[0]
        if result.refined:
            fitted += 1
            assert np.abs(result.corners_px - true).max() < 0.1
    assert fitted >= 6


def test_lines_beat_subpix_tenfold_in_bias() -> None:
    subpix = abs(errors(0.0, 0.7, "subpix", 6, 0.150)[:, 0].mean())
    line = abs(errors(0.0, 0.7, "line", 6, 0.150)[:, 0].mean())
    assert subpix > 0.05
    assert line < subpix / 10.0


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
    found = refine(curled, np.stack([large, small]), [RIMS[6], RIMS[7]], CAMERA, "line")[1]
    out = (small - centre) / np.linalg.norm(small - centre, axis=1, keepdims=True)
    assert found.refined
    assert abs(float(((found.corners_px - small) * out).sum(axis=1).mean())) < 0.08


def spoilt(image: Array, light: str) -> Array:
    if light == "gamma":
        return np.rint(255.0 * (image / 255.0) ** 0.5).astype(np.uint8)
    return np.clip(image * 1.7, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("light", ["gamma", "clipped"])
def test_a_shift_that_all_edges_share_is_taken_out(light: str) -> None:
    """White that grows over black: the border's width shows by how much."""
    biases, raw_biases = [], []
    closed = {n: replace(rim, open=np.zeros_like(rim.open)) for n, rim in RIMS.items()}
    for values in POSES:
        rvec, tvec = pose_of(*values)
        image = spoilt(render(rvec, tvec, blur_px=0.9), light)
        true = true_corners(rvec, tvec, 0.150)
        out = true - true.mean(axis=0)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        for rims, rows in ((RIMS, biases), (closed, raw_biases)):
            result = refine(image, true[None], [rims[6]], CAMERA, "line")[0]
            assert result.refined
            rows.append(((result.corners_px - true) * out).sum(axis=1).mean())
            assert abs(rows[-1]) < 4.0 * np.hypot(result.shift_sigma_px, result.sigma_px)
    assert abs(np.mean(raw_biases)) > 0.12
    assert abs(np.mean(biases)) < 0.03


def test_an_occluded_part_of_a_side_is_left_out() -> None:
    rvec, tvec = pose_of(*POSES[3])
    image = render(rvec, tvec)
    true = true_corners(rvec, tvec, 0.150)
    spot = (0.7 * true[0] + 0.3 * true[1]).astype(int)
    image[spot[1] - 5 : spot[1] + 6, spot[0] - 9 : spot[0] + 10] = 220
    result = refine(image, true[None] + 0.4, [RIMS[6]], CAMERA, "line")[0]
    assert result.refined
    assert np.abs(result.corners_px - true).max() < 0.1


def test_what_is_no_square_or_flat_falls_back_to_the_raw_corners() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (480, 640)).astype(np.uint8)
    raw = np.array([[200.0, 200.0], [260.0, 205.0], [255.0, 262.0], [198.0, 258.0]])
    for image, most_px in ((noise, 6.5), (np.full_like(noise, 128), 1e-5)):
        result = refine(image, raw[None], [RIMS[6]], CAMERA, "line")[0]
        assert not result.refined
        assert np.linalg.norm(result.corners_px - raw, axis=1).max() < most_px
        assert result.sigma_px in (RAW_SIGMA_PX, SUBPIX_SIGMA_PX)


@pytest.mark.parametrize("blur_px", [3.0, 6.0, 12.0])
def test_in_strong_blur_the_result_is_never_worse_than_subpix(blur_px: float) -> None:
    rvec, tvec = pose_of(0.0, 0.0, 0.6, 0.3)
    image = render(rvec, tvec, blur_px=blur_px)
    true = true_corners(rvec, tvec, 0.150)

    def worst(method: str) -> float:
        result = refine(image, inwards(true, 1.0)[None], [RIMS[6]], CAMERA, method)[0]
        return float(np.abs(result.corners_px - true).max())

    assert worst("line") <= worst("subpix") + 1e-9


def test_none_leaves_the_corners_alone() -> None:
    rvec, tvec = pose_of(*POSES[0])
    raw = true_corners(rvec, tvec, 0.150)[None] + 0.3
    (result,) = refine(render(rvec, tvec), raw, [RIMS[6]], CAMERA, "none")
    assert np.array_equal(result.corners_px, raw[0])
    assert not result.refined
    assert refine(render(rvec, tvec), np.empty((0, 4, 2)), [], CAMERA, "line") == []


# --- A marker's square -------------------------------------------------------------------------


def test_one_marker_gives_the_place_of_the_other() -> None:
    assert np.abs(nested(corners("large"), 1 / 6, CAMERA) - corners("small")).max() < 0.01
    whole = completed({"small": corners("small")}, SETUP.ratio, CAMERA)
    assert np.abs(whole["large"] - corners("large")).max() < 0.01
    assert set(completed({"large": corners("large")}, SETUP.ratio, CAMERA)) == {"large", "small"}


quads = st.tuples(
    st.floats(100.0, 500.0), st.floats(100.0, 400.0), st.floats(20.0, 150.0), st.integers(0, 99)
).map(lambda v: box(*v[:3]) + np.random.default_rng(v[3]).uniform(-0.1, 0.1, (4, 2)) * v[2])


@given(quad=quads)
@settings(max_examples=40, deadline=None)
def test_both_homographies_of_the_unit_square_are_each_others_inverse(quad: Array) -> None:
    assert np.allclose(mapped(from_unit(quad), UNIT), quad, atol=1e-3)
    assert np.allclose(mapped(to_unit(quad), quad), UNIT, atol=1e-4)
    inside = np.random.default_rng(0).uniform(-1.0, 1.0, (5, 3, 2))
    there_and_back = mapped(to_unit(quad), mapped(from_unit(quad), inside))
    assert there_and_back.shape == inside.shape
    assert np.allclose(there_and_back, inside, atol=1e-4)


@given(quad=quads, ratio=st.floats(0.1, 1.0))
@settings(max_examples=40, deadline=None)
def test_a_square_in_a_square_has_the_inverse_ratio_around_it(quad: Array, ratio: float) -> None:
    for camera in (None, CAMERA):
        inner = nested(quad, ratio, camera)
        assert np.allclose(nested(inner, 1.0 / ratio, camera), quad, atol=0.05)


# --- Cells -------------------------------------------------------------------------------------


def test_every_single_cell_counts() -> None:
    image = render(*POSE)
    pattern = SETUP.patterns["large"]
    assert cells_agree(image, corners("large"), pattern)
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
            assert not cells_agree(spoilt, corners("large"), pattern), (row, column)


def test_resemblance_gives_the_turn_of_a_marker() -> None:
    image = cv2.GaussianBlur(render(*POSE), (0, 0), 2.0)
    for name in MARKERS:
        for k in range(4):
            rolled = np.roll(corners(name), -k, axis=0)
            likeness = resemblance(np.asarray(image), rolled, SETUP.patterns[name])
            assert int(np.argmax(likeness)) == k
            assert likeness[k] > 0.8


def test_some_covered_cells_are_allowed_for_where_the_place_is_known() -> None:
    pattern, quad = SETUP.patterns["large"], corners("large")
    image = render(*POSE)
    x, y = np.rint(0.92 * quad[1] + 0.08 * quad[3]).astype(int)
    image[y - 14 : y + 15, x - 14 : x + 15] = 200
    assert not cells_agree(image, quad, pattern)
    assert cells_mostly_agree(image, quad, pattern)
    assert not cells_mostly_agree(image, quad + 30.0, pattern)


def test_cells_outside_of_the_picture_or_without_contrast_agree_with_nothing() -> None:
    pattern, image = SETUP.patterns["large"], render(*POSE)
    flat = np.full_like(image, 120)
    for picture, quad in ((image, corners("large") + 500.0), (flat, corners("large"))):
        assert not cells_agree(picture, quad, pattern)
        assert not cells_mostly_agree(picture, quad, pattern)
        assert np.array_equal(resemblance(picture, quad, pattern), np.zeros(4))
