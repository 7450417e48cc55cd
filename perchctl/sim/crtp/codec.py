"""CRTP on the wire: what the firmware answers, its number types, and its tables of contents."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
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
        """The bytes as C stores the value: integers truncated and wrapped, floats rounded."""
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


# --- Tables of contents: which log variables and parameters there are, by number ---------------
# cflib keeps a table in a file named after its CRC, so the CRC follows from the contents and
# nothing else: the same table has the same CRC in every process.


_ITEM, _INFO = 2, 3


class Toc:
    """One table. `codes` maps a complete name ("group.name") to its type byte."""

    def __init__(self, port: int, codes: Mapping[str, int | None], info_tail: bytes = b"") -> None:
        self._port = port
        self._names = list(codes)
        self._items = [_item(name, code) for name, code in codes.items()]
        crc = zlib.crc32(bytes((port,)) + b"".join(self._items))
        self._info = struct.pack("<BHI", _INFO, len(codes), crc) + info_tail

    def name(self, ident: bytes) -> str | None:
        """The name that has this number, two bytes; None where no name has it."""
        number = int.from_bytes(ident, "little")
        return self._names[number] if len(ident) == 2 and number < len(self._names) else None

    def handle(self, packet: Packet) -> list[Packet]:
        """The reply to a request on channel 0."""
        data = packet.data
        if data[:1] == bytes((_INFO,)):
            return [Packet(self._port, 0, self._info)]
        if data[:1] != bytes((_ITEM,)) or len(data) < 3:
            return []
        number = int.from_bytes(data[1:3], "little")
        found = number < len(self._items)
        return [Packet(self._port, 0, data[:3] + self._items[number] if found else data[:1])]


def _item(name: str, code: int | None) -> bytes:
    assert code is not None, f"{name} has a type that its table does not know"
    group, _, short = name.partition(".")
    item = bytes((code,)) + group.encode() + b"\0" + short.encode() + b"\0"
    assert len(item) + 3 <= MAX_DATA, f"the name {name} does not fit into a packet"
    return item
