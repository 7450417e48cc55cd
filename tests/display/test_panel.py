"""The live display, and that nothing it does reaches the loop."""

from __future__ import annotations

import io
import math
import re
import threading
from dataclasses import replace

import pytest

from perchctl.display import FlightPanel
from perchctl.display.panel import status_rows
from perchctl.mission import ExternalPositions, Phase
from perchctl.mission.state import BatteryOutlook
from tests.helpers.live_page import tick
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
    reporter.tick(tick(phase="LANDING"))
    reporter.close()
    assert reporter.failure is None
    text = ESCAPE.sub("", terminal.getvalue())
    assert "link: radio://0/80/2M/E7E7E7E7E7 [ok] https://a.b" in text
    assert "x -12.3  y +4.5  z +123.4 cm   yaw -166.2 deg" in text
    assert COLOUR.search(terminal.getvalue())
    line = next(line for line in terminal.getvalue().splitlines() if "radio://" in line)
    assert not COLOUR.search(line)


def test_a_display_that_fails_falls_silent_once() -> None:
    written = []

    class Failing(io.StringIO):
        def write(self, text: str) -> int:
            written.append(text)
            raise BrokenPipeError("gone")

    reporter = FlightPanel(Failing())
    reporter.event(entered(0.0, Phase.SEARCH, "x"))
    until(lambda: reporter.failure)
    assert reporter.failure == "the display fell silent: BrokenPipeError: gone"
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


def test_the_rows_of_a_moment() -> None:
    rows = dict(status_rows(tick()))
    assert rows["phase"] == "ALIGN  1.2 s"
    assert rows["error"] == "x -12.3  y +4.5  z +123.4 cm   yaw -166.2 deg"
    assert rows["markers"] == "both   attempts 1"
    assert rows["height"].startswith("0.82 m")
    assert rows["ages"] == "link 12 ms   camera 50 ms   loop late 1 ms"
    assert "outside" not in rows
    outside = ExternalPositions(0.012, None, 300, 99.6, None)
    assert dict(status_rows(tick(outside=outside)))["outside"] == "position 100 Hz   12 ms"
    wrong = replace(outside, age_s=math.inf, problem="the rigid body 'cf2' is not seen")
    assert dict(status_rows(tick(outside=wrong)))["outside"] == wrong.problem
    rows = dict(status_rows(tick(tracked=False, e_yaw_rad=math.nan)))
    assert rows["error"].endswith("yaw - deg   (not seen)")
    rows = dict(status_rows(tick(e_m=None, camera_age_s=math.inf)))
    assert (rows["error"], rows["markers"]) == ("no target seen yet", "none   attempts 1")
    assert rows["ages"].startswith("link 12 ms   camera none")


@pytest.mark.parametrize(
    ("volts", "battery", "text"),
    [
        (3.71, BatteryOutlook(60.0, 2), "3.71 V, enough for 2 attempts"),
        (3.3, BatteryOutlook(10.0, 0), "3.30 V, not enough for an attempt"),
        (3.71, BatteryOutlook(60.0), "3.71 V, 60 s left"),
        (3.71, BatteryOutlook(), "3.71 V"),
        (math.nan, BatteryOutlook(), "unknown"),
    ],
)
def test_what_the_battery_is_enough_for(volts: float, battery: BatteryOutlook, text: str) -> None:
    rows = dict(status_rows(tick(battery_v=volts, battery=battery)))
    assert rows["height"] == f"0.82 m   battery {text}"
    assert len(rows["height"]) < 70
