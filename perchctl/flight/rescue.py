"""Land whatever still flies: the last resort of every error path."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from perchctl.flight.clock import Clock
from perchctl.link import Link, SentCallback, ignore_sent
from perchctl.mission import (
    Condition,
    Context,
    Finding,
    Observation,
    Operator,
    PlannerState,
    SentCommand,
    Touchdown,
    VisualInertialMotion,
    rest_finding,
    step_landing,
    touchdown_of,
)
from perchctl.perception import History, add_samples
from perchctl.profile import Profile
from perchctl.vehicle import Command, EmergencyStop, Idle


class Rescued(NamedTuple):
    """Where the vehicle is, and how it met the floor; None for what is not known."""

    finding: Finding | None = None
    touchdown: Touchdown | None = None


LOOK_S = 0.5
"""For so long a vehicle must be seen with its motors off before a rescue leaves it."""


def rescue(
    link: Link,
    clock: Clock,
    profile: Profile,
    operator: Callable[[], Operator],
    state: PlannerState | None,
    history: History,
    position_age_s: Callable[[float], float] = lambda now_s: 0.0,
    told: SentCallback = ignore_sent,
    felt: VisualInertialMotion | None = None,
) -> Rescued:
    """Fly the way down without the planner, the camera and the log, bounded by the landing's
    time. Returns where the vehicle is, once its motors have been seen off.

    `state` is the planner's last, None before its first tick; `history` the telemetry so far;
    `position_age_s` how old the newest position from outside is at a time. By the target none is
    sent any more. `told` is given what was sent; `felt` is the motion that pictures last agreed on.
    """

    def send(command: Command) -> None:
        with suppress(Exception):  # the link may be what failed: the next one goes out all the same
            link.send(command)
            told(SentCommand(clock.now(), "rescue", command))

    start_s, period_s = clock.now(), 1.0 / profile.link.loop_hz
    while (now_s := clock.now()) < start_s + profile.planner.landing.timeout_s:
        if operator() is Operator.STOP:
            send(EmergencyStop())  # the link's guard repeats it
            return Rescued()
        with suppress(Exception):
            history = add_samples(history, link.telemetry(), profile.safety)
        newest = history.newest
        if newest is not None:
            obs = Observation(
                t_s=now_s,
                telemetry=newest,
                link_problem=link.problem(now_s),
                jumped=history.jumped,
                turned_rad=history.turned_rad,
                position_age_s=(
                    math.inf if profile.positioning.by == "target" else position_age_s(now_s)
                ),
                imu=history.imu,
                felt=felt,
            )
            state, command = step_landing(state or _before_take_off(obs), obs, profile)
            if not isinstance(command, Idle):
                send(command)
            c = Context(state, obs, profile)
            if c.held(Condition.DOWN) >= LOOK_S:
                found = rest_finding(c)
                hangs = found in (Finding.HANGS, Finding.HELD)
                return Rescued(found, None if hangs else touchdown_of(c))
        clock.wait_until(now_s + period_s)
    return Rescued()


def _before_take_off(obs: Observation) -> PlannerState:
    """Where the planner's first tick was the one that failed."""
    position_m = obs.telemetry.position_m
    return PlannerState(t_s=obs.t_s, started_s=obs.t_s, ground_m=position_m, entry_m=position_m)
