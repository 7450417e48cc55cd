"""The catalogue: every fault can be drawn, the same again, and is on the page of faults."""

from __future__ import annotations

import math
import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from perchctl.errors import UsageError
from perchctl.faults import effects as e
from perchctl.faults.catalogue import (
    AIR,
    FAULTS,
    USUAL_S,
    Fault,
    case_of,
    draw_case,
    selected,
)
from perchctl.faults.excuses import CUT_S, EXCUSES, Facts
from perchctl.faults.oracle import FLAGS
from perchctl.mission.state import Phase
from perchctl.sim.scenario import Scenario

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "faults.md").read_text(encoding="utf-8")
SCENARIO = Scenario(seed=5)
NAN = math.nan


def facts(*effects: e.Effect, **changes: object) -> Facts:
    plain = Facts(
        effects=effects, begin_s=5.0, report_s=20.0, let_go_s=None, own_landing=False,
        weak_s=None, low_s=None, low_m=0.0, hung_m=None,
    )  # fmt: skip
    return Facts(**{**vars(plain), **changes})  # type: ignore[arg-type]


def excused(name: str, case: Facts) -> bool:
    return next(excuse for excuse in EXCUSES if excuse.name == name).when(case)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f.name)
def test_a_fault_is_well_formed(fault: Fault) -> None:
    assert re.fullmatch(r"[a-z]+(-[a-z]+)*", fault.name)
    assert all(f"\n| {row} | " in PAGE for row in fault.rows)
    assert set(fault.phases) <= set(AIR)
    assert set(USUAL_S) == set(AIR)
    for seed in range(20):
        for phase in fault.phases:
            case = case_of(fault, phase, np.random.default_rng(seed), SCENARIO)
            assert case == case_of(fault, phase, np.random.default_rng(seed), SCENARIO) or (
                "nan" in repr(case)
            )
            assert 0.0 <= case.moment_s <= USUAL_S[phase]
            assert case.effects
            assert (case.landed_from is not None) == (phase is Phase.LANDING)
            assert (case.first_hold is not None) == (phase is Phase.RECOVER)
            for effect in case.effects:
                assert getattr(effect, "for_s", 1.0) > 0.0
                assert all(v is None or isinstance(v, object) for v in asdict(effect).values())


def test_names_are_given_once() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


def test_a_seed_draws_the_same_fault_again_and_others_draw_others() -> None:
    drawn = [repr(draw_case(seed, SCENARIO)) for seed in range(200)]
    assert drawn == [repr(draw_case(seed, SCENARIO)) for seed in range(200)]
    cases = [draw_case(seed, SCENARIO) for seed in range(200)]
    assert len({case.fault.name for case in cases}) > 0.9 * len(FAULTS)
    assert {case.phase for case in cases} == set(AIR)


def test_a_selection_by_name() -> None:
    assert selected("all") == FAULTS
    assert [fault.name for fault in selected("hung, killed")] == ["hung", "killed"]
    with pytest.raises(UsageError, match=r"'hanged' is unknown.*--faults list"):
        selected("killed,hanged")
    assert {draw_case(seed, SCENARIO, selected("slow")).fault.name for seed in range(5)} == {"slow"}


def test_excuses_name_flags_and_reasons() -> None:
    used = {excuse.name for fault in FAULTS for excuse in fault.excuses}
    assert used == {excuse.name for excuse in EXCUSES}
    for excuse in EXCUSES:
        assert excuse.reason
        assert excuse.expected
        assert excuse.expected <= set(FLAGS)


@pytest.mark.parametrize(
    ("effect", "changes", "holds"),
    [
        (e.Silence(CUT_S, up=True, down=False), {}, True),
        (e.Silence(1.5, up=True, down=True), {}, False),
        (e.Silence(e.FOR_EVER, up=False, down=True), {}, False),
        (e.Silence(e.FOR_EVER, up=True, down=True), {"own_landing": True}, False),
        (e.Silence(e.FOR_EVER, up=True, down=True), {"begin_s": None}, False),
        (e.Killed(), {}, True),
        (e.Killed(), {"own_landing": True}, False),
        (e.Suspended(2.5), {}, True),
        (e.Suspended(1.0), {}, False),
        (e.Hung(e.FOR_EVER), {}, False),
    ],
)
def test_what_the_firmware_cuts(effect: e.Effect, changes: dict[str, object], holds: bool) -> None:
    assert excused("cut by the firmware", facts(effect, **changes)) is holds


def test_who_stops_what() -> None:
    assert excused("lands alone", facts(e.Killed(), own_landing=True))
    assert not excused("lands alone", facts(e.Hung(9.0), own_landing=True))
    assert excused("the operator's word", facts(e.Operator((0.0, 0.8))))
    assert not excused("the operator's word", facts(e.Operator((0.0, 0.03, 0.4))))
    held = tuple(0.03 * k for k in range(100))
    assert not excused("the operator's word", facts(e.Operator(held)))
    assert not excused("the operator's word", facts(e.Operator((0.0, 0.8)), begin_s=None))
    assert excused("let go after the flight", facts(e.MagnetLetsGo(9.0), let_go_s=21.0))
    assert not excused("let go after the flight", facts(e.MagnetLetsGo(9.0), let_go_s=19.0))
    assert excused("too low to catch", facts(e.MagnetHolds(0.9), hung_m=0.8))
    assert not excused("too low to catch", facts(e.MagnetHolds(0.9), hung_m=1.2))
    assert excused("too weak to hover", facts(e.MotorWeak(1, 0.85), weak_s=6.0))
    assert not excused("too weak to hover", facts(e.MotorWeak(1, 0.85)))


@pytest.mark.parametrize(
    ("weak_s", "low_s", "low_m", "holds"),
    [
        (None, 8.0, 2.0, False),
        (10.0, 8.0, 2.0, True),
        (10.0, None, 0.0, True),
        (15.0, 8.0, 2.0, False),
        (10.0, 8.0, 0.1, False),
    ],
)
def test_a_battery_that_leaves_no_time(
    weak_s: float | None, low_s: float | None, low_m: float, holds: bool
) -> None:
    sags = facts(e.BatterySags(0.1, 0.6), weak_s=weak_s, low_s=low_s, low_m=low_m)
    assert excused("sags too fast", sags) is holds
