"""The picture with what was found in it: outlines and the target's axes."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import MARKERS, CameraModel, Frame, PipelineOutput, project

# Blue, green, red.
_OUTLINE = {"large": (0, 200, 255), "small": (255, 200, 0)}
_AXES = ((60, 60, 255), (60, 220, 60), (255, 120, 60))
_OTHER = (255, 255, 255)
_SUBPIXEL_BITS = 4
AXES_OF_SIDE = 0.5
"""Length of the drawn axes, in sides of the large marker."""
_FAR_PX = 8000.0  # beyond this a line's end shows nothing, and would overflow


@dataclass(frozen=True, eq=False)
class Sketch:
    """One picture and what to draw into it; made in the loop, drawn elsewhere.

    Attributes:
        image: grey (h, w) uint8; not changed by drawing.
        outlines: marker's name and its corners (4, 2) px.
        pose: rvec (3,) and tvec (3,) of the axes to draw, and their length in m.
    """

    image: NDArray[np.uint8]
    outlines: tuple[tuple[str, Array], ...] = ()
    pose: tuple[Array, Array, float] | None = None


def sketch_of(frame: Frame, output: PipelineOutput | None, large_side_m: float) -> Sketch:
    """Return the frame with the outlines of its markers and the axes of its pose; bare if it was
    not searched. `large_side_m` is the side of the large marker."""
    if output is None or output.detections.frame_index != frame.index:
        return Sketch(frame.image)
    found = ((name, output.detections.get(name)) for name in MARKERS)
    poses = output.poses
    pose = next((poses[name] for name in ("joint", "large", "small") if name in poses), None)
    return Sketch(
        frame.image,
        tuple((name, seen.corners_px) for name, seen in found if seen is not None),
        None if pose is None else (pose.rvec_rad, pose.tvec_m, AXES_OF_SIDE * large_side_m),
    )


def draw_sketch(sketch: Sketch, camera: CameraModel) -> NDArray[np.uint8]:
    """Return the picture in colour (blue, green, red), (h, w, 3) uint8."""
    picture = np.asarray(cv2.cvtColor(sketch.image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for name, corners in sketch.outlines:
        if not np.isfinite(corners).all() or np.abs(corners).max() > _FAR_PX:
            continue
        colour = _OUTLINE.get(name, _OTHER)
        cv2.polylines(
            picture, [_fixed(corners)], True, colour, 1, cv2.LINE_AA, shift=_SUBPIXEL_BITS
        )
        # The first corner, so that the marker's turn can be read.
        x, y = (int(v) for v in _fixed(corners[:1])[0])
        cv2.circle(picture, (x, y), 3 << _SUBPIXEL_BITS, colour, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    if sketch.pose is not None:
        _draw_axes(picture, *sketch.pose, camera)
    return picture


def _draw_axes(
    picture: NDArray[np.uint8], rvec: Array, tvec: Array, length_m: float, camera: CameraModel
) -> None:
    ends = np.vstack([np.zeros(3), np.eye(3) * length_m])
    depth = (ends @ np.asarray(cv2.Rodrigues(rvec)[0]).T + tvec)[:, 2]
    if not (depth > 1e-3).all():
        return  # a tip behind the camera has no place in the picture
    points = project(ends, rvec, tvec, camera)
    if not np.isfinite(points).all() or np.abs(points).max() > _FAR_PX:
        return
    fixed = _fixed(points)
    start = (int(fixed[0, 0]), int(fixed[0, 1]))
    for end, colour in zip(fixed[1:], _AXES, strict=True):
        tip = (int(end[0]), int(end[1]))
        cv2.line(picture, start, tip, colour, 2, cv2.LINE_AA, _SUBPIXEL_BITS)


def _fixed(points_px: Array) -> NDArray[np.int32]:
    """Return pixels as OpenCV's drawing takes them with `shift`."""
    return np.rint(points_px * (1 << _SUBPIXEL_BITS)).astype(np.int32)
