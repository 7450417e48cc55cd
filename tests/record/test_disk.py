"""The flight log on a disk that is full, fails or hangs: the flight goes on, the log stays whole,
and what it lacks is said."""

from __future__ import annotations

import errno
import json
import os
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from perchctl.commands import fly
from perchctl.errors import InvalidValue, LogIncomplete
from perchctl.flight import FlyOptions
from perchctl.mission import (
    Event,
    EventKind,
    FlightReport,
    Outcome,
    Phase,
    SentCommand,
)
from perchctl.profile import apply_settings, load_profile
from perchctl.record import LogWatcher, exact, read_log, write
from perchctl.vehicle import EmergencyStop, Idle
from tests.helpers import log as synthetic
from tests.helpers.disk import full_disk
from tests.helpers.mission import state_with
from tests.helpers.waiting import stopwatch


class Disk:
    """`os.write` on a disk with `room` bytes left, which hangs while its gate is closed."""

    def __init__(self, room: int = 10**9) -> None:
        self.room = room
        self.gate = threading.Event()
        self.gate.set()
        self._real = os.write

    def __call__(self, fd: int, data: Any) -> int:
        self.gate.wait(10.0)
        if self.room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        part = bytes(data[: self.room])
        self.room -= len(part)
        return self._real(fd, part)


def opened(folder: Path, live: bool = False, **header: Any) -> LogWatcher:
    return LogWatcher.open(folder / "f.jsonl", synthetic.header() | header, live)


def test_a_full_disk_that_gets_room_again(tmp_path: Path) -> None:
    """A real failing write: the process may not let a file grow."""
    writer = opened(tmp_path)
    with full_disk(writer.path.stat().st_size + 100):
        for i in range(10):
            writer.write({"t_s": 0.02 * i, "phase": "SEARCH"})
    lost = writer.lost_records
    assert lost > 5
    assert writer.problem == "the flight log cannot be written: File too large"
    writer.write({"t_s": 2.0, "phase": "ALIGN"})
    writer.end(synthetic.SUMMARY)
    log = read_log(writer.path)
    assert (log.records[-1]["phase"], len(log.records)) == ("ALIGN", 11 - lost)
    assert log.ignored_bytes == 0  # no piece of a record was left behind
    assert log.summary is not None
    assert (log.summary["lost_records"], log.summary["problem"]) == (lost, writer.problem)


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("error", [TypeError, MemoryError])
def test_a_record_without_a_form_costs_itself_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception], live: bool
) -> None:
    """The disk is well: nothing lands, what comes behind is written, and the end tells it."""

    def encode(record: Mapping[str, Any]) -> bytes:
        if record.get("odd"):
            raise error("odd")
        return exact.encode_line(record)

    monkeypatch.setattr(write, "encode_line", encode)
    log = LogWatcher.open(tmp_path / "f.jsonl", synthetic.header(), live)
    for i in range(4):
        log.write({"t_s": 0.02 * i, "odd": i == 1})
    summary = log.close(FlightReport(Phase.PERCHED, Outcome.PERCHED, "hanging", 1, 9.0, False))
    assert log.problem is None
    assert [r["t_s"] for r in read_log(log.path).records] == [0.0, 0.04, 0.06]
    assert summary is not None
    assert summary.lost_records == 1
    assert "cannot be encoded" in (summary.log_problem or "")
    end = read_log(log.path).summary
    assert end is not None
    assert (end["lost_records"], end["problem"]) == (1, summary.log_problem)


def test_a_tick_without_a_form_costs_itself_alone(tmp_path: Path) -> None:
    """A log that raised would be left out of its flight."""
    log = LogWatcher.open(tmp_path / "f.jsonl", synthetic.header())
    for t_s, command in ((1.0, Idle()), (1.02, "fly!"), (1.04, Idle())):
        log.tick(synthetic.tick(t_s, synthetic.telemetry(), command, state_with()))  # type: ignore[arg-type]
    summary = log.close(FlightReport(Phase.PERCHED, Outcome.PERCHED, "hanging", 1, 9.0, False))
    assert [r["t_s"] for r in read_log(log.path).records] == [1.0, 1.04]
    assert summary is not None
    assert summary.lost_records == 1
    assert "cannot be encoded" in (summary.log_problem or "")


def no_truth() -> Any:
    raise ZeroDivisionError("by the test")


def test_an_event_or_a_truth_without_a_form_costs_itself_alone(tmp_path: Path) -> None:
    log = LogWatcher.open(tmp_path / "f.jsonl", synthetic.header())
    good = Event(1.0, EventKind.NOTE, "by the test", Phase.SEARCH)
    for event in (good, replace(good, kind="odd"), replace(good, t_s=1.04)):  # type: ignore[arg-type]
        log.event(event)
    log.truth = no_truth
    log.tick(synthetic.tick(1.06, synthetic.telemetry(), Idle(), state_with()))
    summary = log.close(FlightReport(Phase.PERCHED, Outcome.PERCHED, "hanging", 1, 9.0, False))
    assert [event["t_s"] for event in read_log(log.path).events] == [1.0, 1.04]
    assert summary is not None
    assert summary.lost_records == 2
    assert log.problem is None


@pytest.mark.parametrize("live", [False, True])
def test_fsync_about_once_a_second_where_it_is_live(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, live: bool
) -> None:
    calls: list[int] = []

    def failing(fd: int) -> None:
        calls.append(fd)
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", failing)
    writer = opened(tmp_path, live)
    for i in range(251):
        writer.write({"t_s": 100.0 + 0.02 * i})
    writer.end()
    assert 2 <= len(calls) <= 6 if live else not calls  # at most five in flight, one at the end
    assert (writer.problem is not None) is live
    assert writer.lost_records == 0


@pytest.mark.parametrize("failing", ["folder", "disk", "header", "thread"])
def test_a_log_that_cannot_begin_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    """It is refused before the flight; no file, no descriptor and no thread stays."""

    def no_thread(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    closed, threads, folder = list[int](), threading.active_count(), tmp_path / "logs"
    close = os.close
    monkeypatch.setattr(os, "close", lambda fd: (closed.append(fd), close(fd)))
    if failing == "folder":
        folder.write_text("in the way")
    if failing == "thread":
        monkeypatch.setattr(write, "BackgroundWriter", no_thread)
    if failing == "disk":
        monkeypatch.setattr(os, "write", Disk(room=50))
    errors = {"header": TypeError, "thread": RuntimeError}
    with pytest.raises(errors.get(failing, InvalidValue)) as refused:
        opened(folder, True, **({"odd": object()} if failing == "header" else {}))
    assert failing in errors or "log.directory" in str(refused.value)
    assert failing == "folder" or not [*folder.glob("*")]
    assert len(closed) == (failing in ("disk", "thread"))
    assert threading.active_count() == threads


# --- a disk that hangs -------------------------------------------------------------------------


@pytest.fixture
def hung(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[LogWatcher, Disk]]:
    """A log in real time with room for 50 records, and its disk, which hangs."""
    monkeypatch.setattr(write, "LOG_CLOSE_TIMEOUT_S", 0.2)
    monkeypatch.setattr(write, "MOST_WAITING", 50)
    writer = opened(tmp_path, True)
    disk = Disk()
    disk.gate.clear()
    monkeypatch.setattr(os, "write", disk)
    yield writer, disk
    disk.gate.set()


def test_a_disk_that_hangs_holds_up_nobody(hung: tuple[LogWatcher, Disk]) -> None:
    writer, disk = hung
    with stopwatch() as watch:
        for i in range(80):
            writer.write({"t_s": 0.02 * i})
            writer.sent(SentCommand(0.02 * i, "watchdog", EmergencyStop()))
        assert watch.took_s < 1.0
    assert "cannot keep up" in (writer.problem or "")
    assert writer.lost_records == 110
    disk.gate.set()
    writer.end(synthetic.SUMMARY)
    log = read_log(writer.path)
    assert (len(log.records), len(log.sent)) == (25, 25)
    assert log.summary is not None
    assert (log.summary["lost_records"], log.summary["problem"]) == (110, writer.problem)


def test_closing_does_not_wait_for_ever(hung: tuple[LogWatcher, Disk]) -> None:
    writer, disk = hung
    for i in range(10):
        writer.write({"t_s": 0.02 * i})
    with stopwatch() as watch:
        writer.end(synthetic.SUMMARY)
        assert watch.took_s < 2.0
    assert "does not respond" in (writer.problem or "")
    assert writer.lost_records == 11  # the summary too
    disk.gate.set()
    assert writer._writer._thread is not None
    writer._writer._thread.join(20.0)
    log = read_log(writer.path)  # the disk answered after all
    assert log.summary is not None
    assert (len(log.records), log.summary.get("problem")) == (10, None)


@pytest.mark.parametrize(
    ("outcome", "full", "code"),
    [
        (Outcome.PERCHED, False, 0),
        (Outcome.PERCHED, True, LogIncomplete.exit_code),
        (Outcome.ENDED_BY_OPERATOR, True, 130),
    ],
)
def test_a_full_disk_is_in_the_exit_code_of_a_good_flight(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    outcome: Outcome,
    full: bool,
    code: int,
) -> None:
    real = os.write

    def no_room(fd: int, data: Any) -> int:
        if b'"kind":"tick"' in bytes(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(fd, data)

    def session(options: FlyOptions, log: LogWatcher, *rest: Any) -> Any:
        log.write({"t_s": 0.0, "phase": "PERCHED"})
        return FlightReport(Phase.PERCHED, outcome, "hanging still", 1, 9.0, False), None

    quiet = apply_settings(load_profile("sim"), ["log.plot=false"])
    options = FlyOptions(quiet, Path("sim.yaml"), "sim://", "sim:", log_dir=tmp_path)
    monkeypatch.setattr(fly, "_session", session)
    if full:
        monkeypatch.setattr(os, "write", no_room)
    assert fly.fly_and_report(options, as_json=True, view=False) == code
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert (told["exit_code"], told["lost_records"]) == (code, int(full))
    assert ("No space left on device" in said.err) is full


@pytest.mark.parametrize(("outcome", "code"), [(Outcome.PERCHED, 30), (Outcome.SAFETY, 52)])
def test_a_result_that_stdout_does_not_take_is_in_the_exit_code(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    outcome: Outcome,
    code: int,
) -> None:
    def session(*_: Any) -> Any:
        return FlightReport(Phase.PERCHED, outcome, "hanging still", 1, 9.0, False), None

    quiet = apply_settings(load_profile("sim"), ["log.plot=false"])
    options = FlyOptions(quiet, Path("sim.yaml"), "sim://", "sim:", log_dir=tmp_path)
    monkeypatch.setattr(fly, "_session", session)
    with open("/dev/full", "w") as full:
        monkeypatch.setattr("sys.stdout", full)
        assert fly.fly_and_report(options, as_json=False, view=False) == code
    assert "the result cannot be written: No space left on device" in capsys.readouterr().err
