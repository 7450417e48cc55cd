"""A log as a table that other programs read."""

from __future__ import annotations

import csv
from dataclasses import replace
from io import StringIO

import pytest

from perchctl.errors import InvalidValue
from perchctl.record import FlightLog, log_values, read_log
from perchctl.record.fields import FIELDS
from tests.helpers import log as synthetic


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> FlightLog:
    path = tmp_path_factory.mktemp("log") / "f.jsonl"
    return read_log(synthetic.write(path, summary=synthetic.SUMMARY))


def test_every_field_comes_back_in_a_row_a_tick(log: FlightLog) -> None:
    rows = list(csv.DictReader(StringIO(log.csv())))
    assert len(rows) == len(log.records)
    assert [row["t_s"] for row in rows[:3]] == ["0.0", "0.02", "0.04"]
    assert {key for key in FIELDS if not key.startswith(("large_", "small_"))} <= set(rows[0])
    corners = [f"large_{c}_{axis}_px" for c in ("tl", "tr", "br", "bl") for axis in "xy"]
    for row, record in zip(rows, log.records, strict=True):
        assert float(row["z_m"]) == record["z_m"]
        assert row["measured"] == {None: "", True: "1", False: "0"}[record["measured"]]
        assert row["phase"] == record["phase"]
        assert row["ex_m"] == ("" if record["ex_m"] is None else str(record["ex_m"]))
        seen = [float(row[name]) for name in corners] if row[corners[0]] else None
        assert seen == record["large_px"]
        if record["frame_t_s"] is not None:  # it counts from the same 0
            late_s = float(row["t_s"]) - float(row["frame_t_s"])
            assert late_s == pytest.approx(record["t_s"] - record["frame_t_s"], abs=2e-6)


def test_all_logs_have_the_same_columns(log: FlightLog) -> None:
    """Tables of several flights can be put under each other."""
    bare = replace(log, records=[dict.fromkeys(FIELDS) | {"t_s": 0.0}], events=[])
    assert bare.csv().splitlines()[0] == log.csv().splitlines()[0]


@pytest.mark.parametrize(("changes", "why"), [
    ({"large_px": [1.0, 2.0]}, "take the original"), ({"frame_t_s": "soon"}, "take the original"),
    ({"battery_v": "low"}, "take the original"), (None, "holds no ticks"),
])  # fmt: skip
def test_what_cannot_be_exported_is_refused(
    log: FlightLog, changes: dict[str, object] | None, why: str
) -> None:
    wrong = replace(log, records=[] if changes is None else [log.records[0] | changes])
    with pytest.raises(InvalidValue, match=why), log_values(log.path):
        wrong.csv()
