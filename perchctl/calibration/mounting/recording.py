"""Recordings of poses and attitudes while a vehicle is moved by hand: the required motion, and the
file format (JSON lines).

Each part begins with a line ``{"part": "carry", ...}``. One line per sample follows, first all
attitudes, then all poses. A file contains one part or both.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from perchctl.errors import InvalidValue, NotFound
from perchctl.files import kind_note, write_files
from perchctl.geometry import Array

MountingPart = Literal["carry", "pivot"]
_POSE_SHAPES: dict[str, tuple[int, ...]] = {
    "t_s": (),
    "rotation_cam_target": (3, 3),
    "position_cam_target_m": (3,),
    "covariance": (6, 6),
}


@dataclass(frozen=True, eq=False)
class AttitudeSample:
    """The vehicle's estimated attitude at `t_s` on the vehicle's clock, right-handed (positive
    pitch is nose down).

    gyro_radps (3,) is in body axes.
    """

    t_s: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    gyro_radps: Array


@dataclass(frozen=True, eq=False)
class TargetPose:
    """The target in the camera's frame.

    `t_s` is the camera's timestamp, not corrected for latency. `covariance` (6, 6) refers first to
    a small rotation in camera axes (rad, multiplied onto `rotation_cam_target` from the left), then
    to the position (m).
    """

    t_s: float
    rotation_cam_target: Array
    position_cam_target_m: Array
    covariance: Array


@dataclass(eq=False)
class MountingRecording:
    """Recording of one part (carry or pivot), to which data is appended while it runs.
    `mirrored_pictures` counts the images that show only a mirrored target."""

    part: MountingPart
    attitudes: list[AttitudeSample] = field(default_factory=list)
    poses: list[TargetPose] = field(default_factory=list)
    mirrored_pictures: int = 0

    @staticmethod
    def write(path: Path, recordings: Sequence[MountingRecording]) -> None:
        """Write the recordings to one file atomically. Raises InvalidValue if the file cannot be
        written."""
        records: list[dict[str, Any]] = []
        for recording in recordings:
            mirrored = recording.mirrored_pictures
            records.append({"part": recording.part, "mirrored_pictures": mirrored})
            for a in recording.attitudes:
                rpy_rad = (a.roll_rad, a.pitch_rad, a.yaw_rad)
                records.append({"t_s": a.t_s, "rpy_rad": rpy_rad, "gyro_radps": a.gyro_radps})
            records += map(vars, recording.poses)
        lines = [json.dumps(r, separators=(",", ":"), default=np.ndarray.tolist) for r in records]
        write_files({path: ("\n".join(lines) + "\n").encode()})

    @staticmethod
    def read(path: Path) -> list[MountingRecording]:
        """Read the recordings in a file, in the file's order.

        Raises:
            NotFound: there is no such file.
            InvalidValue: the file was not written by `write`; the message names the invalid line.
        """
        try:
            text = path.read_text(encoding="utf-8")
        except FileNotFoundError:
            raise NotFound(
                f"{path} does not exist: name a recording from calibrate mount"
            ) from None
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "it is not text"
            raise InvalidValue(f"{path} cannot be read: {why}") from None
        parts: list[MountingRecording] = []
        for number, line in enumerate(text.splitlines(), start=1):
            try:
                record = json.loads(line)
                if "part" in record:
                    if record["part"] not in get_args(MountingPart):
                        raise ValueError("the part is unknown")
                    mirrored = int(record["mirrored_pictures"])
                    parts.append(MountingRecording(record["part"], mirrored_pictures=mirrored))
                elif "covariance" in record:
                    values = (_numbers(record, key, *shape) for key, shape in _POSE_SHAPES.items())
                    parts[-1].poses.append(TargetPose(*values))
                else:
                    t_s, gyro_radps = _numbers(record, "t_s"), _numbers(record, "gyro_radps", 3)
                    roll, pitch, yaw = _numbers(record, "rpy_rad", 3).tolist()
                    parts[-1].attitudes.append(AttitudeSample(t_s, roll, pitch, yaw, gyro_radps))
            except (LookupError, TypeError, ValueError, OverflowError, RecursionError) as error:
                if note := kind_note(path, "a recording from calibrate mount", "a JSON file"):
                    raise InvalidValue(
                        f"{path} is not a recording from calibrate mount{note}"
                    ) from None
                why = f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
                raise InvalidValue(
                    f"{path}, line {number} is not a line of a calibrate mount recording: {why}"
                ) from None
        if not parts:
            raise InvalidValue(f"{path} is empty: name a recording from calibrate mount")
        return parts


def _numbers(record: Mapping[str, Any], key: str, *shape: int) -> Any:
    """The numbers under a key as an array, or a float if `shape` is (). Raises KeyError, TypeError,
    ValueError."""
    values = np.array(record[key], dtype=np.float64)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{key} must contain {math.prod(shape)} numbers")
    return values if shape else float(values)


@dataclass(frozen=True, eq=False)
class PoseArrays:
    """Poses in order of time: t_s (n,), R_cam_target (n, 3, 3), p_cam_target_m (n, 3), and their
    covariances cov (n, 6, 6), rotation first."""

    t_s: Array
    R_cam_target: Array
    p_cam_target_m: Array
    cov: Array


def pose_arrays(recording: MountingRecording) -> PoseArrays:
    """The poses of a recording as arrays, in order of time."""
    poses = sorted(recording.poses, key=lambda pose: pose.t_s)
    return PoseArrays(
        t_s=np.array([p.t_s for p in poses]),
        R_cam_target=np.array([p.rotation_cam_target for p in poses]),
        p_cam_target_m=np.array([p.position_cam_target_m for p in poses]),
        cov=np.array([p.covariance for p in poses]),
    )


# --- The required motion, checked during the recording and before the solution ---


HOW_TO_RECORD: dict[MountingPart, str] = {
    "carry": "turn the vehicle by hand about every axis for 30 s, with the target in view",
    "pivot": "keep the gear's tip on one point, and tilt the vehicle around that point in every "
    "direction for 20 s",
}
MIRRORED = (
    "the picture is mirrored: turn mirroring off in the camera, or change "
    "camera.mirrored in the profile"
)
LEAST_SEEN_S: dict[MountingPart, float] = {"carry": 20.0, "pivot": 12.0}
LEAST_POSES: dict[MountingPart, int] = {"carry": 150, "pivot": 100}
LEAST_ATTITUDES = 500
TILT_DEG: dict[MountingPart, float] = {"carry": 30.0, "pivot": 25.0}
YAW_DEG, LEAST_RATE_DPS = 90.0, 15.0
"""Minimum range of the rotation about the vertical, from one side to the other with the target in
view, and minimum rate of rotation; only for a carry."""
MOST_LATE_S = 1.0


def check_recording(recording: MountingRecording, part: MountingPart) -> None:
    """Raise InvalidValue, with advice, unless the recording is of the given `part` and can be
    solved."""
    attitudes = recording.attitudes
    poses = recording.poses
    if recording.part != part:
        raise InvalidValue(f"this is a recording of the {recording.part}, not of the {part}")
    if recording.mirrored_pictures > max(5, len(poses)):
        raise InvalidValue(MIRRORED)
    if part == "carry" and attitudes and poses:
        begin_s = min(a.t_s for a in attitudes)
        end_s = max(a.t_s for a in attitudes)
        together = sum(begin_s <= p.t_s <= end_s + MOST_LATE_S for p in poses)
        if together < 0.5 * len(poses):
            raise InvalidValue(
                f"only {together} of {len(poses)} images were taken while telemetry was "
                "recorded: camera and telemetry must use the same clock; record again"
            )
    if lacking := missing_motion(recording):
        raise InvalidValue(f"the {part} recording lacks motion: {'; '.join(lacking)}")


def missing_motion(recording: MountingRecording) -> list[str]:
    """Return advice on each motion that is still missing in the recording; empty if it is
    complete."""
    part = recording.part
    poses = recording.poses
    attitudes = recording.attitudes
    if part == "carry" and len(attitudes) < 2:
        return ["wait for the vehicle"]
    if len(poses) < 2:
        return ["bring the target into view"]
    arrays, lacking = pose_arrays(recording), []
    view = arrays.R_cam_target[:, 2]
    tilts_deg = np.degrees(np.arctan2(view[:, :2], view[:, 2:]))
    directions = np.radians(np.arange(0.0, 180.0, 15.0))
    along = tilts_deg @ np.stack([np.cos(directions), np.sin(directions)])
    tilted = min(_extent(column) for column in along.T)
    if tilted < TILT_DEG[part]:
        lacking.append(
            f"tilt the vehicle in every direction ({tilted:.0f} of {TILT_DEG[part]:.0f} deg)"
        )
    if part == "carry":
        across = arrays.R_cam_target[:, :2, 0]
        turned = _extent(np.degrees(np.unwrap(np.arctan2(across[:, 1], across[:, 0]))))
        if turned < YAW_DEG:
            lacking.append(
                f"turn the vehicle about the vertical axis ({turned:.0f} of {YAW_DEG:.0f} deg)"
            )
        gyro_radps = np.array([a.gyro_radps for a in attitudes])
        rate_dps = math.degrees(math.sqrt(float((gyro_radps**2).sum(axis=1).mean())))
        if rate_dps < LEAST_RATE_DPS:
            lacking.append(f"turn the vehicle faster: {rate_dps:.0f} of {LEAST_RATE_DPS:.0f} deg/s")
        if len(attitudes) < LEAST_ATTITUDES:
            lacking.append(f"telemetry: {len(attitudes)} of {LEAST_ATTITUDES} samples")
    seen_s = float(np.minimum(np.diff(arrays.t_s), 0.2).sum())  # time with the target in view
    if seen_s < LEAST_SEEN_S[part] or len(poses) < LEAST_POSES[part]:
        lacking.append(f"continue: {seen_s:.0f} of {LEAST_SEEN_S[part]:.0f} s in view")
    return lacking


def _extent(values: Array) -> float:
    return float(np.ptp(np.percentile(values, (2.0, 98.0)))) if len(values) else 0.0
