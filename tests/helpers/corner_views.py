"""One rendered view for each method that finds corners, in which it finds them, and the truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision import MARKERS, Frame
from perchctl.vision.markers.detect import (
    CORNER_METHODS,
    CornerMethod,
    CornerResults,
    DetectionPrior,
    make_detection_prior,
)
from perchctl.vision.markers.detector import DetectorInput
from perchctl.vision.types import Detection, Detections, MarkerName
from tests.helpers.markers import SETUP, both, corners
from tests.helpers.target_picture import CAMERA, pose_of, render


@dataclass(frozen=True, eq=False)
class View:
    """A picture of the target at a known pose.

    Attributes:
        method: the method that finds the corners of `marker` in it.
        off_px: error of the predicted corners in x and y; None: no target is expected.
        within_px: largest error that the corners in view may have.
    """

    method: str
    marker: MarkerName
    pose: tuple[Array, Array]
    blur_px: float = 0.8
    noise: float = 3.0
    off_px: float | None = None
    within_px: float = 0.1

    @property
    def true_px(self) -> Array:
        return corners(self.marker, self.pose)

    @cached_property
    def image(self) -> NDArray[np.uint8]:
        return render(*self.pose, blur_px=self.blur_px, noise=self.noise)

    @property
    def picture(self) -> DetectorInput:
        return DetectorInput(self.image, None, SETUP, CAMERA)

    @property
    def prior(self) -> DetectionPrior:
        """What is known if the last picture showed both markers at their predicted corners."""
        frame = Frame(0, 0.0, self.image)
        if self.off_px is None:
            return make_detection_prior(frame, None, SETUP, CAMERA)
        at = both(self.pose, self.off_px)
        large, small = (Detection(name, at[name], 0.1, True) for name in MARKERS)
        before = Detections(-1, -1 / 30, large=large, small=small)
        return make_detection_prior(frame, before, SETUP, CAMERA, at)


def _view(method: str, marker: MarkerName, pose: tuple[Array, Array], **looks: float) -> View:
    return View(method=method, marker=marker, pose=pose, **looks)


VIEWS = (
    _view("Edge fit", "large", pose_of(0.03, -0.02, 0.35, 0.7, 0.05, -0.08), off_px=4.0),
    _view("Half-size search", "small", pose_of(-0.005, 0.01, 0.13, 0.4), off_px=30.0),
    _view("Partial-view fit", "large", pose_of(-0.24, 0.02, 0.36, 0.3, 0.05, 0.1), off_px=2.0),
    _view("Photometric fit", "large", pose_of(0.5, 0.2, 1.8, 0.5), off_px=1.0, blur_px=1.2),
    _view("Cut-view fit", "small", pose_of(0.002, -0.03, 0.034, 0.03, 0.01, -0.02), off_px=25.0),
    _view("Search", "large", pose_of(0.1, -0.1, 0.6, 0.5, -0.1, 0.1)),
    _view("Blurred search", "large", pose_of(-0.3, 0.2, 1.6, 0.5), blur_px=6.0, within_px=0.5),
)
"""One for each of `CORNER_METHODS`, in its order."""


def findings(view: View) -> list[tuple[CornerMethod, CornerResults]]:
    """The methods that are used in the view, each with all that was found up to it."""
    picture, prior, found = view.picture, view.prior, CornerResults()
    steps = []
    for method in CORNER_METHODS:
        if method.should_run(picture, prior, found):
            found = method.find(picture, prior, found)
            steps.append((method, found))
    return steps
