"""A Crazyflie's end of the link: packets in, firmware calls, packets out.

Uses no socket and no clock; `perchctl.sim.endpoint` carries the packets. Everything an
unmodified cflib sends is answered as in docs/firmware.md, "Connect sequence"; ports and layouts
are those of "Link" there, signs those of "Signs and units".
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from perchctl.link import Packet, Port
from perchctl.sim.crtp.tables import MAX_DATA, LogService, ParamService, Status
from perchctl.sim.firmware.controller import Setpoint
from perchctl.sim.firmware.planner import HighLevelCommand, HlGoTo, HlLand, HlStop, HlTakeoff
from perchctl.vehicle import CAN_FLY, CRASHED, LOCKED

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

PROTOCOL_VERSION = 12
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
                return _memories(packet)
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
HL_SET_GROUP, HL_STOP, HL_TAKEOFF_2, HL_LAND_2, HL_GO_TO_2 = 0, 3, 7, 8, 12
# Port 9.
GET_STATE, ARM, RECOVER, EMERGENCY_STOP, WATCHDOG = 0x0C, 0x01, 0x02, 0x03, 0x04
REPLY = 0x80
# Port 6, channel 1.
_LOC_EMERGENCY_STOP, _LOC_WATCHDOG, _LOC_POSE = 3, 4, 8
_NOTIFY_STOP = 0


def _raw(data: bytes) -> Setpoint:
    """Port 3: ``<fffH``; cflib negates the pitch on its way out."""
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
    """Serves the ports that command; holds the group mask."""

    def __init__(self, firmware: Firmware, protocol_version: int = PROTOCOL_VERSION) -> None:
        self.firmware = firmware
        self._has_supervisor_port = protocol_version >= 12
        self._groups = 0
        self._handlers: dict[int, Callable[[Packet], list[Packet]]] = {
            Port.COMMANDER: self._commander,
            Port.COMMANDER_GENERIC: self._generic,
            Port.HIGH_LEVEL: self._high_level,
            Port.LOCALIZATION: self._localization,
            Port.SUPERVISOR: self._supervisor,
        }

    def handle(self, packet: Packet) -> list[Packet]:
        """The answers to one packet. What is too short for its command is passed over, as the
        firmware does."""
        handler = self._handlers.get(packet.port)
        if handler is None or not packet.data:
            return []
        try:
            return handler(packet)
        except struct.error:
            return []

    def arm(self, do_arm: bool) -> bytes:
        """(success, armed) as bytes; shared with the platform port."""
        return bytes(self.firmware.arm(do_arm))

    def recover(self) -> bytes:
        """(success, recovered) as bytes; shared with the platform port."""
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
            (remain_ms,) = struct.unpack_from("<I", data, 1)
            self.firmware.notify_setpoint_stop(remain_ms / 1000.0)
        return []

    def _low_level(self, setpoint: Setpoint) -> None:
        values = (getattr(setpoint, name) for name in Setpoint.__slots__)
        if _all_finite(value for value in values if isinstance(value, float)):
            self.firmware.low_level(setpoint)

    def _high_level(self, packet: Packet) -> list[Packet]:
        data, status = packet.data, Status.OK
        if data[0] == HL_SET_GROUP:
            self._groups = data[1]
        elif (command := _high_level(data)) is None:
            status = Status.ENOEXEC
        elif data[1] == 0 or data[1] & self._groups:
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
    """The command of a packet on port 8; None for one that this vehicle does not have
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
    """Numbers that are none would poison the controller for good: such packets are dropped."""
    return all(map(math.isfinite, values))
