"""The jet below a hovering vehicle, against what others measured (facts 14 to 16 of the notes on
several vehicles: Bauersfeld and others, 2024; Neural-Swarm2)."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.geometry import GRAVITY_MPS2
from perchctl.sim import Scenario, downwash_mps
from perchctl.sim.downwash import LEAST_MPS, jet_mps
from perchctl.sim.world import DRAG_VERTICAL_NSPM, World

G = 1e-3 * GRAVITY_MPS2
"""Weight of a gram, N."""
HOVER_N, NEURAL_SWARM_N = 42 * G, 34 * G


@pytest.mark.parametrize(
    ("below_m", "aside_m", "speed_mps"),
    [(0.5, 0.0, 4.5), (2.0, 0.0, 1.9), (2.0, 0.4, 0.24), (2.0, 0.6, 0.08), (2.0, 1.0, 0.01)],
)
def test_the_jet_is_as_fast_as_measured(below_m: float, aside_m: float, speed_mps: float) -> None:
    """By the published fit for 42 g, as far as its rounded figures say."""
    assert jet_mps(HOVER_N, below_m, aside_m) == pytest.approx(speed_mps, rel=0.03, abs=0.005)


@pytest.mark.parametrize(
    ("below_m", "aside_m", "force_g", "within_g"),
    [(0.3, 0.0, 8.3, 1.5), (0.5, 0.0, 5.9, 1.0), (0.6, 0.0, 4.2, 1.0), (0.3, 0.1, 1.4, 0.3)],
)
def test_it_pushes_as_hard_as_in_recorded_flights(
    below_m: float, aside_m: float, force_g: float, within_g: float
) -> None:
    """The force that Neural-Swarm2's network gives for vehicles of 34 g."""
    pushed_n = DRAG_VERTICAL_NSPM * downwash_mps(NEURAL_SWARM_N, below_m, aside_m)
    assert pushed_n / G == pytest.approx(force_g, abs=within_g)


def test_far_aside_or_above_there_is_none() -> None:
    assert downwash_mps(HOVER_N, 2.0, 1.1) == 0.0
    assert downwash_mps(HOVER_N, -0.1, 0.0) == 0.0
    assert downwash_mps(0.0, 1.0, 0.0) == 0.0
    assert downwash_mps(HOVER_N, 2.0, 0.6) > LEAST_MPS


def test_a_vehicle_in_a_jet_is_pushed_down() -> None:
    """By its drag, and one without a jet moves as before, bit by bit."""
    calm, same, blown = (World(Scenario()) for _ in range(3))
    same.downwash_mps = 0.0
    blown.downwash_mps = 5.0
    for world in (calm, same, blown):
        world.set_pose((0.0, 0.0, 1.0))
        for _ in range(100):
            world.step((0.0, 0.0, 0.0, 0.0))
    assert (calm.z_m, calm.vz_mps) == (same.z_m, same.vz_mps)
    gained_mps = calm.vz_mps - blown.vz_mps
    assert gained_mps == pytest.approx(DRAG_VERTICAL_NSPM * 5.0 / 0.042 * 0.2, rel=0.1)
