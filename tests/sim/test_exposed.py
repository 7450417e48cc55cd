"""A picture shows the way during its exposure, however the vehicle's time is made to pass."""

from __future__ import annotations

import numpy as np
import pytest

from perchctl.calibration import profile_camera
from perchctl.profile import TargetConfig, load_profile
from perchctl.sim import SimulatedVehicle, draw_scenario
from perchctl.values import replace

PROFILE = load_profile("sim")


@pytest.mark.parametrize("readout_s", [0.0, 0.02], ids=["global shutter", "rolling shutter"])
def test_time_in_leaps_shows_what_time_in_steps_shows(readout_s: float) -> None:
    scenario = replace(draw_scenario(PROFILE, 3), camera_readout_s=readout_s)
    leaping, stepping = (
        SimulatedVehicle(scenario, profile_camera(PROFILE.camera), TargetConfig()) for _ in range(2)
    )
    pictures: list[list[bytes]] = [[], []]
    for vehicle in (leaping, stepping):
        vehicle.world.set_pose((0.0, 0.0, 1.2), velocity_mps=(0.4, -0.3, 0.0))
    for k in range(1, 21):
        leaping.advance_to(0.02 * k)
        while stepping.t_s < 0.02 * k - 1e-3:
            stepping.step()
        for vehicle, seen in zip((leaping, stepping), pictures, strict=True):
            assert vehicle.camera is not None
            seen += [np.asarray(frame.image).tobytes() for frame in vehicle.camera.take()]
    assert len(pictures[0]) >= 6
    assert pictures[0] == pictures[1]
