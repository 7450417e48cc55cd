"""The firmware as one object: it takes commands, drives the motors, and advances by control
periods."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

from perchctl.sim.firmware.controller import MODE_RAW, MOTORS_OFF, Controller, MotorDriver, Setpoint
from perchctl.sim.firmware.estimator import Estimator
from perchctl.sim.firmware.outside import Quaternion, Vector
from perchctl.sim.firmware.planner import HighLevelPlanner
from perchctl.sim.firmware.supervisor import EVERY as SUPERVISOR_EVERY
from perchctl.sim.firmware.supervisor import State, Supervisor
from perchctl.sim.firmware.variables import LOG_VARIABLES, PARAMETERS, LogVariable, Parameter
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.vehicle import LOW_POWER

if TYPE_CHECKING:
    from perchctl.sim.world import World

PLANNER_EVERY = 5  # 100 Hz
RAW_THRUST_MIN, RAW_THRUST_MAX = 1000.0, 60000.0
LOW_DELAY_S = 5.0
_BATTERY_FILTER = 0.2  # at 25 Hz

_NULL = Setpoint()


class Firmware:
    """Behaves like a Crazyflie 2.1, or the scenario's airframe, with firmware release 2026.08 (CRTP
    protocol 12).

    docs/firmware.md describes each behaviour and the evidence for it. `step` senses, estimates,
    supervises, controls, drives the motors and advances the world by `CONTROL_PERIOD_S`. Commands
    take effect in the next step.
    """

    LOG_VARIABLES: ClassVar[dict[str, LogVariable]] = LOG_VARIABLES
    PARAMETERS: ClassVar[dict[str, Parameter]] = PARAMETERS

    def __init__(self, world: World, scenario: Scenario) -> None:
        self.world = world
        self.scenario = scenario
        self.log_overrides: dict[str, float] = {}  # set by a fault
        self.reboot()

    def reboot(self) -> None:
        """Restart in the current world, with the default parameters."""
        self._parameters = {name: p.default for name, p in PARAMETERS.items()}
        self._steps = 0
        self._flown = False
        self.motors = MOTORS_OFF
        self._setpoint = _NULL
        self._setpoint_s = 0.0
        self._low_level = False
        self._thrust_locked = True
        self.estimator = Estimator(self.scenario, self._parameters)
        self.planner = HighLevelPlanner()
        airframe = self.scenario.airframe
        self._idle_pwm = airframe.idle_pwm
        self.supervisor = Supervisor(arms_itself=airframe.arms_itself, spin_up_s=airframe.spin_up_s)
        self.controller = Controller(airframe.thrust_base, airframe.rate_gains)
        self.driver = MotorDriver(airframe.thrust)
        self.supply_v, self.power_state, self._fine_s = self.world.battery_v, 0, 0.0
        self._pressed = False
        if self.scenario.extra.get("external_position"):
            self._parameters["deck.bcFlow2"] = 0.0  # external positions
        self._parameters |= self.scenario.airframe.parameters | self.scenario.parameters
        self.supervisor.emergency = bool(self._parameters["stabilizer.stop"])
        self.estimator.reset(0.0)

    @property
    def t_s(self) -> float:
        """Time since boot."""
        return self._steps * CONTROL_PERIOD_S

    def step(self) -> None:
        """Advance by one control period."""
        step = self._steps
        t_s = step * CONTROL_PERIOD_S
        supervisor = self.supervisor
        self.estimator.update(
            self.world,
            has_flown=self._flown,
            spinning=self.motors is not MOTORS_OFF,
            flying=supervisor.is_flying,
            pressed=self._pressed,
        )
        if step % PLANNER_EVERY == 0:
            self._consult_planner(t_s)
            if self.estimator.outside is not None:
                self._pressed = self.world.push_n_and_on_floor()[0] > 0.0
        if step % SUPERVISOR_EVERY == 0:
            ended = supervisor.update(
                t_s,
                motors_running=self.motors is not MOTORS_OFF and max(self.motors) > self._idle_pwm,
                setpoint_age_s=t_s - self._setpoint_s,
                acc_g=self.estimator.acc_g,
            )
            if ended:
                # A setpoint from a finished flight must not affect the next one. After re-arming,
                # only a new packet or the planner can spin the motors.
                self._low_level = False
            self.planner.set_blocked(not supervisor.motors_allowed)
            self._watch_battery(t_s)
        setpoint = self._setpoint if supervisor.motors_allowed else _NULL
        if supervisor.state is State.LEVEL_OUT:
            setpoint = setpoint.level_setpoint()
        requests = self.controller.update(setpoint, self.estimator.now)
        if not supervisor.motors_allowed:
            requests = MOTORS_OFF
        motors = self.driver.pwm(requests, self.world.battery_v)
        if motors is not MOTORS_OFF:
            self._flown = True
        if self._idle_pwm and supervisor.motors_allowed:
            m1, m2, m3, m4 = (max(self._idle_pwm, duty) for duty in motors)
            motors = (m1, m2, m3, m4)
        self.motors = motors
        self._steps = step + 1
        self.world.step(motors)

    # Commands -----------------------------------------------------------------------

    def fly_setpoint(self, setpoint: Setpoint) -> None:
        """Fly this setpoint, which overrides the high-level commander.

        Raw thrust is limited. After boot, raw thrust is locked at 0 until a packet with thrust 0
        arrives (docs/firmware.md, "Raw thrust").
        """
        if setpoint.mode == MODE_RAW:
            thrust = min(setpoint.thrust, RAW_THRUST_MAX)
            if thrust == 0.0:
                self._thrust_locked = False
            if self._thrust_locked or thrust < RAW_THRUST_MIN:
                thrust = 0.0
            setpoint = replace(setpoint, thrust=thrust)
        self._setpoint, self._setpoint_s = setpoint, self.t_s
        self._low_level = True
        self.planner.stop()

    def notify_setpoint_stop(self) -> None:
        """End the low-level setpoints, so that the high-level commander can fly again."""
        self._inform_planner()
        self._low_level = False

    def command_planner(self, method: Callable[..., object], *values: Any) -> None:
        """Call a method of `HighLevelPlanner`; low-level setpoints have priority."""
        method(self.planner, *values, self.t_s)

    def emergency_stop(self) -> None:
        """Stop the motors and lock, within one supervisor update."""
        self.supervisor.emergency = True

    def take_external(self, position_m: Vector, quaternion: Quaternion | None = None) -> None:
        """Receive an external position, m, or a pose; `quaternion`: w, x, y, z, body to world."""
        self.estimator.take_external(position_m, quaternion)

    # Readable values ----------------------------------------------------------------

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
        return LOG_VARIABLES[name].read(self)

    def get_parameter(self, name: str) -> float:
        """The value of a parameter. Raises KeyError for an unknown name."""
        return self._parameters[name]

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter of `PARAMETERS`."""
        self._parameters[name] = float(value)
        if name == "kalman.resetEstimation" and value == 1.0:
            self.estimator.reset(self.t_s)

    # Inside -------------------------------------------------------------------------

    def _consult_planner(self, t_s: float) -> None:
        planner = self.planner
        if planner.active or not self._low_level:
            setpoint = planner.setpoint(t_s)
            if not self._low_level:
                self._setpoint, self._setpoint_s = setpoint, t_s
        if not planner.active:
            self._inform_planner()

    def _inform_planner(self) -> None:
        now = self.estimator.now
        self.planner.set_plan_start(
            (now.x_m, now.y_m, now.z_m),
            (now.vx_mps, now.vy_mps, now.vz_mps),
            math.radians(now.yaw_deg),
        )

    def _watch_battery(self, t_s: float) -> None:
        """Report low power below `pm.lowVoltage` for 5 s (docs/firmware.md, "Link")."""
        self.supply_v += _BATTERY_FILTER * (self.world.battery_v - self.supply_v)
        if self.supply_v >= self._parameters["pm.lowVoltage"]:
            self._fine_s = t_s
        self.power_state = LOW_POWER if t_s - self._fine_s > LOW_DELAY_S else 0
