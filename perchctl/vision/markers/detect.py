"""Finding the two markers of the target in a picture: the steps of a frame, in order.

1. where they are expected, by verification instead of search (`follow`);
2. where the picture cuts them, by what is left of the drawing (`cut`);
3. by a search in a window around that place, then in the whole picture (`search`);
4. where blur may hide them (`blurred`).

A marker of which the picture's edge, light that glares, or the vehicle's own gear (`detector`)
hides a part is measured by what is seen of it (`edge_fit`). Each step takes place within the same
frame, and only where the one before saw too little.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.values import replace
from perchctl.vision.fields import halves, interpolated_sigma_px
from perchctl.vision.markers.blurred import ACROSS_PX, aligned, expected_in_blur, hidden_in_blur
from perchctl.vision.markers.cells import KnownBy, cells_agree, resembles
from perchctl.vision.markers.corners import (
    NESTED_SIGMA_PX,
    RAW_SIGMA_PX,
    RefinedCorners,
    completed,
    mean_side_px,
    nested,
    refine_each,
    shortest_side_px,
    side_lengths_px,
    within,
)
from perchctl.vision.markers.cut import (
    cut_lately,
    cut_markers,
    is_cut,
    may_be_whole,
    measured_lately,
)
from perchctl.vision.markers.detector import Covered, DetectorSetup, filled, hidden_in, hides
from perchctl.vision.markers.edge_fit import ROOM_PX, refine_by_edges
from perchctl.vision.markers.pattern import LEAST_SIDE_PX, Pattern
from perchctl.vision.markers.search import Found, Look, search, search_halved
from perchctl.vision.target_selection import TargetSelector
from perchctl.vision.types import (
    MARKERS,
    CameraModel,
    Detection,
    Detections,
    Frame,
    MarkerName,
    PictureKind,
)

_SEARCHED_SIDE_PX = 13.0  # smaller markers are not found by a search
_Seen = dict[MarkerName, RefinedCorners]


def detect_markers(
    frame: Frame,
    previous: Detections | None,
    setup: DetectorSetup,
    camera: CameraModel,
    expected: Mapping[MarkerName, Array] | None = None,
    empty_frames: int | None = None,
    own: TargetSelector | None = None,
) -> Detections:
    """Find and refine the target's markers in one frame.

    `previous` is what an earlier frame gave (the last one that saw something is best);
    it gives the place to look at first and decides between look-alikes. `expected` are better
    predictions of the corners (4, 2) px, from the target's pose and the vehicle's motion.
    `empty_frames` is how many frames in a row have shown nothing: in a stream the searches take
    turns by it, since all of them in one frame take longer than a frame may. None searches by
    all. `own` chooses among several targets where none is expected. Of a frame of two fields
    whose order is not known the top one is taken.
    """
    expected = dict(expected) if expected else predicted_corners(previous, frame.t_s)
    look = _look(empty_frames, bool(expected), setup)
    turn = (
        (empty_frames + 2) // 4 if empty_frames is not None and look in ("near", "fits") else None
    )
    lately = measured_lately(previous, frame.t_s)
    was_cut = setup.cut and cut_lately(previous, frame.t_s, frame.image.shape)
    picture = halves(frame)[0] if frame.fields == "woven" else frame
    hidden = hidden_in(picture, setup.mask)
    if hidden is not None:
        picture = replace(picture, image=filled(picture.image, hidden), encoded=None)
    found = _search_picture(
        picture, hidden, expected, setup, camera, look, lately, was_cut, turn, own
    )
    return with_motion(found, previous)


def _look(empty_frames: int | None, expected: bool, setup: DetectorSetup) -> Look:
    """After a loss the place where the target should be and the whole picture take turns, and
    there the search and the fits of a blurred target do; later a sharp target and, in every Nth
    frame, a blurred one. The first frame without it may only be blurred: that has both."""
    if empty_frames is None:
        return "all"
    fits = setup.blurred and setup.by_lines
    if expected and setup.window:
        if empty_frames % 2:
            return "sharp"
        if empty_frames == 0 or not fits:
            return "near"
        return "fits" if empty_frames % 4 else "window"
    if not fits:
        return "sharp"
    if setup.blurred_every == 1:
        return "all"
    # At 0 something was seen, though not where the target should be.
    return "blurred" if empty_frames and empty_frames % setup.blurred_every == 0 else "sharp"


def _search_picture(
    frame: Frame,
    hidden: Covered | None,
    expected: Mapping[MarkerName, Array],
    setup: DetectorSetup,
    camera: CameraModel,
    look: Look,
    lately: bool,
    was_cut: bool,
    turn: int | None,
    own: TargetSelector | None,
) -> Detections:
    """What is in a picture of one moment; `hidden` (h, w) is where that is not seen, `lately`
    whether the target was measured a moment ago, `was_cut` no marker of it being whole, `turn` of
    the fits to a blurred one."""
    image = frame.image
    found = Found({}, mirrored=False, full_frame=False)
    both = completed(expected, setup.ratio, camera)
    seen: _Seen = {}
    if look != "fits" and setup.window and both and setup.by_lines:
        seen, found = _followed(image, hidden, both, setup, camera)
    if not seen and lately and setup.cut and is_cut(both, image.shape, hidden):
        seen = cut_markers(image, expected, setup.patterns, camera, hidden)
    findable = not was_cut or may_be_whole(both, image.shape)
    if look not in ("blurred", "fits") and (
        (not seen and findable) or _missing(seen, expected, image.shape, hidden)
    ):
        found = search(image, expected, setup, look, own)
        if len(found.corners_px) >= len(seen):
            seen = _refined(image, hidden, found, setup, camera)
    if not seen and look not in ("sharp", "window") and setup.blurred and setup.by_lines:
        seen = _in_blur(image, expected, setup, camera, turn)
    return Detections(
        frame_index=frame.index,
        t_s=frame.t_s,
        large=_detection("large", seen, frame.fields),
        small=_detection("small", seen, frame.fields),
        full_frame=found.full_frame,
        mirrored=found.mirrored and not seen,
        targets=found.targets,
    )


def _followed(
    image: NDArray[np.uint8],
    hidden: Covered | None,
    expected: Mapping[MarkerName, Array],
    setup: DetectorSetup,
    camera: CameraModel,
) -> tuple[_Seen, Found]:
    """What is where both are expected, or nearby: where no side was met, a near target has most
    often moved on further than a side is looked for, and a look around costs less than to fit
    what may be seen of it in the old place."""
    patterns, nothing = setup.patterns, Found({}, mirrored=False, full_frame=False)
    seen = follow(image, expected, patterns, camera, hidden)
    if not seen:
        found = search_halved(image, expected, setup)
        again = {} if found is None else _refined(image, hidden, found, setup, camera)
        if found is not None and again:
            return again, found
    seen = follow_partly(image, expected, seen, patterns, camera, hidden)
    if any(edges_suffice(r, patterns[name]) for name, r in seen.items()):
        return seen, nothing
    return improved(image, seen, patterns, camera, hidden=hidden), nothing


def _missing(
    seen: _Seen,
    expected: Mapping[MarkerName, Array],
    shape: tuple[int, ...],
    hidden: Covered | None,
) -> bool:
    """Whether a marker that should be in the picture, and not hidden, was not verified, other
    than one too far away to be found by a search."""
    return any(
        name not in seen
        and within(corners, shape)
        and side_lengths_px(corners).min() > _SEARCHED_SIDE_PX
        and not hides(hidden, corners)
        for name, corners in expected.items()
    )


def _refined(
    image: NDArray[np.uint8],
    hidden: Covered | None,
    found: Found,
    setup: DetectorSetup,
    camera: CameraModel,
) -> _Seen:
    """What the search found, by the profile's refinement."""
    seen = {
        name: _refine(image, found.corners_px[name], setup.patterns[name], camera, setup.refinement)
        for name in MARKERS
        if name in found.corners_px
    }
    if not setup.by_lines:
        return seen
    seen = _whole_or_partly(image, hidden, seen, setup, camera)
    return improved(image, seen, setup.patterns, camera, searched=True, hidden=hidden)


def _refine(
    image: NDArray[np.uint8], raw_px: Array, pattern: Pattern, camera: CameraModel, method: str
) -> RefinedCorners:
    """One marker's corners as a search found them, (4, 2), made better by the method."""
    if method == "none":
        return RefinedCorners(raw_px, RAW_SIGMA_PX, False)
    refined = refine_by_edges(image, raw_px, pattern, camera) if method == "line" else None
    return refined or refine_each(image, raw_px, pattern.cells)


def _whole_or_partly(
    image: NDArray[np.uint8],
    hidden: Covered | None,
    seen: _Seen,
    setup: DetectorSetup,
    camera: CameraModel,
) -> _Seen:
    """What the search found, those that are not wholly seen by what is seen of them. A
    search takes the picture's edge for the side of a marker that is cut off there."""
    fitted = dict(seen)
    for name, r in seen.items():
        if r.refined and wholly_seen(r, image.shape, hidden):
            continue
        pattern, small = setup.patterns[name], seen.get("small")
        starts = [r.corners_px]
        if name == "large" and not r.refined and small is not None and small.refined:
            starts.insert(0, nested(small.corners_px, 1.0 / setup.ratio, camera))
        known_by: KnownBy = "other" if len(seen) == 2 else "bits"
        tried = (seen_partly(image, s, pattern, camera, known_by, hidden) for s in starts)
        partly = next((found for found in tried if found is not None), None)
        if partly is not None:
            fitted[name] = partly
        elif not within(r.corners_px, image.shape, ROOM_PX) or hides(hidden, r.corners_px, 1.0):
            del fitted[name]
    return fitted


def _in_blur(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    setup: DetectorSetup,
    camera: CameraModel,
    turn: int | None,
) -> _Seen:
    """What only the drawing shows: near to where it is expected, or anywhere."""
    if expected:
        seen = expected_in_blur(image, expected, setup.patterns, camera, turn)
    else:
        seen = hidden_in_blur(image, setup, camera)
    return improved(image, seen, setup.patterns, camera)


def _detection(name: MarkerName, seen: _Seen, fields: PictureKind | None) -> Detection | None:
    r = seen.get(name)
    if r is None:
        return None
    sigma_px, cov_px2 = r.sigma_px, r.cov_px2
    if fields in ("top", "bottom"):
        lying_px = interpolated_sigma_px(0.0 if r.blur_px is None else r.blur_px[1])
        sigma_px = math.hypot(sigma_px, lying_px)
        cov_px2 = None if cov_px2 is None else cov_px2 + np.diag(4 * [0.0, lying_px**2])
    return Detection(
        name, r.corners_px, sigma_px, r.refined, r.whole, cov_px2=cov_px2, blur_px=r.blur_px
    )


# --- How the markers move from picture to picture, and where that leads them -------------------


_QUARTERS: Array = np.full(4, 0.25)
_MAX_GAP_S = 0.25  # older motion is no evidence of where to look


def predicted_corners(previous: Detections | None, t_s: float) -> dict[MarkerName, Array]:
    """The last corners (4, 2) px, moved on as they moved before; empty if there are none."""
    if previous is None:
        return {}
    gap_s = t_s - previous.t_s
    moves = 0.0 < gap_s <= _MAX_GAP_S
    corners: dict[MarkerName, Array] = {}
    for name in MARKERS:
        detection = previous.get(name)
        if detection is None:
            continue
        flow = previous.flow_px_s.get(name, previous.velocity_px_s)
        corners[name] = detection.corners_px + (flow * gap_s if moves and flow is not None else 0)
    return corners


def with_motion(now: Detections, previous: Detections | None) -> Detections:
    """`now` with velocity_px_s and flow_px_s, where markers were seen a short time before."""
    if previous is None:
        return now
    gap_s = now.t_s - previous.t_s
    if not 0.0 < gap_s <= _MAX_GAP_S:
        return now
    flow: dict[MarkerName, Array] = {}
    for name in MARKERS:
        a, b = previous.get(name), now.get(name)
        if a is not None and b is not None:
            flow[name] = (b.corners_px - a.corners_px) / gap_s
    if not flow:
        return now
    first = next(iter(flow.values()))
    return replace(now, velocity_px_s=_QUARTERS @ first, flow_px_s=flow)


# --- What lines alone left vague, or one of the two markers unseen: measured by the drawing, ---
# where the other marker puts it.


_GOOD_CELL_PX = 6.0  # from here on, lines are as exact as the drawing, and faster
_GOOD_BLURS = 6.0  # a cell's width over the blur's sigma, likewise
_REACH = 0.3  # of the side
# Where the other marker shows that it must be there, it may be vague.
_MAX_SIGMA_ALONE, _MAX_SIGMA = 0.06, 0.12  # of the side
_BLUR_PX = 1.5  # to start with, where it is not known
_OTHER: dict[MarkerName, MarkerName] = {"large": "small", "small": "large"}


def edges_suffice(seen: RefinedCorners, pattern: Pattern) -> bool:
    """Whether no photometric fit could give better corners."""
    cell_px = mean_side_px(seen.corners_px) / pattern.cells
    blur_px = 0.0 if seen.blur_px is None else seen.blur_px[0]
    return seen.refined and cell_px >= max(_GOOD_CELL_PX, _GOOD_BLURS * blur_px)


def improved(
    image: NDArray[np.uint8],
    seen: Mapping[MarkerName, RefinedCorners],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    searched: bool = False,
    hidden: NDArray[np.bool_] | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """The markers that were seen, with better corners and with the other marker if it shows.

    `hidden` (h, w) is where there is something else: a drawing is not laid over that. What a
    search found, its bits read one by one, stays only where lines suffice, the drawing
    confirms it, or the other marker was seen with it."""
    better = dict(seen)
    if "small" in better and "large" not in better:
        large = around(image, better["small"], patterns, camera, hidden)
        if large is not None:
            better["large"] = large
    for name in MARKERS:
        start = _start(name, better, patterns, camera)
        if start is None or not within(start, image.shape) or hides(hidden, start):
            continue
        alone = _OTHER[name] not in better
        max_sigma = _MAX_SIGMA_ALONE if alone else _MAX_SIGMA
        exact = aligned(
            image, start, patterns[name], camera, _REACH, _blur_px(better.get(name)),
            max_sigma=max_sigma, alone=alone,
        )  # fmt: skip
        if exact is not None:
            better[name] = exact
        elif alone and searched:
            better.pop(name, None)
        elif name not in better and resembles(image, start, patterns[name]):
            better[name] = RefinedCorners(start, NESTED_SIGMA_PX, False)
    return better


def _blur_px(seen: RefinedCorners | None) -> float:
    """That of the sides, where lines were fitted: the fit of the drawing gets there sooner."""
    if seen is None or seen.blur_px is None:
        return _BLUR_PX
    return min(math.sqrt(max(seen.blur_px[0] ** 2 - ACROSS_PX**2, 0.0)), _BLUR_PX)


def _start(
    name: MarkerName,
    seen: Mapping[MarkerName, RefinedCorners],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
) -> Array | None:
    """Corners (4, 2) px from which the drawing should be aligned, None where that is of no
    use."""
    this, other = seen.get(name), seen.get(_OTHER[name])
    if this is not None:
        if not this.whole:
            return None  # what hides a part of it would spoil the drawing, too
        # Small cells matter only where no larger ones were measured.
        enough = edges_suffice(this, patterns[name]) or (name == "small" and other is not None)
        return None if this.refined and enough else this.corners_px
    if name == "small" and other is not None and other.refined:
        return nested(other.corners_px, patterns["large"].drawing.ratio, camera)
    return None


# --- Markers where they are expected: no search, only verification -----------------------------
# Edges are fitted from the predicted corners, and every cell is read through the result's
# homography: a strict check (all cells right, none nearly wrong) at a tenth of the price of
# a search.


_LEAST_CELL_PX = 2.5  # for edges
_ANCHOR = 0.12  # of the small marker's side


def follow(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    hidden: Covered | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """The expected markers (corners (4, 2) px) that are verified by all edges and cells;
    `hidden` (h, w) is where there is something else."""
    seen: _Seen = {}
    for name in MARKERS:
        if (
            name not in expected
            or not within(expected[name], image.shape, ROOM_PX)
            or not shortest_side_px(expected[name]) > _LEAST_CELL_PX * patterns[name].cells
        ):
            continue
        found = refine_by_edges(image, expected[name], patterns[name], camera)
        if (
            found is not None
            and wholly_seen(found, image.shape, hidden)
            and cells_agree(image, found.corners_px, patterns[name], camera)
        ):
            seen[name] = found
    return seen


def follow_partly(
    image: NDArray[np.uint8],
    expected: Mapping[MarkerName, Array],
    seen: Mapping[MarkerName, RefinedCorners],
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    hidden: Covered | None = None,
) -> dict[MarkerName, RefinedCorners]:
    """With those that `follow` did not verify, by what is seen of them. Where the small marker
    was met, the large one is looked for around it instead of where it was expected."""
    places, seen = dict(expected), dict(seen)
    if "small" in seen and "large" not in seen:
        places["large"] = nested(
            seen["small"].corners_px, 1.0 / patterns["large"].drawing.ratio, camera
        )
    for name in MARKERS:
        if name in places and name not in seen:
            partly = seen_partly(image, places[name], patterns[name], camera, "track", hidden)
            if partly is not None:
                seen[name] = partly
    large = seen.get("large")
    if large is not None and "small" not in seen:
        # Too small for edges, but where it must be: enough to know that it is there.
        small_px = nested(large.corners_px, patterns["large"].drawing.ratio, camera)
        if mean_side_px(small_px) > LEAST_SIDE_PX and resembles(image, small_px, patterns["small"]):
            seen["small"] = RefinedCorners(small_px, NESTED_SIGMA_PX, False)
    return seen


def seen_partly(
    image: NDArray[np.uint8],
    start_px: Array,
    pattern: Pattern,
    camera: CameraModel,
    known_by: KnownBy,
    hidden: Covered | None = None,
) -> RefinedCorners | None:
    """The marker near to corners `start_px` (4, 2), by what is seen of it, if its cells are."""
    found = refine_by_edges(image, start_px, pattern, camera, hidden, partly=True)
    if found is None:
        return None
    agree = cells_agree(image, found.corners_px, pattern, camera, known_by, hidden)
    return found if agree else None


def wholly_seen(found: RefinedCorners, shape: tuple[int, ...], hidden: Covered | None) -> bool:
    """Whether nothing of the marker is hidden, and the picture's edge too far away to take
    anything from the sides' blur."""
    room_px = ROOM_PX + (0.0 if found.blur_px is None else found.blur_px[0])
    return within(found.corners_px, shape, room_px) and not hides(hidden, found.corners_px)


def around(
    image: NDArray[np.uint8],
    small: RefinedCorners,
    patterns: Mapping[MarkerName, Pattern],
    camera: CameraModel,
    hidden: Covered | None = None,
) -> RefinedCorners | None:
    """The large marker around a small one that was found: something may cover a part of
    it, and it may be cut off by the picture's edge, so long as its edges are where they
    are seen and most cells show."""
    pattern = patterns["large"]
    start = nested(small.corners_px, 1.0 / pattern.drawing.ratio, camera)
    if not np.isfinite(start).all():
        return None
    if within(start, image.shape, ROOM_PX):
        found = refine_by_edges(image, start, pattern, camera)
        if (
            found is not None
            and wholly_seen(found, image.shape, hidden)
            and _centred(found, small, pattern, camera)
            and cells_agree(image, found.corners_px, pattern, camera, "other")
        ):
            return found
    partly = seen_partly(image, start, pattern, camera, "other", hidden)
    return partly if partly and _centred(partly, small, pattern, camera) else None


def _centred(
    large: RefinedCorners, small: RefinedCorners, pattern: Pattern, camera: CameraModel
) -> bool:
    """Whether the small marker is where the large one has it."""
    centre = nested(large.corners_px, pattern.drawing.ratio, camera)
    off_px = float(np.abs(centre - small.corners_px).max())
    return off_px <= max(_ANCHOR * mean_side_px(small.corners_px), 1.0)
