"""The motors' test finds what is wrong and begins only on the ground; a lift shows in the position.

In lockstep with a simulated vehicle.
"""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.check import CheckScope, Row, Verdict, session, vehicle
from perchctl.check.row import Finding
from perchctl.check.vehicle import Vehicle
from perchctl.sim import Scenario, SimulatedVehicle
from perchctl.vehicle import FLYING, LOCKED, Telemetry
from tests.helpers.checks import AT_REST, NOWHERE, PROFILE, said
from tests.helpers.mission import READY


class Lockstep:
    """A `ProbeLink`'s questions put to a simulated vehicle, whose time passes by `wait`."""

    def __init__(self, **scenario: Any) -> None:
        self.vehicle = SimulatedVehicle(Scenario(**scenario))
        self.wait(1.5)
        self.heard_s = self.vehicle.t_s

    def wait(self, seconds: float) -> None:
        self.vehicle.advance_to(self.vehicle.t_s + seconds)
        self.heard_s = self.vehicle.t_s

    def newest(self) -> Telemetry:
        log = self.vehicle.firmware.log_value
        return replace(
            AT_REST, t_s=self.vehicle.t_s, acc_z_g=log("acc.z"),
            position_m=(0.0, 0.0, log("stateEstimate.z")),
            roll_rad=math.radians(log("stateEstimate.roll")),
            supervisor=int(log("supervisor.info")),
        )  # fmt: skip

    def telemetry(self) -> list[Telemetry]:
        return [self.newest()]

    def age_s(self) -> float:
        return self.vehicle.t_s - self.heard_s

    def lost(self) -> str | None:
        return None

    def parameters(self) -> dict[str, float]:
        return {"health.propTestThreshold": 0.0}

    def has_variable(self, name: str) -> bool:
        return True

    def variables(self, names: Any) -> dict[str, float]:
        return {name: self.vehicle.firmware.log_value(name) for name in names}

    def start_health_test(self, test: str) -> None:
        self.vehicle.firmware.set_parameter(f"health.{test}", 1)


def motors(rig: Lockstep) -> dict[str, Row]:
    rows = vehicle.motor_rows(rig, PROFILE, rig.wait)  # type: ignore[arg-type]
    assert [row.name for row in rows] == list(vehicle.MOTORS)
    return {row.name: row for row in rows}


@pytest.mark.parametrize(("scenario", "name", "verdict", "words"), [
    ({}, "propellers", "pass", "M4 "),
    ({}, "battery sag", "pass", "0.09 V"),
    ({"motor_strength": (1, 0, 1, 1)}, "propellers", "fail", "M2 (back right) stands still"),
    ({"propeller_shake_g": (0.05, 0.05, 0.3, 0.05)}, "propellers", "fail",
     "M3 (back left) is out of balance"),
    ({"propeller_shake_g": (0.2, 0.2, 0.2, 0.05)}, "propellers", "warn", "hardly shakes"),
    ({"cell_resistance_ohm": 2.5}, "battery sag", "fail", "under a short load"),
    ({"cell_resistance_ohm": 1.0}, "battery sag", "warn", "under a short load"),
])  # fmt: skip
def test_the_motor_test_finds_what_is_wrong(
    scenario: dict[str, Any], name: str, verdict: str, words: str
) -> None:
    row = motors(Lockstep(**scenario))[name]
    assert row.verdict == verdict
    assert words in row.found


def test_the_firmware_s_own_threshold_counts() -> None:
    even = (1.0, 1.0, 1.0, 1.0)
    assert vehicle.propellers_finding(even, {2}).verdict is Verdict.FAIL
    assert vehicle.propellers_finding(even, set()).verdict is Verdict.PASS


@pytest.mark.parametrize(("change", "age_s", "words"), [
    ({}, 5.0, "nothing fresh"),
    ({"supervisor": READY | FLYING}, 0.0, "flying"),
    ({"supervisor": READY | LOCKED}, 0.0, "locked"),
    ({"position_m": (0.0, 0.0, 2.1)}, 0.0, "2.10 m"),
    ({"roll_rad": 0.4}, 0.0, "tilted"),
    ({"acc_z_g": 0.6}, 0.0, "0.60 g"),
    ({"position_variance_m2": 1.0}, 0.0, "variance"),
])  # fmt: skip
def test_no_motor_turns_but_on_the_ground(change: dict[str, Any], age_s: float, words: str) -> None:
    assert words in vehicle.hindrance(said(**change), age_s, PROFILE)
    assert vehicle.hindrance(AT_REST, 0.0, PROFILE) == ""
    assert vehicle.hindrance(None, 0.0, PROFILE)


def test_a_vehicle_that_is_picked_up_between_the_tests_is_left_alone() -> None:
    rig = Lockstep()
    rows = []
    start = rig.start_health_test

    def picked_up(test: str) -> None:
        start(test)
        rig.wait(5.0)
        rig.vehicle.world.set_pose((0.0, 0.0, 0.5), hold=True)

    rig.start_health_test = picked_up  # type: ignore[method-assign]
    rows = vehicle.motor_rows(rig, PROFILE, rig.wait)  # type: ignore[arg-type]
    assert rows[1].verdict is Verdict.SKIPPED
    assert "not begun" in rows[1].found
    assert rig.vehicle.firmware.log_value("health.batterySag") == 0.0


def unheard(rig: Lockstep, asked: set[str], lost: set[str]) -> None:
    """The answer to the first question for just `asked` comes without these."""
    ask, open_still = rig.variables, [True]

    def answer(names: Any) -> dict[str, float]:
        found = ask(names)
        if set(names) != asked or not open_still:
            return found
        open_still.clear()
        return {name: value for name, value in found.items() if name not in lost}

    rig.variables = answer  # type: ignore[method-assign]


def test_a_sag_that_came_once_is_judged_though_the_next_answer_is_lost() -> None:
    """Nothing but the first answer and the one that differs from it is needed."""
    rig = Lockstep(cell_resistance_ohm=2.5)
    changed: list[float] = []
    ask = rig.variables

    def once(names: Any) -> dict[str, float]:
        if list(names) != [vehicle.SAG]:
            return ask(names)
        if changed:
            return {}
        found = ask(names)
        changed.extend(v for v in found.values() if v)
        return found

    rig.variables = once  # type: ignore[method-assign]
    row = motors(rig)["battery sag"]
    assert row.verdict is Verdict.FAIL
    assert row.found.startswith(f"{changed[0]:.2f} V")


@pytest.mark.parametrize("without", [set(vehicle.VARIANCES[6:]), {vehicle.PASS}])
def test_a_result_that_comes_in_part_is_no_broken_motor(without: set[str]) -> None:
    rig = Lockstep()
    rig.parameters = lambda: {vehicle.THRESHOLD: 9.0}  # type: ignore[method-assign]
    unheard(rig, {*vehicle.VARIANCES, vehicle.PASS}, without)
    row = motors(rig)["propellers"]
    assert row.verdict is Verdict.WARN
    assert "did not come whole" in row.found


@pytest.mark.parametrize(("name", "asked"), [
    ("propellers", vehicle.COUNT), ("battery sag", vehicle.SAG),
])  # fmt: skip
def test_a_first_question_without_an_answer_is_not_a_firmware_without_the_test(
    name: str, asked: str
) -> None:
    rig = Lockstep()
    unheard(rig, {asked}, {asked})
    row = motors(rig)[name]
    assert row.verdict is Verdict.SKIPPED
    assert "no answer" in row.found
    lacking = Lockstep()
    lacking.has_variable = lambda n: n != asked  # type: ignore[method-assign]
    assert "no such test" in motors(lacking)[name].found


def test_an_earlier_test_s_result_is_not_taken_for_this_one_s() -> None:
    """Though the count that tells them apart be lost once."""
    rig = Lockstep()
    motors(rig)
    unheard(rig, {vehicle.PASS, vehicle.COUNT}, {vehicle.COUNT})
    rig.start_health_test = lambda test: None  # type: ignore[method-assign]
    assert motors(rig)["propellers"].found == vehicle.NO_RESULT


def test_a_result_counts_only_once_the_test_has_finished() -> None:
    rig = Lockstep()
    read = rig.variables
    rig.variables = lambda names: read(names) | {vehicle.PASS: 0.0}  # type: ignore[method-assign]
    assert motors(rig)["propellers"].found == vehicle.NO_RESULT


def test_after_a_test_without_a_result_no_other_begins() -> None:
    """At rest and fresh as its reports may be: while it is pending, they are frozen."""
    rig = Lockstep()
    begun: list[str] = []
    rig.start_health_test = begun.append  # type: ignore[method-assign]  # on its way for ever
    rows = motors(rig)
    assert begun == ["startPropTest"]
    assert rows["propellers"].verdict is Verdict.WARN
    assert "keep clear" in rows["propellers"].advice
    assert rows["battery sag"].found.startswith("not begun: the test before")
    assert vehicle.hindrance(rig.newest(), rig.age_s(), PROFILE) == ""


def dying(rig: Lockstep, told: bool) -> None:
    """Answers nothing more; `told`: the link is lost, else it stays and is silent."""
    rig.variables = lambda names: {}  # type: ignore[method-assign]
    rig.lost = lambda: "switched off" if told else None  # type: ignore[method-assign]
    rig.age_s = lambda: 1.6  # type: ignore[method-assign]


def by_hand(rig: Lockstep, moment: str, told: bool, patch: pytest.MonkeyPatch) -> dict[str, Row]:
    """The vehicle's rows, with a lift and a yes to the motors; it dies at that moment."""

    begin = rig.start_health_test

    def at(this: str) -> None:
        if this == moment:
            dying(rig, told)

    def start(test: str) -> None:
        begin(test)
        at(test)

    def yes() -> bool:
        at("question")
        return True

    rig.start_health_test = start  # type: ignore[method-assign]
    patch.setattr(vehicle, "look", lambda *_: Vehicle(NOWHERE, telemetry=AT_REST))
    patch.setattr(session, "time", SimpleNamespace(sleep=rig.wait))
    wanted = CheckScope(yes, lift=True, lift_s=0.5, tell=at)
    it = session.VehicleSession(rig, NOWHERE, PROFILE, None, wanted)  # type: ignore[arg-type]
    return {row.name: row for row in it.answering_rows()}


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize(("moment", "propellers"), [
    (f"now, within 0.5 s: {vehicle.HOW_TO_LIFT}", "not begun"),
    ("question", "not begun"),
    ("startPropTest", vehicle.NO_RESULT),
    ("startBatTest", "shake"),
])  # fmt: skip
def test_a_vehicle_that_dies_by_the_hand_or_the_motors_fails_a_row(
    moment: str, propellers: str, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = by_hand(Lockstep(), moment, told, monkeypatch)
    assert rows[vehicle.GONE].verdict is Verdict.FAIL
    assert ("switched off" if told else "no telemetry came for 1.6 s") in rows[vehicle.GONE].found
    assert rows["propellers"].found.startswith(propellers)


def test_a_vehicle_that_lives_has_no_row_of_its_death(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = by_hand(Lockstep(), "never", True, monkeypatch)
    assert rows["battery sag"].verdict is Verdict.PASS
    assert vehicle.GONE not in rows


def test_a_vehicle_that_dies_in_the_motor_test_is_not_waited_for() -> None:
    rig = Lockstep()
    rig.start_health_test = lambda test: dying(rig, False)  # type: ignore[method-assign]
    start_s = rig.vehicle.t_s
    assert motors(rig)["propellers"].verdict is Verdict.WARN
    assert rig.vehicle.t_s - start_s < 1.0


def a_hand(rig: Lockstep, to_m: float, moves_g: float = 0.0) -> Finding:
    """Lifts it after a second, and puts it back."""
    before = rig.wait
    at = [0.0]

    def wait(seconds: float) -> None:
        at[0] += seconds
        z_m = 0.012 + (to_m if 1.0 < at[0] < 2.0 else 0.0)
        rig.vehicle.world.set_pose((0.0, 0.0, z_m), hold=True)
        before(seconds)

    seen = vehicle.watch_lift(rig, wait, 3.0)  # type: ignore[arg-type]
    seen[len(seen) // 2] = replace(seen[len(seen) // 2], acc_z_g=1.0 + moves_g)
    return vehicle.lift_finding(seen)


def test_a_lift_by_hand_shows_in_the_position() -> None:
    assert a_hand(Lockstep(), 0.4, 0.2).verdict is Verdict.PASS


def test_a_vehicle_that_was_not_lifted_is_not_known() -> None:
    row = a_hand(Lockstep(), 0.0)
    assert row.verdict is Verdict.SKIPPED
    assert "not moved" in row.found


def test_a_position_that_stays_where_it_is_fails() -> None:
    assert a_hand(Lockstep(), 0.0, 0.3).verdict is Verdict.FAIL


def test_a_position_that_does_not_come_back_is_told() -> None:
    heights_m = (0.0, 0.4, 0.25)
    seen = [said(position_m=(0.0, 0.0, z_m), acc_z_g=1.0 + z_m) for z_m in heights_m]
    assert vehicle.lift_finding(seen).verdict is Verdict.WARN
    assert vehicle.lift_finding([]).verdict is Verdict.SKIPPED
