"""Two flights side by side in one table."""

from __future__ import annotations

from pathlib import Path

import pytest

from perchctl.analysis import FlightAnalysis, FlightComparison
from perchctl.record import read_log
from tests.helpers import log as synthetic


@pytest.fixture
def pair(tmp_path: Path) -> FlightComparison:
    """The second was killed in its ascent, and flown with another profile."""
    profile = synthetic.header()["profile"]
    profile = profile | {"camera": profile["camera"] | {"latency_s": 0.1, "mask": "a.png"}}
    del profile["log"]["plot"]
    one = synthetic.write(tmp_path / "one.jsonl", summary=synthetic.SUMMARY)
    other = synthetic.write(tmp_path / "other.jsonl", {"profile": profile}, most=500)
    return FlightComparison((FlightAnalysis(read_log(one)), FlightAnalysis(read_log(other))))


def test_what_differs_is_in_the_table(pair: FlightComparison) -> None:
    found = pair
    assert found.changed_keys == {
        "camera.latency_s": (0.07, 0.1),
        "camera.mask": (None, "a.png"),
        "log.plot": (True, "not there"),
    }
    record = found.record()
    assert record["differences"]["turns"] == 500 - record["a"]["turns"]
    assert record["differences"]["miss_m"] is None  # the second flight's is not known
    (ascend,) = [p for p in record["phases"] if p["phase"] == "ASCEND"]
    assert ascend["a_s"] == 6.0 > ascend["b_s"]
    text = found.text()
    assert max(map(len, text.splitlines())) <= 79
    assert "UNKNOWN: the log ends in ASCEND" in text
    assert "camera.latency_s                0.07  0.1" in text
    assert "camera.mask                     none  a.png" in text
