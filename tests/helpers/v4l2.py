"""A camera's driver behind the ioctls' own structures, written down here once more by ctypes."""

from __future__ import annotations

import contextlib
import ctypes as c
import errno
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from perchctl.camera.v4l2 import Call

U32, S32 = c.c_uint32, c.c_int32
INACTIVE, READ_ONLY, DISABLED = 0x10, 0x04, 0x01


class Capability(c.Structure):
    _fields_ = (
        ("driver", c.c_char * 16), ("card", c.c_char * 32), ("bus_info", c.c_char * 32),
        ("version", U32), ("capabilities", U32), ("device_caps", U32), ("reserved", U32 * 3),
    )  # fmt: skip


class QueryControl(c.Structure):
    _fields_ = (
        ("id", U32), ("type", U32), ("name", c.c_char * 32), ("minimum", S32), ("maximum", S32),
        ("step", S32), ("default_value", S32), ("flags", U32), ("reserved", U32 * 2),
    )  # fmt: skip


class QueryMenu(c.Structure):
    _pack_ = 1
    _layout_ = "ms"
    _fields_ = (("id", U32), ("index", U32), ("name", c.c_char * 32), ("reserved", U32))


class ControlValue(c.Structure):
    _fields_ = (("id", U32), ("value", S32))


@dataclass
class FakeControl:
    id: int
    name: str
    kind: int  # 1 integer, 2 boolean, 3 menu
    low: int
    high: int
    value: int
    step: int = 1
    menu: dict[int, str] = field(default_factory=dict)
    flags: int = 0


def exposure_controls() -> list[FakeControl]:
    """As a usual USB camera has them: the exposure is held while it is automatic."""
    return [
        FakeControl(0x980900, "Brightness", 1, -64, 64, 0),
        FakeControl(0x98090C, "White Balance, Automatic", 2, 0, 1, 1),
        FakeControl(0x980913, "Gain", 1, 0, 100, 10, step=5),
        FakeControl(
            0x9A0901, "Auto Exposure", 3, 0, 3, 3,
            menu={1: "Manual Mode", 3: "Aperture Priority Mode"},
        ),
        FakeControl(0x9A0902, "Exposure Time, Absolute", 1, 1, 5000, 157, flags=INACTIVE),
    ]  # fmt: skip


@dataclass(eq=False)
class FakeDevice:
    """Answers as a driver does, and gives pictures as cv2.VideoCapture does.

    `resets`: a control, and the value that it falls back to when the first picture is read.
    `stubborn`: controls that take a value and keep their own.
    """

    name: str = "USB Video"
    controls: list[FakeControl] = field(default_factory=exposure_controls)
    pictures_node: bool = True
    format: str = "YUYV"
    size: tuple[int, int] = (640, 480)
    rate_hz: float = 30.0
    resets: dict[str, int] = field(default_factory=dict)
    stubborn: tuple[str, ...] = ()
    log: list[str] = field(default_factory=list)
    released: bool = False
    unplugged: bool = False

    @contextlib.contextmanager
    def opener(self, number: int = 0) -> Iterator[Call]:
        yield self.call

    def control(self, name: str) -> FakeControl:
        return next(each for each in self.controls if each.name == name)

    # --- the driver

    def call(self, request: int, data: bytearray) -> None:
        kind = {
            0: (Capability, self._capability), 27: (ControlValue, self._get),
            28: (ControlValue, self._set), 36: (QueryControl, self._query),
            37: (QueryMenu, self._menu),
        }  # fmt: skip
        structure, answer = kind[request & 0xFF]
        assert (request >> 16) & 0x3FFF == c.sizeof(structure) == len(data), structure
        assert (request >> 8) & 0xFF == ord("V")
        value = structure.from_buffer(data)
        answer(value)

    def _capability(self, out: Any) -> None:
        out.card = self.name.encode()
        out.capabilities, out.device_caps = 0x84A00001, 0x04200001 if self.pictures_node else 0

    def _query(self, out: Any) -> None:
        after = out.id & ~0x80000000
        each = _at([k for k in sorted(self.controls, key=lambda k: k.id) if k.id > after], 0)
        out.id, out.type, out.name = each.id, each.kind, each.name.encode()
        out.minimum, out.maximum, out.step, out.flags = each.low, each.high, each.step, each.flags

    def _menu(self, out: Any) -> None:
        each = next(k for k in self.controls if k.id == out.id)
        if out.index not in each.menu:
            raise OSError(errno.EINVAL, "Invalid argument")
        out.name = each.menu[out.index].encode()

    def _get(self, out: Any) -> None:
        out.value = next(k.value for k in self.controls if k.id == out.id)

    def _set(self, out: Any) -> None:
        each = next(k for k in self.controls if k.id == out.id)
        if each.flags & INACTIVE:
            raise OSError(errno.EACCES, "Permission denied")
        self.log.append(f"{each.name} = {out.value}")
        if each.name not in self.stubborn:
            each.value = out.value
        if each.name == "Auto Exposure":
            self.control("Exposure Time, Absolute").flags = INACTIVE if out.value == 3 else 0

    # --- the capture

    def get(self, prop: int) -> float:
        code = int.from_bytes(self.format.ljust(4).encode(), "little") if self.format else 0
        return {cv2.CAP_PROP_FOURCC: float(code), cv2.CAP_PROP_FPS: self.rate_hz}[prop]

    def read(self) -> tuple[bool, Any]:
        self.log.append("read")
        if self.unplugged:
            return False, None
        for name, value in self.resets.items():
            self.control(name).value = value
        self.resets = {}
        width, height = self.size
        return True, np.random.default_rng(len(self.log)).integers(
            0, 255, (height, width), np.uint8
        )

    def release(self) -> None:
        self.released = True


def _at(values: list[Any], index: int) -> Any:
    if index >= len(values):
        raise OSError(errno.EINVAL, "Invalid argument")
    return values[index]
