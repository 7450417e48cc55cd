"""The parent of a fleet with scripted children: who gets permission when, and how stop arrives."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from perchctl.corridor import Point
from perchctl.errors import InvalidValue
from perchctl.fleet import make_plan
from perchctl.fleet.coordinator import HUNG_S, LOOP_HUNG_S, START_HUNG_S, Coordinator
from perchctl.fleet.messages import BEAT_S, Order, Result, Stage, Status, VehicleOutcome
from perchctl.flight import OperatorSwitch
from perchctl.mission import OperatorRequest, Phase
from perchctl.mission.phases.align import MAX_WAIT_FOR_CLIMB_PERMISSION_S
from perchctl.profile import load_profile
from tests.fleet.rig import fleet

FAR: tuple[tuple[Point, Point], ...] = tuple(((4.0 * n, 0.0), (4.0 * n, 0.5)) for n in range(4))
PERCHED = Result(exit_code=0, outcome=VehicleOutcome.PERCHED, reason="hangs", has_flown=True)
ABORTED = Result(
    exit_code=52, outcome=VehicleOutcome.ABORTED, reason="the link was lost", has_flown=True
)


@dataclass
class FakeChild:
    """A vehicle's process that does what the test says, and keeps the orders it was sent."""

    rig: Rig
    orders: list[Order] = field(default_factory=list)
    status: Status | None = None
    heard_s: float = 0.0
    ended: Result | None = None
    garbled: str | None = None
    gone: str | None = None
    hangs: bool = False
    killed: bool = False

    def send(self, order: Order) -> None:
        if not self.hangs:
            self.orders.append(order)

    def newest(self) -> tuple[Status | None, float]:
        return self.status, self.heard_s

    def result(self) -> Result | None:
        return self.ended

    def fault(self) -> str | None:
        return self.garbled

    def end_of_process(self) -> str | None:
        return self.gone

    def kill(self) -> None:
        self.killed = True

    def tell(self, stage: Stage, **more: Any) -> None:
        self.status, self.heard_s = Status(stage=stage, **more), self.rig.now_s

    @property
    def order(self) -> Order:
        """The newest."""
        return self.orders[-1] if self.orders else Order()


class Rig:
    """A coordinator with its fake children, on a clock that nobody waits for."""

    def __init__(
        self,
        places: Sequence[tuple[Point, Point]] = FAR,
        order: str = "2 at a time",
        **settings: Any,
    ) -> None:
        self.now_s = 100.0
        plan = make_plan(fleet(places, order=order, **settings))
        self.children = {v.name: FakeChild(self) for v in plan.fleet.vehicles}
        self.switch = OperatorSwitch(clock=lambda: self.now_s)
        self.fleet = Coordinator(plan, self.children, self.switch, clock=lambda: self.now_s)

    def __getitem__(self, name: str) -> FakeChild:
        return self.children[name]

    def pass_s(self, seconds: float = BEAT_S) -> None:
        """Let time pass, in which each child that does not hang says the same again."""
        end_s = self.now_s + seconds
        while self.now_s < end_s - 1e-9:
            self.now_s += BEAT_S
            for child in self.children.values():
                if not child.hangs and child.status is not None and child.ended is None:
                    child.heard_s = self.now_s
            self.fleet.step()

    def ready(self, *names: str) -> None:
        for name in names or self.children:
            self[name].tell(Stage.READY)
        self.pass_s()

    def fly(self, *names: str) -> None:
        for name in names:
            self[name].tell(Stage.FLYING, phase=Phase.ALIGN)
        self.pass_s()

    def end(self, name: str, result: Result = PERCHED) -> None:
        self[name].ended = result
        self.pass_s()

    def started(self) -> Rig:
        self.fleet.confirm()
        self.ready()
        return self

    @property
    def permitted(self) -> list[str]:
        return [name for name, child in self.children.items() if child.order.may_take_off]

    @property
    def words(self) -> list[OperatorRequest]:
        return [child.order.word for child in self.children.values()]


# --- Permission ---


def test_nothing_may_take_off_before_all_are_ready_and_the_operator_has_confirmed() -> None:
    rig = Rig()
    rig.ready()
    assert rig.permitted == []
    rig["v3"].tell(Stage.CHECKING, reason="a good picture")
    rig.fleet.confirm()
    rig.pass_s(5.0)
    assert rig.permitted == []
    rig.ready("v3")
    assert rig.permitted == ["v0", "v1"]


def test_groups_fly_in_their_order_each_after_the_one_before() -> None:
    rig = Rig().started()
    rig.fly("v0", "v1")
    rig.end("v0")
    assert rig.permitted == ["v0", "v1"], "v1 still flies; an order that has ended means nothing"
    rig.end("v1")
    assert {"v2", "v3"} <= set(rig.permitted)
    rig.fly("v2", "v3")
    rig.end("v2")
    assert not rig.fleet.has_ended
    rig.end("v3")
    assert rig.fleet.has_ended
    assert rig.words == [OperatorRequest.NONE] * 4


def test_a_fleet_has_not_ended_before_each_view_has_its_result(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The display reads the views in another thread, also in the middle of a round."""
    rig = Rig(FAR[:2]).started()
    rig.fly("v0", "v1")
    rig.end("v1")
    seen: list[bool] = []

    def newest() -> tuple[Status | None, float]:
        seen.append(rig.fleet.has_ended or rig.fleet.views[0].result is not None)
        return rig["v1"].status, rig.now_s

    monkeypatch.setattr(rig["v1"], "newest", newest)
    rig.end("v0")
    assert seen == [False]
    assert rig.fleet.has_ended


def test_a_vehicle_that_is_not_ready_any_more_does_not_hold_up_those_in_the_air() -> None:
    rig = Rig().started()
    rig.fly("v0", "v1")
    rig["v2"].tell(Stage.CHECKING, reason="a good picture")
    rig.pass_s(5.0)
    assert rig.permitted == ["v0", "v1"]


def test_one_that_is_not_ready_keeps_all_on_the_floor() -> None:
    """One bad URI of four: nothing arms."""
    rig = Rig()
    rig.fleet.confirm()
    rig.ready("v0", "v1", "v2")
    rig.end(
        "v3", Result(exit_code=10, outcome=VehicleOutcome.FAILED, reason="no Crazyflie answers")
    )
    assert rig.permitted == []
    assert rig.words[:3] == [OperatorRequest.LAND] * 3
    assert not rig.fleet.started
    rig["v3"].ended = None
    rig.ready()
    assert rig.permitted == [], "a result is final"


def test_a_silent_process_is_not_ready() -> None:
    rig = Rig()
    rig["v3"].hangs = True
    rig.ready()
    rig.pass_s(2.0)
    rig.fleet.confirm()
    rig.pass_s(2.0)
    assert rig.permitted == []


# --- A vehicle that has ended where it was not meant to ---


NEAR: tuple[tuple[Point, Point], ...] = (((0.0, 0.0), (0.0, 0.5)), ((1.0, 0.0), (1.0, 0.5)))
"""Too near to fly together, but neither stands or hangs in the other's corridor."""


def test_one_that_ended_somewhere_keeps_its_neighbour_on_the_floor() -> None:
    rig = Rig(NEAR).started()
    assert rig.permitted == ["v0"]
    rig.fly("v0")
    rig.end("v0", ABORTED)
    assert rig["v1"].order == Order(may_take_off=False, word=OperatorRequest.LAND)
    assert "v0 may be in this vehicle's corridor" in rig.fleet.reasons["v1"]


def test_one_that_hangs_or_stands_at_its_home_keeps_nobody() -> None:
    at_home = Result(
        exit_code=50,
        outcome=VehicleOutcome.LANDED,
        reason="target not found",
        has_flown=True,
        place_m=(0.1, 0),
    )
    for result in (
        PERCHED,
        at_home,
        Result(exit_code=52, outcome=VehicleOutcome.FAILED, reason="battery"),
    ):
        rig = Rig(NEAR).started()
        rig.end("v0", result)
        assert rig["v1"].order == Order(may_take_off=True)


def test_one_far_away_flies_on_unless_a_failure_lands_all() -> None:
    rig = Rig(order="one-at-a-time").started()
    rig.fly("v0")
    rig.end("v0", ABORTED)
    assert rig["v1"].order == Order(may_take_off=True)
    rig = Rig(on_failure="land-all").started()
    rig.fly("v0", "v1")
    rig.end("v0", ABORTED)
    assert rig.words[1:] == [OperatorRequest.LAND] * 3
    assert rig.fleet.reasons["v1"] == "v0 has failed"


# --- Permission to climb ---


def test_a_climb_waits_longer_than_a_neighbour_of_unknown_position_can_block_it() -> None:
    """Seed 2612110109: a neighbour whose link fell silent while it landed counted as in the air for
    38 s, and the vehicle that waited for it landed after 20."""
    longest_landing_s = load_profile("sim").planner.landing.timeout_s
    assert longest_landing_s + HUNG_S < MAX_WAIT_FOR_CLIMB_PERMISSION_S


def test_a_climb_is_permitted_again_and_again_until_a_neighbour_is_near() -> None:
    rig = Rig(order="together").started()
    for name in rig.children:
        known = {"telemetry_age_s": 0.1, "loop_age_s": 0.0}
        rig[name].tell(Stage.FLYING, phase=Phase.ALIGN, place_m=(0.0, 0.5), **known)
    rig.pass_s()
    permitted = [child.order for child in rig.children.values()]
    assert all(order.may_climb for order in permitted)
    rig.pass_s()
    assert [child.order.sent_s for child in rig.children.values()] == [rig.now_s] * 4
    assert permitted[0].sent_s < rig.now_s
    strays = (3.4, 0.5)  # in its own axes
    rig["v0"].tell(Stage.FLYING, phase=Phase.LANDING, place_m=strays, **known)
    rig.pass_s()
    assert [child.order.may_climb for child in rig.children.values()] == [True, False, True, True]
    assert rig["v1"].order.why_not_climb == "v0 is too close to this vehicle's climb path"
    assert rig.words == [OperatorRequest.NONE] * 4, "it waits, but does not land"
    rig.end("v0", ABORTED)  # nobody knows whether it is down
    unknown = "the distance of v0 from this vehicle's climb path is unknown"
    assert rig["v1"].order.why_not_climb == unknown
    rig.pass_s(HUNG_S + 0.1)
    assert rig["v1"].order.may_climb


def test_with_its_coordinator_failed_nobody_climbs() -> None:
    rig = Rig(order="together").started()
    rig.fly(*rig.children)
    rig.fleet.step_stopping()
    assert not any(child.order.may_climb for child in rig.children.values())


# --- Distances ---


def test_two_that_come_too_near_land_and_the_others_fly_on() -> None:
    rig = Rig(order="together").started()
    for name, x_m in (("v0", 2.0), ("v1", -1.8), ("v2", 0.0), ("v3", 0.0)):  # from its home
        rig[name].tell(
            Stage.FLYING, phase=Phase.ALIGN, telemetry_age_s=0.1, loop_age_s=0.0, place_m=(x_m, 0.0)
        )
    rig.pass_s()
    assert rig.words == [
        OperatorRequest.LAND,
        OperatorRequest.LAND,
        OperatorRequest.NONE,
        OperatorRequest.NONE,
    ]
    rig["v0"].tell(
        Stage.FLYING, phase=Phase.LANDING, telemetry_age_s=0.1, loop_age_s=0.0, place_m=(0.0, 0.0)
    )
    rig.pass_s()
    assert rig.words[:2] == [OperatorRequest.LAND] * 2, "also once they are apart again"
    assert [str(pair) for pair in rig.fleet.near_pairs] == [
        "v0 and v1 were 0.20 m apart in the air"
    ]
    rig.end(
        "v0",
        Result(exit_code=130, outcome=VehicleOutcome.LANDED, reason="operator", has_flown=True),
    )
    result = rig.fleet.views[0].result
    assert result is not None
    assert (result.exit_code, result.reason) == (52, "0.20 m from v1 in the air: operator")


@pytest.mark.parametrize(("own", "reported"), [(130, 52), (50, 52), (1, 52), (53, 53), (0, 0)])
def test_a_vehicle_that_came_too_near_reports_at_least_a_safety_abort(
    own: int, reported: int
) -> None:
    """Unless it hangs in spite of the order to land."""
    rig = Rig(order="together").started()
    for name, x_m in (("v0", 2.0), ("v1", -1.8)):
        rig[name].tell(Stage.FLYING, telemetry_age_s=0.1, loop_age_s=0.0, place_m=(x_m, 0.0))
    rig.pass_s()
    rig.end("v0", replace(ABORTED, exit_code=own))
    result = rig.fleet.views[0].result
    assert result is not None
    assert result.exit_code == reported


def test_a_position_that_grows_old_lands_nobody_and_is_named() -> None:
    rig = Rig(order="together").started()
    for name in ("v0", "v1"):
        rig[name].tell(
            Stage.FLYING, phase=Phase.ALIGN, telemetry_age_s=0.1, loop_age_s=0.0, place_m=(0.0, 0.0)
        )
    rig.pass_s()
    assert rig.fleet.unwatched == ()
    rig["v0"].hangs = True
    rig.pass_s(0.6)
    assert rig.fleet.unwatched == ("v0",)
    assert rig.words == [OperatorRequest.NONE] * 4


# --- Stop ---


def test_ctrl_c_lands_all_and_again_cuts_all() -> None:
    rig = Rig().started()
    rig.fly("v0", "v1")
    rig.switch.press()
    rig.fleet.step()
    assert rig.words == [OperatorRequest.LAND] * 4, "at once, not at the next beat"
    assert not rig.permitted
    rig.pass_s(1.5)
    rig.switch.press()
    rig.fleet.step()
    assert rig.words == [OperatorRequest.CUT_MOTORS] * 4


def test_a_stop_in_the_round_of_the_start_keeps_the_fleet_on_the_floor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A fleet that has never taken off must not be reported as one that has."""
    rig = Rig()
    rig.fleet.confirm()
    words = [OperatorRequest.NONE, OperatorRequest.LAND]
    monkeypatch.setattr(rig.switch, "read", lambda: words.pop(0) if len(words) > 1 else words[0])
    for child in rig.children.values():
        child.tell(Stage.READY)
    rig.fleet.step()
    assert rig.fleet.started == (rig.permitted != [])
    rig.fleet.step()
    assert rig.words == [OperatorRequest.LAND] * 4


class Rounds(threading.Event):
    """Lets `Coordinator.run` do so many rounds of `BEAT_S`, without waiting for any."""

    def __init__(self, rig: Rig, count: int) -> None:
        super().__init__()
        self._rig, self._left = rig, count

    def wait(self, timeout: float | None = None) -> bool:
        self._rig.now_s += BEAT_S
        self._left -= 1
        return self._left < 0


@pytest.fixture
def failed(monkeypatch: pytest.MonkeyPatch) -> Rig:
    """Two fly, and a round has raised over the status of the first."""
    rig = Rig().started()
    rig.fly("v0", "v1")

    def newest() -> tuple[Status | None, float]:
        raise RuntimeError("a status that nobody foresaw")

    monkeypatch.setattr(rig["v0"], "newest", newest)
    rig.fleet.run(Rounds(rig, 1))
    return rig


def test_a_round_that_raises_lands_all(failed: Rig) -> None:
    assert "RuntimeError: a status that nobody foresaw" in (failed.fleet.failure or "")
    assert failed.words == [OperatorRequest.LAND] * 4
    assert failed.permitted == []


def test_after_a_failure_the_operator_still_cuts_all_and_orders_are_repeated(failed: Rig) -> None:
    before = len(failed["v1"].orders)
    failed.fleet.run(Rounds(failed, 5))
    assert failed.words == [OperatorRequest.LAND] * 4
    assert len(failed["v1"].orders) - before == 5, "signs of life"
    failed.switch.cut()
    failed.fleet.run(Rounds(failed, 1))
    assert failed.words == [OperatorRequest.CUT_MOTORS] * 4
    assert failed.fleet.failure is not None


def test_after_a_failure_nothing_takes_off_and_results_are_still_collected(failed: Rig) -> None:
    failed["v1"].ended = PERCHED
    failed.fleet.confirm()
    failed.fleet.run(Rounds(failed, 2))
    assert failed.permitted == []
    views = {view.name: view for view in failed.fleet.views}
    assert views["v1"].result == PERCHED
    assert views["v0"].result is None
    assert views["v0"].silent_s > 0.0
    assert not failed.fleet.has_ended


def test_one_that_cannot_be_ordered_keeps_no_other_from_its_order(
    failed: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    def send(order: Order) -> None:
        raise RuntimeError("no way")

    monkeypatch.setattr(failed["v0"], "send", send)
    failed.switch.cut()
    failed.fleet.run(Rounds(failed, 1))
    assert failed.words[1:] == [OperatorRequest.CUT_MOTORS] * 3


@pytest.mark.parametrize(
    ("code", "word"), [(130, OperatorRequest.NONE), (52, OperatorRequest.LAND)]
)
def test_a_vehicle_landed_by_key_has_not_failed_unless_it_has(
    code: int, word: OperatorRequest
) -> None:
    """The others continue also with ``on_failure: land-all``."""
    rig = Rig(on_failure="land-all").started()
    rig.fly("v0", "v1")
    rig.fleet.land("v0")
    rig.end("v0", replace(ABORTED, outcome=VehicleOutcome.LANDED, exit_code=code))
    assert rig.words[1:] == [word] * 3


def test_one_that_sends_nonsense_lands_and_says_why() -> None:
    rig = Rig().started()
    rig.fly("v0", "v1")
    rig["v0"].garbled = "its process sent str instead of its status"
    rig.pass_s()
    rig["v0"].garbled = None
    rig.pass_s()
    assert rig.words == [OperatorRequest.LAND, *[OperatorRequest.NONE] * 3], "for good"
    rig.end("v0", replace(ABORTED, outcome=VehicleOutcome.LANDED, exit_code=130))
    result = rig.fleet.views[0].result
    assert result is not None
    assert result.reason.startswith("its process sent str instead of its status: ")
    assert result.exit_code == 52, "no operator has landed it"


def test_a_key_lands_one_and_the_next_group_still_flies() -> None:
    rig = Rig().started()
    rig.fly("v0", "v1")
    rig.fleet.land("v0")
    rig.fleet.step()
    assert rig.words == [OperatorRequest.LAND, *[OperatorRequest.NONE] * 3]
    rig.end(
        "v0",
        Result(exit_code=130, outcome=VehicleOutcome.LANDED, reason="operator", has_flown=True),
    )
    rig.end("v1")
    assert {"v2", "v3"} <= set(rig.permitted)


def test_a_name_that_the_fleet_lacks_is_refused() -> None:
    rig = Rig().started()
    with pytest.raises(InvalidValue, match=r"no vehicle 'v9'; it has v0, v1, v2, v3"):
        rig.fleet.land("v9")


def test_one_that_hangs_holds_up_nobody_and_is_ended() -> None:
    rig = Rig().started()
    rig.fly("v0", "v1")
    rig["v0"].hangs = True
    rig.switch.press()
    rig.pass_s()
    assert rig["v1"].order.word is OperatorRequest.LAND
    rig.pass_s(HUNG_S + 1.0)
    assert rig["v0"].killed
    result = rig.fleet.views[0].result
    assert result is not None
    assert (result.exit_code, result.has_flown, result.hangs) == (52, True, False)
    assert "check where the vehicle is" in result.reason


def test_one_that_still_starts_is_given_the_time_that_a_busy_computer_takes() -> None:
    rig = Rig()
    rig.pass_s(START_HUNG_S - 1.0)
    assert not rig["v0"].killed
    rig.pass_s(2.0)
    assert rig["v0"].killed
    result = rig.fleet.views[0].result
    assert result is not None
    assert not result.has_flown


def test_a_loop_that_hangs_for_longer_than_any_landing_is_ended() -> None:
    rig = Rig().started()
    rig["v0"].tell(Stage.FLYING, phase=Phase.ALIGN, loop_age_s=LOOP_HUNG_S - 1.0)
    rig.pass_s()
    assert not rig["v0"].killed
    rig["v0"].tell(Stage.FLYING, phase=Phase.ALIGN, loop_age_s=LOOP_HUNG_S + 1.0)
    rig.pass_s()
    assert rig["v0"].killed


def test_a_process_that_was_killed_in_the_air_counts_as_somewhere() -> None:
    rig = Rig(NEAR).started()
    rig["v0"].tell(Stage.FLYING, phase=Phase.ALIGN, log="logs/flight.jsonl")
    rig.pass_s()
    rig["v0"].gone = "its process has ended unexpectedly (signal 9)"
    rig.pass_s()
    assert rig["v1"].order.word is OperatorRequest.LAND
    result = rig.fleet.views[0].result
    assert result is not None
    assert (result.has_flown, result.log) == (True, "logs/flight.jsonl")


def test_a_process_that_was_lost_after_its_permission_may_have_flown() -> None:
    """Its last message is older than its permission, so nobody knows whether it took off."""
    rig = Rig(NEAR).started()
    assert rig["v0"].order.may_take_off
    rig["v0"].gone = "its process has ended unexpectedly (signal 9)"
    rig.pass_s()
    result = rig.fleet.views[0].result
    assert result is not None
    assert (result.exit_code, result.has_flown) == (52, True)
    assert "check where the vehicle is" in result.reason
    assert rig["v1"].order == Order(may_take_off=False, word=OperatorRequest.LAND)


def test_a_process_that_was_lost_without_permission_has_not_flown() -> None:
    rig = Rig(NEAR).started()
    rig["v1"].gone = "its process has ended unexpectedly (signal 9)"
    rig.pass_s()
    result = rig.fleet.views[1].result
    assert result is not None
    assert (result.exit_code, result.has_flown) == (1, False)


def test_orders_are_repeated_as_signs_of_life() -> None:
    rig = Rig().started()
    before = len(rig["v0"].orders)
    rig.pass_s(1.0)
    assert len(rig["v0"].orders) - before == 10
