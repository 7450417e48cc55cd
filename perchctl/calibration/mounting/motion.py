"""Whether there was enough motion, and which is missing: while recording and before a solve."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from perchctl.calibration.mounting.recording import AttitudeSample, MountingRecording, SeenPose
from perchctl.geometry import Array

CARRY_S, PIVOT_S = 20.0, 12.0
LEAST_POSES = {"carry": 150, "pivot": 100}
LEAST_ATTITUDES = 500
ROLL_PITCH_DEG, YAW_DEG = 30.0, 90.0
"""From one side to the other, while the target is seen."""
LEAST_RATE_DPS = 15.0
TILT_DEG = 25.0
_MOST_LATE_S = 1.0


def missing(recording: MountingRecording) -> tuple[str, ...]:
    """Which motion is still lacking, in a few words each; nothing: it is enough."""
    lacking = _carry(recording) if recording.part == "carry" else _pivot(recording)
    return tuple(lacking)


def _carry(recording: MountingRecording) -> list[str]:
    attitudes, poses = recording.attitudes, recording.poses
    if len(attitudes) < 2 or len(poses) < 2:
        return ["bring the target into view"] if len(attitudes) >= 2 else ["wait for the vehicle"]
    lacking = []
    rpy = seen_rpy_deg(attitudes, poses)
    for name, axis, least, how in (
        ("roll", 0, ROLL_PITCH_DEG, "tip it from side to side"),
        ("pitch", 1, ROLL_PITCH_DEG, "tip it forwards and back"),
        ("yaw", 2, YAW_DEG, "turn it about the vertical"),
    ):
        span = extent(rpy[:, axis])
        if span < least:
            lacking.append(f"{name}: {how} ({span:.0f} of {least:.0f} deg)")
    rate_dps = math.degrees(
        math.sqrt(float(np.mean([a.gyro_radps @ a.gyro_radps for a in attitudes])))
    )
    if rate_dps < LEAST_RATE_DPS:
        lacking.append(f"faster: {rate_dps:.0f} of {LEAST_RATE_DPS:.0f} deg/s")
    lacking += _length(recording, CARRY_S)
    if len(attitudes) < LEAST_ATTITUDES and not lacking:
        lacking.append(f"telemetry: {len(attitudes)} of {LEAST_ATTITUDES} samples")
    return lacking


def _pivot(recording: MountingRecording) -> list[str]:
    if len(recording.poses) < 2:
        return ["bring the target into view"]
    lacking = []
    least, most = tilt_extents_deg(tilts_rad(recording.poses))
    if most < TILT_DEG:
        lacking.append(f"tilt: around the tip, to all sides ({most:.0f} of {TILT_DEG:.0f} deg)")
    elif least < TILT_DEG:
        lacking.append(
            f"tilt: also at right angles to the tilts so far ({least:.0f} of {TILT_DEG:.0f} deg)"
        )
    return lacking + _length(recording, PIVOT_S)


def _length(recording: MountingRecording, least_s: float) -> list[str]:
    t_s = [p.t_s for p in recording.poses]
    # Time in which the target is seen.
    seen_s = float(np.minimum(np.diff(np.sort(t_s)), 0.2).sum())
    if seen_s < least_s:
        return [f"longer: {seen_s:.0f} of {least_s:.0f} s in view"]
    if len(t_s) < LEAST_POSES[recording.part]:
        return [f"more pictures: {len(t_s)} of {LEAST_POSES[recording.part]}"]
    return []


def extent(values: Array) -> float:
    """From one side to the other, without the outermost hundredths."""
    return float(np.ptp(np.percentile(values, (2.0, 98.0)))) if len(values) else 0.0


def seen_rpy_deg(attitudes: Sequence[AttitudeSample], poses: Sequence[SeenPose]) -> Array:
    """The vehicle's attitude at each picture (n, 3), latency left out of account; heading
    unwrapped."""
    t_s = np.array([a.t_s for a in attitudes])
    rpy = np.unwrap([(a.roll_rad, a.pitch_rad, a.yaw_rad) for a in attitudes], axis=0)
    at_s = np.array([p.t_s for p in poses])
    at_s = at_s[(at_s >= t_s[0]) & (at_s <= t_s[-1] + _MOST_LATE_S)]
    rpy_deg: Array = np.degrees(np.stack([np.interp(at_s, t_s, angle) for angle in rpy.T], axis=1))
    return rpy_deg


def tilts_rad(poses: Sequence[SeenPose]) -> Array:
    """Of the camera to the target's x and y, (n, 2): its view in the target's axes."""
    view = np.array([p.rotation_cam_target[2] for p in poses])
    return np.asarray(np.arctan2(view[:, :2], view[:, 2:]))


def tilt_extents_deg(tilts: Array) -> tuple[float, float]:
    """The least and the most extent of tilts (n, 2) over all directions."""
    angles = np.radians(np.arange(0.0, 180.0, 15.0))
    along = np.degrees(tilts) @ np.stack([np.cos(angles), np.sin(angles)])
    extents = [extent(column) for column in along.T]
    return min(extents), max(extents)
