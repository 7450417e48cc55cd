"""The oracle on scripted truths: each flag raised, and not raised next to it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from perchctl.faults.oracle import Claim, Limits, Oracle, Sample, Verdict, drop_limit_m

DT_S = 0.01
G = 9.81
ON_THE_FLOOR = Sample(
    t_s=0.0, x_m=0.0, y_m=0.0, height_m=0.0, vz_mps=0.0, up_z=1.0, acc_g=1.0, motors_on=False,
    pressing=False, floor=True, hanging=False, hold_ratio=2.0, locked=False,
    ended_by_vehicle=False,
)  # fmt: skip
HOVER = ON_THE_FLOOR._replace(height_m=1.0, motors_on=True, floor=False)
HANGING = HOVER._replace(height_m=2.0, motors_on=False, hanging=True)
STILL_FALL = HANGING._replace(hanging=False, acc_g=0.0)


class Script:
    """Feeds an oracle; time goes on by itself."""

    def __init__(self) -> None:
        self.oracle = Oracle(Limits(fence_radius_m=2.0, max_height_m=3.0))
        self.t_s = 0.0

    def show(self, sample: Sample, for_s: float, **changes: Any) -> Script:
        for _ in range(max(1, round(for_s / DT_S))):
            self.oracle.see(sample._replace(t_s=self.t_s, **changes))
            self.t_s += DT_S
        return self

    def sink(self, sample: Sample, speeds: Iterator[float]) -> Script:
        """From the sample's height, at the given speeds, downwards positive."""
        height_m = sample.height_m
        for speed in speeds:
            height_m -= speed * DT_S
            if height_m <= 0.0:
                self.show(sample, DT_S, height_m=0.0, vz_mps=0.0, floor=True)
                break
            self.show(sample, DT_S, height_m=height_m, vz_mps=-speed)
        return self

    @property
    def verdict(self) -> Verdict:
        return self.oracle.verdict()

    @property
    def flags(self) -> set[str]:
        return set(self.verdict.flags)


def falling(acc: float, for_s: float, start: float = 0.0) -> Iterator[float]:
    for k in range(round(for_s / DT_S)):
        yield start + acc * (k + 1) * DT_S


def arrested(start: float, for_s: float) -> Iterator[float]:
    steps = round(for_s / DT_S)
    for k in range(steps):
        yield start * (1 - (k + 1) / steps)


def test_a_flight_that_hangs_raises_nothing() -> None:
    script = Script().show(ON_THE_FLOOR, 1.0).show(HOVER, 2.0).show(HANGING, 2.0)
    script.oracle.claims("perched", script.t_s)
    script.oracle.ended(script.t_s)
    assert script.show(HANGING, 6.0).flags == set()
    assert script.verdict.drop_m == 0.0


def test_motors_off_in_the_air_is_a_fall() -> None:
    assert Script().show(HOVER, 1.0).show(HOVER, 0.15, motors_on=False).flags == {"fell"}


def test_motors_off_for_a_moment_is_none() -> None:
    script = Script().show(HOVER, 1.0).show(HOVER, 0.05, motors_on=False).show(HOVER, 1.0)
    assert script.flags == set()


def test_motors_off_just_above_the_floor_is_none() -> None:
    low = HOVER._replace(height_m=0.08)
    assert Script().show(low, 1.0).show(low, 0.3, motors_on=False).flags == set()


def test_free_fall_with_turning_motors_is_a_fall() -> None:
    assert Script().show(HOVER, 1.0).show(HOVER, 0.2, acc_g=0.1).flags == {"fell"}
    assert Script().show(HOVER, 1.0).show(HOVER, 0.2, acc_g=0.5).flags == set()


@pytest.mark.parametrize(("sink_mps", "flags"), [(0.9, {"fell"}), (0.7, set())])
def test_touchdown(sink_mps: float, flags: set[str]) -> None:
    low = HOVER._replace(height_m=0.3)
    script = Script().show(low, 0.1)
    assert script.sink(low, iter([sink_mps] * 100)).flags == flags


def slip(ratio: float, acc: float, fall_s: float, brake_s: float = 0.2) -> Verdict:
    hang = HANGING._replace(hold_ratio=ratio)
    script = Script().show(hang, 1.0)
    dropped = STILL_FALL._replace(acc_g=1.0 - acc / G, motors_on=acc < G)
    script.sink(dropped, falling(acc, fall_s))
    fast = acc * fall_s
    low_m = 2.0 - 0.5 * acc * fall_s**2
    caught = HOVER._replace(height_m=low_m, acc_g=1.0 + fast / brake_s / G)
    script.sink(caught, arrested(fast, brake_s))
    return script.show(HOVER, 1.0, height_m=low_m - 0.1).verdict


def test_a_slip_that_is_caught_in_time_is_no_fall() -> None:
    verdict = slip(1.0, G, 0.35)
    assert verdict.flags == {}
    assert verdict.drop_m == pytest.approx(0.5 * G * 0.35**2 + 0.5 * G * 0.35 * 0.2, abs=0.06)
    assert verdict.slip_ratio == 1.0


def test_a_slip_that_falls_too_deep_is_a_fall() -> None:
    assert set(slip(0.7, G, 0.35).flags) == {"fell"}  # 0.9 m, where 0.6 are allowed
    assert set(slip(1.0, G, 0.45).flags) == {"fell"}


def test_a_slip_with_the_motors_turning_is_a_descent() -> None:
    """In position mode the thrust never goes below a third of the weight."""
    verdict = slip(0.2, 0.4 * G, 0.2, 0.5)
    assert verdict.flags == {}
    assert 0.15 < verdict.drop_m < 0.4


def test_a_slip_to_the_floor_is_a_fall() -> None:
    low = HANGING._replace(height_m=0.3, hold_ratio=1.0)
    script = Script().show(low, 1.0)
    script.sink(STILL_FALL._replace(height_m=0.3), falling(0.4 * G, 1.0))
    assert script.flags == {"fell"}


def test_the_limit_of_a_slip() -> None:
    assert [drop_limit_m(r) for r in (0.2, 0.3, 0.5, 0.75, 0.9, 1.1)] == [
        0.15, 0.15, 0.6, 0.6, 1.0, 1.0,
    ]  # fmt: skip


def test_a_controlled_descent_is_no_fall() -> None:
    script = Script().show(HOVER, 0.5)
    script.sink(HOVER, iter([0.35] * 300)).show(ON_THE_FLOOR, 1.0)
    assert script.flags == set()
    assert script.verdict.drop_m == 0.0


def test_let_go_long_after_is_a_fall() -> None:
    """Nobody is there to catch it: it is judged by the floor at the latest."""
    script = Script().show(HANGING, 1.0)
    script.sink(STILL_FALL, falling(G, 2.0))
    assert script.flags == {"fell"}


@pytest.mark.parametrize(("for_s", "flags"), [(3.8, set()), (4.2, {"pressed"})])
def test_pressed(for_s: float, flags: set[str]) -> None:
    assert Script().show(HOVER, 0.1).show(HOVER, for_s, pressing=True).flags == flags


def test_pressed_again_and_again_is_not_pressed_in_a_row() -> None:
    script = Script()
    for _ in range(3):
        script.show(HOVER, 3.0, pressing=True).show(HOVER, 0.1)
    assert script.flags == set()


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({"x_m": 2.2}, set()),
        ({"x_m": 1.7, "y_m": -1.7}, {"strayed"}),
        ({"height_m": 3.2}, set()),
        ({"height_m": 3.4}, {"strayed"}),
        ({"x_m": 2.6, "drifted_m": 0.5}, set()),
        ({"x_m": 2.9, "drifted_m": 0.5}, {"strayed"}),
    ],
)
def test_strayed(changes: dict[str, float], flags: set[str]) -> None:
    assert Script().show(HOVER, 0.5, **changes).flags == flags


def test_outside_on_the_floor_is_where_it_landed() -> None:
    assert Script().show(ON_THE_FLOOR, 1.0, x_m=2.5).flags == set()


@pytest.mark.parametrize(
    ("claim", "truth", "flags"),
    [
        ("perched", HANGING, set()),
        ("perched", HANGING._replace(motors_on=True), {"lied"}),
        ("perched", ON_THE_FLOOR, {"lied"}),
        ("landed", ON_THE_FLOOR, set()),
        ("landed", ON_THE_FLOOR._replace(motors_on=True), {"lied"}),
        ("landed", HANGING, {"lied"}),
        ("cut", ON_THE_FLOOR, set()),
        ("cut", ON_THE_FLOOR._replace(motors_on=True), {"lied"}),
        ("none", ON_THE_FLOOR._replace(motors_on=True), set()),
    ],
)
def test_lied(claim: Claim, truth: Sample, flags: set[str]) -> None:
    script = Script().show(truth, 1.0)
    script.oracle.claims(claim, script.t_s)
    assert script.show(truth, 2.0).flags == flags


def test_a_claim_has_half_a_second_to_become_true() -> None:
    script = Script().show(ON_THE_FLOOR, 1.0, motors_on=True)
    script.oracle.claims("cut", script.t_s)
    assert script.show(ON_THE_FLOOR, 0.3, motors_on=True).show(ON_THE_FLOOR, 2.0).flags == set()


@pytest.mark.parametrize(
    ("truth", "flags"),
    [
        (HOVER, {"flies_on"}),
        (HANGING, set()),
        (HANGING._replace(motors_on=True), {"flies_on"}),
        (ON_THE_FLOOR, set()),
        (ON_THE_FLOOR._replace(motors_on=True), set()),
    ],
)
def test_flies_on(truth: Sample, flags: set[str]) -> None:
    script = Script().show(truth, 1.0)
    script.oracle.ended(script.t_s)
    assert script.show(truth, 4.9).flags == set()
    assert script.show(truth, 0.3).flags == flags


def test_a_lock_without_reason_is_needless() -> None:
    assert Script().show(ON_THE_FLOOR, 1.0, locked=True).flags == {"locked_needlessly"}


def test_what_falls_after_the_end_does_not_fly() -> None:
    script = Script().show(HANGING, 1.0)
    script.oracle.ended(script.t_s)
    script.show(HANGING, 4.9)
    assert script.sink(STILL_FALL, falling(G, 2.0)).flags == {"fell"}


@pytest.mark.parametrize("changes", [{"ended_by_vehicle": True}, {"up_z": 0.3}])
def test_a_lock_after_a_crash_has_its_reason(changes: dict[str, Any]) -> None:
    script = Script().show(ON_THE_FLOOR, 0.1, **changes).show(ON_THE_FLOOR, 1.0, locked=True)
    assert script.flags == set()


def test_what_tumbles_after_the_lock_was_locked_without_reason() -> None:
    script = Script().show(ON_THE_FLOOR, 0.5, locked=True)
    assert script.show(ON_THE_FLOOR, 1.0, locked=True, up_z=-1.0).flags == {"locked_needlessly"}
