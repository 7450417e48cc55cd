"""The flight log on a disk that fails: it never raises, and stays whole."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from perchctl.errors import InvalidValue
from perchctl.log import LogWatcher, read_log, write
from perchctl.log.write import FlightLogWriter
from perchctl.mission import FlightReport, Outcome, Phase
from tests.helpers import log as synthetic
from tests.helpers.small_log import _python, small_log


class FullDisk:
    """`os.write` on a disk with `room` bytes left."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.real = os.write

    def __call__(self, fd: int, data: Any) -> int:
        if self.room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        part = bytes(data[: self.room])
        self.room -= len(part)
        return self.real(fd, part)


def test_a_file_that_cannot_grow_never_raises_and_stays_whole(tmp_path: Path) -> None:
    """A real failing write: the process may not let a file grow beyond 20 kB."""
    path = tmp_path / "f.jsonl"
    code = (
        "import resource, signal, sys\n"
        "from pathlib import Path\n"
        "from perchctl.log.write import FlightLogWriter\n"
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
    lost, problem = _python(code, path).stdout.split(maxsplit=1)
    assert int(lost) > 100
    assert problem.startswith("the flight log cannot be written: File too large")
    log = read_log(path)
    assert log.truncated
    assert log.ignored_bytes == 0  # no piece of a record was left behind
    assert 0 < len(log.records) < 300


def test_a_full_disk_that_gets_room_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    disk = FullDisk(room=100)
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


def test_a_value_that_has_no_place_in_a_log_never_raises(tmp_path: Path) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    writer.write({"t_s": 0.0, "odd": object()})
    assert writer.formless is not None
    assert "object" in writer.formless
    writer.close(synthetic.SUMMARY)
    writer.close(synthetic.SUMMARY)
    writer.write({"t_s": 5.0})
    log = read_log(writer.path)
    assert log.records == []
    assert log.summary is not None


class Unruly(Mapping[str, Any]):
    """A record that fails as its line is made."""

    def __init__(self, error: type[Exception]) -> None:
        self._error = error

    def __getitem__(self, key: str) -> Any:
        raise self._error("odd")

    def __iter__(self) -> Iterator[str]:
        return iter(["t_s"])

    def __len__(self) -> int:
        return 1


@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize("error", [TypeError, ValueError, AttributeError, MemoryError])
def test_a_record_without_a_form_costs_itself_alone(
    tmp_path: Path, error: type[Exception], live: bool
) -> None:
    """The disk is well: nothing lands, what comes behind is written, and the end tells it."""
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header(), live=live)
    log = LogWatcher(writer)
    for i in range(4):
        writer.write({"t_s": 0.02 * i, "odd": Unruly(error)} if i == 1 else {"t_s": 0.02 * i})
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


def test_fsync_about_once_a_second_and_its_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def failing(fd: int) -> None:
        calls.append(fd)
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", failing)
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header(), live=True)
    for i in range(251):
        writer.write({"t_s": 100.0 + 0.02 * i})
    writer.close()
    assert 2 <= len(calls) <= 6  # at most five while flying, one at the end
    assert writer.problem is not None
    assert writer.lost_records == 0


def test_no_fsync_in_lockstep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fsync", lambda fd: pytest.fail("fsync in lockstep"))
    small_log(tmp_path / "f.jsonl", ticks=200)


def test_a_folder_that_cannot_be_made_is_refused_before_the_flight(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InvalidValue, match=r"log\.directory"):
        FlightLogWriter.open(tmp_path / "file" / "f.jsonl", synthetic.header())


def test_no_room_for_the_header_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "write", FullDisk(room=50))
    with pytest.raises(InvalidValue, match="No space left"):
        FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("failing", ["header", "thread"])
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
    with pytest.raises((TypeError, ValueError, RuntimeError)):
        FlightLogWriter.open(tmp_path / "f.jsonl", header, live=True)
    assert list(tmp_path.iterdir()) == []
    assert len(closed) == 1
    assert threading.active_count() == threads
