"""A condition that is taken away leaves the others of a seed as they were."""

from __future__ import annotations

from dataclasses import asdict

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.profile import load_profile
from perchctl.sim import draw_scenario


@pytest.mark.parametrize("frames", [None, (0, 0), (9, 9), (8, 9)])
def test_lost_frames_leave_what_is_drawn_after_them(frames: tuple[int, int] | None) -> None:
    profile = load_profile("sim")
    without = profile.model_copy(
        update={"simulation": profile.simulation.model_copy(update={"camera_burst_frames": frames})}
    )
    for seed in range(20):
        whole = asdict(draw_scenario(profile, seed)) | {"camera_burst": None}
        assert asdict(draw_scenario(without, seed)) | {"camera_burst": None} == whole
