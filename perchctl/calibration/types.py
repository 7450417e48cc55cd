"""The values of a calibration, from pictures to the report."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import CameraModel

Grey = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class BoardView:
    """One picture of the board.

    Attributes:
        name: of the file, or the frame's number.
        size_px: the picture's width and height.
        ids: number of each corner on the board, (n,).
        object_m: the corners on the board, z = 0, (n, 3).
        corners_px: in the picture, pixel (0, 0) is the centre of the top-left one, (n, 2).
        blur_px: median spread of the edges at the corners (tanh width).
    """

    name: str
    size_px: tuple[int, int]
    ids: NDArray[np.intp]
    object_m: Array
    corners_px: Array
    blur_px: float = 0.0

    def __len__(self) -> int:
        return len(self.ids)

    def keep(self, which: NDArray[np.bool_]) -> BoardView:
        """The same view with some of its corners."""
        return BoardView(
            self.name,
            self.size_px,
            self.ids[which],
            self.object_m[which],
            self.corners_px[which],
            self.blur_px,
        )


@dataclass(frozen=True, eq=False)
class Solution:
    """A bundle adjustment's minimum.

    Attributes:
        poses: rvec and tvec of each view's board in the camera frame, (v, 6).
        residuals_px: found minus modelled corners of each view, (n, 2) each.
        rms_px: over all corners (root mean of squared distances, as OpenCV's).
        covariance: of the lens parameters (fx, fy, cx, cy, then distortion), (p, p).
    """

    camera: CameraModel
    poses: Array
    residuals_px: tuple[Array, ...]
    rms_px: float
    covariance: Array

    @property
    def parameters(self) -> Array:
        K = self.camera.K
        return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], self.camera.dist])

    @property
    def std(self) -> Array:
        return np.sqrt(np.diag(self.covariance))

    def view_rms_px(self) -> Array:
        """RMS distance of each view, (v,)."""
        return np.array([np.sqrt((r**2).sum(axis=1).mean()) for r in self.residuals_px])


@dataclass(frozen=True)
class Rejection:
    """A view, or corners of a view, left out, and why."""

    view: str
    reason: str
    corners: tuple[int, ...] = ()  # empty: the whole view


@dataclass(frozen=True)
class Lack:
    """What a calibration lacks, and what would mend it."""

    what: str
    advice: str

    def __str__(self) -> str:
        return f"{self.what}: {self.advice}"


@dataclass(frozen=True)
class ModelScore:
    """How a lens model predicts views it was not fitted to."""

    model: str
    rms_px: float | None  # None: it could not be fitted
    held_out_px: float | None
    per_view_px: tuple[float, ...] = field(default=(), repr=False)
    note: str = ""


@dataclass(frozen=True)
class RangeError:
    """95 % line of the target's position error at one distance.

    mm95: the worst place of those where the target is seen whole and the boards were seen,
    so that it rests on corners and not on what the lens model says beyond them;
    axis_mm95: straight ahead of the camera.
    """

    z_m: float
    mm95: float
    axis_mm95: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """The result of a calibration.

    Attributes:
        views: those used, without rejected corners; `solution` belongs to them.
        seen: all views in which the board was found, as found.
        missing: pictures without a board, and why.
        covered: the picture's cells (rows, columns) that boards were seen in.
        lacks: what keeps it from being a good one, whatever its error.
        ray_rms_px95, ray_max_px95: 95 % lines of the ray error over the image, RMS and
            worst place, in px.
    """

    board: str
    solution: Solution
    views: tuple[BoardView, ...]
    seen: tuple[BoardView, ...]
    rejections: tuple[Rejection, ...]
    missing: tuple[Rejection, ...]
    scores: tuple[ModelScore, ...]
    recommended: str
    errors: tuple[RangeError, ...]
    ray_rms_px95: float
    ray_max_px95: float
    covered: NDArray[np.bool_]
    lacks: tuple[Lack, ...] = ()

    @property
    def camera(self) -> CameraModel:
        return self.solution.camera
