"""The live page for one camera: the newest image, and numbers.

The loop only stores references to the newest values. Drawing, JPEG encoding and HTTP are done in
the page's threads; an error there is stored in `problem` and never raised.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.display.serve import Page
from perchctl.geometry import Array
from perchctl.vision import MARKERS, CameraModel, Frame, PipelineOutput, project

LIVE_JPEG_QUALITY = 80
LIVE_WAIT_S = 0.5
_PICTURE_STALE_S = 1.0


class LivePage(Page):
    """Serves one page with the newest image on localhost until closed.

    Args:
        camera: projects the axes to draw.
        title: heading of the page.
        on_land: called when the button Land is pressed, in a thread of the page; None: no buttons.
        on_cut: called in the same way when the button Cut motors is pressed.
    """

    HTML = "page.html"
    HAS_STREAM = True

    def __init__(
        self,
        camera: CameraModel,
        title: str,
        on_land: Callable[[], None] | None = None,
        on_cut: Callable[[], None] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.camera = camera
        self._drawing = threading.Lock()
        self._sketch: Sketch | None = None
        self._number = 0
        self._picture_s = -math.inf
        self._jpeg: tuple[int, bytes] | None = None
        super().__init__(title, {"land": on_land, "cut": on_cut}, clock)

    # --- For the loop: these methods neither wait nor raise ---

    def show(self, sketch: Sketch) -> None:
        """Show `sketch` until the next call."""
        with self._changed:
            self._picture_s, self._sketch = self._clock(), sketch
            self._number += 1
            self._changed.notify_all()

    # --- For the server's threads ---

    @property
    def _is_fresh(self) -> bool:
        """True while images are arriving."""
        return self._clock() - self._picture_s < _PICTURE_STALE_S

    def state(self) -> dict[str, Any]:
        """The result of `Page.state`, with the additional key ``fresh``: True while images are
        arriving."""
        return super().state() | {"fresh": self._is_fresh}

    def picture(self, name: str) -> bytes | None:
        """The newest image; None if no images are arriving. `name` is not used."""
        newest = self.jpeg_after(0) if self._is_fresh else None
        return None if newest is None else newest[1]

    def jpeg_after(self, number: int) -> tuple[int, bytes] | None:
        """Wait for an image newer than `number`; return its number and JPEG, or None on a
        timeout."""
        with self._changed:
            self._changed.wait_for(lambda: self.closed or self._number > number, LIVE_WAIT_S)
            newest, sketch = self._number, self._sketch
            if sketch is None or newest <= number:
                return None
        with self._drawing:  # drawn once for all browsers
            if self._jpeg is None or self._jpeg[0] < newest:
                picture = draw_sketch(sketch, self.camera)
                quality = [cv2.IMWRITE_JPEG_QUALITY, LIVE_JPEG_QUALITY]
                ok, jpeg = cv2.imencode(".jpg", picture, quality)
                if not ok:
                    return None
                self._jpeg = (newest, jpeg.tobytes())
            return self._jpeg


@contextlib.contextmanager
def live_page(
    camera: CameraModel,
    title: str,
    enabled: bool,
    report: Callable[[str], None],
    on_land: Callable[[], None] | None = None,
    on_cut: Callable[[], None] | None = None,
) -> Iterator[LivePage | None]:
    """Serve a page during the block; yield None unless `enabled`. `report` is called with the
    address and, at the end, with the page's problem if there is one. `on_land`, `on_cut`: as in
    `LivePage`."""
    if not enabled:
        yield None
        return
    page = LivePage(camera, title, on_land, on_cut)
    report(
        f"live page{' (with buttons to land and to cut the motors)' if on_cut else ''}: {page.url}"
    )
    try:
        yield page
    finally:
        page.close()
        if page.problem is not None:
            report(f"the live page failed: {page.problem}")


# --- Draw the detections on the image: marker outlines and the target's axes ---


# Colours as blue, green, red.
_OUTLINE = {"large": (0, 200, 255), "small": (255, 200, 0)}
_AXES = ((60, 60, 255), (60, 220, 60), (255, 120, 60))
_OTHER = (255, 255, 255)
_SUBPIXEL_BITS = 4
AXES_OF_SIDE = 0.5
"""Length of the drawn axes, as a multiple of the large marker's side."""
_DRAWABLE_PX = 8000.0  # a line that ends beyond this is not visible, and would overflow OpenCV


@dataclass(frozen=True, eq=False)
class Sketch:
    """An image and the overlay to draw on it; the drawing is done outside the flight loop.

    Attributes:
        image: grey (h, w) uint8; not changed by drawing.
        outlines: name and corners (4, 2) px of each marker.
        pose: the target's rvec (3,) and tvec (3,) in the camera frame, and the length of its axes
            in m; None: no axes.
    """

    image: NDArray[np.uint8]
    outlines: tuple[tuple[str, Array], ...] = ()
    pose: tuple[Array, Array, float] | None = None


def make_sketch(frame: Frame, output: PipelineOutput | None, large_side_m: float) -> Sketch:
    """The frame with its marker outlines and the axes of the target's pose; only the frame
    if `output` is None. `large_side_m` is the side of the large marker."""
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
    """The image with its overlay, BGR (h, w, 3) uint8. Lines far outside the image, and
    axes with a tip behind the camera, are left out."""
    picture = np.asarray(cv2.cvtColor(sketch.image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for name, corners in sketch.outlines:
        _draw_line(picture, np.vstack([corners, corners[:1]]), _OUTLINE.get(name, _OTHER), 1)
    if sketch.pose is not None:
        rvec, tvec, length_m = sketch.pose
        ends = np.vstack([np.zeros(3), np.eye(3) * length_m])
        depth = (ends @ np.asarray(cv2.Rodrigues(rvec)[0]).T + tvec)[:, 2]
        if (depth > 1e-3).all():
            points = project(ends, rvec, tvec, camera)
            for tip, colour in zip(points[1:], _AXES, strict=True):
                _draw_line(picture, np.vstack([points[0], tip]), colour, 2)
    return picture


def _draw_line(
    picture: NDArray[np.uint8], points_px: Array, colour: tuple[int, int, int], width: int
) -> None:
    if np.abs(points_px).max() < _DRAWABLE_PX:  # also False for NaN
        fixed = np.rint(points_px * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        cv2.polylines(picture, [fixed], False, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)
