"""What a camera's driver says of itself and is told, by V4L2's ioctls (Linux).

OpenCV delivers the pictures, and knows neither a camera's name nor a control by the name that the
driver has for it. Everything here goes through one function, `Call`, that answers a request in the
caller's bytes as the kernel does: a stand-in for a device is one more such function.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

Call = Callable[[int, bytearray], None]
"""One ioctl: number and the structure, which holds the answer afterwards. Errors: OSError."""
Opener = Callable[[int], contextlib.AbstractContextManager[Call]]
"""The driver of camera N for a while. Errors: OSError."""

_MOST = 256  # of whatever a driver lists: no listing goes on for ever
_CAPTURE = 1  # V4L2_CAP_VIDEO_CAPTURE
_HAS_DEVICE_CAPS = 0x80000000
_NEXT_CONTROL = 0x80000000
_DISABLED, _READ_ONLY, _INACTIVE, _WRITE_ONLY = 0x01, 0x04, 0x10, 0x40
_MENU, _INTEGER_MENU = 3, 9
_VALUED = {1: "integer", 2: "boolean", _MENU: "menu", 8: "bitmask", _INTEGER_MENU: "menu"}


def _ioctl(number: int, size: int, writes: bool = True) -> int:
    """_IOR or _IOWR of videodev2.h."""
    return ((3 if writes else 2) << 30) | (size << 16) | (ord("V") << 8) | number


QUERYCAP = _ioctl(0, 104, writes=False)
G_CTRL = _ioctl(27, 8)
S_CTRL = _ioctl(28, 8)
QUERYCTRL = _ioctl(36, 68)
QUERYMENU = _ioctl(37, 44)


@dataclass(frozen=True)
class CameraControl:
    """`name` as V4L2's own tools write it; `menu` holds the entries of one that has such."""

    id: int
    name: str
    kind: str
    low: int
    high: int
    step: int
    default: int
    flags: int
    menu: tuple[tuple[int, str], ...] = ()

    @property
    def inactive(self) -> bool:
        """Another control, as an automatic one, has it now."""
        return bool(self.flags & _INACTIVE)

    @property
    def settable(self) -> bool:
        return not self.flags & _READ_ONLY

    @property
    def allowed(self) -> str:
        """The values that it takes, in words."""
        if self.menu:
            return ", ".join(f"{index} ({text})" for index, text in self.menu)
        if self.kind == "boolean":
            return "0 (off) or 1 (on)"
        steps = f" in steps of {self.step}" if self.step > 1 else ""
        return f"{self.low} to {self.high}{steps}"


@contextlib.contextmanager
def open_driver(number: int) -> Iterator[Call]:
    """Asks /dev/videoN, also while another descriptor streams. Errors: OSError, also on
    systems without V4L2."""
    if not sys.platform.startswith("linux"):
        raise OSError(errno.ENOSYS, "this system has no V4L2")
    import fcntl

    fd = os.open(f"/dev/video{number}", os.O_RDWR | os.O_NONBLOCK)

    def call(request: int, data: bytearray) -> None:
        fcntl.ioctl(fd, request, data, True)

    try:
        yield call
    finally:
        os.close(fd)


def card_of(call: Call) -> tuple[str, bool]:
    """The camera's name, and whether this node gives pictures: a camera has others beside it.
    Errors: OSError."""
    data = bytearray(104)
    call(QUERYCAP, data)
    _, card, _, _, whole, device = struct.unpack_from("=16s32s32sIII", data)
    return _text(card), bool((device if whole & _HAS_DEVICE_CAPS else whole) & _CAPTURE)


def controls_of(call: Call) -> dict[str, CameraControl]:
    """By name, in the driver's order: those that have one value."""
    found: dict[str, CameraControl] = {}
    last = 0
    for _ in range(_MOST):
        data = bytearray(68)
        struct.pack_into("=I", data, 0, last | _NEXT_CONTROL)
        try:
            call(QUERYCTRL, data)
        except OSError:
            break
        number, kind, name, low, high, step, default, flags = struct.unpack_from(
            "=II32siiiiI", data
        )
        if number <= last:
            break  # a driver that does not go on
        last = number
        if kind in _VALUED and not flags & (_DISABLED | _WRITE_ONLY):
            control = CameraControl(
                number, control_name(_text(name)), _VALUED[kind], low, high, step, default, flags,
                _menu(call, number, low, high, kind) if kind in (_MENU, _INTEGER_MENU) else (),
            )  # fmt: skip
            found.setdefault(control.name, control)
    return found


def _menu(call: Call, control: int, low: int, high: int, kind: int) -> tuple[tuple[int, str], ...]:
    entries = []
    for index in range(max(low, 0), min(high, low + _MOST) + 1):
        data = bytearray(44)
        struct.pack_into("=II", data, 0, control, index)
        with contextlib.suppress(OSError):  # an entry that this camera lacks
            call(QUERYMENU, data)
            text = _text(struct.unpack_from("=32s", data, 8)[0])
            number = struct.unpack_from("=q", data, 8)[0]
            entries.append((index, str(number) if kind == _INTEGER_MENU else text))
    return tuple(entries)


def value_of(call: Call, control: CameraControl) -> int:
    """Errors: OSError."""
    data = bytearray(struct.pack("=Ii", control.id, 0))
    call(G_CTRL, data)
    return int(struct.unpack("=Ii", data)[1])


def set_value(call: Call, control: CameraControl, value: int) -> None:
    """Errors: OSError."""
    call(S_CTRL, bytearray(struct.pack("=Ii", control.id, value)))


def control_name(text: str) -> str:
    """``Exposure Time, Absolute`` is ``exposure_time_absolute``."""
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def _text(raw: Any) -> str:
    return bytes(raw).split(b"\0", 1)[0].decode("utf-8", "replace").strip()
