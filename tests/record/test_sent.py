"""What goes to the vehicle in the loop's place is in the log, and is told."""

from __future__ import annotations

from pathlib import Path

import pytest

from perchctl.analysis import FlightAnalysis, show_record, show_text
from perchctl.analysis.story import tell_story
from perchctl.flight import fly
from perchctl.flight.watchdog import rescue
from perchctl.mission import OperatorRequest, SentCommand
from perchctl.perception import History
from perchctl.record import LogWatcher, read_log
from perchctl.vehicle import EmergencyStop, Land, PositionSetpoint, RawThrust, StopMotors
from tests.helpers import log as synthetic
from tests.helpers.loop_rig import HANG_AT_S, PROFILE, Clock, Vehicle, hung_rig
from tests.helpers.mission import telemetry

HOLD, LAND = PositionSetpoint(0.1, 0.2, 1.0 / 3.0, 0.0), Land(-0.05, 2.0)
TOLD = (
    SentCommand(4.0, "watchdog", HOLD),
    SentCommand(4.05, "watchdog", HOLD),
    SentCommand(4.7, "watchdog", LAND),
    SentCommand(6.8, "watchdog", StopMotors()),
    SentCommand(9.0, "rescue", EmergencyStop()),
    SentCommand(9.5, "farewell", RawThrust(0)),
)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    writer = LogWatcher.open(tmp_path / "f.jsonl", synthetic.header())
    left = list(TOLD)
    for tick in synthetic.ticks():
        while left and left[0].t_s < tick["t_s"]:
            writer.sent(left.pop(0))
        writer.write(tick)
    writer.end(synthetic.SUMMARY)
    return writer.path


def test_what_one_sends_in_one_go_is_told_together(log: Path) -> None:
    """By show and by the story, which leaves the farewell out."""
    read = read_log(log)
    flight = FlightAnalysis(read)
    assert tuple(read.sent) == TOLD
    assert [go.by for go in flight.takeovers] == ["watchdog", "watchdog", "rescue", "farewell"]
    starts_s = [go.start_s + read.start_s for go in flight.takeovers]
    assert starts_s == pytest.approx([4.0, 6.8, 9.0, 9.5])
    assert "watchdog  position setpoint (2), land (1)" in show_text(flight)
    assert show_record(flight)["sent"][0]["commands"] == {"position setpoint": 2, "land": 1}
    told = [s for s in tell_story(flight) if "took over" in s.text]
    assert [s.t_s + read.start_s for s in told] == pytest.approx([4.0, 6.8, 9.0])
    assert told[0].text.endswith("for 0.7 s: position setpoint (2), land (1)")
    assert told[2].grade == "bad"


# --- who sends --------------------------------------------------------------------------------


def test_a_hung_loop_s_log_says_what_the_watchdog_sent(tmp_path: Path) -> None:
    rig, link = hung_rig(5.0)
    watcher = LogWatcher.open_lockstep(tmp_path / "f.jsonl", PROFILE, 1)
    parts = rig.parts()
    report = fly(type(parts)(**{**vars(parts), "watchers": (watcher,)}))
    watcher.close(report)
    read = read_log(watcher.path)
    assert [(each.t_s, each.command) for each in read.sent] == link.own
    (go,) = FlightAnalysis(read).takeovers
    assert go.start_s + read.start_s == pytest.approx(HANG_AT_S + 0.3, abs=0.08)
    assert go.commands["land"] > 0
    assert not read.truncated


def test_a_rescue_s_orders_are_told() -> None:
    link, told = Vehicle(), []
    flown = History((telemetry(0.0, 1.0),))
    rescue(
        link, Clock(link), PROFILE, lambda: OperatorRequest.NONE, None, flown, on_sent=told.append
    )
    assert told
    assert [(each.t_s, each.command) for each in told] == link.sent
    assert {each.sender for each in told} == {"rescue"}
