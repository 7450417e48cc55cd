"""A log as a table that other programs read."""

from __future__ import annotations

import csv
from dataclasses import replace
from io import StringIO

import pytest

from perchctl.errors import InvalidValue
from perchctl.record import FlightLog, read_log, wrap_log_errors
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
    assert list(rows[0]) == list(FIELDS)  # of all logs: tables can be put under each other
    for row, record in zip(rows, log.records, strict=True):
        for key in ("z_m", "measured", "phase", "ex_m", "large_px"):
            assert row[key] == ("" if record[key] is None else str(record[key]))
        if record["frame_t_s"] is not None:  # it counts from the same 0
            late_s = float(row["t_s"]) - float(row["frame_t_s"])
            assert late_s == pytest.approx(record["t_s"] - record["frame_t_s"], abs=2e-6)


def test_what_cannot_be_exported_is_refused(log: FlightLog) -> None:
    soon = replace(log, records=[log.records[0] | {"frame_t_s": "soon"}])
    with pytest.raises(InvalidValue, match="use the original"), wrap_log_errors(log.path):
        soon.csv()
    with pytest.raises(InvalidValue, match="has no ticks"):
        replace(log, records=[]).csv()
