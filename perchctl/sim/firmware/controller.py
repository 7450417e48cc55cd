"""The cascaded PID controller: position and velocity at 100 Hz, attitude and rate at 500 Hz.

Gains and limits are the firmware's defaults for the airframe, whatever is written into the
parameters of the same names. Angles are in degrees with pitch nose up, as inside the firmware.
Every change of setpoint mode resets all integrators (docs/firmware.md, "Setpoint modes"), so the
thrust starts again from `thrustBase`. The loops request thrust; `MotorDriver` turns these requests
into duty cycles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from perchctl.sim.airframe import CRAZYFLIE_21, ThrustCurve
from perchctl.sim.powertrain import FULL_COMMAND, inverse_thrust
from perchctl.sim.scenario import CONTROL_PERIOD_S

Motors = tuple[float, float, float, float]
MOTORS_OFF: Motors = (0.0, 0.0, 0.0, 0.0)

# --- Setpoints: which axes are controlled, and how ---

DISABLED = 0
ABSOLUTE = 1
BY_VELOCITY = 2

Mode = tuple[int, int, int, int, int, int]  # x, y, z, roll, pitch, yaw

MODE_OFF: Mode = (DISABLED,) * 6
MODE_POSITION: Mode = (ABSOLUTE, ABSOLUTE, ABSOLUTE, DISABLED, DISABLED, ABSOLUTE)
MODE_VELOCITY: Mode = (BY_VELOCITY, BY_VELOCITY, BY_VELOCITY, DISABLED, DISABLED, BY_VELOCITY)
MODE_HOVER: Mode = (BY_VELOCITY, BY_VELOCITY, ABSOLUTE, DISABLED, DISABLED, BY_VELOCITY)
MODE_Z_DISTANCE: Mode = (DISABLED, DISABLED, ABSOLUTE, ABSOLUTE, ABSOLUTE, BY_VELOCITY)
MODE_RAW: Mode = (DISABLED, DISABLED, DISABLED, ABSOLUTE, ABSOLUTE, BY_VELOCITY)


@dataclass(frozen=True, slots=True)
class Setpoint:
    """One setpoint in the firmware's own units: m, m/s, degrees, pitch nose up.

    Yaw rates are counter-clockwise positive, `thrust` is 0..65535; the velocity is along the
    world's axes, with `MODE_HOVER` along the body's. The default is the setpoint of
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

    def level_setpoint(self) -> Setpoint:
        """The setpoint flown while setpoints are missing: level, no yaw rate, same z."""
        mode = (DISABLED, DISABLED, self.mode[2], ABSOLUTE, ABSOLUTE, BY_VELOCITY)
        return replace(self, mode=mode, roll_deg=0.0, pitch_deg=0.0, yaw_rate_dps=0.0)


# --- The loops ---

ATTITUDE_DT_S = 0.002
POSITION_DT_S = 0.01
POSITION_EVERY = 5
TILT_MAX_DEG, SPEED_MAX_MPS = 20.0, 1.0  # posCtlPid.rLimit, pLimit, xVelMax, yVelMax, zVelMax
THRUST_LEAST = 20000.0  # posCtlPid.thrustMin
INT16_MAX = 32767.0
UINT16_MAX = 65535.0
_OVERHEAD = 1.1  # a loop may request a little more than the limit of the next one
_THRUST_SCALE = 1000.0


class Pid:
    """A PID loop, derivative on measurement; `i_limit` bounds the integral, `limit` the output."""

    def __init__(
        self,
        kp: float,
        ki: float,
        kd: float,
        period_s: float,
        i_limit: float,
        limit: float = math.inf,
    ) -> None:
        self._kp, self._ki, self._kd = kp, ki, kd
        self._limit = limit
        self._period = period_s
        self._i_limit = i_limit
        self._integral = self._measured = 0.0

    def reset(self, measured: float) -> None:
        self._integral = 0.0
        self._measured = measured

    def update(self, desired: float, measured: float, is_angle: bool = False) -> float:
        """Return the output after one period; the error of an angle is wrapped to +-180 degrees."""
        error, change = desired - measured, measured - self._measured
        if is_angle:
            error, change = wrap_deg(error), wrap_deg(change)
        integral = self._integral + error * self._period
        if abs(integral) > self._i_limit:
            integral = math.copysign(self._i_limit, integral)
        self._integral = integral
        self._measured = measured
        output = self._kp * error + self._ki * integral
        if self._kd != 0.0:
            output -= self._kd * change / self._period
        return output if abs(output) <= self._limit else math.copysign(self._limit, output)


def wrap_deg(angle: float) -> float:
    """Wrap an angle to +-180 degrees."""
    return math.remainder(angle, 360.0)


def _saturated(value: float) -> float:
    return max(-INT16_MAX, min(INT16_MAX, value))


@dataclass(slots=True)
class Estimate:
    """The state estimate in the firmware's units: m, m/s, degrees, pitch nose up."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    vx_mps: float = 0.0
    vy_mps: float = 0.0
    vz_mps: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    gyro_x_dps: float = 0.0
    gyro_y_dps: float = 0.0
    gyro_z_dps: float = 0.0


class Controller:
    """Computes four thrust requests, in units of the thrust command, from setpoint and estimate."""

    def __init__(
        self,
        thrust_base: float = CRAZYFLIE_21.thrust_base,
        rate_gains: tuple[float, float, float] = CRAZYFLIE_21.rate_gains,
    ) -> None:
        dt, pt, tilt = ATTITUDE_DT_S, POSITION_DT_S, TILT_MAX_DEG * _OVERHEAD
        self._thrust_base = thrust_base
        self.roll_rate = Pid(*rate_gains, dt, 33.3)
        self.pitch_rate = Pid(*rate_gains, dt, 33.3)
        self.yaw_rate = Pid(120.0, 16.7, 0.0, dt, 166.7)
        self.roll = Pid(6.0, 3.0, 0.0, dt, 20.0)
        self.pitch = Pid(6.0, 3.0, 0.0, dt, 20.0)
        self.yaw = Pid(6.0, 1.0, 0.35, dt, 360.0)
        self.x = Pid(2.0, 0.0, 0.0, pt, 5000.0, SPEED_MAX_MPS * _OVERHEAD)
        self.y = Pid(2.0, 0.0, 0.0, pt, 5000.0, SPEED_MAX_MPS * _OVERHEAD)
        self.z = Pid(2.0, 0.5, 0.0, pt, 5000.0, SPEED_MAX_MPS * _OVERHEAD)
        self.vx = Pid(25.0, 1.0, 0.0, pt, 5000.0, tilt)
        self.vy = Pid(25.0, 1.0, 0.0, pt, 5000.0, tilt)
        self.vz = Pid(25.0, 15.0, 0.0, pt, 5000.0, UINT16_MAX / 2.0 / _THRUST_SCALE)
        self._mode: Mode = MODE_OFF
        self._position_in = 1
        self.thrust = 0.0
        self.desired_roll_deg = self.desired_pitch_deg = self.desired_yaw_deg = 0.0

    def update(self, setpoint: Setpoint, now: Estimate) -> Motors:
        mode = setpoint.mode
        if mode != self._mode:
            self._mode = mode
            self._reset(now)
        if mode[5] == BY_VELOCITY:
            turned_deg = setpoint.yaw_rate_dps * ATTITUDE_DT_S
            self.desired_yaw_deg = wrap_deg(self.desired_yaw_deg + turned_deg)
        elif mode[5] == ABSOLUTE:
            self.desired_yaw_deg = wrap_deg(setpoint.yaw_deg)
        self._position_in -= 1
        if self._position_in == 0:
            self._position_in = POSITION_EVERY
            self._position(setpoint, now)
        if mode[2] == DISABLED:
            self.thrust = setpoint.thrust
        if mode[0] == DISABLED or mode[1] == DISABLED:
            self.desired_roll_deg = setpoint.roll_deg
            self.desired_pitch_deg = setpoint.pitch_deg
        if self.thrust == 0.0:
            self._reset(now)
            self.desired_yaw_deg = now.yaw_deg
            return MOTORS_OFF
        roll_dps = self.roll.update(self.desired_roll_deg, now.roll_deg)
        pitch_dps = self.pitch.update(self.desired_pitch_deg, now.pitch_deg)
        yaw_dps = self.yaw.update(self.desired_yaw_deg, now.yaw_deg, True)
        r = 0.5 * _saturated(self.roll_rate.update(roll_dps, now.gyro_x_dps))
        p = 0.5 * _saturated(self.pitch_rate.update(pitch_dps, -now.gyro_y_dps))
        y = -_saturated(self.yaw_rate.update(yaw_dps, now.gyro_z_dps))
        # The total thrust has neither an upper nor a lower limit here (see `MotorDriver`).
        f = self.thrust
        return (f - r + p + y, f - r - p - y, f + r - p + y, f + r + p - y)

    def _position(self, setpoint: Setpoint, now: Estimate) -> None:
        mode = setpoint.mode
        yaw_rad = math.radians(now.yaw_deg)
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        want_x, want_y = setpoint.vx_mps, setpoint.vy_mps
        if mode != MODE_HOVER:
            want_x, want_y = want_x * c + want_y * s, want_y * c - want_x * s
        if mode[0] == ABSOLUTE:
            want_x = self.x.update(setpoint.x_m * c + setpoint.y_m * s, now.x_m * c + now.y_m * s)
        if mode[1] == ABSOLUTE:
            want_y = self.y.update(setpoint.y_m * c - setpoint.x_m * s, now.y_m * c - now.x_m * s)
        want_z = setpoint.vz_mps
        if mode[2] == ABSOLUTE:
            want_z = self.z.update(setpoint.z_m, now.z_m)
        pitch = -self.vx.update(want_x, now.vx_mps * c + now.vy_mps * s)
        roll = -self.vy.update(want_y, now.vy_mps * c - now.vx_mps * s)
        self.desired_pitch_deg = max(-TILT_MAX_DEG, min(TILT_MAX_DEG, pitch))
        self.desired_roll_deg = max(-TILT_MAX_DEG, min(TILT_MAX_DEG, roll))
        thrust = self.vz.update(want_z, now.vz_mps) * _THRUST_SCALE + self._thrust_base
        self.thrust = min(UINT16_MAX, max(THRUST_LEAST, thrust))

    def _reset(self, now: Estimate) -> None:
        self.x.reset(now.x_m)
        self.y.reset(now.y_m)
        self.z.reset(now.z_m)
        self.roll.reset(now.roll_deg)
        self.pitch.reset(now.pitch_deg)
        self.yaw.reset(now.yaw_deg)
        for pid in (self.vx, self.vy, self.vz, self.roll_rate, self.pitch_rate, self.yaw_rate):
            pid.reset(0.0)
        self.desired_roll_deg = now.roll_deg
        self.desired_pitch_deg = now.pitch_deg


# --- Power distribution: four thrust requests in, four duty cycles (PWM) out ---
# In the firmware's order (source: power distribution, motor driver and stabiliser of release
# 2026.08): the battery's voltage is compensated by the inverted thrust curve first, then any excess
# over the full duty cycle is subtracted from all four. A single motor may therefore be commanded
# above its nominal full thrust, and delivers it as long as the battery voltage allows, so a yaw
# step in hover loses no height (docs/firmware.md, "Yaw step").

SUPPLY_AT_BOOT_V = 4.2
SUPPLY_FILTER = 0.01  # share of each new sample in the filtered voltage, at `SUPPLY_RATE_HZ`
SUPPLY_RATE_HZ = 1000.0
SUPPLY_LEAST_V = 2.0  # a reading below this counts as broken: no thrust

_KEEP = (1.0 - SUPPLY_FILTER) ** (SUPPLY_RATE_HZ * CONTROL_PERIOD_S)


class MotorDriver:
    """Converts thrust requests to duty cycles, using the filtered battery voltage."""

    def __init__(self, curve: ThrustCurve = CRAZYFLIE_21.thrust) -> None:
        self._voltage = inverse_thrust(curve)
        self._n_per_command = curve.most_n / FULL_COMMAND
        self.thrust_min = FULL_COMMAND * curve.least_n / curve.most_n
        # Low-pass filter with a time constant of 0.1 s: the compensation lags behind a sagging
        # battery.
        self._supply_v = SUPPLY_AT_BOOT_V

    def pwm(self, requests: Motors, battery_v: float) -> Motors:
        """Return duty cycles 0..65535 for thrust requests; `MOTORS_OFF` itself when all are 0."""
        self._supply_v = supply_v = battery_v + _KEEP * (self._supply_v - battery_v)
        if requests is MOTORS_OFF or supply_v < SUPPLY_LEAST_V:
            return MOTORS_OFF
        scale, voltage = FULL_COMMAND / supply_v, self._voltage
        least, n_per_command = self.thrust_min, self._n_per_command
        p1, p2, p3, p4 = (
            scale * voltage(n_per_command * request) if request >= least else 0.0
            for request in requests
        )
        most = max(p1, p2, p3, p4)
        if most == 0.0:
            return MOTORS_OFF
        # Attitude takes precedence over thrust: all four requests are reduced equally.
        excess = max(0.0, most - FULL_COMMAND)
        p1, p2, p3, p4 = (max(0.0, duty - excess) for duty in (p1, p2, p3, p4))
        return p1, p2, p3, p4
