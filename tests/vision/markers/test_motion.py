from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.vision import Detection, Detections
from perchctl.vision.markers.detect import predicted_corners, with_motion
from tests.helpers.markers import box


def seen(large: tuple[float, float], t_s: float = 0.0) -> Detections:
    return Detections(0, t_s, Detection("large", box(*large, 80.0), 0.1, True))


def test_corners_move_on_as_they_moved() -> None:
    moving = replace(seen((300, 200)), velocity_px_s=np.array([600.0, -300.0]))
    expected = predicted_corners(moving, 0.1)
    assert np.allclose(expected["large"].mean(axis=0), [360.0, 170.0])
    stale = predicted_corners(moving, 0.9)
    assert np.allclose(stale["large"].mean(axis=0), [300.0, 200.0])
    assert predicted_corners(None, 0.1) == {}


def test_motion_is_that_between_two_pictures() -> None:
    first = seen((300, 200))
    second = with_motion(seen((306, 197), 0.05), first)
    assert np.allclose(predicted_corners(second, 0.1)["large"].mean(axis=0), [312.0, 194.0])
    for earlier in (None, Detections(0, 0.0), replace(first, t_s=-1.0), replace(first, t_s=0.05)):
        still = with_motion(seen((306, 197), 0.05), earlier)
        assert still.velocity_px_s is None
        assert still.flow_px_s == {}
