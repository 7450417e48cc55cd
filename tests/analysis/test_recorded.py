"""The pictures of a report come out of the recording that lies beside the log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perchctl.analysis import FlightAnalysis
from perchctl.analysis.report import decisions_of, reported_flight
from perchctl.profile import Profile
from perchctl.record.recorder import Recorder
from perchctl.vision import Frame
from tests.helpers import log as synthetic
from tests.helpers.told import flown_s, made, written


def grey(number: int) -> np.ndarray:
    return np.full((48, 64), 20 + number % 200, np.uint8)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A flight with a picture for each of its frames beside it."""
    path = written(tmp_path / "flight.jsonl")
    frames = [r for r in made().records if r["frame"] is not None]
    recorder = Recorder.open(
        path.with_suffix(".mcap"), synthetic.header(), Profile(name="sim"), False
    )
    for record in frames:
        t_s = float(record["frame_t_s"])
        recorder.frame(Frame(int(record["frame"]), t_s, grey(int(record["frame"])), t_s + 0.05))
    end = recorder.close()
    assert (end.pictures, end.problem) == (len(frames), None)
    return path


def test_a_report_shows_the_picture_of_each_decision(log: Path) -> None:
    flight = reported_flight(log)
    assert flight.pictures is not None
    assert [s.decision for s in flight.pictures] == list(decisions_of(flight.flight))
    for shown in flight.pictures:
        image = cv2.imdecode(np.frombuffer(shown.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert abs(int(image[-2, -2]) - int(grey(shown.decision.frame)[0, 0])) <= 2


def test_a_recording_that_is_none_costs_the_pictures_only(tmp_path: Path) -> None:
    path = written(tmp_path / "flight.jsonl")
    path.with_suffix(".mcap").write_bytes(b"no recording at all")
    flight = reported_flight(path)
    assert flight.pictures == ()
    assert "flight.mcap" in flight.picture_problem
    assert str(tmp_path) not in flight.picture_problem
    assert flight.outcome == "perched"


def test_an_old_picture_says_from_when_it_is() -> None:
    """The last centimetres are flown without one: it shows another moment than the contact's."""

    def blind(record: dict[str, Any]) -> None:
        if flown_s(record) > 14.5:
            record.update(dict.fromkeys([key for key in record if key.startswith("frame")]))

    (seen,) = [d for d in decisions_of(FlightAnalysis(made())) if d.name == "contact"]
    (old,) = [d for d in decisions_of(FlightAnalysis(made(blind))) if d.name == "contact"]
    assert "from" not in seen.caption
    assert old.caption.startswith("contact, 15.2 s; the picture is from 14.5 s")
