"""What a simulated scenario did to a flight, said with the event that it led to: a newcomer
who sees the target lost should not look for the fault in the program."""

from __future__ import annotations

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import NO_PICTURE_TEXT, Event, EventKind
from perchctl.sim.bursts import Bursts
from perchctl.sim.scenario import Scenario

LOSSES = ("estimate-lost", "align-lost", "ascend-lost", "camera-gone")
"""Rows of the mission's table that lost pictures lead to."""
UNHEARD = ("link-lost", "telemetry-stale")
UNSURE = ("estimate-unsure", "position-astray", "estimator-jump", "fence")
UNSEEN = (*UNSURE, "position-lost", "heading-lost")
"""Rows that a motion capture leads to which sees nothing."""
FELT_FOR_S = 1.2
"""After the last lost frame: a second of no track, and the latency of the next picture."""


class EventExplainer:
    """Explains the events of one flight; call it with each of them, in order."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._slips = 0
        self._bursts = Bursts(scenario.seed, scenario.radio_loss, scenario.radio_burst_s)

    def __call__(self, event: Event, t_s: float) -> str:
        """What the scenario did, in a few words, or the empty string. `t_s` is the event's time in
        the simulation."""
        scenario = self._scenario
        held = event.reason if event.kind is EventKind.HOLD else ""
        if event.row in LOSSES or held.startswith(NO_PICTURE_TEXT):
            return self._lost_frames(t_s)
        if event.row == "slipped":
            self._slips += 1
            force_n = scenario.first_contact_force_n
            if force_n is not None and self._slips == 1:
                part = force_n / (scenario.mass_kg * GRAVITY_MPS2)
                return f"the first contact holds {100 * part:.0f} % of the weight"
        if event.row == "searched-out" and scenario.no_target:
            return "there is no target"
        if event.row in UNHEARD or event.reason.startswith("telemetry is"):
            return self._silence(t_s)
        if event.row in UNSEEN and (hidden := self._hidden(t_s)):
            return hidden
        return ""

    def _lost_frames(self, t_s: float) -> str:
        burst, rate_hz = self._scenario.camera_burst, self._scenario.camera_rate_hz
        if burst is None or not 0.0 <= t_s - burst[0] <= burst[1] / rate_hz + FELT_FOR_S:
            return ""
        return f"{burst[1]} frames lost"

    def _silence(self, t_s: float) -> str:
        self._bursts.lost(t_s)
        newest = self._bursts.newest
        if newest is None or t_s > newest[1] + FELT_FOR_S:
            return ""
        return f"the radio passed nothing for {newest[1] - newest[0]:.1f} s"

    def _hidden(self, t_s: float) -> str:
        for begin_s, length_s in self._scenario.capture_holes_s:
            if 0.0 <= t_s - begin_s <= length_s + FELT_FOR_S:
                return f"the motion capture did not see it for {length_s:.1f} s"
        return ""
