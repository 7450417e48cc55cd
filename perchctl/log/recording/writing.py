"""What a recording holds, in the order in which a flight gives it; one thread's."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from perchctl.calibration.files import camera_of
from perchctl.log.jsonl import encode
from perchctl.log.recording import messages as m
from perchctl.log.recording.container import Container, Stream
from perchctl.log.recording.scene import scene_message
from perchctl.log.recording.shapes import LOOP_TIMES
from perchctl.log.recording.times import Epoch, epoch_of
from perchctl.profile import Profile
from perchctl.vision.types import CameraModel, Frame

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
        profile: Profile,
        camera: CameraModel | None = None,
    ) -> None:
        """`camera` is the profile's where it is not given. Errors: NotFound, InvalidValue."""
        self.pictures = 0
        self.newest_s = 0.0
        self._header = header
        self._profile = profile
        self._camera = camera_of(profile.camera) if camera is None else camera
        self._container = Container(stream)
        self._epoch: Epoch | None = None
        self._said = m.Said3d(Epoch(0, 0.0), None)

    @property
    def size_bytes(self) -> int:
        return self._container.size_bytes

    def frame(self, frame: Frame, with_picture: bool = True) -> None:
        """The frame as the source gave it; its picture, where it is a new one."""
        ns = self._at(frame.t_arrival_s)
        number = frame.index & 0xFFFFFFFF
        if with_picture and not frame.repeated:
            data, form = encoded(frame)
            taken_ns = self._epoch_at(frame.t_s).ns(frame.t_s)
            self._container.say(m.IMAGE, ns, m.image_message(taken_ns, data, form), number)
            self.pictures += 1
        told = {
            "number": frame.index,
            "t_s": frame.t_s,
            "t_arrival_s": frame.t_arrival_s,
            "repeated": frame.repeated,
            "crc32": zlib.crc32(np.ascontiguousarray(frame.image).data),
        }
        # With all digits: a replay needs the very time.
        self._container.say_json(m.FRAME, ns, json.dumps(told).encode(), number)

    def tick(self, record: Mapping[str, Any]) -> None:
        ns = self._at(float(record["t_s"]))
        epoch = self._epoch_at(record["t_s"])
        for topic, message in self._said.of(record):
            self._container.say(topic, ns, message)
        times = {
            key: epoch.since_s(record[key]) for key in LOOP_TIMES if record.get(key) is not None
        }
        self._container.say_json(m.TICK, ns, encode({**record, **times})[:-1])

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

    def _at(self, t_s: float) -> int:
        self.newest_s = t_s
        return self._epoch_at(t_s).ns(t_s)

    def _epoch_at(self, t_s: float) -> Epoch:
        """The start's, which is known by the first record at the latest; with it goes what is
        said once."""
        if self._epoch is None:
            self._epoch = epoch = epoch_of(self._header, t_s)
            ns = epoch.ns(t_s)
            self._said = m.Said3d(epoch, m.mounts_of(self._profile))
            self._container.attach(HEADER_NAME, ns, self._header)
            self._container.say(m.CALIBRATION, ns, m.calibration_message(ns, self._camera))
            self._container.say(m.SCENE, ns, scene_message(ns, self._profile))
        return self._epoch


def encoded(frame: Frame) -> tuple[bytes, str]:
    """The picture's bytes and their format: as they came, or without loss."""
    if frame.encoded is not None:
        return frame.encoded, "jpeg"
    ok, data = cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    if not ok:
        raise ValueError(f"a picture of shape {frame.image.shape} cannot be encoded")
    return data.tobytes(), "png"
