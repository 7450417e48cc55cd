"""What is taken for the target without being it: stills with foreign codewords and tiles, then
what steers after a lock (`decoys_tracked.py`).

    python benchmarks/decoys.py [--quick]

Markers whose codeword is a few bits beside the target's, and walls of black and white tiles,
0.7 to 3 blurs a cell (where bits begin to run together), 100 of each a blur. Beside them the
true target and its small marker alone, likewise: what the checks cost. Exit code 1 where more
than 1 of 100 foreign stills is taken, or something steers that is not the target.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from common import CAMERA, Picture, arguments, setup_with, table
from decoys_tracked import report_tracked

from perchctl.geometry import Array
from perchctl.profile import MarkerConfig, aruco_dictionary
from perchctl.vision import Frame
from perchctl.vision.markers.detect import detect_markers

BLURS_PX = (0.6, 1.0, 1.5, 2.0, 2.8, 4.0)
CELLS_IN_BLURS = (0.7, 3.0)
LEAST_SIDE_PX = 13.0
OWN, MOST_FOREIGN = ("the target", "its small marker"), 0.01
DOTS, FINE = 40, 3  # drawn so many dots a cell, rendered so many times finer than the picture
SETUP = setup_with()
LARGE = MarkerConfig(dictionary="DICT_4X4_1000", id=997, side_m=0.150)
SMALL = MarkerConfig(dictionary="DICT_ARUCO_ORIGINAL", id=5, side_m=0.025)

Rng = np.random.Generator
Sheet = Callable[[Rng], Array]


def bits(dictionary: str, index: int) -> Array:
    source = aruco_dictionary(dictionary)
    rows = np.ascontiguousarray(source.bytesList[index : index + 1])
    return np.asarray(cv2.aruco.Dictionary.getBitsFromByteList(rows, source.markerSize), float)


@cache
def beside(marker: MarkerConfig, wrong_bits: int) -> tuple[int, ...]:
    """The dictionary's ids so many bits away, in the nearest turn."""
    own = bits(marker.dictionary, marker.id)
    ids = range(len(aruco_dictionary(marker.dictionary).bytesList))
    return tuple(
        i
        for i in ids
        if min(int((np.rot90(bits(marker.dictionary, i), k) != own).sum()) for k in range(4))
        == wrong_bits
    )


def foreign(marker: MarkerConfig, wrong_bits: int) -> Sheet:
    return lambda rng: bits(marker.dictionary, int(rng.choice(beside(marker, wrong_bits))))


def tiles(rng: Rng) -> Array:
    n = int(rng.integers(14, 40))
    return (rng.random((n, n)) > rng.uniform(0.3, 0.7)).astype(float)


def drawn(cells: Array, small: Array | None = None) -> Array:
    """Whiteness of a sheet with black border and white margin, a cell each; `small` in its
    centre, to scale."""
    dots = np.kron(np.pad(cells, 1), np.ones((DOTS, DOTS)))
    if small is not None:
        side = round(len(dots) * SMALL.side_m / LARGE.side_m)
        first = (len(dots) - side) // 2
        inner = cv2.resize(np.pad(small, 1), (side, side), interpolation=cv2.INTER_NEAREST)
        dots[first : first + side, first : first + side] = inner
    return np.pad(dots, DOTS, constant_values=1.0)


def picture(sheet: Array, cells: int, blur_px: float, rng: Rng) -> Picture:
    """The sheet anywhere, in any turn, a little tilted, blurred, with noise."""
    side_px = max(LEAST_SIDE_PX, cells * blur_px * float(rng.uniform(*CELLS_IN_BLURS)))
    black, white, wall = rng.uniform(15, 60), rng.uniform(150, 235), rng.uniform(60, 160)
    centre = rng.uniform((150, 120), (490, 360))
    angle, tilt = rng.uniform(0, 2 * math.pi), rng.uniform(-0.04, 0.04, 2)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    unit = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = centre + 0.5 * side_px * (unit @ turn.T) / (1.0 + unit @ tilt)[:, None]
    edge = DOTS if cells * DOTS < len(sheet) else 0
    source = (unit + 1.0) * 0.5 * (len(sheet) - 2 * edge) + edge - 0.5
    H = cv2.getPerspectiveTransform(
        source.astype(np.float32), ((corners + 0.5) * FINE - 0.5).astype(np.float32)
    )
    dots_px = cells * DOTS / side_px / FINE
    soft = cv2.GaussianBlur((black + (white - black) * sheet).astype(np.float32), (0, 0),
                            max(0.6, 0.5 * dots_px))  # fmt: skip
    w, h = CAMERA.size_px
    fine = cv2.warpPerspective(soft, H, (w * FINE, h * FINE), borderValue=float(wall))
    small = cv2.GaussianBlur(
        cv2.resize(fine, (w, h), interpolation=cv2.INTER_AREA), (0, 0), blur_px
    )
    noisy = small + rng.normal(0.0, rng.uniform(1.0, 6.0), small.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def cases() -> dict[str, Callable[[Rng, float], Picture]]:
    own = {m.dictionary: bits(m.dictionary, m.id) for m in (LARGE, SMALL)}

    def of(sheet: Sheet, small: Array | None = None) -> Callable[[Rng, float], Picture]:
        def one(rng: Rng, blur_px: float) -> Picture:
            cells = sheet(rng)
            return picture(drawn(cells, small), len(cells) + 2, blur_px, rng)

        return one

    def wall(rng: Rng, blur_px: float) -> Picture:
        cells = tiles(rng)
        return picture(np.kron(cells, np.ones((DOTS, DOTS))), len(cells), blur_px, rng)

    return {
        "ORIGINAL, 3 bits away": of(foreign(SMALL, 3)),
        "4X4_1000, 2 bits away": of(foreign(LARGE, 2)),
        "tiles": wall,
        OWN[0]: of(lambda _: own[LARGE.dictionary], own[SMALL.dictionary]),
        OWN[1]: of(lambda _: own[SMALL.dictionary]),
    }


def main() -> int:
    options = arguments(__doc__ or "")
    pictures = 20 if options.quick else 100
    rows, good = [], True
    for number, (name, make) in enumerate(cases().items()):
        found = []
        for blur_px in BLURS_PX:
            seen = 0
            for i in range(pictures):
                rng = np.random.default_rng([number, int(10 * blur_px), i])
                frame = Frame(0, 0.0, make(rng, blur_px))
                result = detect_markers(frame, None, SETUP.detector_setup, CAMERA)
                seen += result.large is not None or result.small is not None
            good = good and (name in OWN or seen <= MOST_FOREIGN * pictures)
            found.append(str(seen))
        rows.append([name, *found])
    title = f"taken for the target, of {pictures} stills, by blur (sigma, px)"
    table(title, ["", *(f"{b:g}" for b in BLURS_PX)], rows)
    return 0 if report_tracked(2 if options.quick else 6) and good else 1


if __name__ == "__main__":
    sys.exit(main())
