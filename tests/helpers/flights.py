"""Whole flights for tests: the short profile, its scenario, and one call to fly it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from perchctl.flight import fly_lockstep
from perchctl.flight.lockstep import LockstepFlight
from perchctl.mission import Event, FlightReport, OperatorRequest, Phase, Watcher
from perchctl.profile import Profile, load_profile
from perchctl.record import LogWatcher
from perchctl.record.write import Truth
from perchctl.sim import Scenario, draw_capture, draw_scenario

if TYPE_CHECKING:
    from collections.abc import Callable

    from perchctl.mission import Tick, TickRecord
    from perchctl.vision import Frame

ROOT = Path(__file__).resolve().parents[2]
SHORT = str(Path(__file__).with_name("short.yaml"))
SEED = 3


DATA_SHEET: dict[str, Any] = {
    name: getattr(Scenario(), name)
    for name in (
        "motor_strength",
        "motors_brake",
        "centre_of_mass_m",
        "authority",
        "thrust_noise",
        "drag_nspm",
        "airspeed_moment_nmspm",
        "ground_effect",
        "acc_vibration_g",
        "cell_resistance_ohm",
        "cell_charge",
    )
}
"""A scenario's vehicle as its data sheet has it: for a law that a drawn one may break by chance."""


@dataclass(frozen=True)
class Flown:
    """A flight's end, and the true height of its last tick."""

    flight: LockstepFlight
    z_m: float

    @property
    def report(self) -> FlightReport:
        return self.flight.report

    @property
    def way(self) -> list[str]:
        """The phases, in order."""
        return [event.phase.value for event in self.report.history if event.phase]


class _Heights(LogWatcher):
    """Takes a log's place, writes none, and keeps how high the vehicle truly was."""

    problem: str | None = None

    def __init__(self) -> None:
        self.truth: Callable[[], Truth] | None = None
        self.z_m = 0.0

    def frame(self, frame: Frame) -> None:
        return None

    def remarks(self) -> list[str]:
        return []

    def tick(self, tick: Tick) -> None:
        assert self.truth is not None
        (_, _, self.z_m), _ = self.truth()

    def turn(self, turn: TickRecord) -> None:
        return None

    def event(self, event: Event) -> None:
        return None


def short_profile(changes: Mapping[str, Any] | None = None, base: str = SHORT) -> Profile:
    """A profile with some keys changed, each named by its dotted path."""
    values = load_profile(base).model_dump(mode="json")
    for dotted, value in (changes or {}).items():
        *sections, key = dotted.split(".")
        section = values
        for name in sections:
            section = section[name]
        assert key in section, dotted
        section[key] = value
    return Profile.model_validate(values)


class OperatorAt(Watcher):
    """Gives an operator's command as soon as a phase has been reached."""

    def __init__(self, at: Mapping[Phase, OperatorRequest]) -> None:
        self._at = at
        self._command = OperatorRequest.NONE

    def read(self) -> OperatorRequest:
        return self._command

    def tick(self, tick: Tick) -> None:
        self._command = max(self._command, self._at.get(tick.state.phase, OperatorRequest.NONE))


def ordered(at: Mapping[Phase, OperatorRequest]) -> dict[str, Any]:
    """What `fly_lockstep` takes for these commands."""
    operator = OperatorAt(at)
    return {"watchers": (operator,), "operator": operator.read}


def fly_short(
    changes: Mapping[str, Any] | None = None,
    operator_at: Mapping[Phase, OperatorRequest] | None = None,
    *,
    base: str = SHORT,
    seed: int = SEED,
    capture: Mapping[str, Any] | None = None,
    **scenario: Any,
) -> Flown:
    """One lockstep flight; `changes` are the profile's, `scenario` its scenario's, `capture`
    those of its motion capture's settings."""
    cv2.setNumThreads(1)
    profile = short_profile(changes, base)
    drawn = replace(draw_scenario(profile, seed), **scenario)
    heights = _Heights()
    settings = draw_capture(profile, seed)
    if settings is not None:
        settings = replace(settings, **(capture or {}))
    flight = fly_lockstep(
        profile, log=heights, scenario=drawn, capture=settings, **ordered(operator_at or {})
    )
    return Flown(flight, heights.z_m)
