"""How the markers move from picture to picture, and where that leads them."""

from __future__ import annotations

import numpy as np

from perchctl.geometry import Array
from perchctl.values import replace
from perchctl.vision.types import MARKERS, Detections, MarkerName

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
