"""A simulated vehicle without a camera, flown to a place and from there down by the lander."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from perchctl.geometry import GRAVITY_MPS2
from perchctl.link import MockLink
from perchctl.mission import Condition, Finding, Observation, Phase, PlannerState, lander, planner
from perchctl.mission.context import Context
from perchctl.perception import History, add_samples
from perchctl.profile import Profile
from perchctl.sim import REST_HEIGHT_M, SimulatedVehicle, draw_scenario
from perchctl.vehicle import ExternalPosition, Idle, PositionSetpoint, Telemetry

TICK_S = 0.02
SIGHT_EVERY = 2
SIGHT_SIGMA_M = 0.003
CLIMB_MPS = 0.4
LONGEST_S = 25.0


@dataclass
class Landed:
    """How a way down ended, by the simulator's truth."""

    finding: Finding | None
    hangs: bool
    down_mps: float
    aside_mps: float
    aside_m: float
    lasted_s: float
    deepest_m: float = 0.0
    commands: list[tuple[float, object]] = field(default_factory=list)


class Descent:
    """One vehicle. `climb` flies it up with positions, `down` lands it as `evidence` allows."""

    def __init__(
        self,
        profile: Profile,
        seed: int = 0,
        *,
        mass_kg: float = 0.042,
        hover_error: float = 0.0,
        **scenario: object,
    ) -> None:
        self.profile = profile
        drawn = draw_scenario(profile, seed)
        changed = {"mass_kg": mass_kg, "target_xy_m": (0.0, 0.0), **scenario}
        self.vehicle = SimulatedVehicle(replace(drawn, **changed))  # type: ignore[arg-type]
        self.world = self.vehicle.world
        self.link = MockLink(self.vehicle)
        self.history = History()
        self.rng = np.random.default_rng(seed)
        self.hover_error = hover_error
        self.delay_s = 0.0
        self._late: list[Telemetry] = []
        self.position_s = 0.0
        self.each: Callable[[float], None] = lambda t_s: None
        self.link.connect()
        self._stand()
        self.state = replace(planner.start_mission(self.observe()), phase=Phase.ALIGN)

    @property
    def now_s(self) -> float:
        return self.link.now_s

    def _stand(self) -> None:
        for _ in range(50):
            self._send_place()
            self._advance()

    def _send_place(self) -> None:
        world = self.world
        place_m = np.array([world.x_m, world.y_m, world.z_m - REST_HEIGHT_M])
        x, y, z = place_m + self.rng.normal(0.0, SIGHT_SIGMA_M, 3)
        self.link.external(ExternalPosition((float(x), float(y), float(z))))
        self.position_s = self.now_s

    def _advance(self) -> None:
        self.link.advance_to(self.now_s + TICK_S)
        self._late += self.link.telemetry()
        arrived = [s for s in self._late if s.t_s <= self.now_s - self.delay_s]
        self._late = self._late[len(arrived) :]
        self.history = add_samples(self.history, arrived, self.profile.safety)
        self.each(self.now_s)

    def observe(self) -> Observation:
        newest = self.history.newest
        assert newest is not None
        deck = self.profile.positioning.by == "deck"
        return Observation(
            t_s=self.now_s,
            telemetry=newest,
            jumped=self.history.jumped,
            turned_rad=self.history.turned_rad,
            position_age_s=0.0 if deck else self.now_s - self.position_s,
            imu=self.history.imu,
        )

    def climb(self, height_m: float, settle_s: float = 2.0) -> None:
        """Up to a height, and steady there, the hover thrust learned but for its error."""
        goal_m, thrusts = 0.0, []
        lasts_s = height_m / CLIMB_MPS + settle_s
        for i in range(round(lasts_s / TICK_S)):
            if i % SIGHT_EVERY == 0:
                self._send_place()
            goal_m = min(height_m, goal_m + CLIMB_MPS * TICK_S)
            setpoint = PositionSetpoint(0.0, 0.0, goal_m, 0.0)
            self.link.send(setpoint)
            self._advance()
            obs = self.observe()
            self.state = replace(
                lander.observed(self.state, obs, self.profile),
                setpoint=setpoint, t_s=obs.t_s, last=obs.telemetry,
            )  # fmt: skip
            if i * TICK_S > lasts_s - 1.0:
                thrusts.append(obs.telemetry.thrust)
        hover = float(np.mean(thrusts)) * (1.0 + self.hover_error)
        self.state = replace(self.state, hover_thrust=hover)

    def down(
        self, *, position: bool = False, change: Callable[[Observation], Observation] = lambda o: o
    ) -> Landed:
        """The way down to its end. `position`: positions go on being sent."""
        world, began_s = self.world, self.now_s
        x0, y0 = world.x_m, world.y_m
        landed = Landed(None, False, 0.0, 0.0, 0.0, 0.0)
        state: PlannerState = self.state
        while self.now_s < began_s + LONGEST_S:
            if position:
                self._send_place()
            obs = change(self.observe())
            state, command = lander.step_landing(state, obs, self.profile)
            landed.commands.append((obs.t_s, command))
            if not isinstance(command, Idle):
                self.link.send(command)
            c = Context(state, obs, self.profile)
            if c.held(Condition.DOWN) >= 0.5:
                landed.finding = lander.rest_finding(c)
                break
            down, aside = -world.vz_mps, math.hypot(world.vx_mps, world.vy_mps)
            was_up = not world.on_floor()
            self._advance()
            if was_up and world.on_floor() and landed.down_mps == 0.0:
                landed.down_mps, landed.aside_mps = down, aside
                landed.aside_m = math.hypot(world.x_m - x0, world.y_m - y0)
                landed.lasted_s = self.now_s - began_s
        self.state = state
        landed.hangs = bool(world.magnet_engaged)
        return landed

    def kick(self, x_mps: float = 0.0, y_mps: float = 0.0, z_mps: float = 0.0) -> None:
        """A blow of 40 ms that changes the speed by so much."""
        self.push((x_mps / 0.04, y_mps / 0.04, z_mps / 0.04), 0.04)

    def push(self, mps2: tuple[float, float, float], for_s: float) -> None:
        mass, end_s = self.vehicle.scenario.mass_kg, self.now_s + for_s
        x, y, z = mps2
        self.world.external_force_n = (mass * x, mass * y, mass * z)

        def leave(t_s: float) -> None:
            if t_s >= end_s - 1e-6:
                self.world.external_force_n = (0.0, 0.0, 0.0)

        self.each = leave

    def weight_mps2(self, share: float) -> float:
        return share * GRAVITY_MPS2
