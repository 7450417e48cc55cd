"""The oracle on scripted truths: each flag raised, and not raised next to it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest

from perchctl.faults.oracle import SAY_OFF, Claim, Oracle, Sample, drop_limit_m, emergency_stop_s

DT_S = 0.01
G = 9.81
FLOOR = Sample(
    t_s=0.0, x_m=0.0, y_m=0.0, height_m=0.0, vz_mps=0.0, body_up_z=1.0, acc_g=1.0, motors_on=False,
    pressing=False, on_floor=True, hanging=False, hold_ratio=2.0, locked=False,
    supervisor_ended=False,
)  # fmt: skip
FLOOR_ON = FLOOR._replace(motors_on=True)
LOCKED = FLOOR._replace(locked=True, supervisor_ended=True)
HOVER = FLOOR._replace(height_m=1.0, motors_on=True, on_floor=False)
LOW = HOVER._replace(height_m=0.05)
HANGING = HOVER._replace(height_m=2.0, motors_on=False, hanging=True)
HANGING_ON = HANGING._replace(motors_on=True)
STILL_FALL = HANGING._replace(hanging=False, acc_g=0.0)


class Script:
    """Feeds an oracle; time goes on by itself."""

    def __init__(self, *shown: tuple[Sample, float]) -> None:
        self.oracle = Oracle(max_height_m=3.0)
        self.t_s = 0.0
        for sample, for_s in shown:
            self.show(sample, for_s)

    def show(self, sample: Sample, for_s: float, **changes: Any) -> Script:
        for _ in range(max(1, round(for_s / DT_S))):
            self.oracle.update(sample._replace(t_s=self.t_s, **changes))
            self.t_s += DT_S
        return self

    def sink(self, sample: Sample, speeds: Iterator[float]) -> Script:
        """From the sample's height, at the given speeds, downwards positive."""
        height_m = sample.height_m
        for speed in speeds:
            height_m -= speed * DT_S
            if height_m <= 0.0:
                self.show(sample, DT_S, height_m=0.0, vz_mps=0.0, on_floor=True)
                break
            self.show(sample, DT_S, height_m=height_m, vz_mps=-speed)
        return self

    def claim(self, *claims: Claim) -> Script:
        self.oracle.add_claims(frozenset(claims), self.t_s)
        return self

    def press(self) -> Script:
        self.oracle.note_ctrl_c(self.t_s)
        return self

    def end(self) -> Script:
        self.oracle.note_program_end(self.t_s)
        return self

    @property
    def flags(self) -> set[str]:
        return set(self.oracle.flags)


def falling(acc: float, for_s: float) -> Iterator[float]:
    for k in range(round(for_s / DT_S)):
        yield acc * (k + 1) * DT_S


def arrested(start: float, for_s: float) -> Iterator[float]:
    steps = round(for_s / DT_S)
    for k in range(steps):
        yield start * (1 - (k + 1) / steps)


def test_a_flight_that_hangs_raises_nothing() -> None:
    script = Script((FLOOR, 1.0), (HOVER, 2.0), (HANGING, 2.0)).claim("hangs").end()
    assert script.show(HANGING, 6.0).flags == set()
    assert script.oracle.drop_m == 0.0


@pytest.mark.parametrize(
    ("last", "for_s", "flags"),
    [
        (HOVER._replace(motors_on=False), 0.15, {"fell"}),
        (HOVER._replace(motors_on=False), 0.05, set()),
        (HOVER._replace(motors_on=False, height_m=0.08), 0.3, set()),
        (HOVER._replace(acc_g=0.1), 0.2, {"fell"}),
        (HOVER._replace(acc_g=0.5), 0.2, set()),
        (HOVER._replace(pressing=True), 3.8, set()),
        (HOVER._replace(pressing=True), 4.2, {"pressed"}),
        (HOVER._replace(astray_m=0.9), 0.5, set()),
        (HOVER._replace(astray_m=1.1), 0.5, {"strayed"}),
        (HOVER._replace(height_m=3.2), 0.5, set()),
        (HOVER._replace(height_m=3.4), 0.5, {"strayed"}),
        (FLOOR._replace(astray_m=2.5), 0.5, set()),  # where it landed
        (HOVER._replace(descent_overdue=True), 0.1, {"flies_on"}),
        (HANGING._replace(descent_overdue=True), 0.1, set()),
        (FLOOR_ON._replace(descent_overdue=True), 0.1, set()),
        (FLOOR._replace(locked=True), 1.0, {"locked_needlessly"}),
    ],
)
def test_what_is_a_flag_and_what_is_not_yet_one(
    last: Sample, for_s: float, flags: set[str]
) -> None:
    before = FLOOR if last.on_floor else HOVER
    script = Script((before, 1.0), (last, for_s))
    assert script.flags == flags
    assert script.oracle.astray_m == (0.0 if last.on_floor else last.astray_m)
    assert script.show(before, 1.0).flags == flags


# --- falls and touchdowns -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sink_mps", "aside_mps", "flags"),
    [
        (0.9, 0.0, {"fell"}), (0.7, 0.0, set()), (0.2, 0.6, {"slid"}), (0.2, 0.4, set()),
    ],
)  # fmt: skip
def test_touchdown(sink_mps: float, aside_mps: float, flags: set[str]) -> None:
    """By its speed before the floor brakes it; a vehicle that slides on is judged once."""
    low = HOVER._replace(height_m=0.3, horizontal_mps=aside_mps)
    script = Script((low, 0.1)).sink(low, iter([sink_mps] * 200)).show(FLOOR, 0.5)
    assert script.flags == flags
    low = HOVER._replace(height_m=0.1)
    script.show(low, 0.1).sink(low, iter([0.1] * 200))
    assert script.flags == flags


@pytest.mark.parametrize("motors_on", [False, True])
def test_a_blow_to_a_vehicle_that_stands_is_no_touchdown(motors_on: bool) -> None:
    """Its motors are off: nothing that the program did threw it off the floor (seed 2612011136)."""
    stands = FLOOR._replace(motors_on=motors_on)
    thrown = HOVER._replace(height_m=0.005, horizontal_mps=0.9, motors_on=motors_on, acc_g=1.0)
    script = Script((stands, 1.0)).show(thrown, 0.1).show(stands, 1.0)
    assert script.flags == ({"slid"} if motors_on else set())


def test_a_flight_that_begins_in_such_a_hop_is_judged() -> None:
    stands = FLOOR._replace(motors_on=False)
    hops = HOVER._replace(height_m=0.005, motors_on=False, acc_g=1.0)
    low = HOVER._replace(height_m=0.3, horizontal_mps=0.9)
    script = Script((stands, 1.0)).show(hops, 0.03).show(low, 0.5)
    assert script.sink(low, iter([0.9] * 200)).show(FLOOR, 0.5).flags == {"fell", "slid"}


def slip(
    ratio: float, acc: float, fall_s: float, brake_s: float = 0.2, reserve: float = math.inf
) -> Oracle:
    script = Script((HANGING._replace(hold_ratio=ratio), 1.0))
    dropped = STILL_FALL._replace(acc_g=1.0 - acc / G, motors_on=acc < G, thrust_reserve=reserve)
    script.sink(dropped, falling(acc, fall_s))
    fast = acc * fall_s
    low_m = 2.0 - 0.5 * acc * fall_s**2
    caught = HOVER._replace(height_m=low_m, acc_g=1.0 + fast / brake_s / G)
    script.sink(caught, arrested(fast, brake_s))
    return script.show(HOVER, 1.0, height_m=low_m - 0.1).oracle


def test_a_slip_is_a_fall_where_it_is_too_deep_for_what_the_magnet_held() -> None:
    judge = slip(1.0, G, 0.35)
    assert judge.flags == {}
    assert judge.drop_m == pytest.approx(0.5 * G * 0.35**2 + 0.5 * G * 0.35 * 0.2, abs=0.06)
    assert set(slip(0.7, G, 0.35).flags) == {"fell"}  # 0.9 m, where 0.6 are allowed
    assert set(slip(1.0, G, 0.45).flags) == {"fell"}
    limits = [drop_limit_m(r) for r in (0.2, 0.3, 0.5, 0.75, 0.9, 1.1)]
    assert limits == [0.15, 0.15, 0.6, 0.6, 1.0, 1.0]


def test_a_vehicle_with_little_thrust_to_spare_may_fall_deeper() -> None:
    """It brakes in a distance that is inversely proportional to its reserve."""
    usual_m = drop_limit_m(1.0)
    assert [drop_limit_m(1.0, reserve) for reserve in (1.0, 0.165)] == [usual_m] * 2
    assert drop_limit_m(1.0, 0.11) == pytest.approx(1.25 * usual_m)
    assert drop_limit_m(0.5, 0.05) == drop_limit_m(0.5, -0.2) == pytest.approx(2.15 * 0.6)
    assert drop_limit_m(0.2, 0.05) == drop_limit_m(0.2)  # such a slip is noticed at once
    assert set(slip(1.0, G, 0.45, reserve=0.3).flags) == {"fell"}  # 1.4 m
    assert slip(1.0, G, 0.45, reserve=0.08).flags == {}


@pytest.mark.parametrize(
    ("height_m", "acc", "ended"), [(0.3, 0.4 * G, False), (2.0, G, False), (2.0, G, True)]
)
def test_a_slip_to_the_floor_is_a_fall(height_m: float, acc: float, ended: bool) -> None:
    """Also long after the end, when nobody is there to catch it: it falls, and does not fly."""
    script = Script((HANGING._replace(height_m=height_m, hold_ratio=1.0), 1.0))
    if ended:
        script.end().show(HANGING, 4.9)
    assert script.sink(STILL_FALL._replace(height_m=height_m), falling(acc, 2.0)).flags == {"fell"}


@pytest.mark.parametrize(
    ("times", "press_s", "pause_s", "flags"), [(3, 3.0, 0.3, set()), (50, 0.05, 0.05, {"pressed"})]
)
def test_what_bounces_off_presses_on(
    times: int, press_s: float, pause_s: float, flags: set[str]
) -> None:
    """And what pauses for longer does not press in a row."""
    script = Script()
    for _ in range(times):
        script.show(HOVER, press_s, pressing=True).show(HOVER, pause_s)
    assert script.flags == flags


# --- claims -------------------------------------------------------------------------------------


TRUTHS = {
    "hangs on the target": (
        (HANGING, HANGING._replace(miss_m=0.024)),
        (HANGING._replace(miss_m=0.026), HANGING_ON, FLOOR),
    ),
    "held off the target": (
        (HANGING._replace(miss_m=0.015, below_m=0.021), HANGING._replace(miss_m=0.026),
         HANGING._replace(below_m=-0.026)),
        (HANGING, HANGING._replace(miss_m=0.015, below_m=0.019), HANGING_ON._replace(below_m=0.2),
         FLOOR._replace(below_m=2.0)),
    ),
    "hangs": ((HANGING, HANGING._replace(miss_m=0.026)), (HANGING_ON, FLOOR)),
    "stands": (
        (FLOOR, FLOOR._replace(body_up_z=0.6)),
        (FLOOR_ON, HANGING, FLOOR._replace(body_up_z=-1.0), FLOOR._replace(body_up_z=0.5)),
    ),
    "hangs or stands": (
        (HANGING, FLOOR), (HANGING_ON, HOVER, FLOOR._replace(body_up_z=-1.0)),
    ),
    "motors off": ((FLOOR,), (FLOOR_ON,)),
    "locked": ((LOCKED,), (FLOOR,)),
    "ended by the supervisor": ((LOCKED,), (FLOOR,)),
    "tilted": ((FLOOR._replace(body_up_z=0.3),), (FLOOR._replace(body_up_z=0.9),)),
}  # fmt: skip
"""Of each claim what it is true of, and what it is not."""


@pytest.mark.parametrize("claim", TRUTHS)
def test_lied(claim: Claim) -> None:
    for truths, flags in zip(TRUTHS[claim], (set(), {"lied"}), strict=True):
        for truth in truths:
            assert Script((truth, 1.0)).claim(claim).show(truth, 2.0).flags == flags, truth


def test_a_claim_may_be_of_before_or_become_true_within_half_a_second() -> None:
    script = Script((HOVER._replace(body_up_z=0.2, supervisor_ended=True), 0.2), (FLOOR_ON, 1.0))
    script.claim("tilted", "ended by the supervisor", "motors off")
    assert script.show(FLOOR_ON, 0.3).show(FLOOR, 2.0).flags == set()


@pytest.mark.parametrize("claim", [*sorted(SAY_OFF), "locked"])
def test_motors_that_were_said_to_be_off_turn_no_more(claim: Claim) -> None:
    """What is said of a lock says nothing of later motors."""
    hangs = HANGING._replace(below_m=0.1)
    truth = LOCKED if claim == "locked" else hangs if claim.startswith("h") else FLOOR
    script = Script((truth, 1.0)).claim(claim)
    assert script.show(truth, 3.0).flags == set()
    flags = set() if claim == "locked" else {"lied"}
    assert script.show(truth, 0.05, motors_on=True).flags == flags


@pytest.mark.parametrize("truth", [HANGING, FLOOR])
@pytest.mark.parametrize(
    ("at_rest_s", "changes", "flags"),
    [
        (5.0, {}, set()),
        (6.5, {}, {"lied"}),
        (6.5, {"telemetry_ok": False}, set()),
        (6.5, {"motors_on": True}, set()),
    ],
)
def test_a_landing_that_was_to_be_seen_is_not_unconfirmed(
    truth: Sample, at_rest_s: float, changes: dict[str, Any], flags: set[str]
) -> None:
    script = Script((truth._replace(**changes), at_rest_s)).claim("not seen down")
    assert script.show(truth, 0.6, **changes).flags == flags


# --- the end, the order to cut, the lock ----------------------------------------------------------


@pytest.mark.parametrize(
    ("truth", "flags"),
    [
        (HOVER, {"flies_on"}), (HANGING, set()), (HANGING_ON, {"flies_on"}), (FLOOR, set()),
        (FLOOR_ON, set()),
    ],
)  # fmt: skip
def test_what_flies_on_after_the_end(truth: Sample, flags: set[str]) -> None:
    script = Script((truth, 1.0)).end()
    assert script.show(truth, 4.9).flags == set()
    assert script.show(truth, 0.3).flags == flags


def every(period_s: float, for_s: float) -> list[float]:
    return [period_s * k for k in range(int(for_s / period_s) + 1)]


@pytest.mark.parametrize(
    ("presses_s", "second_s"),
    [
        ([], None),
        ([3.0], None),
        ([3.0, 3.2], None),
        ([3.0, 3.4], 3.63),
        ([3.0, 4.2], 4.2),
        ([3.0, 3.2, 3.4], 3.4),
        ([3.0, 3.5, *(3.53 + 0.03 * k for k in range(14))], None),
        ([3.0, 3.5, *(3.53 + 0.03 * k for k in range(20))], 4.01),
        (every(0.14, 1.9), 0.28),
        (every(0.33, 1.9), 0.56),
    ],
)
def test_when_presses_order_a_stop(presses_s: list[float], second_s: float | None) -> None:
    found_s = emergency_stop_s(presses_s)
    assert found_s == (None if second_s is None else pytest.approx(second_s))


@pytest.mark.parametrize(
    ("after_s", "silent_s", "flags"),
    [
        (0.4, 0.0, set()), (0.6, 0.0, {"stop_not_obeyed"}), (1.4, 1.0, set()),
        (1.6, 1.0, {"stop_not_obeyed"}),
    ],
)  # fmt: skip
def test_the_second_ctrl_c_stops_the_motors_within_half_a_second(
    after_s: float, silent_s: float, flags: set[str]
) -> None:
    """What is not heard, since no packet passes for `silent_s`, is not disobeyed."""
    script = Script((LOW, 1.0)).press().show(LOW, 1.0).press()
    if silent_s:
        script.show(LOW, silent_s, uplink=False)
    script.show(LOW, after_s - silent_s)
    assert script.show(LOW, 1.0, motors_on=False).flags == flags
    assert script.show(LOW, 0.1).flags == {"stop_not_obeyed"}, "they stay off"


def test_one_ctrl_c_asks_for_no_stop_and_nobody_obeys_after_the_end() -> None:
    script = Script((HOVER, 1.0)).press().show(HOVER, 5.0)
    assert script.flags == set()
    assert script.oracle.stop_s is None
    ended = Script((FLOOR_ON, 1.0)).end().press().show(FLOOR_ON, 1.0).press()
    assert ended.show(FLOOR_ON, 1.0).flags == set()


@pytest.mark.parametrize("changes", [{"supervisor_ended": True}, {"body_up_z": 0.3}])
def test_a_lock_has_its_reason_in_a_crash_before_it(changes: dict[str, Any]) -> None:
    """What tumbles after the lock was locked without reason."""
    locked = FLOOR._replace(locked=True)
    assert Script((FLOOR._replace(**changes), 0.1), (locked, 1.0)).flags == set()
    late = Script((locked, 0.5), (locked._replace(**changes), 1.0))
    assert late.flags == {"locked_needlessly"}
