"""The live display, and that nothing it does reaches the loop."""

from __future__ import annotations

import io
import math
import re
import threading
from typing import Any

import pytest
from rich.console import Console
from rich.text import Text

from perchctl.display import FlightPanel
from perchctl.display.panel import status_panel, status_rows
from perchctl.flight import KEY_HELP, STOP_HELP
from perchctl.mission import GearToTargetDistance, Phase
from tests.helpers.live_page import hover_tick, tick
from tests.helpers.mission import entered, held, note
from tests.helpers.waiting import until

ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
COLOUR = re.compile(r"\x1b\[[0-9;]*3[0-9]m")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """A terminal of 80 columns, with colours."""
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLUMNS", "80")
    return Terminal()


def test_one_line_an_event_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    reporter = FlightPanel(stream)
    reporter.event(entered(100.0, Phase.SEARCH, "hovering in the perching area"))
    for i in range(50):
        reporter.tick(tick(100.0 + 0.02 * i, "SEARCH"))
    reporter.event(held(102.5, "no picture for 0.6 s"))
    reporter.close()
    assert stream.getvalue().splitlines() == [
        "[   0.00 s] SEARCH: hovering in the perching area",
        "[   2.50 s] holding: no picture for 0.6 s",
    ]


def test_a_long_event_breaks_between_words_and_below_its_text(terminal: Terminal) -> None:
    path = "/home/somebody/" + "a_long_folder/" * 7 + "flight.jsonl"
    reporter = FlightPanel(terminal)
    reporter.event(
        note(100.0, f"the battery has 8 s left before a landing must begin; {path} of it")
    )
    reporter.close()
    lines = ESCAPE.sub("", terminal.getvalue()).splitlines()
    assert lines[0] == "[   0.00 s] the battery has 8 s left before a landing must begin;"
    assert lines[1:3] == [" " * 12 + path, " " * 12 + "of it"]


@pytest.mark.parametrize("last", ["PERCHED", "LANDED", "ABORTED"])
def test_a_new_phase_is_shown_without_waiting_and_the_last_one_stays(
    last: str, terminal: Terminal
) -> None:
    """The loop tells the event first, and then the tick, which may be the last one."""
    reporter = FlightPanel(terminal)
    reporter.tick(tick(100.0, "ASCEND"))
    reporter.event(entered(100.02, Phase(last), "over"))
    until(lambda: f"{last}: over" in terminal.getvalue())  # the display sleeps again
    reporter.tick(tick(100.02, last))
    until(lambda: f"{last}  " in terminal.getvalue())
    reporter.close()
    assert "ASCEND" not in terminal.getvalue().rpartition(last)[2]


def test_the_panel_on_a_terminal(terminal: Terminal) -> None:
    reporter = FlightPanel(terminal)
    reporter.event(note(100.0, "link: radio://0/80/2M/E7E7E7E7E7 [ok] https://a.b"))
    reporter.help = STOP_HELP, KEY_HELP
    reporter.tick(tick(phase="LANDING"))
    reporter.close()
    assert reporter.failure is None
    assert STOP_HELP in terminal.getvalue()
    text = ESCAPE.sub("", terminal.getvalue())
    assert "link: radio://0/80/2M/E7E7E7E7E7 [ok] https://a.b" in text
    assert "x -12.3  y +4.5  z +123.4 cm   yaw -166.2 deg" in text
    assert COLOUR.search(terminal.getvalue())
    line = next(line for line in terminal.getvalue().splitlines() if "radio://" in line)
    assert not COLOUR.search(line)


def test_the_panel_shows_the_errors_of_a_hover_while_it_lasts() -> None:
    rows = dict(status_rows(hover_tick()))
    assert rows["hover"] == "1 of 5 s   RMS x 3.0  y 0.0  z 4.0 mm   yaw 5.7 deg"
    assert "hover" not in dict(status_rows(hover_tick("LANDING")))


@pytest.mark.parametrize("name", ["NO_COLOR", "TERM"])
def test_no_colour_where_none_is_wanted(
    name: str, monkeypatch: pytest.MonkeyPatch, terminal: Terminal
) -> None:
    """A dumb terminal gets lines only."""
    monkeypatch.setenv(name, "1" if name == "NO_COLOR" else "dumb")
    reporter = FlightPanel(terminal)
    reporter.event(entered(100.0, Phase.ABORTED, "pose is steady"))
    reporter.tick(tick(phase="ABORTED", hold="no picture"))
    reporter.close()
    assert "ABORTED" in terminal.getvalue()
    assert not COLOUR.search(terminal.getvalue())
    if name == "TERM":
        assert terminal.getvalue() == "[   0.00 s] ABORTED: pose is steady\n"


def text_inside(lines: list[str]) -> str:
    """The text between the frame's sides, in one line."""
    return " ".join(
        word for line in lines for word in line.strip("\N{BOX DRAWINGS LIGHT VERTICAL}").split()
    )


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"e_m": None, "camera_age_s": math.inf, "telemetry_age_s": 12.0},
        {"reason": "why " * 100, "hold": "[bold]held[/bold] " * 20},
        {"e_m": (-99.9, 99.9, 99.9), "e_yaw_rad": -math.pi, "entered_s": -899.0},
        {"e_m": (-99.9, 99.9, 99.9), "e_yaw_rad": math.nan, "tracked": False},
    ],
)
def test_the_panel_fits_into_80_columns(changes: dict[str, Any]) -> None:
    shown = tick(**changes)
    console = Console(width=80, file=io.StringIO(), highlight=False, markup=False)
    with console.capture() as capture:
        console.print(status_panel(shown, STOP_HELP, KEY_HELP))
    lines = capture.get().splitlines()
    assert STOP_HELP in lines[-1]
    assert KEY_HELP in lines[0]
    inside = " ".join(
        " ".join(line.strip("\N{BOX DRAWINGS LIGHT VERTICAL} ") for line in lines).split()
    )
    if "hold" in changes:  # a sentence of any length is whole
        assert " ".join(changes["hold"].split()) in inside
    else:
        assert len(lines) == 8
    assert "\N{HORIZONTAL ELLIPSIS}" not in inside
    assert max(Text(line.rstrip()).cell_len for line in lines) + len("^C") <= 80
    assert "   failed attempts 1" in dict(status_rows(shown))["markers"]
    for name, _ in status_rows(shown):
        assert sum(f" {name} " in line for line in lines) == 1, name


LAST_ROW = "contact proven by position, acceleration and thrust; 4.2 +- 1.0 mm off centre"


@pytest.mark.parametrize("columns", [80, 50])
def test_the_panel_cuts_no_unit_off(columns: int) -> None:
    console = Console(width=columns, file=io.StringIO(), highlight=False, markup=False)
    with console.capture() as capture:
        console.print(status_panel(tick(phase="COMPLETE", reason=LAST_ROW), STOP_HELP, KEY_HELP))
    shown = capture.get()
    assert LAST_ROW in text_inside(shown.splitlines())
    assert (KEY_HELP in shown) is (columns == 80)
    assert ("\N{HORIZONTAL ELLIPSIS}" in shown.splitlines()[0]) is (columns == 50)


@pytest.mark.parametrize(
    ("phase", "tracked", "contact", "shown"),
    [
        ("ALIGN", False, None, "(not seen)"),
        ("LANDING", False, None, "(not seen)"),
        ("COMPLETE", False, GearToTargetDistance(0.0024, 0.001), "2.4 +- 1.0 mm off centre"),
        ("COMPLETE", True, GearToTargetDistance(0.0024, math.inf), "at an unknown distance"),
        ("PERCHED", False, GearToTargetDistance(0.0024, 0.001), "2.4 +- 1.0 mm off centre"),
        ("LANDED", False, GearToTargetDistance(0.0024, 0.001), None),
        ("LANDED", True, None, "x -12.3"),
        ("ABORTED", False, None, None),
    ],
)
def test_an_error_that_drifts_unseen_is_not_shown(
    phase: str, tracked: bool, contact: GearToTargetDistance | None, shown: str | None
) -> None:
    rows = dict(status_rows(tick(phase=phase, tracked=tracked, contact=contact)))
    text = rows.get("error", rows.get("contact"))
    assert shown in text if shown and text else shown == text
    assert "error" not in rows or "contact" not in rows


def test_keys_that_do_nothing_any_more_are_not_offered(terminal: Terminal) -> None:
    reporter = FlightPanel(terminal)
    reporter.help = STOP_HELP, KEY_HELP
    reporter.tick(tick(100.0, "COMPLETE"))
    until(lambda: STOP_HELP in terminal.getvalue())
    reporter.tick(tick(100.02, "PERCHED"))
    reporter.close()
    last = terminal.getvalue().rpartition("PERCHED")[0].rpartition("COMPLETE")[2]
    after = terminal.getvalue().rpartition("PERCHED")[2]
    assert KEY_HELP not in last
    assert STOP_HELP not in after


def test_a_display_that_fails_falls_silent_once() -> None:
    written = []

    class Failing(io.StringIO):
        def write(self, text: str) -> int:
            written.append(text)
            raise BrokenPipeError("gone")

    reporter = FlightPanel(Failing())
    reporter.event(entered(0.0, Phase.SEARCH, "x"))
    until(lambda: reporter.failure)
    assert reporter.failure == "the display failed: BrokenPipeError: gone"
    reporter.event(entered(1.0, Phase.ALIGN, "y"))
    reporter.tick(tick())
    reporter.close()
    assert len(written) == 1


def test_a_terminal_that_stands_still_does_not_stop_the_loop() -> None:
    """Ctrl-S: writing blocks; update and event return all the same."""
    gate = threading.Event()

    class Stuck(io.StringIO):
        def write(self, text: str) -> int:
            gate.wait(30.0)
            return super().write(text)

    stream = Stuck()
    reporter = FlightPanel(stream)
    for i in range(5000):
        reporter.event(note(0.02 * i, f"event {i}"))
        reporter.tick(tick(0.02 * i))
    assert stream.getvalue() == ""
    gate.set()
    reporter.close()
    lines = stream.getvalue().splitlines()
    assert lines[-1] == "[  99.98 s] event 4999"
    assert len(lines) <= 1001
