"""A firmware in a world, and the few things tests do with it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from perchctl.sim import CONTROL_PERIOD_S, Scenario
from perchctl.sim.firmware import Firmware
from perchctl.sim.firmware.controller import MODE_POSITION, MODE_RAW, Setpoint
from perchctl.sim.firmware.planner import HighLevelPlanner
from perchctl.sim.world import World

STREAM_PERIOD_S = 0.02
PERFECT = {"estimate_noise_m": 0.0}


def at_height(z_m: float) -> Setpoint:
    """That of `send_position_setpoint(0, 0, z_m, 0)`."""
    return Setpoint(MODE_POSITION, z_m=z_m)


def raw_thrust(thrust: float) -> Setpoint:
    """That of `send_setpoint(0, 0, 0, thrust)`."""
    return Setpoint(MODE_RAW, thrust=float(thrust))


@dataclass
class Rig:
    world: World
    firmware: Firmware

    def run(self, seconds: float, stream: Setpoint | None = None) -> list[float]:
        """Advance, streaming a setpoint at 50 Hz; the true heights on the way."""
        heights = []
        every = round(STREAM_PERIOD_S / CONTROL_PERIOD_S)
        for i in range(round(seconds / CONTROL_PERIOD_S)):
            if stream is not None and i % every == 0:
                self.firmware.fly_setpoint(stream)
            self.firmware.step()
            heights.append(self.world.z_m)
        return heights

    @property
    def info(self) -> int:
        return self.firmware.supervisor_info

    @property
    def motors_off(self) -> bool:
        return max(self.firmware.motors) == 0.0

    def take_off(self, height_m: float = 0.8, settle_s: float = 2.5) -> None:
        self.firmware.command_planner(HighLevelPlanner.take_off, height_m, 2.5, None)
        self.run(2.5 + settle_s)

    def hold(self, seconds: float = 2.0, z_m: float = 0.8) -> None:
        self.run(seconds, at_height(z_m))


def make_rig(*, booted: bool = True, **conditions: Any) -> Rig:
    """A vehicle on the floor with a fresh battery, ready unless `booted` is false."""
    scenario = Scenario(**({"battery_rest_v": 4.2} | conditions))
    world = World(scenario)
    rig = Rig(world, Firmware(world, scenario))
    if booted:
        rig.run(0.3)
    return rig
