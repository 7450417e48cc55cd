"""Whether the spread that a picture's pose claims is what it errs by, by range and blur: the mean
squared error in units of it, a degree of freedom; 1 is honest, less is modest.

The print counts as true; the noise of half of the pictures is low, of half of them high.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from checkout import Checkout, Stream
from common import CAMERA, renderer, table
from degradations import TRUE, error, samples_between

BINS_M = (0.04, 0.08, 0.16, 0.3, 0.6, 1.2)
BLURS_PX = (0.5, 1.0, 1.8, 3.0)
NOISES = (2.0, 8.0)
GOAL = (0.5, 1.5)


def squared(
    low_m: float, high_m: float, blur_px: float, count: int, looker: Checkout
) -> list[float]:
    """Each pose's, over its four."""
    out = []
    for noise in NOISES:
        scene = renderer(seed=7, camera_noise_sigma=noise)
        rng = np.random.default_rng([7, int(1e3 * low_m)])
        for index, sample in enumerate(samples_between(low_m, high_m, count // 2, rng)):
            T = sample.T_at(0.0)
            picture = scene.render([T], blur_px, index)
            seen = looker.look(Stream([(0.0, picture)], {"target": dict(TRUE)}))
            if seen.e is None or seen.cov is None:
                continue
            e = error(seen, T)
            out.append(float(e @ np.linalg.solve(seen.cov, e)) / 4.0)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer pictures, for a first look")
    parser.add_argument("--checkout", type=Path, help="whose perchctl measures; default: this one")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    count = 12 if options.quick else 60
    rows, means = [], []
    with Checkout(options.checkout, (CAMERA.size_px, CAMERA.K, CAMERA.dist)) as looker:
        for low_m, high_m in pairwise(BINS_M):
            cells: list[object] = []
            for blur_px in BLURS_PX:
                found = squared(low_m, high_m, blur_px, count, looker)
                means.append(float(np.mean(found)) if found else np.nan)
                cells += [means[-1], f"{100 * len(found) / count:.0f}"]
            rows.append((f"{100 * low_m:.0f} to {100 * high_m:.0f} cm", *cells))
    head = [""]
    for blur_px in BLURS_PX:
        head += [f"blur {blur_px:g} px", "found %"]
    table(f"{count} pictures a bin: mean squared error over the claimed spread", head, rows)
    good = sum(GOAL[0] <= mean <= GOAL[1] for mean in means)
    print(f"\n{good} of {len(means)} bins between {GOAL[0]} and {GOAL[1]}")


if __name__ == "__main__":
    main()
