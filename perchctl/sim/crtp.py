"""A Crazyflie's end of the link: packets in, firmware calls, packets out.

Uses no socket and no clock; `perchctl.sim.host` carries the packets. Everything an
unmodified cflib sends is answered as in docs/firmware.md, "Connect sequence"; ports and layouts
are those of "Link" there, signs those of "Signs and units".
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING

from perchctl.link import Packet, Port
from perchctl.sim.firmware.controller import Setpoint
from perchctl.sim.firmware.planner import HighLevelCommand, HlGoTo, HlLand, HlStop, HlTakeoff

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

MAX_DATA = 30
PROTOCOL_VERSION = 12
FIRMWARE_VERSION = "2026.08"
DEVICE_TYPE = "C21B"
_ECHO, _SOURCE, _SINK, _NULL = 0, 1, 2, 3
_BOOTLOADER = 0xFE
_SYSTEM_ON, _RESET = 0x03, 0xF0
_COMMAND, _VERSION = 0, 1
_ARM, _RECOVER = 1, 2
_GET_PROTOCOL, _GET_FIRMWARE, _GET_DEVICE = 0, 1, 2
_LINK_SOURCE = b"Bitcraze Crazyflie".ljust(MAX_DATA, b"\0")


@dataclass(frozen=True)
class LinkOptions:
    """How the link of a simulated vehicle differs from a good one.

    Attributes:
        protocol_version: below 12 the supervisor port is missing (an old firmware).
        missing_log_variables: left out of the log table.
    """

    protocol_version: int = PROTOCOL_VERSION
    missing_log_variables: tuple[str, ...] = ()


class CrtpServer:
    """Serves one firmware to one peer at a time."""

    def __init__(self, firmware: Firmware, options: LinkOptions | None = None) -> None:
        options = options or LinkOptions()
        version = options.protocol_version
        self._firmware = firmware
        self._version = version
        self._log = LogService(firmware, options.missing_log_variables)
        self._param = ParamService(firmware)
        self._commands = CommandService(firmware, version)

    def handle(self, packet: Packet) -> list[Packet]:
        """Return the answers to one packet, in order."""
        match packet.port:
            case Port.LINK:
                return self._link(packet)
            case Port.LOG:
                return self._log.handle(packet)
            case Port.PARAM:
                return self._param.handle(packet)
            case Port.MEM:
                return _memories(packet)
            case Port.PLATFORM:
                return self._platform(packet)
            case _:
                return self._commands.handle(packet)

    def due(self) -> list[Packet]:
        """Return the log data that the vehicle sends by itself by now."""
        return self._log.due()

    def reboot(self) -> None:
        """Start the firmware again; log blocks are lost."""
        self._firmware.reboot()
        self._restarted(keep_blocks=False)

    def replace_firmware(self, firmware: Firmware, *, keep_blocks: bool) -> None:
        """Serve another firmware from now on (a test's short cut for a new vehicle)."""
        self._firmware = firmware
        self._restarted(keep_blocks=keep_blocks)

    def _restarted(self, *, keep_blocks: bool) -> None:
        self._log.rebooted(self._firmware, keep_blocks=keep_blocks)
        self._param.firmware = self._firmware
        self._commands.firmware = self._firmware

    def _link(self, packet: Packet) -> list[Packet]:
        if packet.channel == _ECHO:
            return [packet]
        if packet.channel == _SOURCE:
            return [Packet(Port.LINK, _SOURCE, _LINK_SOURCE)]
        if packet.channel == _SINK:
            return []
        # Null packets: a scan's probe, and the power commands of the radio chip.
        if packet.data[:1] == bytes((_BOOTLOADER,)):
            restart = packet.data[1:] == bytes((_RESET, 1)) or packet.data[1:2] == bytes(
                (_SYSTEM_ON,)
            )
            if restart:
                self.reboot()
        return [Packet(Port.LINK, _NULL, packet.data)]

    def _platform(self, packet: Packet) -> list[Packet]:
        if not packet.data:
            return []
        command = packet.data[0]
        answer: bytes | None = None
        if packet.channel == _VERSION:
            if command == _GET_PROTOCOL:
                answer = bytes((self._version,))
            elif command == _GET_FIRMWARE:
                answer = FIRMWARE_VERSION.encode() + b"\0"
            elif command == _GET_DEVICE:
                answer = DEVICE_TYPE.encode() + b"\0"
        elif packet.channel == _COMMAND:
            if command == _ARM and len(packet.data) > 1:
                answer = self._commands.arm(bool(packet.data[1]))
            elif command == _RECOVER:
                answer = self._commands.recover()
        if answer is None:
            return []
        return [Packet(Port.PLATFORM, packet.channel, bytes((command,)) + answer)]


# --- The memory port: one EEPROM, whose contents no client of this vehicle reads ---------------


_MEM_INFO = 0
_MEM_VERSION, _MEM_COUNT, _MEM_DETAILS = 0, 1, 2
_I2C, _EEPROM_BYTES = 0x00, 8192


def _memories(packet: Packet) -> list[Packet]:
    data = packet.data
    if packet.channel != _MEM_INFO or not data:
        return []
    if data[0] in (_MEM_VERSION, _MEM_COUNT):
        answer = bytes((data[0], 1))
    elif data[0] == _MEM_DETAILS:
        details = struct.pack("<BI", _I2C, _EEPROM_BYTES) + bytes(8)
        answer = data[:2] + (details if data[1:2] == b"\0" else b"")
    else:
        return []
    return [Packet(Port.MEM, _MEM_INFO, answer)]


# --- Packets that command the vehicle, turned into the firmware model's calls ------------------


# Port 8.
HL_STOP, HL_TAKEOFF_2, HL_LAND_2, HL_GO_TO_2 = 3, 7, 8, 12
# Port 9.
GET_STATE, ARM, RECOVER, EMERGENCY_STOP, WATCHDOG = 0x0C, 0x01, 0x02, 0x03, 0x04
REPLY = 0x80
# Port 6, channel 1.
_LOC_EMERGENCY_STOP, _LOC_WATCHDOG, _LOC_POSE = 3, 4, 8
_NOTIFY_STOP = 0


def _raw(data: bytes) -> Setpoint:
    """Return the setpoint of a packet on port 3 (``<fffH``); cflib negates the pitch on its way
    out."""
    roll, pitch, yaw_rate, thrust = struct.unpack_from("<fffH", data)
    return Setpoint.raw(roll, -pitch, yaw_rate, thrust)


_GENERIC: dict[int, Callable[[bytes], Setpoint]] = {
    0: lambda data: Setpoint(),
    7: lambda data: Setpoint.position(*struct.unpack_from("<ffff", data)),
    8: lambda data: Setpoint.velocity(*struct.unpack_from("<ffff", data)),
    9: lambda data: Setpoint.z_distance(*struct.unpack_from("<ffff", data)),
    10: lambda data: Setpoint.hover(*struct.unpack_from("<ffff", data)),
    11: _raw,  # manual, by angles
}
"""Port 7: setpoints by their type, as cflib sends them since protocol 11."""


class CommandService:
    """Serve the ports that command."""

    def __init__(self, firmware: Firmware, protocol_version: int = PROTOCOL_VERSION) -> None:
        self.firmware = firmware
        self._has_supervisor_port = protocol_version >= 12
        self._handlers: dict[int, Callable[[Packet], list[Packet]]] = {
            Port.COMMANDER: self._commander,
            Port.COMMANDER_GENERIC: self._generic,
            Port.HIGH_LEVEL: self._high_level,
            Port.LOCALIZATION: self._localization,
            Port.SUPERVISOR: self._supervisor,
        }

    def handle(self, packet: Packet) -> list[Packet]:
        """Return the answers to one packet. What is too short for its command is passed over, as
        the firmware does."""
        handler = self._handlers.get(packet.port)
        if handler is None or not packet.data:
            return []
        try:
            return handler(packet)
        except struct.error:
            return []

    def arm(self, do_arm: bool) -> bytes:
        """Return (success, armed) as bytes, shared with the platform port."""
        return bytes(self.firmware.arm(do_arm))

    def recover(self) -> bytes:
        """Return (success, recovered) as bytes, shared with the platform port."""
        return bytes(self.firmware.recover_from_crash())

    def _commander(self, packet: Packet) -> list[Packet]:
        if packet.channel == 0:
            self._low_level(_raw(packet.data))
        return []

    def _generic(self, packet: Packet) -> list[Packet]:
        data = packet.data
        if packet.channel == 0 and data[0] in _GENERIC:
            self._low_level(_GENERIC[data[0]](data[1:]))
        elif packet.channel == 1 and data[0] == _NOTIFY_STOP:
            self.firmware.notify_setpoint_stop()
        return []

    def _low_level(self, setpoint: Setpoint) -> None:
        values = (getattr(setpoint, name) for name in Setpoint.__slots__)
        if _all_finite(value for value in values if isinstance(value, float)):
            self.firmware.low_level(setpoint)

    def _high_level(self, packet: Packet) -> list[Packet]:
        data, status = packet.data, Status.OK
        command = _high_level(data)
        if command is None:
            status = Status.ENOEXEC
        elif data[1] == 0:  # for all groups; this vehicle is in none
            values = vars(command).values()
            if _all_finite(value for value in values if value is not None):
                self.firmware.high_level(command)
        return [Packet(Port.HIGH_LEVEL, 0, data[:3].ljust(3, b"\0") + bytes((status,)))]

    def _localization(self, packet: Packet) -> list[Packet]:
        data = packet.data
        if packet.channel == 0:
            self.firmware.external_position(struct.unpack_from("<fff", data))
        elif packet.channel == 1 and data[0] == _LOC_EMERGENCY_STOP:
            self.firmware.emergency_stop()
        elif packet.channel == 1 and data[0] == _LOC_WATCHDOG:
            self.firmware.emergency_stop_watchdog()
        elif packet.channel == 1 and data[0] == _LOC_POSE:
            x, y, z, *quaternion = struct.unpack_from("<fffffff", data, 1)
            qx, qy, qz, qw = quaternion
            self.firmware.external_pose((x, y, z), (qx, qy, qz, qw))
        return []

    def _supervisor(self, packet: Packet) -> list[Packet]:
        if not self._has_supervisor_port:
            return []
        command = packet.data[0]
        answer: bytes | None = None
        if packet.channel == 0 and command == GET_STATE:
            answer = struct.pack("<H", self.firmware.supervisor_info)
        elif packet.channel == 1 and command == ARM and len(packet.data) > 1:
            answer = self.arm(bool(packet.data[1]))
        elif packet.channel == 1 and command == RECOVER:
            answer = self.recover()
        elif packet.channel == 1 and command == EMERGENCY_STOP:
            self.firmware.emergency_stop()
        elif packet.channel == 1 and command == WATCHDOG:
            self.firmware.emergency_stop_watchdog()
        if answer is None:
            return []
        return [Packet(Port.SUPERVISOR, packet.channel, bytes((REPLY | command,)) + answer)]


def _high_level(data: bytes) -> HighLevelCommand | None:
    """Return the command of a packet on port 8; None for one that this vehicle does not have
    (trajectories, spirals)."""
    command = data[0]
    if command == HL_STOP:
        return HlStop()
    if command in (HL_TAKEOFF_2, HL_LAND_2):
        height, yaw, keep_yaw, duration = struct.unpack_from("<ff?f", data, 2)
        kind = HlTakeoff if command == HL_TAKEOFF_2 else HlLand
        return kind(height, duration, None if keep_yaw else yaw)
    if command == HL_GO_TO_2:  # data[3] is a flag for straight lines
        x, y, z, yaw, duration = struct.unpack_from("<fffff", data, 4)
        return HlGoTo(x, y, z, yaw, duration, bool(data[2]))
    return None


def _all_finite(values: Iterable[float]) -> bool:
    """Return whether all values are finite. Others would poison the controller for good."""
    return all(map(math.isfinite, values))


# --- C numbers, and the status codes of answers ---------------------------------------------------


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
        """Return the bytes as C stores the value: integers truncated and wrapped, floats
        rounded."""
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
        """Return the name that has this number, two bytes; None where no name has it."""
        number = int.from_bytes(ident, "little")
        return self._names[number] if len(ident) == 2 and number < len(self._names) else None

    def handle(self, packet: Packet) -> list[Packet]:
        """Return the reply to a request on channel 0."""
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
_DELETE, _START, _STOP, _CLEAR, _CREATE_V2, _APPEND_V2 = range(2, 8)
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
        """Begin at time 0 again. The blocks are lost unless kept (a test's short cut)."""
        self._firmware = firmware
        if not keep_blocks:
            self._blocks.clear()
        for block in self._blocks.values():
            if block.due_s is not None:
                block.due_s = firmware.t_s + block.period_s

    def handle(self, packet: Packet) -> list[Packet]:
        """Return the answers to one packet."""
        if packet.channel == _TOC:
            return self.toc.handle(packet)
        if packet.channel != _SETTINGS or not packet.data:
            return []
        command, ident = packet.data[0], packet.data[1] if len(packet.data) > 1 else 0
        status, extra = self._settings(command, ident, packet.data[2:])
        return [Packet(Port.LOG, _SETTINGS, bytes((command, ident, status))), *extra]

    def due(self) -> list[Packet]:
        """Return the data packets whose time has come."""
        now_s = self._firmware.t_s
        packets = []
        for ident, block in self._blocks.items():
            if block.due_s is not None and block.due_s <= now_s + _EPS_S:
                packets.append(self._data(ident, block))
                block.due_s = max(block.due_s + block.period_s, now_s)
        return packets

    def _settings(self, command: int, ident: int, rest: bytes) -> tuple[Status, list[Packet]]:
        block = self._blocks.get(ident)
        if command == _CLEAR:
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
        """Add variables until one does not fit; an incomplete last entry is ignored.

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
        """Return the answers to one packet; a command that is not simulated has none."""
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
