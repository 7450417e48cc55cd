"""The lockstep's radio in a scenario that loses packets by bursts, both ways."""

from __future__ import annotations

from perchctl.link.mock import Radio
from perchctl.sim import Bursts, Packet, Scenario, radio_bursts


class BurstyRadio(Radio):
    """Loses what is sent while a burst lasts."""

    def __init__(self, bursts: Bursts) -> None:
        self._bursts = bursts

    def up(self, packet: Packet, now_s: float) -> bool:
        return not self._bursts.lost(now_s) and super().up(packet, now_s)

    def down(self, block: str, now_s: float) -> float | None:
        return None if self._bursts.lost(now_s) else super().down(block, now_s)


def simulated_radio(scenario: Scenario) -> Radio:
    """As the scenario has it."""
    bursts = radio_bursts(scenario)
    return Radio() if bursts is None else BurstyRadio(bursts)
