"""Pictures from a vehicle that is turned about, with its own legs in them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.vision import Frame

SIZE_PX = (320, 240)


def legs(size_px: tuple[int, int] = SIZE_PX) -> NDArray[np.bool_]:
    """Two of them, from the left and from below, (h, w)."""
    w, h = size_px
    drawn = np.zeros((h, w), np.uint8)
    cv2.line(drawn, (0, h // 2), (w // 3, h // 3), 1, max(w // 24, 3))
    cv2.line(drawn, (2 * w // 3, h - 1), (w // 2, 2 * h // 3), 1, max(w // 24, 3))
    return drawn > 0


def turned_about(
    count: int = 24, contrast: float = 60.0, covered: NDArray[np.bool_] | None = None
) -> list[NDArray[np.uint8]]:
    """Pictures of a room that goes by, with noise, behind the legs."""
    w, h = SIZE_PX
    rng = np.random.default_rng(3)
    room = cv2.resize(rng.normal(0.0, 1.0, (40, 60)), (4 * w, 4 * h), interpolation=cv2.INTER_CUBIC)
    gear = legs() if covered is None else covered
    pictures = []
    for _ in range(count):
        x, y = rng.integers(0, 3 * w), rng.integers(0, 3 * h)
        picture = 120.0 + contrast * room[y : y + h, x : x + w]
        picture = np.where(gear, 30.0, picture)
        soft = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0.0, 3.0, (h, w))
        pictures.append(np.clip(soft, 0, 255).astype(np.uint8))
    return pictures


class Pictures:
    """A recording of these pictures."""

    live, size_px = False, SIZE_PX
    trouble: str | None = None
    """What is wrong with the source once its pictures are over; None: it has ended."""

    def __init__(self, pictures: list[NDArray[np.uint8]]) -> None:
        self._left = [Frame(k, k / 10.0, picture) for k, picture in enumerate(pictures)]

    @property
    def finished(self) -> bool:
        return not (self._left or self.trouble)

    def poll(self, now_s: float) -> Frame | None:
        return self._left.pop(0) if self._left else None

    def problem(self, now_s: float) -> str | None:
        return self.trouble

    def describe(self) -> str:
        return "pictures"

    def close(self) -> None:
        pass


def write_turned_about(folder: Path) -> None:
    folder.mkdir()
    for k, picture in enumerate(turned_about()):
        cv2.imwrite(str(folder / f"{k:02d}.png"), picture)
