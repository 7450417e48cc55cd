"""What a simulated scenario did to a flight, told with the event that it led to: a newcomer
who sees the target lost should not look for the fault in the program."""

from __future__ import annotations

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission.hold import NO_PICTURE
from perchctl.mission.watch import Event, EventKind
from perchctl.sim.scenario import Scenario

LOSSES = ("estimate-lost", "align-lost", "ascend-lost", "camera-gone")
"""Rows of the mission's table that lost pictures lead to."""
SLIP = "slipped"
NOT_FOUND = "searched-out"
FELT_FOR_S = 1.2
"""After the last lost frame: a second of no track, and the latency of the next picture."""


class Teller:
    """Asked for each event of one flight, in order."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._slips = 0

    def __call__(self, event: Event, t_s: float) -> str:
        """In a few words, or the empty string. `t_s` is the event's time in the simulation."""
        scenario = self._scenario
        if self._lacks_pictures(event) and self._in_burst(t_s):
            assert scenario.camera_burst is not None
            return f"{scenario.camera_burst[1]} frames lost"
        if event.row == SLIP:
            self._slips += 1
            force_n = scenario.first_contact_force_n
            if force_n is not None and self._slips == 1:
                part = force_n / (scenario.mass_kg * GRAVITY_MPS2)
                return f"the first contact holds {100 * part:.0f} % of the weight"
        if event.row == NOT_FOUND and scenario.no_target:
            return "there is no target"
        return ""

    @staticmethod
    def _lacks_pictures(event: Event) -> bool:
        held = event.kind is EventKind.HOLD and event.reason.startswith(NO_PICTURE)
        return held or event.row in LOSSES

    def _in_burst(self, t_s: float) -> bool:
        burst, rate_hz = self._scenario.camera_burst, self._scenario.camera_rate_hz
        return burst is not None and 0.0 <= t_s - burst[0] <= burst[1] / rate_hz + FELT_FOR_S
