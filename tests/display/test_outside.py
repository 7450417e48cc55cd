"""How it goes with positions from outside, on the panel and in the log."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from perchctl.display.panel import WIDTH, status_of, status_rows
from perchctl.log.watch import flight_record
from perchctl.mission import ExternalPositions
from perchctl.vehicle import ExternalPosition
from tests.display.test_panel import STATUS, tick

PLACE = ExternalPosition((0.1, -0.2, 0.3))
WELL = ExternalPositions(0.012, None, 300, 99.6, PLACE)


def test_positions_from_outside_have_their_line() -> None:
    assert "outside" not in dict(status_rows(STATUS))
    assert status_of(tick()).outside is None
    rows = dict(status_rows(status_of(tick(outside=WELL))))
    assert rows["outside"] == "position 100 Hz   12 ms"


@pytest.mark.parametrize("age_s", [0.4, math.inf])
def test_what_is_wrong_takes_the_line(age_s: float) -> None:
    outside = replace(WELL, age_s=age_s, problem="the rigid body 'cf2' is not seen")
    assert dict(status_rows(replace(STATUS, outside=outside)))["outside"] == outside.problem
    assert WIDTH <= 80


def test_the_log_has_what_was_sent() -> None:
    record = flight_record(tick(outside=WELL))
    assert [record[f"pos_{key}"] for key in ("age_s", "sent", "hz", "x_m", "z_m")] == [
        0.012, 300, 99.6, 0.1, 0.3,
    ]  # fmt: skip
    assert record["pos_qw"] is None  # a position alone was sent
    never = flight_record(tick(outside=ExternalPositions(math.inf, "none has come", 0, 0.0, None)))
    assert never["pos_age_s"] is None
    assert never["pos_note"] == "none has come"
    assert flight_record(tick())["pos_sent"] is None
