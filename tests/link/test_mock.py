"""The lockstep link: raw thrust is unlocked over a radio that loses packets, and what tells a
vehicle without a deck where it is.
"""

from __future__ import annotations

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.link import MockLink, Packet, Radio
from perchctl.link.crtp import UNLOCK_TIMES
from perchctl.link.firmware import EXTERNAL_POSITION_TICK
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.vehicle import ExternalPosition, RawThrust


class LosesTheFirst(Radio):
    """So many of the packets sent up are lost at the beginning."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.left = count

    def uplink_arrives(self, packet: Packet, now_s: float) -> bool:
        self.left -= 1
        return self.left < 0


@pytest.mark.parametrize("lost", [0, 1, 3, 2 * UNLOCK_TIMES - 2])
def test_a_lost_packet_does_not_leave_the_thrust_locked(lost: int) -> None:
    """The first raw thrust of the flight would be a cut: nothing in the air may unlock it."""
    vehicle = SimulatedVehicle(Scenario())
    link = MockLink(vehicle, radio=LosesTheFirst(lost))
    link.connect()
    for _ in range(20):
        link.send(RawThrust(15000))
        link.advance_to(link.now_s + 0.02)
    assert link.telemetry()[-1].thrust == pytest.approx(15000, abs=1500)


def test_positions_count_while_they_come_by_the_firmware_s_name() -> None:
    # crtp_localization_service.c: the group locSrv has no tick.
    assert EXTERNAL_POSITION_TICK == "locSrvZ.tick"
    link = MockLink(SimulatedVehicle(Scenario(extra={"external_position": 1.0})))
    assert link.measured_by().external is False
    link.external(ExternalPosition((0.0, 0.0, 0.0)))
    link.advance_to(link.now_s + 0.1)
    assert link.measured_by().external is False  # those that have ended are none
    link.each(0.01, lambda now_s: link.external(ExternalPosition((0.0, 0.0, 0.0))))
    assert link.measured_by().external is True
