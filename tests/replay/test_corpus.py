"""The regression corpus: flights of an earlier day, decided again by today's planner.

They were decided on another computer, whose libraries may have rounded otherwise, so numbers may
differ by a tolerance, which is the same on every computer. Bits count where a flight is decided
twice by one process (`tests.helpers.decided`, `test_senses.py`, `test_flights.py`).

A planner that is meant to decide otherwise gets the corpus anew: CONTRIBUTING.md, "Change the
planner".
"""

from __future__ import annotations

from functools import cache

import pytest

from perchctl.analysis import replay
from perchctl.mission import Phase
from perchctl.record import FlightLog, read_log
from perchctl.record.fields import SCHEMA_VERSION
from tests.helpers.decided import FLIGHTS as FOLDER

NAMES = sorted(path.name.removesuffix(".jsonl.gz") for path in FOLDER.glob("*.jsonl.gz"))
MOST_BYTES, MOST_BYTES_SEEN = 1_500_000, 1_000_000
LAST_BITS = {"": 1e-9}
"""By so much numbers of a command may differ, in m, m/s and rad; what is decided may not. A larger
one hides changed constants, a smaller one is exceeded by the rounding of other libraries."""
ANEW = "if that was meant: python tests/data/flights/make.py (CONTRIBUTING.md, Change the planner)"


@cache
def corpus(name: str) -> FlightLog:
    return read_log(FOLDER / f"{name}.jsonl.gz")


@pytest.mark.parametrize("name", NAMES)
def test_the_planner_decides_as_it_did(name: str) -> None:
    found = replay(corpus(name), tolerances=LAST_BITS)
    assert not found.differences, f"{found.differences[0].text}; {ANEW}"
    assert found.ticks > 50


def test_the_corpus_is_worth_its_place() -> None:
    """Small, with every way in which a flight ends, every phase, positions from outside, a silent
    link, and turns that hung while they looked or decided."""
    seen = sum(path.stat().st_size for path in FOLDER.glob("seen.*"))
    assert seen < MOST_BYTES_SEEN
    assert sum(path.stat().st_size for path in FOLDER.glob("*.*")) - seen < MOST_BYTES
    ends = {str((corpus(name).summary or {}).get("outcome")) for name in NAMES}
    assert {"perched", "landed", "aborted"} <= ends
    flown = {turn.phase for name in NAMES for turn in corpus(name).turns if turn.phase}
    assert flown == set(Phase)
    assert any(turn.external_positions for name in NAMES for turn in corpus(name).turns)
    assert any(turn.role == "redone" for turn in corpus("hung-within").turns)
    assert any(turn.inputs.late_samples for turn in corpus("hung-within").turns)
    assert any(turn.transition_name == "telemetry-stale" for turn in corpus("link-silent").turns)


def test_flights_of_two_formats_are_in_it() -> None:
    """Those of version 3, which stay readable, and some of later ones, in which the planner's words
    and what the watchdog sent are held too."""
    of = {name: corpus(name).header["version"] for name in NAMES}
    assert {3, 4} <= {*of.values()} <= {3, 4, SCHEMA_VERSION}
    for name, version in of.items():
        told = [turn.reason is not None for turn in corpus(name).turns if turn.command]
        assert all(told) if version > 3 else not any(told)
    assert {each.sender for each in corpus("hung").sent} == {"watchdog"}
