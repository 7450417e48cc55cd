"""Find the part of the image that the vehicle itself covers, from images taken while it moves.

While you turn the vehicle in your hand, only its own parts stay the same in the image. These parts
are connected to the image's edge.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.calibration.live import poll_frames
from perchctl.camera import FrameSource
from perchctl.errors import InvalidValue

LIVE_S = 20.0
"""Recording time with a live camera, s."""
LEAST_PICTURES = 20
MOST_GEAR_SHARE = 0.6
_LEAST_MOTION_GREY = 8.0  # smallest spread over time of a pixel that sees the moving room
_STILL_RATIO = 0.3  # fraction of the room's spread below which a pixel belongs to the gear
_LEAST_BLOB_SHARE = 5e-4  # smallest part of the gear, as a fraction of the image
_CLOSED_PX = 7  # width of gaps that are filled; larger: pixels between two parts are covered, too
_DILATION_PX = 3  # margin for blur around the gear; larger: more is covered than the gear hides


def learn_gear_mask(
    source: FrameSource, stopped: Callable[[], bool] = lambda: False
) -> NDArray[np.bool_]:
    """Return the mask (h, w) of the pixels that the vehicle covers, possibly none. The images come
    from a recording, or from a live camera for `LIVE_S` or until `stopped` returns True.

    Raises:
        InvalidValue: too few images, unequal sizes, or too little motion.
    """
    count, start_s = 0, time.monotonic()
    total = squares = np.zeros((0, 0))
    for now_s, frame in poll_frames(source, time.monotonic, time.sleep):
        if stopped() or (source.live and now_s - start_s > LIVE_S):
            break
        if frame is None:
            continue
        soft = cv2.blur(frame.image, (3, 3)).astype(np.float64)
        if count and soft.shape != total.shape:
            raise InvalidValue(
                f"image {count + 1} is {soft.shape[1]}x{soft.shape[0]} px, but the first is "
                f"{total.shape[1]}x{total.shape[0]} px: a mask needs images of the same size"
            )
        total, squares = (soft, soft**2) if not count else (total + soft, squares + soft**2)
        count += 1
    if count < LEAST_PICTURES:
        raise InvalidValue(
            f"{count} images are too few to find the parts that stay the same; at least "
            f"{LEAST_PICTURES} are needed: turn the vehicle around for several seconds"
        )
    spread = np.sqrt(np.maximum(squares / count - (total / count) ** 2, 0.0))
    motion = float(np.percentile(spread, 75.0))
    covered = _connected(spread < _STILL_RATIO * motion)
    share = float(covered.mean())
    if motion < _LEAST_MOTION_GREY or share > MOST_GEAR_SHARE:
        raise InvalidValue(
            "the images hardly change: turn the vehicle around where strong patterns "
            "fill the image, not in front of a plain wall"
        )
    return covered


def _connected(still: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the parts that touch the image's edge, without specks and gaps."""
    clean = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    gap = np.ones((_CLOSED_PX, _CLOSED_PX), np.uint8)
    clean = cv2.morphologyEx(clean, cv2.MORPH_CLOSE, gap)
    n, label, stats, _ = cv2.connectedComponentsWithStats(clean)
    edge = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    kept = np.zeros(n, np.uint8)
    kept[np.unique(edge)] = 1
    kept[stats[:, cv2.CC_STAT_AREA] < _LEAST_BLOB_SHARE * still.size] = 0
    kept[0] = 0
    wide = np.ones((2 * _DILATION_PX + 1, 2 * _DILATION_PX + 1), np.uint8)
    return np.asarray(cv2.dilate(kept[label], wide) > 0)
