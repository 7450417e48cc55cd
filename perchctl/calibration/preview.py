"""The lens as the views taken so far have it, while more are being taken.

It is solved on a thread of its own, one solve at a time, each of the newest views: the
capture is never held up, and what does not solve yet leaves the last lens where it is.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.bundle import NoSolution, start_fit
from perchctl.calibration.enough import MIN_VIEWS
from perchctl.calibration.solve import robust_fit, usable
from perchctl.calibration.types import BoardView
from perchctl.errors import InvalidValue
from perchctl.vision import CameraModel, distort, undistort

_WIDEST = 2.5  # tangent of half of the widest field that is drawn flat: 68 deg


@dataclass(frozen=True, eq=False)
class UndistortedView:
    """How to draw the camera's pictures without its distortion.

    Attributes:
        places_px: where in the picture each pixel of the flat one is found, (h, w, 2) float32.
        views: of which the lens was solved.
    """

    places_px: NDArray[np.float32]
    views: int


class LensPreview:
    """`offer` the views, and take the newest `flat`: None until a lens is found."""

    def __init__(self) -> None:
        self.flat: UndistortedView | None = None
        self._offered = 0
        self._thread: threading.Thread | None = None

    def offer(self, views: Sequence[BoardView]) -> None:
        """Solve from these views, if they are enough, more than before, and no other solve is
        under way. Returns at once."""
        if len(views) < MIN_VIEWS or len(views) == self._offered:
            return
        if self._thread is not None and self._thread.is_alive():
            return
        self._offered = len(views)
        self._thread = threading.Thread(
            target=self._solve, args=(tuple(views),), name="lens preview", daemon=True
        )
        self._thread.start()

    def join(self) -> None:
        """Wait for the solve that is under way."""
        if self._thread is not None:
            self._thread.join()

    def _solve(self, views: tuple[BoardView, ...]) -> None:
        camera = _lens_of(views)
        if camera is not None:
            self.flat = UndistortedView(flat_places_px(camera), len(views))


def _lens_of(views: Sequence[BoardView]) -> CameraModel | None:
    """By the model that the views follow, or the fisheye's, which never folds back."""
    try:
        robust = robust_fit(views)
        fit = robust.fit if usable(robust.fit) else start_fit(robust.views, "fisheye")
    except (InvalidValue, NoSolution, np.linalg.LinAlgError, cv2.error):
        return None
    return fit.camera if usable(fit) else None


def flat_places_px(camera: CameraModel) -> NDArray[np.float32]:
    """Of each pixel of a pinhole's picture, its place in the camera's, (h, w, 2) float32. The
    pinhole sees the middle row of the camera's from rim to rim."""
    w, h = camera.size_px
    cx, cy = camera.K[0, 2], camera.K[1, 2]
    rims = np.abs(undistort(np.array([[0.0, cy], [w - 1.0, cy]]), camera)[:, 0])
    reach = float(np.clip(np.nan_to_num(rims, nan=_WIDEST), 0.0, _WIDEST).max())
    f = max(cx, w - 1.0 - cx) / reach
    xs, ys = np.meshgrid((np.arange(w) - cx) / f, (np.arange(h) - cy) / f)
    places = distort(np.column_stack([xs.ravel(), ys.ravel()]), camera)
    return places.reshape(h, w, 2).astype(np.float32)
