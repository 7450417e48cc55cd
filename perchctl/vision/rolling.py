"""Corners of a rolling shutter at one moment.

The rows of such a picture are exposed one after the other within the read-out time, and what
moves is sheared, stretched or squeezed: at 20 ms and 0.3 m/s by as much as the target moves in
a few milliseconds. A frame's time is its middle row's. Each corner is moved back along
its own motion in the picture, by the time that its row was exposed later.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.geometry import Array
from perchctl.vision.types import MARKERS, Detection, Detections

UNKNOWN_READOUT_S = 0.012
"""One standard deviation of a camera's read-out time where nobody has said it."""
FLOW_SIGMA, TURN_SIGMA = 0.05, 0.015
"""Of a motion, along and across, as shares of it: it was measured from the frame before to this
one, and changes."""


def seen_at_once(
    detections: Detections, readout_s: float | None, height_px: int
) -> list[Detection]:
    """The markers with their corners at the frame's own time, as far as their motion is known.

    `readout_s` is from a picture's first row to its last; where it is None the corners stay
    where they are, with what a likely read-out would do to them for an error (`common_px`);
    else with what the motion's own error does.
    """
    seen = [d for name in MARKERS if (d := detections.get(name)) is not None]
    if readout_s == 0.0:
        return seen
    late = UNKNOWN_READOUT_S if readout_s is None else readout_s
    out = []
    for d in seen:
        flow = detections.flow_px_s.get(d.marker, detections.velocity_px_s)
        if flow is None:
            out.append(d)
            continue
        # From frame to frame a corner that moves down is also seen later.
        flow = flow / (1.0 + flow[..., 1:] * late / (height_px - 1.0))
        moved_px = flow * _late_s(d.corners_px, late, height_px)
        if readout_s is None:
            out.append(replace(d, common_px=moved_px))
        else:
            turned_px = TURN_SIGMA * float(np.abs(moved_px).max())
            cov_px2 = None if d.cov_px2 is None else d.cov_px2 + turned_px**2 * np.eye(8)
            out.append(
                replace(
                    d,
                    corners_px=d.corners_px - moved_px,
                    sigma_px=float(np.hypot(d.sigma_px, turned_px)),
                    cov_px2=cov_px2,
                    common_px=FLOW_SIGMA * moved_px,
                )
            )
    return out


def _late_s(corners_px: Array, readout_s: float, height_px: int) -> Array:
    """How much later than the middle row each corner's row is exposed, (4, 1)."""
    return np.asarray((corners_px[:, 1:] / (height_px - 1.0) - 0.5) * readout_s)
