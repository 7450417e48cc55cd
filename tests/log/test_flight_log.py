"""The flight log: what is written comes back, whatever happens on the way."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perchctl.errors import InvalidValue, NotFound
from perchctl.log import write
from perchctl.log.fields import FIELDS, tick_record
from perchctl.log.jsonl import to_plain
from perchctl.log.place import log_path
from perchctl.log.read import read_log
from perchctl.log.watch import LogWatcher
from perchctl.log.write import FlightLogWriter
from perchctl.mission.state import BatteryOutlook, Outcome, Phase
from perchctl.mission.watch import FlightReport, Outside
from perchctl.vehicle import (
    EmergencyStop,
    ExternalPosition,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)
from perchctl.vision.consistency import Consistency
from tests.helpers import log as synthetic
from tests.helpers.mission import held, note

STARTED = datetime(2024, 3, 1, 14, 5, 9, tzinfo=UTC)


def small_log(path: Path, ticks: int = 5) -> Path:
    writer = FlightLogWriter.open(path, synthetic.header())
    for i in range(ticks):
        writer.write({"t_s": 0.02 * i, "phase": "SEARCH", "z_m": 0.1 * i})
        writer.event(note(0.02 * i, f"event {i}"))
    writer.close(synthetic.SUMMARY)
    assert writer.problem is None
    return writer.path


# --- the way out and back ----------------------------------------------------


def test_a_flight_comes_back(tmp_path: Path) -> None:
    writer = FlightLogWriter.open(tmp_path / "new" / "f.jsonl", synthetic.header())
    written = list(synthetic.ticks())
    for record in written:
        writer.write(record)
    writer.event(held(1.5, "no picture"))
    writer.close(synthetic.SUMMARY)
    log = read_log(writer.path)
    assert log.header["profile"]["name"] == "sim"
    assert log.header["seed"] == 7
    assert log.header["fields"] == FIELDS
    assert len(log.records) == len(written)
    for back, record in zip(log.records, written, strict=True):
        assert list(back) == list(FIELDS)
        assert back == to_plain(record)
    assert log.events == [
        {"t_s": 1.5, "event": "hold", "phase": "ALIGN", "severity": "hold", "reason": "no picture"}
    ]
    assert log.summary is not None
    assert log.summary["miss_m"] == 0.0031
    assert (log.truncated, log.ignored_bytes) == (False, 0)
    assert [(p.phase, round(p.duration_s, 2)) for p in log.phases] == [
        (phase, duration_s) for phase, duration_s, _ in synthetic.PLAN
    ]


def test_the_same_flight_gives_the_same_bytes(tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        writer = FlightLogWriter.open(tmp_path / name / "f.jsonl", synthetic.header())
        for record in synthetic.ticks(seed=3):
            writer.write(record)
        writer.close(synthetic.SUMMARY)
        files.append(writer.path.read_bytes())
    assert files[0] == files[1]
    assert b"started_utc" not in files[0]


def test_each_record_is_in_the_file_at_once(tmp_path: Path) -> None:
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    for i in range(3):
        writer.write({"t_s": float(i)})
        assert len(read_log(writer.path).records) == i + 1
    writer.close()
    assert read_log(writer.path).truncated  # closed, but without a summary


def test_names_and_no_overwriting(tmp_path: Path) -> None:
    path = log_path(tmp_path, "my profile/€", STARTED)
    assert path.name == "flight_20240301_140509_my-profile.jsonl"
    paths = []
    for _ in range(3):
        writer = FlightLogWriter.open(path, synthetic.header(started=STARTED))
        writer.close()
        paths.append(writer.path.name)
    assert paths == [
        "flight_20240301_140509_my-profile.jsonl",
        "flight_20240301_140509_my-profile_2.jsonl",
        "flight_20240301_140509_my-profile_3.jsonl",
    ]
    assert read_log(path).header["started_utc"] == "2024-03-01T14:05:09+00:00"


def test_commands_and_telemetry_in_a_record() -> None:
    def of(command: Any) -> dict[str, Any]:
        return tick_record(
            t_s=1.0,
            telemetry=synthetic.telemetry(0.99, 0.8),
            output=None,
            target=None,
            phase="PERCH",
            reason="settled",
            command=command,
        )

    assert of(PositionSetpoint(1.0, 2.0, 3.0, 0.5))["cmd_z_m"] == 3.0
    assert of(RawThrust(60000))["cmd_thrust"] == 60000
    assert of(Land(-0.05, 2.5))["cmd_duration_s"] == 2.5
    assert of(Land(-0.05, 2.0))["cmd_z_m"] == -0.05
    names = [of(c)["cmd"] for c in (Idle(), StopMotors(), EmergencyStop(), None)]
    assert names == ["idle", "stop", "emergency", None]
    record = of(Idle())
    assert set(record) == set(FIELDS)
    assert record["tel_age_s"] == pytest.approx(0.01)
    assert (record["z_m"], record["ex_m"], record["stage"]) == (0.8, None, None)


def test_every_field_is_filled_by_something() -> None:
    """No documented key that nothing writes."""
    rng = np.random.default_rng(1)
    pose = synthetic.target(1.0, 1.6)
    seen: set[str] = set()
    frame = synthetic.output(3, pose, rng)
    frame.poses["joint"] = frame.poses["large"]
    frame = replace(frame, lock_note="not the tracked target")
    commands = (Land(-0.05, 2.0), PositionSetpoint(0.0, 0.0, 1.0, 0.1), RawThrust(1))
    for command in commands:
        record = tick_record(
            t_s=1.0,
            telemetry=synthetic.telemetry(),
            output=frame,
            target=pose,
            phase="ALIGN",
            reason="steady",
            hold="no picture",
            command=command,
            camera_age_s=0.1,
            consistency=Consistency(0.01, 0.004, (0.01, 0.02, 0.03), (0.01, 0.01, 0.02)),
            delay_used_s=0.005,
            outside=Outside(
                0.012,
                "hidden",
                7,
                99.0,
                ExternalPosition((1.0, 2.0, 0.5), (1.0, 0.0, 0.0, 0.0)),
            ),
            battery=BatteryOutlook(60.0, 3, 12.5, 3.9),
            true_position_m=(0.0, 0.0, 1.0),
            true_miss_m=0.01,
        )
        seen |= {key for key, value in record.items() if value is not None}
    assert set(FIELDS) - seen == {"var_m2"}  # this vehicle does not report it


def _python(code: str, path: Path) -> subprocess.CompletedProcess[str]:
    """Run the code in a process of its own, with the path as its argument."""
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", code, str(path)]
    return subprocess.run(command, cwd=root, check=False, capture_output=True, text=True)


# --- failures of the disk ----------------------------------------------------


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
        monkeypatch.setattr(write, "Behind", no_thread)
    header = synthetic.header() | ({"odd": object()} if failing == "header" else {})
    with pytest.raises((TypeError, ValueError, RuntimeError)):
        FlightLogWriter.open(tmp_path / "f.jsonl", header, live=True)
    assert list(tmp_path.iterdir()) == []
    assert len(closed) == 1
    assert threading.active_count() == threads


# --- reading damaged files -------------------------------------------------------


def test_any_cut_of_the_file_is_readable_behind_its_header(tmp_path: Path) -> None:
    data = small_log(tmp_path / "f.jsonl").read_bytes()
    header = data.index(b"\n") + 1
    cut = tmp_path / "cut.jsonl"
    for length in range(header, len(data) - 1):
        cut.write_bytes(data[:length])
        log = read_log(cut)
        assert log.truncated
        whole = data[:length].rfind(b"\n") + 1
        # A last line that lacks only its newline is whole.
        assert log.ignored_bytes in (length - whole, 0)
        kept = len(log.records) + len(log.events) + (log.summary is not None)
        assert kept == data[:whole].count(b"\n") - 1 + (length > whole and log.ignored_bytes == 0)


def test_zeros_after_a_power_cut_are_ignored(tmp_path: Path) -> None:
    path = small_log(tmp_path / "f.jsonl")
    path.write_bytes(path.read_bytes() + b"\0" * 4096)
    log = read_log(path)
    assert len(log.records) == 5
    assert log.ignored_bytes == 4096
    assert log.truncated


def test_a_killed_writer_leaves_a_readable_log(tmp_path: Path) -> None:
    """A process that dies without a word, in the middle of its flight."""
    path = tmp_path / "f.jsonl"
    code = (
        "import os, sys\n"
        "from pathlib import Path\n"
        "from perchctl.log.write import FlightLogWriter\n"
        "from tests.helpers import log as synthetic\n"
        "from tests.helpers.mission import note\n"
        "w = FlightLogWriter.open(Path(sys.argv[1]), synthetic.header(), live=True)\n"
        "for n, record in enumerate(synthetic.ticks()):\n"
        "    w.write(record)\n"
        "    while n == 150 and Path(sys.argv[1]).read_bytes().count(b'\\n') < 152: pass\n"
        "    if n == 150: os.kill(os.getpid(), 9)\n"
    )
    done = _python(code, path)
    assert done.returncode == -signal.SIGKILL
    log = read_log(path)
    assert len(log.records) == 151
    assert log.truncated


def test_not_a_flight_log(tmp_path: Path) -> None:
    def refused(content: bytes, match: str) -> None:
        path = tmp_path / "x.jsonl"
        path.write_bytes(content)
        with pytest.raises(InvalidValue, match=match):
            read_log(path)

    good = small_log(tmp_path / "f.jsonl").read_bytes().splitlines(keepends=True)
    refused(b"", "line 1: the file is empty")
    refused(b"\x89PNG\r\n\x1a\n" + bytes(100), "line 1: not a flight log")
    refused(b'{"kind":"header"}\n', "line 1: not a flight log")
    refused(b"[1]\n", "line 1: not a flight log")
    refused(good[0][:-20], "line 1: not a flight log")
    refused(good[0].replace(b'"version":4', b'"version":99'), "line 1: schema version 99")
    refused(b"".join([*good[:3], b"garbage\n", *good[3:]]), "line 4: not a record")
    refused(b"".join([*good[:3], b'{"kind":"tick"}\n', *good[3:]]), "line 4: .*t_s must be")
    refused(b"".join([*good[:2], b'{"kind":"?","t_s":1}\n', *good[3:]]), "line 3: .*allowed are")
    refused(b"".join([*good[:2], b'{"kind":"tick","t_s":NaN}\n', *good[3:]]), "line 3: .*NaN")
    refused(b"".join([*good[:2], b"[" * 100_000 + b"\n", *good[3:]]), "line 3")


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="does not exist"):
        read_log(tmp_path / "none.jsonl")
    with pytest.raises(NotFound, match="is a folder"):
        read_log(tmp_path)


def test_columns(tmp_path: Path) -> None:
    log = read_log(small_log(tmp_path / "f.jsonl"))
    np.testing.assert_allclose(log.column("z_m"), [0.0, 0.1, 0.2, 0.3, 0.4])
    assert np.isnan(log.column("ex_m")).all()
    with pytest.raises(InvalidValue, match="phase is not a number"):
        log.column("phase")
    assert json.dumps(log.header)  # plain values only
