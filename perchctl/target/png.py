"""A page as a PNG that holds its resolution."""

from __future__ import annotations

import math
import struct
import zlib

import cv2
import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.target.page import Circle, Filled, Item, Line, Page, Polygon, Text, text_width

DPI_RANGE = (50, 1200)
MAX_PIXELS = 200_000_000
_SHIFT = 6  # fractional bits of cv2's coordinates
_MM_PER_INCH = 25.4
_SUPERSAMPLING = 4  # of texts


def png_bytes(page: Page, dpi: int) -> bytes:
    """One page in grey: every pixel the mean of its area for the black squares and the
    straight lines. The resolution is written into the file, so that it prints true to size.

    Raises InvalidValue for a resolution outside `DPI_RANGE` or a picture too large.
    """
    if not DPI_RANGE[0] <= dpi <= DPI_RANGE[1]:
        raise InvalidValue(
            f"--png {dpi}: the resolution must be {DPI_RANGE[0]} to {DPI_RANGE[1]} dpi"
        )
    px = dpi / _MM_PER_INCH
    width, height = round(page.width * px), round(page.height * px)
    if width * height > MAX_PIXELS:
        raise InvalidValue(
            f"--png {dpi}: {width} x {height} pixels are too many; take fewer dpi or the PDF"
        )
    image = np.full((height, width), 255, np.uint8)
    for item in page.items:
        _draw(image, item, px)
    ok, data = cv2.imencode(".png", image)
    assert ok
    return _with_resolution(data.tobytes(), dpi)


def _draw(image: NDArray[np.uint8], item: Item, px: float) -> None:
    match item:
        case Filled(boxes):
            _fill(image, [tuple(px * v for v in box) for box in boxes])
        case Line():
            _fill(image, [tuple(px * v for v in box) for box in _strips(item)])
        case Polygon(points):
            at = np.rint((np.array(points) * px - 0.5) * 2**_SHIFT).astype(np.int32)
            cv2.fillPoly(image, [at], (0,), cv2.LINE_AA, _SHIFT)
        case Circle(x, y, radius, width):
            centre = tuple(round((v * px - 0.5) * 2**_SHIFT) for v in (x, y))
            cv2.circle(
                image,
                centre,
                round(radius * px * 2**_SHIFT),
                (0,),
                max(1, round(width * px)),
                cv2.LINE_AA,
                _SHIFT,
            )
        case Text():
            _write(image, item, px)


def _strips(line: Line) -> list[tuple[float, float, float, float]]:
    """An upright or level line, dashed or not, as boxes."""
    upright = line.x0 == line.x1
    if not upright and line.y0 != line.y1:
        raise ValueError("only upright and level lines are drawn")
    a, b = sorted((line.y0, line.y1) if upright else (line.x0, line.x1))
    count = max(1, math.ceil((b - a) / (2 * line.dash))) if line.dash else 1
    boxes = []
    for i in range(count):
        start = a + 2 * line.dash * i
        length = min(line.dash, b - start) if line.dash else b - a
        if upright:
            boxes.append((line.x0 - line.width / 2, start, line.width, length))
        else:
            boxes.append((start, line.y0 - line.width / 2, length, line.width))
    return boxes


def _fill(image: NDArray[np.uint8], boxes: list[tuple[float, ...]]) -> None:
    """Disjoint black boxes (x, y, w, h) in px; touching ones add up to full black."""
    left = max(0, math.floor(min(b[0] for b in boxes)))
    top = max(0, math.floor(min(b[1] for b in boxes)))
    right = min(image.shape[1], math.ceil(max(b[0] + b[2] for b in boxes)))
    bottom = min(image.shape[0], math.ceil(max(b[1] + b[3] for b in boxes)))
    ink = np.zeros((bottom - top, right - left), np.float32)
    for x, y, w, h in boxes:
        columns, rows = _cover(left, right, x, x + w), _cover(top, bottom, y, y + h)
        c, r = np.flatnonzero(columns), np.flatnonzero(rows)
        if len(c) and len(r):
            part = (slice(r[0], r[-1] + 1), slice(c[0], c[-1] + 1))
            ink[part] += np.outer(rows[part[0]], columns[part[1]]).astype(np.float32)
    area = image[top:bottom, left:right]
    area[:] = np.rint(area * (1.0 - np.minimum(ink, 1.0))).astype(np.uint8)


def _cover(start: int, stop: int, low: float, high: float) -> Array:
    """Share of each pixel of start..stop that lies between low and high."""
    edges = np.arange(start, stop + 1, dtype=np.float64)
    return np.asarray(np.diff(np.clip(edges, low, high)))


def _write(image: NDArray[np.uint8], item: Text, px: float) -> None:
    """OpenCV's strokes, fitted to the width that the layout reckons with."""
    width = text_width(item.text, item.size)
    face, fine = cv2.FONT_HERSHEY_SIMPLEX, _SUPERSAMPLING
    size_px = item.size * px * fine
    scale = cv2.getFontScaleFromHeight(face, max(1, round(0.72 * size_px)))
    thick = 1
    (drawn, ascent), descent = cv2.getTextSize(item.text, face, scale, thick)
    patch = np.full((ascent + descent + 2 * thick, drawn + 2 * thick), 255, np.uint8)
    cv2.putText(patch, item.text, (thick, ascent + thick), face, scale, (0,), thick, cv2.LINE_AA)
    target = (
        max(1, round(width * px * patch.shape[1] / drawn)),
        max(1, round(patch.shape[0] / fine)),
    )
    patch = np.asarray(cv2.resize(patch, target, interpolation=cv2.INTER_AREA), np.uint8)
    back = {"start": 0.0, "middle": 0.5, "end": 1.0}[item.anchor] * width
    base = round((ascent + thick) / fine)
    if item.upwards:
        patch = np.ascontiguousarray(np.rot90(patch))
        left = round(item.x * px) - base
        top = round((item.y + back) * px) - patch.shape[0]
    else:
        left, top = round((item.x - back) * px), round(item.y * px) - base
    rows = slice(max(top, 0), min(top + patch.shape[0], image.shape[0]))
    columns = slice(max(left, 0), min(left + patch.shape[1], image.shape[1]))
    if rows.start < rows.stop and columns.start < columns.stop:
        inner = patch[
            rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
        ]
        image[rows, columns] = np.minimum(image[rows, columns], inner)


def _with_resolution(png: bytes, dpi: int) -> bytes:
    """The same file with a pHYs chunk (pixels per metre) behind its header."""
    header_end = 8 + 4 + 4 + 13 + 4  # signature, then length, type, data and CRC of IHDR
    per_m = round(dpi / _MM_PER_INCH * 1e3)
    body = b"pHYs" + struct.pack(">IIB", per_m, per_m, 1)
    chunk = struct.pack(">I", 9) + body + struct.pack(">I", zlib.crc32(body))
    return png[:header_end] + chunk + png[header_end:]
