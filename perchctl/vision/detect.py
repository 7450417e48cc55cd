"""Finding the two markers of the target in a picture.

One detector pass serves both markers: each has a dictionary that holds its one id,
so nothing else can be taken for it (0/1 correction bits: no false accept in 28
pictures without a target; 0/3: 7 of 28). The search starts in a window around the
last sight and falls back to the whole picture within the same frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig
from perchctl.target.dictionaries import predefined
from perchctl.vision.corners import refine, rim_of_bits, side_lengths_px
from perchctl.vision.types import MARKERS, CameraModel, Detection, Detections, Frame, MarkerName

_MIN_PERIMETER_PX = 19.2  # OpenCV's default rate, 0.03, of 640 px
_THRESHOLDS_PX = (3, 23)  # OpenCV's: 3, 13, 23
_QUICK_THRESHOLDS_PX = (13, 13)  # enough where both markers were seen a frame ago
_WINDOW_MARGIN = 0.25  # of the target's size in the picture, on each side
_WINDOW_MARGIN_PX = 24
_MAX_SPEED_GAP_S = 0.25  # older motion says nothing about where to look
_CENTRE_TOLERANCE = 0.35  # of the small marker's side


@dataclass(frozen=True, eq=False)
class DetectorSetup:
    """What `detect` needs, made once by `make_detector`.

    `mirror_index` is the mirror image's place in the small marker's dictionary (None
    where it could be confused with the marker itself), `rims` what lies inside of each
    marker's border, `ratio` the small marker's side over the large one's.
    """

    detector: Any
    parameters: Any
    mirror_index: int | None
    rims: dict[MarkerName, Array]
    ratio: float
    refinement: str
    window: bool


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
    return DetectorSetup(
        detector=cv2.aruco.ArucoDetector([large, small], parameters),
        parameters=parameters,
        mirror_index=mirror_index,
        rims={"large": rim_of_bits(large_bits), "small": rim_of_bits(small_bits)},
        ratio=target.small.side_m / target.large.side_m,
        refinement=config.refinement,
        window=config.window,
    )


def detect(
    frame: Frame, previous: Detections | None, setup: DetectorSetup, camera: CameraModel
) -> Detections:
    """Find and refine the target's markers in one frame.

    `previous` is what an earlier frame gave (the last one that saw something is best);
    it says where to look first and decides between look-alikes.
    """
    image = frame.image
    expected = predicted_corners(previous, frame.t_s)
    whole = (0, 0, image.shape[1], image.shape[0])
    box = whole
    found: dict[MarkerName, Array] = {}
    mirrored = False
    if setup.window and expected:
        box = search_window(expected, setup.ratio, image.shape) or whole
        if len(expected) == 2:
            found, _ = _search(image, box, expected, setup, _QUICK_THRESHOLDS_PX)
        if len(found) < 2 and box != whole:
            found, _ = _search(image, box, expected, setup)
    if not found or (box == whole and len(found) < 2):
        box = whole
        found, mirrored = _search(image, whole, expected, setup)
    names = [name for name in MARKERS if name in found]
    refined = refine(
        image,
        np.array([found[name] for name in names]).reshape(-1, 4, 2),
        [setup.rims[name] for name in names],
        camera,
        setup.refinement,
    )
    seen = {
        name: Detection(name, r.corners_px, r.sigma_px, r.refined)
        for name, r in zip(names, refined, strict=True)
    }
    result = Detections(
        frame_index=frame.index,
        t_s=frame.t_s,
        large=seen.get("large"),
        small=seen.get("small"),
        full_frame=box == whole,
        mirrored=mirrored and not seen,
    )
    return replace(result, velocity_px_s=_velocity(previous, result))


def predicted_corners(previous: Detections | None, t_s: float) -> dict[MarkerName, Array]:
    """The last corners, moved on by their velocity in the picture; empty if there are none."""
    if previous is None:
        return {}
    gap_s = t_s - previous.t_s
    shift = np.zeros(2)
    if previous.velocity_px_s is not None and 0.0 < gap_s <= _MAX_SPEED_GAP_S:
        shift = previous.velocity_px_s * gap_s
    corners: dict[MarkerName, Array] = {}
    for name in MARKERS:
        detection = previous.get(name)
        if detection is not None:
            corners[name] = detection.corners_px + shift
    return corners


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


def _search(
    image: NDArray[np.uint8],
    box: tuple[int, int, int, int],
    expected: dict[MarkerName, Array],
    setup: DetectorSetup,
    thresholds_px: tuple[int, int] = _THRESHOLDS_PX,
) -> tuple[dict[MarkerName, Array], bool]:
    left, top, right, bottom = box
    parameters = setup.parameters
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = thresholds_px
    parameters.minMarkerPerimeterRate = min(
        1.0, _MIN_PERIMETER_PX / max(right - left, bottom - top)
    )
    setup.detector.setDetectorParameters(parameters)
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
    unit = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], dtype=np.float32)
    H = cv2.getPerspectiveTransform(unit, large_px.astype(np.float32))
    inner = cv2.perspectiveTransform((unit * ratio).reshape(-1, 1, 2), H)
    mapped = np.asarray(inner, dtype=np.float64).reshape(4, 2)
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


def _velocity(previous: Detections | None, now: Detections) -> Array | None:
    if previous is None:
        return None
    gap_s = now.t_s - previous.t_s
    if not 0.0 < gap_s <= _MAX_SPEED_GAP_S:
        return None
    for name in MARKERS:
        a, b = previous.get(name), now.get(name)
        if a is not None and b is not None:
            return np.asarray((b.corners_px - a.corners_px).mean(axis=0) / gap_s)
    return None


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
