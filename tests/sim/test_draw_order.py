"""A condition that is taken away leaves the others of a seed as they were."""

from __future__ import annotations

from dataclasses import asdict

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.profile import SimulationConfig, load_profile
from perchctl.sim import draw_points, draw_scenario


@pytest.mark.parametrize("frames", [None, (0, 0), (9, 9), (8, 9)])
def test_lost_frames_leave_what_is_drawn_after_them(frames: tuple[int, int] | None) -> None:
    profile = load_profile("sim")
    without = profile.model_copy(
        update={"simulation": profile.simulation.model_copy(update={"camera_burst_frames": frames})}
    )
    for seed in range(20):
        whole = asdict(draw_scenario(profile, seed)) | {"camera_burst": None}
        assert asdict(draw_scenario(without, seed)) | {"camera_burst": None} == whole


def test_the_points_of_a_seed_draw_the_same_scenario_to_the_bit() -> None:
    """Of the wildest ranges, too; and each range is among them, but for directions."""
    profile = load_profile("sim")
    ranges = {key for key, value in profile.simulation if _is_range(key) and "_towards_" not in key}
    for seed in range(50):
        points = draw_points(profile, seed)
        assert ranges <= set(points)
        assert all(low == high for low, high in (points[key] for key in ranges))
        pinned = profile.model_copy(
            update={"simulation": profile.simulation.model_copy(update=points)}
        )
        assert draw_scenario(pinned, seed) == draw_scenario(profile, seed)
        assert draw_points(pinned, seed) == points


def _is_range(key: str) -> bool:
    field = SimulationConfig.model_fields[key]
    return field.annotation == tuple[float, float] and bool(field.metadata)
