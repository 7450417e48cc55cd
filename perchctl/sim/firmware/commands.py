"""A Crazyflie's commands as values; units and signs as cflib's calls have them.

Built by decoding packets (`perchctl.sim.crtp.commands`).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RawSetpoint:
    """`commander.send_setpoint`: degrees, yaw rate clockwise positive, thrust 0..65535.

    `pitch_deg` is cflib's argument: +10 is nose down and moves +x."""

    roll_deg: float
    pitch_deg: float
    yaw_rate_dps: float
    thrust: int


@dataclass(frozen=True)
class PositionCommand:
    """`send_position_setpoint`: m and degrees, counter-clockwise positive."""

    x_m: float
    y_m: float
    z_m: float
    yaw_deg: float


@dataclass(frozen=True)
class VelocityWorldCommand:
    """`send_velocity_world_setpoint`: yaw rate deg/s, counter-clockwise positive."""

    vx_mps: float
    vy_mps: float
    vz_mps: float
    yaw_rate_dps: float


@dataclass(frozen=True)
class HoverCommand:
    """`send_hover_setpoint`: body-axes velocity, yaw rate ccw positive, absolute height."""

    vx_mps: float
    vy_mps: float
    yaw_rate_dps: float
    z_m: float


@dataclass(frozen=True)
class ZDistanceCommand:
    """`send_zdistance_setpoint`: attitude, yaw rate, absolute height."""

    roll_deg: float
    pitch_deg: float
    yaw_rate_dps: float
    z_m: float


@dataclass(frozen=True)
class StopCommand:
    """`send_stop_setpoint`."""


LowLevelCommand = (
    RawSetpoint
    | PositionCommand
    | VelocityWorldCommand
    | HoverCommand
    | ZDistanceCommand
    | StopCommand
)


@dataclass(frozen=True)
class HlTakeoff:
    """Absolute height; `yaw_rad` None keeps the current heading."""

    height_m: float
    duration_s: float
    yaw_rad: float | None = None


@dataclass(frozen=True)
class HlLand:
    height_m: float
    duration_s: float
    yaw_rad: float | None = None


@dataclass(frozen=True)
class HlGoTo:
    """`relative` offsets are in world axes (firmware fact)."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float
    duration_s: float
    relative: bool


@dataclass(frozen=True)
class HlStop:
    pass


HighLevelCommand = HlTakeoff | HlLand | HlGoTo | HlStop
