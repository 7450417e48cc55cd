"""The vehicle's tables of log variables and parameters, and the ports that serve them."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING

from perchctl.link import Packet, Port

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

MAX_DATA = 30


class Status(IntEnum):
    """What the firmware answers: the numbers of C's errno."""

    OK = 0
    ENOENT = 2
    E2BIG = 7
    ENOEXEC = 8
    ENOMEM = 12
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


_TOC = 0  # channel, on both ports
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


# --- The log port: blocks of variables, sent with their period while they run ------------------
# Limits as measured: 26 bytes a block, period 10 ms x 1..254, 16 blocks, 128 variables
# (docs/firmware.md, "Link").


MAX_BLOCK_BYTES = 26
MAX_BLOCKS = 16
MAX_VARIABLES = 128
PERIOD_UNIT_S = 0.010
_SETTINGS, _DATA = 1, 2
_DELETE, _START, _STOP, _RESET, _CREATE_V2, _APPEND_V2 = range(2, 8)
_ENTRY_BYTES = 3
_EPS_S = 1e-6


@dataclass
class _Block:
    variables: list[tuple[str, Number]] = field(default_factory=list)
    period_s: float = 0.0
    due_s: float | None = None  # None: stopped

    @property
    def size(self) -> int:
        return sum(number.size for _, number in self.variables)


class LogService:
    """Serves the log port of one firmware; `missing` names are left out of the table."""

    def __init__(self, firmware: Firmware, missing: Collection[str] = ()) -> None:
        self._firmware = firmware
        codes = {
            name: BY_CTYPE[ctype].log_code
            for name, ctype in firmware.LOG_VARIABLES.items()
            if name not in missing
        }
        self.toc = Toc(Port.LOG, codes, bytes((MAX_BLOCKS, MAX_VARIABLES)))
        self._blocks: dict[int, _Block] = {}

    def rebooted(self, firmware: Firmware, *, keep_blocks: bool = False) -> None:
        """Time starts again; the blocks are lost unless kept (a test's short cut)."""
        self._firmware = firmware
        if not keep_blocks:
            self._blocks.clear()
        for block in self._blocks.values():
            if block.due_s is not None:
                block.due_s = firmware.t_s + block.period_s

    def handle(self, packet: Packet) -> list[Packet]:
        """The answers to one packet."""
        if packet.channel == _TOC:
            return self.toc.handle(packet)
        if packet.channel != _SETTINGS or not packet.data:
            return []
        command, ident = packet.data[0], packet.data[1] if len(packet.data) > 1 else 0
        status, extra = self._settings(command, ident, packet.data[2:])
        return [Packet(Port.LOG, _SETTINGS, bytes((command, ident, status))), *extra]

    def due(self) -> list[Packet]:
        """Data packets whose time has come."""
        now_s = self._firmware.t_s
        packets = []
        for ident, block in self._blocks.items():
            if block.due_s is not None and block.due_s <= now_s + _EPS_S:
                packets.append(self._data(ident, block))
                block.due_s = max(block.due_s + block.period_s, now_s)
        return packets

    def _settings(self, command: int, ident: int, rest: bytes) -> tuple[Status, list[Packet]]:
        block = self._blocks.get(ident)
        if command == _RESET:
            self._blocks.clear()
            return Status.OK, []
        if command == _CREATE_V2:
            if block is not None:
                return Status.EEXIST, []
            if len(self._blocks) >= MAX_BLOCKS:
                return Status.ENOMEM, []
            self._blocks[ident] = _Block()
            return self._append(self._blocks[ident], rest), []
        if command not in (_APPEND_V2, _DELETE, _START, _STOP):
            return Status.ENOEXEC, []
        if block is None:
            return Status.ENOENT, []
        if command == _APPEND_V2:
            return self._append(block, rest), []
        if command == _START:
            return Status.OK, self._start(ident, block, rest[0] if rest else 0)
        block.due_s = None
        if command == _DELETE:
            del self._blocks[ident]
        return Status.OK, []

    def _append(self, block: _Block, rest: bytes) -> Status:
        """Adds variables until one does not fit; an incomplete last entry is ignored.

        cflib leaves one stray byte at the end of a full packet.
        """
        for at in range(0, len(rest) - _ENTRY_BYTES + 1, _ENTRY_BYTES):
            number = BY_LOG_CODE.get(rest[at] & 0x0F)
            name = self.toc.name(rest[at + 1 : at + _ENTRY_BYTES])
            if name is None or number is None:
                return Status.ENOENT
            if block.size + number.size > MAX_BLOCK_BYTES:
                return Status.E2BIG
            if sum(len(b.variables) for b in self._blocks.values()) >= MAX_VARIABLES:
                return Status.ENOMEM
            block.variables.append((name, number))
        return Status.OK

    def _start(self, ident: int, block: _Block, period: int) -> list[Packet]:
        if period == 0:  # the firmware sends once
            return [self._data(ident, block)]
        block.period_s = period * PERIOD_UNIT_S
        block.due_s = self._firmware.t_s + block.period_s
        return []

    def _data(self, ident: int, block: _Block) -> Packet:
        stamp_ms = round(self._firmware.t_s * 1000.0) & 0xFFFFFF
        head = struct.pack("<I", ident | stamp_ms << 8)
        read = self._firmware.log_value
        body = b"".join(number.pack(read(name)) for name, number in block.variables)
        return Packet(Port.LOG, _DATA, head + body)


# --- The parameter port: table, values, and which of them are persistent -----------------------


_READ, _WRITE = 1, 2
_EXTENDED_TYPE_V2 = 7
_EXTENDED, _READ_ONLY = 0x10, 0x40
_IS_PERSISTENT = 1


class ParamService:
    """Serves the parameter port of one firmware."""

    def __init__(self, firmware: Firmware) -> None:
        self.firmware = firmware
        self._numbers = {name: BY_CTYPE[p.ctype] for name, p in firmware.PARAMETERS.items()}
        codes = {}
        for name, parameter in firmware.PARAMETERS.items():
            code = self._numbers[name].param_code
            assert code is not None, f"{parameter.ctype} is no type of a parameter"
            extended = _EXTENDED if parameter.persistent else 0
            codes[name] = code | extended | (_READ_ONLY if parameter.readonly else 0)
        self.toc = Toc(Port.PARAM, codes)

    def handle(self, packet: Packet) -> list[Packet]:
        """The answers to one packet; a command that is not simulated has none."""
        if packet.channel == _TOC:
            return self.toc.handle(packet)
        if not packet.data:
            return []
        if packet.channel == _READ:
            answer = self._read(packet.data)
        elif packet.channel == _WRITE:
            answer = self._write(packet.data)
        else:
            answer = self._misc(packet.data)
        return [Packet(Port.PARAM, packet.channel, answer)] if answer else []

    def _value(self, name: str) -> bytes:
        return self._numbers[name].pack(self.firmware.get_parameter(name))

    def _read(self, data: bytes) -> bytes:
        name = self.toc.name(data[:2])
        if name is None:
            return data[:2] + bytes((Status.ENOENT,))
        return data[:2] + bytes((Status.OK,)) + self._value(name)

    def _write(self, data: bytes) -> bytes:
        """Answers with the value that is kept; a read-only one is passed over in silence."""
        name = self.toc.name(data[:2])
        if name is None:
            return data[:2] + bytes((Status.ENOENT,))
        if self.firmware.PARAMETERS[name].readonly:
            return b""
        try:
            self.firmware.set_parameter(name, self._numbers[name].unpack(data[2:]))
        except struct.error:
            return b""
        return data[:2] + self._value(name)

    def _misc(self, data: bytes) -> bytes:
        if data[0] != _EXTENDED_TYPE_V2:
            return b""
        name, head = self.toc.name(data[1:3]), data[:3]
        if name is None or not self.firmware.PARAMETERS[name].persistent:
            return head + bytes((Status.ENOENT,))
        return head + bytes((Status.OK, _IS_PERSISTENT))
