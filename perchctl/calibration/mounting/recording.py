"""Poses and attitudes of a vehicle that is moved by hand, the motion that they need, and their file
of JSON lines.

Each part begins with a line ``{"part": "carry", ...}``; one line a sample follows, first all
attitudes, then all poses. A file holds one part or both.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from perchctl.errors import InvalidValue, NotFound
from perchctl.files import write_files
from perchctl.geometry import Array

MountingPart = Literal["carry", "pivot"]
BARE_SIGMA_RAD, BARE_SHARE = np.radians(0.3), 0.005
"""Of a pose that does not say: of its rotation, and of its distance."""
_FORMAT = 1
_DECIMALS = 9
_MOST_NOT_A_ROTATION = 1e-3  # of R R^T - 1


@dataclass(frozen=True, eq=False)
class AttitudeSample:
    """The vehicle's own estimate at `t_s` of its own clock, right-handed (pitch nose down).

    gyro_radps (3,) is in body axes."""

    t_s: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    gyro_radps: Array


@dataclass(frozen=True, eq=False)
class SeenPose:
    """The target in the camera's frame.

    `t_s` is the camera's own timestamp, before any latency is taken off. Of `covariance` (6, 6)
    the first three are a small turn in camera axes (rad, on the left of `rotation_cam_target`),
    the others the position (m).
    """

    t_s: float
    rotation_cam_target: Array
    position_cam_target_m: Array
    covariance: Array | None = None


@dataclass(frozen=True, eq=False)
class MountingRecording:
    """The recording of one part. `mirrored_pictures` counts those in which the target was seen
    mirrored only; `seen_by` says what else the poses rest on (see
    `perchctl.calibration.mounting.pose_reader`), empty where that is not known."""

    part: MountingPart
    attitudes: tuple[AttitudeSample, ...]
    poses: tuple[SeenPose, ...]
    mirrored_pictures: int = 0
    seen_by: str = ""


@dataclass(frozen=True, eq=False)
class PoseArrays:
    """Poses by time: t_s (n,), R_cam_target (n, 3, 3), p_cam_target_m (n, 3), and their
    covariances cov (n, 6, 6), rotation first: their own, or what their distance usually has."""

    t_s: Array
    R_cam_target: Array
    p_cam_target_m: Array
    cov: Array


def pose_arrays(recording: MountingRecording) -> PoseArrays:
    """Return the poses of a recording as arrays, by time."""
    poses = sorted(recording.poses, key=lambda pose: pose.t_s)
    covs = []
    for pose in poses:
        far_m = float(np.linalg.norm(pose.position_cam_target_m))
        usual = np.diag(np.square([BARE_SIGMA_RAD] * 3 + [BARE_SHARE * far_m] * 3))
        covs.append(usual if pose.covariance is None else pose.covariance)
    return PoseArrays(
        t_s=np.array([p.t_s for p in poses]),
        R_cam_target=np.array([p.rotation_cam_target for p in poses]),
        p_cam_target_m=np.array([p.position_cam_target_m for p in poses]),
        cov=np.array(covs),
    )


# --- The motion that a recording needs, named while it is recorded and before it is solved -------


HOW_TO_RECORD: dict[MountingPart, str] = {
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


# --- The file --------------------------------------------------------------------------------


def write_recordings(path: Path, recordings: Sequence[MountingRecording]) -> None:
    """Write the whole file, or nothing.

    Raises:
        InvalidValue: it cannot be written, or `read_recordings` would refuse a number.
    """
    records = [record for recording in recordings for record in _records(recording)]
    try:
        lines = [json.dumps(r, separators=(",", ":"), allow_nan=False) for r in records]
    except ValueError:
        raise InvalidValue(f"{path} is not written: a sample holds a number that is none") from None
    write_files({path: ("\n".join(lines) + "\n").encode()})


def _records(recording: MountingRecording) -> Iterator[dict[str, Any]]:
    yield {
        "part": recording.part,
        "format": _FORMAT,
        "mirrored_pictures": recording.mirrored_pictures,
        "seen_by": recording.seen_by,
    }
    for a in recording.attitudes:
        rpy = (a.roll_rad, a.pitch_rad, a.yaw_rad)
        yield {"t_s": _plain(a.t_s), "rpy_rad": _plain(rpy), "gyro_radps": _plain(a.gyro_radps)}
    for p in recording.poses:
        record = {
            "t_s": _plain(p.t_s),
            "rotation_cam_target": _plain(p.rotation_cam_target),
            "position_cam_target_m": _plain(p.position_cam_target_m),
        }
        if p.covariance is not None:
            # Its numbers are small: digits that count, not decimals.
            record["covariance"] = [[float(f"{v:.9g}") for v in row] for row in p.covariance]
        yield record


def _plain(value: Any) -> Any:
    return np.round(np.asarray(value, dtype=np.float64), _DECIMALS).tolist()


def read_recordings(path: Path) -> tuple[MountingRecording, ...]:
    """Return the parts of a file, in its order.

    Raises:
        NotFound: no such file.
        InvalidValue: it is none of `write_recordings`, with the line that is not.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise NotFound(f"{path} is not there: name a recording of calibrate mount") from None
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not text"
        raise InvalidValue(f"{path} cannot be read: {why}") from None
    parts: list[tuple[dict[str, Any], list[AttitudeSample], list[SeenPose]]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            record = json.loads(line)
            if "part" in record:
                parts.append((_head(record), [], []))
            elif not parts:
                raise ValueError("the file does not begin with a part")
            elif "rotation_cam_target" in record:
                parts[-1][2].append(_pose(record))
            else:
                parts[-1][1].append(_attitude(record))
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            why = f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
            raise InvalidValue(
                f"{path}, line {number} is no line of a recording of calibrate mount: {why}"
            ) from None
    if not parts:
        raise InvalidValue(f"{path} is empty: name a recording of calibrate mount")
    return tuple(
        MountingRecording(attitudes=tuple(attitudes), poses=tuple(poses), **head)
        for head, attitudes, poses in parts
    )


def _head(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a recording beside its samples."""
    if record["format"] != _FORMAT or record["part"] not in get_args(MountingPart):
        raise ValueError("the part or its format is unknown")
    return {
        "part": record["part"],
        "mirrored_pictures": int(record["mirrored_pictures"]),
        "seen_by": str(record.get("seen_by", "")),
    }


def _attitude(record: Mapping[str, Any]) -> AttitudeSample:
    roll, pitch, yaw = _numbers(record, "rpy_rad", 3).tolist()
    t_s, gyro_radps = float(_numbers(record, "t_s")), _numbers(record, "gyro_radps", 3)
    return AttitudeSample(t_s, roll, pitch, yaw, gyro_radps)


def _pose(record: Mapping[str, Any]) -> SeenPose:
    R = _numbers(record, "rotation_cam_target", 3, 3)
    if np.abs(R @ R.T - np.eye(3)).max() > _MOST_NOT_A_ROTATION or np.linalg.det(R) < 0.0:
        raise ValueError("rotation_cam_target is no rotation")
    cov = _numbers(record, "covariance", 6, 6) if "covariance" in record else None
    t_s, position_m = float(_numbers(record, "t_s")), _numbers(record, "position_cam_target_m", 3)
    return SeenPose(t_s, R, position_m, cov)


def _numbers(record: Mapping[str, Any], key: str, *shape: int) -> Array:
    """Raises KeyError, TypeError or ValueError where the key does not hold such numbers."""
    values = np.array(record[key], dtype=np.float64)
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{key} must hold {math.prod(shape)} numbers")
    return values
