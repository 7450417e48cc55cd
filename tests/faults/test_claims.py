"""What the program says at its end is found by name: each row, phase and outcome has its claims."""

from __future__ import annotations

import re

import pytest

from perchctl.errors import EXIT_CODES
from perchctl.faults.oracle import (
    NOT_KNOWN,
    OUTCOME_CLAIMS,
    PHASE_CLAIMS,
    RESCUE_CLAIMS,
    ROW_CLAIMS,
    SAY_OFF,
    UNCONFIRMED,
    report_claims,
    rescue_claims,
)
from perchctl.mission import Event, EventKind, FlightReport, Outcome, Phase, RestState
from perchctl.mission.phase import FINAL_PHASES
from perchctl.mission.table import TABLE

LAST_ROWS = {row.name: row for row in TABLE if row.to in FINAL_PHASES}


def report(phase: Phase, outcome: Outcome, row: str, locked: bool = False) -> FlightReport:
    last = Event(20.0, EventKind.PHASE, "why", phase, row)
    return FlightReport(phase, outcome, "why", 1, 20.0, locked, (last,))


def test_each_row_that_ends_a_flight_has_its_claims() -> None:
    """A new row needs its own: until it has, nothing holds its sentence against the truth."""
    assert set(ROW_CLAIMS) == set(LAST_ROWS)
    assert {NOT_KNOWN, UNCONFIRMED} <= set(LAST_ROWS)


@pytest.mark.parametrize("name", sorted(LAST_ROWS))
def test_a_row_claims_what_its_sentence_says(name: str) -> None:
    row, claims = LAST_ROWS[name], ROW_CLAIMS[name]
    if row.to is not Phase.ABORTED:
        assert PHASE_CLAIMS[row.to] <= claims or "hangs on the target" in claims
    if row.stop_command is not None:
        assert "motors off" in claims
    if isinstance(row.reason, str):
        said = {
            "locked": "locked", "tilted": "tilted", "motors cut": "motors off",
            "something holds the vehicle": "held off the target",
        }  # fmt: skip
        for word, claim in said.items():
            assert (word in row.reason) <= (claim in claims), row.reason
        assert ("motors off" in row.reason) <= bool(claims & {"hangs on the target", *SAY_OFF})


@pytest.mark.parametrize("outcome", Outcome)
def test_an_outcome_claims_what_its_exit_code_means(outcome: Outcome) -> None:
    """The words of the exit codes' table, as the README prints it."""
    claims = OUTCOME_CLAIMS[outcome]
    meaning = EXIT_CODES[outcome.exit_code]
    words: dict[frozenset[str], str] = {
        frozenset({"hangs on the target"}): r"^perched",
        frozenset({"stands"}): r"landed($| \()",
        frozenset({"hangs or stands"}): r"landed.* left",
        frozenset({"motors off"}): r"motors cut",
        frozenset(): r"^safety abort$",
    }
    assert re.search(words[frozenset(claims)], meaning)


def test_a_report_claims_all_that_it_says() -> None:
    perched = report(Phase.PERCHED, Outcome.PERCHED, "perched")
    assert report_claims(perched) == {"hangs on the target", "hangs"}
    landed = report(Phase.LANDED, Outcome.ENDED_BY_OPERATOR, "landed")
    assert report_claims(landed) == {"stands", "hangs or stands"}
    hung = report(Phase.PERCHED, Outcome.TARGET_NOT_FOUND, "hung")
    assert report_claims(hung) == {"hangs", "stands"}  # exit 50 says that it landed
    cut = report(Phase.ABORTED, Outcome.EMERGENCY, "operator-stop", locked=True)
    assert report_claims(cut) == {"motors off", "locked"}
    not_known = report(Phase.ABORTED, Outcome.SAFETY, NOT_KNOWN)
    assert report_claims(not_known) == {"hangs or stands"}
    assert report_claims(report(Phase.ABORTED, Outcome.SAFETY, UNCONFIRMED)) == {"not seen down"}


def note(text: str, kind: EventKind = EventKind.NOTE) -> Event:
    return Event(9.0, kind, text)


@pytest.mark.parametrize("found", RestState)
def test_what_a_rescue_says_counts_too(found: RestState) -> None:
    """By what it found: that it hangs is another claim than that it stands."""
    claims = rescue_claims(
        Event.make_rescue_note(9.0, ValueError(), found, "whatever it is called")
    )
    words = {
        "is on the floor": "stands", "hanging on the magnet": "hangs",
        "something holds the vehicle": "held off the target",
        "is hanging or on the floor": "hangs or stands",
        "could not be confirmed": "not seen down",
    }  # fmt: skip
    assert claims == {claim for word, claim in words.items() if word in found.value}
    assert set(RESCUE_CLAIMS) == set(RestState)


@pytest.mark.parametrize("text", ["no battery reading", " in flight: ", *map(str, RestState)])
def test_what_is_no_rescue_claims_nothing_whatever_it_says(text: str) -> None:
    """A note of a user's row may say anything."""
    assert rescue_claims(note(text)) == set()
