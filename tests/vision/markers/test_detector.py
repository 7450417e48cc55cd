from __future__ import annotations

import cv2
import numpy as np

from perchctl.profile import DetectorConfig, MarkerConfig, TargetConfig, aruco_dictionary
from perchctl.vision import make_aruco_detector
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.detector import MIRROR_INDEX
from tests.helpers.markers import frame
from tests.helpers.target_picture import CAMERA


def test_a_marker_like_its_own_mirror_image_gives_no_hint() -> None:
    target = TargetConfig(small=MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=0, side_m=0.025))
    usual = make_aruco_detector(DetectorConfig(), TargetConfig())
    assert [len(d.bytesList) for d in usual.dictionaries] == [1 + MIRROR_INDEX, 1 + MIRROR_INDEX]
    setup = make_aruco_detector(DetectorConfig(), target)
    bits = aruco_dictionary("DICT_ARUCO_ORIGINAL")
    grid = cv2.aruco.Dictionary.getBitsFromByteList(np.ascontiguousarray(bits.bytesList[0:1]), 5)
    symmetric = any(np.array_equal(np.rot90(grid, k), grid[:, ::-1]) for k in range(4))
    assert symmetric
    assert [len(d.bytesList) for d in setup.dictionaries] == [1 + MIRROR_INDEX, 1]


def test_correction_bits_are_the_profiles() -> None:
    grid = cv2.aruco.Dictionary.getBitsFromByteList(
        np.ascontiguousarray(aruco_dictionary("DICT_ARUCO_ORIGINAL").bytesList[5:6]), 5
    )
    for wrong in range(4):
        bits = grid.copy()
        bits.ravel()[[6, 12, 18][:wrong]] ^= 1
        cells = np.pad(bits, 1)
        image = np.full((480, 640), 230, np.uint8)
        image[150:290, 250:390] = np.where(np.kron(cells, np.ones((20, 20))) > 0, 230, 20)
        for allowed in range(4):
            setup = make_aruco_detector(
                DetectorConfig(correction_bits_small=allowed), TargetConfig()
            )
            found = detect_markers(frame(image), None, setup, CAMERA)
            assert (found.small is not None) == (wrong <= allowed), (wrong, allowed)
