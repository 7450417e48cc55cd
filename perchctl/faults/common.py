"""Common causes: one fault that affects several vehicles of a fleet at the same time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from perchctl.faults import effects as e
from perchctl.faults.catalogue import Case, DrawInputs, Fault, duration_s, uniform
from perchctl.mission import Phase
from perchctl.sim import Scenario

STALL_S = 2.0
"""Duration of the computer's stall, s. Larger: the firmware cuts the motors, which no program can
prevent."""
PARENT_NOTICED_S = 1.0
"""Longest time until a vehicle notices that the parent is gone, s: at once if the parent was
killed, after 1 s if it hangs. Larger: vehicles fly on for longer than they do in a real fleet."""


@dataclass(frozen=True)
class CommonCause:
    """A fault that affects several vehicles at once.

    Attributes:
        fault: name, description and effects, as for a fault of one vehicle.
        whom: which vehicles it affects: all, those of one dongle (all if no dongle is known), or
            two.
    """

    fault: Fault
    whom: Literal["all", "dongle", "pair"] = "all"

    @property
    def name(self) -> str:
        return self.fault.name

    def draw(self, rng: np.random.Generator, scenario: Scenario) -> Case:
        """The case for each affected vehicle. Its effects begin when the fleet triggers them
        (`FaultyFlight.begin_fault`), regardless of the vehicle's phase."""
        effects = self.fault.draw
        assert callable(effects)
        # No flight leaves its final phase, so these effects never begin on their own.
        return Case(self.fault, Phase.PERCHED, math.inf, (effects(DrawInputs(rng, scenario)),))


def _capture(how: str) -> partial[e.Effect]:
    return partial(_positions, how)


def _positions(how: str, source: DrawInputs) -> e.Effect:
    return partial(e.external_positions, how=how, for_s=duration_s()(source))


def _stall(source: DrawInputs) -> e.Effect:
    return partial(e.suspended, for_s=STALL_S)


def _dead_dongle(source: DrawInputs) -> e.Effect:
    return partial(e.radio_loss, up=True, down="all", for_s=e.FOR_EVER)


def _dead_parent(source: DrawInputs) -> e.Effect:
    noticed_s = uniform(0.0, PARENT_NOTICED_S)(source)
    return partial(e.parent_gone, noticed_s=noticed_s, for_s=e.FOR_EVER)


COMMON_CAUSES: tuple[CommonCause, ...] = (
    CommonCause(
        Fault("capture-silent", "the motion-capture system sends nothing", _capture("silent"))
    ),
    CommonCause(
        Fault("bodies-swap", "two motion-capture bodies swap names", _capture("swapped")),
        "pair",
    ),
    CommonCause(Fault("stall", "the computer stalls for 2 s: all loops are late", _stall)),
    CommonCause(
        Fault("dongle-dies", "the links of all vehicles on one dongle are silent", _dead_dongle),
        "dongle",
    ),
    CommonCause(Fault("parent-dies", "the parent process is killed or hangs", _dead_parent)),
)
