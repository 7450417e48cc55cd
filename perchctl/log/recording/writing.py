"""What a recording holds, in the order in which a flight gives it; one thread's."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from perchctl.log.jsonl import encode
from perchctl.log.recording import messages as m
from perchctl.log.recording.container import Container, Stream
from perchctl.log.recording.messages import BODY, TARGET, Epoch, epoch_of, stamp
from perchctl.log.recording.shapes import LOOP_TIMES
from perchctl.profile import Profile
from perchctl.vision import CameraModel, Frame

PNG_LEVEL = 1
"""Fast; the next levels cost twice the time for a twentieth of the size."""
HEADER_NAME = "header.json"


class Writing:
    """A recording that grows. What writes may raise OSError.

    Attributes:
        pictures: how many were written; `newest_s`: the loop's time of what was written last.
    """

    def __init__(
        self,
        stream: Stream,
        header: Mapping[str, Any],
        profile: Profile | None,
        camera: CameraModel | None,
    ) -> None:
        """None of profile and camera: without what follows from them."""
        self.pictures = 0
        self.newest_s = 0.0
        self._header = header
        self._profile = profile
        self._camera = camera
        self._container = Container(stream)
        self._epoch: Epoch | None = None
        self._first_s: float | None = None
        self._said = m.Said3d(Epoch(0, 0.0))

    @property
    def size_bytes(self) -> int:
        return self._container.size_bytes

    def frame(self, told: Mapping[str, Any], picture: tuple[bytes, str] | None) -> None:
        """A frame as its source gave it (`told_of`), and its picture with its format (`encoded`)
        where it is to be kept."""
        ns = self._at(told["t_arrival_s"])
        number = told["number"] & 0xFFFFFFFF
        if picture is not None:
            taken_ns = self._epoch_at(told["t_s"]).ns(told["t_s"])
            self._container.say(m.IMAGE, ns, m.image_message(taken_ns, *picture), number)
            self.pictures += 1
        # With all digits: a replay needs the very times.
        self._container.say_json(m.FRAME, ns, json.dumps(told).encode(), number)

    def tick(self, record: Mapping[str, Any]) -> None:
        ns = self._at(float(record["t_s"]))
        if self._first_s is None:
            self._first_s = float(record["t_s"])
        for topic, message in self._said.of(record):
            self._container.say(topic, ns, message)
        self._container.say_json(m.TICK, ns, encode(self._counted(record))[:-1])

    def sent(self, values: Mapping[str, Any]) -> None:
        """What was sent in the loop's place (`perchctl.log.sent.sent_values`)."""
        ns = self._at(float(values["t_s"]))
        self._container.say_json(m.SENT, ns, encode(self._counted(values))[:-1])

    def event(self, record: Mapping[str, Any]) -> None:
        ns = self._at(float(record["t_s"]))
        self._container.say(m.LOG, ns, m.log_message(ns, record))

    def flush(self) -> None:
        self._container.flush()

    def free_bytes(self) -> int:
        return self._container.free_bytes()

    def finish(self) -> None:
        self._container.finish()

    def give_up(self) -> None:
        """End what the disk took; never raises."""
        self._container.give_up()

    def _counted(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """With its times as every output counts them, from the first flown turn; before that
        without them."""
        first_s = self._first_s
        times = [key for key in LOOP_TIMES if record.get(key) is not None]
        return {
            **record,
            **{key: None if first_s is None else record[key] - first_s for key in times},
        }

    def _at(self, t_s: float) -> int:
        self.newest_s = t_s
        return self._epoch_at(t_s).ns(t_s)

    def _epoch_at(self, t_s: float) -> Epoch:
        """The start's, which is known by the first record at the latest; with it goes what is
        said once."""
        if self._epoch is None:
            self._epoch = epoch = epoch_of(self._header, t_s)
            ns = epoch.ns(epoch.t0_s)
            mounts = [] if self._profile is None else m.mounts_of(self._profile)
            self._said = m.Said3d(epoch, mounts)
            self._container.attach(HEADER_NAME, ns, self._header)
            if self._camera is not None:
                self._container.say(m.CALIBRATION, ns, m.calibration_message(ns, self._camera))
            if self._profile is not None:
                self._container.say(m.SCENE, ns, scene_message(ns, self._profile))
        return self._epoch


def told_of(frame: Frame) -> dict[str, Any]:
    """The frame without its picture, but with what tells whether one is it."""
    return {
        "number": frame.index,
        "t_s": frame.t_s,
        "t_arrival_s": frame.t_arrival_s,
        "repeated": frame.repeated,
        "crc32": zlib.crc32(np.ascontiguousarray(frame.image).data),
    }


def encoded(frame: Frame) -> tuple[bytes, str]:
    """The picture's bytes and their format: as they came, or without loss."""
    if frame.encoded is not None:
        return frame.encoded, "jpeg"
    ok, data = cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    if not ok:
        raise ValueError(f"a picture of shape {frame.image.shape} cannot be encoded")
    return data.tobytes(), "png"


# --- What the 3-D panel draws besides the frames: a vehicle, and the target's two markers ------


Size = tuple[float, float, float]

ARM_M, FLAT_M = (0.092, 0.012, 0.006), (0.03, 0.03, 0.02)
THIN_M = 0.001
_VEHICLE, _BLACK, _WHITE = (0.2, 0.5, 0.9, 1.0), (0.1, 0.1, 0.1, 1.0), (0.95, 0.95, 0.95, 1.0)
_EIGHTH = (0.9238795, 0.3826834)
"""Cosine and sine of an eighth of a turn, halved: the arms lie across the body's axes."""


def scene_message(ns: int, profile: Profile) -> SceneUpdate:
    """Both stay where their frames go, and until the file's end."""
    cos, sin = _EIGHTH
    vehicle = [
        _cube(ARM_M, _VEHICLE, turn=(cos, sin)),
        _cube(ARM_M, _VEHICLE, turn=(cos, -sin)),
        _cube(FLAT_M, _VEHICLE),
    ]
    large_m, small_m = profile.target.large.side_m, profile.target.small.side_m
    target = [  # each sheet a little nearer to the vehicle than the one behind it
        _cube((1.25 * large_m, 1.25 * large_m, THIN_M), _WHITE),
        _cube((large_m, large_m, THIN_M), _BLACK, z_m=-THIN_M),
        _cube((1.5 * small_m, 1.5 * small_m, THIN_M), _WHITE, z_m=-2.0 * THIN_M),
        _cube((small_m, small_m, THIN_M), _BLACK, z_m=-3.0 * THIN_M),
    ]
    return SceneUpdate(
        entities=[_entity(ns, "vehicle", BODY, vehicle), _entity(ns, "target", TARGET, target)]
    )


def _entity(ns: int, name: str, frame: str, cubes: list[CubePrimitive]) -> SceneEntity:
    return SceneEntity(timestamp=stamp(ns), frame_id=frame, id=name, frame_locked=True, cubes=cubes)


def _cube(
    size_m: Size,
    colour: tuple[float, float, float, float],
    *,
    z_m: float = 0.0,
    turn: tuple[float, float] = (1.0, 0.0),
) -> CubePrimitive:
    r, g, b, a = colour
    x, y, z = size_m
    return CubePrimitive(
        pose=Pose(
            position=Vector3(x=0.0, y=0.0, z=z_m),
            orientation=Quaternion(w=turn[0], x=0.0, y=0.0, z=turn[1]),
        ),
        size=Vector3(x=x, y=y, z=z),
        color=Color(r=r, g=g, b=b, a=a),
    )
