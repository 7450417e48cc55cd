"""Six defects, planted into the program one at a time: the campaign notices each within 20 flights
of the faults that concern it: by a flight that raises nothing of the kind without it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.commands.fly import positioning_methods, with_positioning
from perchctl.faults import flight as faulty
from perchctl.faults.flight import fly_fault_in_folder
from perchctl.faults.oracle import Flag
from perchctl.flight import OperatorSwitch, loop
from perchctl.mission import (
    Observation,
    OperatorRequest,
    Phase,
    PlannerState,
    descent,
    level_descent,
    planner,
)
from perchctl.mission.context import Context
from perchctl.mission.release import stop_motors
from perchctl.mission.setpoints import Action
from perchctl.mission.table import PHASES
from perchctl.profile import Profile, load_profile
from perchctl.vehicle import Command, Land
from tests.helpers.flights import SHORT

FLIGHTS = 20
Patch = pytest.MonkeyPatch


def stops_after_contact(patch: Patch) -> None:
    """The motors stop 0.3 s after the contact, whatever the magnet carries."""
    complete = PHASES[Phase.COMPLETE]

    def stopping(c: Context) -> Action:
        return stop_motors(c) if c.time_in_phase_s >= 0.3 else complete.act(c)

    patch.setitem(PHASES, Phase.COMPLETE, replace(complete, act=stopping))


def ignores_the_second_press(patch: Patch) -> None:
    read = OperatorSwitch.read
    patch.setattr(OperatorSwitch, "read", lambda self: min(read(self), OperatorRequest.LAND))


def lands_fast(patch: Patch) -> None:
    """At 1.5 m/s, by itself and by thrust."""
    order, by_setpoints = descent.make_onboard_landing_command, descent._descend_by_setpoints

    def fast(*known: Any) -> Land:
        land = order(*known)
        return Land(land.height_m, max(0.1, (known[-1] - land.height_m) / 1.5))

    def by_itself(c: Context) -> Action:
        slow = c.belief.is_target_position_source or c.belief.is_possibly_in_magnet_reach
        return by_setpoints(c) if slow else descent._command_onboard_landing(c)

    patch.setattr(descent, "make_onboard_landing_command", fast)
    patch.setattr(descent, "_descend_by_setpoints", by_itself)
    for name in ("SINK_RATE_SETPOINT_MPS", "NEAR_FLOOR_SINK_RATE_SETPOINT_MPS"):
        patch.setattr(level_descent, name, 1.5)


def says_landed(patch: Patch) -> None:
    """Whatever the end of the flight is."""
    step = planner.step_mission

    def landed(*given: Any) -> tuple[PlannerState, Command]:
        state, command = step(*given)
        if state.phase.is_final:
            entry = replace(state.entry, transition_name="landed")
            state = replace(state, phase=Phase.LANDED, entry=entry)
        return state, command

    patch.setattr(loop, "step_mission", landed)


def deceived(change: Callable[[Profile], Profile]) -> Callable[[Patch], None]:
    """The program flies by other limits than those it is held to."""

    def plant(patch: Patch) -> None:
        fly = faulty.fly
        patch.setattr(
            faulty, "fly", lambda parts: fly(replace(parts, profile=change(parts.profile)))
        )

    return plant


def lands_late(profile: Profile) -> Profile:
    """By 5 s, after each loss."""
    safety, positioning = profile.safety, profile.positioning
    later = {
        name: getattr(safety, name) + 5.0
        for name in ("telemetry_land_s", "camera_land_s", "loop_late_land_s")
    }
    return profile.model_copy(
        update={
            "safety": safety.model_copy(update=later),
            "positioning": positioning.model_copy(update={"land_s": positioning.land_s + 5.0}),
        }
    )


def believes_old_telemetry(patch: Patch) -> None:
    """Whatever is proven or waited for, the newest sample counts as one of this moment."""
    step = planner.step_mission

    def believing(
        state: PlannerState, obs: Observation, *rest: Any
    ) -> tuple[PlannerState, Command]:
        telemetry = replace(obs.telemetry, t_s=obs.t_s, behind_s=0.0)
        return step(state, replace(obs, telemetry=telemetry), *rest)

    patch.setattr(loop, "step_mission", believing)


@dataclass(frozen=True)
class Plant:
    """One of the `flags` is what the oracle has to raise; `faults` are those that concern the
    defect."""

    name: str
    into: Callable[[Patch], None]
    flags: tuple[Flag, ...]
    faults: tuple[str, ...]


PLANTS = (
    Plant("stops-after-contact", stops_after_contact, ("fell",), ("no-magnet", "weak-magnet")),
    Plant(
        "ignores-the-second-press", ignores_the_second_press, ("stop_not_obeyed",),
        ("operator-twice", "operator-hammers", "emergency-stop-lost"),
    ),
    Plant("lands-fast", lands_fast, ("fell",), ("operator-once", "hang-up", "landing-lost")),
    Plant("says-landed", says_landed, ("lied",), ("disk-full", "kick", "operator-twice")),
    Plant(
        "lands-late", deceived(lands_late), ("flies_on",),
        ("downlink-silent", "state-block-dead", "hung"),
    ),
    Plant(
        "believes-old-telemetry", believes_old_telemetry, ("flies_on", "pressed", "fell"),
        ("downlink-silent", "attitude-block-dead"),
    ),
)  # fmt: skip
GUARD = {
    (plant.name, positioning_methods()[i % len(positioning_methods())])
    for i, plant in enumerate(PLANTS)
}
"""Each once, the positionings by turns."""


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("plant", "by"),
    [
        pytest.param(
            plant, by, id=f"{plant.name}-{by}",
            marks=[pytest.mark.guard] * ((plant.name, by) in GUARD),
        )
        for by in positioning_methods()
        for plant in PLANTS
    ],
)  # fmt: skip
def test_the_campaign_notices(plant: Plant, by: str) -> None:
    cv2.setNumThreads(1)
    profile = with_positioning(load_profile(SHORT), by)

    def is_flagged(seed: int, *, planted: bool) -> bool:
        with Patch.context() as patch:
            if planted:
                plant.into(patch)
            result = fly_fault_in_folder(profile, plant.faults, None, False, seed)
        return bool(set(plant.flags) & set(result.counted))

    assert any(
        is_flagged(seed, planted=True) and not is_flagged(seed, planted=False)
        for seed in range(FLIGHTS)
    )
