"""The firmware as one object: commands in, motors out, one control period a step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, ClassVar

from perchctl.sim.firmware.commands import HighLevelCommand, LowLevelCommand
from perchctl.sim.firmware.controller import Controller
from perchctl.sim.firmware.estimator import Estimator
from perchctl.sim.firmware.health import BATTERY, PROPELLERS, Health
from perchctl.sim.firmware.motors import MOTORS_OFF, MotorDriver
from perchctl.sim.firmware.outside import SETTINGS
from perchctl.sim.firmware.planner import Planner
from perchctl.sim.firmware.power import PowerMonitor
from perchctl.sim.firmware.setpoint import Decoder, Setpoint
from perchctl.sim.firmware.supervisor import EVERY as SUPERVISOR_EVERY
from perchctl.sim.firmware.supervisor import State, Supervisor
from perchctl.sim.firmware.toc import LOG_VARIABLES, PARAMETERS, Parameter
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario

if TYPE_CHECKING:
    from perchctl.sim.world import World
from collections.abc import Sequence
from operator import attrgetter
from typing import TYPE_CHECKING, Protocol

from perchctl.sim.firmware.covariance import ATTITUDE, POSITION, VELOCITY

if TYPE_CHECKING:
    from perchctl.sim.world import World


PLANNER_EVERY = 5  # 100 Hz
ESTIMATOR_KALMAN = 2

_MOTORS_STATES = (State.READY, State.FLYING, State.LANDED)


class Firmware:
    """A Crazyflie 2.1 as firmware release 2026.08 (CRTP protocol 12) behaves.

    Every behaviour is a fact of docs/firmware.md. `step` senses, estimates,
    supervises, controls, drives the motors and advances the world by
    `CONTROL_PERIOD_S`. Commands take effect in the next step.
    """

    LOG_VARIABLES: ClassVar[dict[str, str]] = LOG_VARIABLES
    PARAMETERS: ClassVar[dict[str, Parameter]] = PARAMETERS

    def __init__(self, world: World, scenario: Scenario) -> None:
        self.world = world
        self.scenario = scenario
        self._parameters = {name: p.default for name, p in PARAMETERS.items()}
        self.log_overrides: dict[str, float] = {}  # what a fault makes of log variables
        self._boot()

    def _boot(self) -> None:
        self._steps = 0
        self._flown = False
        self.motors = MOTORS_OFF
        self._null = Setpoint()
        self._setpoint = self._null
        self.flown_setpoint = self._null
        self._levelled_from = self._null
        self._levelled = self._null
        self._low_level = False
        self._decoder = Decoder()
        self.estimator = Estimator(self.scenario)
        self.external_tick_ms = 0
        self.planner = Planner()
        self.supervisor = Supervisor()
        self.controller = Controller()
        self.driver = MotorDriver()
        self.power = PowerMonitor(self.world.battery_v)
        self.health = Health(self.scenario)
        self._getters: dict[str, Callable[[], float]] = log_getters(self)
        self._pressed = False
        if self.scenario.extra.get("external_position"):
            self._parameters["deck.bcFlow2"] = 0.0  # outside positions instead of a deck
        self._parameters |= self.scenario.parameters
        for name in PARAMETERS:
            self._apply(name)

    @property
    def t_s(self) -> float:
        """Time since boot."""
        return self._steps * CONTROL_PERIOD_S

    def step(self) -> None:
        """One control period."""
        step = self._steps
        t_s = step * CONTROL_PERIOD_S
        supervisor = self.supervisor
        if self.health.testing:
            self._test(t_s)
            return
        self.estimator.update(
            self.world,
            t_s,
            flown=self._flown,
            spinning=self.motors is not MOTORS_OFF,
            flying=supervisor.is_flying,
            pressed=self._pressed,
        )
        if step % PLANNER_EVERY == 0:
            self._consult_planner(t_s)
            if self.estimator.outside is not None:
                self._pressed = self.world.contacts()[0] > 0.0
        if step % SUPERVISOR_EVERY == 0:
            ended = supervisor.update(
                t_s,
                motors_running=self.motors is not MOTORS_OFF and max(self.motors) > 0.0,
                setpoint_age_s=t_s - self._setpoint.stamp_s,
                acc_g=self.estimator.acc_g,
            )
            if ended:
                # The setpoint of a flight that is over must not fly the next one: after
                # re-arming only a new packet, or the planner, spins the motors.
                self._low_level = False
            self.planner.block(not supervisor.motors_allowed)
            self.power.update(t_s, self.world.battery_v, self._parameters)
        setpoint = self._setpoint
        state = supervisor.state
        if state is State.LEVEL_OUT:
            if self._levelled_from is not setpoint:
                self._levelled_from = setpoint
                self._levelled = setpoint.levelled()
            setpoint = self._levelled
        elif state not in _MOTORS_STATES:
            setpoint = self._null
        requests = self.controller.update(setpoint, self.estimator.now)
        if not supervisor.motors_allowed:
            requests = MOTORS_OFF
        motors = self.driver.pwm(requests, self.world.battery_v)
        if motors is not MOTORS_OFF:
            self._flown = True
        self.motors = motors
        self.flown_setpoint = setpoint
        self._steps = step + 1
        self.world.step(motors)

    def _test(self, t_s: float) -> None:
        """A control period of a health test, in which nothing else is heard (source)."""
        for name in (PROPELLERS, BATTERY):
            self._parameters[f"health.{name}"] = 0.0
        self.motors = self.health.pwm(
            self.world.powertrain.forces_n, self.world.battery_v, self._parameters
        )
        if self._steps % SUPERVISOR_EVERY == 0:
            self.power.update(t_s, self.world.battery_v, self._parameters)
        self._steps += 1
        self.world.step(self.motors)

    # Commands -----------------------------------------------------------------------

    def low_level(self, command: LowLevelCommand) -> None:
        """A setpoint packet; takes over from the high-level commander."""
        self._accept(self._decoder.decode(command))
        self._low_level = True
        self.planner.stop()

    def notify_setpoint_stop(self, remain_valid_s: float = 0.0) -> None:
        """Low-level setpoints end: the high-level commander may fly again.

        The firmware reads past `remain_valid_s`; so does this.
        """
        self._tell_planner()
        self._low_level = False

    def high_level(self, command: HighLevelCommand) -> None:
        """A high-level command; flown only when no low-level stream has priority."""
        self.planner.command(command, self.t_s)

    def emergency_stop(self) -> None:
        """Motors off and locked, within one supervisor update."""
        self.supervisor.emergency = True

    def emergency_stop_watchdog(self) -> None:
        """The first call starts the watchdog; a gap over 1 s then cuts and locks."""
        self.supervisor.notify_watchdog(self.t_s)

    def arm(self, do_arm: bool) -> tuple[bool, bool]:
        """(success, armed)."""
        success = self.supervisor.request_arming(do_arm)
        return success, self.supervisor.armed

    def recover_from_crash(self) -> tuple[bool, bool]:
        """(success, recovered); refused while still tumbled."""
        success = self.supervisor.request_recovery()
        return success, not self.supervisor.crashed

    def external_position(self, position_m: tuple[float, float, float]) -> None:
        """A position from outside, m; see `Estimator`."""
        self.external_tick_ms = int(1e3 * self.t_s) % 65536
        self.estimator.external_position(position_m)

    def external_pose(
        self,
        position_m: tuple[float, float, float],
        quaternion_xyzw: tuple[float, float, float, float],
    ) -> None:
        """A pose from outside: m, and body to world."""
        self.external_tick_ms = int(1e3 * self.t_s) % 65536
        x, y, z, w = quaternion_xyzw
        self.estimator.external_pose(position_m, (w, x, y, z))

    def reboot(self) -> None:
        """Everything but the world, the battery and persistent parameters starts again."""
        for name, parameter in PARAMETERS.items():
            if not parameter.persistent:
                self._parameters[name] = parameter.default
        self._boot()

    # What can be read ---------------------------------------------------------------

    @property
    def supervisor_info(self) -> int:
        """`supervisor.info`, uint16 (docs/firmware.md, "Supervisor")."""
        return self.supervisor.info(
            hl_active=self.planner.active, hl_finished=self.planner.finished(self.t_s)
        )

    def log_value(self, name: str) -> float:
        """A log variable in its own units (degrees, g, pitch nose up).

        Raises KeyError for an unknown name.
        """
        if name in self.log_overrides:
            return self.log_overrides[name]
        getter = self._getters.get(name)
        if getter is not None:
            return getter()
        if name not in LOG_VARIABLES:
            raise KeyError(name)
        return 0.0

    def log_values(self, names: Iterable[str]) -> dict[str, float]:
        """Those of a whole block. Errors as for one."""
        if self.log_overrides:
            return {name: self.log_value(name) for name in names}
        getters = self._getters
        return {
            name: getters[name]() if name in getters else self.log_value(name) for name in names
        }

    def get_parameter(self, name: str) -> float:
        """Raises KeyError for an unknown name."""
        return self._parameters[name]

    def set_parameter(self, name: str, value: float) -> None:
        """Raises KeyError for an unknown name, PermissionError for a read-only one."""
        if PARAMETERS[name].readonly:
            raise PermissionError(f"parameter {name} is read-only")
        self._parameters[name] = float(value)
        self._apply(name)

    # Inside -------------------------------------------------------------------------

    def _apply(self, name: str) -> None:
        value = self._parameters[name]
        if name == "kalman.resetEstimation":
            if value == 1.0:
                self.estimator.reset(self.t_s)
        elif name == "stabilizer.estimator":
            self.estimator.hears_outside = value == ESTIMATOR_KALMAN
        elif name in SETTINGS:
            self.estimator.set_outside(name, value)
        elif name in (f"health.{PROPELLERS}", f"health.{BATTERY}"):
            if value:
                self.health.start(name.removeprefix("health."))
        elif name == "stabilizer.stop":
            self.supervisor.emergency = self.supervisor.emergency or value != 0.0
        else:
            apply_parameter(self.controller, name, value)

    def _accept(self, setpoint: Setpoint) -> None:
        setpoint.stamp_s = self.t_s
        self._setpoint = setpoint

    def _consult_planner(self, t_s: float) -> None:
        planner = self.planner
        if planner.active or not self._low_level:
            setpoint = planner.setpoint(t_s)
            if not self._low_level:
                self._accept(setpoint)
        if not planner.active:
            self._tell_planner()

    def _tell_planner(self) -> None:
        now = self.estimator.now
        self.planner.tell_state(
            (now.x_m, now.y_m, now.z_m),
            (now.vx_mps, now.vy_mps, now.vz_mps),
            math.radians(now.yaw_deg),
        )


# --- Log variables: where each live one comes from. All others read 0 --------------------------


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


# --- Parameters that reach into the controller: the gains and limits of its loops --------------


_LOOPS = {
    "posCtlPid": {axis: axis for axis in ("x", "y", "z")},
    "velCtlPid": {axis: axis for axis in ("vx", "vy", "vz")},
    "pid_attitude": {f"{axis}_": axis for axis in ("roll", "pitch", "yaw")},
    "pid_rate": {f"{axis}_": f"{axis}_rate" for axis in ("roll", "pitch", "yaw")},
}
_GAINS = {
    f"{group}.{prefix}{gain if prefix.endswith('_') else gain.capitalize()}": (loop, gain)
    for group, loops in _LOOPS.items()
    for prefix, loop in loops.items()
    for gain in ("kp", "ki", "kd")
}
_LIMITS = {
    "posCtlPid.rLimit": "roll_max_deg",
    "posCtlPid.pLimit": "pitch_max_deg",
    "posCtlPid.xVelMax": "x_speed_max_mps",
    "posCtlPid.yVelMax": "y_speed_max_mps",
    "posCtlPid.zVelMax": "z_speed_max_mps",
    "posCtlPid.thrustBase": "thrust_base",
    "posCtlPid.thrustMin": "thrust_min",
}


def apply_parameter(controller: Controller, name: str, value: float) -> None:
    """Put a parameter's value where the controller uses it; others change nothing."""
    if name in _GAINS:
        loop, gain = _GAINS[name]
        setattr(getattr(controller, loop), gain, value)
    elif name in _LIMITS:
        setattr(controller, _LIMITS[name], value)
        controller.limits_changed()
