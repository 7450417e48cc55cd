"""A recording that is spoilt: the disk full, hung or too slow, the flight killed. The flight goes
on, what is there can be read, and what is missing is said."""

from __future__ import annotations

import io
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from perchctl.errors import InvalidValue
from perchctl.mission import FlightReport, Outcome, Phase
from perchctl.profile import Profile
from perchctl.record import (
    FlightSummary,
    LogWatcher,
    read_log,
    recorded_pictures,
    recording_file,
    summary_text,
)
from perchctl.record import recorder as recording_module
from perchctl.record.recorder import Recorder
from perchctl.record.write import FlightLogWriter
from tests.helpers import log as synthetic
from tests.helpers import recorded
from tests.helpers.disk import full_disk
from tests.helpers.recorded import MemoryDisk

WAIT_S = 20.0


def onto(disk: MemoryDisk, live: bool = False, profile: Profile = recorded.PROFILE) -> Recorder:
    return Recorder(Path("f.mcap"), disk, synthetic.header(), profile, live)


def pictures_on(disk: MemoryDisk, tmp_path: Path) -> list[int]:
    path = tmp_path / "f.mcap"
    path.write_bytes(disk.data)
    return [picture.number for picture in recorded_pictures(path)]


def until(met: Callable[[], object]) -> None:
    end_s = time.monotonic() + WAIT_S
    while not met():
        assert time.monotonic() < end_s, "did not come"
        time.sleep(0.005)


# -- a disk that is full --------------------------------------------------------------------


def test_a_full_disk_ends_the_recording_with_one_sentence(tmp_path: Path) -> None:
    disk, flight = MemoryDisk(room=110_000), recorded.flown(120)
    recorder = onto(disk)
    recorded.fly(recorder, flight)
    (said,) = recorder.take_remarks()
    assert "No space left on device" in said
    assert "the flight and its log go on" in said
    assert recorder.take_remarks() == []
    end = recorder.close()
    assert (end.problem, recorder.take_remarks()) == (said, [])
    assert end.pictures + end.missing == len(flight.frames)
    assert 0 < end.pictures < 60
    assert disk.closed
    assert pictures_on(disk, tmp_path)[: end.pictures] == list(range(end.pictures))
    # There was room for the end's few bytes, as there is where a great chunk was refused.
    reader = make_reader(io.BytesIO(bytes(disk.data)), validate_crcs=True)
    assert len(list(reader.iter_messages(topics=["/tick"]))) > 40


def test_the_disk_s_last_is_left_to_the_log(tmp_path: Path) -> None:
    disk = MemoryDisk()
    recorder, flight = onto(disk), recorded.flown(120)
    recorded.fly(recorder, recorded.Flown(flight.frames[:60], flight.ticks[:120]))
    disk.free = recording_module.RESERVE_BYTES - 1
    recorded.fly(recorder, recorded.Flown(flight.frames[60:], flight.ticks[120:]))
    (said,) = recorder.take_remarks()
    assert "200 MB are left" in said
    assert "kept for the log" in said
    end = recorder.close()
    assert 60 < end.pictures < 120
    summary = make_reader(io.BytesIO(bytes(disk.data))).get_summary()
    assert summary is not None  # it was ended well, with its index
    assert len(pictures_on(disk, tmp_path)) == end.pictures


def test_beyond_its_size_it_goes_on_without_pictures(tmp_path: Path) -> None:
    profile = recorded.PROFILE
    small = profile.model_copy(update={"log": profile.log.model_copy(update={"max_mb": 0.15})})
    disk, flight = MemoryDisk(), recorded.flown(120)
    recorder = onto(disk, profile=small)
    recorded.fly(recorder, flight)
    (said,) = recorder.take_remarks()
    assert "log.max_mb" in said
    assert "0.15" in said
    end = recorder.close()
    assert end.pictures == len(pictures_on(disk, tmp_path)) < 120
    assert end.missing == 120 - end.pictures
    found = recorded.messages(tmp_path / "f.mcap")
    assert len(found["/tick"]) == len(flight.ticks)
    assert len(found["/camera/frame"]) == 120
    pictures_bytes = sum(len(image.data) for image in found["/camera/image"])
    assert pictures_bytes < 150_000


def test_what_cannot_be_encoded_ends_it_and_nothing_else() -> None:
    recorder, flight = onto(MemoryDisk()), recorded.flown(4)
    recorder.frame(flight.frames[0])
    recorder.tick({"t_s": 1.2, "phase": object()})
    (said,) = recorder.take_remarks()
    assert "TypeError" in said
    recorded.fly(recorder, flight)
    assert recorder.close().missing == 5


def test_a_place_that_cannot_be_written_is_refused_before_the_flight(tmp_path: Path) -> None:
    with pytest.raises(InvalidValue, match="--no-record"):
        recorded.recorder(tmp_path / "missing" / "f.mcap")
    there = tmp_path / "f.mcap"
    there.write_bytes(b"another flight's")
    with pytest.raises(InvalidValue):
        recorded.recorder(there)
    assert there.read_bytes() == b"another flight's"
    with full_disk(0), pytest.raises(InvalidValue, match="cannot be begun"):
        recorded.recorder(tmp_path / "g.mcap")
    assert not (tmp_path / "g.mcap").exists()


# -- a disk that hangs or is too slow -----------------------------------------------------------


@pytest.fixture
def hung(monkeypatch: pytest.MonkeyPatch) -> Iterator[MemoryDisk]:
    """A disk whose gate a test closes; it is opened at the end."""
    monkeypatch.setattr(recording_module, "CLOSE_TIMEOUT_S", WAIT_S)
    disk = MemoryDisk()
    yield disk
    disk.gate.set()


def test_a_disk_that_hangs_holds_up_nobody(
    hung: MemoryDisk, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The queue's place for pictures is used up, and then its place for turns."""
    held_bytes = recording_module._Turn(recorded.frame(0, 1.0, as_jpeg=True)).held_bytes
    monkeypatch.setattr(recording_module, "MOST_PICTURE_BYTES", 10 * held_bytes)
    monkeypatch.setattr(recording_file, "CHUNK_BYTES", 1)
    recorder, flight = onto(hung, live=True), recorded.flown(120)
    hung.gate.clear()
    began_s = time.monotonic()
    recorded.fly(recorder, flight)
    assert time.monotonic() - began_s < 2.0  # 240 turns; the disk answers none of them
    (said,) = recorder.take_remarks()
    assert "does not keep up" in said
    hung.gate.set()
    until(lambda: recorder._done_bytes == recorder._handed_bytes)
    recorder.frame(recorded.frame(200, 20.0, as_jpeg=True))
    recorder.tick({**flight.ticks[-1], "t_s": 20.0})
    end = recorder.close()
    kept = pictures_on(hung, tmp_path)
    assert end.pictures == len(kept)
    assert end.pictures + end.missing == 121
    assert 10 <= len(kept) <= 13  # and it goes on with the next that there is room for
    assert kept[-1] == 200


def test_a_queue_that_is_full_drops_turns(
    hung: MemoryDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_module, "MOST_BEHIND", 20)
    recorder = onto(hung, live=True)
    hung.gate.clear()
    recorded.fly(recorder, recorded.flown(60))
    (said,) = recorder.take_remarks()
    assert "turns are missing" in said


def test_closing_does_not_wait_for_ever(hung: MemoryDisk, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording_module, "CLOSE_TIMEOUT_S", 0.1)
    recorder = onto(hung, live=True)
    hung.gate.clear()
    recorded.fly(recorder, recorded.flown(10))
    began_s = time.monotonic()
    end = recorder.close()
    assert time.monotonic() - began_s < 5.0
    assert end.problem is not None
    assert "does not answer" in end.problem
    assert end.missing == 10 - end.pictures > 0
    hung.gate.set()
    until(lambda: hung.closed)  # should the disk ever answer, nothing stays open


# -- live and in lockstep -----------------------------------------------------------------------


def test_live_and_in_lockstep_it_holds_the_same(tmp_path: Path) -> None:
    """In lockstep to the byte, and without a thread."""
    flight, before = recorded.flown(60), threading.active_count()
    for name, live in (("live", True), ("a", False), ("b", False)):
        recorder = recorded.recorder(tmp_path / f"{name}.mcap", live=live)
        assert threading.active_count() == before + live
        recorded.fly(recorder, flight)
        end = recorder.close()
        assert (end.pictures, end.missing, end.problem) == (60, 0, None)
    live_one, one, other = (tmp_path / f"{name}.mcap" for name in ("live", "a", "b"))
    assert str(recorded.messages(live_one)) == str(recorded.messages(one))
    assert one.read_bytes() == other.read_bytes()


def test_frames_before_the_first_tick_are_kept_and_repetitions_are_not(tmp_path: Path) -> None:
    """The pipeline has seen them: a replay begins with them."""
    recorder, flight = recorded.recorder(tmp_path / "f.mcap"), recorded.flown(8)
    for frame in flight.frames:
        recorder.frame(frame)
    recorder.frame(replace(flight.frames[-1], repeated=True))
    assert recorder.close().pictures == 8
    found = recorded.messages(tmp_path / "f.mcap")
    assert (len(found["/camera/image"]), len(found["/camera/frame"])) == (8, 9)


# -- a flight that is killed -------------------------------------------------------------------


def test_a_file_that_was_cut_gives_what_is_whole(tmp_path: Path) -> None:
    """Wherever it is cut: what a killed process leaves is a beginning of its file."""
    whole = tmp_path / "whole.mcap"
    recorder, flight = recorded.recorder(whole), recorded.flown(120)
    recorded.fly(recorder, flight)
    recorder.close()
    data = whole.read_bytes()
    counts = []
    for cut in [*range(64, len(data), len(data) // 25), len(data) - 20]:
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        found = list(recorded_pictures(path))
        assert [p.number for p in found] == list(range(len(found)))
        assert all((p.image == flight.frames[p.number].image).all() for p in found)
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == 120
    assert len(set(counts)) > 3  # chunk by chunk, about one a second


def test_a_killed_program_leaves_what_is_older_than_a_second(tmp_path: Path) -> None:
    """The system has every chunk that was flushed, without the file being closed."""
    path = tmp_path / "f.mcap"
    recorder, flight = recorded.recorder(path), recorded.flown(120)
    recorded.fly(recorder, flight)
    found = [p.t_s for p in recorded_pictures(path)]  # as another program sees it now
    last_s = flight.frames[-1].t_s
    assert last_s - 1.2 < found[-1] < last_s
    assert os.path.getsize(path) > 0
    recorder.close()


def test_what_is_wrong_with_it_is_no_problem_of_the_log_s(tmp_path: Path) -> None:
    """For which the vehicle would land."""
    writer = FlightLogWriter.open(tmp_path / "f.jsonl", synthetic.header())
    disk = MemoryDisk()
    log = LogWatcher(writer, onto(disk))
    disk.room = 0
    log.event(recorded.EVENT)
    for tick in recorded.flown(1).ticks:
        assert log._recorder is not None
        log._recorder.tick(tick)
    assert log.problem is None
    (said,) = log.remarks()
    assert "No space left" in said
    assert log.remarks() == []
    summary = log.close(FlightReport(Phase.PERCHED, Outcome.PERCHED, "hanging", 1, 9.0, False))
    assert summary is not None
    assert summary.log_problem is None
    assert f"0 pictures in f.mcap ({said})" in summary_text(summary)
    read = FlightSummary.of(read_log(tmp_path / "f.jsonl")).recording
    assert read is not None
    assert (read.pictures, read.problem) == (0, said)
    assert read.path == tmp_path / "f.mcap"


def test_a_flight_that_never_began_leaves_no_file(tmp_path: Path) -> None:
    log = LogWatcher.real_time(tmp_path, recorded.PROFILE, "usb://0", "camera:0", record=True)
    assert {path.suffix for path in tmp_path.iterdir()} == {".jsonl", ".mcap"}
    log.abandon("no vehicle answers")
    assert not list(tmp_path.iterdir())


def test_log_and_recording_share_a_name_that_neither_had(tmp_path: Path) -> None:
    (tmp_path / "f.mcap").write_bytes(b"another flight's")
    log = LogWatcher.lockstep(tmp_path / "f.jsonl", recorded.PROFILE, 1, record=True)
    log.close()
    assert {path.name for path in tmp_path.iterdir()} == {"f.mcap", "f_2.jsonl", "f_2.mcap"}
    assert (tmp_path / "f.mcap").read_bytes() == b"another flight's"
