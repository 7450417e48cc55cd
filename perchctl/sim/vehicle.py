"""World, firmware, camera and motion capture as one simulated vehicle, advanced by simulated
time."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from perchctl.geometry import Array, rotation_from_quaternion
from perchctl.link import Packet
from perchctl.profile import TargetConfig
from perchctl.sim.camera import SimCamera
from perchctl.sim.capture.settings import CaptureSettings
from perchctl.sim.capture.system import SimCapture
from perchctl.sim.crtp.commands import CommandService
from perchctl.sim.crtp.server import PROTOCOL_VERSION
from perchctl.sim.firmware import Firmware
from perchctl.sim.renderer import Renderer
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.sim.world import World
from perchctl.vision import CameraModel

_TICK_S = 1e-6  # less than a control period: an exposure is never passed over


class PastPose(NamedTuple):
    """Where the vehicle was, kept 500 times a second: arrays only for what an exposure asks."""

    t_s: float
    place_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]

    @property
    def position_m(self) -> Array:
        return np.array(self.place_m)

    @property
    def R_world_body(self) -> Array:
        return rotation_from_quaternion(self.quaternion)


class SimulatedVehicle:
    """One simulated Crazyflie. Without a camera model it has no camera, without a capture's
    settings nobody measures it from outside."""

    def __init__(
        self,
        scenario: Scenario,
        camera: CameraModel | None = None,
        target: TargetConfig | None = None,
        capture: CaptureSettings | None = None,
    ) -> None:
        self.scenario = scenario
        self.world = World(scenario)
        self.firmware = Firmware(self.world, scenario)
        self._commands = CommandService(self.firmware, PROTOCOL_VERSION)
        self.camera: SimCamera | None = None
        if camera is not None:
            renderer = Renderer(scenario, camera, target or TargetConfig(), scenario.seed)
            self.camera = SimCamera(scenario, renderer)
        self.capture = None if capture is None else SimCapture(capture)
        self.watched = True  # somebody takes the camera's pictures; no others are made
        # The past that an exposure may need.
        exposed_s = 0.0 if self.camera is None else self.camera.exposed_s
        steps = int(exposed_s / CONTROL_PERIOD_S) + 8
        self._past: deque[PastPose] = deque(maxlen=steps)

    @property
    def t_s(self) -> float:
        """Simulated time since the start; unlike the firmware's, no reboot resets it."""
        return self.world.t_s

    def advance_to(self, t_s: float) -> None:
        """Step until `t_s` (to the nearest control period)."""
        end_s = t_s - CONTROL_PERIOD_S / 2
        if self.camera is None or not self.watched:
            while self.world.t_s < end_s:
                self.step_blindly()
            return
        exposed_s = self.camera.exposed_s + 2.0 * CONTROL_PERIOD_S
        due_s, t_s = self.camera.next_s - _TICK_S, self.world.t_s
        while t_s < end_s:
            self.step_blindly()
            t_s = self.world.t_s
            if t_s >= due_s - exposed_s:
                self._remember()
                if t_s >= due_s:
                    self.camera.advance(t_s, self._state_at)
                    due_s = self.camera.next_s - _TICK_S
        self.camera.advance(t_s, self._state_at)

    def receive(self, packet: Packet) -> None:
        """Take a packet as it comes from the radio."""
        self._commands.handle(packet)

    def step(self) -> None:
        """One control period, and the exposures that fall into it."""
        self.step_blindly()
        if self.camera is not None and self.watched:
            self._remember()
            self.camera.advance(self.world.t_s, self._state_at)

    def step_blindly(self) -> None:
        """One control period without the camera, which somebody else exposes."""
        self.firmware.step()
        if self.capture is not None:
            self.capture.advance(self.world)

    def move_target(self, xy_m: tuple[float, float]) -> None:
        """The target and its magnet hang there from now on."""
        self.world.magnet.target_xy_m = xy_m
        if self.camera is not None:
            self.camera.develop()
            self.camera.renderer.move_target(xy_m)

    def _remember(self) -> None:
        world = self.world
        place_m = (world.x_m, world.y_m, world.z_m)
        self._past.append(PastPose(world.t_s, place_m, world.quaternion))

    def _state_at(self, t_s: float) -> PastPose:
        """The pose nearest to `t_s` in the recent past."""
        newest = self._past[-1]
        back = round((newest.t_s - t_s) / CONTROL_PERIOD_S)
        return self._past[max(-len(self._past), -1 - max(0, back))]
