"""CRTP on the wire: what the firmware answers, and its number types."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntEnum

from perchctl.link import Packet as Packet
from perchctl.link import Port as Port

MAX_DATA = 30


class Status(IntEnum):
    """What the firmware answers: the numbers of C's errno."""

    OK = 0
    ENOENT = 2
    E2BIG = 7
    ENOEXEC = 8
    ENOMEM = 12
    EACCES = 13
    EEXIST = 17


@dataclass(frozen=True)
class Number:
    """A C number type: its codes in the two tables and its `struct` letter."""

    ctype: str
    letter: str
    log_code: int | None
    param_code: int | None

    @property
    def size(self) -> int:
        return struct.calcsize("<" + self.letter)

    def pack(self, value: float) -> bytes:
        """As C stores it: integers truncated and wrapped, floats rounded."""
        if self.letter in "efd":
            return _pack_float(self.letter, value)
        bits = 8 * self.size
        whole = int(value) & ((1 << bits) - 1) if math.isfinite(value) else 0
        return whole.to_bytes(self.size, "little")

    def unpack(self, data: bytes) -> float:
        """Raises struct.error when `data` has another length."""
        return float(struct.unpack("<" + self.letter, data)[0])


def _pack_float(letter: str, value: float) -> bytes:
    try:
        return struct.pack("<" + letter, value)
    except OverflowError:
        return struct.pack("<" + letter, math.copysign(math.inf, value))


_NUMBERS = (
    Number("uint8_t", "B", 0x01, 0x08),
    Number("uint16_t", "H", 0x02, 0x09),
    Number("uint32_t", "I", 0x03, 0x0A),
    Number("int8_t", "b", 0x04, 0x00),
    Number("int16_t", "h", 0x05, 0x01),
    Number("int32_t", "i", 0x06, 0x02),
    Number("float", "f", 0x07, 0x06),
    Number("FP16", "e", 0x08, None),
)
BY_CTYPE = {number.ctype: number for number in _NUMBERS}
BY_LOG_CODE = {n.log_code: n for n in _NUMBERS if n.log_code is not None}
BY_PARAM_CODE = {n.param_code: n for n in _NUMBERS if n.param_code is not None}
