"""The designer's z1, z2, z3 against what the renderer and the plain detector measure.

    python benchmarks/ranges_by_design.py

Three cameras (f = 250, 380, 600 px, 640x480) and three blurs; every measured range is the
end of the stretch in which the marker is found in at least 90 % of 24 rendered pictures,
at any turn (z3: at the turn that needs the most room).
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable

import numpy as np

from perchctl.geometry import make_T, rotation_from_rpy
from perchctl.profile import Profile, TargetConfig
from perchctl.sim import Renderer, Scenario
from perchctl.target import make_design
from perchctl.target.reading import FOUND_RATE, NOISE, TRIALS, ArucoReader
from perchctl.vision import CameraModel
from perchctl.vision.types import MarkerName

FOCAL_PX = (250.0, 380.0, 600.0)
BLUR_PX = (0.6, 1.5, 2.5)
STEP = 1.04
START = 1.35
CEILING_M = 12.0
TOLERANCE = 0.15


def camera_of(focal_px: float) -> CameraModel:
    K = np.array([[focal_px, 0.0, 319.5], [0.0, focal_px, 239.5], [0.0, 0.0, 1.0]])
    return CameraModel((640, 480), K, np.zeros(5))


class Bench:
    """Renders and reads; the same seed for every camera."""

    def __init__(self, camera: CameraModel, blur_px: float, target: TargetConfig) -> None:
        scenario = Scenario(
            ceiling_z_m=CEILING_M,
            camera_noise_sigma=NOISE,
            camera_defocus_px=blur_px,
            large_side_m=target.large.side_m,
            small_side_m=target.small.side_m,
        )
        self._renderer = Renderer(scenario, camera, target, seed=5)
        self._reader = ArucoReader(target)
        self._focal_px = float(camera.K[0, 0])
        self._rates: dict[tuple[str, int, float | None], float] = {}

    def rate(self, marker: MarkerName, z_m: float, turn_rad: float | None = None) -> float:
        """Share of pictures from `z_m` below in which the marker is found."""
        key = (marker, round(1e5 * z_m), turn_rad)
        if key in self._rates:
            return self._rates[key]
        rng = np.random.default_rng([7, key[1]])
        hits = 0
        for i in range(TRIALS):
            yaw = rng.uniform(-math.pi, math.pi) if turn_rad is None else turn_rad
            x, y = rng.uniform(-0.5, 0.5, 2) * z_m / self._focal_px
            pose = make_T(rotation_from_rpy(0.0, 0.0, yaw), (x, y, CEILING_M - z_m))
            hits += marker in self._reader.read(self._renderer.render([pose], frame_index=i))
        self._rates[key] = hits / TRIALS
        return hits / TRIALS

    def farthest_m(self, marker: MarkerName, guess_m: float) -> float:
        """Searched inwards from well beyond the guess."""
        return _edge(lambda z: self._found(marker, z), START * guess_m, STEP)

    def nearest_m(self, marker: MarkerName, guess_m: float) -> float:
        """Searched outwards from well within the guess; a square needs most room across."""
        turn = math.radians(45.0)
        return _edge(lambda z: self._found(marker, z, turn), guess_m / START, 1.0 / STEP)

    def _found(self, marker: MarkerName, z_m: float, turn_rad: float | None = None) -> bool:
        if turn_rad is not None:
            # At the picture's edge the rate is a step.
            return self.rate(marker, z_m, turn_rad) >= FOUND_RATE
        # Three neighbouring ranges together, as the designer does.
        rates = [self.rate(marker, z) for z in (z_m / STEP, z_m, z_m * STEP)]
        return sum(rates) / 3.0 >= FOUND_RATE


def _edge(found: Callable[[float], bool], start_m: float, step: float) -> float:
    """The first z at which it is found, going from `start_m` against `step`."""
    z = start_m
    while not found(z):
        z /= step
    return z


def measure(
    focal_px: float, blur_px: float, target: TargetConfig
) -> list[tuple[str, float, float]]:
    """(name, designed, measured) of z1, z2, z3 in metres."""
    camera = camera_of(focal_px)
    designed = make_design(target, camera, blur_px, Profile())
    bench = Bench(camera, blur_px, target)
    assert designed.z1_m is not None
    assert designed.z2_m is not None
    assert designed.z3_m is not None
    return [
        ("z1", designed.z1_m, bench.farthest_m("large", designed.z1_m)),
        ("z2", designed.z2_m, bench.farthest_m("small", designed.z2_m)),
        ("z3", designed.z3_m, bench.nearest_m("large", designed.z3_m)),
    ]


def main() -> int:
    argparse.ArgumentParser(description=__doc__).parse_args()
    target = TargetConfig()
    worst = 0.0
    print("f px  blur px  range  designed cm  measured cm  difference %")
    for focal_px in FOCAL_PX:
        for blur_px in BLUR_PX:
            for name, designed, measured in measure(focal_px, blur_px, target):
                off = designed / measured - 1.0
                worst = max(worst, abs(off))
                print(
                    f"{focal_px:4.0f}  {blur_px:7.1f}  {name:<5}  {100 * designed:11.1f}  "
                    f"{100 * measured:11.1f}  {100 * off:+12.1f}",
                    flush=True,
                )
    print(f"worst {100 * worst:.1f} %, allowed {100 * TOLERANCE:.0f} %")
    return 0 if worst <= TOLERANCE else 1


if __name__ == "__main__":
    sys.exit(main())
