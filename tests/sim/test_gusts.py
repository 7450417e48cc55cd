"""The air of harder worlds: single gusts, and the pull of the ceiling against what is known."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.sim import Scenario
from perchctl.sim.scenario import Gust, blown
from perchctl.sim.world import SUCTION_LENGTH_M, Wind

GUST = Gust(2.0, 1.0, (0.6, 0.0, 0.1))
ROTOR_RADIUS_M = 0.023
ROTORS_OVER_CENTRE_M = 0.01


def test_a_gust_rises_to_its_peak_and_goes() -> None:
    assert blown([GUST], 2.0) == blown([GUST], 3.0) == blown([GUST], 9.0) == (0.0, 0.0, 0.0)
    assert blown([GUST], 2.5) == pytest.approx(GUST.peak_mps)
    assert blown([GUST], 2.25) == pytest.approx([0.5 * v for v in GUST.peak_mps])
    mean = sum(blown([GUST], 2.0 + k / 1000.0)[0] for k in range(1000)) / 1000.0
    assert mean == pytest.approx(0.3, rel=1e-3)
    assert blown([GUST, GUST], 2.5) == pytest.approx([2.0 * v for v in GUST.peak_mps])


def test_gusts_are_added_to_the_draught() -> None:
    steady = Scenario(seed=3, draught_mps=(0.3, -0.1, 0.0))
    gusty = Scenario(seed=3, draught_mps=(0.3, -0.1, 0.0), gusts=(GUST,))
    for t_s in (1.0, 2.3, 2.5, 4.0):
        expected = [a + b for a, b in zip(Wind(steady).at(t_s), blown([GUST], t_s), strict=True)]
        assert Wind(gusty).at(t_s) == pytest.approx(expected)
    assert Wind(Scenario(gusts=(GUST,))).at(2.5) == pytest.approx(GUST.peak_mps)
    assert Wind(Scenario(gusts=(GUST,))).at(1.0) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("height_m", [0.03, 0.035, 0.04, 0.05, 0.07, 0.1, 0.15])
def test_the_ceilings_pull_is_that_of_momentum_theory(height_m: float) -> None:
    """A rotor of radius R at D below a ceiling has its wake's power divided by
    g = (1 + sqrt(1 + (R / D)^2 / 8)) / 2 (Hsiao and Chirarattananon, arXiv 1905.04632, who
    measured it with rotors of this radius); at the same power the thrust grows by g^(2/3)."""
    gap_m = height_m - ROTORS_OVER_CENTRE_M
    g = 0.5 + 0.5 * math.sqrt(1.0 + (ROTOR_RADIUS_M / gap_m) ** 2 / 8.0)
    gained = Scenario().ceiling_suction * math.exp(-height_m / SUCTION_LENGTH_M)
    assert gained == pytest.approx(g ** (2.0 / 3.0) - 1.0, abs=0.006)
