"""Where a vehicle should be in each phase, and by when it should be on its way down."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import pytest

from perchctl.faults import effects as e
from perchctl.faults.truth import (
    COMING_DOWN_MPS,
    HANDED_OVER_M,
    LASTS_S,
    REACTION_S,
    SUNK_M,
    WATCHED_S,
    DescentBound,
    PositionBound,
    UndetectedDrift,
    target_places,
)
from perchctl.mission import Phase
from perchctl.profile import Profile, load_profile
from perchctl.sim import Neighbour, Scenario

P = Phase
SIM, TARGET_ONLY = load_profile("sim"), load_profile("target_only")
SCENARIO = Scenario(target_xy_m=(2.0, 0.0))
SAFETY = SIM.safety


def bound(*phases: Phase, scenario: Scenario = SCENARIO, at: tuple[float, float]) -> PositionBound:
    """Started at the origin, and `at` that place when the last of the phases was entered."""
    made = PositionBound(scenario, SIM)
    made.note_phase(None, (0.0, 0.0))
    for phase in phases[:-1]:
        made.note_phase(phase, (0.0, 0.0))
    made.note_phase(phases[-1], at)
    return made


@pytest.mark.parametrize(
    ("phase", "place", "astray_m"),
    [
        (P.APPROACH, (0.0, 0.3), 0.3),
        (P.SEARCH, (1.0, 0.3), 0.3),
        (P.ALIGN, (-0.5, 0.0), 0.5),
        (P.RECOVER, (1.5, -0.2), 0.2),
        (P.ASCEND, (1.0, 0.0), 1.0),
        (P.PERCH, (2.0, 0.4), 0.4),
    ],
)
def test_where_it_should_be(phase: Phase, place: tuple[float, float], astray_m: float) -> None:
    assert bound(phase, at=place).astray_m(place) == pytest.approx(astray_m)


def test_a_landing_goes_down_where_it_should_have_been_as_it_began() -> None:
    """Not where it was: what had strayed by then strays on."""
    down = bound(P.ALIGN, P.LANDING, at=(1.2, 0.7))
    assert down.astray_m((1.2, 0.7)) == pytest.approx(0.7)
    assert down.astray_m((2.2, 0.0)) == pytest.approx(1.0)
    down.note_phase(P.ABORTED, (2.2, 0.0))
    assert down.astray_m((2.2, 0.0)) == pytest.approx(1.0)


def test_without_a_target_it_stays_above_its_start() -> None:
    """In a landing from the take-off, and under a bare ceiling."""
    assert bound(P.APPROACH, P.LANDING, at=(0.4, 0.0)).astray_m((0.4, 0.3)) == 0.5
    bare = bound(P.SEARCH, at=(0.0, 0.0), scenario=Scenario(no_target=True, target_xy_m=(2.0, 0.0)))
    assert bare.astray_m((1.0, 0.0)) == 1.0


def test_all_that_looks_like_its_target_may_be_flown_to() -> None:
    alike = Neighbour((0.0, 1.0))
    other = Neighbour((5.0, 0.0), large_id=7, small_id=8)
    scenario = Scenario(
        target_xy_m=(2.0, 0.0), target_yaw_rad=0.5 * math.pi, neighbours=(alike, other)
    )
    assert target_places(scenario) == [(2.0, 0.0), pytest.approx((1.0, 0.0))]
    assert bound(P.PERCH, at=(0.0, 0.0), scenario=scenario).astray_m((1.0, 0.2)) == pytest.approx(
        0.2
    )


def drifted(
    *effects: e.Effect, after_s: float, by_target: bool = True, phase: Phase = P.SEARCH
) -> float:
    drift = UndetectedDrift(effects, SCENARIO, by_target=by_target)
    for k in range(1, round(after_s / 0.1)):
        drift.update_drift_m(0.1 * k, phase)
    return drift.update_drift_m(after_s, phase)


SLIDE = partial(e.estimate_error, step_m=(2.0, 0.0, 0.0), drift_mps=(0.3, 0.4, 9.0), for_s=4.0)


def test_what_nothing_on_board_can_know_is_allowed_on_top() -> None:
    assert drifted(SLIDE, after_s=2.0) == pytest.approx(1.0)
    assert drifted(SLIDE, after_s=60.0) == pytest.approx(2.0)
    push = partial(e.push, force_n=(0.042, 0.0, 1.0), for_s=2.0)  # 1 m/s^2 at 42 g
    assert drifted(push, after_s=1.0) == pytest.approx(0.5)
    assert drifted(push, SLIDE, after_s=60.0) == pytest.approx(4.0)
    assert (
        drifted(
            positions("silent"), partial(e.camera_fault, kind="covered", for_s=9.0), after_s=60.0
        )
        == 0.0
    )


def test_a_slide_of_before_is_forgotten_once_it_is_under_the_target() -> None:
    """And counts anew on the way down, where no picture steers."""
    drift = UndetectedDrift((SLIDE,), SCENARIO, by_target=False)
    way = [(1.0, P.SEARCH), (2.0, P.ALIGN), (3.0, P.ASCEND), (4.0, P.LANDING)]
    assert [drift.update_drift_m(*each) for each in way] == pytest.approx([0.5, 0.5, 0.0, 0.5])


# --- the way down -----------------------------------------------------------------------

EVER = e.FOR_EVER
NEVER = math.inf


def lost(for_s: float, up: bool, down: str, delay_s: float = math.inf) -> e.Effect:
    return partial(e.radio_loss, for_s=for_s, up=up, down=down, delay_s=delay_s)


def blind(kind: str) -> e.Effect:
    return partial(e.camera_fault, kind=kind, for_s=EVER)


def positions(how: str) -> e.Effect:
    return partial(e.external_positions, how=how, for_s=EVER)


def befallen(
    effect: e.Effect, profile: Profile = SIM, phase: Phase | None = P.ALIGN
) -> Callable[..., bool]:
    """By the time since the effect befell it, and by what is not so of a vehicle that hovers on:
    is it overdue?"""
    made = DescentBound((effect,), profile)
    made.begin(0.0, phase)
    return partial(made.is_overdue, height_m=1.5, vz_mps=0.0, touching=False, uplink=True)


@pytest.mark.parametrize(
    ("effect", "profile", "phase", "limit_s"),
    [
        (lost(EVER, False, "all"), SIM, P.APPROACH, SAFETY.telemetry_land_s),
        (lost(EVER, False, "all"), SIM, P.COMPLETE, NEVER),
        (lost(EVER, True, ""), SIM, P.ALIGN, NEVER),
        (lost(1.0 + LASTS_S, False, "all"), SIM, P.ALIGN, NEVER),
        (lost(EVER, False, "state"), SIM, P.SEARCH, SAFETY.telemetry_land_s),
        (lost(EVER, False, "battery"), SIM, P.SEARCH, NEVER),
        (lost(EVER, False, "all", 1.5), SIM, P.ASCEND, SAFETY.telemetry_land_s),
        (lost(EVER, False, "all", 0.5), SIM, P.ASCEND, NEVER),
        (partial(e.hung, for_s=5.0), SIM, P.ALIGN, SAFETY.loop_late_land_s),
        (blind("silent"), SIM, P.ALIGN, SAFETY.camera_land_s),
        (blind("silent"), SIM, P.APPROACH, NEVER),
        (blind("covered"), SIM, P.ALIGN, NEVER),
        (blind("covered"), TARGET_ONLY, P.ALIGN, TARGET_ONLY.positioning.land_s),
        (positions("silent"), SIM, P.APPROACH, SIM.positioning.land_s),
        (positions("late"), SIM, P.ALIGN, NEVER),
        (partial(e.deck_silent, for_s=EVER, acc_z_mps2=0.05), SIM, P.ALIGN, SIM.positioning.land_s),
        (partial(e.suspended, for_s=1.9), SIM, P.ALIGN, SAFETY.loop_late_land_s),
        (partial(e.suspended, for_s=1.9), SIM, None, NEVER),  # on the floor, before the first tick
        (partial(e.hung, for_s=5.0), SIM, None, NEVER),
        (positions("silent"), SIM, None, SIM.positioning.land_s),
        (partial(e.parent_gone, noticed_s=0.4, for_s=EVER), SIM, P.ALIGN, 0.4),
        (partial(e.raises), SIM, P.ALIGN, 0.0),
        (partial(e.operator, presses_s=(0.0, 4.0)), SIM, P.ALIGN, 0.0),
        (partial(e.operator, presses_s=(0.0,)), SIM, P.COMPLETE, NEVER),
    ],
)
def test_after_what_loss_it_comes_down_and_when(
    effect: e.Effect, profile: Profile, phase: Phase | None, limit_s: float
) -> None:
    late_s = limit_s + REACTION_S + WATCHED_S
    is_overdue = befallen(effect, profile, phase)
    overdue_s = (0.01 * k for k in range(2000) if is_overdue(0.01 * k))
    assert next(overdue_s, math.inf) == pytest.approx(late_s, abs=0.011)


def test_what_touches_the_ceiling_before_it_has_to_come_down_is_not_overdue() -> None:
    """And what rises to it instead of coming down is."""
    hangs = befallen(partial(e.hung, for_s=EVER))
    assert not any(hangs(0.1 * k, touching=True) for k in range(200))
    rises = befallen(partial(e.hung, for_s=EVER))
    assert not rises(2.01)
    assert not rises(3.0, height_m=2.0, touching=True)
    assert rises(4.1, height_m=2.0, touching=True)


@pytest.mark.parametrize("effect", [partial(e.suspended, for_s=1.9), lost(1.9, True, "all")])
def test_what_hears_nothing_is_overdue_once_it_hears_again(effect: e.Effect) -> None:
    """As a program that was suspended for 1.9 s is, or a link that was silent for so long."""
    is_overdue = befallen(effect)
    assert not is_overdue(1.9, uplink=False)
    late_s = 1.9 + REACTION_S + WATCHED_S + 0.02
    ages_s = (1.9 + REACTION_S + 0.01, late_s - 0.1, late_s)
    assert [is_overdue(age_s) for age_s in ages_s] == [False, False, True]


@pytest.mark.parametrize(
    ("height_m", "vz_mps", "lands", "late"),
    [
        (1.5, 0.0, False, True),
        (1.5 - SUNK_M - 0.01, 0.0, False, False),
        (1.5 - SUNK_M + 0.01, 0.0, False, True),
        (1.45, -COMING_DOWN_MPS - 0.01, False, False),
        (1.45, -COMING_DOWN_MPS + 0.01, False, True),
        (HANDED_OVER_M, 0.0, False, False),
        (1.5, 0.0, True, False),
        (1.8, 0.2, True, True),
    ],
)
def test_what_is_on_its_way_down_is_not_overdue(
    height_m: float, vz_mps: float, lands: bool, late: bool
) -> None:
    """Also in a landing of its own, whose curve starts from rest; one that climbs is none."""
    is_overdue = befallen(partial(e.hung, for_s=EVER))
    assert not is_overdue(2.0 + 1e-6)
    assert is_overdue(4.1, height_m=height_m, vz_mps=vz_mps, lands=lands) is late
