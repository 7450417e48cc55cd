"""Log variables: where each live one comes from. All others read 0."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Protocol

from perchctl.sim.firmware.controller import Controller
from perchctl.sim.firmware.covariance import ATTITUDE, POSITION, VELOCITY
from perchctl.sim.firmware.estimator import Estimator
from perchctl.sim.firmware.health import Health
from perchctl.sim.firmware.motors import MotorDriver
from perchctl.sim.firmware.power import PowerMonitor
from perchctl.sim.firmware.setpoint import Setpoint
from perchctl.sim.firmware.supervisor import Supervisor
from perchctl.sim.scenario import Scenario

if TYPE_CHECKING:
    from perchctl.sim.world import World

Getter = Callable[[], float]
AXES = "xyz"
ANGLES = ("roll", "pitch", "yaw")


class Logged(Protocol):
    """What of the firmware can be logged."""

    world: World
    estimator: Estimator
    controller: Controller
    supervisor: Supervisor
    power: PowerMonitor
    health: Health
    scenario: Scenario
    driver: MotorDriver
    flown_setpoint: Setpoint
    external_tick_ms: int

    @property
    def motors(self) -> Sequence[float]: ...

    @property
    def t_s(self) -> float: ...

    @property
    def supervisor_info(self) -> int: ...


def log_getters(firmware: Logged) -> dict[str, Getter]:
    """Name -> getter, bound to one boot of the firmware."""
    return {
        **_system(firmware),
        **_translation(firmware),
        **_rotation(firmware),
        **_motors(firmware),
        **_health(firmware.health),
    }


def _field(thing: object, name: str, scale: float = 1.0) -> Getter:
    read = attrgetter(name)
    if scale == 1.0:
        return lambda: float(read(thing))
    return lambda: scale * float(read(thing))


def _system(firmware: Logged) -> dict[str, Getter]:
    """Power, supervisor, controller and ranges."""
    power, supervisor = firmware.power, firmware.supervisor
    controller, estimator = firmware.controller, firmware.estimator
    return {
        "pm.vbat": _field(power, "battery_v"),
        "pm.vbatMV": _field(power, "battery_v", 1000.0),
        "pm.state": _field(power, "state"),
        "pm.batteryLevel": _field(power, "level_percent"),
        "supervisor.info": lambda: float(firmware.supervisor_info),
        "sys.canfly": _field(supervisor, "motors_allowed"),
        "sys.isFlying": _field(supervisor, "is_flying"),
        "sys.isTumbled": _field(supervisor, "tumbled"),
        "stabilizer.thrust": _field(controller, "thrust"),
        "controller.cmd_thrust": _field(controller, "thrust"),
        "controller.actuatorThrust": _field(controller, "thrust"),
        **{f"controller.{a}": _field(controller, f"desired_{a}_deg") for a in ANGLES},
        "controller.accelz": lambda: estimator.acc_g[2],
        "radio.rssi": lambda: -firmware.scenario.rssi_dbm,
        "radio.isConnected": lambda: 1.0,
        "kalman.inFlight": _field(supervisor, "is_flying"),
        "range.zrange": lambda: (  # a deck's
            1000.0 * max(0.0, firmware.world.z_m) if estimator.outside is None else 0.0
        ),
        "locSrvZ.tick": lambda: float(firmware.external_tick_ms),
    }


def _translation(firmware: Logged) -> dict[str, Getter]:
    """Position, velocity, acceleration, and the setpoint's."""
    estimator, now = firmware.estimator, firmware.estimator.now

    def flown(name: str) -> Getter:
        return lambda: float(getattr(firmware.flown_setpoint, name))

    def acc(axis: int) -> Getter:
        return lambda: estimator.acc_g[axis]

    def variance(state: int) -> Getter:
        return lambda: estimator.variance(firmware.t_s, state)

    getters: dict[str, Getter] = {}
    for i, axis in enumerate(AXES):
        position = _field(now, f"{axis}_m")
        velocity = _field(now, f"v{axis}_mps")
        getters |= {
            f"stateEstimate.{axis}": position,
            f"stateEstimate.v{axis}": velocity,
            f"kalman.state{axis.upper()}": position,
            f"kalman.stateP{axis.upper()}": velocity,
            f"stateEstimateZ.{axis}": _field(now, f"{axis}_m", 1000.0),
            f"stateEstimateZ.v{axis}": _field(now, f"v{axis}_mps", 1000.0),
            f"kalman.var{axis.upper()}": variance(POSITION + i),
            f"kalman.varP{axis.upper()}": variance(VELOCITY + i),
            f"kalman.varD{i}": variance(ATTITUDE + i),
            f"acc.{axis}": acc(i),
            f"gyro.{axis}": _field(now, f"gyro_{axis}_dps"),
            f"ctrltarget.{axis}": flown(f"{axis}_m"),
            f"ctrltarget.v{axis}": flown(f"v{axis}_mps"),
        }
    return getters


def _rotation(firmware: Logged) -> dict[str, Getter]:
    """Attitude, rates, and the setpoint's."""
    controller, now = firmware.controller, firmware.estimator.now

    def flown(name: str) -> Getter:
        return lambda: float(getattr(firmware.flown_setpoint, name))

    def output(i: int) -> Getter:
        return lambda: controller.outputs[i]

    def quaternion(i: int) -> Getter:
        return lambda: firmware.world.quaternion[i]

    getters: dict[str, Getter] = {}
    for i, (angle, axis, sign) in enumerate(zip(ANGLES, AXES, (1, -1, 1), strict=True)):
        value = _field(now, f"{angle}_deg")
        getters |= {
            f"stateEstimate.{angle}": value,
            f"stabilizer.{angle}": value,
            f"ctrltarget.{angle}": flown(f"{angle}_deg"),
            f"controller.cmd_{angle}": output(i),
            f"controller.r_{angle}": _field(now, f"gyro_{axis}_dps", math.radians(sign)),
        }
    for i, part in enumerate("wxyz"):
        getters[f"stateEstimate.q{part}"] = quaternion(i)
        getters[f"kalman.q{i}"] = quaternion(i)
    return getters


def _motors(firmware: Logged) -> dict[str, Getter]:
    """Duty cycles, after and before the cap."""

    def motor(i: int) -> Getter:
        return lambda: float(int(firmware.motors[i]))

    def request(i: int) -> Getter:
        return lambda: float(int(firmware.driver.requested[i]))

    getters = {f"motor.m{i + 1}": motor(i) for i in range(4)}
    return getters | {f"motor.m{i + 1}req": request(i) for i in range(4)}


def _health(health: Health) -> dict[str, Getter]:
    """The results of the firmware's own tests."""

    def variance(motor: int, axis: int) -> Getter:
        return lambda: health.variance[motor][axis]

    getters = {
        f"health.motorVar{'XY'[axis]}M{motor + 1}": variance(motor, axis)
        for motor in range(4)
        for axis in range(2)
    }
    return getters | {
        "health.motorPass": _field(health, "motor_pass"),
        "health.motorTestCount": _field(health, "motor_tests"),
        "health.batteryPass": _field(health, "battery_pass"),
        "health.batterySag": _field(health, "sag_v"),
    }
