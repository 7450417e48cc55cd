"""Packets that command the vehicle, turned into the firmware model's calls.

Ports and layouts: docs/firmware.md, "Link"; signs: "Signs and units".
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING

from perchctl.sim.crtp.codec import MAX_DATA, Packet, Port, Status
from perchctl.sim.firmware.commands import (
    HighLevelCommand,
    HlGoTo,
    HlLand,
    HlStop,
    HlTakeoff,
    HoverCommand,
    LowLevelCommand,
    PositionCommand,
    RawSetpoint,
    StopCommand,
    VelocityWorldCommand,
    ZDistanceCommand,
)

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

# Port 8.
HL_SET_GROUP, HL_TAKEOFF, HL_LAND, HL_STOP, HL_GO_TO = 0, 1, 2, 3, 4
HL_TAKEOFF_2, HL_LAND_2, HL_GO_TO_2 = 7, 8, 12
# Port 9.
GET_STATE, ARM, RECOVER, EMERGENCY_STOP, WATCHDOG = 0x0C, 0x01, 0x02, 0x03, 0x04
REPLY = 0x80
# Port 6, channel 1.
_LOC_EMERGENCY_STOP, _LOC_WATCHDOG, _LOC_POSE = 3, 4, 8
_NOTIFY_STOP = 0


def raw(data: bytes) -> RawSetpoint:
    """Port 3: ``<fffH``; cflib negates the pitch on its way out."""
    roll, pitch, yaw_rate, thrust = struct.unpack_from("<fffH", data)
    return RawSetpoint(roll, -pitch, yaw_rate, thrust)


def _hover(data: bytes, sign: float = 1.0) -> LowLevelCommand:
    vx, vy, rate, z = struct.unpack_from("<ffff", data)
    return HoverCommand(vx, vy, sign * rate, z)


def _velocity(data: bytes, sign: float = 1.0) -> LowLevelCommand:
    vx, vy, vz, rate = struct.unpack_from("<ffff", data)
    return VelocityWorldCommand(vx, vy, vz, sign * rate)


def _z_distance(data: bytes, sign: float = 1.0) -> LowLevelCommand:
    roll, pitch, rate, z = struct.unpack_from("<ffff", data)
    return ZDistanceCommand(roll, pitch, sign * rate, z)


# The first generation of these setpoints had the yaw rate's sign the other way round.
_GENERIC: dict[int, Callable[[bytes], LowLevelCommand]] = {
    0: lambda data: StopCommand(),
    1: lambda data: _velocity(data, -1.0),
    2: lambda data: _z_distance(data, -1.0),
    5: lambda data: _hover(data, -1.0),
    7: lambda data: PositionCommand(*struct.unpack_from("<ffff", data)),
    8: _velocity,
    9: _z_distance,
    10: _hover,
    11: raw,  # manual, by angles
}


class CommandService:
    """Serves the ports that command; holds the group mask."""

    def __init__(self, firmware: Firmware, protocol_version: int) -> None:
        self.firmware = firmware
        self._has_supervisor_port = protocol_version >= 12
        self._has_go_to_2 = protocol_version >= 8
        self._groups = 0
        self._handlers: dict[int, Callable[[Packet], list[Packet]]] = {
            Port.COMMANDER: self._commander,
            Port.COMMANDER_GENERIC: self._generic,
            Port.HIGH_LEVEL: self._high_level,
            Port.LOCALIZATION: self._localization,
            Port.SUPERVISOR: self._supervisor,
        }

    def handle(self, packet: Packet) -> list[Packet]:
        """Packets too short for their command are passed over, as the firmware does."""
        handler = self._handlers.get(packet.port)
        if handler is None or (not packet.data):
            return []
        try:
            return handler(packet)
        except struct.error:
            return []

    def arm(self, do_arm: bool) -> bytes:
        """(success, armed) as bytes; shared with the platform port."""
        return bytes(self.firmware.arm(do_arm))

    def recover(self) -> bytes:
        return bytes(self.firmware.recover_from_crash())

    def _commander(self, packet: Packet) -> list[Packet]:
        if packet.channel == 0:
            self._low_level(raw(packet.data))
        return []

    def _generic(self, packet: Packet) -> list[Packet]:
        data = packet.data
        if packet.channel == 0 and data[0] in _GENERIC:
            self._low_level(_GENERIC[data[0]](data[1:]))
        elif packet.channel == 1 and data[0] == _NOTIFY_STOP:
            (remain_ms,) = struct.unpack_from("<I", data, 1)
            self.firmware.notify_setpoint_stop(remain_ms / 1000.0)
        return []

    def _high_level(self, packet: Packet) -> list[Packet]:
        data = packet.data
        status = Status.OK
        if data[0] == HL_SET_GROUP:
            self._groups = data[1]
        elif data[0] == HL_GO_TO_2 and not self._has_go_to_2:
            status = Status.ENOEXEC
        else:
            command = _high_level(data)
            if command is None:
                status = Status.ENOEXEC
            elif self._for_us(data[1]) and _all_finite(command):
                self.firmware.high_level(command)
        return [Packet(Port.HIGH_LEVEL, 0, data[:3].ljust(3, b"\0") + bytes((status,)))]

    def _low_level(self, command: LowLevelCommand) -> None:
        if _all_finite(command):
            self.firmware.low_level(command)

    def _for_us(self, mask: int) -> bool:
        return mask == 0 or bool(mask & self._groups)

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
    """None for a command this vehicle does not have (trajectories, spirals)."""
    command = data[0]
    if command == HL_STOP:
        return HlStop()
    if command in (HL_TAKEOFF, HL_LAND):
        height, duration = struct.unpack_from("<ff", data, 2)
        # The first generation always turns to yaw 0 (source).
        return (HlTakeoff if command == HL_TAKEOFF else HlLand)(height, duration, 0.0)
    if command in (HL_TAKEOFF_2, HL_LAND_2):
        height, yaw, keep_yaw, duration = struct.unpack_from("<ff?f", data, 2)
        cls = HlTakeoff if command == HL_TAKEOFF_2 else HlLand
        return cls(height, duration, None if keep_yaw else yaw)
    if command in (HL_GO_TO, HL_GO_TO_2):
        at = 4 if command == HL_GO_TO_2 else 3  # the second one has a flag for straight lines
        x, y, z, yaw, duration = struct.unpack_from("<fffff", data, at)
        return HlGoTo(x, y, z, yaw, duration, bool(data[2]))
    return None


def _all_finite(command: LowLevelCommand | HighLevelCommand) -> bool:
    """Numbers that are none would poison the controller for good: such packets are dropped."""
    values = vars(command).values()
    return all(math.isfinite(v) for v in values if isinstance(v, float))


def link_source() -> bytes:
    """The answer to a link-source request (port 15, channel 1)."""
    return b"Bitcraze Crazyflie".ljust(MAX_DATA, b"\0")
