"""Detect the corners of the target's two markers in a picture.

`CORNER_METHODS` lists the methods that find corners in the order in which they are tried, with the
requirements, cost and use of each; ``docs/corners.md`` shows examples of all.

    frame -> Prior -> CORNER_METHODS, one by one -> CornerFindings -> Detections
             (expected corners, kinds of search)

Corners are (4, 2) px, top left, top right, bottom right, bottom left as printed; (0, 0) is the
centre of the top-left pixel. Each marker's corners have one standard deviation (px) or a covariance
(8, 8) px^2. A marker that no method confirms is None.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig
from perchctl.values import replace
from perchctl.vision.fields import interpolate_fields, interpolated_sigma_px
from perchctl.vision.markers.blurred import align_marker, find_blurred, find_expected_blurred
from perchctl.vision.markers.corners import (
    DERIVED_CORNER_SIGMA_PX,
    RefinedCorners,
    add_missing_marker,
    is_inside_picture,
    mean_side_px,
    refine_subpix,
    side_lengths_px,
)
from perchctl.vision.markers.cut import (
    MAX_CUT_FIT_AGE_S,
    can_be_whole,
    fit_cut_markers,
    is_target_cut,
)
from perchctl.vision.markers.detector import (
    DetectorSetup,
    Picture,
    fill_hidden_pixels,
    is_hidden,
    make_hidden_mask,
)
from perchctl.vision.markers.edge_fit import refine_lines
from perchctl.vision.markers.partial import (
    PICTURE_MARGIN_PX,
    IdentifiedBy,
    fit_partly_visible,
    is_fully_visible,
)
from perchctl.vision.markers.pattern import (
    MIN_MARKER_SIDE_PX,
    Pattern,
    has_matching_cells,
    has_mostly_matching_cells,
    is_correlated_with_pattern,
)
from perchctl.vision.markers.search import FoundMarkers, SearchMode, search, search_half_size
from perchctl.vision.target_selection import OwnTargetOffset
from perchctl.vision.types import (
    MARKERS,
    CameraModel,
    Detection,
    Detections,
    EdgeShift,
    Frame,
    MarkerName,
    PictureKind,
)

_MIN_SEARCHED_SIDE_PX = 13.0  # a search does not find smaller markers
# pictures for which a measured shift of all edges is valid, since light changes slowly
_MAX_EDGE_SHIFT_AGE = 5
_FoundCorners = dict[MarkerName, RefinedCorners]


# --- The methods that find corners, in the order in which they are tried ---


@dataclass(frozen=True, eq=False)
class Prior:
    """Knowledge about the target before a frame is examined.

    Attributes:
        expected: the markers' predicted corners, each (4, 2) px; empty if no target is expected.
        expected_both: `expected`, with a missing marker derived from the other one.
        search_mode: the kinds of search for this frame.
        blur_guess_index: its parity selects the first guess of the blur; None tries all.
        was_recent: a marker was found at most `MAX_CUT_FIT_AGE_S` before this frame; False without
            edge fits.
        was_cut: `was_recent`, and no marker can have been completely in that picture.
        edge_shift: the shift of all edges measured in the last frames; None measures it.
        own: selects one of several targets if none is expected; None uses the picture alone.
    """

    expected: Mapping[MarkerName, Array]
    expected_both: Mapping[MarkerName, Array]
    search_mode: SearchMode
    blur_guess_index: int | None
    was_recent: bool
    was_cut: bool
    edge_shift: EdgeShift | None
    own: OwnTargetOffset | None


@dataclass(frozen=True, eq=False)
class CornerFindings:
    """Results of the methods tried so far: the markers' `corners`, and the result of the last
    `search`."""

    corners: dict[MarkerName, RefinedCorners] = field(default_factory=dict)
    search: FoundMarkers = field(default_factory=FoundMarkers)


@dataclass(frozen=True, eq=False)
class CornerMethod:
    """One method to find corners: a row of `CORNER_METHODS`.

    Attributes:
        name: its heading in ``docs/corners.md``.
        needs: its requirements.
        cost: typical time for a picture of 640x480 on one core.
        used_when: `is_used` in words.
        is_used: function that returns True if the method applies to the picture, the prior and the
            findings so far.
        find: function that returns the findings that replace the previous ones.
    """

    name: str
    needs: str
    cost: str
    used_when: str
    is_used: Callable[[Picture, Prior, CornerFindings], bool]
    find: Callable[[Picture, Prior, CornerFindings], CornerFindings]


def _is_target_expected(picture: Picture, prior: Prior, found: CornerFindings) -> bool:
    return prior.search_mode != "fits" and bool(prior.expected_both) and picture.setup.fits_lines


def _fit_edges(picture: Picture, prior: Prior, found: CornerFindings) -> CornerFindings:
    return replace(
        found, corners=refine_expected_markers(picture, prior.expected_both, prior.edge_shift)
    )


def _is_edge_fit_empty(picture: Picture, prior: Prior, found: CornerFindings) -> bool:
    return _is_target_expected(picture, prior, found) and not found.corners


def _search_half_size(picture: Picture, prior: Prior, found: CornerFindings) -> CornerFindings:
    # If no side was found, a close target has usually moved further than a profile reaches.
    searched = search_half_size(picture, prior.expected_both)
    if searched is None:
        return found
    corners = _refine_found(picture, searched)
    return CornerFindings(corners, searched) if corners else found


def _is_half_size_search_empty(picture: Picture, prior: Prior, found: CornerFindings) -> bool:
    return _is_target_expected(picture, prior, found) and not found.search.corners_px


def _fit_visible_part(picture: Picture, prior: Prior, found: CornerFindings) -> CornerFindings:
    corners = add_partly_visible(picture, prior.expected_both, found.corners, prior.edge_shift)
    return replace(found, corners=corners)


def _needs_photometric_fit(picture: Picture, prior: Prior, found: CornerFindings) -> bool:
    patterns = picture.setup.patterns
    return _is_half_size_search_empty(picture, prior, found) and not any(
        is_line_fit_sufficient(r, patterns[name]) for name, r in found.corners.items()
    )


def _fit_drawing(picture: Picture, prior: Prior, found: CornerFindings) -> CornerFindings:
    return replace(found, corners=improve_corners(picture, found.corners))


def _can_be_cut(picture: Picture, prior: Prior, found: CornerFindings) -> bool:
    if found.corners or not prior.was_recent:
        return False
    return is_target_cut(prior.expected_both, picture.image.shape, picture.hidden)


def _fit_cut_target(picture: Picture, prior: Prior, found: CornerFindings) -> CornerFindings:
    return replace(found, corners=fit_cut_markers(picture, prior.expected))


def _should_search(picture: Picture, prior: Prior, found: CornerFindings) -> bool:
    if prior.search_mode in ("blurred", "fits"):
        return False
    if not found.corners and (
        not prior.was_cut or can_be_whole(prior.expected_both, picture.image.shape)
    ):
        return True
    return _is_marker_missing(picture, found.corners, prior.expected)


def _search(picture: Picture, prior: Prior, found: CornerFindings) -> CornerFindings:
    searched = search(picture, prior.expected, prior.search_mode, prior.own)
    if len(searched.corners_px) < len(found.corners):
        return replace(found, search=searched)
    return CornerFindings(_refine_found(picture, searched), searched)


def _can_be_blurred(picture: Picture, prior: Prior, found: CornerFindings) -> bool:
    allowed = prior.search_mode not in ("sharp", "window")
    return not found.corners and allowed and picture.setup.fits_lines


def _search_blurred(picture: Picture, prior: Prior, found: CornerFindings) -> CornerFindings:
    bare = replace(picture, hidden=None)
    if prior.expected:
        seen = find_expected_blurred(bare, prior.expected, prior.blur_guess_index)
    else:
        seen = find_blurred(bare)
    return replace(found, corners=improve_corners(bare, seen))


CORNER_METHODS: tuple[CornerMethod, ...] = (
    CornerMethod(
        name="Edge fit",
        needs="an expected marker, whole, with cells of 2.5 px and straight sides",
        cost="0.7 ms",
        used_when="the target is expected; after a loss, in three of four pictures",
        is_used=_is_target_expected,
        find=_fit_edges,
    ),
    CornerMethod(
        name="Half-size search",
        needs="both markers expected, those in view with sides above 60 px",
        cost="5 ms, with the measurement of what it finds",
        used_when="the edge fit was tried and found no marker",
        is_used=_is_edge_fit_empty,
        find=_search_half_size,
    ),
    CornerMethod(
        name="Partial-view fit",
        needs="an expected marker with cells of 4 px, 60 % of its cells and four of its edges",
        cost="3 ms for each marker",
        used_when="the edge fit was tried, and a marker is missing; "
        "not if the half-size search found one",
        is_used=_is_half_size_search_empty,
        find=_fit_visible_part,
    ),
    CornerMethod(
        name="Photometric fit",
        needs="a whole marker with sides of 7 px, and corners to within 0.3 sides",
        cost="1.3 ms for each marker",
        used_when="the edge fit was tried, and no marker's edges suffice: its cells are smaller "
        "than 6 px or than six times the blur; not if the half-size search found one",
        is_used=_needs_photometric_fit,
        find=_fit_drawing,
    ),
    CornerMethod(
        name="Cut-view fit",
        needs="a measurement at most 0.5 s old, and small-marker cells of 8 px",
        cost="7 ms",
        used_when="nothing was found, and each expected marker may be cut by the picture or hidden",
        is_used=_can_be_cut,
        find=_fit_cut_target,
    ),
    CornerMethod(
        name="Search",
        needs="a marker whose bits can be read",
        cost="4 to 9 ms, with the measurement of what it finds",
        used_when="nothing was found, unless the target was cut and still is; or an expected "
        "marker with sides above 13 px is missing; after a loss, in three of four pictures",
        is_used=_should_search,
        find=_search,
    ),
    CornerMethod(
        name="Blurred search",
        needs="a whole marker with sides of 7 px that resembles its drawing",
        cost="5 to 10 ms",
        used_when="nothing was found; after a loss, in one of four pictures",
        is_used=_can_be_blurred,
        find=_search_blurred,
    ),
)
"""The methods, tried in this order in each picture. With ``detector.refinement: subpix``, only the
search is used."""


def find_corners(picture: Picture, prior: Prior) -> CornerFindings:
    """Find the markers' corners with each applicable method of `CORNER_METHODS` in turn.

    Each method starts from the findings of the methods before it.
    """
    found = CornerFindings()
    for method in CORNER_METHODS:
        if method.is_used(picture, prior, found):
            found = method.find(picture, prior, found)
    return found


def detect_markers(
    frame: Frame,
    previous: Detections | None,
    setup: DetectorSetup,
    camera: CameraModel,
    expected: Mapping[MarkerName, Array] | None = None,
    empty_frames: int | None = None,
    own: OwnTargetOffset | None = None,
) -> Detections:
    """Find and refine the target's markers in one frame.

    The search starts at the corners (4, 2) px `expected` from the vehicle's motion, or otherwise
    near the `previous` detections. `empty_frames`, the number of successive frames without markers,
    alternates the kinds of search; None applies all kinds. If no target is expected, `own` selects
    one of several. For a frame of two fields, the result is the mean of the fields.
    """
    prior = make_prior(frame, previous, setup, camera, expected, empty_frames, own)
    if frame.fields == "woven":
        first, second = (_detect(each, setup, camera, prior) for each in interpolate_fields(frame))
        return add_marker_flow(average_fields(first, second), previous)
    return add_marker_flow(_detect(frame, setup, camera, prior), previous)


def make_prior(
    frame: Frame,
    previous: Detections | None,
    setup: DetectorSetup,
    camera: CameraModel,
    expected: Mapping[MarkerName, Array] | None = None,
    empty_frames: int | None = None,
    own: OwnTargetOffset | None = None,
) -> Prior:
    """Return the knowledge before the frame; arguments as in `detect_markers`."""
    expected = dict(expected) if expected else extrapolate_corners(previous, frame.t_s)
    search_mode = _choose_search_mode(empty_frames, bool(expected), setup.fits_lines)
    blur_guess_index = None
    if empty_frames is not None and search_mode in ("near", "fits"):
        blur_guess_index = (empty_frames + 2) // 4
    # A part of the target is recognized only at a position measured a short time ago.
    last = {} if previous is None else {d.marker: d.corners_px for d in previous.markers}
    was_recent = previous is not None and 0.0 < frame.t_s - previous.t_s <= MAX_CUT_FIT_AGE_S
    was_recent = was_recent and setup.fits_lines and bool(last)
    shift = None if previous is None else previous.edge_shift
    if shift is not None:
        age = shift.age_frames + 1
        shift = replace(shift, age_frames=age) if age < _MAX_EDGE_SHIFT_AGE else None
    return Prior(
        expected=expected,
        expected_both=add_missing_marker(expected, setup.ratio, camera),
        search_mode=search_mode,
        blur_guess_index=blur_guess_index,
        was_recent=was_recent,
        was_cut=was_recent and not can_be_whole(last, frame.image.shape),
        edge_shift=shift,
        own=own,
    )


def _detect(frame: Frame, setup: DetectorSetup, camera: CameraModel, prior: Prior) -> Detections:
    hidden = make_hidden_mask(frame, setup.mask)
    image = frame.image if hidden is None else fill_hidden_pixels(frame.image, hidden)
    found = find_corners(Picture(image, hidden, setup, camera), prior)
    seen = found.corners
    shifts = (r.edge_shift for r in seen.values())
    return Detections(
        frame_index=frame.index,
        t_s=frame.t_s,
        large=_make_detection("large", seen, frame.fields),
        small=_make_detection("small", seen, frame.fields),
        mirrored=found.search.mirrored and not seen,
        target_count=found.search.target_count,
        edge_shift=next((each for each in shifts if each is not None), None),
    )


def _choose_search_mode(empty_frames: int | None, expected: bool, fits_lines: bool) -> SearchMode:
    """Return the kind of search for this frame. After a loss, the kinds alternate."""
    if empty_frames is None:
        return "all"
    if not fits_lines or (expected and empty_frames % 2):
        return "sharp"
    if expected:
        if empty_frames == 0:
            return "near"
        return "fits" if empty_frames % 4 else "window"
    # At 0, something was seen, but not at the expected position.
    every = DetectorConfig.blurred_every
    return "blurred" if empty_frames and empty_frames % every == 0 else "sharp"


def _is_marker_missing(
    picture: Picture, seen: _FoundCorners, expected: Mapping[MarkerName, Array]
) -> bool:
    return any(
        name not in seen
        and is_inside_picture(corners, picture.image.shape)
        and side_lengths_px(corners).min() > _MIN_SEARCHED_SIDE_PX
        and not is_hidden(picture.hidden, corners)
        for name, corners in expected.items()
    )


def _refine_found(picture: Picture, found: FoundMarkers) -> _FoundCorners:
    """Measure the raw corners of a search: by the edge fit, otherwise by subpixel refinement.
    Markers that are not completely in view are measured by the partial-view fit because a search
    takes the picture's edge for a side. The photometric fit follows where edges do not suffice."""
    image, setup = picture.image, picture.setup
    raw = {name: found.corners_px[name] for name in MARKERS if name in found.corners_px}
    lines = fit_lines(picture, raw) if setup.fits_lines else {}
    seen = {
        name: lines.get(name) or refine_subpix(image, corners, setup.patterns[name].rim.cells)
        for name, corners in raw.items()
    }
    if not setup.fits_lines:
        return seen
    fitted, small = dict(seen), seen.get("small")
    for name, r in seen.items():
        if r.refined and is_fully_visible(picture, r):
            continue
        starts = [r.corners_px]
        if name == "large" and not r.refined and small is not None and small.refined:
            starts.insert(0, picture.other_corners(small.corners_px, "large"))
        identified_by: IdentifiedBy = "other" if len(seen) == 2 else "bits"
        tried = (fit_partly_visible(picture, name, start, identified_by) for start in starts)
        partly = next((found for found in tried if found is not None), None)
        if partly is not None:
            fitted[name] = partly
        elif not is_inside_picture(r.corners_px, image.shape, PICTURE_MARGIN_PX) or is_hidden(
            picture.hidden, r.corners_px, 1.0
        ):
            del fitted[name]
    return improve_corners(picture, fitted, searched=True)


def _make_detection(
    name: MarkerName, seen: _FoundCorners, fields: PictureKind | None
) -> Detection | None:
    r = seen.get(name)
    if r is None:
        return None
    interpolated = fields in ("top", "bottom")
    return Detection(
        name,
        r.corners_px,
        r.sigma_px,
        r.refined,
        r.shift_sigma_px,
        cov_px2=r.cov_px2,
        row_sigma_px=r.row_sigma_px,
        horizontal_side_sigma_px=interpolated_sigma_px(r.min_blur_px) if interpolated else 0.0,
    )


# --- Motion of the markers from picture to picture, and their predicted positions ---


_MEAN_OF_FOUR: Array = np.full(4, 0.25)
_MAX_FLOW_AGE_S = 0.25  # older motion does not predict positions


def extrapolate_corners(previous: Detections | None, t_s: float) -> dict[MarkerName, Array]:
    """Return the corners (4, 2) px in `previous`, extrapolated to `t_s` by their flow; may be
    empty."""
    if previous is None:
        return {}
    gap_s = t_s - previous.t_s
    moves = 0.0 < gap_s <= _MAX_FLOW_AGE_S
    corners: dict[MarkerName, Array] = {}
    for d in previous.markers:
        flow = previous.flow_px_s.get(d.marker)
        corners[d.marker] = d.corners_px + (flow * gap_s if moves and flow is not None else 0)
    return corners


def add_marker_flow(now: Detections, previous: Detections | None) -> Detections:
    """Return `now` with the image velocity, px/s, of its markers' corners since `previous`."""
    if previous is None or not 0.0 < now.t_s - previous.t_s <= _MAX_FLOW_AGE_S:
        return now
    flow: dict[MarkerName, Array] = {}
    for name in MARKERS:
        a, b = previous.get(name), now.get(name)
        if a is not None and b is not None:
            flow[name] = (b.corners_px - a.corners_px) / (now.t_s - previous.t_s)
    if not flow:
        return now
    mean = _MEAN_OF_FOUR @ next(iter(flow.values()))
    return replace(now, flow_px_s=dict.fromkeys(MARKERS, mean) | flow)


# --- Photometric fits for markers that the edge fit measured poorly or missed ---


_MIN_ACCURATE_CELL_PX = 6.0  # from this size on, lines are as accurate as the drawing, and faster
# the same limit as a ratio of a cell's width to the blur's standard deviation
_MIN_ACCURATE_CELL_BLURS = 6.0
_ALIGN_RANGE = 0.3  # share of the side
# A marker whose position follows from the other one may have a larger standard deviation.
_MAX_UNTRACKED_SIGMA, _MAX_TRACKED_SIGMA = 0.06, 0.12  # share of the side
_DEFAULT_BLUR_PX = 1.5  # initial guess if the blur is unknown
_SIDE_BLUR_SIGMA_PX = 0.37
"""Standard deviation that pixels and interpolation add to the blur of sides but not to that of a
drawing, px."""
_OTHER_MARKER: dict[MarkerName, MarkerName] = {"large": "small", "small": "large"}


def is_line_fit_sufficient(seen: RefinedCorners, pattern: Pattern) -> bool:
    """True if a marker's edge fit is as accurate as a photometric fit would be: with cells of at
    least 6 px and 6 times the blur."""
    cell_px = mean_side_px(seen.corners_px) / pattern.rim.cells
    return seen.refined and cell_px >= max(
        _MIN_ACCURATE_CELL_PX, _MIN_ACCURATE_CELL_BLURS * seen.blur_px
    )


def improve_corners(picture: Picture, seen: _FoundCorners, searched: bool = False) -> _FoundCorners:
    """Return the `seen` markers, with a photometric fit of those whose edges do not suffice, and
    any other visible marker derived from the first. If `searched`, a single marker is dropped
    unless its edges suffice or the drawing confirms it."""
    image, patterns, better = picture.image, picture.setup.patterns, dict(seen)
    if "small" in better and "large" not in better:
        large = find_large_around(picture, better["small"])
        if large is not None:
            better["large"] = large
    for name in MARKERS:
        start = _initial_corners(picture, name, better)
        if (
            start is None
            or not is_inside_picture(start, image.shape)
            or is_hidden(picture.hidden, start)
        ):
            continue
        alone = _OTHER_MARKER[name] not in better
        max_sigma = _MAX_UNTRACKED_SIGMA if alone else _MAX_TRACKED_SIGMA
        blur_px = _blur_px(better.get(name))
        exact = align_marker(picture, name, start, _ALIGN_RANGE, blur_px, max_sigma, alone)
        if exact is not None:
            better[name] = exact
        elif alone and searched:
            better.pop(name, None)
        elif name not in better and is_correlated_with_pattern(image, start, patterns[name]):
            better[name] = RefinedCorners(start, DERIVED_CORNER_SIGMA_PX, False)
    return better


def _blur_px(seen: RefinedCorners | None) -> float:
    """Return the first guess of the blur's standard deviation, px: that of the sides if lines were
    fitted."""
    if seen is None or not seen.refined or seen.blur_px <= 0.0:
        return _DEFAULT_BLUR_PX
    return min(math.sqrt(max(seen.blur_px**2 - _SIDE_BLUR_SIGMA_PX**2, 0.0)), _DEFAULT_BLUR_PX)


def _initial_corners(picture: Picture, name: MarkerName, seen: _FoundCorners) -> Array | None:
    this, other = seen.get(name), seen.get(_OTHER_MARKER[name])
    if this is not None:
        if this.cov_px2 is not None:
            return None  # an obstacle in front of the marker would spoil the drawing, too
        # Small cells matter only if no larger ones were measured.
        enough = is_line_fit_sufficient(this, picture.setup.patterns[name])
        enough = enough or (name == "small" and other is not None)
        return None if this.refined and enough else this.corners_px
    if name == "small" and other is not None and other.refined:
        return picture.other_corners(other.corners_px, "small")
    return None


# --- Markers at their expected positions: no search, only verification ---


_MIN_LINE_CELL_PX = 2.5  # least cell size for line fits
_MAX_CENTRE_OFFSET = 0.12  # share of the small marker's side


def fit_lines(
    picture: Picture, places: Mapping[MarkerName, Array], shift: EdgeShift | None = None
) -> _FoundCorners:
    """Return the markers near corners `places` (4, 2) px whose four sides are straight edges, by
    `refine_lines`: all at once because they share the shift of all edges. The cells are not
    examined. `shift` None measures the shift of all edges."""
    if not places:
        return {}
    rims = [picture.setup.patterns[name].rim for name in places]
    raw = np.array(list(places.values()))
    fitted = refine_lines(picture.image, raw, rims, picture.camera, shift)
    return {name: found for name, found in zip(places, fitted, strict=True) if found is not None}


def refine_expected_markers(
    picture: Picture, expected: Mapping[MarkerName, Array], shift: EdgeShift | None = None
) -> _FoundCorners:
    """Return the expected markers, corners (4, 2) px, whose sides and cells the picture confirms,
    measured by edge fits. Markers beyond the reach of the profiles (0.85 cells, at most 7 px), cut
    or hidden markers, and markers with cells below 2.5 px are omitted."""
    image, patterns = picture.image, picture.setup.patterns
    places = {
        name: expected[name]
        for name in MARKERS
        if name in expected
        and is_inside_picture(expected[name], image.shape, PICTURE_MARGIN_PX)
        and side_lengths_px(expected[name]).min() > _MIN_LINE_CELL_PX * patterns[name].rim.cells
    }
    return {
        name: found
        for name, found in fit_lines(picture, places, shift).items()
        if is_fully_visible(picture, found)
        and has_matching_cells(image, found.corners_px, patterns[name])
    }


def add_partly_visible(
    picture: Picture,
    expected: Mapping[MarkerName, Array],
    seen: _FoundCorners,
    shift: EdgeShift | None = None,
) -> _FoundCorners:
    """Return the `seen` markers of `refine_expected_markers` plus those fitted to their visible
    part.

    If the small marker was seen, the large one is expected around it.
    """
    places, seen = dict(expected), dict(seen)
    if "small" in seen and "large" not in seen:
        places["large"] = picture.other_corners(seen["small"].corners_px, "large")
    for name in MARKERS:
        if name in places and name not in seen:
            partly = fit_partly_visible(picture, name, places[name], "track", shift)
            if partly is not None:
                seen[name] = partly
    if "large" in seen and "small" not in seen:
        # Too small for lines, but its position follows from the large marker: a similar pattern is
        # enough.
        small_px = picture.other_corners(seen["large"].corners_px, "small")
        if mean_side_px(small_px) > MIN_MARKER_SIDE_PX and is_correlated_with_pattern(
            picture.image, small_px, picture.setup.patterns["small"]
        ):
            seen["small"] = RefinedCorners(small_px, DERIVED_CORNER_SIGMA_PX, False)
    return seen


def find_large_around(picture: Picture, small: RefinedCorners) -> RefinedCorners | None:
    """Return the large marker around a detected small one; the large one may be partly covered or
    cut. None if the picture does not confirm it."""
    image, pattern = picture.image, picture.setup.patterns["large"]
    start = picture.other_corners(small.corners_px, "large")
    if not np.isfinite(start).all():
        return None

    def is_centred(large: RefinedCorners) -> bool:
        centre = picture.other_corners(large.corners_px, "small")
        off_px = float(np.abs(centre - small.corners_px).max())
        return off_px <= max(_MAX_CENTRE_OFFSET * mean_side_px(small.corners_px), 1.0)

    if is_inside_picture(start, image.shape, PICTURE_MARGIN_PX):
        # A small marker yields a rough position only, so the fit is repeated from the first result.
        found = fit_lines(picture, {"large": start}).get("large")
        if found is not None:
            found = fit_lines(picture, {"large": found.corners_px}).get("large")
        if found is not None:
            start = found.corners_px
            good = is_fully_visible(picture, found) and is_centred(found)
            if good and has_mostly_matching_cells(image, start, pattern):
                return found
    partly = fit_partly_visible(picture, "large", start, "other")
    return partly if partly and is_centred(partly) else None


# --- Mean of the markers in two fields, at the time half way between them ---


_MAX_FIELD_MOTION_SIDES = 1.5  # of the marker: the small one at 1.9 m/s


def average_fields(first: Detections, second: Detections) -> Detections:
    """Return the mean of both fields' corners, valid for either order of the fields. If one marker
    is in both fields, a marker in only one field is omitted."""
    averaged: dict[MarkerName, Detection] = {}
    for name in MARKERS:
        one, other = first.get(name), second.get(name)
        if one is None or other is None:
            continue
        offset_px = one.corners_px.mean(axis=0) - other.corners_px.mean(axis=0)
        if float(np.linalg.norm(offset_px)) < _MAX_FIELD_MOTION_SIDES * mean_side_px(
            one.corners_px
        ):
            averaged[name] = _average_detections(one, other)
    if not averaged:
        alone = first if first.markers else second
        return replace(alone, mirrored=alone.mirrored or second.mirrored)
    return replace(first, large=averaged.get("large"), small=averaged.get("small"), mirrored=False)


def _average_detections(a: Detection, b: Detection) -> Detection:

    def half(one: float, other: float) -> float:
        return float(((one**2 + other**2) / 4.0) ** 0.5)

    cov_px2 = None
    if a.cov_px2 is not None or b.cov_px2 is not None:
        one, other = (d.sigma_px**2 * np.eye(8) if d.cov_px2 is None else d.cov_px2 for d in (a, b))
        cov_px2 = (one + other) / 4.0
    return Detection(
        a.marker,
        (a.corners_px + b.corners_px) / 2.0,
        half(a.sigma_px, b.sigma_px),
        a.refined and b.refined,
        max(a.shift_sigma_px, b.shift_sigma_px),
        cov_px2=cov_px2,
        row_sigma_px=half(a.row_sigma_px, b.row_sigma_px),
        horizontal_side_sigma_px=half(a.horizontal_side_sigma_px, b.horizontal_side_sigma_px),
    )
