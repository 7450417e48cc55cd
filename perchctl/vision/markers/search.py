"""One detector pass over (a part of) the picture, and the choice among what it finds.

Each marker has a dictionary that holds its one id, so nothing else can be taken for it
(0/1 correction bits: no false accept in 28 pictures without a target; 0/3: 7 of 28).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig
from perchctl.profile.dictionaries import predefined
from perchctl.vision.markers.corners import Rim, rim_of_bits, side_lengths_px
from perchctl.vision.markers.drawing import drawing_of
from perchctl.vision.markers.follow import Pattern, nested, pattern_of
from perchctl.vision.types import MARKERS, MarkerName

_MIN_PERIMETER_PX = 19.2  # OpenCV's default rate, 0.03, of 640 px
_THRESHOLDS_PX = (3, 23)  # OpenCV's: 3, 13, 23
_LOOSE_THRESHOLDS_PX = (15, 35)
_LOOSE_PERIMETER_RATE = 0.05
QUICK_THRESHOLDS_PX = (13, 13)  # enough where both markers were seen a frame ago
_WINDOW_MARGIN = 0.25  # of the target's size in the picture, on each side
_WINDOW_MARGIN_PX = 24
_PRINT_M = 2e-5  # half a dot of a printer
_CENTRE_TOLERANCE = 0.35  # of the small marker's side


@dataclass(frozen=True, eq=False)
class DetectorSetup:
    """What `detect` needs, made once by `make_detector`.

    `loose` takes nearly any quadrilateral for a candidate; `mirror_index` is the mirror
    image's place in the small marker's dictionary (None where it could be confused with
    the marker itself), `patterns` how each marker looks, `ratio` the small marker's side
    over the large one's.
    """

    detector: Any
    loose: Any
    parameters: Any
    mirror_index: int | None
    patterns: dict[MarkerName, Pattern]
    ratio: float
    refinement: str
    window: bool
    blurred: bool
    blurred_every: int


def make_detector(config: DetectorConfig, target: TargetConfig) -> DetectorSetup:
    """Dictionaries of just the target's ids, and the detector that looks for them."""
    large_bits, small_bits = _bits(target.large), _bits(target.small)
    patterns = [small_bits]
    mirror_index = None
    mirror = np.ascontiguousarray(small_bits[:, ::-1])
    if _distance(mirror, small_bits) > 2 * config.correction_bits_small + 1:
        mirror_index = len(patterns)
        patterns.append(mirror)
    large = _dictionary([large_bits], config.correction_bits_large)
    small = _dictionary(patterns, config.correction_bits_small)
    parameters = cv2.aruco.DetectorParameters()
    parameters.errorCorrectionRate = 1.0  # so that maxCorrectionBits is the limit itself
    parameters.minDistanceToBorder = 0
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    ratio = target.small.side_m / target.large.side_m
    return DetectorSetup(
        detector=cv2.aruco.ArucoDetector([large, small], parameters),
        loose=cv2.aruco.ArucoDetector([large, small], _loose()),
        parameters=parameters,
        mirror_index=mirror_index,
        patterns={
            "large": pattern_of(
                _rim(large_bits, target.large.side_m), drawing_of(large_bits, small_bits, ratio)
            ),
            "small": pattern_of(_rim(small_bits, target.small.side_m), drawing_of(small_bits)),
        },
        ratio=ratio,
        refinement=config.refinement,
        window=config.window,
        blurred=config.blurred,
        blurred_every=config.blurred_every,
    )


def _loose() -> Any:
    """For blurred pictures: round corners, wide dark borders, small sides."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.minDistanceToBorder = 0
    parameters.polygonalApproxAccuracyRate = 0.1
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = _LOOSE_THRESHOLDS_PX
    parameters.adaptiveThreshWinSizeStep = _LOOSE_THRESHOLDS_PX[1] - _LOOSE_THRESHOLDS_PX[0]
    parameters.minMarkerPerimeterRate = _LOOSE_PERIMETER_RATE
    return parameters


def _parameters(
    setup: DetectorSetup, size_px: tuple[int, ...], thresholds_px: tuple[int, int]
) -> None:
    parameters = setup.parameters
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = thresholds_px
    parameters.minMarkerPerimeterRate = min(1.0, _MIN_PERIMETER_PX / max(size_px))
    setup.detector.setDetectorParameters(parameters)


def search_window(
    expected: dict[MarkerName, Array], ratio: float, shape: tuple[int, ...]
) -> tuple[int, int, int, int] | None:
    """Where to look: left, top, right, bottom px; None where a window would not pay.

    It holds the whole large marker as long as that can be in the picture, so that
    the stage can change from one frame to the next.
    """
    h, w = shape[:2]
    if "large" in expected:
        corners = expected["large"]
    else:
        small = expected["small"]
        centre = small.mean(axis=0)
        whole = centre + (small - centre) / ratio
        inside = (whole >= 0).all() and (whole < (w, h)).all()
        corners = whole if inside else centre + 1.6 * (small - centre)
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = np.maximum(_WINDOW_MARGIN * (high - low).max(), _WINDOW_MARGIN_PX)
    left, top = np.clip(np.floor(low - margin), 0, (w, h)).astype(int)
    right, bottom = np.clip(np.ceil(high + margin), 0, (w, h)).astype(int)
    if right - left < 16 or bottom - top < 16 or (right - left) * (bottom - top) > 0.8 * w * h:
        return None
    return int(left), int(top), int(right), int(bottom)


def search(
    image: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    expected: dict[MarkerName, Array],
    setup: DetectorSetup,
    thresholds_px: tuple[int, int] = _THRESHOLDS_PX,
) -> tuple[dict[MarkerName, Array], bool]:
    """Raw corners (4, 2) of what is in the box (left, top, right, bottom), and whether the
    small marker's mirror image is."""
    left, top, right, bottom = box
    _parameters(setup, (right - left, bottom - top), thresholds_px)
    corners, ids, _, which = setup.detector.detectMarkersMultiDict(image[top:bottom, left:right])
    if ids is None or len(corners) == 0:
        return {}, False
    shift = np.array([left, top], dtype=np.float64)
    candidates: dict[MarkerName, list[Array]] = {"large": [], "small": []}
    mirrored = False
    for quad, index, dictionary in zip(corners, ids.ravel(), which.ravel(), strict=True):
        if dictionary == 1 and index == setup.mirror_index:
            mirrored = True
            continue
        name = MARKERS[int(dictionary)]
        candidates[name].append(np.asarray(quad, dtype=np.float64).reshape(4, 2) + shift)
    return choose(candidates, expected, setup.ratio), mirrored


def choose(
    candidates: dict[MarkerName, list[Array]], expected: dict[MarkerName, Array], ratio: float
) -> dict[MarkerName, Array]:
    """At most one of each marker: look-alikes and what does not fit together are dropped.

    A small marker in the centre of a large one, of the right size and turn, proves
    both. Without such a pair the last sight decides; without one, a lone marker is
    taken, and of several the evidence is too thin to take any.
    """
    large, small = candidates["large"], candidates["small"]
    pairs = [(misfit(a, b, ratio), i, j) for i, a in enumerate(large) for j, b in enumerate(small)]
    if pairs:
        best, i, j = min(pairs)
        if best <= 1.0:
            return {"large": large[i], "small": small[j]}
    near_large = _nearest("large", large, expected, ratio)
    near_small = _nearest("small", small, expected, ratio)
    if near_large is not None:
        return {"large": near_large}
    if near_small is not None:
        return {"small": near_small}
    # A small marker beside a whole large one is not the target's.
    if len(large) == 1:
        return {"large": large[0]}
    if len(small) == 1 and not large:
        return {"small": small[0]}
    return {}


def misfit(large_px: Array, small_px: Array, ratio: float) -> float:
    """How far the small marker's corners are from where the large one puts them, in
    units of what is allowed (1 or less: they belong together)."""
    mapped = nested(large_px, ratio)
    side_px = float(side_lengths_px(mapped).mean())
    allowed_px = max(_CENTRE_TOLERANCE * side_px, 2.5)
    return float(np.linalg.norm(mapped - small_px, axis=1).max()) / allowed_px


def _nearest(
    name: MarkerName, quads: list[Array], expected: dict[MarkerName, Array], ratio: float
) -> Array | None:
    """The candidate that continues the last sight, in place and in size, if any does."""
    if not expected or not quads:
        return None
    if name in expected:
        guess = expected[name]
    else:
        other = next(iter(expected.values()))
        centre = other.mean(axis=0)
        guess = centre + (ratio if name == "small" else 1.0 / ratio) * (other - centre)
    side_px = max(float(side_lengths_px(guess).mean()), 1e-6)
    reach_px = max(2.0 * side_px * (1.0 if name == "small" else ratio), 40.0)
    best: Array | None = None
    for quad in quads:
        distance_px = float(np.linalg.norm(quad.mean(axis=0) - guess.mean(axis=0)))
        growth = float(side_lengths_px(quad).mean()) / side_px
        if distance_px < reach_px and 0.6 < growth < 1.7:
            best, reach_px = quad, distance_px
    return best


def _rim(bits: NDArray[np.uint8], side_m: float) -> Rim:
    return rim_of_bits(bits, _PRINT_M * (len(bits) + 2) / side_m)


def _bits(marker: MarkerConfig) -> NDArray[np.uint8]:
    source = predefined(marker.dictionary)
    rows = np.ascontiguousarray(source.bytesList[marker.id : marker.id + 1])
    return np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(rows, source.markerSize))


def _dictionary(patterns: list[NDArray[np.uint8]], correction_bits: int) -> Any:
    rows = [cv2.aruco.Dictionary.getByteListFromBits(np.ascontiguousarray(p)) for p in patterns]
    return cv2.aruco.Dictionary(
        np.ascontiguousarray(np.concatenate(rows)), patterns[0].shape[0], correction_bits
    )


def _distance(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> int:
    """Fewest bits in which a, in any turn, differs from b."""
    return min(int((np.rot90(a, turn) != b).sum()) for turn in range(4))
