"""Setpoints: which axes are controlled how, as the stabiliser's controller reads them."""

from __future__ import annotations

from dataclasses import dataclass, replace

DISABLED, ABSOLUTE, VELOCITY = 0, 1, 2

Mode = tuple[int, int, int, int, int, int]  # x, y, z, roll, pitch, yaw

MODE_OFF: Mode = (DISABLED,) * 6
MODE_POSITION: Mode = (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLED, DISABLED, ABSOLUTE)
MODE_VELOCITY: Mode = (VELOCITY, VELOCITY, VELOCITY, DISABLED, DISABLED, VELOCITY)
MODE_HOVER: Mode = (VELOCITY, VELOCITY, ABSOLUTE, DISABLED, DISABLED, VELOCITY)
MODE_Z_DISTANCE: Mode = (DISABLED, DISABLED, ABSOLUTE, ABSOLUTE, ABSOLUTE, VELOCITY)
MODE_RAW: Mode = (DISABLED, DISABLED, DISABLED, ABSOLUTE, ABSOLUTE, VELOCITY)


@dataclass(frozen=True, slots=True)
class Setpoint:
    """One setpoint in the firmware's own units: m, m/s, degrees, pitch nose up.

    Yaw rates are counter-clockwise positive, `thrust` is 0..65535; `body_velocity` means that
    the velocity is along the body's axes instead of the world's. The class methods take what
    cflib's calls of the same kind take. Without arguments it is the one of
    `send_stop_setpoint`: no thrust.
    """

    mode: Mode = MODE_OFF
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    vz_mps: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    yaw_rate_dps: float = 0.0
    thrust: float = 0.0
    body_velocity: bool = False

    @classmethod
    def raw(cls, roll_deg: float, pitch_deg: float, yaw_rate_dps: float, thrust: float) -> Setpoint:
        """`commander.send_setpoint`: +10 of pitch is nose down, the yaw rate clockwise positive."""
        return cls(
            MODE_RAW,
            roll_deg=roll_deg,
            pitch_deg=-pitch_deg,
            yaw_rate_dps=-yaw_rate_dps,
            thrust=float(thrust),
        )

    @classmethod
    def position(cls, x_m: float, y_m: float, z_m: float, yaw_deg: float) -> Setpoint:
        """`send_position_setpoint`: m and degrees, counter-clockwise positive."""
        return cls(MODE_POSITION, x_m, y_m, z_m, yaw_deg=yaw_deg)

    @classmethod
    def velocity(cls, vx_mps: float, vy_mps: float, vz_mps: float, yaw_rate_dps: float) -> Setpoint:
        """`send_velocity_world_setpoint`: yaw rate counter-clockwise positive."""
        return cls(
            MODE_VELOCITY, vx_mps=vx_mps, vy_mps=vy_mps, vz_mps=vz_mps, yaw_rate_dps=yaw_rate_dps
        )

    @classmethod
    def hover(cls, vx_mps: float, vy_mps: float, yaw_rate_dps: float, z_m: float) -> Setpoint:
        """`send_hover_setpoint`: velocity in body axes, yaw rate, absolute height."""
        return cls(
            MODE_HOVER,
            z_m=z_m,
            vx_mps=vx_mps,
            vy_mps=vy_mps,
            yaw_rate_dps=yaw_rate_dps,
            body_velocity=True,
        )

    @classmethod
    def z_distance(
        cls, roll_deg: float, pitch_deg: float, yaw_rate_dps: float, z_m: float
    ) -> Setpoint:
        """`send_zdistance_setpoint`: attitude, yaw rate, absolute height."""
        return cls(
            MODE_Z_DISTANCE,
            z_m=z_m,
            roll_deg=roll_deg,
            pitch_deg=pitch_deg,
            yaw_rate_dps=yaw_rate_dps,
        )

    def levelled(self) -> Setpoint:
        """What the supervisor flies while setpoints are missing: level, no turn, z as it is."""
        mode = (DISABLED, DISABLED, self.mode[2], ABSOLUTE, ABSOLUTE, VELOCITY)
        return replace(self, mode=mode, roll_deg=0.0, pitch_deg=0.0, yaw_rate_dps=0.0)
