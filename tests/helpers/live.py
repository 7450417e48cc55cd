"""What tests of live sources share: a clock that stands, and waits with a bound."""

from __future__ import annotations

import struct
from typing import TypeVar

import cv2
import numpy as np

from perchctl.camera.source import LiveSource
from perchctl.vision import Frame
from tests.helpers.waiting import until

WAIT_S = 10.0  # bound of every wait; reached only when a test fails


S = TypeVar("S", bound=LiveSource)


class Clock:
    def __init__(self) -> None:
        self.t_s = 100.0

    def __call__(self) -> float:
        return self.t_s


def begun(source: S, opened: list[LiveSource] | None = None, **timing: float) -> S:
    """The source connecting, with other times than its own."""
    for name, seconds in timing.items():
        assert hasattr(source, name)
        setattr(source, name, seconds)
    source.begin()
    if opened is not None:
        opened.append(source)
    return source


def next_frame(source: LiveSource) -> Frame:
    frame: Frame = until(lambda: source.poll(0.0))
    return frame


def level(frame: Frame) -> int:
    """Of a picture of one grey, to the nearest 20."""
    return 20 * round(float(frame.image.mean()) / 20.0)


def jpeg(level: int, size: tuple[int, ...] = (48, 64), **options: int) -> bytes:
    rng = np.random.default_rng(level)
    image = np.clip(rng.normal(level, 4.0, size), 0, 255).astype(np.uint8)
    flags = [x for pair in options.items() for x in (getattr(cv2, pair[0]), pair[1])]
    return bytes(cv2.imencode(".jpg", image, flags)[1].tobytes())


def resized(picture: bytes, width: int, height: int) -> bytes:
    """The JPEG with another size in its header."""
    at = max(picture.find(b"\xff\xc0"), picture.find(b"\xff\xc2"))
    return picture[: at + 5] + struct.pack(">HH", height, width) + picture[at + 9 :]


def part(picture: bytes, headers: bytes = b"Content-Type: image/jpeg\r\n") -> bytes:
    return b"--frame\r\n" + headers + b"\r\n" + picture + b"\r\n"
