"""One simulated vehicle: world, firmware, camera and motion capture, advanced in simulated time."""

from __future__ import annotations

from collections import deque

from perchctl.geometry import Array, make_T, rotation_from_quaternion
from perchctl.link import Packet
from perchctl.profile import TargetConfig
from perchctl.sim.camera import SimCamera
from perchctl.sim.capture import CaptureSettings, SimCapture
from perchctl.sim.crtp import execute_packet
from perchctl.sim.firmware import Firmware
from perchctl.sim.renderer import Renderer
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.sim.world import Vector, World
from perchctl.vision import CameraModel

_PAST = 128  # control periods: longer than any exposure with its read-out


class SimulatedVehicle:
    """One simulated Crazyflie.

    The vehicle has a camera only if a camera model is given, and motion capture only if capture
    settings are given.
    """

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
            renderer = Renderer(scenario, camera, target or TargetConfig())
            self.camera = SimCamera(scenario, renderer)
        self.capture = None if capture is None else SimCapture(capture)
        self.watched = (
            True  # True if the camera's images are used; otherwise no images are rendered
        )
        self._past: deque[tuple[Vector, tuple[float, float, float, float]]] = deque(maxlen=_PAST)

    @property
    def t_s(self) -> float:
        """Simulated time since the start. A reboot does not reset it."""
        return self.world.t_s

    def advance_to(self, t_s: float) -> None:
        """Step until `t_s` (to the nearest control period)."""
        while self.world.t_s < t_s - CONTROL_PERIOD_S / 2:
            self.step()

    def receive(self, packet: Packet) -> None:
        """Receive a packet from the radio."""
        execute_packet(self.firmware, packet)

    def step(self) -> None:
        """Advance by one control period, and take the exposures within it."""
        self.firmware.step()
        world = self.world
        if self.capture is not None:
            self.capture.advance(world)
        if self.camera is not None and self.watched:
            self._past.append(((world.x_m, world.y_m, world.z_m), world.quaternion))
            self.camera.advance(world.t_s, self._pose_at)

    def move_target(self, xy_m: tuple[float, float]) -> None:
        """Move the target and its magnet."""
        self.world.magnet.target_xy_m = xy_m
        if self.camera is not None:
            self.camera.renderer.move_target(xy_m)

    def _pose_at(self, t_s: float) -> Array:
        """Return T_world_body (4, 4) at a time shortly before now."""
        back = max(0, round((self.t_s - t_s) / CONTROL_PERIOD_S))
        place_m, quaternion = self._past[max(-len(self._past), -1 - back)]
        return make_T(rotation_from_quaternion(quaternion), place_m)
