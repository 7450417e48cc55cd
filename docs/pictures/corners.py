"""The pictures of docs/corners.md: what each method does in a view that a test holds it to.

The views are rendered in closed form, so the true corners are known exactly
(`tests/helpers/corner_views.py`). Expected corners are orange and dashed, found ones blue, true
ones green crosses.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from PIL import Image

from perchctl.geometry import Array
from perchctl.plot import BLUE, GREEN, ORANGE, PURPLE, VERMILLION, figure_bytes, new_figure
from perchctl.vision.lens import distort_to_px, undistort_px
from perchctl.vision.markers.corners import (
    apply_homography,
    homography_from_centred_square,
    mean_side_px,
    refine_subpix,
)
from perchctl.vision.markers.cut import RigidPose, fit_pose, make_coarse_lattice, make_outline
from perchctl.vision.markers.edge_fit import measure_edges, prepare_marker_sides
from perchctl.vision.markers.partial import find_visible_edges
from perchctl.vision.markers.photometric_fit import (
    align_drawing,
    distort_px,
    make_sampling_grid,
    project_nodes,
    render_blurred,
)
from perchctl.vision.markers.search import (
    make_search_window,
    search_for_markers,
    search_half_size_image,
)
from tests.helpers.corner_views import VIEWS, View, findings
from tests.helpers.markers import SETUP
from tests.helpers.target_picture import CAMERA

_GREYS = 64
"""Of the palette, beside the colours of the lines: a picture has a third of the bytes."""
_ZOOM_PX, _NEARER_PX = 10.0, 3.0
"""Of a corner, to each side."""
_WHOLE = slice(0, CAMERA.size_px[1]), slice(0, CAMERA.size_px[0])
_LARGE = SETUP.patterns["large"]


def edge_fit(file: Path) -> None:
    """The profiles across the sides, the edges on them, and where the lines meet."""
    view = _view("Edge fit")
    figure, whole, near = _panels(view)
    markers = prepare_marker_sides(_expected(view)[None], [_LARGE.cells_along_border], CAMERA)
    assert markers is not None
    edges, _ = measure_edges(view.image, markers, CAMERA, must_measure_inner_edges=False)
    used = edges.edge_points_normalised[edges.edge_point_weight > 0.0]
    at = distort_to_px(used, CAMERA)
    _dots(whole, near, at, "edge on a profile")
    _finish(figure, file, whole, view)


def half_size_search(file: Path) -> None:
    """The window in the picture, and the same at half size."""
    view = _view("Half-size search")
    figure, whole, half = _panels(view, width_ratios=(2.0, 1.0))
    rows, columns = (
        make_search_window(
            view.prior.expected_corners_both_markers_px,
            SETUP.small_to_large_side_ratio,
            view.image.shape,
        )
        or _WHOLE
    )
    half.clear()
    reduced = cv2.resize(
        view.image[rows, columns], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA
    )
    half.imshow(reduced, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    half.set_title("searched at half size", fontsize=9)
    whole.set_xlim(-0.5, view.image.shape[1] - 0.5)
    whole.set_ylim(view.image.shape[0] - 0.5, -0.5)
    searched = search_half_size_image(view.picture, view.prior.expected_corners_both_markers_px)
    assert searched is not None
    for quad in searched.corners_px.values():
        own = 0.5 * (quad - (columns.start or 0, rows.start or 0)) - 0.25
        _square(half, own, VERMILLION, "decoded")
    _finish(figure, file, whole, view)


def partial_view_fit(file: Path) -> None:
    """The edges that are in view, and the square that follows from them."""
    view = _view("Partial-view fit")
    figure, whole, near = _panels(view)
    H = homography_from_centred_square(undistort_px(_found(view), CAMERA))
    seen = find_visible_edges(view.picture, H, _LARGE)
    assert seen is not None
    points = apply_homography(H, seen.measured_points_half_sides[seen.profile_weight > 0.0])
    at = distort_px(points.T, CAMERA).T
    _dots(whole, near, at, "edge in view")
    _finish(figure, file, whole, view)


def photometric_fit(file: Path) -> None:
    """A small marker, its drawing in the fitted light and blur, and what is left over."""
    _drawing(_view("Photometric fit"), file)


def cut_view_fit(file: Path) -> None:
    """The drawing's edges in view, and the corners outside of the picture."""
    view = _view("Cut-view fit")
    figure, whole, near = _panels(view)
    small = SETUP.patterns["small"]
    outline = make_outline(
        _LARGE.drawing,
        _LARGE.cells_along_border.printed_edge_position_sigma_cells,
        small.cells_along_border.printed_edge_position_sigma_cells,
    )
    R, t = cv2.Rodrigues(view.pose[0])[0], view.pose[1] / 0.075
    start = RigidPose(np.asarray(R) @ np.diag([1.0, -1.0, -1.0]), t)
    fit = fit_pose(view.image, start, outline, CAMERA)
    assert fit is not None
    X = (
        np.column_stack([outline.points_half_sides, np.zeros(len(outline.points_half_sides))])
        @ fit.pose.R_cam_drawing.T
        + fit.pose.t_cam_drawing_half_sides
    )
    x = X[:, :2] / X[:, 2:]
    at = distort_to_px(
        x[np.hypot(*x.T) < make_coarse_lattice(CAMERA).valid_lens_radius_normalised], CAMERA
    )
    _dots(whole, near, at[((at > 0.0) & (at < (639.0, 479.0))).all(axis=1)], "edge of the drawing")
    _finish(figure, file, whole, view)


def search_and_refinement(file: Path) -> None:
    """One corner as OpenCV finds it, refined by its neighbourhood, and by an edge fit."""
    view = _view("Search")
    figure, whole, near = _panels(view, zoom_px=_NEARER_PX)
    raw = search_for_markers(view.picture, {}).corners_px["large"]
    subpix = refine_subpix(view.image, raw, _LARGE.cells_along_border.cells_per_side).corners_px
    near.plot(*raw.T, "s", color=ORANGE, label="found by the search", zorder=5)
    near.plot(*subpix.T, "o", color=VERMILLION, label="subpixel refinement", zorder=5)
    _finish(figure, file, whole, view)


def blurred_search(file: Path) -> None:
    """A marker that cannot be decoded, its drawing in the fitted light and blur, and the rest."""
    _drawing(_view("Blurred search"), file)


# --- what they share --------------------------------------------------------------------


def _view(method: str) -> View:
    return next(view for view in VIEWS if view.method == method)


def _expected(view: View) -> Array:
    return view.prior.expected_corners_both_markers_px[view.marker]


def _found(view: View) -> Array:
    """The marker's corners after the view's method."""
    after = {method.name: found for method, found in findings(view)}
    return after[view.method].corners[view.marker].corners_px


def _dots(whole: Axes, near: Axes, at_px: Array, label: str) -> None:
    for ax, size in ((whole, 2.0), (near, 24.0)):
        ax.scatter(*at_px.T, s=size, color=PURPLE, label=label, linewidths=0.0, zorder=4)


def _panels(
    view: View, width_ratios: tuple[float, float] = (1.25, 1.0), zoom_px: float = _ZOOM_PX
) -> tuple[Figure, Axes, Axes]:
    """The marker in the picture, and one of its corners in view from near."""
    figure = new_figure(7.2, 3.4, dpi=100)
    whole, near = figure.subplots(1, 2, width_ratios=width_ratios)
    for ax in (whole, near):
        ax.imshow(view.image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    true, found = view.true_px, _found(view)
    height, width = view.image.shape
    inside = ((true > _ZOOM_PX) & (true < (width - _ZOOM_PX, height - _ZOOM_PX))).all(axis=1)
    x, y = np.rint(true[int(np.flatnonzero(inside)[0])])
    near.set_xlim(x - zoom_px, x + zoom_px)
    near.set_ylim(y + zoom_px, y - zoom_px)
    near.set_title(f"one corner, {2.0 * zoom_px:g} px wide", fontsize=9)
    room = 0.25 * mean_side_px(true)
    (left, top), (right, bottom) = true.min(axis=0) - room, true.max(axis=0) + room
    whole.set_xlim(left, right)
    whole.set_ylim(bottom, top)
    whole.add_patch(Rectangle((-0.5, -0.5), width, height, fill=False, edgecolor="black"))
    for ax in (whole, near):
        if view.prior.expected_corners_px:
            _square(ax, _expected(view), ORANGE, "expected", linestyle="dashed")
        _square(ax, found, BLUE, "found")
        size = 8.0 if ax is whole else 16.0
        ax.plot(*true.T, "+", color=GREEN, markersize=size, markeredgewidth=2.0, label="true")
    return figure, whole, near


def _square(ax: Axes, corners_px: Array, colour: str, label: str, linestyle: str = "solid") -> None:
    ax.add_patch(
        Polygon(
            corners_px,
            fill=False,
            edgecolor=colour,
            linewidth=1.4,
            linestyle=linestyle,
            label=label,
        )
    )


def _drawing(view: View, file: Path) -> None:
    """The marker at the nodes of the fit's grid: seen, drawn, and the difference."""
    found = _found(view)
    drawing = _LARGE.drawing
    fit = align_drawing(view.image, found, drawing, CAMERA, view.blur_px)
    assert fit is not None
    n = 44
    grid = make_sampling_grid(n, drawing.photometric_fit_half_width_half_sides)
    H = homography_from_centred_square(undistort_px(fit.corners_px, CAMERA))
    x, y = distort_px(project_nodes(H, grid.node_uv1), CAMERA).astype(np.float32).reshape(2, n, n)
    grey = cv2.remap(view.image.astype(np.float32), x, y, cv2.INTER_LINEAR).ravel()
    node_px = drawing.photometric_fit_half_width_half_sides * mean_side_px(fit.corners_px) / n
    rows, _ = render_blurred(
        drawing, n, round(np.log(fit.blur_sigma_px / node_px) / 0.02)
    ).illumination_basis
    drawn = rows.T @ np.linalg.lstsq(rows.T, grey, rcond=None)[0]
    figure = new_figure(7.2, 2.4, dpi=100)
    picture, seen, model, rest = figure.subplots(1, 4)
    picture.imshow(view.image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    room = 0.35 * mean_side_px(found)
    (left, top), (right, bottom) = found.min(axis=0) - room, found.max(axis=0) + room
    picture.set_xlim(left, right)
    picture.set_ylim(bottom, top)
    _square(picture, found, BLUE, "found")
    picture.plot(*view.true_px.T, "+", color=GREEN, markersize=8, markeredgewidth=2.0, label="true")
    reprojection_error_px = float(np.abs(found - view.true_px).max())
    picture.set_title(f"picture, error {reprojection_error_px:.2f} px", fontsize=9)
    low, high = float(grey.min()), float(grey.max())
    for ax, values, title in (
        (seen, grey, "picture on the grid"),
        (model, drawn, f"drawing, blur {fit.blur_sigma_px:.1f} px"),
        (rest, grey - drawn + 0.5 * (low + high), "difference"),
    ):
        ax.imshow(values.reshape(n, n), cmap="gray", vmin=low, vmax=high)
        ax.set_title(title, fontsize=9)
    for ax in (picture, seen, model, rest):
        ax.set_xticks([])
        ax.set_yticks([])
    figure.legend(
        *picture.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9
    )
    _write(figure, file)


def _finish(figure: Figure, file: Path, whole: Axes, view: View) -> None:
    true, found = view.true_px, _found(view)
    reprojection_error_px = float(np.abs(found - true).max())
    whole.set_title(f"largest error {reprojection_error_px:.2f} px", fontsize=9)
    labelled = {}
    for ax in figure.axes:
        ax.set_xticks([])
        ax.set_yticks([])
        labelled.update(dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True)))
    figure.legend(
        labelled.values(), labelled.keys(), loc="outside lower center", ncols=5, fontsize=9
    )
    _write(figure, file)


def _write(figure: Figure, file: Path) -> None:
    """As a picture of few colours."""
    drawn = Image.open(BytesIO(figure_bytes(figure))).convert("RGB")
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette())
    drawn.quantize(palette=palette, dither=Image.Dither.NONE).save(file, optimize=True)


def _palette() -> list[int]:
    """Greys, and the lines' colours over black, grey and white in three strengths."""
    greys = np.linspace(0, 255, _GREYS)[:, None].repeat(3, axis=1)
    lines = np.array([to_rgb(each) for each in (BLUE, GREEN, ORANGE, PURPLE, VERMILLION)]) * 255.0
    below = np.array([0.0, 128.0, 255.0])[:, None]
    mixed = [line + share * (below - line) for line in lines for share in (0.0, 1 / 3, 2 / 3)]
    return [int(value) for value in np.rint(np.concatenate([greys, *mixed])).ravel()]


PICTURES: dict[str, Callable[[Path], None]] = {
    "Edge fit": edge_fit,
    "Half-size search": half_size_search,
    "Partial-view fit": partial_view_fit,
    "Photometric fit": photometric_fit,
    "Cut-view fit": cut_view_fit,
    "Search": search_and_refinement,
    "Blurred search": blurred_search,
}
"""By the method's name."""
