"""Those who look on: one that raises is left out, the others hear of it, and the flight goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from perchctl.analysis import replay
from perchctl.display import FlightPage, FlightPanel
from perchctl.errors import LogIncomplete, SafetyAbort
from perchctl.flight import fly
from perchctl.flight.watching import SLOW_WATCHER_S
from perchctl.mission import (
    Event,
    EventKind,
    FlightReport,
    OperatorRequest,
    Outcome,
    SentCommand,
    Tick,
    TickRecord,
)
from perchctl.perception import perception
from perchctl.record import LogWatcher, read_log
from perchctl.vehicle import PositionSetpoint
from perchctl.vision import Frame
from tests.helpers.loop_rig import Broken, Rig, Vehicle, Watcher, hung_rig

BREAKS_S = 1.2
LANDS_S = 3.0


@dataclass
class Breaks:
    """A watcher of which one part raises from `BREAKS_S` on."""

    part: str
    error: BaseException = field(default_factory=lambda: Broken("by the test"))
    name: str = "the display"
    now: Callable[[], float] = lambda: BREAKS_S
    calls: int = 0

    def _called(self, part: str) -> None:
        if part == self.part and self.now() >= BREAKS_S:
            self.calls += 1
            raise self.error

    def frame(self, frame: Frame) -> None:
        self._called("frame")

    def tick(self, tick: Tick) -> None:
        self._called("tick")

    def event(self, event: Event) -> None:
        self._called("event")

    @property
    def problem(self) -> str | None:
        self._called("problem")
        return None


class BreaksAsALog(Breaks):
    def turn(self, turn: TickRecord) -> None:
        self._called("turn")

    def sent(self, sent: SentCommand) -> None:
        self._called("sent")


def ordered(rig: Rig) -> Rig:
    """The rig, with the order to land at `LANDS_S`."""

    def land() -> OperatorRequest:
        return OperatorRequest.LAND if rig.link.now_s > LANDS_S else OperatorRequest.NONE

    rig.operator = land
    return rig


def flown(*broken: Breaks, rig: Rig | None = None, **parts: Any) -> tuple[FlightReport, Watcher]:
    """A flight with these and a watcher that works, which lands on the operator's order."""
    rig, works = ordered(rig or Rig()), Watcher()
    for each in broken:
        if each.part != "turn":  # which is called before take-off
            each.now = lambda: rig.link.now_s
    report = fly(replace(rig.parts(), watchers=(*broken, works), **parts))
    assert rig.link.said(PositionSetpoint)[-1] > BREAKS_S + 1.0  # it flew on
    return report, works


def notes(watcher: Watcher) -> list[str]:
    return [event.reason for event in watcher.events if event.kind is EventKind.NOTE]


@pytest.mark.parametrize(
    "part", ["frame", "tick", "event", pytest.param("problem", marks=pytest.mark.long)]
)
def test_a_watcher_that_raises_is_left_out_and_named(part: str) -> None:
    breaks = Breaks(part)
    report, works = flown(breaks)
    assert report.outcome.value == "operator"
    assert breaks.calls == 1
    (said,) = report.detached_watcher_messages
    assert said.startswith("the display raised Broken: by the test (test_watching.py, line ")
    assert [note for note in notes(works) if note.startswith("the display raised Broken")] or (
        part == "event"  # at the landing: its note would come in the next tick
    )
    assert works.ticks[-1].state.phase.is_final


def test_a_watcher_without_a_name_is_named_by_its_class() -> None:
    report, _ = flown(Breaks("tick", name=""))
    assert report.detached_watcher_messages[0].startswith("Breaks raised Broken")


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(FlightPanel, marks=pytest.mark.long),
        pytest.param(FlightPage, marks=pytest.mark.long),
        LogWatcher,
    ],
)
def test_the_flight_s_own_watchers_have_names_for_people(kind: Any) -> None:
    own = object.__new__(kind)  # raises whatever it is called for
    own.problem = None
    rig = ordered(Rig())
    report = fly(replace(rig.parts(), watchers=(own,)))
    assert report.detached_watcher_messages[0].startswith("the ")


@pytest.mark.parametrize("lands", [False, True])
def test_a_log_that_raises_is_the_profile_s_to_judge(lands: bool) -> None:
    rig = Rig()
    rig.profile = rig.profile.with_({"safety.land_on_log_error": lands})
    breaks = BreaksAsALog("tick")
    rig, works = ordered(rig), Watcher()
    breaks.now = lambda: rig.link.now_s
    report = fly(replace(rig.parts(), watchers=(breaks, works)))
    assert ("the display raised Broken" in report.reason) is lands
    assert rig.link.said(PositionSetpoint)[-1] > BREAKS_S
    assert [note for note in notes(works) if "flight log is incomplete" in note]
    assert breaks.calls == 1


def test_the_file_of_a_log_that_raised_and_the_exit_code_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = ordered(Rig())
    rig.profile = rig.profile.with_({"safety.land_on_log_error": False})
    log = LogWatcher.open_lockstep(tmp_path / "flight.jsonl", rig.profile, seed=1)
    real = LogWatcher.turn

    def turn(self: LogWatcher, turn: TickRecord) -> None:
        if turn.t_s > BREAKS_S:
            raise Broken("by the test")
        real(self, turn)

    monkeypatch.setattr(LogWatcher, "turn", turn)
    summary = log.close(fly(replace(rig.parts(), watchers=(log,))))
    assert summary is not None
    assert summary.log_problem is not None
    assert summary.log_problem.startswith("the flight log raised Broken: by the test (")
    perched = replace(summary, cause=Outcome.PERCHED.value)
    assert perched.exit_code == LogIncomplete.exit_code
    written = read_log(log.path)
    assert written.summary is not None
    assert written.summary["problem"] == summary.log_problem
    assert [note for note in replay(written).notes if summary.log_problem in note]


@pytest.mark.parametrize("refuses", [False, True])
def test_a_log_that_raises_before_take_off_may_be_a_refusal(refuses: bool) -> None:
    rig = ordered(Rig())
    rig.profile = rig.profile.with_({"safety.land_on_log_error": refuses})
    breaks = BreaksAsALog("turn")
    if not refuses:
        assert flown(breaks, rig=rig)[0].detached_watcher_messages
        return
    with pytest.raises(SafetyAbort, match="flight log: the display raised Broken"):
        fly(replace(rig.parts(), watchers=(breaks,)))
    assert not rig.link.said(PositionSetpoint)


@pytest.mark.parametrize("error", [Broken("by the test"), SystemExit(1)])
def test_a_log_that_raises_in_the_link_s_thread_keeps_no_command_back(
    error: BaseException,
) -> None:
    """The guard lands a hanging loop, and tells of each command that it has sent."""
    rig, _ = hung_rig(1.0)
    breaks = BreaksAsALog("sent", error)
    breaks.now = lambda: BREAKS_S
    report = fly(replace(rig.parts(), watchers=(breaks,)))
    assert breaks.calls == 1
    assert report.detached_watcher_messages
    assert rig.link.z_m == 0.0


@pytest.mark.parametrize("error", [KeyboardInterrupt, SystemExit])
def test_an_exit_of_a_watcher_lands_first_and_is_raised(error: type[BaseException]) -> None:
    rig = Rig()
    breaks = Breaks("tick", error())
    breaks.now = lambda: rig.link.now_s
    with pytest.raises(error):
        fly(replace(rig.parts(), watchers=(breaks,)))
    assert rig.link.z_m == 0.0
    assert not rig.link.motors


@pytest.mark.parametrize("part", ["frame", "tick", "event", "problem"])
def test_a_judge_that_raises_lands_and_is_raised(part: str) -> None:
    """A simulated flight without its judge proves nothing."""
    rig = Rig()
    breaks = Breaks(part)
    breaks.now = lambda: rig.link.now_s
    with pytest.raises(Broken):
        fly(replace(rig.parts(), judges=(breaks,)))
    assert rig.link.z_m == 0.0


def test_remarks_that_raise_end_and_the_flight_does_not() -> None:
    asked = []

    def remarks() -> list[str]:
        asked.append(1)
        if len(asked) > 60:
            raise Broken("by the test")
        return ["the recording is full"] if len(asked) == 50 else []

    _, works = flown(remarks=remarks)
    assert len(asked) == 61
    assert "the recording is full" in notes(works)
    assert [note for note in notes(works) if note.startswith("perchctl no longer adds notes")]


def test_a_watcher_that_hangs_is_named_once() -> None:
    """The watchdog steers meanwhile."""
    rig = Rig(Vehicle())
    hung: list[float] = []

    def hang(tick: Tick) -> None:
        if tick.t_s > BREAKS_S and len(hung) < 2:
            hung.append(tick.t_s)
            rig.link.advance_to(rig.link.now_s + SLOW_WATCHER_S + 0.1)

    slow = Watcher(hang)
    report, works = flown(rig=rig, judges=(slow,))
    assert report.detached_watcher_messages == ()
    (said,) = [note for note in notes(works) if "not controlled" in note]
    assert said == "Watcher took 0.4 s, during which the flight was not controlled"
    assert len(hung) == 2


def test_what_was_left_out_hears_nothing_of_a_rescue_and_the_others_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rig, works = Rig(), Watcher()
    breaks = Breaks("tick")
    breaks.now = lambda: rig.link.now_s
    real = perception.step

    def step(*arguments: Any) -> Any:
        if rig.link.now_s > BREAKS_S + 0.5:
            raise Broken("by the camera")
        return real(*arguments)

    monkeypatch.setattr(perception, "step", step)
    with pytest.raises(Broken, match="by the camera") as failed:
        fly(replace(rig.parts(), watchers=(breaks, works)))
    assert breaks.calls == 1
    (said,) = failed.value.__notes__
    assert said.startswith("the display raised Broken: by the test")
    assert works.events[-1].rest_state is not None
