"""Log variables: where each live one comes from. All others read 0."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from perchctl.sim.firmware.vehicle import Firmware

Getter = Callable[[], float]


def log_getters(firmware: Firmware) -> dict[str, Getter]:
    """Name -> getter, bound to one boot of the firmware."""
    now = firmware.estimator.now
    estimator = firmware.estimator
    controller = firmware.controller
    supervisor = firmware.supervisor
    power = firmware.power

    def field(thing: object, name: str, scale: float = 1.0) -> Getter:
        return lambda: scale * float(getattr(thing, name))

    def flown(name: str) -> Getter:
        return lambda: float(getattr(firmware.flown_setpoint, name))

    def acc(axis: int) -> Getter:
        return lambda: estimator.acc_g[axis]

    def motor(i: int) -> Getter:
        return lambda: float(int(firmware.motors[i]))

    def quaternion(i: int) -> Getter:
        return lambda: firmware.world.quaternion[i]

    def output(i: int) -> Getter:
        return lambda: controller.outputs[i]

    def variance() -> float:
        return estimator.variance(firmware.t_s)

    getters: dict[str, Getter] = {
        "pm.vbat": field(power, "battery_v"),
        "pm.vbatMV": field(power, "battery_v", 1000.0),
        "pm.state": field(power, "state"),
        "pm.batteryLevel": field(power, "level_percent"),
        "supervisor.info": lambda: float(firmware.supervisor_info),
        "sys.canfly": field(supervisor, "motors_allowed"),
        "sys.isFlying": field(supervisor, "is_flying"),
        "sys.isTumbled": field(supervisor, "tumbled"),
        "stabilizer.thrust": field(controller, "thrust"),
        "controller.cmd_thrust": field(controller, "thrust"),
        "controller.actuatorThrust": field(controller, "thrust"),
        "controller.roll": field(controller, "desired_roll_deg"),
        "controller.pitch": field(controller, "desired_pitch_deg"),
        "controller.yaw": field(controller, "desired_yaw_deg"),
        "controller.accelz": acc(2),
        "radio.rssi": lambda: 40.0,
        "radio.isConnected": lambda: 1.0,
        "kalman.inFlight": field(supervisor, "is_flying"),
        "range.zrange": lambda: 1000.0 * max(0.0, firmware.world.z_m),
        "locSrv.tick": field(estimator, "external_count"),
    }
    for i, axis in enumerate("xyz"):
        position = field(now, f"{axis}_m")
        velocity = field(now, f"v{axis}_mps")
        getters |= {
            f"stateEstimate.{axis}": position,
            f"stateEstimate.v{axis}": velocity,
            f"kalman.state{axis.upper()}": position,
            f"kalman.stateP{axis.upper()}": velocity,
            f"stateEstimateZ.{axis}": field(now, f"{axis}_m", 1000.0),
            f"stateEstimateZ.v{axis}": field(now, f"v{axis}_mps", 1000.0),
            f"kalman.var{axis.upper()}": variance,
            f"kalman.varP{axis.upper()}": variance,
            f"acc.{axis}": acc(i),
            f"gyro.{axis}": field(now, f"gyro_{axis}_dps"),
            f"ctrltarget.{axis}": flown(f"{axis}_m"),
            f"ctrltarget.v{axis}": flown(f"v{axis}_mps"),
        }
    for i, angle in enumerate(("roll", "pitch", "yaw")):
        value = field(now, f"{angle}_deg")
        getters |= {
            f"stateEstimate.{angle}": value,
            f"stabilizer.{angle}": value,
            f"ctrltarget.{angle}": flown(f"{angle}_deg"),
            f"controller.cmd_{angle}": output(i),
        }
    gyro = ("gyro_x_dps", "gyro_y_dps", "gyro_z_dps")
    for angle, name, sign in zip(("roll", "pitch", "yaw"), gyro, (1, -1, 1), strict=True):
        getters[f"controller.r_{angle}"] = field(now, name, math.radians(sign))
    for i in range(4):
        getters[f"motor.m{i + 1}"] = motor(i)
        getters[f"motor.m{i + 1}req"] = motor(i)
        getters[f"stateEstimate.q{'wxyz'[i]}"] = quaternion(i)
        getters[f"kalman.q{i}"] = quaternion(i)
    return getters
