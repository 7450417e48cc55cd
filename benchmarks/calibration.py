"""Seeded synthetic calibrations: is the predicted error at the target calibrated?

    python benchmarks/calibration.py [--seeds 30] [--corners]

Each seed draws a camera, poses of a board, blur, noise and motion; the pictures are
rendered, the board is found in them, and the camera is calibrated as the command does it
(`--corners` skips the pictures and adds noise to true corners). The last lines say in how
many cases the true error lies below its 95 % line; between 85 and 100 % is wanted.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from perchctl.calibration import FoundViews, calibrate_camera
from perchctl.calibration.board.adjust import lens_parameters
from perchctl.calibration.board.detect import BoardView, find_board
from perchctl.calibration.board.predict import position_errors_mm
from tests.helpers.boards import (
    CHARUCO,
    CHESSBOARD,
    BoardRenderer,
    corner_views,
    draw_camera,
    draw_poses,
)

RANGES_M = (0.05, 0.1, 0.3, 1.0, 1.5)


def views_of(seed: int, corners_only: bool) -> tuple[list[BoardView], object]:
    rng = np.random.default_rng([seed, 20])
    camera = draw_camera(rng)
    board = CHARUCO if seed % 2 == 0 else CHESSBOARD
    if corners_only:
        return corner_views(rng, camera, CHARUCO, 15, rng.uniform(0.02, 0.2)), camera
    renderer = BoardRenderer(camera, board)
    blur_px, noise = rng.uniform(0.5, 1.4), rng.uniform(1.0, 6.0)
    views = []
    for i, pose in enumerate(draw_poses(rng, camera, board, 18)):
        angle, motion = rng.uniform(0, np.pi), rng.uniform(0.0, 1.5)
        moved = (motion * np.cos(angle), motion * np.sin(angle))
        seen = find_board(renderer.render(pose, rng, blur_px, noise, moved), board, f"view {i}")
        if isinstance(seen, BoardView):
            views.append(seen)
    return views, camera


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--corners", action="store_true")
    options = parser.parse_args()
    below: dict[str, list[bool]] = {}
    for seed in range(options.seeds):
        start_s = time.perf_counter()
        views, truth = views_of(seed, options.corners)
        result = calibrate_camera(FoundViews(tuple(views)), "synthetic")
        off = (result.fit.parameters - lens_parameters(truth)) / result.parameter_std
        line = (
            f"seed {seed:2d}: {len(result.views)} of {len(views)} views, "
            f"RMS {result.fit.rms_px:.3f} px, {result.camera.model}, largest parameter error "
            f"{np.abs(off).max():.1f} sigma;"
        )
        below.setdefault("all parameters within 3 sigma", []).append(bool(np.abs(off).max() < 3))
        for e in result.errors:
            if e.z_m not in RANGES_M:
                continue
            true_mm = position_errors_mm(result.camera, truth, e.z_m, result.covered_cells)
            for what, true, line95 in (
                ("where boards were seen", true_mm.max(), e.mm95),
                ("straight ahead", true_mm[0], e.axis_mm95),
            ):
                key = f"{what} at {100 * e.z_m:g} cm"
                below.setdefault(key, []).append(bool(true <= line95))
            if e.z_m == 1.0:
                line += f" at 1 m {true_mm.max():.2f} of {e.mm95:.2f} mm,"
                line += f" ahead {true_mm[0]:.2f} of {e.axis_mm95:.2f} mm"
        print(f"{line} ({time.perf_counter() - start_s:.1f} s)", flush=True)
    for key, cases in below.items():
        print(f"{key}: {100 * np.mean(cases):.0f} % of {len(cases)}")


if __name__ == "__main__":
    main()
