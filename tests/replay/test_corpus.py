"""The regression corpus: flights of an earlier day, decided again by today's planner.

A planner that is meant to decide otherwise gets the corpus anew: CONTRIBUTING.md, "Change the
planner".
"""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest

from perchctl.analysis import replay
from perchctl.analysis.replayer import Replay
from perchctl.mission import Phase
from perchctl.record import FlightLog, read_log
from perchctl.record.fields import SCHEMA_VERSION
from tests.helpers.flights import ROOT

FOLDER = ROOT / "tests" / "data" / "flights"
NAMES = sorted(path.name.removesuffix(".jsonl.gz") for path in FOLDER.glob("*.jsonl.gz"))
MOST_BYTES, MOST_BYTES_SEEN = 1_500_000, 1_000_000
LAST_BITS = 1e-9
"""By so much sums may differ on a computer with other libraries; what is decided may not."""
ANEW = "if that was meant: python tests/data/flights/make.py (CONTRIBUTING.md, Change the planner)"


@cache
def corpus(name: str) -> FlightLog:
    return read_log(FOLDER / f"{name}.jsonl.gz")


@pytest.mark.parametrize("name", NAMES)
def test_the_planner_decides_as_it_did(name: str) -> None:
    found = replay(corpus(name))
    if not found.differences:
        assert found.ticks > 50
        return
    assert found.log.computer_differences, f"{found.differences[0].text}; {ANEW}"
    assert not _beyond_last_bits(found), f"{found.differences[0].text}; {ANEW}"


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
    assert any(turn.outside for name in NAMES for turn in corpus(name).turns)
    assert any(turn.role == "redone" for turn in corpus("hung-within").turns)
    assert any(turn.taken.late for turn in corpus("hung-within").turns)
    assert any(turn.row == "telemetry-stale" for turn in corpus("link-silent").turns)


def test_flights_of_two_formats_are_in_it() -> None:
    """Those of version 3, which stay readable, and some of later ones, in which the planner's words
    and what the watchdog sent are held too."""
    of = {name: corpus(name).header["version"] for name in NAMES}
    assert {3, 4} <= {*of.values()} <= {3, 4, SCHEMA_VERSION}
    for name, version in of.items():
        told = [turn.reason is not None for turn in corpus(name).turns if turn.command]
        assert all(told) if version > 3 else not any(told)
    assert {each.by for each in corpus("hung").sent} == {"watchdog"}


def _beyond_last_bits(found: Replay) -> list[Any]:
    return [
        each.difference
        for each in found.decisions
        if (d := each.difference) is not None and not _near(d[1], d[2])
    ]


def _near(one: Any, other: Any) -> bool:
    numbers = isinstance(one, float) and isinstance(other, float)
    return numbers and abs(one - other) <= LAST_BITS * max(1.0, abs(one))
