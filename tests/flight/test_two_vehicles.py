"""Two vehicles in one room perch side by side, each on its own target.

Both targets hang under one ceiling and show in both cameras' pictures.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.flight import fly_lockstep
from perchctl.geometry import invert_T, make_T, rot_z, yaw_of
from perchctl.mission import Phase
from perchctl.profile import Profile
from perchctl.record import read_log
from perchctl.sim import Neighbour, Scenario, draw_scenario
from tests.helpers.flights import short_profile

APART_M = 0.8
MISS_M = 0.02


def pair(profile: Profile, seed: int, apart_m: float) -> tuple[Scenario, Scenario]:
    """The room of that seed: two scenarios of the profile under one ceiling, each in the world of
    its own vehicle."""
    rng = np.random.default_rng([seed, 14])
    bearing_rad, turn_rad = (float(angle) for angle in rng.uniform(-math.pi, math.pi, 2))
    there_m = apart_m * np.array([math.cos(bearing_rad), math.sin(bearing_rad), 0.0])
    T_a_b = make_T(rot_z(turn_rad), there_m)  # the second target in the first one's axes
    a, b = (draw_scenario(profile, 2 * seed + k) for k in (0, 1))
    b = replace(b, ceiling_z_m=a.ceiling_z_m)
    sees_b, sees_a = (
        Neighbour((float(T[0, 3]), float(T[1, 3])), yaw_of(T[:3, :3]))
        for T in (T_a_b, invert_T(T_a_b))
    )
    return replace(a, neighbours=(sees_b,)), replace(b, neighbours=(sees_a,))


# --- in lockstep -------------------------------------------------------------------------


def perches_on_its_own(profile: Profile, scenario: Scenario, log: Path | None = None) -> None:
    flight = fly_lockstep(profile, log=log, scenario=scenario)
    assert (flight.report.phase, flight.hanging) == (Phase.PERCHED, True), flight
    assert flight.miss_m < MISS_M, flight


@pytest.mark.long
def test_a_pair_perches_side_by_side(tmp_path: Path) -> None:
    for name, scenario in zip("ab", pair(short_profile(), 0, APART_M), strict=True):
        perches_on_its_own(short_profile(), scenario, tmp_path / name)
        log = read_log(tmp_path / name)
        xy = np.stack([log.column("tx_m"), log.column("ty_m")], axis=1)
        seen = xy[np.isfinite(xy[:, 0])]
        assert np.linalg.norm(seen - scenario.target_xy_m, axis=1).max() < APART_M / 4
        assert not any("taken up anew" in (r["lock_note"] or "") for r in log.records)
