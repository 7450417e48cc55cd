"""What a recording holds, in the order in which a flight gives it; one thread's."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from perchctl.log.jsonl import encode
from perchctl.log.recording import messages as m
from perchctl.log.recording.container import Container, Stream
from perchctl.log.recording.scene import scene_message
from perchctl.log.recording.shapes import LOOP_TIMES
from perchctl.log.recording.times import Epoch, epoch_of
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
