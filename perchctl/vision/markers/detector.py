"""Data for detecting the target's markers, computed once: dictionaries, patterns, and the mask of
the vehicle's own gear.

Each marker has its own dictionary with a single id, so that no other marker can be mistaken for it.
In 28 images without a target, 0 and 1 correction bits (large and small marker) led to no false
detection; 0 and 3 correction bits led to false detections in 7 images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, TargetConfig
from perchctl.vision.markers.corners import scale_square
from perchctl.vision.markers.pattern import (
    MarkerPattern,
    make_cells_along_border,
    make_marker_drawing,
    make_marker_pattern,
)
from perchctl.vision.types import CameraModel, Frame, MarkerName

MIRRORED_MARKER_ID = 1
"""Index of the marker's mirror image in its dictionary."""
# The error of an edge is small because the errors of its hundreds of printed dots average out.
_PRINTED_EDGE_POSITION_SIGMA_M = 1e-6
_MIN_MARKER_PERIMETER_TO_DETECT_PX = 19.2  # OpenCV's default, 0.03 times the image size, for 640 px
_QUAD_DETECTOR_MIN_MARKER_PERIMETER_RATE = 0.05
_QUAD_DETECTOR_POLYGONAL_APPROX_ACCURACY_RATE = 0.1


ThresholdWindowRange = tuple[int, int]
"""Smallest and largest window of the adaptive threshold, px; OpenCV tries windows in steps of
10."""
OPENCV_DEFAULT_THRESHOLD_WINDOW_RANGE_PX: ThresholdWindowRange = (3, 23)
"""OpenCV's default windows."""
# A single window is sufficient if both markers were seen in the previous frame.
QUICK_SEARCH_THRESHOLD_WINDOW_RANGE_PX: ThresholdWindowRange = (13, 13)
_QUAD_DETECTOR_THRESHOLD_WINDOW_RANGE_PX: ThresholdWindowRange = (15, 35)


@dataclass(frozen=True, eq=False)
class DetectorSetup:
    """Parameters of `detect_markers`, created by `make_detector_setup`.

    Attributes:
        large_and_small_aruco_dictionaries: one `cv2.aruco.Dictionary` for the large marker and one
            for the small marker. Each contains only this marker and, if the two can be told apart,
            its mirror image.
        patterns: appearance of each marker.
        small_to_large_side_ratio: side of the small marker divided by the side of the large one.
        is_line_fit_enabled: if False, markers are only detected by OpenCV and refined by
            `refine_subpix`, without edge fits and photometric fits.
        static_hidden_mask: True for pixels that the vehicle hides in every image, (h, w); None if
            it hides none.
    """

    large_and_small_aruco_dictionaries: tuple[Any, Any]
    patterns: dict[MarkerName, MarkerPattern]
    small_to_large_side_ratio: float
    is_line_fit_enabled: bool
    static_hidden_mask: HiddenMask | None = None


def make_detector_setup(
    config: DetectorConfig, target: TargetConfig, static_hidden_mask: HiddenMask | None = None
) -> DetectorSetup:
    """Return the setup for a target, with dictionaries that only contain the target's markers and
    their mirror images. `static_hidden_mask` (h, w) is True for pixels that the vehicle hides in
    every image; None if it hides none."""
    large_bits, small_bits = target.large.bits, target.small.bits
    small_to_large_side_ratio = target.small.side_m / target.large.side_m
    return DetectorSetup(
        large_and_small_aruco_dictionaries=(
            _make_aruco_dictionary(large_bits, config.correction_bits_large),
            _make_aruco_dictionary(small_bits, config.correction_bits_small),
        ),
        patterns={
            "large": make_marker_pattern(
                make_cells_along_border(
                    large_bits,
                    _PRINTED_EDGE_POSITION_SIGMA_M * (len(large_bits) + 2) / target.large.side_m,
                ),
                make_marker_drawing(
                    large_bits,
                    small_bits,
                    small_to_large_side_ratio,
                    small_to_large_side_ratio + 2.0 * target.ring_m / target.large.side_m,
                ),
            ),
            "small": make_marker_pattern(
                make_cells_along_border(
                    small_bits,
                    _PRINTED_EDGE_POSITION_SIGMA_M * (len(small_bits) + 2) / target.small.side_m,
                ),
                make_marker_drawing(small_bits),
            ),
        },
        small_to_large_side_ratio=small_to_large_side_ratio,
        is_line_fit_enabled=config.refinement == "line",
        static_hidden_mask=static_hidden_mask,
    )


def make_aruco_detector(
    setup: DetectorSetup, size_px: tuple[int, int], threshold_windows_px: ThresholdWindowRange
) -> Any:
    """Return a `cv2.aruco.ArucoDetector` for images of `size_px` (width, height), without corner
    refinement. Its adaptive threshold tries square windows whose sides range from the first to the
    second of `threshold_windows_px`, px."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate = 1.0  # the limit is then maxCorrectionBits itself
    parameters.minDistanceToBorder = 0
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = threshold_windows_px
    parameters.minMarkerPerimeterRate = min(1.0, _MIN_MARKER_PERIMETER_TO_DETECT_PX / max(size_px))
    return cv2.aruco.ArucoDetector(list(setup.large_and_small_aruco_dictionaries), parameters)


def make_quad_detector(setup: DetectorSetup) -> Any:
    """Return a `cv2.aruco.ArucoDetector` that finds nearly any quadrilateral. Its output includes,
    as rejected candidates, the quadrilaterals whose bits it cannot read; the caller compares them
    with blurred markers (`find_blurred_marker`)."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.minDistanceToBorder = 0
    parameters.polygonalApproxAccuracyRate = _QUAD_DETECTOR_POLYGONAL_APPROX_ACCURACY_RATE
    least_px, most_px = _QUAD_DETECTOR_THRESHOLD_WINDOW_RANGE_PX
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = least_px, most_px
    parameters.adaptiveThreshWinSizeStep = most_px - least_px
    parameters.minMarkerPerimeterRate = _QUAD_DETECTOR_MIN_MARKER_PERIMETER_RATE
    return cv2.aruco.ArucoDetector(list(setup.large_and_small_aruco_dictionaries), parameters)


def _make_aruco_dictionary(bits: NDArray[np.uint8], max_correction_bits: int) -> Any:
    patterns, mirror = [bits], np.ascontiguousarray(bits[:, ::-1])
    distance = min(int((np.rot90(mirror, turn) != bits).sum()) for turn in range(4))
    if distance > 2 * max_correction_bits + 1:
        patterns.append(mirror)
    rows = [cv2.aruco.Dictionary.getByteListFromBits(np.ascontiguousarray(p)) for p in patterns]
    return cv2.aruco.Dictionary(
        np.ascontiguousarray(np.concatenate(rows)), bits.shape[0], max_correction_bits
    )


# --- The vehicle's own gear in the image ---
# The gear hides parts of the target. The pixels of the gear are filled from their surroundings so
# that thresholding does not connect the gear to a marker's border. No side or cell is measured at
# these pixels.


HiddenMask = NDArray[np.bool_]
REQUIRED_VISIBLE_HALF_WIDTH_HALF_SIDES = 1.25
"""Distance from a marker's centre, in half sides, within which any object disturbs the measurement
of the marker's sides."""
# A covered row contributes to this number of a field's image rows.
_FIELD_HIDDEN_MASK_DILATION_ROWS = 7
# Factor by which the image is reduced, and standard deviation of the fill in the reduced image.
_HIDDEN_PIXEL_FILL_IMAGE_REDUCTION_FACTOR, _HIDDEN_PIXEL_FILL_BLUR_SIGMA_REDUCED_PX = 8, 2.0
_MEAN_GREY_WEIGHT_IN_HIDDEN_PIXEL_FILL = 1e-4


def make_hidden_mask(frame: Frame, static_hidden_mask: HiddenMask | None) -> HiddenMask | None:
    """Return the mask (h, w), True for pixels that the vehicle hides in this frame; None if
    `static_hidden_mask` is None. For a single field of interlaced video, it is `static_hidden_mask`
    extended by the rows that were interpolated from hidden ones, otherwise `static_hidden_mask`
    itself."""
    if static_hidden_mask is None or frame.picture_kind not in ("top", "bottom"):
        return static_hidden_mask
    return (
        cv2.dilate(
            static_hidden_mask.astype(np.uint8),
            np.ones((_FIELD_HIDDEN_MASK_DILATION_ROWS, 1), np.uint8),
        )
        > 0
    )


def fill_hidden_pixels(image: NDArray[np.uint8], hidden_mask: HiddenMask) -> NDArray[np.uint8]:
    """Return the image (h, w) after filling the pixels at which `hidden_mask` (h, w) is True with a
    smooth interpolation of their surroundings."""
    h, w = image.shape
    free = (~hidden_mask).astype(np.float32)
    size = (
        max(w // _HIDDEN_PIXEL_FILL_IMAGE_REDUCTION_FACTOR, 1),
        max(h // _HIDDEN_PIXEL_FILL_IMAGE_REDUCTION_FACTOR, 1),
    )

    def around(values: NDArray[np.float32]) -> NDArray[np.float32]:
        reduced = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        return np.asarray(
            cv2.GaussianBlur(reduced, (0, 0), _HIDDEN_PIXEL_FILL_BLUR_SIGMA_REDUCED_PX), np.float32
        )

    mean = cv2.mean(image, (~hidden_mask).astype(np.uint8))[0]
    grey = (around(image * free) + _MEAN_GREY_WEIGHT_IN_HIDDEN_PIXEL_FILL * mean) / (
        around(free) + _MEAN_GREY_WEIGHT_IN_HIDDEN_PIXEL_FILL
    )
    smooth = cv2.resize(grey, (w, h), interpolation=cv2.INTER_LINEAR)
    return np.where(hidden_mask, np.rint(smooth).astype(np.uint8), image)


def is_any_marker_part_hidden(
    hidden_mask: HiddenMask | None,
    corners_px: Array,
    reach_from_centre_half_sides: float = REQUIRED_VISIBLE_HALF_WIDTH_HALF_SIDES,
) -> bool:
    """True if the vehicle hides any pixel of the marker with `corners_px` (4, 2) in the image or of
    its surroundings: of a concentric square whose half side is `reach_from_centre_half_sides` times
    the marker's. `hidden_mask` (h, w) is True for hidden pixels. The result is False if there is no
    mask or if a corner is not finite."""
    if hidden_mask is None:
        return False
    h, w = hidden_mask.shape
    centre = corners_px.mean(axis=0)
    wide = centre + reach_from_centre_half_sides * (corners_px - centre)
    if not np.isfinite(wide).all():
        return False
    low = np.clip(np.floor(wide.min(axis=0)), 0, (w - 1, h - 1)).astype(int)
    high = np.clip(np.ceil(wide.max(axis=0)), 0, (w - 1, h - 1)).astype(int)
    part = hidden_mask[low[1] : high[1] + 1, low[0] : high[0] + 1]
    if not part.any():
        return False
    inside = np.zeros(part.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(wide - low).astype(np.int32), 1)
    return bool((part & (inside > 0)).any())


@dataclass(frozen=True, eq=False)
class DetectorInput:
    """An image in which markers are to be detected, together with the detector setup and the
    camera. `hidden_mask` (h, w) is True for pixels that the vehicle hides; None if it hides
    none."""

    image: NDArray[np.uint8]
    hidden_mask: HiddenMask | None
    setup: DetectorSetup
    camera: CameraModel

    def derive_corners_from_other_marker_px(
        self, other_corners_px: Array, derived_name: MarkerName
    ) -> Array:
        """Return the corners (4, 2) px of the marker `derived_name`, derived from
        `other_corners_px` (4, 2) of the other marker, both in the distorted image."""
        side_ratio = (
            self.setup.small_to_large_side_ratio
            if derived_name == "small"
            else 1.0 / self.setup.small_to_large_side_ratio
        )
        return scale_square(other_corners_px, side_ratio, self.camera)
