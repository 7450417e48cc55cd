"""A marker's square by the edges of its drawing: whole, or what is seen of it, with known truth."""

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
from perchctl.vision import Detections, Frame, MarkerName, PipelineState, step
from perchctl.vision.markers.cells import KnownBy
from perchctl.vision.markers.corners import RefinedCorners, from_unit, mapped, refine_each
from perchctl.vision.markers.detect import detect_markers, seen_partly
from perchctl.vision.markers.detector import make_aruco_detector
from perchctl.vision.markers.edge_fit import refine_by_edges
from perchctl.vision.markers.search import search
from tests.helpers.markers import POSE, SETUP, corners, followed, frame
from tests.helpers.target_picture import CAMERA, pose_of, render

Grey = NDArray[np.uint8]
W, H = CAMERA.size_px
LARGE = SETUP.patterns["large"]
POSES = [
    (0.0, 0.0, 0.24, 0.0, 0.0, 0.0),
    (0.02, -0.01, 0.24, 0.5, 0.05, -0.08),
    (-0.03, 0.02, 0.30, 2.9, 0.1, 0.1),
    (0.05, 0.04, 0.45, -1.2, -0.15, 0.05),
    (0.10, -0.05, 0.60, 1.0, 0.0, 0.2),
]


def outwards(quad: Array) -> Array:
    way = quad - quad.mean(axis=0)
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))


def fitted(image: Grey, start: Array, name: MarkerName = "large") -> RefinedCorners:
    found = refine_by_edges(image, start, SETUP.patterns[name], CAMERA)
    assert found is not None
    return found


def errors(
    noise: float, blur_px: float, name: MarkerName = "large", poses: list[tuple[float, ...]] = POSES
) -> Array:
    """(radial bias, error) of each corner over the poses, from starts 0.5 px inwards."""
    rows = []
    for index, values in enumerate(poses):
        pose = pose_of(*values)
        true = corners(name, pose)
        out = outwards(true)
        start = true - 0.5 * out + np.random.default_rng(index).normal(0.0, 0.3, (4, 2))
        found = fitted(render(*pose, noise=noise, blur_px=blur_px, seed=index), start, name)
        error = found.corners_px - true
        rows.append(np.column_stack([(error * out).sum(axis=1), error]))
    return np.concatenate(rows)


# --- A whole marker ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["large", "small"])
@pytest.mark.parametrize("blur_px", [0.6, 1.2])
def test_corners_are_found_without_bias(name: MarkerName, blur_px: float) -> None:
    # Beyond 30 cm the small marker's cells are 4 px and less.
    found = errors(0.0, blur_px, name, POSES if name == "large" else POSES[:3])
    assert abs(found[:, 0].mean()) < 0.02
    assert np.sqrt((found[:, 1:] ** 2).mean()) < 0.03


def test_corners_are_calm_in_noise() -> None:
    found = errors(10.0, 0.7)
    assert abs(found[:, 0].mean()) < 0.03
    assert np.sqrt((found[:, 1:] ** 2).mean()) < 0.08


def test_edges_beat_each_corner_s_neighbourhood_tenfold_in_bias() -> None:
    def bias(values: tuple[float, ...]) -> float:
        true = corners("large", pose_of(*values))
        image = render(*pose_of(*values), blur_px=0.7)
        found = refine_each(image, true - 0.5 * outwards(true), LARGE.cells)
        return float(((found.corners_px - true) * outwards(true)).sum(axis=1).mean())

    each = abs(np.mean([bias(values) for values in POSES]))
    assert each > 0.05
    assert abs(errors(0.0, 0.7)[:, 0].mean()) < each / 10.0


@pytest.mark.parametrize("off_px", [2.0, 4.0, 6.0])
def test_an_edge_far_from_where_it_is_expected_is_where_it_is(off_px: float) -> None:
    """As where a vehicle in motion has its target expected, in the last decimetres."""
    measured = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        pose = pose_of(*rng.uniform(-0.01, 0.01, 2), 0.18, rng.uniform(-3.1, 3.1))
        true, turn = corners("large", pose), rng.uniform(-np.pi, np.pi)
        start = true + off_px * np.array([np.cos(turn), np.sin(turn)])
        image = render(*pose, noise=3.0, blur_px=0.8, seed=seed)
        found = refine_by_edges(image, start, LARGE, CAMERA)
        if found is not None:
            measured += 1
            assert np.abs(found.corners_px - true).max() < 0.1
    assert measured >= 6


@pytest.mark.parametrize("partly", [False, True])
def test_from_wherever_the_fit_starts_it_finds_and_claims_the_same(partly: bool) -> None:
    image, true = render(*POSE, noise=2.0), corners("large")
    found = [
        refine_by_edges(image, true + off_px, LARGE, CAMERA, partly=partly)
        for off_px in (0.0, 0.5, 1.5, 3.0)
    ]
    seen = [each for each in found if each is not None]
    assert len(seen) == 4
    spreads = [each.sigma_px for each in seen]
    assert max(spreads) < 1.05 * min(spreads)
    assert max(np.abs(each.corners_px - seen[0].corners_px).max() for each in seen) < 0.02


def test_sigma_follows_the_noise() -> None:
    true = corners("large", pose_of(*POSES[1]))
    clean, noisy, noisier = (
        fitted(render(*pose_of(*POSES[1]), noise=noise), true).sigma_px for noise in (0, 8, 20)
    )
    assert clean < 0.03
    assert clean < noisy < noisier < 0.4


@pytest.mark.parametrize("blur_px", [0.7, 1.2, 2.0])
def test_the_blur_is_measured(blur_px: float) -> None:
    """`render` has a softness of tanh, which falls off as a Gaussian of about that width does."""
    found = fitted(
        render(*pose_of(*POSES[0]), blur_px=blur_px), corners("large", pose_of(*POSES[0]))
    )
    assert found.blur_px is not None
    assert found.blur_px == pytest.approx((blur_px, blur_px), rel=0.25)


@pytest.mark.parametrize("light", ["gamma", "clipped"])
def test_a_shift_that_all_edges_share_is_taken_out(light: str) -> None:
    """White that grows over black moves the edges of black and of white cells opposite ways."""
    biases = []
    for values in POSES:
        image, true = render(*pose_of(*values), blur_px=0.9), corners("large", pose_of(*values))
        if light == "gamma":
            bright = np.rint(255.0 * (image / 255.0) ** 0.5).astype(np.uint8)
        else:
            bright = np.clip(image * 1.7, 0, 255).astype(np.uint8)
        found = fitted(bright, true)
        biases.append(((found.corners_px - true) * outwards(true)).sum(axis=1).mean())
        assert abs(biases[-1]) < 4.0 * found.sigma_px
    assert abs(np.mean(biases)) < 0.03


def test_an_occluded_part_of_a_side_is_left_out() -> None:
    image, true = render(*pose_of(*POSES[3])), corners("large", pose_of(*POSES[3]))
    x, y = (0.7 * true[0] + 0.3 * true[1]).astype(int)
    image[y - 5 : y + 6, x - 9 : x + 10] = 220
    assert np.abs(fitted(image, true + 0.4).corners_px - true).max() < 0.1


@pytest.mark.parametrize("partly", [False, True])
@pytest.mark.parametrize("kind", ["noise", "black", "grey", "white", "blur"])
def test_nothing_is_fitted_to_what_is_no_marker(kind: str, partly: bool) -> None:
    true = corners("large")
    image = np.full((H, W), {"black": 0, "white": 255}.get(kind, 128), np.uint8)
    if kind == "noise":
        image = np.random.default_rng(0).integers(0, 255, (H, W)).astype(np.uint8)
    elif kind == "blur":
        image = np.asarray(cv2.GaussianBlur(render(*POSE), (0, 0), 30.0), np.uint8)
    for start in (true, np.full((4, 2), np.nan), true + 5000.0, 1e8 * (true - true.mean(axis=0))):
        assert refine_by_edges(image, start, LARGE, CAMERA, partly=partly) is None


# --- A marker of which a part is not seen ------------------------------------------------------


def beyond(pose: tuple[Array, Array]) -> float:
    """How far the large marker reaches beyond the picture, in terms of its side."""
    c = corners("large", pose)
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
    assert found.large is not None
    assert found.large.cov_px2 is not None
    error = (found.large.corners_px - corners("large", pose)).ravel()
    values, axes = np.linalg.eigh(found.large.cov_px2)
    return np.asarray(axes.T @ error / np.sqrt(values))


@pytest.mark.parametrize("share", [0.01, 0.04, 0.1])
def test_a_marker_that_the_picture_cuts_is_measured_by_what_is_left_of_it(share: float) -> None:
    squares = []
    for seed in range(4):
        pose = cut(share, seed)
        found = detect_markers(frame(render(*pose, noise=2.0, seed=seed)), None, SETUP, CAMERA)
        squares.append(sigmas(found, pose))
        assert found.large is not None
        assert not found.large.whole
        # A pixel of a corner beyond the picture may be a millimetre of the target.
        assert np.abs(found.large.corners_px - corners("large", pose)).max() < 0.3
        spread = np.sqrt(np.diagonal(found.large.cov_px2).reshape(4, 2).sum(axis=1))
        assert share < 0.1 or spread.max() > 1.1 * np.median(spread)
    assert np.abs(squares).max() < 4.0
    assert np.mean(np.square(squares)) < 2.0


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
    """Blur needs what is beyond the edge."""
    pose = cut(share, 1, yaw=0.0)
    true, image = corners("large", pose), render(*pose, blur_px=2.0)
    first = detect_markers(frame(image), None, SETUP, CAMERA)
    for found in (first, detect_markers(frame(image, 1), first, SETUP, CAMERA)):
        assert found.large is not None
        assert np.abs(found.large.corners_px - true).max() < 0.03


def test_what_the_edge_cut_off_is_not_taken_unless_its_cells_are_seen() -> None:
    """Both markers decoded, but the large one does not look as it should."""
    image = render(*cut(0.03, 0), noise=2.0)
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
    near: dict[MarkerName, Array] = {"large": corners("large", pose) + 2.0}
    seen = followed(render(*pose, noise=2.0), near)
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
    centre = true[corner] + 0.1 * (true.mean(axis=0) - true[corner])
    side = float(np.linalg.norm(true[0] - true[1]))
    image = glaring(render(*pose, noise=2.0), centre, radius * side)
    found = detect_markers(frame(image), None, SETUP, CAMERA)
    again = detect_markers(frame(image, 1), found, SETUP, CAMERA)
    for each in (found, again):
        assert each.large is not None
        assert np.abs(each.large.corners_px - true).max() < 0.3
    assert np.abs(sigmas(found, pose)).max() < 4.0


def test_what_is_hidden_is_no_edge() -> None:
    """A bar along a whole side: without that side, the inner edges are left."""
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
    found = refine_by_edges(bright, true + 1.0, LARGE, CAMERA, partly=True)
    assert found is None or np.abs(found.corners_px - true).max() < 0.3


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
    ways: tuple[KnownBy, ...] = ("all", "bits", "track", "other")
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
