"""The markers of two fields, at the moment half way between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.geometry import Array
from perchctl.vision.markers.square import mean_side_px
from perchctl.vision.types import MARKERS, Detection, Detections

_MOST_SIDES = 1.5  # of the marker: the small one at 1.9 m/s


def between(a: Detections, b: Detections) -> Detections:
    """The mean of both fields' corners, which is right for either order of the fields.

    A marker that only one field shows is left out where the other marker is in both: the
    two would belong to different moments. Nothing lies between two different targets.
    """
    both = {
        name: _middle(one, other)
        for name in MARKERS
        if (one := a.get(name)) is not None
        and (other := b.get(name)) is not None
        and _is_one(one.corners_px, other.corners_px)
    }
    if not both:
        alone = a if a.large is not None or a.small is not None else b
        return replace(alone, mirrored=alone.mirrored or b.mirrored)
    return replace(a, large=both.get("large"), small=both.get("small"), mirrored=False)


def _is_one(a_px: Array, b_px: Array) -> bool:
    """Whether a marker can have moved from one place to the other between the fields."""
    moved_px = float(np.linalg.norm(a_px.mean(axis=0) - b_px.mean(axis=0)))
    return moved_px < _MOST_SIDES * mean_side_px(a_px)


def _middle(a: Detection, b: Detection) -> Detection:
    """Each field has its own noise, so the mean is surer than either."""
    return Detection(
        a.marker,
        (a.corners_px + b.corners_px) / 2.0,
        ((a.sigma_px**2 + b.sigma_px**2) / 4.0) ** 0.5,
        a.refined and b.refined,
        max(a.shift_sigma_px, b.shift_sigma_px),
        cov_px2=_mean_cov_px2(a, b),
        row_sigma_px=((a.row_sigma_px**2 + b.row_sigma_px**2) / 4.0) ** 0.5,
        lying_sigma_px=((a.lying_sigma_px**2 + b.lying_sigma_px**2) / 4.0) ** 0.5,
    )


def _mean_cov_px2(a: Detection, b: Detection) -> Array | None:
    """None where in both the corners spread alike."""
    if a.cov_px2 is None and b.cov_px2 is None:
        return None
    one, other = (d.sigma_px**2 * np.eye(8) if d.cov_px2 is None else d.cov_px2 for d in (a, b))
    return np.asarray((one + other) / 4.0)
