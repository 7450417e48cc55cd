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

    __slots__ = ("_coefficients", "_duration", "goal")

    def __init__(self, start: AxisState, goal: float, duration_s: float) -> None:
        self.goal = goal
        self._duration = duration_s
        if duration_s <= 0.0:
            self._coefficients: tuple[float, ...] = (goal,)
            return
        T = duration_s
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
        self._now = [AxisState(0.0)] * 4
        self._start: tuple[Place, Place, float] | None = None  # since, unless a plan was flown

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

    def start_from(
        self,
        position_m: tuple[float, float, float],
        velocity_mps: tuple[float, float, float],
        yaw_rad: float,
    ) -> None:
        """Let new plans begin here."""
        self._start = (position_m, velocity_mps, yaw_rad)

    def _begin(self) -> list[AxisState]:
        """Return where a new plan begins: the last setpoint, or the estimate while idle."""
        if self._start is not None:
            position_m, velocity_mps, yaw_rad = self._start
            axes = zip(position_m, velocity_mps, strict=True)
            self._now = [*(AxisState(p, v) for p, v in axes), AxisState(yaw_rad)]
            self._start = None
        return self._now

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
        self._vertical(command, t_s)
        self.state = LANDING if landing else FLYING
        return True

    def setpoint(self, t_s: float) -> Setpoint:
        """Return the setpoint at t; a null one (motors off) while idle."""
        if self.state == LANDING and self.finished(t_s):
            self.state = IDLE
        if self.state == IDLE:
            return Setpoint()
        x, y, z, yaw = self._now = [axis.at(t_s - self._begin_s) for axis in self._axes]
        self._start = None
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

    def _vertical(self, command: HlTakeoff, t_s: float) -> None:
        x, y, z, yaw = self._begin()
        heading = wrap_rad(yaw.value)
        turn = 0.0 if command.yaw_rad is None else wrap_rad(command.yaw_rad - heading)
        self._plan(
            (AxisState(x.value), AxisState(y.value), AxisState(z.value), AxisState(heading)),
            (x.value, y.value, command.height_m, heading + turn),
            command.duration_s,
            t_s,
        )

    def _go_to(self, command: HlGoTo, t_s: float) -> None:
        if self.active:
            self._now, self._start = [axis.at(t_s - self._begin_s) for axis in self._axes], None
        x, y, z, yaw = self._begin()
        goal = (command.x_m, command.y_m, command.z_m, command.yaw_rad)
        if command.relative:
            goal = (x.value + goal[0], y.value + goal[1], z.value + goal[2], yaw.value + goal[3])
        heading = wrap_rad(yaw.value)
        self._plan(
            (x, y, z, AxisState(heading, yaw.rate)),
            (*goal[:3], heading + wrap_rad(goal[3] - heading)),
            command.duration_s,
            t_s,
        )
        self.state = FLYING

    def _plan(
        self,
        start: tuple[AxisState, ...],
        goal: tuple[float, ...],
        duration_s: float,
        t_s: float,
    ) -> None:
        self._axes = tuple(Polynomial(s, g, duration_s) for s, g in zip(start, goal, strict=True))
        self._begin_s = t_s
        self._duration_s = duration_s
