"""What a recording says of a log's records: Foxglove's own messages, and JSON where it has none.

Every message is made from the records that the log holds, so that a recording made in flight and
one made of its log say the same. Frames: `world` (of the state estimate), `body`, `gear`, `camera`
(OpenCV's axes, which are Foxglove's) and `target`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from perchctl.geometry import quaternion_from_rotation, quaternion_from_rpy
from perchctl.profile import Profile
from perchctl.vision import CameraModel

WORLD, BODY, GEAR, CAMERA, TARGET = "world", "body", "gear", "camera", "target"

IMAGE, FRAME, CALIBRATION = "/camera/image", "/camera/frame", "/camera/calibration"
TF, VEHICLE, PATH, TARGET_POSE = "/tf", "/vehicle/pose", "/vehicle/path", "/target/pose"
SETPOINT, SCENE, LOG, TICK = "/setpoint", "/scene", "/log", "/tick"
CORNERS = "/camera/corners"
SENT = "/sent"

PATH_PERIOD_S = 1.0
"""The whole path so far is said so often: who jumps into the middle sees what was flown."""
PATH_STEP_S = 0.1

_MODELS = {"fisheye": "kannala_brandt"}
"""Foxglove's name of OpenCV's fisheye; the others are called alike."""
_LEVELS = {"hold": Log.WARNING, "back off": Log.WARNING, "land": Log.ERROR, "stop": Log.FATAL}
_OUTLINE = Color(r=0.1, g=0.9, b=0.2, a=1.0)

Said = tuple[str, Message]
"""A topic and its message."""


def stamp(ns: int) -> Timestamp:
    return Timestamp(seconds=ns // NS, nanos=ns % NS)


def image_message(ns: int, data: bytes, form: str) -> CompressedImage:
    """`form` is ``jpeg`` or ``png``."""
    return CompressedImage(timestamp=stamp(ns), frame_id=CAMERA, data=data, format=form)


def calibration_message(ns: int, camera: CameraModel) -> CameraCalibration:
    """With its distortion. One camera needs no rectification: R is 1 and P holds K."""
    width, height = camera.size_px
    P = np.hstack([camera.K, np.zeros((3, 1))])
    return CameraCalibration(
        timestamp=stamp(ns),
        frame_id=CAMERA,
        width=width,
        height=height,
        distortion_model=_MODELS.get(camera.model, camera.model),
        D=[float(v) for v in np.ravel(camera.dist)],
        K=[float(v) for v in np.ravel(camera.K)],
        R=[float(v) for v in np.eye(3).ravel()],
        P=[float(v) for v in P.ravel()],
    )


def log_message(ns: int, record: Mapping[str, Any]) -> Log:
    """An event's record. What goes on is an info, a landing an error, a stop fatal."""
    level = _LEVELS.get(str(record.get("severity")), Log.INFO)
    what, phase = record.get("event"), record.get("phase")
    text = str(record.get("reason") or "")
    if what == "phase":
        text = f"{phase}: {text}".rstrip(": ")
    elif what == "hold":
        text = f"held: {text}"
    if record.get("simulated"):
        text = f"{text} (simulated: {record['simulated']})"
    return Log(
        timestamp=stamp(ns),
        level=level,
        message=text,
        name="perchctl",
        file=record.get("row") or "",
    )


def corners_message(ns: int, record: Mapping[str, Any]) -> ImageAnnotations:
    """The markers' outlines in the frame of a tick's record; none of one without the target,
    so that no old one stays in the picture."""
    return ImageAnnotations(
        timestamp=stamp(ns),
        points=[
            PointsAnnotation(
                timestamp=stamp(ns),
                type=PointsAnnotation.LINE_LOOP,
                points=[Point2(x=x, y=y) for x, y in zip(px[::2], px[1::2], strict=True)],
                outline_color=_OUTLINE,
                thickness=2.0,
            )
            for px in (record.get("large_px"), record.get("small_px"))
            if px is not None
        ],
    )


def mounts_of(profile: Profile) -> list[FrameTransform]:
    """What does not move against the body."""
    T_body_cam = profile.camera.mount.T_body_cam
    q = quaternion_from_rotation(T_body_cam[:3, :3])
    gear_m = profile.vehicle.gear_body_m
    return [
        _transform(0, BODY, CAMERA, T_body_cam[:3, 3], q),
        _transform(0, BODY, GEAR, gear_m, (1.0, 0.0, 0.0, 0.0)),
    ]


class Said3d:
    """The messages of each tick for the 3-D panel, and the path that grows with them.

    What stands still is said with every tick: who jumps into the middle of a flight gets the
    newest message of each topic, and no older one.
    """

    def __init__(self, epoch: Epoch, mounts: Sequence[FrameTransform] = ()) -> None:
        self._epoch = epoch
        self._mounts = mounts
        self._target: FrameTransform | None = None  # where it was last
        self._path = PosesInFrame(frame_id=WORLD)
        self._path_s = self._point_s = -math.inf

    def of(self, record: Mapping[str, Any]) -> Iterator[Said]:
        """Of a tick's record (`perchctl.log.fields.FIELDS`)."""
        t_s = float(record["t_s"])
        ns = self._epoch.ns(t_s)
        now = stamp(ns)
        for mount in self._mounts:
            mount.timestamp.CopyFrom(now)
        transforms = list(self._mounts)
        body = _body_of(record)
        if body is not None:
            sampled_ns = self._epoch.ns(t_s - (_number(record, "tel_age_s") or 0.0))
            transforms.append(_transform(sampled_ns, WORLD, BODY, *body))
            pose = _pose(*body)
            yield VEHICLE, PoseInFrame(timestamp=stamp(sampled_ns), frame_id=WORLD, pose=pose)
            yield from self._path_with(pose, t_s, ns)
        target = _turned(record, "tx_m", "ty_m", "tz_m", "tyaw_rad")
        if target is not None:
            self._target = _transform(ns, WORLD, TARGET, *target)
            yield TARGET_POSE, _pose_in_world(ns, target)
        elif self._target is not None:
            self._target.timestamp.CopyFrom(now)
        if self._target is not None:
            transforms.append(self._target)
        yield TF, FrameTransforms(transforms=transforms)
        setpoint = _turned(record, "cmd_x_m", "cmd_y_m", "cmd_z_m", "cmd_yaw_rad")
        if setpoint is not None:
            yield SETPOINT, _pose_in_world(ns, setpoint)

        if record.get("frame_t_s") is not None:
            yield CORNERS, corners_message(self._epoch.ns(float(record["frame_t_s"])), record)

    def _path_with(self, pose: Pose, t_s: float, ns: int) -> Iterator[Said]:
        if t_s - self._point_s >= PATH_STEP_S:
            self._point_s = t_s
            self._path.poses.append(pose)
        if t_s - self._path_s >= PATH_PERIOD_S:
            self._path_s = t_s
            self._path.timestamp.CopyFrom(stamp(ns))
            yield PATH, self._path


Placed = tuple[Any, tuple[float, float, float, float]]
"""A position (3,), m, and a quaternion (w, x, y, z)."""


def _body_of(record: Mapping[str, Any]) -> Placed | None:
    keys = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
    values = [_number(record, key) for key in keys]
    if any(value is None for value in values):
        return None
    x, y, z, roll, pitch, yaw = (float(v) for v in values if v is not None)
    return (x, y, z), quaternion_from_rpy(roll, pitch, yaw)


def _turned(record: Mapping[str, Any], *keys: str) -> Placed | None:
    """Three keys of a position and one of a heading."""
    values = [_number(record, key) for key in keys]
    if any(value is None for value in values):
        return None
    x, y, z, yaw = (float(v) for v in values if v is not None)
    return (x, y, z), quaternion_from_rpy(0.0, 0.0, yaw)


def _number(record: Mapping[str, Any], key: str) -> float | None:
    """None for what is missing or not finite: a view of it would fail."""
    value = record.get(key)
    return float(value) if value is not None and math.isfinite(value) else None


def _transform(
    ns: int, parent: str, child: str, t_m: Any, q: tuple[float, float, float, float]
) -> FrameTransform:
    return FrameTransform(
        timestamp=stamp(ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=_vector(t_m),
        rotation=_quaternion(q),
    )


def _pose(t_m: Any, q: tuple[float, float, float, float]) -> Pose:
    return Pose(position=_vector(t_m), orientation=_quaternion(q))


def _pose_in_world(ns: int, placed: Placed) -> PoseInFrame:
    return PoseInFrame(timestamp=stamp(ns), frame_id=WORLD, pose=_pose(*placed))


def _vector(t_m: Any) -> Vector3:
    x, y, z = t_m
    return Vector3(x=x, y=y, z=z)


def _quaternion(q: tuple[float, float, float, float]) -> Quaternion:
    w, x, y, z = q
    return Quaternion(w=w, x=x, y=y, z=z)


# --- The loop's clock on the wall's, in which a recording tells its times ----------------------


NS = 1_000_000_000


@dataclass(frozen=True)
class Epoch:
    """`started_ns` of the wall's clock, since 1970, is `t0_s` of the loop's.

    A flight in lockstep has no wall clock: its recording begins in 1970, at 0.
    """

    started_ns: int
    t0_s: float

    def ns(self, t_s: float) -> int:
        """Nanoseconds since 1970; what was before that is at 0, which MCAP begins at."""
        return max(0, self.started_ns + round((t_s - self.t0_s) * NS))


def epoch_of(header: Mapping[str, Any], first_s: float) -> Epoch:
    """By a log's header; `first_s` is the loop's time of the first record, which counts as the
    start where the header does not say more."""
    t0_s = header.get("t0_s")
    if not isinstance(t0_s, (int, float)) or not math.isfinite(t0_s):
        t0_s = first_s
    return Epoch(_started_ns(header.get("started_utc")), float(t0_s))


def _started_ns(text: Any) -> int:
    try:
        started = datetime.fromisoformat(str(text))
    except ValueError:
        return 0
    aware = started if started.tzinfo else started.replace(tzinfo=UTC)
    since = aware - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86400 + since.seconds) * NS + since.microseconds * 1000
