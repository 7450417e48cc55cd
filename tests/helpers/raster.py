"""PDF pages as pictures, and edges in them to a hundredth of a pixel."""

from __future__ import annotations

import numpy as np
import pypdfium2  # type: ignore[import-untyped]
from numpy.typing import NDArray

DPI = 600
PX_PER_MM = DPI / 25.4


def page_picture(pdf: bytes, page: int, dpi: int = DPI) -> NDArray[np.uint8]:
    document = pypdfium2.PdfDocument(pdf)
    try:
        bitmap = document[page].render(scale=dpi / 72.0, grayscale=True)
        return np.array(bitmap.to_numpy(), np.uint8).reshape(bitmap.height, bitmap.width)
    finally:
        document.close()


def black_runs_mm(line: NDArray[np.uint8], dpi: int = DPI) -> list[tuple[float, float]]:
    """Start and end of every dark run of a row or column, mm, from the grey at its ends."""
    dark = line < 128
    edges = np.flatnonzero(np.diff(np.concatenate([[False], dark, [False]]).astype(int)))
    ink = 1.0 - line.astype(float) / 255.0
    runs = []
    for start, stop in edges.reshape(-1, 2):
        before = ink[start - 1] if start > 0 else 0.0
        after = ink[stop] if stop < len(line) else 0.0
        low = start + (1.0 - ink[start]) - before
        high = stop - (1.0 - ink[stop - 1]) + after
        runs.append((low * 25.4 / dpi, high * 25.4 / dpi))
    return runs
