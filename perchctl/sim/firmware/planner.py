"""The high-level commander: 7th-order polynomials in x, y, z and yaw, run by the clock."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from perchctl.geometry import wrap_rad
from perchctl.sim.firmware.controller import MODE_POSITION, Setpoint

IDLE, FLYING, LANDING = 0, 1, 3
Place = tuple[float, float, float]


@dataclass(frozen=True)
class HlTakeoff:
    """Absolute height; `yaw_rad` None keeps the current heading."""

    height_m: float
    duration_s: float
    yaw_rad: float | None = None


@dataclass(frozen=True)
class HlLand(HlTakeoff):
    """As a take-off, and the plan ends with the motors off."""


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
    """The plan ends at once, and the motors stop."""


HighLevelCommand = HlTakeoff | HlGoTo | HlStop


class AxisState(NamedTuple):
    """One axis at the start of a trajectory: value and two derivatives."""

    value: float
    rate: float = 0.0
    accel: float = 0.0


class Polynomial:
    """From a state at t = 0 to rest at `goal` at t = T; no jerk at either end."""

    def __init__(self, start: AxisState, goal: float, duration_s: float) -> None:
        self.goal = goal
        self._duration = T = max(duration_s, 1e-9)
        # In u = t / T with the goal subtracted, eight end conditions fix eight
        # coefficients; the first four are the start itself (its jerk is zero).
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


class Planner:
    """States idle, flying, landing; setpoints for the commander at 100 Hz."""

    def __init__(self) -> None:
        self.state = IDLE
        self.blocked = False
        self._begin_s = 0.0
        self._duration_s = 0.0
        self._axes: tuple[Polynomial, ...] = ()
        self._now = [AxisState(0.0)] * 4  # where a new plan begins

    @property
    def active(self) -> bool:
        return self.state != IDLE

    def finished(self, t_s: float) -> bool:
        """True if the plan is over: by the clock, not by height (docs/firmware.md, "Setpoint
        modes")."""
        return self.state == IDLE or t_s - self._begin_s >= self._duration_s

    def stop(self) -> None:
        self.state = IDLE

    def block(self, blocked: bool) -> None:
        """Forbid or allow motors. While forbidden, plans end and new ones are refused."""
        if blocked and not self.blocked:
            self.stop()
        self.blocked = blocked

    def start_from(self, position_m: Place, velocity_mps: Place, yaw_rad: float) -> None:
        """Let the next plan begin here, unless a setpoint is planned before."""
        axes = zip(position_m, velocity_mps, strict=True)
        self._now = [*(AxisState(p, v) for p, v in axes), AxisState(yaw_rad)]

    def command(self, command: HighLevelCommand, t_s: float) -> bool:
        """Accept or refuse a command."""
        if isinstance(command, HlStop):
            self.stop()
            return True
        if self.blocked:
            return False
        if isinstance(command, HlGoTo):
            self._go_to(command, t_s)
            return True
        landing = isinstance(command, HlLand)
        if (self.state == LANDING) if landing else (self.state != IDLE):
            return False
        x, y, z, yaw = (AxisState(axis.value) for axis in self._now)
        place = (x.value, y.value, command.height_m)
        self._plan((x, y, z, yaw), place, command.yaw_rad, command, t_s)
        self.state = LANDING if landing else FLYING
        return True

    def setpoint(self, t_s: float) -> Setpoint:
        """Return the setpoint at t; a null one (motors off) while idle."""
        if self.state == LANDING and self.finished(t_s):
            self.state = IDLE
        if self.state == IDLE:
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

    def _go_to(self, command: HlGoTo, t_s: float) -> None:
        if self.active:
            self._now = [axis.at(t_s - self._begin_s) for axis in self._axes]
        x, y, z, yaw = self._now
        place, heading = (command.x_m, command.y_m, command.z_m), command.yaw_rad
        if command.relative:
            place = (x.value + place[0], y.value + place[1], z.value + place[2])
            heading += yaw.value
        self._plan((x, y, z, AxisState(yaw.value, yaw.rate)), place, heading, command, t_s)
        self.state = FLYING

    def _plan(
        self,
        start: tuple[AxisState, ...],
        place: Place,
        heading_rad: float | None,
        command: HlTakeoff | HlGoTo,
        t_s: float,
    ) -> None:
        """Plan the way to a place; the heading turns the short way round, None keeps it."""
        *axes, yaw = start
        now_rad = wrap_rad(yaw.value)
        turn_rad = 0.0 if heading_rad is None else wrap_rad(heading_rad - now_rad)
        goal = (*place, now_rad + turn_rad)
        states = (*axes, AxisState(now_rad, yaw.rate))
        self._begin_s, self._duration_s = t_s, command.duration_s
        self._axes = tuple(
            Polynomial(state, end, command.duration_s)
            for state, end in zip(states, goal, strict=True)
        )
