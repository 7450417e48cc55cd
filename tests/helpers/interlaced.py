"""A simulated camera that passes under the target: its frames, and where the target truly was."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from perchctl.geometry import Array, invert_T, make_T, rotation_from_rpy
from perchctl.profile import TargetConfig
from perchctl.sim import CONTROL_PERIOD_S, Renderer, Scenario
from perchctl.sim.camera import SimCamera
from perchctl.vision import Frame
from tests.helpers.target_picture import CAMERA


class Pass:
    """A camera `below_m` under the target, moving and turning evenly; PAL unless told
    otherwise. Its frames have their true middle moment for a time."""

    def __init__(
        self,
        below_m: float = 0.3,
        velocity_mps: tuple[float, float, float] = (0.2, 0.1, 0.05),
        turn_radps: float = 0.5,
        **scenario: Any,
    ) -> None:
        values: dict[str, Any] = {
            "seed": 4, "camera_rate_hz": 25.0, "camera_jitter_s": 0.0,
            "T_body_cam_true": tuple(map(tuple, np.eye(4))),
        }  # fmt: skip
        self.scenario = Scenario(**(values | scenario))
        self._below_m, self._velocity, self._turn = below_m, np.array(velocity_mps), turn_radps
        self._renderer = Renderer(self.scenario, CAMERA, TargetConfig())

    def T_world_cam(self, t_s: float) -> Array:
        since_s = t_s - 0.25
        start = np.array([0.01, 0.0, self.scenario.ceiling_z_m - self._below_m])
        R = rotation_from_rpy(0.03, 0.02, 0.3 + self._turn * since_s)
        return make_T(R, start + self._velocity * since_s)

    def target_m(self, t_s: float) -> Array:
        """The target in the camera's frame."""
        T = invert_T(self.T_world_cam(t_s)) @ self._renderer.T_world_target
        return np.asarray(T[:3, 3])

    def frames(self, count: int) -> Iterator[Frame]:
        camera = SimCamera(self.scenario, self._renderer)
        step = given = 0
        while given < count:
            step += 1
            camera.advance(step * CONTROL_PERIOD_S, self.T_world_cam)
            for frame in camera.take():
                given += 1
                yield Frame(frame.index, frame.t_exposure_s, frame.image, frame.t_arrival_s)
