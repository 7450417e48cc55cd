"""Finding the two markers of the target in a picture.

First where they are expected, by proof instead of search (`perchctl.vision.markers.follow`); then
by a search in a window around that place, then in the whole picture, all within the
same frame. Where nothing is found, blur may hide it (`perchctl.vision.markers.blurred`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.markers.blurred import expected_in_blur, hidden_in_blur
from perchctl.vision.markers.corners import RefinedCorners, refine, side_lengths_px
from perchctl.vision.markers.follow import (
    GOOD_LINE_BLURS,
    GOOD_LINE_CELL_PX,
    NESTED_SIGMA_PX,
    Pattern,
    aligned,
    around,
    completed,
    follow,
    nested,
    resembles,
    within,
)
from perchctl.vision.markers.search import (
    QUICK_THRESHOLDS_PX,
    DetectorSetup,
    choose,
    make_detector,
    misfit,
    search,
    search_window,
)
from perchctl.vision.types import (
    MARKERS,
    CameraModel,
    Detection,
    Detections,
    EdgeShift,
    Frame,
    MarkerName,
)

__all__ = [
    "DetectorSetup",
    "choose",
    "detect",
    "make_detector",
    "misfit",
    "predicted_corners",
    "search_window",
]

_MAX_SPEED_GAP_S = 0.25  # older motion says nothing about where to look
_SHIFT_PICTURES = 5
_SEARCHED_SIDE_PX = 13.0  # smaller markers are not found by a search


def detect(
    frame: Frame,
    previous: Detections | None,
    setup: DetectorSetup,
    camera: CameraModel,
    expected: Mapping[MarkerName, Array] | None = None,
    thorough: bool = True,
) -> Detections:
    """Find and refine the target's markers in one frame.

    `previous` is what an earlier frame gave (the last one that saw something is best);
    it says where to look first and decides between look-alikes. `expected` are better
    predictions of the corners (4, 2) px, from the target's pose and the vehicle's motion.
    `thorough` looks once more, all over a picture in which nothing was found and nothing
    is expected, for a target hidden by blur.
    """
    image = frame.image
    expected = dict(expected) if expected else predicted_corners(previous, frame.t_s)
    seen: dict[MarkerName, RefinedCorners] = {}
    mirrored, full_frame = False, False
    by_lines = setup.refinement == "line"
    if setup.window and expected and by_lines:
        guess = completed(expected, setup.ratio, camera)
        seen = follow(image, guess, setup.patterns, camera, _known_shift(previous))
        if seen and not any(_good(r, setup.patterns[name]) for name, r in seen.items()):
            seen = _with_other(image, seen, setup, camera)
    if not seen or _worse(seen, expected, image.shape):
        found, mirrored, full_frame = _searched(image, expected, setup)
        if len(found) >= len(seen):
            seen = _refined(image, found, setup, camera)
        if not seen and setup.blurred and by_lines:
            if expected:
                seen = expected_in_blur(image, expected, setup.patterns, camera)
            elif thorough:
                seen = hidden_in_blur(image, setup, camera)
            seen = _with_other(image, seen, setup, camera)
    result = Detections(
        frame_index=frame.index,
        t_s=frame.t_s,
        large=_detection("large", seen),
        small=_detection("small", seen),
        full_frame=full_frame,
        mirrored=mirrored and not seen,
        edge_shift=next((r.edge_shift for r in seen.values() if r.edge_shift is not None), None),
    )
    return replace(result, **_motion(previous, result))


def _known_shift(previous: Detections | None) -> EdgeShift | None:
    """Light, lens and ink change slowly: what one picture told holds for some more."""
    shift = None if previous is None else previous.edge_shift
    if shift is None or shift.age + 1 >= _SHIFT_PICTURES:
        return None
    return replace(shift, age=shift.age + 1)


def _detection(name: MarkerName, seen: dict[MarkerName, RefinedCorners]) -> Detection | None:
    r = seen.get(name)
    if r is None:
        return None
    return Detection(name, r.corners_px, r.sigma_px, r.refined, r.shift_sigma_px)


def _good(seen: RefinedCorners, pattern: Pattern) -> bool:
    """Whether lines are all that could be wished for."""
    cell_px = float(side_lengths_px(seen.corners_px).mean()) / pattern.rim.cells
    least_px = max(GOOD_LINE_CELL_PX, GOOD_LINE_BLURS * seen.blur_px)
    return seen.refined and cell_px >= least_px


def _worse(
    seen: dict[MarkerName, RefinedCorners],
    expected: Mapping[MarkerName, Array],
    shape: tuple[int, ...],
) -> bool:
    """Whether a marker that should be in the picture was not proven, other than one too
    far away to be found by a search."""
    return any(
        name not in seen
        and within(corners, shape)
        and side_lengths_px(corners).min() > _SEARCHED_SIDE_PX
        for name, corners in expected.items()
    )


def _searched(
    image: NDArray[np.uint8], expected: dict[MarkerName, Array], setup: DetectorSetup
) -> tuple[dict[MarkerName, Array], bool, bool]:
    """Raw corners by the window and the whole picture; mirrored; whether the whole was."""
    whole = (0, 0, image.shape[1], image.shape[0])
    box = whole
    found: dict[MarkerName, Array] = {}
    mirrored = False
    if setup.window and expected:
        box = search_window(expected, setup.ratio, image.shape) or whole
        if len(expected) == 2:
            found, _ = search(image, box, expected, setup, QUICK_THRESHOLDS_PX)
        if len(found) < 2 and box != whole:
            found, _ = search(image, box, expected, setup)
    if not found or (box == whole and len(found) < 2):
        box = whole
        found, mirrored = search(image, whole, expected, setup)
    return found, mirrored, box == whole


def _refined(
    image: NDArray[np.uint8],
    found: dict[MarkerName, Array],
    setup: DetectorSetup,
    camera: CameraModel,
) -> dict[MarkerName, RefinedCorners]:
    names = [name for name in MARKERS if name in found]
    raw = np.array([found[name] for name in names]).reshape(-1, 4, 2)
    rims = [setup.patterns[name].rim for name in names]
    refined = refine(image, raw, rims, camera, setup.refinement)
    seen = dict(zip(names, refined, strict=True))
    return _with_other(image, seen, setup, camera) if setup.refinement == "line" else seen


def _with_other(
    image: NDArray[np.uint8],
    seen: dict[MarkerName, RefinedCorners],
    setup: DetectorSetup,
    camera: CameraModel,
) -> dict[MarkerName, RefinedCorners]:
    """What lines alone left vague or unseen, by its drawing."""
    better = dict(seen)
    if "small" in better and "large" not in better:
        large = around(image, better["small"], setup.patterns, camera)
        if large is not None:
            better["large"] = large
    for name in MARKERS:
        r, pattern = better.get(name), setup.patterns[name]
        other = better.get("small" if name == "large" else "large")
        if r is not None and r.refined:
            # Small cells matter only where no larger ones were measured.
            if _good(r, pattern) or (name == "small" and other is not None):
                continue
        elif r is None and (name == "large" or other is None or not other.refined):
            continue
        start = r.corners_px if r is not None else nested(_corners(other), setup.ratio, camera)
        if not within(start, image.shape):
            continue
        # Where the other marker says that it must be, it may be vague.
        max_sigma = 0.06 if other is None else 0.12
        exact = aligned(image, start, pattern, camera, reach=0.3, max_sigma=max_sigma)
        if exact is not None:
            better[name] = exact
        elif r is None and resembles(image, start, pattern):
            better[name] = RefinedCorners(start, NESTED_SIGMA_PX, False)
    return better


def _corners(seen: RefinedCorners | None) -> Array:
    assert seen is not None
    return seen.corners_px


def predicted_corners(previous: Detections | None, t_s: float) -> dict[MarkerName, Array]:
    """The last corners, moved on as they moved before; empty if there are none."""
    if previous is None:
        return {}
    gap_s = t_s - previous.t_s
    moves = 0.0 < gap_s <= _MAX_SPEED_GAP_S
    corners: dict[MarkerName, Array] = {}
    for name in MARKERS:
        detection = previous.get(name)
        if detection is None:
            continue
        flow = previous.flow_px_s.get(name)
        if flow is None and previous.velocity_px_s is not None:
            flow = previous.velocity_px_s
        corners[name] = detection.corners_px + (flow * gap_s if moves and flow is not None else 0)
    return corners


def _motion(previous: Detections | None, now: Detections) -> dict[str, Any]:
    """velocity_px_s and flow_px_s of `now`."""
    if previous is None:
        return {}
    gap_s = now.t_s - previous.t_s
    if not 0.0 < gap_s <= _MAX_SPEED_GAP_S:
        return {}
    flow = {}
    for name in MARKERS:
        a, b = previous.get(name), now.get(name)
        if a is not None and b is not None:
            flow[name] = (b.corners_px - a.corners_px) / gap_s
    if not flow:
        return {}
    first = next(iter(flow.values()))
    return {"velocity_px_s": first.mean(axis=0), "flow_px_s": flow}
