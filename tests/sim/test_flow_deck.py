"""The errors of a flow deck by their laws: with height, and blind."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.sim import CONTROL_PERIOD_S, Scenario
from perchctl.sim.firmware.estimator import Estimator, FlowDeck, has_flow_errors
from perchctl.sim.world import World

GOOD = {"flow_noise_radps": 0.06}


@dataclass
class At:
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 1.0


def flown(at: At, for_s: float, **scenario: Any) -> FlowDeck:
    deck = FlowDeck(Scenario(**scenario))
    for _ in range(round(for_s / CONTROL_PERIOD_S)):
        deck.step(at)
    return deck


def rms(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))


def test_what_the_gyroscope_is_off_by_is_a_drift_that_grows_with_height() -> None:
    bias = math.radians(1.0)
    for z_m in (0.5, 1.0, 2.0):
        decks = [
            flown(At(z_m=z_m), 8.0, seed=seed, flow_bias_radps=(bias, 0.0)) for seed in range(6)
        ]
        mean_m = float(np.mean([deck.position_error_m[0] for deck in decks]))
        assert mean_m == pytest.approx(8.0 * bias * z_m, rel=0.2)


def test_velocity_noise_and_the_walk_of_the_position_grow_with_height() -> None:
    def spread(z_m: float) -> tuple[float, float]:
        decks = [flown(At(z_m=z_m), 5.0, seed=s, flow_noise_radps=0.2) for s in range(8)]
        return (
            rms([v for deck in decks for v in deck.velocity_error_mps]),
            rms([p for deck in decks for p in deck.position_error_m[:2]]),
        )

    (low_v, low_p), (high_v, high_p) = spread(0.4), spread(2.4)
    assert high_v > 1.5 * low_v
    assert high_p > 2.5 * low_p
    assert 0.005 < high_v < 0.1


def test_blind_it_sums_up_the_accelerometer() -> None:
    scenario: dict[str, Any] = GOOD | {"flow_reach_m": 2.5}
    blind = [flown(At(z_m=2.6), 8.0, seed=seed, **scenario) for seed in range(6)]
    seen = flown(At(z_m=2.4), 8.0, **scenario)
    away = [math.hypot(*deck.position_error_m[:2]) for deck in blind]
    # Half of 0.0125 m/s^2 times the square of the time.
    assert float(np.median(away)) == pytest.approx(0.4, rel=0.3)
    assert math.hypot(*seen.position_error_m[:2]) < 0.1
    assert min(deck.variance for deck in blind) > 0.2 > 0.01 > seen.variance


def test_a_good_floor_keeps_it_within_five_centimetres_for_half_a_minute() -> None:
    decks = [flown(At(), 30.0, seed=seed, flow_noise_radps=0.05) for seed in range(6)]
    assert rms([p for deck in decks for p in deck.position_error_m[:2]]) < 0.05


def test_it_trusts_flow_as_little_as_the_firmware() -> None:
    """Two counts are 0.41 rad/s: a speed that is wrong is taken over within a second, not at
    once, and the attitude learns what keeps making it wrong."""
    deck = FlowDeck(Scenario(seed=1, flow_bias_radps=(0.05, 0.0)))
    speeds = {}
    for step in range(1, 5001):
        deck.step(At())
        speeds[round(step * CONTROL_PERIOD_S, 3)] = deck.velocity_error_mps[0]
    assert speeds[0.1] < 0.01 < 0.04 < speeds[10.0] < 0.06


def test_blind_the_reported_variance_grows_as_it_was_measured() -> None:
    """0.05 after 4 s and 0.2 after 7 s (docs/firmware.md)."""
    deck = flown(At(z_m=0.5), 10.0, **GOOD, flow_reach_m=1.5)
    grown = []
    for seconds in (4, 3):
        for _ in range(round(seconds / CONTROL_PERIOD_S)):
            deck.step(At(z_m=1.6))
        grown.append(deck.variance)
    assert grown == pytest.approx([0.05, 0.2], rel=0.35)


def test_when_it_sees_again_the_speed_is_right_and_the_place_goes_no_farther() -> None:
    deck = flown(At(z_m=2.6), 8.0, flow_reach_m=2.5, **GOOD)
    assert math.hypot(*deck.velocity_error_mps) > 0.05
    places = []
    for _ in range(2):
        for _ in range(2000):
            deck.step(At(z_m=1.0))
        places.append(deck.position_error_m[:2])
        assert math.hypot(*deck.velocity_error_mps) < 0.03
    assert math.dist(*places) < 0.03


def test_the_measured_height_is_good_to_two_and_a_half_metres() -> None:
    def spread(z_m: float) -> float:
        deck, found = FlowDeck(Scenario(**GOOD)), []  # type: ignore[arg-type]
        for _ in range(10000):
            deck.step(At(z_m=z_m))
            found.append(deck.position_error_m[2])
        return rms(found)

    assert spread(1.0) < 1e-4
    assert spread(2.5) == pytest.approx(0.0025, rel=0.3)
    assert spread(4.0) == pytest.approx(0.2, rel=0.3)


def test_the_estimate_has_the_decks_errors_once_it_has_flown() -> None:
    scenario = Scenario(estimate_noise_m=0.0, flow_bias_radps=(0.1, 0.0))
    estimator, world = Estimator(scenario), World(scenario)
    world.set_pose((0.0, 0.0, 1.0), hold=True)
    for step in range(1000):
        estimator.update(world, step * CONTROL_PERIOD_S, flown=False, spinning=False)
    assert estimator.now.x_m == 0.0
    for step in range(4000):
        estimator.update(world, step * CONTROL_PERIOD_S, flown=True, spinning=True)
    assert estimator.now.x_m == pytest.approx(0.8, rel=0.2)
    assert estimator.now.vx_mps == pytest.approx(0.1, rel=0.2)
    estimator.reset(2.0)
    estimator.update(world, 2.0, flown=False, spinning=False)
    assert estimator.now.x_m == 0.0


def test_a_good_deck_and_a_motion_capture_have_none_of_it() -> None:
    assert not has_flow_errors(Scenario())
    outside = Scenario(flow_noise_radps=0.3, extra={"external_position": 1.0})
    good = Estimator(Scenario())
    assert good.variance(5.0) == Estimator(Scenario(seed=4)).variance(5.0)
    assert Estimator(outside).outside is not None
