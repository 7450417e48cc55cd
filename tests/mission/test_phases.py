"""The sets of phases that rows apply in hold every phase, and agree with what phases declare."""

from __future__ import annotations

import pytest

from perchctl.mission import Phase
from perchctl.mission.phase import (
    AIRBORNE_PHASES,
    CAMERA_GUIDED_PHASES,
    FINAL_PHASES,
    FREE_AIR_PHASES,
    PRE_CONTACT_PHASES,
    PRE_LANDING_PHASES,
    PUBLISHED_METHOD_PHASES,
)
from perchctl.mission.table import PHASES, TABLE

GRAVEST = {"operator-stop", "locked", "tumbled", "crashed", "tilted"}
"""What ends every flight, wherever it is."""
THEN = {"operator-land", "link-lost", "telemetry-stale", "loop-late"}
"""What lands every flight that has not begun to."""


def test_every_phase_is_defined_under_its_own_name() -> None:
    assert set(PHASES) == set(Phase)
    assert all(definition.phase is phase for phase, definition in PHASES.items())


@pytest.mark.parametrize("phase", sorted(AIRBORNE_PHASES, key=lambda p: p.value))
def test_no_airborne_phase_lacks_the_gravest_rows(phase: Phase) -> None:
    rows = {row.name for row in TABLE if phase in row.phases}
    assert rows >= GRAVEST
    assert phase is Phase.LANDING or rows >= THEN


def test_what_the_camera_steers_and_what_flies_in_the_open_is_declared_once() -> None:
    """A row asks for the set, the belief for the maneuver: they must mean the same."""
    assert {
        p for p, each in PHASES.items() if each.maneuver.is_camera_guided
    } == CAMERA_GUIDED_PHASES
    assert {p for p, each in PHASES.items() if each.maneuver.is_in_free_air} == FREE_AIR_PHASES
    assert {p for p, each in PHASES.items() if each.maneuver.descends_to_floor} == {Phase.LANDING}


def test_the_sets_are_those_of_the_paper_s_phases() -> None:
    """By name: a phase that is put between others must not push one out."""
    names = " ".join(phase.value for phase in PUBLISHED_METHOD_PHASES)
    assert names == "APPROACH SEARCH ESTIMATE ALIGN ASCEND PERCH COMPLETE"
    assert {*PUBLISHED_METHOD_PHASES, Phase.RECOVER} <= PRE_LANDING_PHASES
    assert {Phase.COMPLETE} == PRE_LANDING_PHASES - PRE_CONTACT_PHASES
    assert not FINAL_PHASES & AIRBORNE_PHASES


@pytest.mark.parametrize("phase", list(Phase))
def test_a_phase_owns_its_exits(phase: Phase) -> None:
    """An exit leaves the phase in whose file it is; what is left for ever has none."""
    exits = PHASES[phase].exits
    assert all(phase in row.phases for row in exits)
    assert bool(exits) is (phase in AIRBORNE_PHASES)
