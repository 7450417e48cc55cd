"""Flies planner or lander tick by tick through observations that a test makes up."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from perchctl.mission import Observation, PlannerState, planner
from perchctl.profile import Profile
from perchctl.vehicle import Command, PositionSetpoint, RawThrust, StopMotors
from tests.helpers.mission import HOVER_THRUST, PROFILE, Felt, observation, telemetry

TICK_S, BEGIN_S = 0.02, 10.0
Look = Callable[[float], Observation]
"""The observation at a time."""


def at(
    z_m: float = 1.0, *, age_s: float = 0.0, obs: dict[str, Any] | None = None, **tel: Any
) -> Look:
    """The vehicle at a height with its target in sight, by telemetry that is `age_s` old; with
    changes of the observation, and of the telemetry."""

    def look(t_s: float) -> Observation:
        sample = replace(telemetry(t_s - age_s, z_m), **tel)
        return observation(t_s, telemetry=sample, **(obs or {}))

    return look


@dataclass(frozen=True)
class Tick:
    """One tick of a flight: what was observed, and what the planner decided."""

    t_s: float
    obs: Observation
    state: PlannerState
    command: Command


@dataclass(frozen=True)
class Flight:
    """The ticks of a flight, in order."""

    ticks: list[Tick]

    @property
    def obs(self) -> Observation:
        return self.ticks[-1].obs

    @property
    def state(self) -> PlannerState:
        return self.ticks[-1].state

    @property
    def command(self) -> Command:
        return self.ticks[-1].command

    @property
    def commands(self) -> list[Command]:
        return [tick.command for tick in self.ticks]

    @property
    def rows(self) -> set[str]:
        return {tick.state.transition_name for tick in self.ticks}

    @property
    def stops_s(self) -> list[float]:
        """The times at which the motors were ordered to stop."""
        return [tick.t_s for tick in self.ticks if isinstance(tick.command, StopMotors)]

    @property
    def still_s(self) -> list[float]:
        """The times at which a raw thrust was sent on which the motors stand still."""
        return [
            tick.t_s
            for tick in self.ticks
            if isinstance(tick.command, RawThrust) and tick.command.thrust <= 5000
        ]


def times(lasts_s: float) -> Iterator[float]:
    """The times of the ticks."""
    for i in range(1, round(lasts_s / TICK_S) + 1):
        yield BEGIN_S + TICK_S * i


def fly(
    state: PlannerState,
    look: Look | Motors,
    lasts_s: float = TICK_S,
    profile: Profile = PROFILE,
    *,
    feels: Felt | bool = False,
    one_phase: bool = False,
) -> Flight:
    """Fly from `BEGIN_S` on until the time or the flight is over, or with `one_phase` the phase.

    `feels`: the observations carry what the accelerometer has integrated so far. A vehicle's
    `Motors` obey each command."""
    felt = feels if isinstance(feels, Felt) else Felt()
    begun, ticks = state.phase, []
    for t_s in times(lasts_s):
        obs = look.look(t_s, state) if isinstance(look, Motors) else look(t_s)
        obs = felt(obs) if feels else obs
        state, command = planner.step_mission(state, obs, profile)
        ticks.append(Tick(t_s, obs, state, command))
        if isinstance(look, Motors):
            look.obey(state, command)
        if state.phase.is_final or (one_phase and state.phase is not begun):
            break
    return Flight(ticks)


class Motors:
    """A vehicle whose motors do as ordered, and turn at `held_part` of the hover thrust on a
    setpoint, since something holds it."""

    held_part = 0.34

    def __init__(self, thrust: float = 0.34 * HOVER_THRUST) -> None:
        self.thrust = thrust

    def look(self, t_s: float, state: PlannerState) -> Observation:
        """The observation of the vehicle at a time, flown by a planner in that state."""
        raise NotImplementedError

    def obey(self, state: PlannerState, command: Command) -> None:
        """Take over the thrust of a command."""
        match command:
            case RawThrust(order):
                self.thrust = 0.0 if order < 5000 else float(order)
            case StopMotors():
                self.thrust = 0.0
            case PositionSetpoint():
                self.thrust = self.held_part * HOVER_THRUST


def is_setpoint(
    command: object, above_m: float = -math.inf, distance_below_m: float = math.inf
) -> bool:
    """True if it is a position setpoint between two heights."""
    return isinstance(command, PositionSetpoint) and above_m < command.z_m < distance_below_m
