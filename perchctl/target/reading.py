"""Reading the target with OpenCV's detector as it comes: what one picture alone gives,
without the memory of the last one and without perchctl's own refinements."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.profile import MarkerConfig, TargetConfig, aruco_dictionary
from perchctl.vision import MARKERS, MarkerName


class PlainReader:
    """cv2.aruco with its default parameters, and for each marker a dictionary of just
    its id (the other ids of a nested dictionary are not searched)."""

    def __init__(self, target: TargetConfig) -> None:
        dictionaries = [_own(target.large), _own(target.small)]
        self._detector: Any = cv2.aruco.ArucoDetector(dictionaries, cv2.aruco.DetectorParameters())

    def read(self, image: NDArray[np.uint8]) -> dict[MarkerName, NDArray[np.float32]]:
        """Corners (4, 2) px of the markers in a grey picture (TL TR BR BL)."""
        corners, ids, _, which = self._detector.detectMarkersMultiDict(image)
        if ids is None or len(corners) == 0:
            return {}
        return {
            MARKERS[int(dictionary)]: np.asarray(quad, np.float32).reshape(4, 2)
            for quad, dictionary in zip(corners, np.asarray(which).ravel(), strict=True)
        }


def _own(marker: MarkerConfig) -> Any:
    source = aruco_dictionary(marker.dictionary)
    return cv2.aruco.Dictionary(
        np.ascontiguousarray(source.bytesList[marker.id : marker.id + 1]), source.markerSize, 0
    )
