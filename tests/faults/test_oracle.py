"""The oracle on scripted truths: each flag raised, and not raised next to it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from perchctl.faults.claims import Claim
from perchctl.faults.oracle import (
    FLAGS,
    SAY_OFF,
    Limits,
    Oracle,
    Sample,
    Verdict,
    drop_limit_m,
    second_press_s,
)

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
        self.oracle = Oracle(Limits(max_height_m=3.0, max_tilt_deg=55.0))
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
    script.oracle.claims(frozenset({"hangs"}), script.t_s)
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
    assert script.verdict.touchdown_mps == pytest.approx(sink_mps)


@pytest.mark.parametrize(("aside_mps", "flags"), [(0.6, {"slid"}), (0.4, set())])
def test_a_touchdown_sideways(aside_mps: float, flags: set[str]) -> None:
    """By its speed before the floor brakes it; a vehicle that slides on is judged once."""
    low = HOVER._replace(height_m=0.2, aside_mps=aside_mps)
    script = Script().show(low, 0.1).sink(low, iter([0.2] * 200))
    assert script.show(ON_THE_FLOOR, 0.5, aside_mps=0.0).flags == flags
    assert script.verdict.touchdown_aside_mps == pytest.approx(aside_mps)


def test_the_hardest_touchdown_is_kept() -> None:
    low = HOVER._replace(height_m=0.1)
    script = Script()
    for sink_mps in (0.3, 0.5, 0.1):
        script.show(low, 0.1).sink(low, iter([sink_mps] * 200))
    assert script.verdict.touchdown_mps == pytest.approx(0.5)


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
        script.show(HOVER, 3.0, pressing=True).show(HOVER, 0.3)
    assert script.flags == set()


def test_what_bounces_off_presses_on() -> None:
    script = Script()
    for _ in range(50):
        script.show(HOVER, 0.05, pressing=True).show(HOVER, 0.05)
    assert script.flags == {"pressed"}


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({"astray_m": 0.9}, set()),
        ({"astray_m": 1.1}, {"strayed"}),
        ({"height_m": 3.2}, set()),
        ({"height_m": 3.4}, {"strayed"}),
    ],
)
def test_strayed(changes: dict[str, float], flags: set[str]) -> None:
    script = Script().show(HOVER, 0.5, **changes)
    assert script.flags == flags
    assert script.verdict.astray_m == changes.get("astray_m", 0.0)


def test_astray_on_the_floor_is_where_it_landed() -> None:
    assert Script().show(ON_THE_FLOOR, 1.0, astray_m=2.5).flags == set()


LOCKED = ON_THE_FLOOR._replace(locked=True, ended_by_vehicle=True)


@pytest.mark.parametrize(
    ("claim", "truth", "flags"),
    [
        ("hangs on the target", HANGING, set()),
        ("hangs on the target", HANGING._replace(miss_m=0.024), set()),
        ("hangs on the target", HANGING._replace(miss_m=0.026), {"lied"}),
        ("hangs on the target", HANGING._replace(motors_on=True), {"lied"}),
        ("hangs on the target", ON_THE_FLOOR, {"lied"}),
        ("held off the target", HANGING, {"lied"}),
        ("held off the target", HANGING._replace(miss_m=0.015, below_m=0.019), {"lied"}),
        ("held off the target", HANGING._replace(miss_m=0.015, below_m=0.021), set()),
        ("held off the target", HANGING._replace(miss_m=0.026), set()),
        ("held off the target", HANGING._replace(below_m=-0.026), set()),
        ("held off the target", HANGING._replace(below_m=0.2, motors_on=True), {"lied"}),
        ("held off the target", ON_THE_FLOOR._replace(below_m=2.0), {"lied"}),
        ("hangs", HANGING._replace(miss_m=0.026), set()),
        ("hangs", HANGING, set()),
        ("hangs", HANGING._replace(motors_on=True), {"lied"}),
        ("hangs", ON_THE_FLOOR, {"lied"}),
        ("stands", ON_THE_FLOOR, set()),
        ("stands", ON_THE_FLOOR._replace(motors_on=True), {"lied"}),
        ("stands", HANGING, {"lied"}),
        ("stands", ON_THE_FLOOR._replace(up_z=-1.0), {"lied"}),
        ("stands", ON_THE_FLOOR._replace(up_z=0.5), {"lied"}),
        ("stands", ON_THE_FLOOR._replace(up_z=0.6), set()),
        ("hangs or stands", HANGING, set()),
        ("hangs or stands", ON_THE_FLOOR, set()),
        ("hangs or stands", HANGING._replace(motors_on=True), {"lied"}),
        ("hangs or stands", HOVER, {"lied"}),
        ("hangs or stands", ON_THE_FLOOR._replace(up_z=-1.0), {"lied"}),
        ("motors off", ON_THE_FLOOR, set()),
        ("motors off", ON_THE_FLOOR._replace(motors_on=True), {"lied"}),
        ("locked", LOCKED, set()),
        ("locked", ON_THE_FLOOR, {"lied"}),
        ("ended by the supervisor", LOCKED, set()),
        ("ended by the supervisor", ON_THE_FLOOR, {"lied"}),
        ("tilted", ON_THE_FLOOR._replace(up_z=0.3), set()),
        ("tilted", ON_THE_FLOOR._replace(up_z=0.9), {"lied"}),
    ],
)
def test_lied(claim: Claim, truth: Sample, flags: set[str]) -> None:
    script = Script().show(truth, 1.0)
    script.oracle.claims(frozenset({claim}), script.t_s)
    assert script.show(truth, 2.0).flags == flags


def test_each_of_several_claims_has_to_be_true() -> None:
    script = Script().show(HANGING, 1.0)
    script.oracle.claims(frozenset({"hangs", "locked"}), script.t_s)
    assert script.show(HANGING, 2.0).flags == {"lied"}


def test_what_tilted_and_crashed_before_did_so() -> None:
    script = Script().show(HOVER, 0.2, up_z=0.2, ended_by_vehicle=True).show(ON_THE_FLOOR, 1.0)
    script.oracle.claims(frozenset({"tilted", "ended by the supervisor"}), script.t_s)
    assert script.show(ON_THE_FLOOR, 2.0).flags == set()


def test_a_claim_has_half_a_second_to_become_true() -> None:
    script = Script().show(ON_THE_FLOOR, 1.0, motors_on=True)
    script.oracle.claims(frozenset({"motors off"}), script.t_s)
    assert script.show(ON_THE_FLOOR, 0.3, motors_on=True).show(ON_THE_FLOOR, 2.0).flags == set()


@pytest.mark.parametrize("claim", sorted(SAY_OFF))
def test_motors_that_were_said_to_be_off_turn_no_more(claim: Claim) -> None:
    truth = HANGING._replace(below_m=0.1) if claim.startswith("h") else ON_THE_FLOOR
    script = Script().show(truth, 1.0)
    script.oracle.claims(frozenset({claim}), script.t_s)
    assert script.show(truth, 3.0).flags == set()
    assert script.show(truth, 0.05, motors_on=True).flags == {"lied"}


@pytest.mark.parametrize("truth", [HANGING, ON_THE_FLOOR])
@pytest.mark.parametrize(
    ("at_rest_s", "changes", "flags"),
    [
        (5.0, {}, set()),
        (6.5, {}, {"lied"}),
        (6.5, {"heard": False}, set()),
        (6.5, {"motors_on": True}, set()),
    ],
)
def test_a_landing_that_was_to_be_seen_is_not_unconfirmed(
    truth: Sample, at_rest_s: float, changes: dict[str, Any], flags: set[str]
) -> None:
    script = Script().show(truth, at_rest_s, **changes)
    script.oracle.claims(frozenset({"not seen down"}), script.t_s)
    assert script.show(truth, 0.6, **changes).flags == flags


def test_what_is_said_of_a_lock_says_nothing_of_later_motors() -> None:
    script = Script().show(LOCKED, 1.0)
    script.oracle.claims(frozenset({"locked"}), script.t_s)
    assert script.show(LOCKED, 1.0).show(LOCKED, 0.1, motors_on=True).flags == set()


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


def test_what_should_have_come_down_flies_on() -> None:
    assert Script().show(HOVER, 0.1, overdue=True).flags == {"flies_on"}
    assert Script().show(HANGING, 0.1, overdue=True).flags == set()
    assert Script().show(ON_THE_FLOOR, 0.1, overdue=True, motors_on=True).flags == set()


def test_how_the_program_ended() -> None:
    for how in ("crashed", "endless"):
        script = Script().show(ON_THE_FLOOR, 1.0)
        script.oracle.ended(script.t_s, **{how: True})
        assert script.show(ON_THE_FLOOR, 1.0).verdict.flags == {how: pytest.approx(1.0)}


# --- the second Ctrl-C ------------------------------------------------------------------


def every(period_s: float, for_s: float) -> list[float]:
    return [period_s * k for k in range(int(for_s / period_s) + 1)]


@pytest.mark.parametrize(
    ("presses_s", "second_s"),
    [
        ([], None),
        ([3.0], None),
        ([3.0, 3.4], None),
        ([3.0, 3.6], 3.6),
        ([3.0, 3.2, 3.4, 3.6], None),
        ([3.0, 3.2, 3.4, 3.8], 3.8),
        (every(0.03, 1.9), None),
        (every(0.14, 1.9), None),
        (every(0.1, 2.5), 2.0),
    ],
)
def test_which_press_is_the_second(presses_s: list[float], second_s: float | None) -> None:
    found_s = second_press_s(presses_s)
    assert found_s == (None if second_s is None else pytest.approx(second_s))


def stopped(after_s: float, silent_s: float = 0.0) -> set[str]:
    """Ctrl-C twice in a hover; the motors stand still so long after the second, near the floor.
    For `silent_s` from there on no packet passes."""
    low = HOVER._replace(height_m=0.05)
    script = Script().show(low, 1.0)
    script.oracle.pressed(script.t_s)
    script.show(low, 1.0)
    script.oracle.pressed(script.t_s)
    if silent_s:
        script.show(low, silent_s, uplink=False)
    if after_s > silent_s:
        script.show(low, after_s - silent_s)
    return script.show(low, 1.0, motors_on=False).flags


def test_the_second_ctrl_c_stops_the_motors_within_half_a_second() -> None:
    assert stopped(0.4) == set()
    assert stopped(0.6) == {"stop_not_obeyed"}


def test_what_is_not_heard_is_not_disobeyed() -> None:
    assert stopped(1.4, silent_s=1.0) == set()
    assert stopped(1.6, silent_s=1.0) == {"stop_not_obeyed"}


def test_motors_that_the_second_ctrl_c_stopped_stay_off() -> None:
    low = HOVER._replace(height_m=0.05)
    script = Script().show(low, 1.0)
    for _ in range(2):
        script.oracle.pressed(script.t_s)
        script.show(low, 0.6, motors_on=script.oracle.stop_s is None)
    assert script.show(low, 1.0, motors_on=False).flags == set()
    assert script.show(low, 0.1).flags == {"stop_not_obeyed"}


def test_one_ctrl_c_asks_for_no_stop() -> None:
    script = Script().show(HOVER, 1.0)
    script.oracle.pressed(script.t_s)
    assert script.show(HOVER, 5.0).flags == set()
    assert script.oracle.stop_s is None


def test_nobody_is_there_to_obey_after_the_end() -> None:
    script = Script().show(ON_THE_FLOOR, 1.0, motors_on=True)
    script.oracle.ended(script.t_s)
    for _ in range(2):
        script.show(ON_THE_FLOOR, 1.0, motors_on=True)
        script.oracle.pressed(script.t_s)
    assert script.show(ON_THE_FLOOR, 1.0, motors_on=True).flags == set()


def test_flags_are_told_in_the_order_in_which_they_came() -> None:
    script = Script().show(HOVER, 0.1, astray_m=2.0).show(HOVER, 0.3, motors_on=False)
    assert list(script.verdict.flags) == ["strayed", "fell"]
    assert set(script.verdict.flags) <= set(FLAGS)


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
