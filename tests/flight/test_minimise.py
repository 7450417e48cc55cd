"""A failure is brought down to its causes, whichever and however many they are."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.flight.minimise import HALVINGS, Levels, minimised

NAMES = [f"condition {k}" for k in range(20)]


class Flights:
    """Fails where each cause is at least as strong as its threshold; counts."""

    def __init__(self, causes: dict[str, float]) -> None:
        self.causes = causes
        self.flown: list[Levels] = []

    def fails(self, levels: Levels) -> bool:
        return all(levels[name] >= least for name, least in self.causes.items())

    def first_failing(self, several: Sequence[Levels]) -> int | None:
        for k, levels in enumerate(several):
            assert set(levels) == set(NAMES)
            self.flown.append(levels)
            if self.fails(levels):
                return k
        return None


causes = st.dictionaries(st.sampled_from(NAMES), st.floats(0.01, 1.0), max_size=5)


@settings(max_examples=60)
@given(causes)
def test_whichever_causes_fail_together_are_found(thresholds: dict[str, float]) -> None:
    flights = Flights(thresholds)
    found = minimised(NAMES, NAMES, flights.first_failing)
    assert {name for name, level in found.items() if level} == set(thresholds)
    assert flights.fails(found)
    for name, least in thresholds.items():
        assert found[name] - least < 0.5**HALVINGS
    assert len(flights.flown) <= 180


@settings(max_examples=25)
@given(causes)
def test_what_is_there_or_not_is_not_weakened(thresholds: dict[str, float]) -> None:
    found = minimised(NAMES, (), Flights(thresholds).first_failing)
    assert {name: level for name, level in found.items() if level} == dict.fromkeys(thresholds, 1.0)


@settings(max_examples=25)
@given(causes)
def test_each_smaller_failure_is_told_as_it_is_found(thresholds: dict[str, float]) -> None:
    """So that what is known so far can be told when somebody ends it."""
    flights = Flights(thresholds)
    told: list[Levels] = []
    found = minimised(NAMES, NAMES, flights.first_failing, lambda levels: told.append(dict(levels)))
    sums = [sum(levels.values()) for levels in told]
    assert sums == sorted(sums, reverse=True)
    assert all(map(flights.fails, told))
    assert told[-1] == found if thresholds else sums == [0.0]


def test_two_causes_of_twenty_cost_few_flights() -> None:
    worst = 0
    for one in NAMES:
        for other in NAMES[NAMES.index(one) + 1 :]:
            flights = Flights({one: 0.3, other: 0.7})
            minimised(NAMES, (), flights.first_failing)
            worst = max(worst, len(flights.flown))
            assert len({tuple(levels.items()) for levels in flights.flown}) == len(flights.flown)
    assert worst <= 45


def test_either_of_two_causes_is_enough_to_explain() -> None:
    """Of an exclusive or, too: where less of it fails otherwise, nothing is taken away."""

    def either(several: Sequence[Levels]) -> int | None:
        fails = [bool(levels[NAMES[3]] or levels[NAMES[11]]) for levels in several]
        return fails.index(True) if True in fails else None

    found = minimised(NAMES, (), either)
    assert [name for name, level in found.items() if level] in ([NAMES[3]], [NAMES[11]])


def test_what_fails_in_still_air_has_no_cause_among_the_conditions() -> None:
    assert not any(minimised(NAMES, NAMES, lambda several: 0).values())
