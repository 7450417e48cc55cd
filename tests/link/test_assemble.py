"""Samples from log blocks: a sample is as old as its oldest part."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.link.telemetry import BLOCKS, MOST_CARRIED_S, Assembler
from perchctl.mission import Condition, Context, Observation, Phase, PlannerState
from perchctl.mission.conditions import BY_PLACE, PROOFS, conditions_since
from perchctl.profile import Profile
from perchctl.vehicle import Telemetry

STILL = {name: dict.fromkeys(variables, 0.0) for name, variables in BLOCKS.items()}


def test_nothing_without_both_fast_blocks() -> None:
    assembler = Assembler()
    assert assembler.accept("attitude", STILL["attitude"], 0.0) is None
    assert "stateEstimate.x" in assembler.missing()
    assert assembler.accept("state", STILL["state"], 0.01) is None
    assert assembler.accept("attitude", STILL["attitude"], 0.01) is not None


@given(silent_ms=st.integers(0, 3000), speed_mps=st.floats(-1, 1))
def test_a_dead_block_shows_in_the_sample(silent_ms: int, speed_mps: float) -> None:
    assembler = Assembler()
    assembler.accept("state", STILL["state"] | {"stateEstimate.vz": speed_mps}, 1.0)
    sample = assembler.accept("attitude", STILL["attitude"], 1.0 + silent_ms / 1e3)
    assert sample is not None
    assert sample.behind_s == pytest.approx(silent_ms / 1e3)
    carried_m = speed_mps * min(silent_ms / 1e3, MOST_CARRIED_S)
    assert sample.position_m[2] == pytest.approx(carried_m)


def test_what_a_vehicle_told_before_it_started_anew_is_over() -> None:
    assembler = Assembler()
    assembler.accept("state", STILL["state"], 1.0)
    assert assembler.accept("attitude", STILL["attitude"], 2.0, 1) is None
    assembler.accept("state", STILL["state"], 2.01, 1)
    assert assembler.accept("attitude", STILL["attitude"], 1.01, 0) is None  # it came late
    sample = assembler.accept("attitude", STILL["attitude"], 2.02, 1)
    assert sample is not None
    assert (sample.start, sample.behind_s) == (1, pytest.approx(0.01))


HANGS = Telemetry(
    1.0, (0.0, 0.0, 2.0), (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 1.0, 0.0, 3.9, supervisor=0x020E
)  # fmt: skip
HANGING = PlannerState(
    phase=Phase.COMPLETE, released_s=0.0, contact_z_m=2.0, hover_thrust=50000.0,
    ground_m=(0.0, 0.0, 0.0),
)  # fmt: skip


@pytest.mark.parametrize("behind_s", [0.0, 0.15, 2.0])
def test_a_frozen_position_proves_no_place(behind_s: float) -> None:
    """A position block that alone stops arriving looks like a vehicle at rest. What rests on
    acceleration, thrust and the supervisor's word, which are fresh, is proven all the same."""
    obs = Observation(1.0, replace(HANGS, behind_s=behind_s))
    proven = PROOFS & conditions_since(Context(HANGING, obs, Profile())).keys()
    assert not (proven & BY_PLACE and behind_s > 0.0)
    assert Condition.WEIGHT_HANGS in proven
    old = replace(HANGS, t_s=1.0 - 0.15)
    assert (
        not PROOFS
        & conditions_since(Context(HANGING, replace(obs, telemetry=old), Profile())).keys()
    )
