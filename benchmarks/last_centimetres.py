"""The last 10 cm of an ascent, for each way to mount the camera: how much of them is blind.

The camera sits beside the magnet gear, or under it, and as the gear comes near to the target
the markers grow out of the picture. Ascents are rendered with motion blur and noise, the
vehicle swaying a little; every frame goes through the pipeline. Blind is the share of the last
10 cm without a measured pose; the squared error is that of (x, y, z, yaw) in units of its
covariance, a degree of freedom. In every ascent the target is printed a little too large or too
small, by as much as a print that was measured leaves open, and the state estimate wanders.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass

import cv2
import numpy as np
from common import CAMERA, CEILING_Z_M, SIDES_M, TARGET, renderer, rms, table

from perchctl.geometry import Array, make_T, rot_z, rotation_from_rpy, wrap_rad
from perchctl.profile import CameraConfig, Mounting, Profile
from perchctl.profile.vision import VehicleConfig
from perchctl.sim import Renderer
from perchctl.target.prints import MEASURED_SIGMA
from perchctl.vision import Frame, Pipeline, PipelineState, VehicleState, make_pipeline, step

LAST_M, FROM_M, SPEED_MPS, RATE_HZ = 0.10, 0.16, 0.10, 30.0
EXPOSURE_S = 0.008
TARGET_M = np.array([0.0, 0.0, CEILING_Z_M])
BELOW_M = (0.02, 0.025, 0.0)
SWAY_M, SWAY_DEG, SWAY_YAW_DEG = 0.003, 1.5, 3.0
ESTIMATE_M, MEMORY_S = 0.002, 0.3  # the state estimate's wandering error, and for how long


@dataclass(frozen=True)
class Case:
    """The gear's tip in the camera (x right, y down, and as far above it), m."""

    name: str
    gear_m: tuple[float, float, float]


CASES = [
    Case(
        f"{1e3 * beside:g} mm beside {along}, {1e3 * below:g} below" if beside else
        f"under the gear, {1e3 * below:g} below",
        (-beside * (along == "width"), -beside * (along == "height"), below),
    )
    for beside, along in ((0.0, ""), (0.03, "width"), (0.03, "height"))
    for below in BELOW_M
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sway:
    """How a hovering vehicle moves about its way: sines of a seed's own phases."""

    phase: Array
    pulse: Array

    def at(self, t_s: float) -> Array:
        """x, y m; roll, pitch, yaw rad."""
        wave = np.sin(self.pulse * t_s + self.phase)
        size = (SWAY_M, SWAY_M, *np.radians((SWAY_DEG, SWAY_DEG, SWAY_YAW_DEG)))
        return np.asarray(wave * size)


@dataclass(frozen=True)
class Row:
    """One frame: the gear's distance, whether the markers were cut, the pose's error (x, y, z
    m, yaw rad), its squared error a degree of freedom, and the CPU time."""

    range_m: float
    cut: bool
    error: tuple[float, float, float, float] | None
    squared: float
    took_s: float


def setup_for(case: Case) -> Pipeline:
    profile = Profile(
        target=TARGET.model_copy(update={"size_sigma": MEASURED_SIGMA}),
        camera=CameraConfig(mount=Mounting(position_m=(0.0, 0.0, 0.0))),
        vehicle=VehicleConfig(gear_body_m=case.gear_m),
    )
    return make_pipeline(profile, CAMERA)


def body_at(t_s: float, sway: Sway, case: Case) -> tuple[Array, tuple[float, float, float]]:
    """T_world_body with the gear's tip on its way to the target, and roll, pitch, yaw."""
    x, y, *rpy = sway.at(t_s)
    R = rotation_from_rpy(*rpy)
    tip = TARGET_M + np.array((x, y, SPEED_MPS * t_s - FROM_M))
    return make_T(R, tip - R @ np.array(case.gear_m)), (rpy[0], rpy[1], rpy[2])


def ascent(case: Case, setup: Pipeline, scene: Renderer, seed: int, in_hand: bool) -> list[Row]:
    rng = np.random.default_rng(seed)
    sway = Sway(rng.uniform(0.0, 2.0 * math.pi, 5), 2.0 * math.pi * rng.uniform(0.3, 0.8, 5))
    state, rows, off = PipelineState(), [], np.zeros(3)
    keep = math.exp(-1.0 / (RATE_HZ * MEMORY_S))
    for k in range(int(FROM_M / SPEED_MPS * RATE_HZ)):
        t_s = k / RATE_HZ
        samples = [body_at(t_s + w * EXPOSURE_S, sway, case)[0] for w in (-0.5, 0.0, 0.5)]
        T, (roll, pitch, yaw) = body_at(t_s, sway, case)
        image = scene.render(samples, frame_index=1000 * seed + k)
        off = keep * off + rng.normal(0.0, ESTIMATE_M * math.sqrt(1.0 - keep**2), 3)
        attitude = None if in_hand else VehicleState(t_s, roll, pitch, yaw, tuple(T[:3, 3] + off))
        start_s = time.process_time()
        state, output = step(state, Frame(k, t_s, image), attitude, setup)
        took_s = time.process_time() - start_s
        way = TARGET_M - T[:3, 3]
        gear = np.array(case.gear_m)
        if in_hand:
            e, heading = T[:3, :3].T @ way - gear, math.atan2(T[0, 1], T[0, 0])
        else:
            e, heading = rot_z(-yaw) @ (way - T[:3, :3] @ gear), -yaw
        range_m = FROM_M - SPEED_MPS * t_s
        pose = next(iter(output.poses.values()), None)
        if pose is None or not state.marker_poses.poses_by_updated_track:
            rows.append(Row(range_m, False, None, math.nan, took_s))
            continue
        error = np.array([*(pose.e_m - e), wrap_rad(pose.e_yaw_rad - heading)])
        assert pose.level_frame_xyz_yaw_cov is not None
        squared = float(error @ np.linalg.solve(pose.level_frame_xyz_yaw_cov, error)) / 4.0
        seen = output.detections.small or output.detections.large
        cut = seen is not None and seen.cov_px2 is not None
        rows.append(Row(range_m, cut, tuple(error.tolist()), squared, took_s))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one ascent a mounting")
    parser.add_argument("--hand", action="store_true", help="without the vehicle's attitude")
    parser.add_argument("--only", default="", help="mountings whose name holds this")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(11)
    scenes = [printed(seed, rng) for seed in range(1 if options.quick else 3)]
    lines = []
    for case in (c for c in CASES if options.only in c.name):
        setup = setup_for(case)
        rows = [
            row
            for seed, scene in enumerate(scenes)
            for row in ascent(case, setup, scene, seed, options.hand)
            if row.range_m <= LAST_M
        ]
        seen = [row for row in rows if row.error is not None]
        blind = 100.0 * (1.0 - len(seen) / len(rows))
        whole, cut = ([row for row in seen if row.cut == flag] for flag in (False, True))
        took_ms = [1e3 * row.took_s for row in rows]
        lines.append((case.name, len(rows), f"{blind:.0f} %", *_figures(whole), *_figures(cut),
                      float(np.median(took_ms)), max(took_ms)))  # fmt: skip
    head = ("mounting", "frames", "blind", "whole", "x, y mm", "z mm", "yaw deg", "sq. error",
            "cut", "x, y mm", "z mm", "yaw deg", "sq. error", "CPU ms", "most")  # fmt: skip
    table(
        "the last 10 cm of an ascent, while a marker is whole and while both are cut", head, lines
    )


def printed(seed: int, rng: np.random.Generator) -> Renderer:
    """The target as a printer makes it: all of it too large or too small."""
    share = 1.0 + rng.normal(0.0, MEASURED_SIGMA)
    return renderer(
        seed, large_side_m=share * SIDES_M["large"], small_side_m=share * SIDES_M["small"]
    )


def _figures(rows: list[Row]) -> tuple[object, ...]:
    """How many, RMS in x and y, in z and in yaw, and the mean squared error."""
    errors = np.array([row.error for row in rows]).reshape(-1, 4)
    nothing = math.nan
    return (
        len(rows),
        1e3 * rms(errors[:, :2].ravel()) if rows else nothing,
        1e3 * rms(errors[:, 2]) if rows else nothing,
        math.degrees(rms(errors[:, 3])) if rows else nothing,
        float(np.mean([row.squared for row in rows])) if rows else nothing,
    )


if __name__ == "__main__":
    main()
