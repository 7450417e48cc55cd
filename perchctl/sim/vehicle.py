"""World, firmware, camera and motion capture as one simulated vehicle, advanced by simulated
time."""

from __future__ import annotations

from collections import deque

from perchctl.profile import TargetConfig
from perchctl.sim.camera import SimCamera
from perchctl.sim.capture.settings import CaptureSettings
from perchctl.sim.capture.system import SimCapture
from perchctl.sim.firmware import Firmware
from perchctl.sim.renderer import Renderer
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.sim.world import TrueState, World
from perchctl.vision.types import CameraModel


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
        self.camera: SimCamera | None = None
        if camera is not None:
            renderer = Renderer(scenario, camera, target or TargetConfig(), scenario.seed)
            self.camera = SimCamera(scenario, renderer)
        self.capture = None if capture is None else SimCapture(capture)
        # The past that an exposure may need.
        exposed_s = 0.0 if self.camera is None else self.camera.exposed_s
        steps = int(exposed_s / CONTROL_PERIOD_S) + 8
        self._past: deque[TrueState] = deque(maxlen=steps)

    @property
    def t_s(self) -> float:
        return self.firmware.t_s

    def advance_to(self, t_s: float) -> None:
        """Step until `t_s` (to the nearest control period)."""
        while self.firmware.t_s < t_s - CONTROL_PERIOD_S / 2:
            self.step()

    def step(self) -> None:
        """One control period, and the exposures that fall into it."""
        self.step_blindly()
        if self.camera is not None:
            self._past.append(self.world.state())
            self.camera.advance(self.firmware.t_s, self._state_at)

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

    def _state_at(self, t_s: float) -> TrueState:
        """The true state nearest to `t_s` in the recent past."""
        newest = self._past[-1]
        back = round((newest.t_s - t_s) / CONTROL_PERIOD_S)
        return self._past[max(-len(self._past), -1 - max(0, back))]
