"""Two flights side by side: on one time, in one table, in one picture."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from perchctl.analysis import Comparison, FlightAnalysis, plot_comparison
from perchctl.analysis.plot import stretches, ticks_of
from perchctl.analysis.sight import Stay
from perchctl.errors import InvalidValue
from perchctl.log import FlightLog, read_log
from tests.helpers import log as synthetic


def spans(*stays: tuple[str, float]) -> list[Stay]:
    t_s, found = 10.0, []
    for phase, duration_s in stays:
        found.append(Stay(phase, t_s, t_s + duration_s))
        t_s += duration_s
    return found


def test_each_phase_begins_at_the_same_moment_in_both() -> None:
    one = spans(("APPROACH", 2.0), ("ALIGN", 1.0), ("PERCH", 1.0))
    other = spans(("APPROACH", 3.0), ("ALIGN", 0.5), ("PERCH", 2.0))
    found = stretches(one, other)
    assert [(s.phase, s.start_s, s.end_s) for s in found] == [
        ("APPROACH", 0.0, 3.0), ("ALIGN", 3.0, 4.0), ("PERCH", 4.0, 6.0),
    ]  # fmt: skip
    assert found[1].stays == (one[1], other[1])


def test_a_second_attempt_stands_alone_and_both_keep_their_order() -> None:
    one = spans(("ALIGN", 1.0), ("ASCEND", 1.0), ("PERCH", 1.0))
    other = spans(("ALIGN", 1.0), ("ASCEND", 1.0), ("RECOVER", 1.0), ("ALIGN", 1.0),
                  ("ASCEND", 1.0), ("PERCH", 1.0))  # fmt: skip
    found = stretches(one, other)
    assert [s.stays[0] for s in found if s.stays[0]] == one
    assert [s.stays[1] for s in found if s.stays[1]] == other
    assert sum(s.stays[0] is None for s in found) == 3


def test_the_ticks_of_a_stretch_lie_on_the_common_time() -> None:
    records = [{"t_s": 10.0 + 0.5 * i, "phase": "A" if i < 4 else "B"} for i in range(8)]
    log = FlightLog(Path("f.jsonl"), {}, records, [], None, True)
    longer = spans(("A", 5.0), ("B", 1.0))
    flight = FlightAnalysis(log)
    first, second = stretches(flight.stays, longer)
    inside, t_s = ticks_of(flight, second, 0)
    assert second.start_s == first.end_s == 5.0
    np.testing.assert_allclose(t_s, [5.0, 5.5, 6.0, 6.5])
    assert inside.sum() == 4
    assert ticks_of(flight, stretches([], longer)[0], 0)[1].size == 0


@pytest.fixture
def pair(tmp_path: Path) -> Comparison:
    """The second was killed in its ascent, and flown with another profile."""
    profile = synthetic.header()["profile"]
    profile = profile | {"camera": profile["camera"] | {"latency_s": 0.1}}
    del profile["log"]["plot"]
    one = synthetic.write(tmp_path / "one.jsonl", summary=synthetic.SUMMARY)
    other = synthetic.write(tmp_path / "other.jsonl", {"profile": profile}, most=500)
    return Comparison((FlightAnalysis(read_log(one)), FlightAnalysis(read_log(other))))


def test_what_differs_is_in_the_table(pair: Comparison) -> None:
    found = pair
    assert found.profile == {
        "camera.latency_s": (0.07, 0.1),
        "log.plot": (True, "not there"),
    }
    record = found.record()
    assert record["differences"]["turns"] == 500 - record["a"]["turns"]
    assert record["differences"]["miss_m"] is None  # the second flight's is not known
    (ascend,) = [p for p in record["phases"] if p["phase"] == "ASCEND"]
    assert (ascend["a_s"], ascend["a_visits"], ascend["b_visits"]) == (6.0, 1, 1)
    assert ascend["difference_s"] == pytest.approx(ascend["b_s"] - 6.0)
    text = found.text()
    assert max(map(len, text.splitlines())) <= 79
    assert "UNKNOWN: the log ends in ASCEND" in text
    assert "camera.latency_s                0.07  0.1" in text


def test_a_flight_beside_itself(pair: Comparison) -> None:
    found = Comparison((pair.flights[0], pair.flights[0]))
    assert "their profiles are the same" in found.text()
    assert {d for d in found.record()["differences"].values() if d is not None} == {0}


@pytest.mark.long
def test_both_are_drawn(pair: Comparison, tmp_path: Path) -> None:
    plot_comparison(pair, tmp_path / "both.png")
    image = cv2.imread(str(tmp_path / "both.png"))
    assert image is not None
    for rgb in ((0x00, 0x72, 0xB2), (0xD5, 0x5E, 0x00)):
        near = np.abs(image.astype(int) - np.array(rgb[::-1])).max(axis=2) < 12
        assert near.mean() > 5e-4


def test_nothing_to_draw_is_said(pair: Comparison, tmp_path: Path) -> None:
    bare = FlightLog(Path("bare.jsonl"), {}, [], [], None, True)
    with pytest.raises(InvalidValue, match=r"bare\.jsonl: the log holds no ticks"):
        plot_comparison(Comparison((pair.flights[0], FlightAnalysis(bare))), tmp_path / "both.png")
