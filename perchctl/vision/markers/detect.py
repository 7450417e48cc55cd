"""Detect the corners of the target's two markers in an image.

`CORNER_METHODS` lists the methods that find corners, in the order in which they are tried, with the
requirements and cost of each method and when it runs. ``docs/corners.md`` shows an example of each.

    frame -> DetectionPrior -> CORNER_METHODS, one by one -> CornerResults -> Detections
             (expected corners, kinds of search)

Corners are (4, 2) px, top left, top right, bottom right, bottom left as printed; (0, 0) is the
centre of the top-left pixel. The corners of a marker have either one standard deviation, px, or a
covariance (8, 8), px^2. The result is None for a marker that no method confirms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig
from perchctl.values import replace
from perchctl.vision.fields import interpolate_fields, interpolated_field_edge_sigma_px
from perchctl.vision.markers.blurred import (
    align_marker,
    find_blurred_marker,
    find_expected_blurred_marker,
)
from perchctl.vision.markers.corners import (
    SIGMA_OF_CORNERS_DERIVED_FROM_OTHER_MARKER_PX,
    RefinedCorners,
    add_missing_marker_corners,
    is_inside_image,
    mean_side_px,
    refine_subpix,
    side_lengths_px,
)
from perchctl.vision.markers.cut import (
    MAX_TARGET_MEASUREMENT_AGE_TO_TRY_TRUNCATED_FIT_S,
    can_complete_marker_be_in_view,
    fit_truncated_markers,
    is_target_possibly_truncated,
)
from perchctl.vision.markers.detector import (
    DetectorInput,
    DetectorSetup,
    fill_hidden_pixels,
    is_any_marker_part_hidden,
    make_hidden_mask,
)
from perchctl.vision.markers.edge_fit import refine_corners_by_lines
from perchctl.vision.markers.partial import (
    MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX,
    IdentificationEvidence,
    fit_partly_visible_marker,
    is_fully_visible,
)
from perchctl.vision.markers.pattern import (
    MIN_MARKER_SIDE_TO_IDENTIFY_PX,
    MarkerPattern,
    has_matching_cells,
    has_mostly_matching_cells,
    is_correlated_with_pattern,
)
from perchctl.vision.markers.search import (
    MarkerSearchResult,
    SearchMode,
    search_for_markers,
    search_half_size_image,
)
from perchctl.vision.target_selection import MarkerToOwnTargetDistanceFunction
from perchctl.vision.types import (
    MARKERS,
    CameraModel,
    Detection,
    Detections,
    EdgeShiftEstimate,
    Frame,
    MarkerName,
    PictureKind,
)

_MIN_MISSING_MARKER_SIDE_TO_RUN_SEARCH_PX = 13.0  # The search does not find smaller markers.
# A measured edge shift stays valid for this number of frames because the light changes slowly.
_MAX_FRAMES_TO_REUSE_BLOOMING_EDGE_SHIFT = 5
_FoundCorners = dict[MarkerName, RefinedCorners]


# --- The methods that find corners, in the order in which they are tried ---


@dataclass(frozen=True, eq=False)
class DetectionPrior:
    """What is known about the target before its markers are detected in a frame.

    Attributes:
        expected_corners_px: the markers' predicted corners, each (4, 2) px; empty if no target is
            expected.
        expected_corners_both_markers_px: the predicted corners of both markers, each (4, 2) px; a
            missing marker is derived from the other one. Empty if no target is expected.
        search_mode: the kinds of search to use in this frame (`SearchMode`).
        blurred_fit_attempt_index: number of earlier frames, since the markers were lost, in
            which fits to blurred markers were tried at the expected position. If it is even, the
            fits in this frame start with a small blur; if it is odd, with a large one. None to try
            both.
        was_target_seen_recently: True if a marker was found at most
            `MAX_TARGET_MEASUREMENT_AGE_TO_TRY_TRUNCATED_FIT_S` before this frame; always False if
            edge fits are disabled.
        was_target_truncated_when_last_seen: True if `was_target_seen_recently` is True and the
            image border truncated every marker that was detected last.
        recently_measured_edge_shift: how far white has grown over black (blooming), in pixels, with
            its standard deviation, as measured in a recent frame; None if it must be measured in
            this frame.
        measure_marker_to_own_target_distance_m: function that returns a marker's horizontal
            distance, m, from the position of this vehicle's own target. If several targets are in
            view and no corners are expected, the target with the smallest distance is selected.
            None if only the image is used to select a target.
    """

    expected_corners_px: Mapping[MarkerName, Array]
    expected_corners_both_markers_px: Mapping[MarkerName, Array]
    search_mode: SearchMode
    blurred_fit_attempt_index: int | None
    was_target_seen_recently: bool
    was_target_truncated_when_last_seen: bool
    recently_measured_edge_shift: EdgeShiftEstimate | None
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction | None


@dataclass(frozen=True, eq=False)
class CornerResults:
    """Results of the corner methods tried so far on an image: the refined `corners` of each marker
    that was found, and `search_result`, the unrefined result of the last search with OpenCV's
    detector, which is empty if no search has run."""

    corners: dict[MarkerName, RefinedCorners] = field(default_factory=dict)
    search_result: MarkerSearchResult = field(default_factory=MarkerSearchResult)


@dataclass(frozen=True, eq=False)
class CornerMethod:
    """One method to find corners: a row of `CORNER_METHODS`.

    Attributes:
        name: heading in ``docs/corners.md``.
        docs_prerequisites: what the target must look like in the image, and what must be known
            about it beforehand, for the method to succeed. This text and the next two are only
            shown to readers of ``docs/corners.md``; no code evaluates them.
        docs_typical_time: typical time for an image of 640x480 on one core.
        docs_run_condition: description of the cases in which `should_run` returns True.
        should_run: function that returns True if the method should be tried on the image, given the
            prior and the results so far.
        find: function that runs the method and returns the new results, which replace the previous
            ones.
    """

    name: str
    docs_prerequisites: str
    docs_typical_time: str
    docs_run_condition: str
    should_run: Callable[[DetectorInput, DetectionPrior, CornerResults], bool]
    find: Callable[[DetectorInput, DetectionPrior, CornerResults], CornerResults]


def _should_fit_edges(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> bool:
    return (
        prior.search_mode != "expected_fits"
        and bool(prior.expected_corners_both_markers_px)
        and detector_input.setup.is_line_fit_enabled
    )


def _fit_edges(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> CornerResults:
    return replace(
        earlier_results,
        corners=refine_expected_markers(
            detector_input,
            prior.expected_corners_both_markers_px,
            prior.recently_measured_edge_shift,
        ),
    )


def _should_search_half_size_image(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> bool:
    return _should_fit_edges(detector_input, prior, earlier_results) and not earlier_results.corners


def _search_half_size_image(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> CornerResults:
    # If the edge fit found no sides, a close target has usually moved further than a profile
    # reaches.
    searched = search_half_size_image(detector_input, prior.expected_corners_both_markers_px)
    if searched is None:
        return earlier_results
    corners = _refine_found_markers(detector_input, searched)
    return CornerResults(corners, searched) if corners else earlier_results


def _should_fit_visible_part(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> bool:
    return (
        _should_fit_edges(detector_input, prior, earlier_results)
        and not earlier_results.search_result.corners_px
    )


def _fit_visible_part(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> CornerResults:
    corners = add_partly_visible_markers(
        detector_input,
        prior.expected_corners_both_markers_px,
        earlier_results.corners,
        prior.recently_measured_edge_shift,
    )
    return replace(earlier_results, corners=corners)


def _needs_photometric_fit(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> bool:
    patterns = detector_input.setup.patterns
    return _should_fit_visible_part(detector_input, prior, earlier_results) and not any(
        is_line_fit_accurate(r, patterns[name]) for name, r in earlier_results.corners.items()
    )


def _run_photometric_fit(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> CornerResults:
    return replace(
        earlier_results, corners=refine_photometrically(detector_input, earlier_results.corners)
    )


def _can_target_be_truncated(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> bool:
    if earlier_results.corners or not prior.was_target_seen_recently:
        return False
    return is_target_possibly_truncated(
        prior.expected_corners_both_markers_px,
        detector_input.image.shape,
        detector_input.hidden_mask,
    )


def _fit_truncated_target(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> CornerResults:
    return replace(
        earlier_results, corners=fit_truncated_markers(detector_input, prior.expected_corners_px)
    )


def _should_search(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> bool:
    if prior.search_mode in ("whole_blurred", "expected_fits"):
        return False
    if not earlier_results.corners and (
        not prior.was_target_truncated_when_last_seen
        or can_complete_marker_be_in_view(
            prior.expected_corners_both_markers_px, detector_input.image.shape
        )
    ):
        return True
    return _is_marker_missing(detector_input, earlier_results.corners, prior.expected_corners_px)


def _run_search(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> CornerResults:
    searched = search_for_markers(
        detector_input,
        prior.expected_corners_px,
        prior.search_mode,
        prior.measure_marker_to_own_target_distance_m,
    )
    if len(searched.corners_px) < len(earlier_results.corners):
        return replace(earlier_results, search_result=searched)
    return CornerResults(_refine_found_markers(detector_input, searched), searched)


def _can_target_be_blurred(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> bool:
    allowed = prior.search_mode not in ("whole_sharp", "expected_window")
    return not earlier_results.corners and allowed and detector_input.setup.is_line_fit_enabled


def _run_blurred_search(
    detector_input: DetectorInput, prior: DetectionPrior, earlier_results: CornerResults
) -> CornerResults:
    bare = replace(detector_input, hidden_mask=None)
    if prior.expected_corners_px:
        found_corners = find_expected_blurred_marker(
            bare, prior.expected_corners_px, prior.blurred_fit_attempt_index
        )
    else:
        found_corners = find_blurred_marker(bare)
    return replace(earlier_results, corners=refine_photometrically(bare, found_corners))


CORNER_METHODS: tuple[CornerMethod, ...] = (
    CornerMethod(
        name="Edge fit",
        docs_prerequisites="an expected, whole marker with straight sides and cells of at least "
        "2.5 px",
        docs_typical_time="0.7 ms",
        docs_run_condition="the target is expected; after the target was lost, in three of four "
        "images",
        should_run=_should_fit_edges,
        find=_fit_edges,
    ),
    CornerMethod(
        name="Half-size search",
        docs_prerequisites="both markers expected, those in view with sides above 60 px",
        docs_typical_time="5 ms, including the measurement of the markers found",
        docs_run_condition="the edge fit was tried and found no marker",
        should_run=_should_search_half_size_image,
        find=_search_half_size_image,
    ),
    CornerMethod(
        name="Partial-view fit",
        docs_prerequisites="an expected marker with cells of at least 4 px, of which at least "
        "60 % of the cells and four edges are visible",
        docs_typical_time="3 ms for each marker",
        docs_run_condition="the edge fit was tried, and a marker is missing; "
        "not if the half-size search found one",
        should_run=_should_fit_visible_part,
        find=_fit_visible_part,
    ),
    CornerMethod(
        name="Photometric fit",
        docs_prerequisites="a whole marker with sides of at least 7 px, whose corners are known to "
        "within 0.3 times a side",
        docs_typical_time="1.3 ms for each marker",
        docs_run_condition="the edge fit was tried, and no marker's edges suffice: its cells are "
        "smaller than 6 px or than six times the blur; not if the half-size search found one",
        should_run=_needs_photometric_fit,
        find=_run_photometric_fit,
    ),
    CornerMethod(
        name="Cut-view fit",
        docs_prerequisites="a measurement at most 0.5 s old, and small-marker cells of at least "
        "8 px",
        docs_typical_time="7 ms",
        docs_run_condition="nothing was found, and each expected marker may be cut off by the edge "
        "of the image or hidden",
        should_run=_can_target_be_truncated,
        find=_fit_truncated_target,
    ),
    CornerMethod(
        name="Search",
        docs_prerequisites="a marker whose bits can be read",
        docs_typical_time="4 to 9 ms, including the measurement of the markers found",
        docs_run_condition="nothing was found, unless the target was cut off before and still is; "
        "or an expected marker with sides above 13 px is missing; after the target was "
        "lost, in three of four images",
        should_run=_should_search,
        find=_run_search,
    ),
    CornerMethod(
        name="Blurred search",
        docs_prerequisites="a whole marker with sides of at least 7 px that resembles its drawing",
        docs_typical_time="5 to 10 ms",
        docs_run_condition="nothing was found; after the target was lost, in one of four images",
        should_run=_can_target_be_blurred,
        find=_run_blurred_search,
    ),
)
"""The corner methods in the order in which they are tried on each image. With
``detector.refinement: subpix``, only the search is used."""


def find_corners(detector_input: DetectorInput, prior: DetectionPrior) -> CornerResults:
    """Find the markers' corners with each applicable method of `CORNER_METHODS` in turn. Each
    method starts from the results of the methods before it. The result has no corners if no method
    finds a marker.
    """
    found = CornerResults()
    for method in CORNER_METHODS:
        if method.should_run(detector_input, prior, found):
            found = method.find(detector_input, prior, found)
    return found


def detect_markers(
    frame: Frame,
    previous: Detections | None,
    setup: DetectorSetup,
    camera: CameraModel,
    expected_corners_px: Mapping[MarkerName, Array] | None = None,
    frames_without_markers: int | None = None,
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction | None = None,
) -> Detections:
    """Find the target's markers in one frame and measure their corners. A marker that is not found
    is None in the result.

    Args:
        frame: the image and its time. In a frame that consists of two interlaced fields, the
            markers are found in each field, and their corners are averaged.
        previous: detections in the previous frame; None for the first frame.
        setup: the target's markers and the options of the detector.
        camera: camera model, including lens distortion.
        expected_corners_px: corners (4, 2) of each marker in the distorted image, predicted by the
            caller. If None or empty, they are extrapolated from `previous`.
        frames_without_markers: number of successive frames before this one without a marker.
            The kinds of search alternate depending on this number. If None, all kinds of search
            are used.
        measure_marker_to_own_target_distance_m: function that returns a marker's horizontal
            distance, m, from this vehicle's own target. If several targets are in view and no
            corners are expected, the target with the smallest distance is selected. None to select
            a target from the image only.
    """
    prior = make_detection_prior(
        frame,
        previous,
        setup,
        camera,
        expected_corners_px,
        frames_without_markers,
        measure_marker_to_own_target_distance_m,
    )
    if frame.picture_kind == "woven":
        first, second = (
            _detect_with_prior(each, setup, camera, prior) for each in interpolate_fields(frame)
        )
        return add_marker_flow(average_field_detections(first, second), previous)
    return add_marker_flow(_detect_with_prior(frame, setup, camera, prior), previous)


def make_detection_prior(
    frame: Frame,
    previous: Detections | None,
    setup: DetectorSetup,
    camera: CameraModel,
    expected_corners_px: Mapping[MarkerName, Array] | None = None,
    frames_without_markers: int | None = None,
    measure_marker_to_own_target_distance_m: MarkerToOwnTargetDistanceFunction | None = None,
) -> DetectionPrior:
    """Return what is known about the target before its markers are detected in the frame: the
    expected corners, predicted by the caller (`expected_corners_px`) or otherwise extrapolated from
    the `previous` detections; the kinds of search to use; and, from the `previous` detections,
    whether the target was seen recently or truncated, and how far white has grown over black. The
    arguments are those of `detect_markers`."""
    expected_corners_px = (
        dict(expected_corners_px)
        if expected_corners_px
        else extrapolate_corners(previous, frame.t_s)
    )
    search_mode = _choose_search_mode(
        frames_without_markers, bool(expected_corners_px), setup.is_line_fit_enabled
    )
    blurred_fit_attempt_index = None
    if frames_without_markers is not None and search_mode in ("near_expected", "expected_fits"):
        blurred_fit_attempt_index = (frames_without_markers + 2) // 4
    # A part of the target is only recognised at a recently measured position.
    last = {} if previous is None else {d.marker: d.corners_px for d in previous.markers}
    was_recent = (
        previous is not None
        and 0.0 < frame.t_s - previous.t_s <= MAX_TARGET_MEASUREMENT_AGE_TO_TRY_TRUNCATED_FIT_S
    )
    was_recent = was_recent and setup.is_line_fit_enabled and bool(last)
    recently_measured_edge_shift = None if previous is None else previous.edge_shift
    if recently_measured_edge_shift is not None:
        age = recently_measured_edge_shift.age_frames + 1
        recently_measured_edge_shift = (
            replace(recently_measured_edge_shift, age_frames=age)
            if age < _MAX_FRAMES_TO_REUSE_BLOOMING_EDGE_SHIFT
            else None
        )
    return DetectionPrior(
        expected_corners_px=expected_corners_px,
        expected_corners_both_markers_px=add_missing_marker_corners(
            expected_corners_px, setup.small_to_large_side_ratio, camera
        ),
        search_mode=search_mode,
        blurred_fit_attempt_index=blurred_fit_attempt_index,
        was_target_seen_recently=was_recent,
        was_target_truncated_when_last_seen=was_recent
        and not can_complete_marker_be_in_view(last, frame.image.shape),
        recently_measured_edge_shift=recently_measured_edge_shift,
        measure_marker_to_own_target_distance_m=measure_marker_to_own_target_distance_m,
    )


def _detect_with_prior(
    frame: Frame, setup: DetectorSetup, camera: CameraModel, prior: DetectionPrior
) -> Detections:
    hidden_mask = make_hidden_mask(frame, setup.static_hidden_mask)
    image = frame.image if hidden_mask is None else fill_hidden_pixels(frame.image, hidden_mask)
    found = find_corners(DetectorInput(image, hidden_mask, setup, camera), prior)
    found_corners = found.corners
    shifts = (r.removed_edge_shift for r in found_corners.values())
    return Detections(
        frame_index=frame.index,
        t_s=frame.t_s,
        large=_make_detection("large", found_corners, frame.picture_kind),
        small=_make_detection("small", found_corners, frame.picture_kind),
        is_mirrored_marker_seen=found.search_result.is_mirrored_marker_seen and not found_corners,
        target_count=found.search_result.target_count,
        edge_shift=next((each for each in shifts if each is not None), None),
    )


def _choose_search_mode(
    frames_without_markers: int | None, is_target_expected: bool, is_line_fit_enabled: bool
) -> SearchMode:
    """Return the kind of search to use in this frame. `frames_without_markers` is the number of
    successive frames before this one in which no marker was found. The first of these cases that
    applies determines the result:

    - `frames_without_markers` is None: "all", which combines all kinds of search.
    - Line fits are disabled: "whole_sharp", which searches the whole image for a sharp target.
    - A target is expected, and `frames_without_markers` is 0: "near_expected", which searches near
      the expected position for a sharp or blurred target.
    - A target is expected, and `frames_without_markers` is odd: "whole_sharp".
    - A target is expected, and `frames_without_markers` is even: alternately "expected_fits", which
      searches near the expected position for a blurred target only, and "expected_window", which
      searches there for a sharp target only.
    - No target is expected, and `frames_without_markers` is a multiple of
      `DetectorConfig.blurred_every`, but not 0: "whole_blurred", which searches the whole image for
      a blurred target.
    - Otherwise: "whole_sharp".
    """
    if frames_without_markers is None:
        return "all"
    if not is_line_fit_enabled or (is_target_expected and frames_without_markers % 2):
        return "whole_sharp"
    if is_target_expected:
        if frames_without_markers == 0:
            return "near_expected"
        return "expected_fits" if frames_without_markers % 4 else "expected_window"
    # If `frames_without_markers` is 0, something was seen, but not at the expected position.
    every = DetectorConfig.blurred_every
    return (
        "whole_blurred"
        if frames_without_markers and frames_without_markers % every == 0
        else "whole_sharp"
    )


def _is_marker_missing(
    detector_input: DetectorInput,
    found_corners: _FoundCorners,
    expected_corners_px: Mapping[MarkerName, Array],
) -> bool:
    return any(
        name not in found_corners
        and is_inside_image(corners, detector_input.image.shape)
        and side_lengths_px(corners).min() > _MIN_MISSING_MARKER_SIDE_TO_RUN_SEARCH_PX
        and not is_any_marker_part_hidden(detector_input.hidden_mask, corners)
        for name, corners in expected_corners_px.items()
    )


def _refine_found_markers(
    detector_input: DetectorInput, found: MarkerSearchResult
) -> _FoundCorners:
    """Refine the raw corners of the markers that a search found, and return the markers that could
    be measured. If line fits are disabled, subpixel refinement is the only method. Otherwise, these
    methods are used in turn:

    1. The edge fit measures each marker.
    2. If the edge fit fails, or if the marker is truncated or hidden, the partial-view fit measures
       the marker, because a search may mistake the image border for a side. If this fails too, a
       truncated or hidden marker is omitted. Any other marker keeps the corners of the edge fit or,
       if that failed, of subpixel refinement.
    3. The photometric fit measures each marker whose edges are not accurate enough. If there is
       only one marker and its fit fails, it is dropped.
    """
    image, setup = detector_input.image, detector_input.setup
    raw = {name: found.corners_px[name] for name in MARKERS if name in found.corners_px}
    lines = fit_side_lines(detector_input, raw) if setup.is_line_fit_enabled else {}
    found_corners = {
        name: lines.get(name)
        or refine_subpix(image, corners, setup.patterns[name].cells_along_border.cells_per_side)
        for name, corners in raw.items()
    }
    if not setup.is_line_fit_enabled:
        return found_corners
    fitted, small = dict(found_corners), found_corners.get("small")
    for name, r in found_corners.items():
        if r.are_corners_fitted and is_fully_visible(detector_input, r):
            continue
        starts = [r.corners_px]
        if (
            name == "large"
            and not r.are_corners_fitted
            and small is not None
            and small.are_corners_fitted
        ):
            starts.insert(
                0, detector_input.derive_corners_from_other_marker_px(small.corners_px, "large")
            )
        identified_by: IdentificationEvidence = (
            "other_marker" if len(found_corners) == 2 else "bits"
        )
        tried = (
            fit_partly_visible_marker(detector_input, name, start, identified_by)
            for start in starts
        )
        partly = next((found for found in tried if found is not None), None)
        if partly is not None:
            fitted[name] = partly
        elif not is_inside_image(
            r.corners_px, image.shape, MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX
        ) or is_any_marker_part_hidden(detector_input.hidden_mask, r.corners_px, 1.0):
            del fitted[name]
    return refine_photometrically(detector_input, fitted, is_from_search=True)


def _make_detection(
    name: MarkerName, found_corners: _FoundCorners, picture_kind: PictureKind | None
) -> Detection | None:
    r = found_corners.get(name)
    if r is None:
        return None
    interpolated = picture_kind in ("top", "bottom")
    return Detection(
        name,
        r.corners_px,
        r.sigma_px,
        r.are_corners_fitted,
        r.remaining_edge_shift_sigma_px,
        cov_px2=r.cov_px2,
        row_jitter_sigma_px=r.row_jitter_sigma_px,
        horizontal_side_deinterlacing_sigma_px=interpolated_field_edge_sigma_px(
            r.sharpest_side_blur_sigma_px
        )
        if interpolated
        else 0.0,
    )


# --- Motion of the markers from image to image, and their predicted positions ---


_MEAN_OF_FOUR_WEIGHTS: Array = np.full(4, 0.25)
# Older image motion is useless for predicting positions.
_MAX_DETECTION_INTERVAL_TO_USE_MARKER_FLOW_S = 0.25


def extrapolate_corners(previous: Detections | None, t_s: float) -> dict[MarkerName, Array]:
    """Return the corners (4, 2) px of each marker in `previous`, extrapolated to `t_s` with their
    image velocity. Without a recent velocity, the corners stay where they were. Empty if `previous`
    has no markers."""
    if previous is None:
        return {}
    gap_s = t_s - previous.t_s
    moves = 0.0 < gap_s <= _MAX_DETECTION_INTERVAL_TO_USE_MARKER_FLOW_S
    corners: dict[MarkerName, Array] = {}
    for d in previous.markers:
        flow = previous.corner_flow_pxps.get(d.marker)
        corners[d.marker] = d.corners_px + (flow * gap_s if moves and flow is not None else 0)
    return corners


def add_marker_flow(current: Detections, previous: Detections | None) -> Detections:
    """Return `current` with the image velocity, px/s, of its markers' corners since the `previous`
    detections, by finite differences. If only one marker was detected both times, the other one
    gets the mean velocity of that marker's corners. `current` is returned unchanged if no marker
    was detected both times, or if `previous` is None or more than
    `_MAX_DETECTION_INTERVAL_TO_USE_MARKER_FLOW_S` old."""
    if (
        previous is None
        or not 0.0 < current.t_s - previous.t_s <= _MAX_DETECTION_INTERVAL_TO_USE_MARKER_FLOW_S
    ):
        return current
    flow: dict[MarkerName, Array] = {}
    for name in MARKERS:
        a, b = previous.get(name), current.get(name)
        if a is not None and b is not None:
            flow[name] = (b.corners_px - a.corners_px) / (current.t_s - previous.t_s)
    if not flow:
        return current
    mean = _MEAN_OF_FOUR_WEIGHTS @ next(iter(flow.values()))
    return replace(current, corner_flow_pxps=dict.fromkeys(MARKERS, mean) | flow)


# --- Photometric fits for markers that the edge fit measured poorly or missed ---


# With larger cells, a line fit is as accurate as a photometric fit, and faster.
_MIN_CELL_FOR_ACCURATE_LINE_FIT_PX = 6.0
# For this accuracy, a cell must also be wider than this multiple of the blur's standard deviation.
_MIN_CELL_TO_BLUR_RATIO_FOR_ACCURATE_LINE_FIT = 6.0
_MAX_CORNER_MOTION_IN_PHOTOMETRIC_FIT_SIDES = 0.3
# A marker that is located from the other marker may have a larger standard deviation.
_MAX_CORNER_SIGMA_TO_ACCEPT_ONLY_MARKER_SIDES, _MAX_CORNER_SIGMA_TO_ACCEPT_SECOND_MARKER_SIDES = (
    0.06,
    0.12,
)
_DEFAULT_PHOTOMETRIC_INITIAL_BLUR_SIGMA_PX = 1.5
_BLUR_SIGMA_DUE_TO_PIXEL_SAMPLING_PX = 0.37
"""Standard deviation, px, that pixels and interpolation add to the measured blur of a marker's
sides, but not to the blur of its drawing."""
_OTHER_MARKER: dict[MarkerName, MarkerName] = {"large": "small", "small": "large"}


def is_line_fit_accurate(corners: RefinedCorners, pattern: MarkerPattern) -> bool:
    """True if the corners come from an edge fit that is as accurate as a photometric fit. This
    requires cells that are at least 6 px wide, and at least 6 times as wide as the blur."""
    cell_size_px = mean_side_px(corners.corners_px) / pattern.cells_along_border.cells_per_side
    return corners.are_corners_fitted and cell_size_px >= max(
        _MIN_CELL_FOR_ACCURATE_LINE_FIT_PX,
        _MIN_CELL_TO_BLUR_RATIO_FOR_ACCURATE_LINE_FIT * corners.blurriest_side_blur_sigma_px,
    )


def refine_photometrically(
    detector_input: DetectorInput, found_corners: _FoundCorners, is_from_search: bool = False
) -> _FoundCorners:
    """Return `found_corners` with more accurate corners: the marker's drawing is fitted to the
    image for each marker whose edge fit is not accurate enough. If only one marker was found, the
    other one is located from it, and added if the image shows it.

    If the fit of a drawing fails, the marker keeps its corners, with one exception: if
    `is_from_search` is True and it is the only marker, it is dropped. `is_from_search` means that
    the markers were decoded by a search, so no predicted position confirms them.
    """
    image, patterns, better = (
        detector_input.image,
        detector_input.setup.patterns,
        dict(found_corners),
    )
    if "small" in better and "large" not in better:
        large = find_large_marker_around_small(detector_input, better["small"])
        if large is not None:
            better["large"] = large
    for name in MARKERS:
        start = _photometric_start_corners_px(detector_input, name, better)
        if (
            start is None
            or not is_inside_image(start, image.shape)
            or is_any_marker_part_hidden(detector_input.hidden_mask, start)
        ):
            continue
        is_single = _OTHER_MARKER[name] not in better
        max_corner_sigma_sides = (
            _MAX_CORNER_SIGMA_TO_ACCEPT_ONLY_MARKER_SIDES
            if is_single
            else _MAX_CORNER_SIGMA_TO_ACCEPT_SECOND_MARKER_SIDES
        )
        blur_px = _photometric_initial_blur_sigma_px(better.get(name))
        exact = align_marker(
            detector_input,
            name,
            start,
            _MAX_CORNER_MOTION_IN_PHOTOMETRIC_FIT_SIDES,
            blur_px,
            max_corner_sigma_sides,
            is_single,
        )
        if exact is not None:
            better[name] = exact
        elif is_single and is_from_search:
            better.pop(name, None)
        elif name not in better and is_correlated_with_pattern(image, start, patterns[name]):
            better[name] = RefinedCorners(
                start, SIGMA_OF_CORNERS_DERIVED_FROM_OTHER_MARKER_PX, False
            )
    return better


def _photometric_initial_blur_sigma_px(corners: RefinedCorners | None) -> float:
    """Return the standard deviation of the blur, px, at which a photometric fit starts. If lines
    were fitted to the sides in `corners`, it is the blur of the blurriest side without the blur due
    to sampling (its variance is subtracted). Otherwise, or if `corners` is None, it is
    `_DEFAULT_PHOTOMETRIC_INITIAL_BLUR_SIGMA_PX`, which is also the upper limit."""
    if (
        corners is None
        or not corners.are_corners_fitted
        or corners.blurriest_side_blur_sigma_px <= 0.0
    ):
        return _DEFAULT_PHOTOMETRIC_INITIAL_BLUR_SIGMA_PX
    return min(
        math.sqrt(
            max(
                corners.blurriest_side_blur_sigma_px**2 - _BLUR_SIGMA_DUE_TO_PIXEL_SAMPLING_PX**2,
                0.0,
            )
        ),
        _DEFAULT_PHOTOMETRIC_INITIAL_BLUR_SIGMA_PX,
    )


def _photometric_start_corners_px(
    detector_input: DetectorInput, name: MarkerName, found_corners: _FoundCorners
) -> Array | None:
    this, other = found_corners.get(name), found_corners.get(_OTHER_MARKER[name])
    if this is not None:
        if this.cov_px2 is not None:
            # Whatever hides a part of the marker would also disturb the photometric fit.
            return None
        # Small cells only matter if no larger ones were measured.
        enough = is_line_fit_accurate(this, detector_input.setup.patterns[name])
        enough = enough or (name == "small" and other is not None)
        return None if this.are_corners_fitted and enough else this.corners_px
    if name == "small" and other is not None and other.are_corners_fitted:
        return detector_input.derive_corners_from_other_marker_px(other.corners_px, "small")
    return None


# --- Markers at their expected positions, which are only verified, not searched for ---


_MIN_CELL_SIZE_TO_TRY_LINE_FIT_PX = 2.5
_MAX_SMALL_CORNER_MISMATCH_TO_ACCEPT_LARGE_SIDES = 0.12


def fit_side_lines(
    detector_input: DetectorInput,
    start_corners_px: Mapping[MarkerName, Array],
    known_edge_shift: EdgeShiftEstimate | None = None,
) -> _FoundCorners:
    """Fit the four sides of each marker, starting at `start_corners_px` (4, 2) in the distorted
    image, and return the markers whose four sides are straight. The cells are not checked, so a
    result may be a square of any other content.

    All markers are fitted together, because blooming and gamma move all edges of an image by the
    same number of pixels. `known_edge_shift` is how far white has grown over black, px, and its
    standard deviation; if it is None, the growth is measured.
    """
    if not start_corners_px:
        return {}
    rims = [detector_input.setup.patterns[name].cells_along_border for name in start_corners_px]
    raw = np.array(list(start_corners_px.values()))
    fitted = refine_corners_by_lines(
        detector_input.image, raw, rims, detector_input.camera, known_edge_shift
    )
    return {
        name: found
        for name, found in zip(start_corners_px, fitted, strict=True)
        if found is not None
    }


def refine_expected_markers(
    detector_input: DetectorInput,
    expected_corners_px: Mapping[MarkerName, Array],
    known_edge_shift: EdgeShiftEstimate | None = None,
) -> _FoundCorners:
    """Measure the expected markers, with corners (4, 2) px, by edge fits. Return the markers whose
    sides and cells the image confirms.

    A marker is omitted if it is more than 0.85 cells (at most 7 px) from its expected position, if
    it is truncated or hidden, or if its cells are smaller than 2.5 px. `known_edge_shift` is how
    far white has grown over black, px, and its standard deviation; if it is None, the growth is
    measured.
    """
    image, patterns = detector_input.image, detector_input.setup.patterns
    start_corners_px = {
        name: expected_corners_px[name]
        for name in MARKERS
        if name in expected_corners_px
        and is_inside_image(
            expected_corners_px[name], image.shape, MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX
        )
        and side_lengths_px(expected_corners_px[name]).min()
        > _MIN_CELL_SIZE_TO_TRY_LINE_FIT_PX * patterns[name].cells_along_border.cells_per_side
    }
    return {
        name: found
        for name, found in fit_side_lines(
            detector_input, start_corners_px, known_edge_shift
        ).items()
        if is_fully_visible(detector_input, found)
        and has_matching_cells(image, found.corners_px, patterns[name])
    }


def add_partly_visible_markers(
    detector_input: DetectorInput,
    expected_corners_px: Mapping[MarkerName, Array],
    found_corners: _FoundCorners,
    known_edge_shift: EdgeShiftEstimate | None = None,
) -> _FoundCorners:
    """Return the markers in `found_corners`, plus each marker in `expected_corners_px`, (4, 2) px
    each, whose visible part could be fitted.

    If the small marker was found, the large one is expected around it. If only the large marker is
    found, the small one is derived from it and added if the image resembles it. `known_edge_shift`
    is how far white has grown over black at all edges, px, and its standard deviation; if it is
    None, the growth is measured.
    """
    start_corners_px, found_corners = dict(expected_corners_px), dict(found_corners)
    if "small" in found_corners and "large" not in found_corners:
        start_corners_px["large"] = detector_input.derive_corners_from_other_marker_px(
            found_corners["small"].corners_px, "large"
        )
    for name in MARKERS:
        if name in start_corners_px and name not in found_corners:
            partly = fit_partly_visible_marker(
                detector_input, name, start_corners_px[name], "track", known_edge_shift
            )
            if partly is not None:
                found_corners[name] = partly
    if "large" in found_corners and "small" not in found_corners:
        # The small marker is too small for a line fit, but its position follows from the large
        # marker, so an approximate match is enough.
        small_px = detector_input.derive_corners_from_other_marker_px(
            found_corners["large"].corners_px, "small"
        )
        if mean_side_px(small_px) > MIN_MARKER_SIDE_TO_IDENTIFY_PX and is_correlated_with_pattern(
            detector_input.image, small_px, detector_input.setup.patterns["small"]
        ):
            found_corners["small"] = RefinedCorners(
                small_px, SIGMA_OF_CORNERS_DERIVED_FROM_OTHER_MARKER_PX, False
            )
    return found_corners


def find_large_marker_around_small(
    detector_input: DetectorInput, small: RefinedCorners
) -> RefinedCorners | None:
    """Return the large marker around a detected small one, or None if the image does not confirm
    the large marker. The large marker may be partly hidden or truncated."""
    image, pattern = detector_input.image, detector_input.setup.patterns["large"]
    start = detector_input.derive_corners_from_other_marker_px(small.corners_px, "large")
    if not np.isfinite(start).all():
        return None

    def is_centred(large: RefinedCorners) -> bool:
        centre = detector_input.derive_corners_from_other_marker_px(large.corners_px, "small")
        off_px = float(np.abs(centre - small.corners_px).max())
        return off_px <= max(
            _MAX_SMALL_CORNER_MISMATCH_TO_ACCEPT_LARGE_SIDES * mean_side_px(small.corners_px), 1.0
        )

    if is_inside_image(start, image.shape, MIN_EDGE_DISTANCE_FROM_IMAGE_BORDER_PX):
        # The small marker only yields an approximate position, so the fit is repeated from its
        # first result.
        found = fit_side_lines(detector_input, {"large": start}).get("large")
        if found is not None:
            found = fit_side_lines(detector_input, {"large": found.corners_px}).get("large")
        if found is not None:
            start = found.corners_px
            good = is_fully_visible(detector_input, found) and is_centred(found)
            if good and has_mostly_matching_cells(image, start, pattern):
                return found
    partly = fit_partly_visible_marker(detector_input, "large", start, "other_marker")
    return partly if partly and is_centred(partly) else None


# --- Mean of the markers in two fields, at the time halfway between the fields ---


_MAX_MARKER_MOTION_TO_AVERAGE_FIELDS_SIDES = 1.5  # corresponds to 1.9 m/s for the small marker


def average_field_detections(first: Detections, second: Detections) -> Detections:
    """Return the detections of a frame of two interlaced fields, `first` and `second`: the corners
    of each marker are the mean of its corners in the two fields. A marker that moved by more than
    1.5 sides between the fields is not averaged. If any marker can be averaged, markers that cannot
    are omitted. Otherwise, the detections in one field are returned: the first if it shows a
    marker, else the second."""
    averaged: dict[MarkerName, Detection] = {}
    for name in MARKERS:
        one, other = first.get(name), second.get(name)
        if one is None or other is None:
            continue
        offset_px = one.corners_px.mean(axis=0) - other.corners_px.mean(axis=0)
        if float(
            np.linalg.norm(offset_px)
        ) < _MAX_MARKER_MOTION_TO_AVERAGE_FIELDS_SIDES * mean_side_px(one.corners_px):
            averaged[name] = _average_detections(one, other)
    if not averaged:
        alone = first if first.markers else second
        return replace(
            alone,
            is_mirrored_marker_seen=alone.is_mirrored_marker_seen or second.is_mirrored_marker_seen,
        )
    return replace(
        first,
        large=averaged.get("large"),
        small=averaged.get("small"),
        is_mirrored_marker_seen=False,
    )


def _average_detections(first: Detection, second: Detection) -> Detection:

    def half_root_sum_square(one: float, other: float) -> float:
        return float(((one**2 + other**2) / 4.0) ** 0.5)

    cov_px2 = None
    if first.cov_px2 is not None or second.cov_px2 is not None:
        one, other = (
            d.sigma_px**2 * np.eye(8) if d.cov_px2 is None else d.cov_px2 for d in (first, second)
        )
        cov_px2 = (one + other) / 4.0
    return Detection(
        first.marker,
        (first.corners_px + second.corners_px) / 2.0,
        half_root_sum_square(first.sigma_px, second.sigma_px),
        first.are_corners_fitted and second.are_corners_fitted,
        max(first.remaining_edge_shift_sigma_px, second.remaining_edge_shift_sigma_px),
        cov_px2=cov_px2,
        row_jitter_sigma_px=half_root_sum_square(
            first.row_jitter_sigma_px, second.row_jitter_sigma_px
        ),
        horizontal_side_deinterlacing_sigma_px=half_root_sum_square(
            first.horizontal_side_deinterlacing_sigma_px,
            second.horizontal_side_deinterlacing_sigma_px,
        ),
    )
