"""The page of a calibration: whole, closed in itself, and drawn from what the views show."""

from __future__ import annotations

import dataclasses
import re

import cv2
import numpy as np
import pytest

from perchctl.calibration import FoundViews, calibrate_camera, calibration_report
from perchctl.calibration.board.detect import BoardView, FrameCounts, Rejection
from perchctl.calibration.board.report import CalibrationReport, round_down
from perchctl.calibration.board.solve import Calibration
from tests.helpers.boards import CHARUCO, corner_view, corner_views, draw_camera, draw_poses
from tests.helpers.report_page import Page

DATE = "2026-11-30T10:20:30+00:00"


def drawn_views(views: int = 20) -> list[BoardView]:
    rng = np.random.default_rng(5)
    return corner_views(rng, draw_camera(rng), views=views)


def calibrated(views: list[BoardView]) -> Calibration:
    return calibrate_camera(FoundViews(tuple(views)), CHARUCO.notation())


def reported(views: list[BoardView]) -> CalibrationReport:
    return CalibrationReport(calibrated(views), "camera.yaml", DATE)


@pytest.fixture(scope="module")
def good() -> Calibration:
    return calibrated(drawn_views())


def test_a_page_says_the_verdict_in_millimetres(good: Calibration) -> None:
    page = Page(calibration_report(good, "camera.yaml", DATE))
    assert '<h2 class="good">GOOD TO FLY</h2>' in calibration_report(good, "camera.yaml", DATE)
    assert "GOOD TO FLY The target's centre is accurate to" in page.words
    far = next(e for e in good.errors if e.z_m == 1.0)
    assert f"{far.axis_mm95:.2g} mm at 1 m (95 %). camera.yaml" in page.words
    assert f"1 m {far.axis_mm95:.2f} mm 10.0 mm {far.mm95:.2f} mm" in page.words
    assert "2026-11-30 10:20 UTC" in page.words
    assert "What to improve Nothing." in page.words
    assert "Rejected views None: every view was used." in page.words


def test_rejected_views_are_named_with_the_reason() -> None:
    views = drawn_views()
    noise = np.random.default_rng(1).normal(0, 5, views[3].corners_px.shape)
    views[3] = dataclasses.replace(views[3], corners_px=views[3].corners_px + noise)
    outlier = views[5].corners_px.copy()
    outlier[2] += 9.0
    views[5] = dataclasses.replace(views[5], corners_px=outlier)
    frames = FrameCounts(live=True, still_px=1.5, taken=20, moved=4, without_board=6)
    without_board = (Rejection("<script>.png", "no board found"),)
    found = FoundViews(tuple(views), without_board, frames)
    result = calibrate_camera(found, CHARUCO.notation())
    words = Page(calibration_report(result, "camera.yaml", DATE)).words
    assert re.search(r"view 3: RMS error \d\.\d\d px, but the median is", words)
    assert "<script>.png: no board found" in words
    assert "24 of 30 frames show the board: 20 taken, 4 moved by more than 1.5 px" in words
    assert "Some views do not fit the others: take them again" in words
    assert re.search(rf"view 5 \d\.\d+ px {len(views[5]) - 1} 1 ", words)


def test_residuals_are_drawn_enlarged_by_the_factor_that_is_given(good: Calibration) -> None:
    html = calibration_report(good, "camera.yaml", DATE)
    (factor,) = map(float, re.findall(r"detected corner,\s+(\d+)\s+times", html))
    (key,) = map(float, re.findall(r"= ([\d.]+) px</text>", html))
    (key_length,) = map(float, re.findall(r'class="key" d="M4 15h([\d.]+)"', html))
    assert key_length == pytest.approx(key * factor, abs=0.06)
    paths = re.findall(r'class="residual" d="([^"]*)"><title>([^<]*)</title>', html)
    by_name = {name: path for path, name in paths}
    for view, residuals in zip(good.views, good.fit.residuals, strict=True):
        numbers = re.findall(r"M(\S+) (\S+)l(\S+) (\S+?)(?=M|$)", by_name[view.name])
        lines = np.array(numbers, dtype=float)  # the picture is 640 px wide, as the drawing
        np.testing.assert_allclose(lines[:, 2:], factor * residuals, atol=0.051)
        np.testing.assert_allclose(lines[:, :2], view.corners_px - residuals + 0.5, atol=0.051)


def test_what_no_board_covered_is_marked() -> None:
    cut = [view.select(view.corners_px[:, 0] < 390) for view in drawn_views()]
    report = reported([view for view in cut if len(view) >= 8])
    boxes = np.array(report.uncovered_boxes_px)
    left, top, width, height = boxes.T
    share = (width * height).sum() / (640 * 480)
    assert share == pytest.approx(1.0 - report.result.covered_cells.mean())
    assert ((left >= 0) & (left + width <= 640) & (top >= 0) & (top + height <= 480)).all()
    assert np.isclose(left + width, 640).sum() == 24  # each row of the grid ends uncovered
    assert any("% of the image is uncovered" in sentence for sentence in report.advice)
    html = calibration_report(report.result, "camera.yaml", DATE)
    assert html.count('class="empty"') == len(boxes)


def test_distance_and_tilt_are_those_of_the_boards() -> None:
    rng = np.random.default_rng(5)
    camera = draw_camera(rng)
    poses = draw_poses(rng, camera, CHARUCO, 20)
    views = [corner_view(rng, camera, CHARUCO, p, 0.02, str(i)) for i, p in enumerate(poses)]
    report = reported(views)
    for shown in report.views:
        view, pose = views[int(shown.name)], poses[int(shown.name)]
        R = cv2.Rodrigues(pose[:3])[0]
        corners = view.corners_m @ R.T + pose[3:]
        assert shown.distance_m == pytest.approx(np.linalg.norm(corners.mean(axis=0)), rel=0.01)
        assert shown.tilt_deg == pytest.approx(np.degrees(np.arccos(abs(R[2, 2]))), abs=0.5)
        toward = -R[:, 2] * np.sign(R[2, 2])
        np.testing.assert_allclose(shown.facing, toward[:2] / np.hypot(*toward[:2]), atol=0.05)
    assert [v.rms_px for v in report.views] == sorted([v.rms_px for v in report.views])[::-1]
    assert report.distance_ticks_m[-1] >= max(v.distance_m for v in report.views)


def test_a_board_whose_right_side_is_nearer_faces_left() -> None:
    rng = np.random.default_rng(5)
    camera, views = draw_camera(rng), drawn_views()
    pose = np.array([0.0, 0.5, 0.0, -0.1, -0.08, 0.5])
    assert (cv2.Rodrigues(pose[:3])[0] @ [1.0, 0.0, 0.0])[2] < 0  # its right side is nearer
    views.append(corner_view(rng, camera, CHARUCO, pose, 0.02, "turned"))
    (shown,) = [v for v in reported(views).views if v.name == "turned"]
    np.testing.assert_allclose(shown.facing, [-1.0, 0.0], atol=0.05)


def test_few_and_equal_views_are_told_what_is_missing() -> None:
    rng = np.random.default_rng(2)
    camera, middle = draw_camera(rng), CHARUCO.corners_m().mean(axis=0)
    views = []
    for i in range(8):
        about = 2 * np.pi * i / 8
        rvec = 0.5 * np.array([np.cos(about), np.sin(about), 0.0])
        t = np.array([0.0, 0.0, 0.25]) - cv2.Rodrigues(rvec)[0] @ middle
        pose = np.concatenate([rvec, t])
        views.append(corner_view(rng, camera, CHARUCO, pose, 0.6, f"view {i}"))
    report = reported(views)
    assert report.grade in ("warn", "bad")
    assert report.advice[0] == "Only 8 views: add 2 or more."
    said = " ".join(report.advice)
    for axis, what in (("position x", "move the board to the"), ("size", "move")):
        assert re.search(rf"The views reach \d+ % of the goal for {axis}: {what}", said)
    assert "goal for skew" not in said
    assert "The expected error exceeds its limit at some distances: add sharp views" in said
    html = calibration_report(report.result, "camera.yaml", DATE)
    assert Page(html).words.startswith("perchctl: camera.yaml")
    too_large = [e for e in report.result.errors if e.axis_mm95 > max(1.0, 10.0 * e.z_m)]
    assert len(re.findall(r'<td class="n bad">', html)) >= len(too_large) > 0


@pytest.mark.parametrize(
    ("value", "rounded"),
    [(1.0, 1.0), (1.99, 1.0), (2.0, 2.0), (4.9, 2.0), (5.0, 5.0), (99.0, 50.0), (0.03, 0.02)],
)
def test_a_scale_is_round(value: float, rounded: float) -> None:
    assert round_down(value) == rounded
