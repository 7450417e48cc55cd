"""The Crazyflie's side of the link: packets in, firmware calls, packets out.

This module uses no socket and no clock; `perchctl.sim.host` carries the packets. Everything that an
unmodified cflib sends is answered as described in docs/firmware.md ("Connect sequence"). In the
same document, "Link" describes ports and layouts, and "Signs and units" describes the signs.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from errno import E2BIG, EEXIST, ENOENT, ENOEXEC, ENOMEM
from typing import TYPE_CHECKING, Any

from perchctl.link import Packet, Port
from perchctl.sim.firmware.controller import (
    MODE_HOVER,
    MODE_POSITION,
    MODE_RAW,
    MODE_VELOCITY,
    MODE_Z_DISTANCE,
    Setpoint,
)
from perchctl.sim.firmware.planner import HighLevelPlanner

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

MAX_DATA = 30
PROTOCOL_VERSION = 12
FIRMWARE_VERSION = "2026.08"
OK = 0
"""The answer for success; all other answers are errno codes."""


# --- Packets that command the vehicle, turned into the firmware model's calls ---


_SETPOINTS = {
    7: (MODE_POSITION, ("x_m", "y_m", "z_m", "yaw_deg")),
    8: (MODE_VELOCITY, ("vx_mps", "vy_mps", "vz_mps", "yaw_rate_dps")),
    9: (MODE_Z_DISTANCE, ("roll_deg", "pitch_deg", "yaw_rate_dps", "z_m")),
    10: (MODE_HOVER, ("vx_mps", "vy_mps", "yaw_rate_dps", "z_m")),
}
"""Port 7: the mode and the fields of each setpoint type, as sent by cflib since protocol 11."""


def execute_packet(firmware: Firmware, packet: Packet) -> bytes | None:
    """Make the firmware execute a packet; return the data of its answer, or None if there is no
    answer.

    Raises struct.error for a packet that is too short for its command.
    """
    data = packet.data
    match packet.port, packet.channel, data[0] if data else None:
        case _, _, None:
            return None
        case Port.COMMANDER, 0, _:
            _fly(firmware, _raw(data))
        case Port.COMMANDER_GENERIC, 0, 0:
            _fly(firmware, Setpoint())
        case Port.COMMANDER_GENERIC, 0, 11:  # manual, by angles
            _fly(firmware, _raw(data[1:]))
        case Port.COMMANDER_GENERIC, 0, kind if kind in _SETPOINTS:
            mode, names = _SETPOINTS[kind]
            numbers = struct.unpack_from("<ffff", data, 1)
            _fly(firmware, Setpoint(mode, **dict(zip(names, numbers, strict=True))))
        case Port.COMMANDER_GENERIC, 1, 0:
            firmware.notify_setpoint_stop()
        case Port.HIGH_LEVEL, 0, _:
            return data[:3].ljust(3, b"\0") + bytes((_plan(firmware, data),))
        case Port.LOCALIZATION, 0, _:
            firmware.take_external(struct.unpack_from("<fff", data))
        case Port.LOCALIZATION, 1, 8:
            x, y, z, qx, qy, qz, qw = struct.unpack_from("<fffffff", data, 1)
            firmware.take_external((x, y, z), (qw, qx, qy, qz))
        case ((Port.LOCALIZATION | Port.SUPERVISOR), 1, 3):
            firmware.emergency_stop()
        case ((Port.LOCALIZATION | Port.SUPERVISOR), 1, 4):
            firmware.supervisor.notify_watchdog(firmware.t_s)
        case Port.SUPERVISOR, 0, 0x0C:
            return struct.pack("<BH", 0x8C, firmware.supervisor_info)
        case Port.SUPERVISOR, 1, 1 if len(data) > 1:
            return bytes((0x81, *firmware.supervisor.request_arming(bool(data[1]))))
        case Port.SUPERVISOR, 1, 2:
            return bytes((0x82, *firmware.supervisor.request_recovery()))
        case Port.PLATFORM, 0, 1 if len(data) > 1:
            return bytes((1, *firmware.supervisor.request_arming(bool(data[1]))))
        case Port.PLATFORM, 0, 2:
            return bytes((2, *firmware.supervisor.request_recovery()))
    return None


def _raw(data: bytes) -> Setpoint:
    """The setpoint of a packet on port 3, whose yaw rate is clockwise."""
    roll, pitch, yaw_rate, thrust = struct.unpack_from("<fffH", data)
    return Setpoint(
        MODE_RAW, roll_deg=roll, pitch_deg=pitch, yaw_rate_dps=-yaw_rate, thrust=float(thrust)
    )


def _fly(firmware: Firmware, setpoint: Setpoint) -> None:
    """Pass on finite numbers only: any other number would corrupt the controller permanently."""
    values = (getattr(setpoint, name) for name in Setpoint.__slots__)
    if all(math.isfinite(value) for value in values if isinstance(value, float)):
        firmware.fly_setpoint(setpoint)


def _plan(firmware: Firmware, data: bytes) -> int:
    """Pass on a command of port 8. Trajectories and spirals are not simulated."""
    order: Callable[..., object]
    values: tuple[Any, ...]
    match data[0]:
        case 3:
            order, values = HighLevelPlanner.stop, ()
        case 7 | 8 as kind:
            height, yaw, keep_yaw, duration = struct.unpack_from("<ff?f", data, 2)
            order = HighLevelPlanner.take_off if kind == 7 else HighLevelPlanner.land
            values = (height, duration, None if keep_yaw else yaw)
        case 12:  # data[3] is a flag for straight lines
            values = *struct.unpack_from("<fffff", data, 4), bool(data[2])
            order = HighLevelPlanner.go_to
        case _:
            return ENOEXEC
    is_finite = all(math.isfinite(value) for value in values if value is not None)
    if is_finite and data[1:2] == b"\0":  # for all groups; this vehicle is in no group
        firmware.command_planner(order, *values)
    return OK


# --- C numbers ---


@dataclass(frozen=True)
class CNumber:
    """A C number type: its `struct` letter, and its codes in the two tables."""

    letter: str
    log_code: int
    param_code: int

    @property
    def size(self) -> int:
        return struct.calcsize("<" + self.letter)

    def pack(self, value: float) -> bytes:
        """The bytes as C stores them: integers truncated and wrapped, floats rounded."""
        if self.letter in "ef":
            try:
                return struct.pack("<" + self.letter, value)
            except OverflowError:
                return struct.pack("<" + self.letter, math.copysign(math.inf, value))
        whole = int(value) if math.isfinite(value) else 0
        return (whole & ((1 << 8 * self.size) - 1)).to_bytes(self.size, "little")

    def unpack(self, data: bytes) -> float:
        """The number in `data`. Raises struct.error if the length is not `size`."""
        return float(struct.unpack("<" + self.letter, data)[0])


BY_CTYPE = {
    "uint8_t": CNumber("B", 0x01, 0x08),
    "uint16_t": CNumber("H", 0x02, 0x09),
    "uint32_t": CNumber("I", 0x03, 0x0A),
    "int8_t": CNumber("b", 0x04, 0x00),
    "float": CNumber("f", 0x07, 0x06),
    "FP16": CNumber("e", 0x08, 0x05),
}
BY_LOG_CODE = {number.log_code: number for number in BY_CTYPE.values()}


# --- Tables of contents: the log variables and parameters, by number ---
# cflib caches a table in a file named after its CRC, which depends on the contents alone.


class Toc:
    """A table of contents; `codes` maps a complete name ("group.name") to its type byte."""

    _ITEM, _INFO = 2, 3

    def __init__(self, port: int, codes: Mapping[str, int], info_tail: bytes = b"") -> None:
        self._names = list(codes)
        self._items = []
        for name, code in codes.items():
            item = bytes((code,)) + name.replace(".", "\0").encode() + b"\0"
            assert len(item) + 3 <= MAX_DATA, f"the name {name} does not fit into a packet"
            self._items.append(item)
        crc = zlib.crc32(bytes((port,)) + b"".join(self._items))
        self._info = struct.pack("<BHI", self._INFO, len(codes), crc) + info_tail

    def name(self, ident: bytes) -> str | None:
        """Return the name with the number `ident` (two bytes); None for an unknown number."""
        number = int.from_bytes(ident, "little")
        return self._names[number] if len(ident) == 2 and number < len(self._names) else None

    def answer(self, data: bytes) -> bytes | None:
        """The answer to a request on channel 0, None for an unknown request."""
        if data[0] == self._INFO:
            return self._info
        if data[0] != self._ITEM or len(data) < 3:
            return None
        number = int.from_bytes(data[1:3], "little")
        return data[:3] + self._items[number] if number < len(self._items) else data[:1]


# --- The server ---
# Limits of log blocks as measured: 26 bytes a block, period 10 ms x 1..254, 16 blocks,
# 128 variables (docs/firmware.md, "Link").


MAX_BLOCK_BYTES = 26
MAX_BLOCKS = 16
MAX_VARIABLES = 128
PERIOD_UNIT_S = 0.010
_DELETE, _START, _STOP, _CLEAR, _CREATE_V2, _APPEND_V2 = range(2, 8)
_LOG_DATA = 2  # channel
_ENTRY_BYTES = 3
_LOG_DUE_EPS_S = 1e-6
_EXTENDED, _READ_ONLY = 0x10, 0x40
_EXTENDED_TYPE_V2 = 7
_IS_PERSISTENT = 1
_EEPROM = struct.pack("<BI", 0x00, 8192) + bytes(8)  # type I2C, size, address
_LINK_SOURCE = b"Bitcraze Crazyflie".ljust(MAX_DATA, b"\0")
# commands to the radio chip: reset to the firmware, system on
_RESTARTS = (b"\xfe\xf0\x01", b"\xfe\x03")


@dataclass
class _Block:
    variables: list[tuple[str, CNumber]] = field(default_factory=list)
    period_s: float = 0.0
    due_s: float | None = None  # None: stopped

    @property
    def size(self) -> int:
        return sum(number.size for _, number in self.variables)


class CrtpServer:
    """Serves one firmware to one peer. Before protocol 12, there is no supervisor port.

    `device_type`: the name that the firmware announces instead of its airframe's.
    """

    def __init__(
        self,
        firmware: Firmware,
        protocol_version: int = PROTOCOL_VERSION,
        missing_log_variables: Sequence[str] = (),
        device_type: str | None = None,
    ) -> None:
        self._firmware = firmware
        self._device_type = device_type
        self._version = protocol_version
        self._blocks: dict[int, _Block] = {}
        log_codes = {
            name: BY_CTYPE[variable.ctype].log_code
            for name, variable in firmware.LOG_VARIABLES.items()
            if name not in missing_log_variables
        }
        self._log_toc = Toc(Port.LOG, log_codes, bytes((MAX_BLOCKS, MAX_VARIABLES)))
        parameters = firmware.PARAMETERS.items()
        self._numbers = {name: BY_CTYPE[parameter.ctype] for name, parameter in parameters}
        param_codes = {
            name: self._numbers[name].param_code
            | (_EXTENDED if parameter.persistent else 0)
            | (_READ_ONLY if parameter.readonly else 0)
            for name, parameter in parameters
        }
        self._param_toc = Toc(Port.PARAM, param_codes)

    def handle(self, packet: Packet) -> list[Packet]:
        """Return the answers to one packet, at most one. A packet that is too short for its command
        is ignored, as in the real firmware."""
        try:
            answer = self._answer(packet)
        except struct.error:
            return []
        return [] if answer is None else [Packet(packet.port, packet.channel, answer)]

    def due_packets(self) -> list[Packet]:
        """Return the log data packets that are due now."""
        now_s = self._firmware.t_s
        packets = []
        for ident, block in self._blocks.items():
            if block.due_s is not None and block.due_s <= now_s + _LOG_DUE_EPS_S:
                packets.append(self._data(ident, block))
                block.due_s = max(block.due_s + block.period_s, now_s)
        return packets

    def reboot(self) -> None:
        """Restart the firmware, which loses its log blocks."""
        self._firmware.reboot()
        self._blocks.clear()

    def replace_firmware(self, firmware: Firmware) -> None:
        """Serve another firmware with the same log blocks."""
        self._firmware = firmware
        for block in self._blocks.values():
            if block.due_s is not None:
                block.due_s = firmware.t_s + block.period_s

    def _answer(self, packet: Packet) -> bytes | None:
        data = packet.data
        match packet.port, packet.channel:
            case Port.LINK, 0:
                return data
            case Port.LINK, 1:
                return _LINK_SOURCE
            case Port.LINK, 3:  # the probe packet of a scan, and the radio chip's power commands
                if data.startswith(_RESTARTS):
                    self.reboot()
                return data
            case _ if not data:
                return None
            case Port.LOG, 0:
                return self._log_toc.answer(data)
            case Port.LOG, 1:
                ident = data[1] if len(data) > 1 else 0
                return bytes((data[0], ident, self._set_block(data[0], ident, data[2:])))
            case Port.PARAM, 0:
                return self._param_toc.answer(data)
            case Port.PARAM, 1:
                return self._read(data)
            case Port.PARAM, 2:
                return self._write(data)
            case Port.PARAM, 3 if data[0] == _EXTENDED_TYPE_V2:
                name = self._param_toc.name(data[1:3])
                persistent = name is not None and self._firmware.PARAMETERS[name].persistent
                status = (OK, _IS_PERSISTENT) if persistent else (ENOENT,)
                return data[:3] + bytes(status)
            case Port.MEM, 0:  # a single EEPROM, whose contents no client of this vehicle reads
                if data[0] == 2:
                    return data[:2] + (_EEPROM if data[1:2] == b"\0" else b"")
                return bytes((data[0], 1)) if data[0] < 2 else None
            case Port.PLATFORM, 1 if data[0] < 3:
                version = bytes((self._version,))
                device_type = self._device_type or self._firmware.scenario.airframe.device_type
                names = (FIRMWARE_VERSION.encode() + b"\0", device_type.encode() + b"\0")
                return data[:1] + (version, *names)[data[0]]
            case Port.SUPERVISOR, _ if self._version < PROTOCOL_VERSION:
                return None
            case _:
                return execute_packet(self._firmware, packet)

    # Log blocks ---------------------------------------------------------------------

    def _set_block(self, request: int, ident: int, rest: bytes) -> int:
        block = self._blocks.get(ident)
        if request == _CLEAR:
            self._blocks.clear()
            return OK
        if request == _CREATE_V2:
            if block is not None:
                return EEXIST
            if len(self._blocks) >= MAX_BLOCKS:
                return ENOMEM
            self._blocks[ident] = _Block()
            return self._append(self._blocks[ident], rest)
        if request not in (_APPEND_V2, _DELETE, _START, _STOP):
            return ENOEXEC
        if block is None:
            return ENOENT
        if request == _APPEND_V2:
            return self._append(block, rest)
        block.due_s = None
        if request == _START and rest[:1] > b"\0":
            block.period_s = rest[0] * PERIOD_UNIT_S
            block.due_s = self._firmware.t_s + block.period_s
        elif request == _DELETE:
            del self._blocks[ident]
        return OK

    def _append(self, block: _Block, rest: bytes) -> int:
        """Add variables until one does not fit; an incomplete last entry is ignored.

        cflib leaves one stray byte at the end of a full packet.
        """
        for at in range(0, len(rest) - _ENTRY_BYTES + 1, _ENTRY_BYTES):
            number = BY_LOG_CODE.get(rest[at] & 0x0F)
            name = self._log_toc.name(rest[at + 1 : at + _ENTRY_BYTES])
            if name is None or number is None:
                return ENOENT
            if block.size + number.size > MAX_BLOCK_BYTES:
                return E2BIG
            if sum(len(b.variables) for b in self._blocks.values()) >= MAX_VARIABLES:
                return ENOMEM
            block.variables.append((name, number))
        return OK

    def _data(self, ident: int, block: _Block) -> Packet:
        stamp_ms = round(self._firmware.t_s * 1000.0) & 0xFFFFFF
        read = self._firmware.log_value
        body = b"".join(number.pack(read(name)) for name, number in block.variables)
        return Packet(Port.LOG, _LOG_DATA, struct.pack("<I", ident | stamp_ms << 8) + body)

    # Parameters ---------------------------------------------------------------------

    def _value(self, name: str) -> bytes:
        return self._numbers[name].pack(self._firmware.get_parameter(name))

    def _read(self, data: bytes) -> bytes:
        name = self._param_toc.name(data[:2])
        if name is None:
            return data[:2] + bytes((ENOENT,))
        return data[:2] + bytes((OK,)) + self._value(name)

    def _write(self, data: bytes) -> bytes | None:
        """Answer with the value after the write. Read-only parameters do not change."""
        name = self._param_toc.name(data[:2])
        if name is None:
            return data[:2] + bytes((ENOENT,))
        if self._firmware.PARAMETERS[name].readonly:
            return None
        self._firmware.set_parameter(name, self._numbers[name].unpack(data[2:]))
        return data[:2] + self._value(name)
