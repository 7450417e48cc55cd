"""One tick as the decisions see it."""

from __future__ import annotations

from typing import Any

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.observation import Observation
from perchctl.mission.state import PlannerState
from perchctl.profile import PlannerConfig, Profile, SafetyConfig
from perchctl.vehicle import Telemetry


class Context:
    """What is believed and what was decided: the argument of all rows and actions.

    Attributes:
        state: what the planner has decided, `PlannerState`.
        belief: what is believed of vehicle and target, `Belief`; all about position, motion,
            contact and target is asked there.
        obs, profile: the observation and the profile that the belief rests on; `planner` and
            `safety` are its sections, `telemetry` is the newest sample.
        t_s: time on the loop's clock.
    """

    def __init__(self, state: PlannerState) -> None:
        self.state = state
        self.belief: Belief = state.belief
        self.obs: Observation = self.belief.obs
        self.profile: Profile = self.belief.profile
        self.planner: PlannerConfig = self.profile.planner
        self.safety: SafetyConfig = self.profile.safety
        self.telemetry: Telemetry = self.obs.telemetry
        self.t_s: float = self.obs.t_s

    @property
    def in_phase_s(self) -> float:
        """Time since the phase began."""
        return self.t_s - self.state.entry.t_s

    def held_s(self, condition: Condition[Any]) -> float:
        """Seconds for which a condition has been true; -1 while it is false."""
        began_s = self.belief.since.get(condition)
        if began_s is None:
            began_s = self.state.since.get(condition)
        return -1.0 if began_s is None else self.t_s - began_s
