"""The bytes of NatNet 3.1, in which OptiTrack's server speaks: what a client asks and is told.

Little-endian; each message begins with its kind and the length of what follows. Of a frame only
the rigid bodies are filled in; a client steps over the empty lists.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

from perchctl.positioning import BodyPose, CaptureFrame

CONNECT, SERVER_INFO, ASK_MODELS, MODELS, FRAME = 0, 1, 4, 5, 7
COMMAND_PORT = 1510
_VERSION = bytes((3, 1, 0, 0))
_NAME_BYTES = 256
_TICKS_HZ = 1_000_000
_RIGID_BODY = 1
_TRACKED = 1
_NO_PARENT = -1
_EMPTY = struct.pack("<i", 0)
_UNSEEN = BodyPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


def message(kind: int, body: bytes) -> bytes:
    return struct.pack("<HH", kind, len(body)) + body


def kind_of(request: bytes) -> int | None:
    """None for what is too short to be one."""
    return int.from_bytes(request[:2], "little") if len(request) >= 4 else None


def server_info(data_port: int) -> bytes:
    """The answer to `CONNECT`: frames will come to that port of the client's, by unicast."""
    name = b"perchctl".ljust(_NAME_BYTES, b"\0")
    where = struct.pack("<QH?4B", _TICKS_HZ, data_port, False, 0, 0, 0, 0)
    return message(SERVER_INFO, name + _VERSION + _VERSION + where)


def models(names: Sequence[str]) -> bytes:
    """The answer to `ASK_MODELS`: rigid bodies, numbered from 1, their origins unmoved."""
    body = struct.pack("<i", len(names))
    for number, name in enumerate(names, 1):
        body += struct.pack("<i", _RIGID_BODY) + name.encode() + b"\0"
        body += struct.pack("<ii3f", number, _NO_PARENT, 0.0, 0.0, 0.0) + _EMPTY  # no markers
    return message(MODELS, body)


def frame(number: int, names: Sequence[str], seen: CaptureFrame) -> bytes:
    """One frame; a body that is not in it is marked as not tracked."""
    parts = [struct.pack("<i", number), _EMPTY, _EMPTY]  # marker sets, other markers
    parts.append(struct.pack("<i", len(names)))
    for index, name in enumerate(names, 1):
        pose = seen.bodies.get(name)
        w, x, y, z = (pose or _UNSEEN).quaternion
        place = (pose or _UNSEEN).position_m
        tracked = 0 if pose is None else _TRACKED
        parts.append(struct.pack("<i3f4ffh", index, *place, x, y, z, w, 0.0, tracked))
    parts += [_EMPTY] * 4  # skeletons, labelled markers, force plates, devices
    ticks = round(seen.t_s * _TICKS_HZ)
    parts.append(struct.pack("<IId3Qh", 0, 0, seen.t_s, ticks, ticks, ticks, 0) + _EMPTY)
    return message(FRAME, b"".join(parts))
