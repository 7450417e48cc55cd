"""CRTP packets, and the encoding of commands and positions as packets; no other module encodes
them.

`CflibLink` sends these packets, and `MockLink` passes the same bytes to the simulated vehicle. The
layouts are those of cflib 0.1.34 (`commander`, `high_level_commander`, `supervisor`) for protocol
12 and later. This module converts radians to degrees (docs/firmware.md, "Link" and "Signs and
units").
"""

from __future__ import annotations

import math
import struct
from enum import IntEnum
from typing import NamedTuple

from perchctl.errors import InvalidValue
from perchctl.vehicle import (
    Arm,
    Command,
    EmergencyStop,
    ExternalPosition,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)

MAX_DATA = 30
"""Bytes of a packet after its header."""


class Port(IntEnum):
    """CRTP's ports with their numbers."""

    PARAM = 2
    COMMANDER = 3
    MEM = 4
    LOG = 5
    LOCALIZATION = 6
    COMMANDER_GENERIC = 7
    HIGH_LEVEL = 8
    SUPERVISOR = 9
    PLATFORM = 13
    LINK = 15


class Packet(NamedTuple):
    """One packet: a header ``port << 4 | 0x0C | channel`` and at most `MAX_DATA` bytes."""

    port: int
    channel: int
    data: bytes

    def encode(self) -> bytes:
        """Return the packet's bytes as transmitted."""
        return bytes((self.port << 4 | 0x0C | self.channel,)) + self.data

    @staticmethod
    def decode(datagram: bytes) -> Packet | None:
        """Return the packet in the datagram; None if the datagram is empty or too long."""
        if not 1 <= len(datagram) <= 1 + MAX_DATA:
            return None
        return Packet(datagram[0] >> 4, datagram[0] & 0x03, datagram[1:])


LAND_TIMES = 3
"""Number of times that a landing command is sent."""
NOTIFY_TIMES = 3
"""Number of notify messages that follow a stop setpoint. Each setpoint makes the firmware wait for
another one, so if those that follow the last one are lost, it locks the vehicle 2 s later, however
many were received before."""
# Port 7: channels, then setpoint types.
_SETPOINT, _META = 0, 1
_STOP, _POSITION = 0, 7
_NOTIFY_SETPOINT_STOP = 0
# Port 8.
_LAND_2 = 8
_ALL_GROUPS = 0
# Port 6: channels, then packet types of the generic channel.
_EXTERNAL_POSITION, _LOCALISATION = 0, 1
_EXTERNAL_POSE = 8
# Port 9, channel 1.
_REQUEST = 1
_ARM, _EMERGENCY_STOP = 1, 3


def encode(message: Command | ExternalPosition) -> tuple[Packet, ...]:
    """Return the packets for a command or an external position, in the order in which they are
    sent; none for `Idle`.

    Raises InvalidValue for a number that does not fit into its field.
    """
    try:
        return _packets(message)
    except (struct.error, OverflowError) as error:
        raise InvalidValue(f"{message} does not fit into a packet: {error}") from None


def _packets(what: Command | ExternalPosition) -> tuple[Packet, ...]:
    match what:
        case Idle():
            return ()
        case PositionSetpoint(x, y, z, yaw):
            data = struct.pack("<Bffff", _POSITION, x, y, z, math.degrees(yaw))
            return (Packet(Port.COMMANDER_GENERIC, _SETPOINT, data),)
        case RawThrust(thrust, roll_rad, pitch_rad):
            return (_raw(thrust, roll_rad, pitch_rad),)
        case Land(height, duration):
            # No yaw is sent (cflib's `yaw=None`), because the vehicle would rotate to it on the
            # way.
            data = struct.pack("<BBff?f", _LAND_2, _ALL_GROUPS, height, 0.0, True, duration)
            # The landing command is sent first, three times: it must not get lost, because the
            # notify message alone cuts the motors at once (docs/firmware.md, "Notify alone"). If
            # the notify message is lost, the setpoint watchdog leaves 2 s to repeat everything.
            return (Packet(Port.HIGH_LEVEL, 0, data),) * LAND_TIMES + (_NOTIFY,)
        case StopMotors():
            stop = Packet(Port.COMMANDER_GENERIC, _SETPOINT, bytes((_STOP,)))
            return stop, *(_NOTIFY,) * NOTIFY_TIMES
        case EmergencyStop():
            return (Packet(Port.SUPERVISOR, _REQUEST, bytes((_EMERGENCY_STOP,))),)
        case Arm(armed):
            return (Packet(Port.SUPERVISOR, _REQUEST, bytes((_ARM, armed))),)
        case ExternalPosition(position_m, quaternion):
            if quaternion is None:
                data = struct.pack("<fff", *position_m)
                return (Packet(Port.LOCALIZATION, _EXTERNAL_POSITION, data),)
            w, x, y, z = quaternion
            data = struct.pack("<Bfffffff", _EXTERNAL_POSE, *position_m, x, y, z, w)
            return (Packet(Port.LOCALIZATION, _LOCALISATION, data),)


def _raw(thrust: int, roll_rad: float = 0.0, pitch_rad: float = 0.0) -> Packet:
    """Return a raw setpoint with zero yaw rate. The pitch is negated for the Crazyflie's
    convention."""
    roll_deg, pitch_deg = math.degrees(roll_rad), math.degrees(pitch_rad)
    return Packet(Port.COMMANDER, 0, struct.pack("<fffH", roll_deg, -pitch_deg, 0.0, thrust))


_NOTIFY = Packet(Port.COMMANDER_GENERIC, _META, struct.pack("<BI", _NOTIFY_SETPOINT_STOP, 0))

UNLOCK_THRUST = (_raw(0), _NOTIFY)
"""One zero-thrust packet after boot, on the ground, then the notify message, which ends the
priority of low-level setpoints. Without the zero-thrust packet, raw thrust stays 0; without the
notify message, the firmware does not execute its own landing (docs/firmware.md, "Raw thrust"). The
vehicle does not confirm these packets, and if they were lost, the first raw thrust in the air would
cut the motors. The packets are therefore sent `UNLOCK_TIMES` times."""
UNLOCK_TIMES, UNLOCK_PERIOD_S = 5, 0.02
"""Number of repetitions of `UNLOCK_THRUST`, and the time between them, s."""
