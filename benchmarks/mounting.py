"""The mounting, the latency and the gear's tip, measured from a vehicle in a hand.

    python benchmarks/mounting.py [--seeds 30] [--bare]

Each seed draws how the camera is mounted (turned by up to 180 deg, moved by up to 60 mm), how late
its pictures are (20 to 150 ms), the sensors' errors (attitude with 0.3 deg of noise and 0.5 deg of
bias) and a hand's motion. The pictures are rendered for the `sim` profile's camera and go through
the pipeline; `--bare` takes true poses with noise instead, in a hundredth of the time. The last
lines stand beside the goals; 1 is the exit code where one is missed.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from perchctl.calibration import MountingRecording, profile_camera
from perchctl.calibration.board.adjust import SIGMAS_95
from perchctl.calibration.mounting.carry import solve_rotation
from perchctl.calibration.mounting.pivot import solve_pivot
from perchctl.errors import InvalidValue
from perchctl.profile import load_profile
from tests.helpers.hand import Hand, draw_hand, record_hand
from tests.helpers.mounting import seen

GOALS = {"turn, deg": (0.15, 0.5), "latency, ms": (3.0, 8.0), "gear's tip, mm": (0.4, 1.2)}
"""Of the median and of the worst."""
COVERED = (0.90, 0.99)
PROFILE = load_profile("sim")


def recording(hand: Hand, bare: bool) -> MountingRecording:
    return seen(hand) if bare else record_hand(hand, PROFILE, profile_camera(PROFILE.camera))


def errors_of(seed: int, bare: bool) -> tuple[dict[str, float], list[float]]:
    """Of each goal, and of each value in units of its sigma. Raises InvalidValue."""
    hands = {part: draw_hand(PROFILE, part, seed) for part in ("carry", "pivot")}
    carried = solve_rotation(recording(hands["carry"], bare))
    pivoted = solve_pivot(recording(hands["pivot"], bare), PROFILE.target.size_sigma)
    truth = hands["carry"]
    turn = Rotation.from_matrix(carried.R_body_cam @ truth.T_body_cam[:3, :3].T)
    angles = (np.array(carried.rpy_deg) - truth.rpy_deg + 180.0) % 360.0 - 180.0
    late_s = carried.latency_s - truth.latency_s
    tip_m = np.array(pivoted.gear_cam_m) - truth.gear_cam_m
    values = (
        math.degrees(turn.magnitude()),
        1e3 * abs(late_s),
        1e3 * float(np.linalg.norm(tip_m)),
    )
    sigmas = [*(angles / carried.rpy_sigma_deg), late_s / carried.latency_sigma_s]
    sigmas += [*(tip_m / pivoted.gear_cam_sigma_m)]
    return dict(zip(GOALS, values, strict=True)), [abs(float(v)) for v in sigmas]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--bare", action="store_true", help="true poses with noise, no pictures")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    found: dict[str, list[float]] = {name: [] for name in GOALS}
    sigmas: list[float] = []
    refused = 0
    for seed in range(options.seeds):
        try:
            errors, off = errors_of(seed, options.bare)
        except InvalidValue as error:
            refused += 1
            print(f"seed {seed:2d}: refused: {error}")
            continue
        sigmas += off
        for name, value in errors.items():
            found[name].append(value)
        line = ", ".join(f"{name} {value:.3f}" for name, value in errors.items())
        print(f"seed {seed:2d}: {line}; farthest {max(off):.1f} sigma", flush=True)
    covered = float(np.mean(np.array(sigmas) < SIGMAS_95)) if sigmas else 0.0
    met = not refused and COVERED[0] <= covered <= COVERED[1]
    for name, (median, worst) in GOALS.items():
        values = found[name] or [math.inf]
        print(
            f"{name}: median {np.median(values):.3f} (goal {median}), "
            f"worst {max(values):.3f} (goal {worst})"
        )
        met = met and np.median(values) <= median and max(values) <= worst
    print(
        f"the 95 % interval covers the truth in {100 * covered:.1f} % of {len(sigmas)} values "
        f"(goal {100 * COVERED[0]:.0f} to {100 * COVERED[1]:.0f}); {refused} seeds refused"
    )
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
