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

    __slots__ = ("belief", "state")

    def __init__(self, state: PlannerState) -> None:
        self.state = state
        self.belief: Belief = state.belief

    @property
    def obs(self) -> Observation:
        return self.belief.obs

    @property
    def profile(self) -> Profile:
        return self.belief.profile

    @property
    def planner(self) -> PlannerConfig:
        return self.belief.profile.planner

    @property
    def safety(self) -> SafetyConfig:
        return self.belief.profile.safety

    @property
    def telemetry(self) -> Telemetry:
        return self.belief.obs.telemetry

    @property
    def t_s(self) -> float:
        return self.belief.obs.t_s

    @property
    def in_phase_s(self) -> float:
        """Time since the phase began."""
        return self.belief.obs.t_s - self.state.entered_s

    def held_s(self, condition: Condition[Any]) -> float:
        """Seconds for which a condition has been true; -1 while it is false."""
        began_s = self.belief.since.get(condition)
        if began_s is None:
            began_s = self.state.since.get(condition)
        return -1.0 if began_s is None else self.belief.obs.t_s - began_s
