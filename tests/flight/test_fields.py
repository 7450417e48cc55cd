"""The flight loop under an interlaced camera: each field with the attitude of its own time."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from perchctl.flight import FlightInputs
from perchctl.geometry import rpy_from_rotation
from perchctl.link import Link
from perchctl.perception import perception
from perchctl.profile import Profile
from perchctl.vehicle import Telemetry
from perchctl.vision import Frame, make_pipeline
from tests.helpers.interlaced import Pass
from tests.helpers.mission import telemetry
from tests.helpers.target_picture import CAMERA

PERIOD_S = 0.01
PROFILE = Profile.model_validate(
    {"camera": {"mount": {"position_m": [0, 0, 0]}}, "vehicle": {"gear_body_m": [0, 0, 0]}}
)


class Vehicle:
    """Its telemetry is the truth, every 10 ms."""

    def __init__(self, scene: Pass) -> None:
        self._scene, self._next_s, self.now_s = scene, 0.0, 0.0

    def telemetry(self) -> list[Telemetry]:
        new = []
        while self._next_s <= self.now_s:
            T = self._scene.T_world_cam(self._next_s)
            x, y, z = (float(v) for v in T[:3, 3])
            roll, pitch, yaw = rpy_from_rotation(T[:3, :3])
            sample = telemetry(
                self._next_s, position_m=(x, y, z), roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw
            )
            new.append(sample)
            self._next_s += PERIOD_S
        return new


class Camera:
    """Gives each frame when it has arrived."""

    live, finished, size_px = True, False, CAMERA.size_px

    def __init__(self, scene: Pass, count: int) -> None:
        self._frames = list(scene.frames(count))

    def poll(self, now_s: float) -> Frame | None:
        if self._frames and self._frames[0].t_arrival_s <= now_s:
            return self._frames.pop(0)
        return None

    def problem(self, now_s: float) -> str | None:
        return None

    def describe(self) -> str:
        return "a camera"


def flown_by(scene: Pass, count: int = 14) -> list[Any]:
    """The outputs of all turns with a frame."""
    vehicle = Vehicle(scene)
    pipeline = make_pipeline(PROFILE, CAMERA)
    inputs = FlightInputs(cast(Link, vehicle), cast(Any, Camera(scene, count)), pipeline, PROFILE)
    outputs = []
    for k in range(1, 80):
        vehicle.now_s = k * PERIOD_S
        inputs.take_in(vehicle.now_s)
        if inputs.output is not None:
            outputs.append(inputs.output)
    return outputs


@pytest.mark.parametrize("first", ["top", "bottom"])
def test_a_target_stands_still_under_fields_in_flight(first: str) -> None:
    scene = Pass(0.25, (0.25, 0.1, 0.0), camera_fields=first, camera_latency_s=0.06)
    outputs = flown_by(scene)
    assert len(outputs) == 14
    assert {output.fields for output in outputs[5:]} == {"bottom" if first == "top" else "top"}
    places = [output.target.world_m for output in outputs[5:]]
    # Fields 10 ms from their time would be 2.7 mm aside.
    there = np.array([0.0, 0.0, scene.scenario.ceiling_z_m])
    assert np.abs(np.array(places) - there).max() < 7e-4


def test_both_fields_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """The later one is a tick's output; the filter had the earlier one too."""
    scene = Pass(0.25, (0.2, 0.0, 0.0), camera_fields="top")
    seen: list[float] = []
    real = perception.step

    def noted(state: Any, picture: Frame, *more: Any) -> Any:
        seen.append(picture.t_s)
        return real(state, picture, *more)

    monkeypatch.setattr(perception, "step", noted)
    flown_by(scene, 10)
    assert len(seen) >= 16
    assert np.diff(seen)[-6:] == pytest.approx(0.02, abs=1e-3)
