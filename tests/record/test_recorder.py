"""The recorder never costs the flight anything: not when its disk is full, fails, hangs or is too
slow, and what it wrote by then is readable."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from perchctl.errors import InvalidValue
from perchctl.mission import FlightReport, Outcome, Phase
from perchctl.record import FlightSummary, LogWatcher, read_log, recorded_pictures
from perchctl.record import recorder as recording_module
from perchctl.record.recorder import Recorder
from tests.helpers import log as synthetic
from tests.helpers import recorded
from tests.helpers.disk import full_disk
from tests.helpers.mission import changed
from tests.helpers.recorded import MemoryDisk
from tests.helpers.waiting import stopwatch, until

WAIT_S = 20.0


def onto(disk: Any, live: bool = False, max_mb: float = 1000.0) -> Recorder:
    profile = changed({"log.max_mb": max_mb}, recorded.PROFILE)
    return Recorder(Path("f.mcap"), disk, synthetic.header(), profile, live)


def pictures_on(disk: MemoryDisk, tmp_path: Path) -> list[int]:
    path = tmp_path / "f.mcap"
    path.write_bytes(disk.data)
    return [picture.number for picture in recorded_pictures(path)]


# -- what ends a recording ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said", "whole"),
    [
        ({"room": 110_000}, "No space left on device", False),
        ({"free": recording_module.RESERVE_BYTES - 1}, "are reserved for the log", True),
        ({"max_mb": 0.15}, "log.max_mb in the profile, 0.15", True),
        ({"tick": {"t_s": 1.9, "phase": object()}}, "TypeError", False),
    ],
)
def test_what_ends_the_recording_is_one_sentence_and_the_flight_goes_on(
    tmp_path: Path, change: dict[str, Any], said: str, whole: bool
) -> None:
    """A full disk, a disk with the log's last room, a recording as large as it may be, and what
    cannot be encoded."""
    disk, flight = MemoryDisk(), recorded.flown(120)
    recorder = onto(disk, max_mb=change.get("max_mb", 1000.0))
    recorded.fly(recorder, recorded.Flown(flight.frames[:60], flight.ticks[:120]))
    disk.room, disk.free = change.get("room"), change.get("free", 10**12)
    if "tick" in change:
        recorder.write_tick(change["tick"])
    recorded.fly(recorder, recorded.Flown(flight.frames[60:], flight.ticks[120:]))
    end = recorder.close()
    assert said in (end.recording_problem or "")
    assert "the flight and its log continue" in (end.recording_problem or "")
    assert end.pictures + end.pictures_missing == len(flight.frames)
    assert 0 < end.pictures < 120
    assert disk.closed
    assert pictures_on(disk, tmp_path) == list(range(end.pictures))
    with (tmp_path / "f.mcap").open("rb") as stream:
        assert whole is (len(disk.data) > 8 and disk.data[-8:] == b"\x89MCAP0\r\n")
        if whole:
            assert make_reader(stream, validate_crcs=True).get_summary() is not None


def test_a_place_that_cannot_be_written_is_refused_before_the_flight(tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match="--no-record"):
        recorded.recorder(tmp_path / "missing" / "f.mcap")
    there = tmp_path / "f.mcap"
    there.write_bytes(b"another flight's")
    with pytest.raises(InvalidValue):
        recorded.recorder(there)
    assert there.read_bytes() == b"another flight's"
    with full_disk(0), pytest.raises(InvalidValue, match="cannot be created"):
        recorded.recorder(tmp_path / "g.mcap")
    assert not (tmp_path / "g.mcap").exists()


# -- a disk that hangs or is too slow -----------------------------------------------------------


@pytest.fixture
def hung(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryDisk]:
    """A disk whose gate a test closes; it is opened at the end."""
    monkeypatch.setattr(recording_module, "RECORDING_CLOSE_TIMEOUT_S", WAIT_S)
    disk = MemoryDisk()
    yield disk
    disk.gate.set()


def test_a_disk_that_hangs_holds_up_nobody(
    hung: MemoryDisk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """What may wait is used up; it goes on with the next turn that there is room for."""
    monkeypatch.setattr(recording_module, "MOST_WAITING_BYTES", 300_000)
    monkeypatch.setattr(recording_module, "CHUNK_BYTES", 1)
    recorder, flight = onto(hung, live=True), recorded.flown(120)
    hung.gate.clear()
    with stopwatch() as watch:
        recorded.fly(recorder, flight)
        assert watch.took_s < 2.0  # 240 turns; the disk answers none of them
    assert "cannot keep up" in (recorder.problem or "")
    hung.gate.set()
    until(lambda: recorder._writer._left == 0)
    recorder.write_frame(recorded.frame(200, 20.0, as_jpeg=True))
    recorder.write_tick({**flight.ticks[-1], "t_s": 20.0})
    end = recorder.close()
    kept = pictures_on(hung, tmp_path)
    assert end.pictures == len(kept)
    assert end.pictures + end.pictures_missing == 121
    assert 10 <= len(kept) <= 15
    assert kept[-1] == 200


# -- live and in lockstep -----------------------------------------------------------------------


def test_live_and_in_lockstep_it_holds_the_same(tmp_path: Path) -> None:
    """In lockstep to the byte, and without a thread."""
    flight, before = recorded.flown(60), threading.active_count()
    for name, live in (("live", True), ("a", False), ("b", False)):
        recorder = recorded.recorder(tmp_path / f"{name}.mcap", live=live)
        assert threading.active_count() == before + live
        recorded.fly(recorder, flight)
        end = recorder.close()
        assert (end.pictures, end.pictures_missing, end.recording_problem) == (60, 0, None)
    live_one, one, other = (tmp_path / f"{name}.mcap" for name in ("live", "a", "b"))
    assert str(recorded.messages(live_one)) == str(recorded.messages(one))
    assert one.read_bytes() == other.read_bytes()


def test_frames_before_the_first_tick_are_kept_and_repetitions_are_not(tmp_path: Path) -> None:
    """The pipeline has seen them: a replay begins with them."""
    recorder, flight = recorded.recorder(tmp_path / "f.mcap"), recorded.flown(8)
    for frame in flight.frames:
        recorder.write_frame(frame)
    recorder.write_frame(replace(flight.frames[-1], is_repeated=True))
    assert recorder.close().pictures == 8
    found = recorded.messages(tmp_path / "f.mcap")
    assert (len(found["/camera/image"]), len(found["/camera/frame"])) == (8, 9)


# -- a flight that is killed -------------------------------------------------------------------


def test_what_is_left_by_a_killed_flight_gives_what_is_whole(tmp_path: Path) -> None:
    """Wherever the file ends: it is a beginning, and about a second is lost."""
    path, cut_path = tmp_path / "f.mcap", tmp_path / "cut.mcap"
    recorder, flight = recorded.recorder(path), recorded.flown(120)
    recorded.fly(recorder, flight)
    found = [p.t_s for p in recorded_pictures(path)]  # as another program sees it now
    last_s = flight.frames[-1].t_s
    assert last_s - 1.2 < found[-1] < last_s
    recorder.close()
    data, counts = path.read_bytes(), []
    for cut in [*range(64, len(data), len(data) // 25), len(data) - 20]:
        cut_path.write_bytes(data[:cut])
        pictures = list(recorded_pictures(cut_path))
        assert [p.number for p in pictures] == list(range(len(pictures)))
        assert all((p.image == flight.frames[p.number].image).all() for p in pictures)
        counts.append(len(pictures))
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, 120)
    assert len(set(counts)) > 3  # chunk by chunk, about one a second


# -- beside the log -----------------------------------------------------------------------------


def closed(log: LogWatcher) -> FlightSummary:
    summary = log.close(FlightReport(Phase.PERCHED, Outcome.PERCHED, "hanging", 1, 9.0, False))
    assert summary is not None
    assert (summary.lost_records, summary.log_problem) == (0, None)
    return summary


def test_what_is_wrong_with_it_is_no_problem_of_the_log_s(tmp_path: Path) -> None:
    """For which the vehicle would land."""
    log, disk = LogWatcher.open(tmp_path / "f.jsonl", synthetic.header()), MemoryDisk()
    log.recorder = onto(disk)
    disk.room = 0
    for tick in recorded.flown(1).ticks:
        log.recorder.write_tick(tick)
    assert log.problem is None
    (said,) = log.remarks()
    assert "No space left" in said
    assert log.remarks() == []
    assert f"0 pictures in f.mcap ({said})" in closed(log).text()


def test_the_log_is_whole_before_the_recording_s_end_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hung: MemoryDisk
) -> None:
    monkeypatch.setattr(recording_module, "RECORDING_CLOSE_TIMEOUT_S", 0.1)
    log = LogWatcher.open(tmp_path / "f.jsonl", synthetic.header(), live=True)
    log.recorder = onto(hung, live=True)
    recorded.fly(log.recorder, recorded.flown(10))
    hung.gate.clear()
    with stopwatch() as watch:
        end = closed(log).recording
        assert watch.took_s < 5.0
    assert end is not None
    assert "does not respond" in (end.recording_problem or "")
    assert end.pictures_missing == 10 - end.pictures
    assert read_log(log.path).summary is not None
    hung.gate.set()
    until(lambda: hung.closed)  # should the disk ever answer, it is ended


def test_a_flight_that_never_began_leaves_no_file(tmp_path: Path) -> None:
    log = LogWatcher.open_real_time(tmp_path, recorded.PROFILE, "usb://0", "camera:0", record=True)
    assert {path.suffix for path in tmp_path.iterdir()} == {".jsonl", ".mcap"}
    log.abandon("no vehicle answers")
    assert not list(tmp_path.iterdir())


def test_log_and_recording_share_a_name_that_neither_had(tmp_path: Path) -> None:
    (tmp_path / "f.mcap").write_bytes(b"another flight's")
    log = LogWatcher.open_lockstep(tmp_path / "f.jsonl", recorded.PROFILE, 1, record=True)
    log.close()
    assert {path.name for path in tmp_path.iterdir()} == {"f.mcap", "f_2.jsonl", "f_2.mcap"}
    assert (tmp_path / "f.mcap").read_bytes() == b"another flight's"
