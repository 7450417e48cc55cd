"""The argument of all decisions: belief and planner state in one tick."""

from __future__ import annotations

from typing import Any

from perchctl.mission.belief.belief import Belief
from perchctl.mission.belief.contact import Support, find_support
from perchctl.mission.belief.evidence import Condition
from perchctl.mission.observation import Observation
from perchctl.mission.state import PlannerState
from perchctl.profile import PlannerConfig, Profile, SafetyConfig
from perchctl.vehicle import Telemetry


class Context:
    """Belief and planner state in one tick: the argument of all functions of the transition table's
    rows, and of the phases' actions (`act`).

    Attributes:
        state: the decisions of the planner so far, `PlannerState`.
        belief: the belief about vehicle and target, `Belief`: position, motion, contact and target.
        obs, profile: observation and profile on which the belief is based; `planner` and `safety`
            are sections of the profile, and `telemetry` is the newest sample.
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
    def time_in_phase_s(self) -> float:
        """Time since the phase began, s."""
        return self.t_s - self.state.entry.t_s

    @property
    def support(self) -> Support:
        """What supports the vehicle in this tick. To find out how long this support has lasted,
        call `true_for_s` with the condition that shows it."""
        return find_support(self.belief)

    def true_for_s(self, condition: Condition[Any]) -> float:
        """Seconds for which a condition has been true; -1 while it is false."""
        began_s = self.belief.condition_start_times_s.get(condition)
        if began_s is None:
            began_s = self.state.condition_start_times_s.get(condition)
        return -1.0 if began_s is None else self.t_s - began_s
