"""The panel of a fleet: the newest rows below the lines, and nothing of it reaches the fleet."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest

from perchctl.display import FleetPanel, FleetRow
from tests.helpers.waiting import until

ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A terminal of 80 columns."""
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "80")
    return Terminal()


def row(phase: str, link_s: float | None = 0.02) -> FleetRow:
    return FleetRow(number=1, name="north", phase=phase, reason="why", link_s=link_s)


def test_lines_stand_above_the_newest_rows_and_the_last_ones_stay(terminal: Terminal) -> None:
    panel = FleetPanel(terminal, ("below", "above"))
    panel.show([row("ALIGN")])
    until(lambda: "ALIGN" in terminal.getvalue())
    panel.event("north: LANDED")
    panel.show([row("LANDED", None)])
    panel.close()
    assert panel.failure is None
    lines, _, last = ESCAPE.sub("", terminal.getvalue()).rpartition("perchctl: above")
    assert "north: LANDED" in lines
    assert "20 ms" in lines
    assert "LANDED" in last
    assert "ALIGN" not in last
    assert "below" in last


def test_keys_are_offered_until_all_flights_are_over(terminal: Terminal) -> None:
    panel = FleetPanel(terminal, ("below", "above"))
    panel.show([replace(row("PERCHED"), has_ended=True), row("ASCEND")])
    until(lambda: "ASCEND" in terminal.getvalue())
    assert "below" in terminal.getvalue()
    panel.show([replace(row("PERCHED"), has_ended=True), replace(row("LANDED"), has_ended=True)])
    panel.close()
    last = terminal.getvalue().rpartition("ASCEND")[2]
    assert "below" not in last.rpartition("perchctl")[2]
    assert "above" not in last.rpartition("perchctl")[2]


def test_there_are_only_lines_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    panel = FleetPanel(stream)
    panel.show([row("ALIGN")])
    panel.event("north: ALIGN")
    panel.close()
    assert stream.getvalue() == "north: ALIGN\n"


def test_a_display_that_fails_says_why() -> None:
    class Failing(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError("gone")

    panel = FleetPanel(Failing())
    panel.event("north: ALIGN")
    until(lambda: panel.failure)
    assert panel.failure == "the display failed: BrokenPipeError: gone"
    panel.event("north: LANDED")
    panel.close()
