"""The printed target: the sizes measured on paper, and the ratio of the small marker's size to the
large one's.

Both markers lie in one plane at the same distance, so the ratio of their apparent sizes is the
ratio of the printed sizes, regardless of distance and focal length.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from perchctl.geometry import Array
from perchctl.profile import MarkerConfig, TargetConfig
from perchctl.target.drawing import marker_corners_m, print_scale
from perchctl.vision import CameraModel, PipelineOutput, undistort_to_normalised

MEASURED_SIGMA = 0.001
"""Relative error of measured sizes: 0.15 mm of a large marker."""


def measured_target(
    nominal: TargetConfig, sides_m: Mapping[str, float]
) -> tuple[TargetConfig, list[str]]:
    """The target with the measured sides of ``large`` and ``small``, and notes for the user. If
    both sides are given, `size_sigma` is reduced to `MEASURED_SIGMA`.

    Raises InvalidValue for a side that differs from its nominal length by more than any printer's
    error.
    """
    notes, scales = [], {}
    target = nominal
    for name, side_m in sides_m.items():
        marker: MarkerConfig = getattr(nominal, name)
        scales[name], said = print_scale(
            name, f"--measured-{name}", side_m, marker.side_m, "the profile"
        )
        notes += said
        target = target.model_copy(update={name: marker.model_copy(update={"side_m": side_m})})
    if len(scales) == 2:
        between = scales["small"] - scales["large"]
        notes.append(f"small relative to large: {100 * between:+.2f} %")
        sigma = min(nominal.size_sigma, MEASURED_SIGMA)
        target = target.model_copy(update={"size_sigma": sigma})
    if target.size_sigma > MEASURED_SIGMA:
        notes.append("measure both markers: until then, distances have a larger uncertainty")
    return target, notes


# --- The size ratio of the two printed markers, measured by the camera ---


CORNER_BIAS_PX = 0.02
"""Inward or outward error of a refined corner that is the same in all frames, px; averaging over
frames does not reduce it."""
MIN_ERROR = 0.003
"""Smallest relative error that is reported: one printer dot on a 25 mm marker."""
SIGMAS = 3.0
MIN_FRAMES = 5
_MEDIAN_TO_SIGMA = 1.2533  # ratio of the standard error of a median to that of a mean
_MAD_TO_SIGMA = 1.4826


def size_ratio(
    large_px: Array, small_px: Array, camera: CameraModel, target: TargetConfig
) -> tuple[float, float] | None:
    """Return the ratio of the small marker's size to the large marker's, divided by the same ratio
    in the profile (1.01: printed 1 % too large), from the corners in one frame, (4, 2) px each; and
    the possible systematic error of the result due to the corners. None if the corners do not span
    a plane."""
    rays = undistort_to_normalised(np.concatenate([large_px, small_px]), camera)
    seen = (rays @ camera.K[:2, :2].T + camera.K[:2, 2]).astype(np.float32)
    sides = [
        float(np.linalg.norm(q - np.roll(q, 1, axis=0), axis=1).mean()) for q in np.split(seen, 2)
    ]
    if not np.isfinite(seen).all() or min(sides) < 1.0:
        return None
    on_print = marker_corners_m(target.large.side_m)[:, :2].astype(np.float32)
    H = cv2.getPerspectiveTransform(seen[:4], on_print)
    small = cv2.perspectiveTransform(seen[None, 4:], H)[0]
    side_m = float(np.linalg.norm(small - np.roll(small, 1, axis=0), axis=1).mean())
    bias = math.hypot(*(2.0 * CORNER_BIAS_PX / side for side in sides))
    return side_m / target.small.side_m, bias


@dataclass(frozen=True)
class PrintVerdict:
    """The result of comparing the sizes of both markers. `advice` is empty unless the print is
    wrong."""

    found: str
    advice: str = ""

    @property
    def is_wrong(self) -> bool:
        return bool(self.advice)


@dataclass(eq=False)
class PrintCheck:
    """The ratio of the two markers' apparent sizes over the frames that show both."""

    camera: CameraModel
    target: TargetConfig
    _ratios: list[tuple[float, float]] = field(default_factory=list)

    def add(self, output: PipelineOutput | None) -> None:
        """Add an image's ratio if it shows both markers with refined corners."""
        if output is None:
            return
        large = output.detections.large
        small = output.detections.small
        if (
            large is not None
            and small is not None
            and large.are_corners_fitted
            and small.are_corners_fitted
        ):
            self.add_corners(large.corners_px, small.corners_px)

    def add_corners(self, large_px: Array, small_px: Array) -> None:
        """Add the ratio for one image from its markers' corners, (4, 2) px each."""
        ratio = size_ratio(large_px, small_px, self.camera, self.target)
        if ratio is not None:
            self._ratios.append(ratio)

    @property
    def has_enough_frames(self) -> bool:
        """True when enough frames showed both markers."""
        return len(self._ratios) >= MIN_FRAMES

    def verdict(self) -> PrintVerdict:
        """Check the median ratio. The print is wrong if the error exceeds noise and bias; with too
        few frames, it is not reported as wrong."""
        if not self.has_enough_frames:
            return PrintVerdict(
                f"print not checked: both markers were seen in only {len(self._ratios)} of the "
                f"{MIN_FRAMES} frames needed"
            )
        values, biases = np.array(self._ratios).T
        value = float(np.median(values))
        spread = _MAD_TO_SIGMA * float(np.median(np.abs(values - value)))
        sigma = _MEDIAN_TO_SIGMA * spread / math.sqrt(len(values))
        off = value - 1.0
        total = math.hypot(sigma, float(np.median(biases)))
        nominal = self.target.small.side_m / self.target.large.side_m
        ratio_text = (
            f"the small marker is {value * nominal:.4f} times as large as the large one, and the "
            f"profile specifies {nominal:.4f} ({100 * off:+.2f} %, sigma {100 * total:.2f} %)"
        )
        if abs(off) <= max(SIGMAS * total, MIN_ERROR):
            return PrintVerdict(f"print correct within the noise: {ratio_text}")
        return PrintVerdict(
            f"print error: {ratio_text}",
            "measure both black squares and write them to the profile with perchctl make-target "
            "measured --measured-large MM --measured-small MM",
        )
