"""A Crazyflie's end of the link: packets in, firmware calls, packets out.

Uses no socket and no clock; `perchctl.sim.process.host` carries the packets. Everything
an unmodified cflib sends is answered as in docs/firmware.md, "Connect sequence".
"""

from __future__ import annotations

import struct
import zlib
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from perchctl.errors import InvalidValue
from perchctl.sim.crtp.codec import MAX_DATA, Packet, Port, Status
from perchctl.sim.crtp.commands import CommandService
from perchctl.sim.crtp.log import LogService
from perchctl.sim.crtp.param import ParamService
from perchctl.vehicle import CAN_FLY, CRASHED, LOCKED

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

PROTOCOL_VERSION = 12
OLDEST_PROTOCOL_VERSION = 11
FIRMWARE_VERSION = "2026.08"
DEVICE_TYPE = "C21B"
_ECHO, _SOURCE, _SINK, _NULL = 0, 1, 2, 3
_BOOTLOADER = 0xFE
_SYSTEM_ON, _RESET = 0x03, 0xF0
_COMMAND, _VERSION = 0, 1
_CONTINUOUS_WAVE, _ARM, _RECOVER, _NOTIFICATION = 0, 1, 2, 3
_GET_PROTOCOL, _GET_FIRMWARE, _GET_DEVICE = 0, 1, 2
_LINK_SOURCE = b"Bitcraze Crazyflie".ljust(MAX_DATA, b"\0")
_BOOT_TEXT = (
    "SYS: ----------------------------\n"
    "SYS: Crazyflie 2.1 is up and running!\n"
    f"SYS: Build {FIRMWARE_VERSION} (simulated)\n"
    "SYS: Free heap: 16920 bytes\n"
)
_MESSAGES = (
    (LOCKED, "SUPERVISOR: Locked, reboot required\n"),
    (CRASHED, "SUPERVISOR: Crashed, recover required\n"),
    (CAN_FLY, "SUPERVISOR: Ready to fly\n"),
)


@dataclass(frozen=True)
class LinkOptions:
    """How the link of a simulated vehicle differs from a good one.

    Attributes:
        protocol_version: below 12 the supervisor port is missing (an old firmware).
        missing_log_variables: left out of the log table.
        loss_rate: share of packets lost, each way; drawn by `loss_seed`.
    """

    protocol_version: int = PROTOCOL_VERSION
    missing_log_variables: tuple[str, ...] = ()
    loss_rate: float = 0.0
    loss_seed: int = 0

    def __post_init__(self) -> None:
        if not OLDEST_PROTOCOL_VERSION <= self.protocol_version <= PROTOCOL_VERSION:
            raise InvalidValue(
                f"protocol version {self.protocol_version} is not simulated, choose "
                f"{OLDEST_PROTOCOL_VERSION} to {PROTOCOL_VERSION}"
            )
        if not 0.0 <= self.loss_rate <= 1.0:
            raise InvalidValue(f"loss rate {self.loss_rate} is no share, choose 0 to 1")


class CrtpServer:
    """Serves one firmware to one peer at a time."""

    def __init__(self, firmware: Firmware, options: LinkOptions | None = None) -> None:
        options = options or LinkOptions()
        version = options.protocol_version
        self._firmware = firmware
        self._version = version
        self._log = LogService(firmware, options.missing_log_variables)
        self._param = ParamService(firmware)
        self._mem = MemService()
        self._commands = CommandService(firmware, version)
        self._console: deque[Packet] = deque(maxlen=64)
        self._info = 0
        self._print(_BOOT_TEXT)

    def handle(self, packet: Packet) -> list[Packet]:
        """The answers to one packet, in order."""
        match packet.port:
            case Port.LINK:
                return self._link(packet)
            case Port.LOG:
                return self._log.handle(packet)
            case Port.PARAM:
                return self._param.handle(packet)
            case Port.MEM:
                return self._mem.handle(packet)
            case Port.PLATFORM:
                return self._platform(packet)
            case _:
                return self._commands.handle(packet)

    def due(self) -> list[Packet]:
        """What the vehicle sends by itself by now: console text and log data."""
        info = self._firmware.supervisor_info
        if info != self._info:
            for bit, text in _MESSAGES:
                if info & bit and not self._info & bit:
                    self._print(text)
            self._info = info
        packets = list(self._console)
        self._console.clear()
        return packets + self._log.due()

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
        self._info = 0
        self._print(_BOOT_TEXT)

    def _print(self, text: str) -> None:
        raw = text.encode("ascii")
        for at in range(0, len(raw), MAX_DATA):
            self._console.append(Packet(Port.CONSOLE, 0, raw[at : at + MAX_DATA]))

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
            elif command in (_CONTINUOUS_WAVE, _NOTIFICATION):
                answer = packet.data[1:]
        if answer is None:
            return []
        return [Packet(Port.PLATFORM, packet.channel, bytes((command,)) + answer)]


# --- The memory port: which memories the vehicle has, and what is in them ----------------------


_INFO, _READ = 0, 1
_MEM_VERSION, _MEM_COUNT, _MEM_DETAILS = 0, 1, 2
_CHUNK = 24
I2C, ONE_WIRE = 0x00, 0x01


@dataclass(frozen=True)
class _Memory:
    kind: int
    content: bytes
    serial: bytes = bytes(8)


class MemService:
    """The EEPROM with the radio's settings and the flow deck's 1-wire memory, to be read."""

    def __init__(self) -> None:
        serial = bytes.fromhex("0D2F4C1BA0000055")
        self._memories = (
            _Memory(I2C, _eeprom().ljust(8192, b"\xff")),
            _Memory(ONE_WIRE, _flow_deck().ljust(112, b"\xff"), serial),
        )

    def handle(self, packet: Packet) -> list[Packet]:
        """The answer to one packet; writing has none."""
        data = packet.data
        answer = b""
        if packet.channel == _INFO and data:
            answer = self._info(data)
        elif packet.channel == _READ and len(data) >= 6:
            answer = self._read(data)
        return [Packet(Port.MEM, packet.channel, answer)] if answer else []

    def _info(self, data: bytes) -> bytes:
        if data[0] == _MEM_VERSION:
            return bytes((_MEM_VERSION, 1))
        if data[0] == _MEM_COUNT:
            return bytes((_MEM_COUNT, len(self._memories)))
        if data[0] != _MEM_DETAILS or len(data) < 2:
            return b""
        if data[1] >= len(self._memories):
            return data[:2]
        memory = self._memories[data[1]]
        return data[:2] + struct.pack("<BI", memory.kind, len(memory.content)) + memory.serial

    def _read(self, data: bytes) -> bytes:
        ident, at, length = struct.unpack_from("<BIB", data)
        content = self._memories[ident].content if ident < len(self._memories) else b""
        if length > _CHUNK or at + length > len(content):
            return data[:5] + bytes((Status.EACCES,))
        return data[:5] + bytes((Status.OK,)) + content[at : at + length]


def _eeprom() -> bytes:
    """The radio's settings, version 1: channel 80, 2 Mbit/s, address E7E7E7E7E7."""
    body = b"0xBC" + struct.pack("<BBBffBI", 1, 80, 2, 0.0, 0.0, 0xE7, 0xE7E7E7E7)
    return body + bytes((sum(body) % 256,))


def _flow_deck() -> bytes:
    """A deck's description: header, then board name and revision, each with a CRC."""
    header = struct.pack("<BIBB", 0xEB, 0, 0xBC, 0x0F)
    name, revision = b"bcFlow2", b"A"
    body = bytes((1, len(name))) + name + bytes((2, len(revision))) + revision
    elements = bytes((0, len(body))) + body
    return _with_crc(header) + _with_crc(elements)


def _with_crc(data: bytes) -> bytes:
    return data + bytes((zlib.crc32(data) & 0xFF,))
