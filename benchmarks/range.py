"""Smallest side (px) at which a marker is found in 90 % of frames, by degradation: the
plain detector, ours on single frames, and ours where the frame before showed the target."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from common import (
    CAMERA,
    Picture,
    arguments,
    camera_pose,
    in_view,
    plain_detect,
    renderer,
    setup_with,
    table,
    true_corners,
)

from perchctl.geometry import Array
from perchctl.vision import MARKERS, Frame
from perchctl.vision.markers.corners import side_lengths_px
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.types import Detection, Detections

SIDES_PX = (
    64,
    56,
    50,
    46,
    42,
    38,
    34,
    31,
    28,
    26,
    24,
    22,
    20,
    18,
    16,
    15,
    14,
    13,
    12,
    11,
    10,
    9,
    8,
)
SHARE = 0.9
WRONG_SIDES = 0.2  # of a side: a corner farther off than this is a wrong answer
METHODS = ("plain", "still", "tracked")


@dataclass(frozen=True)
class Case:
    name: str
    facts: str  # what was measured of the plain detector elsewhere, large/small
    blur_px: float = 0.6
    noise: float = 1.0
    motion_px: float = 0.0
    analogue: float = 0.0


CASES = (
    Case("clean", "12/14"),
    Case("noise 10", "14/14", noise=10.0),
    Case("blur 1", "20/16", blur_px=1.0),
    Case("blur 2", "34/34", blur_px=2.0),
    Case("blur 3", "50/50", blur_px=3.0),
    Case("motion 4", "24/24", motion_px=4.0),
    Case("motion 8", "40/none", motion_px=8.0),
    Case("analogue", "20-40/24-50", analogue=0.4),
    Case("fpv", "34-40/40-64", blur_px=1.6, noise=5.0, motion_px=2.0, analogue=0.25),
)


@dataclass(frozen=True, eq=False)
class View:
    image: Picture
    true_px: Array
    before: Detections  # the target in the frame before, a thirtieth of a second ago


def views(case: Case, marker: str, side_px: float, count: int) -> Iterator[View]:
    """Random places, headings and tilts with the marker's side at that size."""
    scene = renderer(
        seed=int(side_px),
        camera_noise_sigma=case.noise,
        extra={"analogue": case.analogue} if case.analogue else {},
    )
    rng = np.random.default_rng([CASES.index(case), int(side_px), marker == "small"])
    size_m = 0.150 if marker == "large" else 0.025
    z = float(CAMERA.K[0, 0]) * size_m / side_px
    done = 0
    while done < count:
        x, y = (float(v) * z for v in rng.uniform((-0.55, -0.4), (0.55, 0.4)))
        yaw, roll, pitch = (float(v) for v in rng.uniform(-1, 1, 3) * (math.pi, 0.12, 0.12))
        T = camera_pose(x, y, z, yaw, roll, pitch)
        true = true_corners(T, marker)
        if not in_view(true):
            continue
        samples = [T]
        if case.motion_px > 0.0:
            angle = float(rng.uniform(0.0, math.tau))
            step = case.motion_px * z / float(CAMERA.K[0, 0])
            dx, dy = step * math.cos(angle), step * math.sin(angle)
            samples = [
                camera_pose(x + f * dx, y + f * dy, z, yaw, roll, pitch) for f in (-0.5, 0.0, 0.5)
            ]
        image = scene.render(samples, case.blur_px, done)
        # Some pixels and degrees from frame to frame, as far as no motion was known.
        shift = rng.normal(0.0, 2.5, 2) * z / float(CAMERA.K[0, 0])
        turn, zoom = float(rng.normal(0.0, math.radians(1.5))), float(rng.normal(1.0, 0.015))
        T_before = camera_pose(x + shift[0], y + shift[1], z * zoom, yaw + turn, roll, pitch)
        seen = {}
        for name in MARKERS:
            corners = true_corners(T_before, name)
            if in_view(corners) and side_lengths_px(corners).min() > 7.0:
                seen[name] = Detection(name, corners, 0.05, True)
        done += 1
        yield View(image, true, Detections(0, 0.0, seen.get("large"), seen.get("small")))


def finder(method: str, marker: str) -> Callable[[View], Array | None]:
    setup = setup_with().detector_setup

    def plain(view: View) -> Array | None:
        return plain_detect(view.image).get(marker)

    def ours(view: View) -> Array | None:
        before = view.before if method == "tracked" else None
        seen = detect_markers(Frame(1, 1 / 30, view.image), before, setup, CAMERA)
        found = getattr(seen, marker)
        return None if found is None else np.asarray(found.corners_px)

    return plain if method == "plain" else ours


def smallest(case: Case, marker: str, count: int, sides: tuple[int, ...]) -> dict[str, object]:
    """The smallest side per method; how many answers were wrong."""
    best: dict[str, float] = dict.fromkeys(METHODS, math.nan)
    going = set(METHODS)
    wrong = 0
    find = {m: finder(m, marker) for m in METHODS}
    for side_px in sides:
        pictures = list(views(case, marker, side_px, count))
        for method in METHODS:
            if method not in going:
                continue
            hits = 0
            for view in pictures:
                corners = find[method](view)
                if corners is None:
                    continue
                off = float(np.abs(corners - view.true_px).max())
                good = off < max(WRONG_SIDES * float(side_lengths_px(view.true_px).mean()), 2.0)
                hits += good
                wrong += not good and method != "plain"
            if hits >= SHARE * count:
                best[method] = float(side_px)
            elif side_px < 60:
                going.discard(method)
        if not going:
            break
    return {**best, "wrong": wrong}


def main() -> None:
    quick = arguments(__doc__ or "").quick
    count, sides = (10, SIDES_PX[::2]) if quick else (30, SIDES_PX)
    cv2.setNumThreads(1)
    for marker in ("large", "small"):
        rows = []
        for case in CASES:
            found = smallest(case, marker, count, sides)
            plain, still, tracked = (float(found[m]) for m in METHODS)  # type: ignore[arg-type]
            rows.append((case.name, case.facts.split("/")[marker == "small"], plain, still,
                         tracked, plain / still, plain / tracked, found["wrong"]))  # fmt: skip
        table(
            f"{marker} marker: smallest side found in 90 % of {count} frames, px",
            ("", "facts", "plain", "ours, still", "ours, tracked", "x still", "x tracked", "wrong"),
            rows,
        )


if __name__ == "__main__":
    main()
