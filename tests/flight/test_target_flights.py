"""Whole flights with nothing but a camera: the target is the positioning system."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.campaign.flights import fly_seed
from perchctl.faults import FAULTS
from perchctl.faults.catalogue import draw_case
from perchctl.faults.flight import FaultyFlight
from perchctl.flight import fly_lockstep
from perchctl.mission import Event, Phase, Tick
from perchctl.sim import draw_scenario
from tests.helpers.mission import changed
from tests.helpers.sights import TARGET_ONLY

MISS_M = 0.006
ON_IT = tuple(
    fault for fault in FAULTS
    if fault.name in ("target-covered", "camera-frozen", "camera-lossy", "kick")
)  # fmt: skip


@dataclass
class Seen:
    """What the flight believed and sent, tick by tick."""

    problem: str | None = None
    ages_s: dict[Phase, float] = field(default_factory=dict)

    def tick(self, tick: Tick) -> None:
        assert tick.outside is not None
        phase = tick.state.phase
        self.ages_s[phase] = max(self.ages_s.get(phase, 0.0), tick.outside.age_s)

    def event(self, event: Event) -> None:
        return None


@pytest.mark.long
def test_it_perches_by_the_sight_of_the_target_alone() -> None:
    seen = Seen()
    it = fly_lockstep(TARGET_ONLY, 3, watchers=(seen,))
    assert it.report.phase is Phase.PERCHED
    assert it.perched_miss_m is not None
    assert it.perched_miss_m < MISS_M
    assert it.scenario.extra["external_position"]
    assert any(it.scenario.gyro_bias_radps)
    # In the air by sights; pressed and hanging the place is known.
    assert seen.ages_s[Phase.ALIGN] < TARGET_ONLY.positioning.hold_s
    assert seen.ages_s[Phase.COMPLETE] < TARGET_ONLY.positioning.land_s


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(20))
def test_whatever_the_seed_it_perches_or_lands(seed: int) -> None:
    result = fly_seed(TARGET_ONLY, seed)
    assert not result.fell
    assert not result.locked
    assert result.outcome in ("perched", "landed")
    assert result.miss_m is None or result.miss_m < 2.0 * MISS_M


@pytest.mark.campaign
@pytest.mark.parametrize("seed", range(40))
def test_no_fault_of_its_sight_makes_it_fall_or_lie(seed: int) -> None:
    """Covered, frozen, lossy, and a blow, in whatever phase."""
    scenario = draw_scenario(TARGET_ONLY, seed)
    result = FaultyFlight(TARGET_ONLY, draw_case(seed, scenario, ON_IT), scenario).fly()
    assert not result.counted, (result.fault, result.phase, result.reason, result.counted)


@pytest.mark.long
@pytest.mark.parametrize("seed", [16, 30])
def test_what_a_blow_knocks_off_the_magnet_is_braked(seed: int) -> None:
    """In COMPLETE, and in a landing that has released it: by its estimate it stands still."""
    scenario = draw_scenario(TARGET_ONLY, seed)
    result = FaultyFlight(TARGET_ONLY, draw_case(seed, scenario, ON_IT), scenario).fly()
    assert result.fault == "kick"
    assert not result.counted, (result.phase, result.reason, result.counted)
    assert result.astray_m < 0.5


@pytest.mark.campaign
@pytest.mark.parametrize("wrong_s", [-0.03, 0.03])
def test_a_latency_that_is_wrong_does_not_swing_the_alignment(wrong_s: float) -> None:
    scenario = draw_scenario(TARGET_ONLY, 1)
    latency_s = scenario.camera_latency_s + wrong_s
    aside_m: list[float] = []

    class Aside:
        problem: str | None = None

        def tick(self, tick: Tick) -> None:
            if tick.state.phase is Phase.ASCEND and tick.target is not None:
                aside_m.append(math.hypot(*tick.target.e_m[:2]))

        def event(self, event: Event) -> None:
            return None

    profile = changed({"camera.latency_s": latency_s}, TARGET_ONLY)
    it = fly_lockstep(profile, scenario=scenario, watchers=(Aside(),))
    assert it.report.phase is Phase.PERCHED
    assert max(aside_m) < 0.02
