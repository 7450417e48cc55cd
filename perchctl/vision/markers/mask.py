"""The vehicle's own gear in the picture: where it is, nothing is to be seen of a target.

Legs and guards do not move in the picture, so what they cover is known (`camera.mask`). There the
picture is filled with what is around it, so that no threshold joins the gear to a marker's rim,
and no side or cell is measured.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.geometry import Array
from perchctl.vision.types import Frame

Covered = NDArray[np.bool_]
WITH_WHITE = 1.25
"""Half sides from a marker's centre within which anything spoils its sides' measurement."""
_FIELD_ROWS = 7  # of a field's picture, that a covered row has a part in
_REDUCED, _SPREAD = 8, 2.0  # times smaller, and there the spread of what fills
_TINY = 1e-4


@dataclass(frozen=True, eq=False)
class GearMask:
    """Where the vehicle covers a picture (h, w), and where it has a part in one made of a
    single field, whose missing rows are interpolated."""

    whole: Covered
    field: Covered


def make_mask(covered: Covered) -> GearMask:
    """From where the gear is in the picture (h, w)."""
    rows = np.ones((_FIELD_ROWS, 1), np.uint8)
    return GearMask(covered, cv2.dilate(covered.astype(np.uint8), rows) > 0)


def hidden_in(frame: Frame, mask: GearMask | None) -> Covered | None:
    """Where a frame of one moment shows the vehicle."""
    if mask is None:
        return None
    return mask.field if frame.fields in ("top", "bottom") else mask.whole


def filled(image: NDArray[np.uint8], hidden: Covered) -> NDArray[np.uint8]:
    """The picture with what is hidden replaced by the mean of what is around it."""
    h, w = image.shape
    free = (~hidden).astype(np.float32)
    size = (max(w // _REDUCED, 1), max(h // _REDUCED, 1))

    def around(values: NDArray[np.float32]) -> NDArray[np.float32]:
        reduced = cv2.resize(values, size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.GaussianBlur(reduced, (0, 0), _SPREAD), np.float32)

    mean = cv2.mean(image, (~hidden).astype(np.uint8))[0]
    grey = (around(image * free) + _TINY * mean) / (around(free) + _TINY)
    smooth = cv2.resize(grey, (w, h), interpolation=cv2.INTER_LINEAR)
    return np.where(hidden, np.rint(smooth).astype(np.uint8), image)


def hides(hidden: Covered | None, corners_px: Array, reach: float = WITH_WHITE) -> bool:
    """Whether a part of the marker with these corners (4, 2) is hidden, as far as `reach` half
    sides from its centre."""
    if hidden is None:
        return False
    h, w = hidden.shape
    centre = corners_px.mean(axis=0)
    wide = centre + reach * (corners_px - centre)
    if not np.isfinite(wide).all():
        return False
    low = np.clip(np.floor(wide.min(axis=0)), 0, (w - 1, h - 1)).astype(int)
    high = np.clip(np.ceil(wide.max(axis=0)), 0, (w - 1, h - 1)).astype(int)
    part = hidden[low[1] : high[1] + 1, low[0] : high[0] + 1]
    if not part.any():
        return False
    inside = np.zeros(part.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(wide - low).astype(np.int32), 1)
    return bool((part & (inside > 0)).any())
