"""A disk that hangs or is full: the flight goes on, and it is said."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from perchctl.commands import fly
from perchctl.errors import LogIncomplete
from perchctl.flight import FlyOptions, SessionResult
from perchctl.log import FlightSummary, LogWatcher, read_log, summary_text, write
from perchctl.log.disk import BackgroundWriter
from perchctl.log.write import FlightLogWriter
from perchctl.mission import FlightReport, Outcome, Phase, Turn, TurnInputs
from perchctl.profile import load_profile
from tests.helpers import log as synthetic
from tests.helpers.mission import note


class HungDisk:
    """`os.write` that returns when it is let go."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self._real = os.write

    def __call__(self, fd: int, data: Any) -> int:
        self.gate.wait(10.0)
        return self._real(fd, data)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[HungDisk]:
    hung = HungDisk()
    monkeypatch.setattr(write, "CLOSE_TIMEOUT_S", 0.2)
    monkeypatch.setattr(write, "BEHIND_S", 0.5)  # 50 records
    yield hung
    hung.gate.set()


def test_a_disk_that_hangs_holds_up_nobody(
    tmp_path: Path, disk: HungDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header(), live=True)
    monkeypatch.setattr(os, "write", disk)
    began_s = time.monotonic()
    for i in range(80):
        writer.write({"t_s": 0.02 * i})
    assert time.monotonic() - began_s < 1.0
    assert writer.problem is not None
    assert "does not keep up" in writer.problem
    assert 28 <= writer.lost_records <= 30  # 50 wait, one is being written
    disk.gate.set()
    writer.close(synthetic.SUMMARY)
    log = read_log(writer.path)
    assert len(log.records) == 80 - writer.lost_records
    assert log.summary is not None
    assert log.summary["lost_records"] == writer.lost_records
    assert log.summary["problem"] == writer.problem


def test_closing_does_not_wait_for_ever(
    tmp_path: Path, disk: HungDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header(), live=True)
    monkeypatch.setattr(os, "write", disk)
    for i in range(10):
        writer.write({"t_s": 0.02 * i})
    began_s = time.monotonic()
    writer.close(synthetic.SUMMARY)
    assert time.monotonic() - began_s < 2.0
    assert writer.problem is not None
    assert "does not answer" in writer.problem
    assert writer.lost_records == 11  # the summary too
    held = writer._file._fd
    disk.gate.set()
    assert writer._writer._thread is not None
    writer._writer._thread.join(20.0)
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(held)


@pytest.mark.parametrize("loop_hz", [50.0, 200.0])
def test_half_a_minute_may_wait_and_turns_give_way_to_ticks_and_events(
    tmp_path: Path, disk: HungDisk, monkeypatch: pytest.MonkeyPatch, loop_hz: float
) -> None:
    writer = FlightLogWriter.open(
        tmp_path / "f.jsonl", synthetic.header(), live=True, loop_hz=loop_hz
    )
    monkeypatch.setattr(os, "write", disk)
    places = round(0.5 * 2 * loop_hz)
    for i in range(places):
        writer.turn(Turn(i, "flown", i / loop_hz, i / loop_hz, TurnInputs()))
    taken = places - writer.lost_records
    assert taken in (round(0.8 * places), round(0.8 * places) + 1)  # one is being written
    lost = writer.lost_records
    for i in range(places // 10):
        writer.write({"t_s": 1.0 + i / loop_hz})
        writer.event(note(1.0 + i / loop_hz, "odd"))
    assert writer.lost_records == lost
    writer.write({"t_s": 9.0})
    writer.write({"t_s": 9.1})
    assert writer.lost_records > lost  # and it is bounded


def test_a_live_log_has_every_record_in_order(tmp_path: Path) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header(), live=True)
    written = list(synthetic.ticks())
    for record in written:
        writer.write(record)
    writer.close(synthetic.SUMMARY)
    assert (writer.problem, writer.lost_records) == (None, 0)
    assert [r["t_s"] for r in read_log(writer.path).records] == pytest.approx(
        [r["t_s"] for r in written]
    )


def test_a_job_that_raises_does_not_end_the_thread() -> None:
    done: list[int] = []

    def fails() -> None:
        raise AttributeError("odd")

    behind = BackgroundWriter(10, "test", live=True)
    for job in (fails, lambda: done.append(1), fails):
        assert behind.put(job)
    assert behind.finish(lambda: done.append(2), 20.0, fails) == 0
    assert done == [1, 2]


def test_lockstep_writes_without_a_thread(tmp_path: Path) -> None:
    before = threading.active_count()
    log = LogWatcher.lockstep(tmp_path / "f.jsonl", load_profile("sim"), 1)
    assert threading.active_count() == before
    log.close()


def test_the_summary_says_what_the_log_lacks() -> None:
    whole = FlightSummary("perched", "hanging still")
    assert "log lost" not in summary_text(whole)
    lost = FlightSummary("perched", "hanging still", lost_records=7, log_problem="disk full")
    assert "log lost:  7 records (disk full)" in summary_text(lost)
    unsynced = FlightSummary("perched", "hanging still", log_problem="I/O error")
    assert "log lost:  perhaps its last records (I/O error)" in summary_text(unsynced)


@pytest.mark.parametrize(
    ("outcome", "full", "code"),
    [
        (Outcome.PERCHED, False, 0),
        (Outcome.PERCHED, True, LogIncomplete.exit_code),
        (Outcome.OPERATOR, True, 130),
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

    def session(options: FlyOptions, log: LogWatcher, *rest: Any) -> SessionResult:
        for record in list(synthetic.ticks())[:5]:
            log.writer.write(record)
        return SessionResult(FlightReport(Phase.PERCHED, outcome, "hanging still", 1, 9.0, False))

    profile = load_profile("sim")
    quiet = profile.model_copy(update={"log": profile.log.model_copy(update={"plot": False})})
    options = FlyOptions(quiet, Path("sim.yaml"), "sim://", "sim:", log_dir=tmp_path)
    monkeypatch.setattr(fly, "_session", session)
    if full:
        monkeypatch.setattr(os, "write", no_room)
    assert fly.fly(options, as_json=True, port=None) == code
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert told["exit_code"] == code
    assert (told["log_problem"] is not None) is full
    assert (told["lost_records"] > 0) is full
    assert ("No space left on device" in said.err) is full
