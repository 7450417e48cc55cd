"""The flight log on a disk that is full, fails or hangs: the flight goes on, the log stays whole,
and what it lacks is said."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from perchctl.commands import fly
from perchctl.errors import InvalidValue, LogIncomplete
from perchctl.flight import FlyOptions
from perchctl.mission import FlightReport, Outcome, Phase, Turn, TurnInputs
from perchctl.profile import changed_profile, load_profile
from perchctl.record import LogWatcher, exact, read_log, write
from perchctl.record.write import FlightLogWriter
from tests.helpers import log as synthetic
from tests.helpers.log import run_python
from tests.helpers.mission import note


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


def test_a_file_that_cannot_grow_never_raises_and_stays_whole(tmp_path: Path) -> None:
    """A real failing write: the process may not let a file grow beyond 20 kB."""
    path = tmp_path / "f.jsonl"
    code = (
        "import resource, signal, sys\n"
        "from pathlib import Path\n"
        "from perchctl.record.write import FlightLogWriter\n"
        "from tests.helpers import log as synthetic\n"
        "from tests.helpers.mission import note\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))\n"
        "w = FlightLogWriter.open(Path(sys.argv[1]), synthetic.header())\n"
        "for i in range(300):\n"
        "    w.write({'t_s': 0.02 * i, 'reason': 'x' * 200})\n"
        "w.event(note(6.1, 'still flying'))\n"
        "w.close(synthetic.SUMMARY)\n"
        "print(w.lost_records, w.problem)\n"
    )
    lost, problem = run_python(code, path).stdout.split(maxsplit=1)
    assert int(lost) > 100
    assert problem.startswith("the flight log cannot be written: File too large")
    log = read_log(path)
    assert log.truncated
    assert log.ignored_bytes == 0  # no piece of a record was left behind
    assert 0 < len(log.records) < 300


def test_a_full_disk_that_gets_room_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    disk = Disk(room=100)
    monkeypatch.setattr(os, "write", disk)
    for i in range(10):
        writer.write({"t_s": 0.02 * i, "phase": "SEARCH"})
    assert writer.problem == "the flight log cannot be written: No space left on device"
    lost = writer.lost_records
    assert lost > 5
    disk.room = 10**9
    writer.write({"t_s": 0.21, "phase": "SEARCH"})  # too soon after the failure
    assert writer.lost_records == lost + 1
    writer.write({"t_s": 2.0, "phase": "ALIGN"})
    writer.close(synthetic.SUMMARY)
    log = read_log(writer.path)
    assert log.records[-1]["phase"] == "ALIGN"
    assert log.ignored_bytes == 0
    assert log.summary is not None
    assert log.summary["lost_records"] == lost + 1
    assert log.summary["problem"] == writer.problem


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("error", [TypeError, MemoryError])
def test_a_record_without_a_form_costs_itself_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception], live: bool
) -> None:
    """The disk is well: nothing lands, what comes behind is written, and the end tells it."""

    def encode(record: Mapping[str, Any]) -> bytes:
        if record.get("odd"):
            raise error("odd")
        return exact.encode(record)

    monkeypatch.setattr(write, "encode", encode)
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header(), live=live)
    log = LogWatcher(writer)
    for i in range(4):
        writer.write({"t_s": 0.02 * i, "odd": i == 1})
    report = FlightReport(Phase.PERCHED, Outcome.PERCHED, "hanging", 1, 9.0, False)
    summary = log.close(report)
    assert log.problem is None
    assert [r["t_s"] for r in read_log(writer.path).records] == [0.0, 0.04, 0.06]
    (said,) = log.remarks()
    assert "no form" in said
    assert log.remarks() == []
    assert summary is not None
    assert (summary.lost_records, summary.log_problem) == (1, said)
    end = read_log(writer.path).summary
    assert end is not None
    assert (end["lost_records"], end["problem"]) == (1, said)


@pytest.mark.parametrize("live", [False, True])
def test_fsync_about_once_a_second_where_it_is_live(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, live: bool
) -> None:
    calls: list[int] = []

    def failing(fd: int) -> None:
        calls.append(fd)
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", failing)
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header(), live=live)
    for i in range(251):
        writer.write({"t_s": 100.0 + 0.02 * i})
    writer.close()
    assert 2 <= len(calls) <= 6 if live else not calls  # at most five in flight, one at the end
    assert (writer.problem is not None) is live
    assert writer.lost_records == 0


def test_a_folder_that_cannot_be_made_is_refused_before_the_flight(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidValue, match=r"log\.directory"):
        FlightLogWriter.open(tmp_path / "file" / "f.jsonl", synthetic.header())


@pytest.mark.parametrize("failing", ["disk", "header", "thread"])
def test_a_log_that_cannot_begin_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    """Whatever the error: no file, no descriptor, no thread."""

    def no_thread(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    closed, threads = list[int](), threading.active_count()
    close = os.close
    monkeypatch.setattr(os, "close", lambda fd: (closed.append(fd), close(fd)))
    if failing == "thread":
        monkeypatch.setattr(write, "BackgroundWriter", no_thread)
    header = synthetic.header() | ({"odd": object()} if failing == "header" else {})
    if failing == "disk":
        monkeypatch.setattr(os, "write", Disk(room=50))
    errors = {"disk": InvalidValue, "header": TypeError, "thread": RuntimeError}
    with pytest.raises(errors[failing]):
        FlightLogWriter.open(tmp_path / "f.jsonl", header, live=True)
    assert list(tmp_path.iterdir()) == []
    assert len(closed) == 1
    assert threading.active_count() == threads


# --- a disk that hangs -------------------------------------------------------------------------


@pytest.fixture(params=[50.0])
def hung(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[FlightLogWriter, Disk]]:
    """A log in real time with room for half a second, and its disk, which hangs."""
    monkeypatch.setattr(write, "CLOSE_TIMEOUT_S", 0.2)
    monkeypatch.setattr(write, "BEHIND_S", 0.5)
    writer = FlightLogWriter.open(
        tmp_path / "f.jsonl", synthetic.header(), live=True, loop_hz=request.param
    )
    disk = Disk()
    disk.gate.clear()
    monkeypatch.setattr(os, "write", disk)
    yield writer, disk
    disk.gate.set()


def test_a_disk_that_hangs_holds_up_nobody(hung: tuple[FlightLogWriter, Disk]) -> None:
    writer, disk = hung
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


def test_closing_does_not_wait_for_ever(hung: tuple[FlightLogWriter, Disk]) -> None:
    writer, disk = hung
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


@pytest.mark.parametrize(("hung", "loop_hz"), [(50.0, 50.0), (200.0, 200.0)], indirect=["hung"])
def test_half_a_minute_may_wait_and_turns_give_way_to_ticks_and_events(
    hung: tuple[FlightLogWriter, Disk], loop_hz: float
) -> None:
    writer, _ = hung
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

    def session(options: FlyOptions, log: LogWatcher, *rest: Any) -> Any:
        for record in list(synthetic.ticks())[:5]:
            log.writer.write(record)
        return FlightReport(Phase.PERCHED, outcome, "hanging still", 1, 9.0, False), None

    quiet = changed_profile(load_profile("sim"), ["log.plot=false"])
    options = FlyOptions(quiet, Path("sim.yaml"), "sim://", "sim:", log_dir=tmp_path)
    monkeypatch.setattr(fly, "_session", session)
    if full:
        monkeypatch.setattr(os, "write", no_room)
    assert fly.fly_and_report(options, as_json=True, port=None) == code
    said = capsys.readouterr()
    told = json.loads(said.out)
    assert told["exit_code"] == code
    assert (told["log_problem"] is not None) is full
    assert (told["lost_records"] > 0) is full
    assert ("No space left on device" in said.err) is full
