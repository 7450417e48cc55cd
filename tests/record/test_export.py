"""A log as a table: the columns, and that other programs read them."""

from __future__ import annotations

import csv
from dataclasses import replace
from io import StringIO

import pytest

from perchctl.errors import InvalidValue
from perchctl.record import FlightLog, log_table, read_log
from perchctl.record.fields import FIELDS
from tests.helpers import log as synthetic
from tests.helpers.mission import held, note


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> FlightLog:
    events = [note(1.11, "a note, with a comma"), held(1.115, "no picture")]
    path = tmp_path_factory.mktemp("log") / "f.jsonl"
    return read_log(synthetic.write(path, summary=synthetic.SUMMARY, events=events))


def rows_of(log: FlightLog) -> list[dict[str, str]]:
    """The rows as another program reads them out of the CSV."""
    return list(csv.DictReader(StringIO(log_table(log).csv())))


def test_every_field_comes_back_in_a_row_a_turn(log: FlightLog) -> None:
    rows = rows_of(log)
    assert len(rows) == len(log.records)
    assert [row["t_s"] for row in rows[:3]] == ["0.0", "0.02", "0.04"]
    assert {key for key in FIELDS if not key.startswith(("large_", "small_"))} <= set(rows[0])
    for row, record in zip(rows, log.records, strict=True):
        assert float(row["z_m"]) == record["z_m"]
        assert row["measured"] == {None: "", True: "1", False: "0"}[record["measured"]]
        assert row["phase"] == record["phase"]
        assert row["ex_m"] == ("" if record["ex_m"] is None else str(record["ex_m"]))
        if record["frame_t_s"] is not None:  # it counts from the same 0
            late_s = float(row["t_s"]) - float(row["frame_t_s"])
            assert late_s == pytest.approx(record["t_s"] - record["frame_t_s"], abs=2e-6)


def test_corners_events_and_timings_become_columns(log: FlightLog) -> None:
    at = next(i for i, record in enumerate(log.records) if record["large_px"])
    timing = {"pipeline_s": 0.004, "planner_s": 0.001, "send_s": 0.0, "turn_s": 0.006}
    turns = [{"t_s": log.records[at]["t_s"] + 3e-7, "timing": timing}]
    rows = rows_of(replace(log, turn_records=turns))
    corners = [f"large_{c}_{axis}_px" for c in ("tl", "tr", "br", "bl") for axis in "xy"]
    assert [float(rows[at][name]) for name in corners] == log.records[at]["large_px"]
    assert rows[0]["large_tl_x_px"] == ""
    assert rows[1]["event"] == "note: a note, with a comma | hold: no picture"
    assert not any(row["event"] for row in rows[2:])
    assert (rows[at]["turn_s"], rows[at + 1]["turn_s"]) == ("0.006", "")


def test_all_logs_have_the_same_columns(log: FlightLog) -> None:
    """Tables of several flights can be put under each other."""
    bare = replace(log, records=[dict.fromkeys(FIELDS) | {"t_s": 0.0}], events=[])
    assert log_table(bare).columns == log_table(log).columns


@pytest.mark.parametrize(("key", "value"), [
    ("large_px", [1.0, 2.0]), ("large_px", [1.0] * 9), ("frame_t_s", "soon"), ("battery_v", "low"),
])  # fmt: skip
def test_a_value_that_no_flight_writes_is_refused(log: FlightLog, key: str, value: object) -> None:
    wrong = replace(log, records=[log.records[0] | {key: value}])
    with pytest.raises(InvalidValue, match=r"take the original|not a number"):
        log_table(wrong)


def test_nothing_to_export_is_said(log: FlightLog) -> None:
    with pytest.raises(InvalidValue, match="holds no ticks"):
        log_table(replace(log, records=[]))
