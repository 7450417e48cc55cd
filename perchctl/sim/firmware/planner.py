"""The high-level commander, which flies 7th-order polynomials in x, y, z and yaw."""

from __future__ import annotations

import math
from typing import NamedTuple

from perchctl.geometry import wrap_rad
from perchctl.sim.firmware.controller import MODE_POSITION, Setpoint

TRAJECTORY_IDLE = 0
TRAJECTORY_FLYING = 1
TRAJECTORY_LANDING = 3
Place = tuple[float, float, float]


class AxisState(NamedTuple):
    """One axis at the start of a trajectory: value and two derivatives."""

    value: float
    rate: float = 0.0
    accel: float = 0.0


class Polynomial:
    """One axis of a trajectory from a state at t = 0 to rest at `goal` at t = T, without jerk at
    either end."""

    def __init__(self, start: AxisState, goal: float, duration_s: float) -> None:
        self.goal = goal
        self._duration = T = max(duration_s, 1e-9)
        # With u = t / T and the goal subtracted, eight boundary conditions determine eight
        # coefficients. The first four coefficients are the initial state itself (its jerk is zero).
        p, v, a = start.value - goal, start.rate * T, start.accel * T * T
        coefficients = (
            start.value,
            v,
            a / 2.0,
            0.0,
            -(35.0 * p + 20.0 * v + 5.0 * a),
            84.0 * p + 45.0 * v + 10.0 * a,
            -(70.0 * p + 36.0 * v + 7.5 * a),
            20.0 * p + 10.0 * v + 2.0 * a,
        )
        self._coefficients = tuple(c / T**i for i, c in enumerate(coefficients))

    def at(self, t_s: float) -> AxisState:
        if t_s >= self._duration:
            return AxisState(self.goal)
        value = rate = accel = 0.0
        for c in reversed(self._coefficients):
            accel = accel * t_s + 2.0 * rate
            rate = rate * t_s + value
            value = value * t_s + c
        return AxisState(value, rate, accel)


class HighLevelPlanner:
    """Plans trajectories, with the states idle, flying and landing, and provides setpoints at 100
    Hz."""

    def __init__(self) -> None:
        self.state = TRAJECTORY_IDLE
        self.blocked = False
        self._begin_s = 0.0
        self._duration_s = 0.0
        self._axes: tuple[Polynomial, ...] = ()
        self._now = [AxisState(0.0)] * 4  # state at which a new plan begins

    @property
    def active(self) -> bool:
        return self.state != TRAJECTORY_IDLE

    def finished(self, t_s: float) -> bool:
        """True if the plan's time is over, regardless of the height (docs/firmware.md, "Setpoint
        modes")."""
        return self.state == TRAJECTORY_IDLE or t_s - self._begin_s >= self._duration_s

    def stop(self, t_s: float = 0.0) -> None:
        """End the plan at once."""
        self.state = TRAJECTORY_IDLE

    def set_blocked(self, blocked: bool) -> None:
        """Forbid or allow the motors. While the motors are forbidden, plans end and new plans are
        refused."""
        if blocked and not self.blocked:
            self.stop()
        self.blocked = blocked

    def set_plan_start(self, position_m: Place, velocity_mps: Place, yaw_rad: float) -> None:
        """Set the state at which the next plan begins."""
        axes = zip(position_m, velocity_mps, strict=True)
        self._now = [*(AxisState(p, v) for p, v in axes), AxisState(yaw_rad)]

    def take_off(
        self,
        height_m: float,
        duration_s: float,
        yaw_rad: float | None,
        t_s: float,
        state: int = TRAJECTORY_FLYING,
    ) -> bool:
        """Plan a vertical flight to a height; False if refused. `yaw_rad`: None keeps the
        heading."""
        if self.blocked or self.state not in (
            (TRAJECTORY_IDLE, TRAJECTORY_FLYING)
            if state == TRAJECTORY_LANDING
            else (TRAJECTORY_IDLE,)
        ):
            return False
        x, y, z, yaw = (AxisState(axis.value) for axis in self._now)
        self._plan((x, y, z, yaw), (x.value, y.value, height_m), yaw_rad, duration_s, t_s)
        self.state = state
        return True

    def land(self, height_m: float, duration_s: float, yaw_rad: float | None, t_s: float) -> bool:
        """Plan a vertical flight, as `take_off` does; the motors stop when the plan ends."""
        return self.take_off(height_m, duration_s, yaw_rad, t_s, TRAJECTORY_LANDING)

    def go_to(
        self,
        x_m: float,
        y_m: float,
        z_m: float,
        yaw_rad: float,
        duration_s: float,
        relative: bool,
        t_s: float,
    ) -> None:
        """Plan a flight to a pose; `relative`: x, y, z, yaw are offsets, in world axes."""
        if self.blocked:
            return
        if self.active:
            self._now = [axis.at(t_s - self._begin_s) for axis in self._axes]
        x, y, z, yaw = self._now
        if relative:
            x_m, y_m, z_m = x.value + x_m, y.value + y_m, z.value + z_m
            yaw_rad += yaw.value
        start = (x, y, z, AxisState(yaw.value, yaw.rate))
        self._plan(start, (x_m, y_m, z_m), yaw_rad, duration_s, t_s)
        self.state = TRAJECTORY_FLYING

    def setpoint(self, t_s: float) -> Setpoint:
        """The plan's setpoint at `t_s`; while idle, a setpoint with the motors off."""
        if self.state == TRAJECTORY_LANDING and self.finished(t_s):
            self.state = TRAJECTORY_IDLE
        if self.state == TRAJECTORY_IDLE:
            return Setpoint()
        x, y, z, yaw = self._now = [axis.at(t_s - self._begin_s) for axis in self._axes]
        return Setpoint(
            MODE_POSITION,
            x.value,
            y.value,
            z.value,
            x.rate,
            y.rate,
            z.rate,
            yaw_deg=math.degrees(yaw.value),
            yaw_rate_dps=math.degrees(yaw.rate),
        )

    def _plan(
        self,
        start: tuple[AxisState, ...],
        place: Place,
        heading_rad: float | None,
        duration_s: float,
        t_s: float,
    ) -> None:
        *axes, yaw = start
        now_rad = wrap_rad(yaw.value)
        turn_rad = 0.0 if heading_rad is None else wrap_rad(heading_rad - now_rad)
        goal = (*place, now_rad + turn_rad)
        states = (*axes, AxisState(now_rad, yaw.rate))
        self._begin_s, self._duration_s = t_s, duration_s
        self._axes = tuple(
            Polynomial(state, end, duration_s) for state, end in zip(states, goal, strict=True)
        )
