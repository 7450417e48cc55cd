"""What a log says of its battery: charge by the thrust, voltages as they were read."""

from __future__ import annotations

import math
from typing import Any

import pytest

from perchctl.analysis.edges import USUAL_MAH, battery_of
from perchctl.mission.battery import FULL_A
from perchctl.vehicle import FULL_THRUST
from tests.helpers.log import PLAN
from tests.helpers.told import made


def test_charge_is_the_thrust_over_time() -> None:
    def change(record: dict[str, Any]) -> None:
        record["thrust"] = 0.5 * FULL_THRUST

    energy = battery_of(made(change))
    flown_s = sum(duration_s for _, duration_s, _ in PLAN)
    assert energy.used_mah == pytest.approx(0.5 * FULL_A * flown_s / 3.6, rel=0.01)


def test_a_hole_in_the_log_is_not_flown() -> None:
    log = made()
    log.records[500:] = [r | {"t_s": r["t_s"] + 600.0} for r in log.records[500:]]
    assert battery_of(log).used_mah < battery_of(made()).used_mah * 1.1


def test_voltages_are_the_readings_and_none_is_unknown() -> None:
    def fall(record: dict[str, Any]) -> None:
        record["battery_v"] = 4.0 - 0.02 * record["t_s"]

    energy = battery_of(made(fall))
    assert energy.start_v == pytest.approx(4.0 - 0.02 * 1.1)
    assert energy.lowest_v == energy.end_v < energy.start_v

    def none(record: dict[str, Any]) -> None:
        record["battery_v"] = None

    energy = battery_of(made(none))
    assert math.isnan(energy.lowest_v)
    assert energy.fit is None
    assert energy.left is None


def test_the_battery_is_the_profile_s_or_the_usual_one() -> None:
    log = made()
    log.header["profile"]["vehicle"]["battery_mah"] = 350.0
    assert (battery_of(log).battery_mah, battery_of(log).assumed) == (350.0, False)
    del log.header["profile"]["vehicle"]["battery_mah"]
    assert (battery_of(log).battery_mah, battery_of(log).assumed) == (USUAL_MAH, True)


def test_a_log_without_a_tick_has_used_nothing() -> None:
    log = made()
    log.records.clear()
    assert battery_of(log).used_mah == 0.0
