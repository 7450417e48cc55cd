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
    """What the planner knows in one tick: its belief about vehicle and target, and its own state.
    It is the argument of the functions that decide whether a transition applies, and of the phases'
    actions (`act`).

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
    def vehicle_support(self) -> Support:
        """What supports the vehicle in this tick: the air, a surface that it presses against, the
        target's magnet, another object or the floor; UNKNOWN if the evidence does not prove one of
        them (`find_support`)."""
        return find_support(self.belief)

    def true_for_s(self, condition: Condition[Any]) -> float:
        """Seconds for which a condition has been true without interruption; -1 while it is false or
        the data that it requires is stale. A change of phase or a hold also interrupts it, unless
        it has `persists_across_phases`. The result is always -1 for a condition that is neither one
        of the belief's nor one of a phase (`PhaseDefinition.timed_conditions`)."""
        began_s = self.belief.condition_start_times_s.get(condition)
        if began_s is None:
            began_s = self.state.condition_start_times_s.get(condition)
        return -1.0 if began_s is None else self.t_s - began_s
