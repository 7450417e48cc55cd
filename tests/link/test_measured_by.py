"""What tells a vehicle without a deck where it is: positions that come, not that once came."""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.link import EXTERNAL_POSITION_TICK, MockLink
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.vehicle import ExternalPosition

PERIOD_S = 0.01


def test_positions_count_while_they_come_by_the_firmware_s_name() -> None:
    # crtp_localization_service.c: the group locSrv has no tick.
    assert EXTERNAL_POSITION_TICK == "locSrvZ.tick"
    link = MockLink(SimulatedVehicle(Scenario(extra={"external_position": 1.0})))
    assert link.measured_by().external is False
    link.each(PERIOD_S, lambda now_s: link.external(ExternalPosition((0.0, 0.0, 0.0))))
    assert link.measured_by().external is True


def test_positions_that_have_ended_are_none() -> None:
    link = MockLink(SimulatedVehicle(Scenario(extra={"external_position": 1.0})))
    link.external(ExternalPosition((0.0, 0.0, 0.0)))
    link.advance_to(link.now_s + 0.1)
    assert link.measured_by().external is False
