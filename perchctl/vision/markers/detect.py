"""Finding the two markers of the target in a picture: the steps of a frame, in order.

1. where they are expected, by verification instead of search (`follow_markers`);
2. where the picture cuts them, by what is left of the drawing (`cut`);
3. by a search in a window around that place, then in the whole picture (`search`);
4. where blur may hide them (`blurred`).

A marker of which a part is hidden is measured by what is seen of it (`partial`). Each step takes
place within the same frame, and only where the one before saw too little.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig
from perchctl.values import replace
from perchctl.vision.fields import field_frames, interpolated_sigma_px
from perchctl.vision.markers.blurred import align_marker, find_blurred, find_expected_blurred
from perchctl.vision.markers.corners import (
    NESTED_SIGMA_PX,
    RefinedCorners,
    mean_side_px,
    refine_subpix,
    side_lengths_px,
    with_missing_marker,
    within,
)
from perchctl.vision.markers.cut import MOST_AGE_S, fit_cut_markers, is_target_cut, may_be_whole
from perchctl.vision.markers.detector import (
    DetectorSetup,
    Picture,
    fill_hidden,
    hidden_area,
    is_hidden,
)
from perchctl.vision.markers.edge_fit import refine_lines
from perchctl.vision.markers.partial import ROOM_PX, KnownBy, fit_partly_seen, is_wholly_seen
from perchctl.vision.markers.pattern import (
    LEAST_SIDE_PX,
    Pattern,
    cells_agree,
    cells_mostly_agree,
    fits_pattern,
)
from perchctl.vision.markers.search import FoundMarkers, Look, search, search_halved
from perchctl.vision.target_selection import OwnOffset
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

_SEARCHED_SIDE_PX = 13.0  # smaller markers are not found by a search
_SHIFT_PICTURES = 5  # for which a measured shift of all edges holds: light changes slowly
_Found = dict[MarkerName, RefinedCorners]


def detect_markers(
    frame: Frame,
    previous: Detections | None,
    setup: DetectorSetup,
    camera: CameraModel,
    expected: Mapping[MarkerName, Array] | None = None,
    empty_frames: int | None = None,
    own: OwnOffset | None = None,
) -> Detections:
    """Find and refine the target's markers in one frame.

    The search begins at the corners (4, 2) px `expected` by the vehicle's motion, or else near the
    `previous` detections. `empty_frames`, the number of frames in a row without markers, alternates
    the kinds of search; None: all kinds. If no target is expected, `own` chooses among several. For
    a frame of two fields the result is the fields' mean."""
    expected = dict(expected) if expected else predicted_corners(previous, frame.t_s)
    both = with_missing_marker(expected, setup.ratio, camera)
    look = _look(empty_frames, bool(expected), setup.fits_lines)
    turn = None
    if empty_frames is not None and look in ("near", "fits"):
        turn = (empty_frames + 2) // 4
    # A part of the target is known again where it was measured a short time ago.
    last = {} if previous is None else {d.marker: d.corners_px for d in previous.markers}
    lately = previous is not None and 0.0 < frame.t_s - previous.t_s <= MOST_AGE_S
    lately = lately and setup.fits_lines and bool(last)
    was_cut = lately and not may_be_whole(last, frame.image.shape)
    shift = None if previous is None else previous.edge_shift
    if shift is not None:
        age = shift.age + 1
        shift = replace(shift, age=age) if age < _SHIFT_PICTURES else None

    def detected(frame: Frame) -> Detections:
        hidden = hidden_area(frame, setup.mask)
        image = frame.image if hidden is None else fill_hidden(frame.image, hidden)
        picture, found = Picture(image, hidden, setup, camera), FoundMarkers()
        seen: _Found = {}
        if look != "fits" and both and setup.fits_lines:
            seen, found = _followed(picture, both, shift)
        if not seen and lately and is_target_cut(both, image.shape, hidden):
            seen = fit_cut_markers(picture, expected)
        findable = not was_cut or may_be_whole(both, image.shape)
        if look not in ("blurred", "fits") and (
            (not seen and findable) or _missing(picture, seen, expected)
        ):
            found = search(picture, expected, look, own)
            if len(found.corners_px) >= len(seen):
                seen = _refined(picture, found)
        if not seen and look not in ("sharp", "window") and setup.fits_lines:
            bare = replace(picture, hidden=None)
            seen = find_expected_blurred(bare, expected, turn) if expected else find_blurred(bare)
            seen = improve_corners(bare, seen)
        shifts = (r.edge_shift for r in seen.values())
        return Detections(
            frame_index=frame.index,
            t_s=frame.t_s,
            large=_detection("large", seen, frame.fields),
            small=_detection("small", seen, frame.fields),
            mirrored=found.mirrored and not seen,
            targets=found.targets,
            edge_shift=next((each for each in shifts if each is not None), None),
        )

    if frame.fields == "woven":
        return add_marker_flow(mean_of_fields(*map(detected, field_frames(frame))), previous)
    return add_marker_flow(detected(frame), previous)


def _look(empty_frames: int | None, expected: bool, fits_lines: bool) -> Look:
    """Return how to search this frame. After a loss the ways take turns."""
    if empty_frames is None:
        return "all"
    if not fits_lines or (expected and empty_frames % 2):
        return "sharp"
    if expected:
        if empty_frames == 0:
            return "near"
        return "fits" if empty_frames % 4 else "window"
    # At 0 something was seen, though not where the target should be.
    every = DetectorConfig.blurred_every
    return "blurred" if empty_frames and empty_frames % every == 0 else "sharp"


def _followed(
    picture: Picture, expected: Mapping[MarkerName, Array], shift: EdgeShift | None
) -> tuple[_Found, FoundMarkers]:
    """Return what is where both are expected, or nearby: where no side was met, a near target has
    most often moved on further than a side is looked for."""
    seen = follow_markers(picture, expected, shift)
    if not seen:
        found = search_halved(picture, expected)
        again = {} if found is None else _refined(picture, found)
        if found is not None and again:
            return again, found
    seen = add_partly_visible(picture, expected, seen, shift)
    if any(lines_suffice(r, picture.setup.patterns[name]) for name, r in seen.items()):
        return seen, FoundMarkers()
    return improve_corners(picture, seen), FoundMarkers()


def _missing(picture: Picture, seen: _Found, expected: Mapping[MarkerName, Array]) -> bool:
    return any(
        name not in seen
        and within(corners, picture.image.shape)
        and side_lengths_px(corners).min() > _SEARCHED_SIDE_PX
        and not is_hidden(picture.hidden, corners)
        for name, corners in expected.items()
    )


def _refined(picture: Picture, found: FoundMarkers) -> _Found:
    """Return what the search found with better corners.

    Those without four lines for sides are measured by what of these is seen: a search takes the
    picture's edge for a side.
    """
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
        if r.refined and is_wholly_seen(picture, r):
            continue
        starts = [r.corners_px]
        if name == "large" and not r.refined and small is not None and small.refined:
            starts.insert(0, picture.other_corners(small.corners_px, "large"))
        known_by: KnownBy = "other" if len(seen) == 2 else "bits"
        tried = (fit_partly_seen(picture, name, start, known_by) for start in starts)
        partly = next((found for found in tried if found is not None), None)
        if partly is not None:
            fitted[name] = partly
        elif not within(r.corners_px, image.shape, ROOM_PX) or is_hidden(
            picture.hidden, r.corners_px, 1.0
        ):
            del fitted[name]
    return improve_corners(picture, fitted, searched=True)


def _detection(name: MarkerName, seen: _Found, fields: PictureKind | None) -> Detection | None:
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
        lying_sigma_px=interpolated_sigma_px(r.least_blur_px) if interpolated else 0.0,
    )


# --- How the markers move from picture to picture, and where that leads them ---


_QUARTERS: Array = np.full(4, 0.25)
_MAX_GAP_S = 0.25  # older motion is no evidence of where to look


def predicted_corners(previous: Detections | None, t_s: float) -> dict[MarkerName, Array]:
    """The corners (4, 2) px in `previous`, extrapolated to `t_s` by their flow; may be empty."""
    if previous is None:
        return {}
    gap_s = t_s - previous.t_s
    moves = 0.0 < gap_s <= _MAX_GAP_S
    corners: dict[MarkerName, Array] = {}
    for d in previous.markers:
        flow = previous.flow_px_s.get(d.marker)
        corners[d.marker] = d.corners_px + (flow * gap_s if moves and flow is not None else 0)
    return corners


def add_marker_flow(now: Detections, previous: Detections | None) -> Detections:
    """Return `now` with the image velocity, px/s, of its markers' corners since `previous`."""
    if previous is None or not 0.0 < now.t_s - previous.t_s <= _MAX_GAP_S:
        return now
    flow: dict[MarkerName, Array] = {}
    for name in MARKERS:
        a, b = previous.get(name), now.get(name)
        if a is not None and b is not None:
            flow[name] = (b.corners_px - a.corners_px) / (now.t_s - previous.t_s)
    if not flow:
        return now
    mean = _QUARTERS @ next(iter(flow.values()))
    return replace(now, flow_px_s=dict.fromkeys(MARKERS, mean) | flow)


# --- What lines left vague or unseen, by the drawing ---


_GOOD_CELL_PX = 6.0  # from here on, lines are as exact as the drawing, and faster
_GOOD_BLURS = 6.0  # a cell's width over the blur's sigma, likewise
_REACH = 0.3  # of the side
# Where the other marker shows that it must be there, it may be vague.
_MAX_SIGMA_ALONE, _MAX_SIGMA = 0.06, 0.12  # of the side
_BLUR_PX = 1.5  # to start with, where it is not known
_ACROSS_PX = 0.37
"""Sigma: sides have the width of pixels and of reading them in their blur, a drawing has not."""
_OTHER: dict[MarkerName, MarkerName] = {"large": "small", "small": "large"}


def lines_suffice(seen: RefinedCorners, pattern: Pattern) -> bool:
    """True if a marker's line fits are accurate enough without a photometric fit."""
    cell_px = mean_side_px(seen.corners_px) / pattern.rim.cells
    return seen.refined and cell_px >= max(_GOOD_CELL_PX, _GOOD_BLURS * seen.blur_px)


def improve_corners(picture: Picture, seen: _Found, searched: bool = False) -> _Found:
    """The `seen` markers with better corners, and any other visible marker. If
    `searched`, a lone marker is dropped unless its lines suffice or the drawing confirms it."""
    image, patterns, better = picture.image, picture.setup.patterns, dict(seen)
    if "small" in better and "large" not in better:
        large = large_around(picture, better["small"])
        if large is not None:
            better["large"] = large
    for name in MARKERS:
        start = _start(picture, name, better)
        if start is None or not within(start, image.shape) or is_hidden(picture.hidden, start):
            continue
        alone = _OTHER[name] not in better
        max_sigma = _MAX_SIGMA_ALONE if alone else _MAX_SIGMA
        blur_px = _blur_px(better.get(name))
        exact = align_marker(picture, name, start, _REACH, blur_px, max_sigma, alone)
        if exact is not None:
            better[name] = exact
        elif alone and searched:
            better.pop(name, None)
        elif name not in better and fits_pattern(image, start, patterns[name]):
            better[name] = RefinedCorners(start, NESTED_SIGMA_PX, False)
    return better


def _blur_px(seen: RefinedCorners | None) -> float:
    """The blur to start with: of the sides, where lines were fitted."""
    if seen is None or not seen.refined or seen.blur_px <= 0.0:
        return _BLUR_PX
    return min(math.sqrt(max(seen.blur_px**2 - _ACROSS_PX**2, 0.0)), _BLUR_PX)


def _start(picture: Picture, name: MarkerName, seen: _Found) -> Array | None:
    this, other = seen.get(name), seen.get(_OTHER[name])
    if this is not None:
        if this.cov_px2 is not None:
            return None  # what hides a part of it would spoil the drawing, too
        # Small cells matter only where no larger ones were measured.
        enough = lines_suffice(this, picture.setup.patterns[name])
        enough = enough or (name == "small" and other is not None)
        return None if this.refined and enough else this.corners_px
    if name == "small" and other is not None and other.refined:
        return picture.other_corners(other.corners_px, "small")
    return None


# --- Markers where they are expected: no search, only verification ---


_LEAST_CELL_PX = 2.5  # for lines
_ANCHOR = 0.12  # of the small marker's side


def fit_lines(
    picture: Picture, places: Mapping[MarkerName, Array], shift: EdgeShift | None = None
) -> _Found:
    """Return the markers near corners `places` (4, 2) px whose sides are straight edges."""
    if not places:
        return {}
    rims = [picture.setup.patterns[name].rim for name in places]
    raw = np.array(list(places.values()))
    fitted = refine_lines(picture.image, raw, rims, picture.camera, shift)
    return {name: found for name, found in zip(places, fitted, strict=True) if found is not None}


def follow_markers(
    picture: Picture, expected: Mapping[MarkerName, Array], shift: EdgeShift | None = None
) -> _Found:
    """The expected markers whose sides and cells are all confirmed in the picture."""
    image, patterns = picture.image, picture.setup.patterns
    places = {
        name: expected[name]
        for name in MARKERS
        if name in expected
        and within(expected[name], image.shape, ROOM_PX)
        and side_lengths_px(expected[name]).min() > _LEAST_CELL_PX * patterns[name].rim.cells
    }
    return {
        name: found
        for name, found in fit_lines(picture, places, shift).items()
        if is_wholly_seen(picture, found) and cells_agree(image, found.corners_px, patterns[name])
    }


def add_partly_visible(
    picture: Picture,
    expected: Mapping[MarkerName, Array],
    seen: _Found,
    shift: EdgeShift | None = None,
) -> _Found:
    """The `seen` markers of `follow_markers` plus those fitted to their visible part.

    If the small marker was seen, the large one is expected around it.
    """
    places, seen = dict(expected), dict(seen)
    if "small" in seen and "large" not in seen:
        places["large"] = picture.other_corners(seen["small"].corners_px, "large")
    for name in MARKERS:
        if name in places and name not in seen:
            partly = fit_partly_seen(picture, name, places[name], "track", shift)
            if partly is not None:
                seen[name] = partly
    if "large" in seen and "small" not in seen:
        # Too small for lines, but where it must be: enough to know that it is there.
        small_px = picture.other_corners(seen["large"].corners_px, "small")
        if mean_side_px(small_px) > LEAST_SIDE_PX and fits_pattern(
            picture.image, small_px, picture.setup.patterns["small"]
        ):
            seen["small"] = RefinedCorners(small_px, NESTED_SIGMA_PX, False)
    return seen


def large_around(picture: Picture, small: RefinedCorners) -> RefinedCorners | None:
    """The large marker around a detected small one; the large one may be partly covered or
    cut off. None if the picture does not confirm it."""
    image, pattern = picture.image, picture.setup.patterns["large"]
    start = picture.other_corners(small.corners_px, "large")
    if not np.isfinite(start).all():
        return None

    def is_centred(large: RefinedCorners) -> bool:
        centre = picture.other_corners(large.corners_px, "small")
        off_px = float(np.abs(centre - small.corners_px).max())
        return off_px <= max(_ANCHOR * mean_side_px(small.corners_px), 1.0)

    if within(start, image.shape, ROOM_PX):
        # A small marker gives a rough place; the first fit is where to look closely.
        found = fit_lines(picture, {"large": start}).get("large")
        if found is not None:
            found = fit_lines(picture, {"large": found.corners_px}).get("large")
        if found is not None:
            start = found.corners_px
            good = is_wholly_seen(picture, found) and is_centred(found)
            if good and cells_mostly_agree(image, start, pattern):
                return found
    partly = fit_partly_seen(picture, "large", start, "other")
    return partly if partly and is_centred(partly) else None


# --- The markers of two fields, at the moment half way between them ---


_MOST_SIDES = 1.5  # of the marker: the small one at 1.9 m/s


def mean_of_fields(first: Detections, second: Detections) -> Detections:
    """The mean of both fields' corners, valid for either order of the fields. If one marker
    is in both fields, a marker in only one field is left out."""
    both: dict[MarkerName, Detection] = {}
    for name in MARKERS:
        one, other = first.get(name), second.get(name)
        if one is None or other is None:
            continue
        way_px = one.corners_px.mean(axis=0) - other.corners_px.mean(axis=0)
        if float(np.linalg.norm(way_px)) < _MOST_SIDES * mean_side_px(one.corners_px):
            both[name] = _middle(one, other)
    if not both:
        alone = first if first.markers else second
        return replace(alone, mirrored=alone.mirrored or second.mirrored)
    return replace(first, large=both.get("large"), small=both.get("small"), mirrored=False)


def _middle(a: Detection, b: Detection) -> Detection:

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
        lying_sigma_px=half(a.lying_sigma_px, b.lying_sigma_px),
    )
