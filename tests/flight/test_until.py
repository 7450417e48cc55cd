"""A campaign flies until its rate is known, and the same seeds count whichever ends first."""

from __future__ import annotations

import random

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.flight import FlightResult, StopRule
from perchctl.flight.rates import rate_interval
from tests.helpers.results import landed, perched


def result(seed: int) -> FlightResult:
    return landed(seed) if seed % 7 == 3 else perched(seed)


def width(good: int, flights: int) -> float:
    low, high = rate_interval(good, flights)
    return high - low


def flown(order: list[int], most: float, seeds: range) -> StopRule:
    enough = StopRule(seeds, most)
    for seed in order:
        if enough.note(result(seed)):
            break
    return enough


def test_it_ends_with_the_first_flight_by_which_the_rate_is_known() -> None:
    enough = flown(list(range(10, 400)), 0.2, range(10, 400))
    good = sum(not r.is_bad for r in enough.counted)
    assert enough.met
    assert width(good, len(enough.counted)) < 0.2
    before = enough.counted[:-1]
    assert width(sum(not r.is_bad for r in before), len(before)) >= 0.2


@pytest.mark.parametrize("ahead", [2, 5, 40])
def test_the_same_seeds_count_in_whatever_order_they_end(ahead: int) -> None:
    """Flights of a window end in any order, as several at a time do."""
    seeds = range(300)
    alone = flown(list(seeds), 0.2, seeds)
    rng = random.Random(ahead)
    waiting, order, coming = [], [], list(seeds)
    while coming or waiting:
        while coming and len(waiting) < ahead:
            waiting.append(coming.pop(0))
        order.append(waiting.pop(rng.randrange(len(waiting))))
    several = flown(order, 0.2, seeds)
    assert [r.seed for r in several.counted] == [r.seed for r in alone.counted]
    assert several.interval == alone.interval


def test_a_seed_that_is_still_flying_holds_up_the_judgement() -> None:
    enough = StopRule(range(300), 0.5)
    assert not any(enough.note(perched(seed)) for seed in range(1, 300))
    assert enough.counted == []
    assert enough.note(perched(0))
    assert width(len(enough.counted), len(enough.counted)) < 0.5


def test_the_bound_may_be_met_first() -> None:
    enough = flown(list(range(5)), 0.005, range(5))
    assert not enough.met
    assert len(enough.counted) == 5
    assert len(flown(list(range(1000)), 0.05, range(1000)).counted) < 1000


def test_a_rate_of_one_takes_as_many_as_its_interval_says() -> None:
    enough = StopRule(range(1000), 0.005)
    last = next(seed for seed in range(1000) if enough.note(perched(seed)))
    assert last + 1 == 736


def test_what_it_may_come_to_is_what_the_present_rate_needs() -> None:
    """When all perch, 0.5 % take 736 flights; once one has not, more than there are."""
    enough = StopRule(range(1000), 0.005)
    assert enough.expected() == 1000
    for seed in range(10):
        enough.note(perched(seed))
        assert enough.expected() == 736
    enough.note(landed(10))
    assert enough.expected() == 1000
    met = StopRule(range(1000), 0.5)
    for seed in range(100):
        if met.note(perched(seed)):
            break
    assert met.met
    assert met.expected() == len(met.counted)
