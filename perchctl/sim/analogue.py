"""Faults of an analogue video link: lines that tremble, hum bars, torn and lost lines."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

LINE_JITTER_PX = 1.2
HUM_GREY = 18.0
TEAR_PX = 30.0
TEARS_PER_FRAME = 1.5
SNOW_LINES_PER_FRAME = 12.0
"""Means at full strength."""


def spoil(image: NDArray[np.uint8], strength: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture as a receiver shows it; `strength` 0 (clean) .. 1 (about to be lost)."""
    height, width = image.shape
    shift = np.asarray(rng.standard_normal(height) * LINE_JITTER_PX * strength)
    for _ in range(rng.poisson(TEARS_PER_FRAME * strength)):
        start, length = int(rng.integers(height)), int(rng.integers(4, 40))
        # A torn band comes back to its place over its length, as the receiver's line lock does.
        band = slice(start, min(start + length, height))
        fade = np.linspace(1.0, 0.0, length)[: band.stop - band.start]
        shift[band] += rng.normal(0.0, TEAR_PX * strength) * fade
    cols, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    cols = cols + shift[:, None].astype(np.float32)
    out = cv2.remap(image, cols, rows.astype(np.float32), cv2.INTER_LINEAR,
                    borderMode=cv2.BORDER_REPLICATE).astype(np.float32)  # fmt: skip
    phase, bars = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.7, 2.5)
    hum = np.sin(2.0 * np.pi * bars * np.arange(height) / height + phase)
    out += (HUM_GREY * strength * hum)[:, None].astype(np.float32)
    for _ in range(rng.poisson(SNOW_LINES_PER_FRAME * strength)):
        row, left = int(rng.integers(height)), int(rng.integers(width))
        length = int(min(rng.exponential(0.3 * width) + 1.0, width - float(left)))
        out[row, left : left + length] = rng.uniform(0.0, 255.0, size=length)
    return np.clip(np.rint(out), 0.0, 255.0).astype(np.uint8)
