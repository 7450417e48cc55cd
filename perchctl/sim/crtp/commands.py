"""Packets that command the vehicle, turned into the firmware model's calls.

Ports and layouts: docs/firmware.md, "Link"; signs: "Signs and units".
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from perchctl.sim.crtp.codec import Packet, Port, Status
from perchctl.sim.firmware.controller import Setpoint
from perchctl.sim.firmware.planner import HighLevelCommand, HlGoTo, HlLand, HlStop, HlTakeoff

if TYPE_CHECKING:
    from perchctl.sim.firmware import Firmware

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

    def __init__(self, firmware: Firmware, protocol_version: int) -> None:
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
