"""A flight that nobody records is the same flight: only the spread of the present is left out."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perchctl.flight import fly_lockstep
from perchctl.flight.lockstep import LockstepFlight
from perchctl.mission import Event, Tick
from perchctl.vision import TargetEstimate
from tests.helpers.flights import SEED, short_profile

SPREAD = {"sigma_m", "sigma_yaw_rad"}


class Shown:
    """What the planner was shown of the target, and what it sent."""

    problem: str | None = None

    def __init__(self) -> None:
        self.targets: list[TargetEstimate | None] = []
        self.commands: list[Any] = []

    def tick(self, tick: Tick) -> None:
        self.targets.append(tick.target)
        self.commands.append(tick.command)

    def event(self, event: Event) -> None:
        return None


def flown(log: Path | None) -> tuple[LockstepFlight, Shown]:
    shown = Shown()
    return fly_lockstep(short_profile({}), SEED, log, watchers=(shown,)), shown


@pytest.mark.long
def test_the_planner_is_shown_the_same(tmp_path: Path) -> None:
    (bare, unlogged), (whole, logged) = flown(None), flown(tmp_path / "flight.jsonl")
    assert unlogged.commands == logged.commands
    assert (bare.miss_m, bare.simulated_s) == (whole.miss_m, whole.simulated_s)
    other_spread = 0
    for one, other in zip(unlogged.targets, logged.targets, strict=True):
        assert (one is None) == (other is None)
        if one is None or other is None:
            continue
        for field in dataclasses.fields(TargetEstimate):
            a, b = getattr(one, field.name), getattr(other, field.name)
            if field.name in SPREAD:
                other_spread += not np.array_equal(a, b)
            else:
                assert np.array_equal(a, b), field.name
    assert other_spread > 100
