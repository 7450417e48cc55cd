"""What was seen and felt while the vehicle was moved by hand, and its file of JSON lines.

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
FORMAT = 1
_DECIMALS = 9
_MOST_NOT_A_TURN = 1e-3  # of R R^T - 1


@dataclass(frozen=True, eq=False)
class AttitudeSample:
    """The vehicle's own estimate at `t_s` of its own clock, right-handed (pitch nose down).

    gyro_radps (3,) is in body axes. `position_m` (3,) in the world, where the estimate has one,
    to `position_sigma_m`.
    """

    t_s: float
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    gyro_radps: Array
    position_m: Array | None = None
    position_sigma_m: float | None = None


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
    """One part. `mirrored_pictures` counts those in which the target was seen mirrored only;
    `seen_by` says what else the poses rest on (see `perchctl.calibration.mounting.eye`), empty
    where that is not known."""

    part: MountingPart
    attitudes: tuple[AttitudeSample, ...]
    poses: tuple[SeenPose, ...]
    mirrored_pictures: int = 0
    seen_by: str = ""


def write_recordings(path: Path, recordings: Sequence[MountingRecording]) -> None:
    """Write the whole file, or nothing.

    Raises:
        InvalidValue: it cannot be written, or `read_recordings` would refuse a number.
    """
    records = [record for recording in recordings for record in _lines(recording)]
    try:
        lines = [json.dumps(r, separators=(",", ":"), allow_nan=False) for r in records]
    except ValueError:
        raise InvalidValue(f"{path} is not written: a sample holds a number that is none") from None
    write_files({path: ("\n".join(lines) + "\n").encode()})


def read_recordings(path: Path) -> tuple[MountingRecording, ...]:
    """The parts of a file, in its order.

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
    parts: list[_Growing] = []
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            _add(parts, json.loads(line, parse_constant=_refuse_constant))
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            what = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise InvalidValue(
                f"{path}, line {number} is no line of a recording of calibrate mount: {what}"
            ) from None
    if not parts:
        raise InvalidValue(f"{path} is empty: name a recording of calibrate mount")
    return tuple(
        MountingRecording(p.part, tuple(p.attitudes), tuple(p.poses), p.mirrored, p.seen_by)
        for p in parts
    )


def _lines(recording: MountingRecording) -> Iterator[dict[str, Any]]:
    yield {
        "part": recording.part,
        "format": FORMAT,
        "mirrored_pictures": recording.mirrored_pictures,
        "seen_by": recording.seen_by,
    }
    for a in recording.attitudes:
        rpy = (a.roll_rad, a.pitch_rad, a.yaw_rad)
        record = {"t_s": _plain(a.t_s), "rpy_rad": _plain(rpy), "gyro_radps": _plain(a.gyro_radps)}
        if a.position_m is not None:
            record["position_m"] = _plain(a.position_m)
        if a.position_sigma_m is not None:
            record["position_sigma_m"] = _plain(a.position_sigma_m)
        yield record
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


class _Growing:
    def __init__(self, part: MountingPart, mirrored: int, seen_by: str) -> None:
        self.part: MountingPart = part
        self.mirrored = mirrored
        self.seen_by = seen_by
        self.attitudes: list[AttitudeSample] = []
        self.poses: list[SeenPose] = []


def _add(parts: list[_Growing], record: Any) -> None:
    """One line into what is read so far. KeyError, TypeError and ValueError where it is none."""
    if not isinstance(record, dict):
        raise ValueError("not a JSON object")
    if "part" in record:
        if record["part"] not in get_args(MountingPart):
            raise ValueError(
                f"part {record['part']!r} is none of {', '.join(get_args(MountingPart))}"
            )
        if record["format"] != FORMAT:
            raise ValueError(f"format {record['format']!r}, this version reads {FORMAT}")
        mirrored, seen_by = int(record["mirrored_pictures"]), str(record.get("seen_by", ""))
        parts.append(_Growing(record["part"], mirrored, seen_by))
    elif not parts:
        raise ValueError("the file does not begin with a part")
    elif "rotation_cam_target" in record:
        parts[-1].poses.append(_pose(record))
    else:
        parts[-1].attitudes.append(_attitude(record))


def _attitude(record: Mapping[str, Any]) -> AttitudeSample:
    roll, pitch, yaw = _array(record["rpy_rad"], (3,)).tolist()
    sigma = record.get("position_sigma_m")
    return AttitudeSample(
        t_s=_number(record["t_s"]),
        roll_rad=roll,
        pitch_rad=pitch,
        yaw_rad=yaw,
        gyro_radps=_array(record["gyro_radps"], (3,)),
        position_m=_array(record["position_m"], (3,)) if "position_m" in record else None,
        position_sigma_m=None if sigma is None else _number(sigma),
    )


def _pose(record: Mapping[str, Any]) -> SeenPose:
    R = _array(record["rotation_cam_target"], (3, 3))
    if np.abs(R @ R.T - np.eye(3)).max() > _MOST_NOT_A_TURN or np.linalg.det(R) < 0.0:
        raise ValueError("rotation_cam_target is no rotation")
    cov = record.get("covariance")
    return SeenPose(
        t_s=_number(record["t_s"]),
        rotation_cam_target=R,
        position_cam_target_m=_array(record["position_cam_target_m"], (3,)),
        covariance=None if cov is None else _array(cov, (6, 6)),
    )


def _array(value: Any, shape: tuple[int, ...]) -> Array:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"found {value!r}, expected finite numbers of shape {shape}"[:120])
    return array


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"found {value!r}, expected a finite number")
    return number


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")
