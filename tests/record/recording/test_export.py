"""An MCAP file of a log: what the recording would say, with its pictures where they are."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from perchctl.errors import InvalidValue
from perchctl.record import export_mcap, recorded_pictures
from perchctl.record.write import FlightLogWriter
from tests.helpers import log as synthetic
from tests.helpers import recorded

FLIGHT = recorded.flown(60)
HEADER = {"t0_s": 1.0}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A log and its recording."""
    writer = FlightLogWriter.open(tmp_path / "flight.jsonl", synthetic.header(**HEADER))
    recorder = recorded.recorder(tmp_path / "flight.mcap", **HEADER)
    for n, tick in enumerate(FLIGHT.ticks):
        if n == 3:
            writer.event(recorded.EVENT)
        writer.write(tick)
    writer.close(synthetic.SUMMARY)
    recorded.fly(recorder, FLIGHT)
    recorder.close()
    return writer.path


def test_it_says_what_the_recording_says(log: Path, tmp_path: Path) -> None:
    done = export_mcap(log, tmp_path / "out.mcap")
    assert (done.pictures, done.notes) == (60, ())
    told, flown = (
        recorded.messages(path) for path in (tmp_path / "out.mcap", tmp_path / "flight.mcap")
    )
    assert set(told) == set(flown)
    for topic in ("/camera/image", "/camera/frame", "/camera/calibration"):
        assert [str(each) for each in told[topic]] == [str(each) for each in flown[topic]]
    for one, other in zip(told["/tick"], flown["/tick"], strict=True):
        assert json.loads(one) == pytest.approx(json.loads(other), abs=2e-6)
    for one, other in zip(told["/tf"], flown["/tf"], strict=True):
        for a, b in zip(one.transforms, other.transforms, strict=True):
            assert a.child_frame_id == b.child_frame_id
            for part in ("translation", "rotation"):
                assert _values(getattr(a, part)) == pytest.approx(
                    _values(getattr(b, part)), abs=2e-6
                )
    (event,) = told["/log"]
    assert event.message == "LANDING: target not found"


def _values(message: Any) -> list[float]:
    return [getattr(message, field.name) for field in message.DESCRIPTOR.fields]


def test_its_pictures_are_the_flights_to_the_bit(log: Path, tmp_path: Path) -> None:
    export_mcap(log, tmp_path / "out.mcap")
    found = list(recorded_pictures(tmp_path / "out.mcap"))
    assert [(p.number, p.t_s) for p in found] == [(f.index, f.t_s) for f in FLIGHT.frames]
    assert all((p.image == FLIGHT.frames[p.number].image).all() for p in found)


def test_a_log_alone_is_told_without_pictures(log: Path, tmp_path: Path) -> None:
    (tmp_path / "flight.mcap").unlink()
    done = export_mcap(log, tmp_path / "out.mcap")
    assert done.pictures == 0
    (note,) = done.notes
    assert note.startswith("without pictures")
    found = recorded.messages(tmp_path / "out.mcap")
    assert len(found["/tf"]) == len(FLIGHT.ticks)
    assert "/camera/calibration" in found
    assert "/camera/image" not in found


def test_a_cut_recording_becomes_a_whole_file(log: Path, tmp_path: Path) -> None:
    """In its own place, where that is asked for."""
    recording = tmp_path / "flight.mcap"
    recording.write_bytes(recording.read_bytes()[:150_000])
    kept = len(list(recorded_pictures(recording)))
    assert 0 < kept < 60
    done = export_mcap(log, recording, overwrite=True)
    assert done.pictures == kept
    assert len(recorded.messages(recording)["/camera/image"]) == kept


@pytest.mark.parametrize("name", ["out.mcap", "out.foxglove.json"])
def test_what_is_there_is_not_overwritten(log: Path, tmp_path: Path, name: str) -> None:
    there = tmp_path / name
    there.write_text("mine")
    with pytest.raises(InvalidValue, match="--force"):
        export_mcap(log, tmp_path / "out.mcap")
    assert there.read_text() == "mine"
    assert len(list(tmp_path.iterdir())) == 3
    export_mcap(log, tmp_path / "out.mcap", overwrite=True)
    assert there.read_bytes() != b"mine"


def test_the_layout_lies_beside_it(log: Path, tmp_path: Path) -> None:
    done = export_mcap(log, tmp_path / "sub" / "out.mcap")
    assert done.layout == tmp_path / "sub" / "out.foxglove.json"
    assert set(json.loads(done.layout.read_text())) >= {"configById", "layout"}


def test_an_older_log_of_an_unknown_profile_gives_what_it_has(log: Path, tmp_path: Path) -> None:
    lines = log.read_text().splitlines(keepends=True)
    header = json.loads(lines[0])
    header["profile"] = {"camera": {"lens": "unheard of"}}
    log.write_text(json.dumps(header) + "\n" + "".join(lines[1:]))
    done = export_mcap(log, tmp_path / "out.mcap")
    assert "mounting" in done.notes[0]
    found = recorded.messages(tmp_path / "out.mcap")
    assert {t.child_frame_id for t in found["/tf"][-1].transforms} == {"body", "setpoint"}
    assert len(found["/camera/image"]) == 60
