"""Your own detector: OpenCV's ArUco with its own corners, instead of perchctl's edges.

In the profile: `detector: {own: "own_detector:corners"}`. Everything behind the corners stays:
pose, covariance, filter, planner. A neural network fits here as well.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

Corners = NDArray[np.float64]
SIGMA_PX = 0.4  # a corner's standard deviation: the pose's covariance follows from it

DICTIONARIES = {
    "large": (cv2.aruco.DICT_4X4_1000, 997),
    "small": (cv2.aruco.DICT_ARUCO_ORIGINAL, 5),
}
PARAMETERS = cv2.aruco.DetectorParameters()
PARAMETERS.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
DETECTORS = {
    name: cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary), PARAMETERS)
    for name, (dictionary, _) in DICTIONARIES.items()
}


def corners(image: NDArray[np.uint8]) -> dict[str, tuple[Corners, float]]:
    """Return each marker's corners (4, 2) px and their standard deviation, px."""
    found: dict[str, tuple[Corners, float]] = {}
    for name, (_, marker_id) in DICTIONARIES.items():
        squares, ids, _ = DETECTORS[name].detectMarkers(image)
        for square, number in zip(squares, [] if ids is None else ids.ravel(), strict=True):
            if number == marker_id:
                found[name] = np.asarray(square, np.float64).reshape(4, 2), SIGMA_PX
    return found
