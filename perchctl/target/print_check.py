"""Whether the small marker was printed in the right proportion to the large one.

Seen together, both markers lie in one plane at one distance: the ratio of their apparent
sizes is the ratio of their prints, whatever the distance and the focal length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.optimize import least_squares

from perchctl.geometry import Array
from perchctl.profile import TargetConfig
from perchctl.target.drawing import marker_corners_m
from perchctl.vision import CameraModel, PipelineOutput, undistort

CORNER_BIAS_PX = 0.02
"""What a refined corner errs inwards or outwards in all frames alike; no number of frames
averages it away."""
MIN_ERROR = 0.003
"""Errors smaller than this are not named: 0.3 % of a 25 mm marker is 0.08 mm, the width of
a printer's dot."""
SIGMAS = 3.0
MIN_FRAMES = 5
_FOLD = 500  # frames whose size ratios are kept one by one


@dataclass(frozen=True)
class SizeRatio:
    """`value` is the small marker's size, relative to the large one's, over the
    ratio in the profile: 1.01 is printed 1 % too large. `sigma` is its spread; `bias` what the
    corners may err systematically. `small_px` is the small marker's side in the picture."""

    value: float
    sigma: float
    bias: float
    frames: int
    small_px: float


@dataclass(frozen=True)
class PrintVerdict:
    """`wrong` names a print error beyond the noise; `text` is one sentence."""

    wrong: bool
    text: str


def size_ratio(
    large_px: Array,
    small_px: Array,
    sigma_px: tuple[float, float],
    camera: CameraModel,
    target: TargetConfig,
) -> SizeRatio | None:
    """From one frame's corners, (4, 2) px each, with the spread of the large and of the
    small marker's: pose and ratio are solved together by least squares.

    None where the corners give no pose, or spread so far that the ratio is unknown.
    """
    X_large, X_small = (marker_corners_m(m.side_m) for m in (target.large, target.small))
    rays = undistort(np.concatenate([large_px, small_px]), camera)
    seen = rays @ camera.K[:2, :2].T + camera.K[:2, 2]
    if not np.isfinite(seen).all() or not all(math.isfinite(s) and s > 0.0 for s in sigma_px):
        return None
    weight = np.repeat(1.0 / np.array(sigma_px), 8)

    def errors(p: Array) -> Array:
        """In sigmas, (16,), by rvec, tvec and the ratio."""
        X = np.concatenate([X_large, p[6] * X_small])
        image, _ = cv2.projectPoints(X, p[:3], p[3:6], camera.K, None)
        return np.asarray(weight * (image.reshape(-1, 2) - seen).ravel())

    try:
        ok, rvec, tvec = cv2.solvePnP(
            X_large, np.ascontiguousarray(seen[:4]), camera.K, None, flags=cv2.SOLVEPNP_SQPNP
        )
        start = np.concatenate([np.ravel(rvec), np.ravel(tvec), [1.0]])
        if not ok or start[5] <= 0.0:
            return None
        found = least_squares(errors, start, method="lm", x_scale="jac")
        covariance = np.linalg.inv(found.jac.T @ found.jac)
    except (cv2.error, ValueError, np.linalg.LinAlgError):
        return None
    if found.x[5] <= 0.0 or found.x[6] <= 0.0:
        return None
    chi2 = 2.0 * float(found.cost) / (len(weight) - len(start))
    sides = [
        float(np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1).mean())
        for quad in (seen[:4], seen[4:])
    ]
    return SizeRatio(
        float(found.x[6]),
        math.sqrt(float(covariance[6, 6]) * max(1.0, chi2)),
        math.hypot(*(2.0 * CORNER_BIAS_PX / side for side in sides)),
        1,
        sides[1],
    )


def combined(ratios: Sequence[SizeRatio]) -> SizeRatio | None:
    """The weighted mean of many frames; its spread is the larger of what the frames claim
    and what they show. None of no frames."""
    if not ratios:
        return None
    value = np.array([r.value for r in ratios])
    weight = np.array([1.0 / max(r.sigma, 1e-9) ** 2 for r in ratios])
    share = weight / weight.sum()
    mean = float(share @ value)
    sigma = float(1.0 / math.sqrt(weight.sum()))
    if len(ratios) > 1:
        shown = float(share**2 @ (value - mean) ** 2) * len(ratios) / (len(ratios) - 1)
        sigma = max(sigma, math.sqrt(shown))
    return SizeRatio(
        mean,
        sigma,
        float(share @ np.array([r.bias for r in ratios])),
        sum(r.frames for r in ratios),
        float(share @ np.array([r.small_px for r in ratios])),
    )


def verdict(ratio: SizeRatio | None, target: TargetConfig) -> PrintVerdict:
    """Names a print error only where it is beyond noise and bias."""
    if ratio is None or ratio.frames < MIN_FRAMES:
        count = 0 if ratio is None else ratio.frames
        return PrintVerdict(
            False,
            f"print not judged: both markers were seen in {count} frames, {MIN_FRAMES} needed",
        )
    off, total = ratio.value - 1.0, math.hypot(ratio.sigma, ratio.bias)
    nominal = target.small.side_m / target.large.side_m
    ratio_text = (
        f"the small marker is {ratio.value * nominal:.4f} of the large one, the profile says "
        f"{nominal:.4f} ({100 * off:+.2f} %, sigma {100 * total:.2f} %)"
    )
    if abs(off) <= max(SIGMAS * total, MIN_ERROR):
        return PrintVerdict(False, f"print good within its noise: {ratio_text}")
    return PrintVerdict(
        True,
        f"print error: {ratio_text}; measure both black squares and give them to "
        f"perchctl make-target measured --measured-large MM --measured-small MM",
    )


@dataclass(eq=False)
class PrintCheck:
    """The ratio of the two markers' apparent sizes over the frames that show both."""

    camera: CameraModel
    target: TargetConfig
    _ratios: list[SizeRatio] = field(default_factory=list)

    def add(self, output: PipelineOutput | None) -> None:
        if output is None:
            return
        large, small = output.detections.large, output.detections.small
        if large is None or small is None or not (large.refined and small.refined):
            return
        ratio = size_ratio(
            large.corners_px,
            small.corners_px,
            (large.sigma_px, small.sigma_px),
            self.camera,
            self.target,
        )
        if ratio is not None:
            self._ratios.append(ratio)
        if len(self._ratios) >= _FOLD:
            mean = combined(self._ratios)
            self._ratios = [] if mean is None else [mean]

    @property
    def judged(self) -> bool:
        """Whether enough frames showed both markers."""
        return sum(ratio.frames for ratio in self._ratios) >= MIN_FRAMES

    def verdict(self) -> PrintVerdict:
        return verdict(combined(self._ratios), self.target)
