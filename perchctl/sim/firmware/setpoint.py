"""Setpoints: which axes are controlled how, as the stabiliser's controller reads them."""

from __future__ import annotations

from perchctl.sim.firmware.commands import (
    HoverCommand,
    LowLevelCommand,
    PositionCommand,
    RawSetpoint,
    StopCommand,
    VelocityWorldCommand,
    ZDistanceCommand,
)

DISABLED, ABSOLUTE, VELOCITY = 0, 1, 2

Mode = tuple[int, int, int, int, int, int]  # x, y, z, roll, pitch, yaw

MODE_OFF: Mode = (DISABLED,) * 6
MODE_POSITION: Mode = (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLED, DISABLED, ABSOLUTE)
MODE_VELOCITY: Mode = (VELOCITY, VELOCITY, VELOCITY, DISABLED, DISABLED, VELOCITY)
MODE_HOVER: Mode = (VELOCITY, VELOCITY, ABSOLUTE, DISABLED, DISABLED, VELOCITY)
MODE_Z_DISTANCE: Mode = (DISABLED, DISABLED, ABSOLUTE, ABSOLUTE, ABSOLUTE, VELOCITY)
MODE_RAW: Mode = (DISABLED, DISABLED, DISABLED, ABSOLUTE, ABSOLUTE, VELOCITY)

RAW_THRUST_MIN = 1000
RAW_THRUST_MAX = 60000


class Setpoint:
    """One setpoint in the firmware's own units: m, m/s, degrees, pitch nose up.

    Yaw rates are counter-clockwise positive. `stamp_s` is the firmware time at which
    it was accepted. Never changed after it was handed to the commander.
    """

    __slots__ = (
        "body_velocity",
        "mode",
        "pitch_deg",
        "roll_deg",
        "stamp_s",
        "thrust",
        "vx_mps",
        "vy_mps",
        "vz_mps",
        "x_m",
        "y_m",
        "yaw_deg",
        "yaw_rate_dps",
        "z_m",
    )

    def __init__(
        self,
        mode: Mode = MODE_OFF,
        position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0),
        rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
        yaw_rate_dps: float = 0.0,
        thrust: float = 0.0,
        body_velocity: bool = False,
    ) -> None:
        self.mode = mode
        self.x_m, self.y_m, self.z_m = position_m
        self.vx_mps, self.vy_mps, self.vz_mps = velocity_mps
        self.roll_deg, self.pitch_deg, self.yaw_deg = rpy_deg
        self.yaw_rate_dps = yaw_rate_dps
        self.thrust = thrust
        self.body_velocity = body_velocity
        self.stamp_s = 0.0

    def levelled(self) -> Setpoint:
        """What the supervisor flies while setpoints are missing: level, no turn, z as it is."""
        mode = (DISABLED, DISABLED, self.mode[2], ABSOLUTE, ABSOLUTE, VELOCITY)
        return Setpoint(
            mode,
            (self.x_m, self.y_m, self.z_m),
            (self.vx_mps, self.vy_mps, self.vz_mps),
            (0.0, 0.0, self.yaw_deg),
            0.0,
            self.thrust,
            self.body_velocity,
        )


class Decoder:
    """Turns commands into setpoints; holds the raw thrust's lock.

    Raw thrust is forced to 0 until one packet with thrust 0 has come since boot
    (docs/firmware.md, "Raw thrust").
    """

    def __init__(self) -> None:
        self.thrust_locked = True

    def decode(self, command: LowLevelCommand) -> Setpoint:
        match command:
            case PositionCommand(x_m, y_m, z_m, yaw_deg):
                return Setpoint(MODE_POSITION, (x_m, y_m, z_m), rpy_deg=(0.0, 0.0, yaw_deg))
            case RawSetpoint():
                return self._raw(command)
            case VelocityWorldCommand(vx, vy, vz, yaw_rate):
                return Setpoint(MODE_VELOCITY, velocity_mps=(vx, vy, vz), yaw_rate_dps=yaw_rate)
            case HoverCommand(vx, vy, yaw_rate, z_m):
                return Setpoint(
                    MODE_HOVER,
                    (0.0, 0.0, z_m),
                    (vx, vy, 0.0),
                    yaw_rate_dps=yaw_rate,
                    body_velocity=True,
                )
            case ZDistanceCommand(roll, pitch, yaw_rate, z_m):
                return Setpoint(
                    MODE_Z_DISTANCE,
                    (0.0, 0.0, z_m),
                    rpy_deg=(roll, pitch, 0.0),
                    yaw_rate_dps=yaw_rate,
                )
            case StopCommand():
                return Setpoint()

    def _raw(self, command: RawSetpoint) -> Setpoint:
        if command.thrust == 0:
            self.thrust_locked = False
        thrust = min(int(command.thrust), RAW_THRUST_MAX)
        if self.thrust_locked or thrust < RAW_THRUST_MIN:
            thrust = 0
        # cflib negates the pitch on its way out; its yaw rate is clockwise positive.
        return Setpoint(
            MODE_RAW,
            rpy_deg=(command.roll_deg, -command.pitch_deg, 0.0),
            yaw_rate_dps=-command.yaw_rate_dps,
            thrust=float(thrust),
        )
