"""Raw thrust is unlocked on the ground, over a link that loses packets."""

from __future__ import annotations

import pytest

from perchctl.link import MockLink, Packet, Radio
from perchctl.link.crtp import UNLOCK_TIMES
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.vehicle import RawThrust


class LosesTheFirst(Radio):
    """So many of the packets sent up are lost at the beginning."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.left = count

    def up(self, packet: Packet, now_s: float) -> bool:
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
