"""Common causes: one fault that several vehicles of a fleet meet at the same moment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from perchctl.faults import effects as e
from perchctl.faults.catalogue import Case, DrawInputs, Fault, duration_s
from perchctl.mission import Phase
from perchctl.sim import Scenario

STALL_S = 2.0
"""How long the computer stalls. Larger: the firmware cuts the motors, which no program avoids."""


@dataclass(frozen=True)
class CommonCause:
    """What befalls several vehicles at once.

    Attributes:
        fault: name, description and effects, as of a fault of one vehicle.
        whom: all vehicles, those of one dongle (all where no dongle is known), or two.
    """

    fault: Fault
    whom: Literal["all", "dongle", "pair"] = "all"

    @property
    def name(self) -> str:
        return self.fault.name

    def draw(self, rng: np.random.Generator, scenario: Scenario) -> Case:
        """The case of each vehicle that meets it. Its effects begin when the fleet says so
        (`FaultyFlight.begin_fault`), in whatever phase a vehicle is."""
        effects = self.fault.draw
        assert callable(effects)
        # No flight leaves its last phase, so that nothing begins by itself.
        return Case(self.fault, Phase.PERCHED, math.inf, (effects(DrawInputs(rng, scenario)),))


def _capture(how: str) -> partial[e.Effect]:
    return partial(_positions, how)


def _positions(how: str, source: DrawInputs) -> e.Effect:
    return partial(e.external_positions, how=how, for_s=duration_s()(source))


def _stall(source: DrawInputs) -> e.Effect:
    return partial(e.suspended, for_s=STALL_S)


def _dead_dongle(source: DrawInputs) -> e.Effect:
    return partial(e.radio_loss, up=True, down="all", for_s=e.FOR_EVER)


COMMON_CAUSES: tuple[CommonCause, ...] = (
    CommonCause(Fault("capture-silent", "the motion capture sends nothing", _capture("silent"))),
    CommonCause(
        Fault("bodies-swap", "two bodies of the motion capture swap names", _capture("swapped")),
        "pair",
    ),
    CommonCause(Fault("stall", "the computer stalls for 2 s: all loops are late", _stall)),
    CommonCause(
        Fault("dongle-dies", "the links of all vehicles on one dongle are silent", _dead_dongle),
        "dongle",
    ),
)
