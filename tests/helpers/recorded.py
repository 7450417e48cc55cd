"""A made-up flight with pictures for the tests of the recording."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from perchctl.geometry import Array, make_T, rotation_from_quaternion
from perchctl.profile import Profile
from perchctl.record.recorder import Recorder
from perchctl.vision import Frame
from tests.helpers import log as synthetic

SIZE_PX = (64, 48)
LATENCY_S = 0.075
PROFILE = Profile(name="sim")


def picture(number: int) -> np.ndarray[Any, Any]:
    """Noise, another for each number."""
    width, height = SIZE_PX
    return np.random.default_rng(number).integers(0, 256, (height, width), np.uint8)


def frame(number: int, t_s: float, as_jpeg: bool) -> Frame:
    image = picture(number)
    if not as_jpeg:
        return Frame(number, t_s, image, t_s + LATENCY_S)
    data = cv2.imencode(".jpg", cv2.GaussianBlur(image, (0, 0), 3.0))[1]
    decoded = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
    return Frame(number, t_s, decoded, t_s + LATENCY_S, source_jpeg=data.tobytes())


def frames(count: int) -> list[Frame]:
    """JPEG and plain by turns, at times with all digits."""
    return [frame(n, 1.1 + n * 0.0333333333333, n % 2 == 0) for n in range(count)]


@dataclass(frozen=True)
class Flown:
    """What was handed to a recorder."""

    frames: list[Frame]
    ticks: list[dict[str, Any]]


def flown(count: int = 20) -> Flown:
    return Flown(frames(count), list(synthetic.ticks())[: 2 * count])


def fly(recorder: Recorder, flight: Flown) -> None:
    """A frame in every other turn."""
    for n, tick in enumerate(flight.ticks):
        if n % 2 == 0 and n // 2 < len(flight.frames):
            recorder.write_frame(flight.frames[n // 2])
        recorder.write_tick(tick)


def recorder(path: Path, live: bool = False, **changes: Any) -> Recorder:
    return Recorder.open(path, synthetic.header(**changes), PROFILE, live)


def messages(path: Path) -> dict[str, list[Any]]:
    """By topic, decoded by the schemas that are in the file; checksums are checked."""
    found: dict[str, list[Any]] = {}
    factory = DecoderFactory()
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            decode = factory.decoder_for(channel.message_encoding, schema)
            data = message.data if decode is None else decode(message.data)
            found.setdefault(channel.topic, []).append(data)
    return found


def transforms(message: Any) -> dict[str, Array]:
    """The transforms of a message of `/tf`, by ``parent child``."""
    found = {}
    for each in message.transforms:
        q, t = each.rotation, each.translation
        R = rotation_from_quaternion((q.w, q.x, q.y, q.z))
        found[f"{each.parent_frame_id} {each.child_frame_id}"] = make_T(R, (t.x, t.y, t.z))
    return found


class MemoryDisk:
    """A stream that can be full, or hang while `gate` is closed."""

    def __init__(self, room: int | None = None, free: int = 10**12) -> None:
        self.data = bytearray()
        self.room = room
        self.free = free
        self.closed = False
        self.gate = threading.Event()
        self.gate.set()

    def write(self, data: bytes) -> int:
        self.gate.wait(20.0)
        if self.room is not None and len(self.data) + len(data) > self.room:
            raise OSError(28, "No space left on device")
        self.data += data
        return len(data)

    def tell(self) -> int:
        return len(self.data)

    def flush(self) -> None:
        self.gate.wait(20.0)

    def free_bytes(self) -> int:
        return self.free

    def close(self) -> None:
        self.closed = True
