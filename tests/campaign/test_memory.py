"""A process that flies on does not grow."""

from __future__ import annotations

import resource
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign import flight_processes, fly_all
from perchctl.campaign.flights import fly_seed
from perchctl.campaign.results import peak_memory_mb
from perchctl.profile import Profile
from tests.helpers.flights import SEED, short_profile

FLIGHTS, FROM = 10, 4
MORE_MB = 10.0
"""Between two flights: caches of eight entries fill up by 1 MB a flight."""
STATM = Path("/proc/self/statm")


def held_mb(profile: Profile, seed: int) -> float:
    """By this process, after a flight."""
    fly_seed(profile, seed)
    return int(STATM.read_text().split()[1]) * resource.getpagesize() * 1e-6


@pytest.mark.long
def test_a_peak_stays() -> None:
    before_mb = peak_memory_mb()
    block = bytearray(b"x") * int(1e6 * (before_mb + 60.0))  # more than was ever held
    while_held_mb = peak_memory_mb()
    del block
    assert before_mb + 50.0 < while_held_mb < 2.5 * before_mb + 200.0
    assert peak_memory_mb() == pytest.approx(while_held_mb, abs=5.0)


@pytest.mark.long
@pytest.mark.skipif(not STATM.exists(), reason="only Linux tells what is held now")
def test_a_process_that_flies_on_does_not_grow() -> None:
    profile = short_profile({"planner.perching_time_s": 0.3})
    with flight_processes(1) as pool:
        held = fly_all(partial(held_mb, profile), range(SEED, SEED + FLIGHTS), pool)
    assert held[-1] - held[FROM - 1] < MORE_MB, held
    assert max(held) < 250.0, held
