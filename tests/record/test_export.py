"""A log as a table: the columns, and that other programs read them."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from io import BytesIO, StringIO
from pathlib import Path

import pytest

from perchctl.errors import InvalidValue, UsageError
from perchctl.record import FlightLog, log_table, read_log
from perchctl.record.fields import FIELDS
from tests.helpers import log as synthetic
from tests.helpers.mission import held, note


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> FlightLog:
    events = [note(1.11, "a note, with a comma"), held(1.115, "no picture")]
    path = tmp_path_factory.mktemp("log") / "f.jsonl"
    return read_log(synthetic.write(path, summary=synthetic.SUMMARY, events=events))


def test_a_table_begins_with_the_time_from_0_and_holds_every_field(log: FlightLog) -> None:
    columns = {column.name: column for column in log_table(log).columns}
    assert next(iter(columns)) == "t_s"
    assert columns["t_s"].values[:3] == [0.0, 0.02, 0.04]
    assert columns["vx_mps"].unit == "m/s"
    assert {key for key in FIELDS if not key.startswith(("large_", "small_"))} <= set(columns)
    assert len({len(column.values) for column in columns.values()}) == 1


def test_corners_become_columns(log: FlightLog) -> None:
    columns = {column.name: column.values for column in log_table(log).columns}
    (row,) = [i for i, r in enumerate(log.records) if r["large_px"]][:1]
    corners = [f"large_{c}_{axis}_px" for c in ("tl", "tr", "br", "bl") for axis in "xy"]
    assert [columns[name][row] for name in corners] == log.records[row]["large_px"]
    assert columns["large_tl_x_px"][0] is None
    assert "large_px" not in columns


def test_frames_count_from_the_same_0(log: FlightLog) -> None:
    columns = {column.name: column.values for column in log_table(log).columns}
    for row, record in enumerate(log.records):
        if record["frame_t_s"] is not None:
            late_s = columns["t_s"][row] - columns["frame_t_s"][row]
            assert late_s == pytest.approx(record["t_s"] - record["frame_t_s"], abs=2e-6)


def test_what_happened_stands_in_the_turn_behind_it(log: FlightLog) -> None:
    (events,) = [c.values for c in log_table(log).columns if c.name == "event"]
    assert events[1] == "note: a note, with a comma | hold: no picture"
    assert not any(events[2:])


def test_the_parts_of_a_turn_are_beside_it(log: FlightLog) -> None:
    timing = {"pipeline_s": 0.004, "planner_s": 0.001, "send_s": 0.0, "turn_s": 0.006}
    t_s = log.records[3]["t_s"]
    timed = replace(log, turn_records=[{"t_s": t_s + 3e-7, "timing": timing}])
    columns = {column.name: column.values for column in log_table(timed).columns}
    assert columns["turn_s"][3] == 0.006
    assert columns["turn_s"][4] is None


def test_csv_comes_back_as_it_was(log: FlightLog) -> None:
    rows = list(csv.DictReader(StringIO(log_table(log).csv())))
    assert len(rows) == len(log.records)
    for row, record in zip(rows, log.records, strict=True):
        assert float(row["z_m"]) == record["z_m"]
        assert row["measured"] == {None: "", True: "1", False: "0"}[record["measured"]]
        assert row["phase"] == record["phase"]
        assert row["ex_m"] == ("" if record["ex_m"] is None else str(record["ex_m"]))


def test_parquet_has_types_units_and_the_header(log: FlightLog) -> None:
    pq = pytest.importorskip("pyarrow.parquet", reason="Parquet needs the extra [parquet]")
    table = pq.read_table(BytesIO(log_table(log).parquet()))
    kinds = {name: str(table.schema.field(name).type) for name in table.column_names}
    assert (kinds["t_s"], kinds["measured"], kinds["attempts"], kinds["phase"]) == (
        "double", "bool", "int64", "string",
    )  # fmt: skip
    assert table.schema.field("vx_mps").metadata[b"unit"] == b"m/s"
    assert json.loads(table.schema.metadata[b"perchctl.header"]) == log.header
    assert json.loads(table.schema.metadata[b"perchctl.summary"]) == log.summary
    assert table["ez_m"].to_pylist() == [record["ez_m"] for record in log.records]


def test_all_logs_have_the_same_columns_and_types(log: FlightLog, tmp_path: Path) -> None:
    """Tables of several flights can be put under each other."""
    bare = replace(log, records=[dict.fromkeys(FIELDS) | {"t_s": 0.0}], events=[])
    full = [(c.name, c.kind) for c in log_table(log).columns]
    assert [(c.name, c.kind) for c in log_table(bare).columns] == full


def test_without_the_library_it_is_one_sentence(
    log: FlightLog, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(UsageError, match=r"needs the library pyarrow.*perchctl\[parquet\]"):
        log_table(log).parquet()


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("battery_v", "low"),
        ("measured", 1),
        ("attempts", 1.5),
        ("large_px", [1.0, 2.0]),
        ("frame_t_s", "soon"),
    ],
)
def test_a_value_of_another_kind_is_refused(log: FlightLog, key: str, value: object) -> None:
    wrong = replace(log, records=[log.records[0] | {key: value}])
    with pytest.raises(InvalidValue, match="take the original"):
        log_table(wrong)


def test_nothing_to_export_is_said(log: FlightLog) -> None:
    with pytest.raises(InvalidValue, match="holds no ticks"):
        log_table(replace(log, records=[]))
