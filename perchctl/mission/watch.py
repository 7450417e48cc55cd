"""What those who look on are given: every tick, what happened, and how the flight ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from perchctl.mission.state import Outcome, Phase, PlannerState
from perchctl.vehicle import Command, Telemetry
from perchctl.vision.types import PipelineOutput, TargetPose


@dataclass(frozen=True, eq=False)
class Tick:
    """All that one turn of the loop knew and did, for the log and the display."""

    t_s: float
    telemetry: Telemetry
    output: PipelineOutput | None
    target: TargetPose | None
    state: PlannerState
    command: Command
    loop_late_s: float
    camera_age_s: float
    telemetry_age_s: float


class Watcher(Protocol):
    """Something that looks on: flight log, panel, live page. Must not raise."""

    def tick(self, tick: Tick) -> None: ...

    def event(self, t_s: float, text: str) -> None: ...

    @property
    def problem(self) -> str | None: ...


@dataclass(frozen=True)
class FlightReport:
    """How the flight ended. `row` names the transition that decided it."""

    phase: Phase
    outcome: Outcome
    reason: str
    attempts: int
    duration_s: float
    locked: bool
    history: tuple[tuple[float, str, str], ...] = ()
