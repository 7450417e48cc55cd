"""The part of the picture that the vehicle itself covers, learned from pictures that move.

While the vehicle is turned about, everything else in the picture changes. What stays the same, and
is connected with the picture's edge, as legs and guards are, is the vehicle.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.camera import Grey
from perchctl.errors import InvalidValue

LEAST_PICTURES = 20
MOST_COVERED = 0.6
_LEAST_MOTION_GREY = 8.0  # spread of a pixel that sees the room go by
_STILL = 0.3  # of that
_LEAST_SHARE = 5e-4  # of the picture, for a part of the gear
_CLOSED_PX, _EDGE_PX = 7, 3  # gaps that are gear; blur around it


@dataclass(frozen=True, eq=False)
class Gear:
    """The vehicle's own gear: `covered` (h, w), and the number of pictures it was learned from."""

    covered: NDArray[np.bool_]
    pictures: int

    @property
    def share(self) -> float:
        """Share of the picture that the vehicle covers."""
        return float(self.covered.mean())

    def png(self) -> bytes:
        """Return the mask as `camera.mask` has it: white is what the vehicle covers."""
        return bytes(cv2.imencode(".png", np.where(self.covered, np.uint8(255), np.uint8(0)))[1])


def learn_gear(pictures: Iterable[Grey]) -> Gear:
    """Learn the gear from grey pictures (h, w) of one size, in which everything else moves.

    Raises:
        InvalidValue: too few pictures, unequal sizes, too little motion, or nothing found.
    """
    count = 0
    total = squares = np.zeros((0, 0))
    for picture in pictures:
        soft = cv2.blur(picture, (3, 3)).astype(np.float64)
        if count and soft.shape != total.shape:
            raise InvalidValue(
                f"picture {count + 1} is {soft.shape[1]}x{soft.shape[0]} px, the first "
                f"{total.shape[1]}x{total.shape[0]}: a mask belongs to one size"
            )
        total, squares = (soft, soft**2) if not count else (total + soft, squares + soft**2)
        count += 1
    if count < LEAST_PICTURES:
        raise InvalidValue(
            f"{count} pictures are too few to see what stays the same in them, at least "
            f"{LEAST_PICTURES} are needed: turn the vehicle about for some seconds"
        )
    spread = np.sqrt(np.maximum(squares / count - (total / count) ** 2, 0.0))
    motion = float(np.percentile(spread, 75.0))
    if motion < _LEAST_MOTION_GREY:
        raise InvalidValue(
            f"the pictures hardly change (by {motion:.1f} grey levels, at least "
            f"{_LEAST_MOTION_GREY:g} are needed): turn the vehicle about in front of something "
            f"with strong patterns, not a plain wall"
        )
    covered = _connected(spread < _STILL * motion)
    share = float(covered.mean())
    if share == 0.0:
        raise InvalidValue(
            "nothing stays the same in the pictures: the vehicle covers nothing, and "
            "camera.mask is not needed"
        )
    if share > MOST_COVERED:
        raise InvalidValue(
            f"{100 * share:.0f} % of the picture stay the same: turn the vehicle about in front "
            f"of something with strong patterns all over the picture"
        )
    return Gear(covered, count)


def _connected(still: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the parts that reach the picture's edge, without specks and gaps."""
    clean = cv2.morphologyEx(still.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    gap = np.ones((_CLOSED_PX, _CLOSED_PX), np.uint8)
    clean = cv2.morphologyEx(clean, cv2.MORPH_CLOSE, gap)
    n, label, stats, _ = cv2.connectedComponentsWithStats(clean)
    edge = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    kept = np.zeros(n, np.uint8)
    kept[np.unique(edge)] = 1
    kept[stats[:, cv2.CC_STAT_AREA] < _LEAST_SHARE * still.size] = 0
    kept[0] = 0
    wide = np.ones((2 * _EDGE_PX + 1, 2 * _EDGE_PX + 1), np.uint8)
    return np.asarray(cv2.dilate(kept[label], wide) > 0)
