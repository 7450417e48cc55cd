"""World, firmware, camera and motion capture as one simulated vehicle, advanced by simulated
time."""

from __future__ import annotations

from collections import deque

from perchctl.geometry import Array, make_T, rotation_from_quaternion
from perchctl.link import Packet
from perchctl.profile import TargetConfig
from perchctl.sim.camera import SimCamera
from perchctl.sim.capture import CaptureSettings, SimCapture
from perchctl.sim.crtp import CommandService
from perchctl.sim.firmware import Firmware
from perchctl.sim.renderer import Renderer
from perchctl.sim.scenario import CONTROL_PERIOD_S, Scenario
from perchctl.sim.world import World
from perchctl.vision import CameraModel

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class PastPoses:
    """Where a vehicle was within the last `kept_s`, 500 times a second; called with a time it
    gives the nearest T_world_body (4, 4)."""

    def __init__(self, kept_s: float) -> None:
        self._poses: deque[tuple[float, Vector, Quaternion]] = deque(
            maxlen=int(kept_s / CONTROL_PERIOD_S) + 8
        )

    def add(self, world: World) -> None:
        """Add the pose of now."""
        self._poses.append((world.t_s, (world.x_m, world.y_m, world.z_m), world.quaternion))

    @property
    def newest_s(self) -> float:
        """The time of the last pose."""
        return self._poses[-1][0]

    def __call__(self, t_s: float) -> Array:
        back = round((self.newest_s - t_s) / CONTROL_PERIOD_S)
        _, place_m, quaternion = self._poses[max(-len(self._poses), -1 - max(0, back))]
        return make_T(rotation_from_quaternion(quaternion), place_m)


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
        self._commands = CommandService(self.firmware)
        self.camera: SimCamera | None = None
        if camera is not None:
            renderer = Renderer(scenario, camera, target or TargetConfig(), scenario.seed)
            self.camera = SimCamera(scenario, renderer)
        self.capture = None if capture is None else SimCapture(capture)
        self.watched = True  # somebody takes the camera's pictures; no others are made
        # The past that an exposure may need.
        self._past = PastPoses(0.0 if self.camera is None else self.camera.exposed_s)

    @property
    def t_s(self) -> float:
        """Simulated time since the start; unlike the firmware's, no reboot resets it."""
        return self.world.t_s

    def advance_to(self, t_s: float) -> None:
        """Step until `t_s` (to the nearest control period)."""
        while self.world.t_s < t_s - CONTROL_PERIOD_S / 2:
            self.step()

    def receive(self, packet: Packet) -> None:
        """Take a packet as it comes from the radio."""
        self._commands.handle(packet)

    def step(self) -> None:
        """Advance by one control period, with the exposures that fall into it."""
        self.firmware.step()
        if self.capture is not None:
            self.capture.advance(self.world)
        if self.camera is not None and self.watched:
            self._past.add(self.world)
            self.camera.advance(self.world.t_s, self._past)

    def move_target(self, xy_m: tuple[float, float]) -> None:
        """Move the target and its magnet."""
        self.world.magnet.target_xy_m = xy_m
        if self.camera is not None:
            self.camera.renderer.move_target(xy_m)
