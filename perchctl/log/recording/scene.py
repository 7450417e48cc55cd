"""What the 3-D panel draws besides the frames: a vehicle, and the target's two markers."""

from __future__ import annotations

from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CubePrimitive_pb2 import CubePrimitive
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3

from perchctl.log.recording.messages import BODY, TARGET, stamp
from perchctl.profile import Profile

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
