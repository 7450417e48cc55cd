"""What a frame costs after the target is lost, or where there is none, under busy ceilings.

    python benchmarks/loss.py [--quick]

A target is locked on, then covered by the ceiling: CPU time of the first 30 frames after that,
of the later ones, and of a stream in which there never was a target. One thread; the
same frames by two full-frame detectors, in the same process, give the ratio. Last column: what
a stream costs while the target is tracked there.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from common import (
    CEILING_Z_M,
    Picture,
    arguments,
    camera_pose,
    plain_detect,
    renderer,
    setup_with,
    table,
)

from perchctl.geometry import Array
from perchctl.vision import Frame, PipelineState, step

RATE_HZ, FIRST, LATER, LOCK = 30.0, 30, 30, 12
HEIGHTS_M = (0.25, 0.5, 1.0, 1.8)
SIZE = (640, 480)
SETUP = setup_with()

Texture = Callable[[np.random.Generator], Picture]


def tiles(rng: np.random.Generator) -> Picture:
    """Acoustic tiles: small dark holes all over."""
    picture = np.full(SIZE[::-1], 190, np.uint8)
    for _ in range(2500):
        x, y = (int(v) for v in rng.integers(0, SIZE))
        cv2.circle(picture, (x, y), int(rng.integers(1, 4)), int(rng.integers(40, 120)), -1)
    return picture


def grid(rng: np.random.Generator) -> Picture:
    """A suspended ceiling: dark joints, every field a quadrilateral."""
    picture = np.full(SIZE[::-1], 190, np.uint8)
    pitch, slant = int(rng.integers(32, 48)), int(rng.integers(20, 70))
    for at in range(-slant, SIZE[0], pitch):
        cv2.line(picture, (at, 0), (at + slant, SIZE[1]), 70, 3)
        cv2.line(picture, (0, at), (SIZE[0], at + slant // 2), 70, 3)
    return picture


def mosaic(rng: np.random.Generator) -> Picture:
    """Black and white stones of ten pixels."""
    stones = (rng.random((48, 64)) > 0.5).astype(np.uint8) * 150 + 50
    return np.asarray(cv2.resize(stones, SIZE, interpolation=cv2.INTER_NEAREST), np.uint8)


def plain(rng: np.random.Generator) -> Picture:
    """The simulator's."""
    return np.asarray(
        renderer(int(rng.integers(99)), no_target=True).render([camera_pose(0, 0, 1)], 0.8, 0)
    )


TEXTURES: dict[str, Texture] = {"plain": plain, "tiles": tiles, "grid": grid, "mosaic": mosaic}


def taken(texture: Picture, rng: np.random.Generator) -> Picture:
    """As a camera sees it, a few pixels aside every time."""
    moved = np.roll(texture, tuple(rng.integers(-3, 4, 2)), axis=(0, 1))
    soft = cv2.GaussianBlur(moved, (0, 0), 0.8).astype(np.float32)
    return np.asarray(np.clip(soft + rng.normal(0.0, 4.0, soft.shape), 0, 255), np.uint8)


def stream(texture: Picture, height_m: float | None, rng: np.random.Generator) -> list[Picture]:
    """The target for `LOCK` frames (not at all without a height), then the ceiling alone."""
    pictures = []
    if height_m is not None:
        scene = renderer(seed=int(rng.integers(99)))
        for k in range(LOCK):
            pose = camera_pose(0.02 * height_m, 0.002 * k, height_m, 0.3)
            pictures.append(scene.render([pose], 0.8, k))
    return pictures + [taken(texture, rng) for _ in range(FIRST + LATER)]


def plain_ms(pictures: list[Picture]) -> float:
    """CPU ms of two full-frame detectors, the median."""
    times = []
    for picture in pictures:
        start = time.thread_time()
        plain_detect(picture)
        times.append((time.thread_time() - start) * 1e3)
    return float(np.median(times))


def stepped(pictures: list[Picture]) -> Array:
    """CPU ms of each frame, one after the other."""
    state, times = PipelineState(), []
    for k, picture in enumerate(pictures):
        frame = Frame(k, k / RATE_HZ, picture)
        start = time.thread_time()
        state, _ = step(state, frame, None, SETUP)
        times.append((time.thread_time() - start) * 1e3)
    return np.array(times)


def main() -> None:
    quick = arguments(__doc__ or "").quick
    heights = HEIGHTS_M[1:2] if quick else HEIGHTS_M
    rows = []
    for name, texture in TEXTURES.items():
        rng = np.random.default_rng([len(rows), 7])
        picture = texture(rng)
        lost = [stepped(stream(picture, h, rng)) for h in heights]
        never = stepped(stream(picture, None, rng))[1:]  # the first picture is a still
        base = plain_ms([taken(picture, rng) for _ in range(9)])
        first = np.concatenate([t[LOCK : LOCK + FIRST] for t in lost])
        later = np.concatenate([t[LOCK + FIRST :] for t in lost])
        tracked = np.concatenate([t[LOCK // 2 : LOCK] for t in lost])
        rows.append(
            (
                name,
                *(
                    f"{np.median(t):.1f} / {np.percentile(t, 99):.1f} / {t.max():.1f}"
                    for t in (first, later, never)
                ),
                base / float(np.median(first)),
                float(np.median(tracked)),
            )
        )
    table(
        f"CPU ms a frame of 640x480, one thread: median / p99 / most; ceiling at {CEILING_Z_M} m",
        ("ceiling", f"first {FIRST} lost", "later", "never seen", "x faster", "tracked"),
        rows,
    )


if __name__ == "__main__":
    main()
