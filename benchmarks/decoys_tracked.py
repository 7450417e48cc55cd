"""What is not the target: does it steer, after a lock?

A camera in a hand, and a vehicle with its attitude, have locked on the target; then it is
covered, and something like it is in the picture, or a second one comes into view. A frame is
wrong if the target is told farther than 5 cm from where it is.

No picture tells a hand's camera whether both markers were moved or the camera was, in frames that
are lost. It takes them for the target's after a while, and says so: frames taken up `anew`, which
may be only there, and only where the target is not seen any more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from common import Picture, setup_with, table

from perchctl.geometry import R_MARKER_TARGET, Array, invert_T, make_T, rot_z, rotation_from_rpy
from perchctl.vision import Frame, PipelineState, VehicleState, step
from tests.helpers.target_picture import CAMERA, Drawn, render, side_by_side

RATE_HZ = 30.0
LOCKED, AFTER = 8, 72
BLURS_PX = (0.8, 1.6, 3.0)
WRONG_M, MOVED_M = 0.05, 0.005
TARGET_M = np.array([0.1, 0.05, 2.0])


@dataclass(frozen=True)
class Decoy:
    """Markers on a sheet in the plane of the target, `away_m` from it, in the world."""

    name: str
    markers: tuple[str | Drawn, ...] = ("large", "small")
    scale: float = 1.0  # of the target's own markers
    away_m: tuple[float, float] = (0.0, 0.0)
    covered: bool = True
    sheet_m: float = 0.2


CASES = (
    Decoy("target covered", markers=()),
    Decoy("lone id 5, 100 mm", markers=(("DICT_ARUCO_ORIGINAL", 5, 0.100),)),
    Decoy("lone id 5, 100 mm, aside", (("DICT_ARUCO_ORIGINAL", 5, 0.100),), away_m=(0.2, -0.1)),
    Decoy("lone 997, 80 mm", markers=(("DICT_4X4_1000", 997, 0.080),)),
    Decoy("lone 997, aside", markers=("large",), away_m=(-0.25, 0.05)),
    Decoy("half-size target", scale=0.5),
    Decoy("half-size target, aside", scale=0.5, away_m=(0.2, 0.1)),
    Decoy("second target 24 cm aside", away_m=(0.24, 0.0), covered=False),
    Decoy("second target, first covered", away_m=(0.24, 0.0)),
    Decoy("id 13 (4X4), 150 mm", markers=(("DICT_4X4_1000", 13, 0.150),)),
    Decoy("id 13 (4X4), 150 mm, aside", (("DICT_4X4_1000", 13, 0.150),), away_m=(0.1, 0.2)),
)


@dataclass(frozen=True, eq=False)
class View:
    """Where the camera is, and with which attitude its vehicle says so."""

    T_world_cam: Array
    attitude: VehicleState


def view(k: int, seed: int) -> View:
    """A camera that sways by a few centimetres and degrees, 0.5 to 1.3 m below the target."""
    rng = np.random.default_rng(seed)
    phase, t = rng.uniform(0.0, 2.0 * math.pi, 6), k / RATE_HZ
    height = rng.uniform(0.5, 1.3)
    sway = np.array([0.04, 0.04, 0.03]) * np.sin(1.5 * t + phase[:3])
    roll, pitch, yaw = np.array([0.04, 0.04, 0.3]) * np.sin(1.2 * t + phase[3:])
    x, y, z = (float(v) for v in TARGET_M + sway - np.array([0.0, 0.0, height]))
    attitude = VehicleState(t, float(roll), float(pitch), float(yaw), (x, y, z))
    return View(make_T(rotation_from_rpy(roll, pitch, yaw), (x, y, z)), attitude)


def picture(seen: View, decoy: Decoy | None, blur_px: float, seed: int) -> Picture:
    """What the camera sees: the target, alone, with the decoy, or covered."""
    target = _drawn(seen, Decoy("target"), blur_px)
    image = target
    if decoy is not None:
        other = _drawn(seen, decoy, blur_px)
        image = other if decoy.covered else side_by_side(target, other)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


def _drawn(seen: View, decoy: Decoy, blur_px: float) -> Picture:
    place = TARGET_M + np.array([*decoy.away_m, 0.0])
    T = invert_T(seen.T_world_cam) @ make_T(rot_z(0.4) @ R_MARKER_TARGET, place)
    rvec = np.asarray(cv2.Rodrigues(T[:3, :3])[0], dtype=float).ravel()
    # What is half as large looks as what is twice as far.
    return render(
        rvec, T[:3, 3] / decoy.scale, CAMERA, markers=decoy.markers, blur_px=blur_px,
        sheet_m=decoy.sheet_m,
    )  # fmt: skip


@dataclass(frozen=True)
class Count:
    frames: int = 0
    measured: int = 0
    wrong: int = 0
    anew: int = 0
    worst_m: float = 0.0


def tracked(decoy: Decoy, in_flight: bool, seed: int, blur_px: float) -> Count:
    """One run: `LOCKED` frames of the target, then `AFTER` with the decoy."""
    setup, state = setup_with(CAMERA), PipelineState()
    count, anew = Count(), False
    for k in range(LOCKED + AFTER):
        seen = view(k, seed)
        image = picture(seen, decoy if k >= LOCKED else None, blur_px, 1000 * seed + k)
        attitude = seen.attitude if in_flight else None
        state, output = step(state, Frame(k, k / RATE_HZ, image), attitude, setup)
        target = output.target
        anew = anew or output.target_lock_message.startswith("target reacquired")
        if k < LOCKED:
            assert target is not None, f"no lock in frame {k}"
        elif target is not None:
            T = seen.T_world_cam
            true = invert_T(T)[:3, :3] @ (TARGET_M - T[:3, 3])
            if in_flight:
                true = rot_z(-seen.attitude.yaw_rad) @ (TARGET_M - T[:3, 3])
            off_m = float(np.linalg.norm(target.e_m - true))
            count = Count(
                count.frames + 1,
                count.measured + target.is_measured_in_newest_frame,
                count.wrong + (off_m > WRONG_M and not anew),
                count.anew + anew,
                count.worst_m if anew else max(count.worst_m, off_m),
            )
    return count


def report_tracked(seeds: int) -> bool:
    """Print the table; whether nothing steered that should not."""
    rows, good = [], True
    for decoy in CASES:
        for in_flight in (False, True):
            runs = [tracked(decoy, in_flight, s, BLURS_PX[s % 3]) for s in range(seeds)]
            wrong, worst_m = sum(r.wrong for r in runs), max(r.worst_m for r in runs)
            anew = sum(r.anew for r in runs)
            may_jump = decoy.covered and not in_flight and decoy.markers == Decoy("").markers
            bad = wrong > 0 or (not decoy.covered and worst_m > MOVED_M)
            bad = bad or (anew > 0 and not may_jump)
            good = good and not bad
            rows.append(
                (decoy.name, "fly" if in_flight else "track", AFTER * seeds,
                 sum(r.measured for r in runs), wrong, anew, 1e3 * worst_m,
                 "steered" if bad else "")
            )  # fmt: skip
    head = ("tracked", "", "frames", "measured", "wrong", "anew", "worst mm", "")
    table(f"After {LOCKED} frames of the target", head, rows)
    return good
