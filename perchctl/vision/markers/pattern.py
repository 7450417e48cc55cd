"""A marker's appearance (border, cells, drawing), and functions that check whether an image shows
these cells at given corners."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.corners import (
    apply_homography,
    homography_from_centred_square,
    is_inside_image,
)

MIN_MARKER_SIDE_TO_IDENTIFY_PX = 7.0  # A smaller marker looks like a blob.
MIN_CONTRAST_TO_COMPARE_CELLS_GREY = 10.0
# A cell must differ from the threshold by at least this fraction of the contrast.
MIN_CELL_MARGIN_FROM_THRESHOLD_TO_CONTRAST_RATIO = 0.1
MIN_MATCHING_CELL_FRACTION = 0.8
"""Fraction of the cells that must have the right colour."""
_MIN_CORRELATION_TO_COUNT_AS_MATCHING_PATTERN = 0.6
# Within this distance from the centre, in half sides of the small marker, no cells are sampled,
# because the small marker may hide them.
_UNSAMPLED_CENTRE_TO_SMALL_MARKER_SIDE_RATIO = 1.25
_SAMPLE_OFFSETS_FROM_CELL_CENTRE_CELLS: Array = np.array(
    [[-0.22, -0.22], [0.22, -0.22], [0.22, 0.22], [-0.22, 0.22]]
)


@dataclass(frozen=True, eq=False)
class CellsAlongBorder:
    """The colours of the cells just inside a marker's black border, along each of its four sides.
    Side k runs from corner k to corner k + 1 and is n cells long, including the border's own cells
    at both ends, which count as black.

    Attributes:
        is_cell_next_to_border_white: 1.0 if the cell next to the border is white, 0.0 if it is
            black, at each position along each side (4, n).
        are_two_cells_next_to_border_white: 1.0 if that cell and the next one towards the marker's
            centre are both white, otherwise 0.0 (4, n).
        printed_edge_position_sigma_cells: standard deviation of a printed edge's position, in
            cells.
    """

    is_cell_next_to_border_white: Array
    are_two_cells_next_to_border_white: Array
    printed_edge_position_sigma_cells: float = 0.0

    @property
    def cells_per_side(self) -> int:
        return int(self.is_cell_next_to_border_white.shape[1])


@dataclass(frozen=True, eq=False)
class MarkerPattern:
    """The appearance of a marker.

    Attributes:
        cells_along_border: the cells just inside the border.
        drawing: all cells of the marker.
        sample_points_half_sides: points (n, 2) at which the greys of cells are read, in half sides
            from the marker's centre (x right, y down on the paper). The cells below are those that
            have sample points.
        sample_cell_index: the cell (n,) of each sample point.
        samples_per_cell: number of sample points in each cell, (cells,).
        expected_sample_greys_per_rotation: expected grey (4, n) at the sample points, one row for
            each rotation of the marker (corners rolled by 0 to 3). Each row is blurred by half a
            cell and normalised to zero mean and unit norm.
        is_cell_white: True for a white cell, (cells,).
        is_cell_inside_border: True for a cell that is not part of the border, (cells,).
    """

    cells_along_border: CellsAlongBorder
    drawing: MarkerDrawing
    sample_points_half_sides: Array
    sample_cell_index: NDArray[np.intp]
    samples_per_cell: Array
    expected_sample_greys_per_rotation: Array
    is_cell_white: NDArray[np.bool_]
    is_cell_inside_border: NDArray[np.bool_]


def make_cells_along_border(
    bits: NDArray[np.uint8], printed_edge_position_sigma_cells: float = 0.0
) -> CellsAlongBorder:
    """Return the colours of the two outermost layers of cells inside the black border of a marker
    with inner bits (n, n), 1 = white. The edge fits use them, because the blur of these cells may
    reach the edges of the border. `printed_edge_position_sigma_cells` is the standard deviation of
    a printed edge's position, in cells."""
    n = len(bits)

    def ring(depth: int) -> Array:
        if 2 * depth >= n:
            return np.ones((4, n))
        last = n - 1 - depth
        return np.asarray(
            (bits[depth], bits[:, last], bits[last, ::-1], bits[::-1, depth]), dtype=np.float64
        )

    white = np.pad(ring(0), ((0, 0), (1, 1)))
    second = np.pad(ring(1), ((0, 0), (1, 1)))
    return CellsAlongBorder(white, white * second, printed_edge_position_sigma_cells)


def make_marker_pattern(
    cells_along_border: CellsAlongBorder, drawing: MarkerDrawing
) -> MarkerPattern:
    """Return the pattern of a marker with the given `drawing`. Its sample points, in half sides
    from the marker's centre, are in all cells, except where a small marker in the centre covers
    them. `cells_along_border`, the cells just inside the border (`make_cells_along_border`),
    becomes a part of the pattern."""
    n = len(drawing.cell_whiteness)
    middle = (2.0 * np.arange(n) + 1.0) / n - 1.0
    x, y = np.meshgrid(middle, middle)
    centres = np.stack([x.ravel(), y.ravel()], axis=1)
    sample_points_half_sides = (
        centres[:, None] + _SAMPLE_OFFSETS_FROM_CELL_CENTRE_CELLS * 2.0 / n
    ).reshape(-1, 2)
    owner = np.repeat(np.arange(n * n), len(_SAMPLE_OFFSETS_FROM_CELL_CENTRE_CELLS))
    free = (
        np.abs(sample_points_half_sides).max(axis=1)
        > _UNSAMPLED_CENTRE_TO_SMALL_MARKER_SIDE_RATIO * drawing.small_to_large_side_ratio
    )
    kept = np.unique(owner[free])
    turns, at = [], sample_points_half_sides[free]
    for _ in range(4):
        soft = _sample_blurred_drawing(drawing, at)
        soft -= soft.mean()
        turns.append(soft / math.sqrt(float(soft @ soft)))
        at = np.stack([-at[:, 1], at[:, 0]], axis=1)
    own = np.searchsorted(kept, owner[free]).astype(np.intp)
    return MarkerPattern(
        cells_along_border=cells_along_border,
        drawing=drawing,
        sample_points_half_sides=np.ascontiguousarray(sample_points_half_sides[free]),
        sample_cell_index=own,
        samples_per_cell=np.bincount(own).astype(np.float64),
        expected_sample_greys_per_rotation=np.stack(turns),
        is_cell_white=drawing.cell_whiteness.ravel()[kept] > 0.5,
        is_cell_inside_border=np.abs(centres).max(axis=1)[kept] < 1.0 - 2.0 / n,
    )


def has_matching_cells(image: NDArray[np.uint8], corners_px: Array, pattern: MarkerPattern) -> bool:
    """True if every cell of a marker with corners (4, 2) px in the image clearly has the colour of
    its cell in the pattern: its mean grey is on the right side of the middle between the medians of
    black and white, by at least `MIN_CELL_MARGIN_FROM_THRESHOLD_TO_CONTRAST_RATIO` of the contrast.
    False if the contrast is below `MIN_CONTRAST_TO_COMPARE_CELLS_GREY` or the marker is partly
    outside the image."""
    means = _mean_grey_per_cell(image, corners_px, pattern)
    if means is None:
        return False
    white, black = means[pattern.is_cell_white], means[~pattern.is_cell_white]
    # The illumination may vary across the marker, so medians are used for white and black.
    high = float(np.partition(white, len(white) // 2)[len(white) // 2])
    low = float(np.partition(black, len(black) // 2)[len(black) // 2])
    contrast = high - low
    middle, margin = 0.5 * (high + low), MIN_CELL_MARGIN_FROM_THRESHOLD_TO_CONTRAST_RATIO * contrast
    return bool(
        contrast >= MIN_CONTRAST_TO_COMPARE_CELLS_GREY
        and white.min() > middle + margin
        and black.max() < middle - margin
    )


def has_mostly_matching_cells(
    image: NDArray[np.uint8], corners_px: Array, pattern: MarkerPattern
) -> bool:
    """True if more than `MIN_MATCHING_CELL_FRACTION` of the cells of a marker with corners (4, 2)
    px in the image have the colour of their cell in the pattern: their mean grey is on the right
    side of the middle between the medians of black and white. False if the contrast is below
    `MIN_CONTRAST_TO_COMPARE_CELLS_GREY` or the marker is partly outside the image."""
    means = _mean_grey_per_cell(image, corners_px, pattern)
    if means is None:
        return False
    high, low = np.median(means[pattern.is_cell_white]), np.median(means[~pattern.is_cell_white])
    right = (means > 0.5 * (high + low)) == pattern.is_cell_white
    return bool(
        high - low >= MIN_CONTRAST_TO_COMPARE_CELLS_GREY
        and right.mean() > MIN_MATCHING_CELL_FRACTION
    )


def is_correlated_with_pattern(
    image: NDArray[np.uint8], corners_px: Array, pattern: MarkerPattern
) -> bool:
    """True if the grey values in the cells of a marker with corners (4, 2) px in the image have a
    correlation of more than `_MIN_CORRELATION_TO_COUNT_AS_MATCHING_PATTERN` with the pattern. The
    first corner is taken as the marker's top left as printed; other rotations are not tried. False
    if there is no contrast or the marker is partly outside the image."""
    return (
        float(correlate_pattern_rotations(image, corners_px, pattern)[0])
        > _MIN_CORRELATION_TO_COUNT_AS_MATCHING_PATTERN
    )


def correlate_pattern_rotations(
    image: NDArray[np.uint8], corners_px: Array, pattern: MarkerPattern
) -> Array:
    """Return the correlation (4,) of the grey values in the cells with the pattern, for the four
    rotations of the marker (corners (4, 2) px in the image, rolled by 0 to 3 as by `np.roll`); 0 if
    there is no contrast or the marker is partly outside the image."""
    grey = _read_sample_greys(image, corners_px, pattern)
    if grey is None:
        return np.zeros(4)
    grey -= grey.mean()
    spread = float(np.linalg.norm(grey))
    # If half of the samples are black and half are white, they differ by two standard deviations.
    if spread < 0.5 * MIN_CONTRAST_TO_COMPARE_CELLS_GREY * math.sqrt(len(grey)):
        return np.zeros(4)
    return np.asarray(pattern.expected_sample_greys_per_rotation @ grey / spread)


def _mean_grey_per_cell(
    image: NDArray[np.uint8], corners_px: Array, pattern: MarkerPattern
) -> Array | None:
    grey = _read_sample_greys(image, corners_px, pattern)
    if grey is None:
        return None
    return np.asarray(
        np.bincount(pattern.sample_cell_index, weights=grey) / pattern.samples_per_cell
    )


def _read_sample_greys(
    image: NDArray[np.uint8], corners_px: Array, pattern: MarkerPattern
) -> Array | None:
    """Return the grey values (n,) of the pixels nearest to the pattern's sample points in a marker
    with corners (4, 2) px in the image, ignoring lens distortion between the corners; None if any
    of them is outside the image."""
    at = apply_homography(
        homography_from_centred_square(corners_px), pattern.sample_points_half_sides
    )
    # If the corners are in the image, so are the sample points, which are all inside the marker.
    if not (is_inside_image(corners_px, image.shape) or is_inside_image(at, image.shape)):
        return None
    nearest = (at + 0.5).astype(np.intp)
    return image[nearest[:, 1], nearest[:, 0]].astype(np.float64)


def _sample_blurred_drawing(drawing: MarkerDrawing, sample_points_half_sides: Array) -> Array:
    """Return the whiteness (k,), 0 to 1, of the drawing at the sample points (k, 2), in half sides
    from the marker's centre, after a blur with a standard deviation of half a cell. The small
    marker is not drawn."""
    n, fine = len(drawing.cell_whiteness), 8
    sharp_node_values = np.kron(
        np.pad(drawing.cell_whiteness, 2, constant_values=1.0), np.ones((fine, fine))
    )
    white = np.asarray(cv2.GaussianBlur(sharp_node_values, (0, 0), 0.5 * fine), dtype=np.float64)
    at = (((sample_points_half_sides + 1.0) * 0.5 * n + 2.0) * fine).astype(np.intp)
    return np.asarray(white[at[:, 1], at[:, 0]])


# --- A marker's drawing on a grid: whiteness of each node, sharp and blurred ---


# Width of the white margin around the border that is fitted.
_PHOTOMETRIC_FIT_WHITE_MARGIN_CELLS = 0.6
GRID_MARGIN_FOR_BLUR_NODES = 12
"""Number of nodes that are added on all sides to make room for the blur."""


@dataclass(frozen=True, eq=False)
class MarkerDrawing:
    """What is printed on the paper: a marker and, if it is the large one, the small marker in its
    centre, which a white square ring surrounds. Lengths are in half sides of this marker.

    Attributes:
        cell_whiteness: 1 for a white cell, 0 for a black one (n, n), row by row from the top left,
            including the black border.
        small_marker_cell_whiteness: the same (m, m) for the small marker in the centre; None if
            there is none.
        small_to_large_side_ratio: side of the small marker divided by the side of this marker; 0 if
            there is no small marker.
        white_ring_outer_half_width_half_sides: distance from the centre to the outer edge of the
            white ring. This marker's own cells are not printed any closer to the centre.
        paper_half_width_half_sides: distance from the centre to the edge of the square paper; None
            if the paper is assumed to be infinite.
    """

    cell_whiteness: Array
    small_marker_cell_whiteness: Array | None = None
    small_to_large_side_ratio: float = 0.0
    white_ring_outer_half_width_half_sides: float = 0.0
    paper_half_width_half_sides: float | None = None

    @property
    def photometric_fit_half_width_half_sides(self) -> float:
        """Half the side, in half sides of the marker, of the square that the photometric fit
        compares with the image."""
        return 1.0 + _PHOTOMETRIC_FIT_WHITE_MARGIN_CELLS * 2.0 / len(self.cell_whiteness)


def make_marker_drawing(
    bits: NDArray[np.uint8],
    small_marker_bits: NDArray[np.uint8] | None = None,
    small_to_large_side_ratio: float = 0.0,
    white_ring_outer_half_width_half_sides: float = 0.0,
) -> MarkerDrawing:
    """Return the drawing of a marker with inner bits `bits` (n, n), 1 = white, to which a black
    border is added.

    The other arguments describe the small marker in the centre of a large one, if there is one:

    - `small_marker_bits` (m, m): its inner bits, 1 = white.
    - `small_to_large_side_ratio`: its side divided by the side of the large marker.
    - `white_ring_outer_half_width_half_sides`: the distance from the centre to the outer edge of
      the white ring around it, in half sides of the large marker; if it is less than the half side
      of the small marker, that half side is used.

    With a small marker, the paper ends one cell outside the border; without one, the paper is
    assumed to be infinite.
    """
    cells = np.pad(bits.astype(np.float64), 1)
    if small_marker_bits is None:
        return MarkerDrawing(cells)
    return MarkerDrawing(
        cells,
        np.pad(small_marker_bits.astype(np.float64), 1),
        small_to_large_side_ratio,
        max(white_ring_outer_half_width_half_sides, small_to_large_side_ratio),
        1.0 + 2.0 / len(cells),
    )


def _cell_coverage(
    node_positions_half_sides: Array,
    node_half_width_half_sides: float,
    cells_per_side: int,
    square_half_width_half_sides: float,
    max_counted_distance_from_centre_half_sides: float = math.inf,
) -> Array:
    """Return the fraction of each node's interval that each cell covers, (nodes, cells), along one
    axis of a grid of nodes over the marker, at which the drawing is rendered. A node's interval
    extends `node_half_width_half_sides` to each side of its position. The `cells_per_side` cells
    fill the interval from -square_half_width_half_sides to square_half_width_half_sides; of each
    cell, only the part up to `max_counted_distance_from_centre_half_sides` from the centre counts.
    Lengths are in half sides from the marker's centre."""
    edges = square_half_width_half_sides * np.linspace(-1.0, 1.0, cells_per_side + 1)
    edges = np.clip(
        edges,
        -max_counted_distance_from_centre_half_sides,
        max_counted_distance_from_centre_half_sides,
    )
    low, high = (
        node_positions_half_sides[:, None] - node_half_width_half_sides,
        node_positions_half_sides[:, None] + node_half_width_half_sides,
    )
    overlap = np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1])
    return np.asarray(np.maximum(overlap, 0.0) / (2.0 * node_half_width_half_sides))


def _add_margin_nodes(node_positions_half_sides: Array, node_half_width_half_sides: float) -> Array:
    """Return the positions of a grid's nodes along one axis, in half sides from the marker's
    centre, after adding `GRID_MARGIN_FOR_BLUR_NODES` nodes at both ends to make room for the blur.
    `node_half_width_half_sides` is half the spacing of the nodes."""
    more = 2.0 * node_half_width_half_sides * np.arange(1, GRID_MARGIN_FOR_BLUR_NODES + 1)
    return np.concatenate(
        [
            node_positions_half_sides[0] - more[::-1],
            node_positions_half_sides,
            node_positions_half_sides[-1] + more,
        ]
    )


@lru_cache(maxsize=64)
def render_whiteness_and_off_paper_fraction(
    drawing: MarkerDrawing, nodes_per_side: int
) -> tuple[NDArray[np.float32], ...]:
    """Render the drawing without blur on a grid of n by n nodes (`nodes_per_side`) over the square
    that the photometric fit compares with the image. A margin of m = `GRID_MARGIN_FOR_BLUR_NODES`
    nodes is added on all sides, so that the result can be blurred afterwards.

    The first array returned, (n + 2m, n + 2m), is the whiteness of each node, 0 to 1: the mean over
    the small square around it. If the drawing has a `paper_half_width_half_sides`, a second array
    of the same shape contains the fraction of this small square that is beyond the paper.
    """
    node_half_width_half_sides = drawing.photometric_fit_half_width_half_sides / nodes_per_side
    node_positions_half_sides: Array = node_half_width_half_sides * (
        2.0 * np.arange(nodes_per_side, dtype=np.float64) + 1.0 - nodes_per_side
    )
    paper = render_cells(drawing, node_positions_half_sides, node_half_width_half_sides)
    if drawing.paper_half_width_half_sides is None:
        return (paper,)
    on = _cell_coverage(
        _add_margin_nodes(node_positions_half_sides, node_half_width_half_sides),
        node_half_width_half_sides,
        1,
        drawing.paper_half_width_half_sides,
    )
    return paper, (1.0 - on @ on.T).astype(np.float32)


@lru_cache(maxsize=64)
def render_black_square(cells_per_side: int, nodes_per_side: int) -> NDArray[np.float32]:
    """Return the whiteness, 0 to 1, of a plain black square on white paper that has the size of a
    marker but no inner pattern, without blur. The photometric fit subtracts it to compare the inner
    pattern alone.

    The result (n + 2m, n + 2m) covers a grid of n by n nodes (`nodes_per_side`) and a margin of m =
    `GRID_MARGIN_FOR_BLUR_NODES` nodes around them. `cells_per_side`, the marker's number of cells
    including the border, determines how far the nodes extend beyond the square."""
    return render_whiteness_and_off_paper_fraction(
        MarkerDrawing(np.zeros((cells_per_side, cells_per_side))), nodes_per_side
    )[0]


def render_cells(
    drawing: MarkerDrawing, node_positions_half_sides: Array, node_half_width_half_sides: float
) -> NDArray[np.float32]:
    """Return the whiteness of the drawing, 0 to 1, at the nodes of a square grid, without blur. The
    nodes are at `node_positions_half_sides` (n,) along both axes, in half sides from the marker's
    centre, and the result also has a margin of m = `GRID_MARGIN_FOR_BLUR_NODES` nodes on all sides:
    (n + 2m, n + 2m). Each value is the mean over the node's square, which extends
    `node_half_width_half_sides`, half the spacing, to each side. The surroundings of the marker are
    white."""
    wide = _add_margin_nodes(node_positions_half_sides, node_half_width_half_sides)
    C = _cell_coverage(wide, node_half_width_half_sides, len(drawing.cell_whiteness), 1.0)
    black = C @ (1.0 - drawing.cell_whiteness) @ C.T
    if drawing.small_marker_cell_whiteness is not None:
        # The part of the large marker that the small one and its ring replace.
        C = _cell_coverage(
            wide,
            node_half_width_half_sides,
            len(drawing.cell_whiteness),
            1.0,
            drawing.white_ring_outer_half_width_half_sides,
        )
        black -= C @ (1.0 - drawing.cell_whiteness) @ C.T
        C = _cell_coverage(
            wide,
            node_half_width_half_sides,
            len(drawing.small_marker_cell_whiteness),
            drawing.small_to_large_side_ratio,
        )
        black += C @ (1.0 - drawing.small_marker_cell_whiteness) @ C.T
    return (1.0 - black).astype(np.float32)


def blurred_cell_coverage(
    drawing: MarkerDrawing,
    node_positions_half_sides: Array,
    node_half_width_half_sides: float,
    blur_sigma_nodes: float,
) -> Array:
    """Return the fraction (n, cells) of each node's interval that each row (or column) of the
    drawing's cells covers, along one axis of a grid of nodes, after a Gaussian blur with the
    standard deviation `blur_sigma_nodes`, in node spacings. The product of two such fractions, one
    for each axis, is the weight of a cell's colour in the grey value of a node. The nodes are at
    `node_positions_half_sides` (n,), in half sides from the marker's centre; their intervals extend
    `node_half_width_half_sides` to each side."""
    wide = _cell_coverage(
        _add_margin_nodes(node_positions_half_sides, node_half_width_half_sides),
        node_half_width_half_sides,
        len(drawing.cell_whiteness),
        1.0,
    )
    soft = cv2.GaussianBlur(
        wide.astype(np.float32),
        (1, 0),
        sigmaX=1e-3,
        sigmaY=blur_sigma_nodes,
        borderType=cv2.BORDER_REPLICATE,
    )
    return np.asarray(
        soft[
            GRID_MARGIN_FOR_BLUR_NODES : GRID_MARGIN_FOR_BLUR_NODES + len(node_positions_half_sides)
        ],
        dtype=np.float64,
    )


def blur_node_values(
    sharp_node_values: NDArray[np.float32], blur_sigma_nodes: float
) -> NDArray[np.float32]:
    """Return the values `sharp_node_values` (k, k) at the nodes of a grid after a Gaussian blur.

    The blur has the standard deviation `blur_sigma_nodes`, in node spacings. Both arrays include a
    margin of `GRID_MARGIN_FOR_BLUR_NODES` nodes on all sides, in which the result is less accurate.
    """
    soft = cv2.GaussianBlur(
        sharp_node_values, (0, 0), blur_sigma_nodes, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(soft, np.float32)
