"""Build the messages in a flight's recording from the records of its log.

The messages are Foxglove's protobuf messages, as defined in Foxglove's package. Values for which
Foxglove has no message are JSON. Frames: `world` (that of the state estimate), `body`, `gear`,
`camera` (OpenCV's axes, which Foxglove also uses), `target` and `setpoint`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import cv2
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from perchctl.geometry import quaternion_from_rotation, quaternion_from_rpy
from perchctl.profile import Profile
from perchctl.record.fields import FIELDS
from perchctl.vision import Frame

WORLD, BODY, GEAR, CAMERA = "world", "body", "gear", "camera"
TARGET, SETPOINT = "target", "setpoint"

IMAGE, FRAME, CORNERS = "/camera/image", "/camera/frame", "/camera/corners"
TF = "/tf"
TICK = "/tick"

NS = 1_000_000_000
PNG_LEVEL = 1
"""A fast compression level. The next higher levels take twice the time and save 5 % of the size."""
BODY_KEYS = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
TARGET_KEYS = ("tx_m", "ty_m", "tz_m", "tyaw_rad")
SETPOINT_KEYS = ("cmd_x_m", "cmd_y_m", "cmd_z_m", "cmd_yaw_rad")


def image_message(time_ns: int, frame: Frame) -> CompressedImage:
    """Return the message for an image: the camera's own JPEG, or else a PNG."""
    data = frame.source_jpeg
    if data is None:
        png = cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])[1]
        data = png.tobytes()
    form = "png" if data.startswith(b"\x89PNG") else "jpeg"
    return CompressedImage(timestamp=to_stamp(time_ns), frame_id=CAMERA, data=data, format=form)


_TEXTS = ("phase", "stage", "reason", "hold", "pos_note", "lock_note", "cmd")
_TYPES = {
    **dict.fromkeys(_TEXTS, "string"),
    **dict.fromkeys(("measured", "tracked"), "boolean"),
    **dict.fromkeys(("large_px", "small_px"), "array"),
}
TICK_SCHEMA = {
    "type": "object",
    "title": "One tick of the flight loop, as in the flight log",
    "properties": {
        key: {
            "type": _TYPES.get(key, "number"),
            "items": {"type": "number"},  # the items of an array
            "description": text,
        }
        for key, text in FIELDS.items()
    },
}
"""JSON schema of the ticks, for which Foxglove has none."""


# --- Foxglove's messages ---

_OUTLINE = Color(r=0.1, g=0.9, b=0.2, a=1.0)


def to_stamp(time_ns: int) -> Timestamp:
    """Convert nanoseconds since 1970 to a protobuf time stamp."""
    return Timestamp(seconds=time_ns // NS, nanos=time_ns % NS)


def corners_message(time_ns: int, record: Mapping[str, Any]) -> ImageAnnotations:
    """The markers' outlines in the frame of a tick's record; empty for
    a frame without the target, which clears the previous outlines."""
    return ImageAnnotations(
        timestamp=to_stamp(time_ns),
        points=[
            PointsAnnotation(
                timestamp=to_stamp(time_ns),
                type=PointsAnnotation.LINE_LOOP,
                points=[Point2(x=x, y=y) for x, y in zip(px[::2], px[1::2], strict=True)],
                outline_color=_OUTLINE,
                thickness=2.0,
            )
            for px in (record.get("large_px"), record.get("small_px"))
            if px is not None
        ],
    )


def fixed_transforms(profile: Profile) -> list[FrameTransform]:
    """The fixed transforms from the body to the camera and to the gear."""
    T_body_cam, gear_m = profile.camera.mount.T_body_cam, profile.vehicle.gear_body_m
    q = quaternion_from_rotation(T_body_cam[:3, :3])
    level = (1.0, 0.0, 0.0, 0.0)
    return [
        _transform(0, BODY, CAMERA, T_body_cam[:3, 3], q),
        _transform(0, BODY, GEAR, gear_m, level),
    ]


def moving_transforms(
    time_ns: int, sampled_ns: int, record: Mapping[str, Any]
) -> Iterator[FrameTransform]:
    """Yield the transforms from the world to the body (at `sampled_ns`), the target and the
    setpoint in a tick's record. A transform that is missing or not finite is left out."""
    for child, at_ns, keys in (
        (BODY, sampled_ns, BODY_KEYS),
        (TARGET, time_ns, TARGET_KEYS),
        (SETPOINT, time_ns, SETPOINT_KEYS),
    ):
        values: list[Any] = [record.get(key) for key in keys]
        if all(value is not None and math.isfinite(value) for value in values):
            x, y, z, *angles = values
            roll, pitch, yaw = angles if len(angles) == 3 else (0.0, 0.0, *angles)
            q = quaternion_from_rpy(roll, pitch, yaw)
            yield _transform(at_ns, WORLD, child, (x, y, z), q)


def _transform(
    ns: int, parent: str, child: str, t_m: Any, q: tuple[float, float, float, float]
) -> FrameTransform:
    (x, y, z), (w, qx, qy, qz) = t_m, q
    return FrameTransform(
        timestamp=to_stamp(ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(w=w, x=qx, y=qy, z=qz),
    )
