"""The motion that a recording needs, and which of it is missing: named while recording, and before
a solve would be in vain."""

from __future__ import annotations

import math

import numpy as np

from perchctl.calibration.mounting.recording import MountingPart, MountingRecording, SeenPose
from perchctl.errors import InvalidValue
from perchctl.geometry import Array

AGAIN: dict[MountingPart, str] = {
    "carry": "turn the vehicle by hand in view of the target for 30 s, about all axes",
    "pivot": "keep the tip on its point and tilt the vehicle around it to all sides for 20 s",
}
MIRRORED = (
    "the picture is mirrored: switch that off in the camera, or change camera.mirrored in the "
    "profile"
)
LEAST_SEEN_S: dict[MountingPart, float] = {"carry": 20.0, "pivot": 12.0}
LEAST_POSES: dict[MountingPart, int] = {"carry": 150, "pivot": 100}
LEAST_ATTITUDES = 500
ROLL_PITCH_DEG, YAW_DEG = 30.0, 90.0
"""From one side to the other, while the target is seen."""
LEAST_RATE_DPS = 15.0
TILT_DEG = 25.0
MOST_LATE_S = 1.0


def check_recording(recording: MountingRecording, part: MountingPart) -> None:
    """Raises InvalidValue where a solve would be in vain, with what to do."""
    attitudes, poses = recording.attitudes, recording.poses
    if recording.part != part:
        raise InvalidValue(f"this is a recording of the {recording.part}, not of the {part}")
    if recording.mirrored_pictures > max(5, len(poses)):
        raise InvalidValue(MIRRORED)
    if part == "carry" and attitudes and poses:
        begin_s, end_s = min(a.t_s for a in attitudes), max(a.t_s for a in attitudes)
        together = sum(begin_s <= p.t_s <= end_s + MOST_LATE_S for p in poses)
        if together < 0.5 * len(poses):
            raise InvalidValue(
                f"only {together} of {len(poses)} pictures fall into the time of the "
                f"telemetry: both must be on one clock; record anew"
            )
    if lacking := missing_motion(recording):
        raise InvalidValue(f"the {part} lacks motion: {'; '.join(lacking)}")


def missing_motion(recording: MountingRecording) -> tuple[str, ...]:
    """Return which motion is still missing, in a few words each; empty when it is enough."""
    if recording.part == "carry" and len(recording.attitudes) < 2:
        return ("wait for the vehicle",)
    if len(recording.poses) < 2:
        return ("bring the target into view",)
    lacking = (
        _lacking_rotation(recording) if recording.part == "carry" else _lacking_tilt(recording)
    )
    lacking += _lacking_length(recording)
    if recording.part == "carry" and len(recording.attitudes) < LEAST_ATTITUDES and not lacking:
        lacking.append(f"telemetry: {len(recording.attitudes)} of {LEAST_ATTITUDES} samples")
    return tuple(lacking)


def _lacking_rotation(recording: MountingRecording) -> list[str]:
    rpy_deg = _seen_rpy_deg(recording)
    lacking = []
    for name, angles, least, how in (
        ("roll", rpy_deg[:, 0], ROLL_PITCH_DEG, "tip it from side to side"),
        ("pitch", rpy_deg[:, 1], ROLL_PITCH_DEG, "tip it forwards and back"),
        ("yaw", rpy_deg[:, 2], YAW_DEG, "turn it about the vertical"),
    ):
        span = _extent(angles)
        if span < least:
            lacking.append(f"{name}: {how} ({span:.0f} of {least:.0f} deg)")
    gyro_radps = np.array([a.gyro_radps for a in recording.attitudes])
    rate_dps = math.degrees(math.sqrt(float((gyro_radps**2).sum(axis=1).mean())))
    if rate_dps < LEAST_RATE_DPS:
        lacking.append(f"faster: {rate_dps:.0f} of {LEAST_RATE_DPS:.0f} deg/s")
    return lacking


def _seen_rpy_deg(recording: MountingRecording) -> Array:
    """Return the vehicle's attitude at each picture (n, 3), latency left out of account; heading
    unwrapped."""
    attitudes = recording.attitudes
    t_s = np.array([a.t_s for a in attitudes])
    rpy = np.unwrap([(a.roll_rad, a.pitch_rad, a.yaw_rad) for a in attitudes], axis=0)
    at_s = np.array([p.t_s for p in recording.poses])
    at_s = at_s[(at_s >= t_s[0]) & (at_s <= t_s[-1] + MOST_LATE_S)]
    return np.asarray(np.degrees([np.interp(at_s, t_s, angle) for angle in rpy.T])).T


def _lacking_tilt(recording: MountingRecording) -> list[str]:
    tilts_deg = np.degrees(tilts_rad(recording.poses))
    directions = np.radians(np.arange(0.0, 180.0, 15.0))
    along = tilts_deg @ np.stack([np.cos(directions), np.sin(directions)])
    extents = [_extent(column) for column in along.T]
    if max(extents) < TILT_DEG:
        done = f"({max(extents):.0f} of {TILT_DEG:.0f} deg)"
        return [f"tilt: around the tip, to all sides {done}"]
    if min(extents) < TILT_DEG:
        done = f"({min(extents):.0f} of {TILT_DEG:.0f} deg)"
        return [f"tilt: also at right angles to the tilts so far {done}"]
    return []


def tilts_rad(poses: tuple[SeenPose, ...]) -> Array:
    """Return the camera's tilts to the target's x and y, (n, 2)."""
    view = np.array([p.rotation_cam_target[2] for p in poses])
    return np.asarray(np.arctan2(view[:, :2], view[:, 2:]))


def _lacking_length(recording: MountingRecording) -> list[str]:
    t_s = np.sort([p.t_s for p in recording.poses])
    least_s, least = LEAST_SEEN_S[recording.part], LEAST_POSES[recording.part]
    seen_s = float(np.minimum(np.diff(t_s), 0.2).sum())  # in which the target is seen
    if seen_s < least_s:
        return [f"longer: {seen_s:.0f} of {least_s:.0f} s in view"]
    return [f"more pictures: {len(t_s)} of {least}"] if len(t_s) < least else []


def _extent(values: Array) -> float:
    """Return how far values go from one side to the other, without the outermost hundredths."""
    return float(np.ptp(np.percentile(values, (2.0, 98.0)))) if len(values) else 0.0
