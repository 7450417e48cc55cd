"""A flight's recording as an MCAP file: what is written into it, and how.

The messages are made of the log's own records. They are Foxglove's protobuf ones, with the
definitions of Foxglove's own package: a picture stays the bytes that it came as, which the JSON
variant of the same schemas would make a third longer. What is perchctl's own is JSON. Frames:
`world` (of the state estimate), `body`, `gear`, `camera` (OpenCV's axes, which are Foxglove's),
`target` and `setpoint`.
"""

from __future__ import annotations

import json
import math
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

import perchctl
from perchctl.geometry import quaternion_from_rotation, quaternion_from_rpy
from perchctl.profile import Profile
from perchctl.record.disk import DiskFile
from perchctl.record.exact import encode
from perchctl.record.fields import FIELDS
from perchctl.vision import Frame

WORLD, BODY, GEAR, CAMERA = "world", "body", "gear", "camera"
TARGET, SETPOINT = "target", "setpoint"

IMAGE, FRAME, CORNERS = "/camera/image", "/camera/frame", "/camera/corners"
TF = "/tf"
LOG, TICK = "/log", "/tick"

NS = 1_000_000_000
CHUNK_BYTES = 4_000_000
PNG_LEVEL = 1
"""Fast; the next levels cost twice the time for a twentieth of the size."""
BODY_KEYS = ("x_m", "y_m", "z_m", "roll_rad", "pitch_rad", "yaw_rad")
TARGET_KEYS = ("tx_m", "ty_m", "tz_m", "tyaw_rad")
SETPOINT_KEYS = ("cmd_x_m", "cmd_y_m", "cmd_z_m", "cmd_yaw_rad")


# --- the file ---------------------------------------------------------


class RecordingFile:
    """A recording that grows, in the order in which a flight gives it; one thread's. Every method
    but `close` may raise OSError.

    Its times are nanoseconds since 1970. A flight in lockstep has no wall clock: its recording
    begins in 1970, at 0.

    Attributes:
        pictures: how many were written; `newest_s`: the loop's time of what was written last.
        size_bytes: of all messages so far, before they are compressed.
    """

    def __init__(self, stream: DiskFile, header: Mapping[str, Any], profile: Profile) -> None:
        """Begin the file at the times of the log's header."""
        self.pictures = self.size_bytes = 0
        self.newest_s = self._t0_s = float(header["t0_s"])
        started = header.get("started_utc")
        self._started_ns = NS * round(datetime.fromisoformat(started).timestamp()) if started else 0
        self._mounts = mounts_of(profile)
        self._first_s: float | None = None
        self._stream = stream
        self._writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)  # type: ignore[arg-type]
        self._channels: dict[str, int] = {}
        self._writer.start(library=f"perchctl {perchctl.__version__}")

    def frame(self, about: Mapping[str, Any], picture: tuple[bytes, str] | None) -> None:
        """Write a frame as its source gave it (`frame_record`), and its picture with its format
        (`encoded`) where it is to be kept."""
        ns = self._ns(about["t_arrival_s"])
        self.newest_s = about["t_arrival_s"]
        number = about["number"] & 0xFFFFFFFF
        if picture is not None:
            data, form = picture
            taken = stamp(self._ns(about["t_s"]))
            image = CompressedImage(timestamp=taken, frame_id=CAMERA, data=data, format=form)
            self._add(IMAGE, ns, image, number)
            self.pictures += 1
        # With all digits: a replay needs the very times.
        self._add(FRAME, ns, json.dumps(about).encode(), number)

    def tick(self, record: Mapping[str, Any]) -> None:
        """Write a tick's record (`perchctl.record.fields.FIELDS`) with its times since the first
        flown turn, and what it shows in space."""
        t_s, exposed_s = float(record["t_s"]), record.get("frame_t_s")
        self.newest_s, ns = t_s, self._ns(t_s)
        first_s = self._first_s = t_s if self._first_s is None else self._first_s
        for mount in self._mounts:
            mount.timestamp.CopyFrom(stamp(ns))
        sampled_ns = self._ns(t_s - (record.get("tel_age_s") or 0.0))
        moving = [
            _transform_to(BODY, sampled_ns, record, BODY_KEYS),
            _transform_to(TARGET, ns, record, TARGET_KEYS),
            _transform_to(SETPOINT, ns, record, SETPOINT_KEYS),
        ]
        transforms = [*self._mounts, *(each for each in moving if each is not None)]
        self._add(TF, ns, FrameTransforms(transforms=transforms))
        shown = {**record, "t_s": t_s - first_s}
        if exposed_s is not None:
            self._add(CORNERS, ns, corners_message(self._ns(exposed_s), record))
            shown["frame_t_s"] = exposed_s - first_s
        self._add(TICK, ns, encode(shown)[:-1])

    def event(self, record: Mapping[str, Any]) -> None:
        """Write an event's record (`perchctl.record.fields.event_record`)."""
        ns = self._ns(float(record["t_s"]))
        self._add(LOG, ns, log_message(ns, record))

    def flush(self) -> None:
        """Bring to the disk what was added so far."""
        self._writer.flush()

    def free_bytes(self) -> int:
        """Return the bytes that are left on its disk."""
        return self._stream.free_bytes()

    def finish(self) -> None:
        """End the file with its index; nothing can be added any more."""
        self._writer.finish()
        self._stream.flush()
        self._stream.close()

    def close(self) -> None:
        """Close the file without an index, where its last whole record ends. Never raises."""
        with suppress(OSError):
            self._stream.close()

    def _ns(self, t_s: float) -> int:
        """Return a time on the loop's clock as nanoseconds since 1970; what was before that is at
        0, which MCAP begins at."""
        return max(0, self._started_ns + round((t_s - self._t0_s) * NS))

    def _add(self, topic: str, ns: int, message: Message | bytes, sequence: int = 0) -> None:
        """Add a message of Foxglove's, or JSON."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._new_channel(topic, message)
        data = message if isinstance(message, bytes) else message.SerializeToString()
        self._writer.add_message(channel, ns, data, ns, sequence)
        self.size_bytes += len(data)

    def _new_channel(self, topic: str, message: Message | bytes) -> int:
        if isinstance(message, bytes):
            schema = json.dumps(TICK_SCHEMA if topic == TICK else {"type": "object"}).encode()
            name = f"perchctl.{topic.rpartition('/')[2].capitalize()}"
            number = self._writer.register_schema(name, SchemaEncoding.JSONSchema, schema)
            return self._writer.register_channel(topic, MessageEncoding.JSON, number)
        number = register_schema(self._writer, type(message))
        return self._writer.register_channel(topic, MessageEncoding.Protobuf, number)


def frame_record(frame: Frame) -> dict[str, Any]:
    """Return the frame without its picture, but with the checksum that identifies it."""
    return {
        "number": frame.index,
        "t_s": frame.t_s,
        "t_arrival_s": frame.t_arrival_s,
        "repeated": frame.repeated,
        "crc32": zlib.crc32(np.ascontiguousarray(frame.image).data),
    }


def encoded(frame: Frame) -> tuple[bytes, str]:
    """Return the picture's bytes and their format: as they came, or without loss."""
    if frame.encoded is not None:
        return frame.encoded, "jpeg"
    _, data = cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    return data.tobytes(), "png"


_TEXTS = ("phase", "stage", "reason", "hold", "pos_note", "lock_note", "cmd")
_TYPES = {
    **dict.fromkeys(_TEXTS, "string"),
    **dict.fromkeys(("measured", "tracked"), "boolean"),
    **dict.fromkeys(("large_px", "small_px"), "array"),
}
TICK_SCHEMA = {
    "type": "object",
    "title": "One turn of the flight loop, as the flight log has it",
    "properties": {
        key: {
            "type": _TYPES.get(key, "number"),
            "items": {"type": "number"},  # of an array
            "description": text,
        }
        for key, text in FIELDS.items()
    },
}
"""JSON schema of the ticks, for which Foxglove has none."""


# --- Foxglove's messages ----------------------------------------------

_LEVELS = {"hold": Log.WARNING, "back off": Log.WARNING, "land": Log.ERROR, "stop": Log.FATAL}
_OUTLINE = Color(r=0.1, g=0.9, b=0.2, a=1.0)


def stamp(ns: int) -> Timestamp:
    """Return nanoseconds since 1970 as protobuf's time stamp."""
    return Timestamp(seconds=ns // NS, nanos=ns % NS)


def log_message(ns: int, record: Mapping[str, Any]) -> Log:
    """Return the message of an event's record. What goes on is an info, a landing an error, a stop
    fatal."""
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
    """Return the markers' outlines in the frame of a tick's record; a frame without the target has
    none, so that no old one stays in the picture."""
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
    """Return the transforms of what does not move against the body: camera and gear."""
    T_body_cam, gear_m = profile.camera.mount.T_body_cam, profile.vehicle.gear_body_m
    q = quaternion_from_rotation(T_body_cam[:3, :3])
    level = (1.0, 0.0, 0.0, 0.0)
    return [
        _transform(0, BODY, CAMERA, T_body_cam[:3, 3], q),
        _transform(0, BODY, GEAR, gear_m, level),
    ]


def _transform_to(
    child: str, ns: int, record: Mapping[str, Any], keys: Sequence[str]
) -> FrameTransform | None:
    """Return the transform from the world, by three keys of a position and one of a heading or
    three of an attitude; None where one of them is missing or not finite."""
    values: list[Any] = [record.get(key) for key in keys]
    if any(value is None or not math.isfinite(value) for value in values):
        return None
    x, y, z, *angles = values
    roll, pitch, yaw = angles if len(angles) == 3 else (0.0, 0.0, *angles)
    return _transform(ns, WORLD, child, (x, y, z), quaternion_from_rpy(roll, pitch, yaw))


def _transform(
    ns: int, parent: str, child: str, t_m: Any, q: tuple[float, float, float, float]
) -> FrameTransform:
    (x, y, z), (w, qx, qy, qz) = t_m, q
    return FrameTransform(
        timestamp=stamp(ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(w=w, x=qx, y=qy, z=qz),
    )
