"""Positions from outside before take-off and in the loop: waited for, compared, refused by name."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.flight import unmeasured_problem, world_problem
from perchctl.flight.criteria import AtRest, apart, with_another_up
from perchctl.flight.preflight import refuse_strange
from perchctl.geometry import quaternion_from_rotation, rotation_from_rpy
from perchctl.mission import Operator, Outcome
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.vehicle import ExternalPosition, MeasuredBy, PositionSetpoint
from tests.helpers.capture import TURNS, named_up
from tests.helpers.loop_rig import PROFILE, Rig, Vehicle
from tests.helpers.mission import MOCAP, READY, changed, telemetry

WITH_OWN_DECK = Profile.model_validate({"positioning": {"decks": ["labUwb"]}})
LEVEL = (1.0, 0.0, 0.0, 0.0)
REST = telemetry(1.0, 0.02, thrust=0.0, supervisor=READY)
HIDDEN = "motion capture vicon:lab does not see the rigid body 'cf2'"


def at(x: float, y: float, z: float, q: tuple[float, float, float, float] = LEVEL) -> Any:
    return ExternalPosition((x, y, z), q)


# --- Of a vehicle at rest ------------------------------------------------------------------


@pytest.mark.parametrize(("place", "words"), [
    (at(0.3, -0.2, 0.012), None),
    (at(300.0, -200.0, 12.0), "x 300, y -200, z 12 m: these look like millimetres"),
    (at(0.0, 0.0, 12.0), "millimetres"),
    (at(-1200.0, 0.0, 0.04), "millimetres"),
    (at(0.3, 0.02, 0.4), "at 0.40 m, and the ground is at 0.00 m: swapped axes .is its y up"),
    (at(0.3, 0.4, 2.1), "swapped axes, another rigid body or zero"),
])  # fmt: skip
def test_a_place_that_is_none_is_named(place: ExternalPosition, words: str | None) -> None:
    problem = world_problem(place, REST, MOCAP)
    if words is None:
        assert problem is None
        return
    assert problem is not None
    assert re.search(words, problem.sentence)
    assert problem.advice


def test_a_body_that_stands_out_of_the_target_s_reach_is_another_vehicle_s() -> None:
    """Two vehicles in one room: the other one stands level, on the ground, two metres aside."""
    own = {"target.expected_xy_m": (0.3, 0.0), "target.expected_within_m": 0.3}
    profile = changed(own, MOCAP)
    assert world_problem(at(0.2, -0.5, 0.012), REST, profile) is None
    assert world_problem(at(3.0, -0.5, 0.012), REST, MOCAP) is None, (
        "nobody has said where it hangs"
    )
    problem = world_problem(at(3.0, -0.5, 0.012), REST, profile)
    assert problem is not None
    assert "2.7 m from where its target is expected" in problem.found
    assert "another vehicle's" in problem.advice


def test_a_body_that_goes_about_while_the_vehicle_stands_is_another_s() -> None:
    def told(places: list[Any]) -> list[bool]:
        at_rest = AtRest()
        return [at_rest.strange(place, MOCAP) is not None for place in places]

    walks = [at(0.02 * k, 0.0, 0.012) for k in range(8)]
    assert told(walks) == [False] * 6 + [True] * 2
    assert not any(told([at(0.004 * (k % 2), 0.0, 0.012) for k in range(100)])), "noise"
    # What was carried there, or is not known for a while, begins anew.
    assert not any(told([*walks[:4], None, *walks[4:]]))


@given(st.sampled_from(TURNS), st.floats(-3.1, 3.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_another_axis_up_is_named_by_the_attitude(
    turn: Any, yaw: float, roll: float, pitch: float
) -> None:
    """As long as the body's own axes are the vehicle's, in whatever heading it stands."""
    own = rotation_from_rpy(roll, pitch, yaw)
    tel = replace(REST, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
    problem = with_another_up(at(0.0, 0.0, 0.0, quaternion_from_rotation(turn @ own)), tel)
    up = named_up(turn)
    assert (problem is None) is (up == "z")
    if problem is not None:
        assert f"up is {up} in the motion capture" in problem.found


@given(st.sampled_from(TURNS), st.floats(0.6, 2.5))
def test_a_body_defined_in_another_world_shows_once_it_is_turned(turn: Any, yaw: float) -> None:
    """Level where it was defined, it says nothing; that is what `check --lift` is for."""
    for heading, told in ((0.0, False), (yaw, named_up(turn) not in ("z", "-z"))):
        tel = replace(REST, yaw_rad=heading)
        own = turn @ rotation_from_rpy(0.0, 0.0, heading) @ turn.T
        problem = with_another_up(at(0.0, 0.0, 0.0, quaternion_from_rotation(own)), tel)
        assert (problem is not None) is told


@pytest.mark.parametrize(("place", "agrees"), [
    (at(0.05, 0.0, 0.05), True), (at(0.2, 0.0, 0.02), False), (at(0.0, 0.0, math.nan), False),
    (at(0.0, 0.0, 0.02, quaternion_from_rotation(rotation_from_rpy(0.0, 0.0, 0.2))), True),
    (at(0.0, 0.0, 0.02, quaternion_from_rotation(rotation_from_rpy(0.0, 0.0, 0.4))), False),
])  # fmt: skip
def test_the_estimate_has_to_agree(place: ExternalPosition, agrees: bool) -> None:
    assert (apart(place, REST) is None) is agrees


@pytest.mark.parametrize(("by", "profile", "words"), [
    (MeasuredBy(("bcFlow2",)), PROFILE, None),
    (MeasuredBy(("labUwb",), False), WITH_OWN_DECK, None),
    (MeasuredBy(("bcLedRing",), False), WITH_OWN_DECK, "if bcLedRing measures it, name"),
    (MeasuredBy(("bcLedRing", "bcLighthouse4")), PROFILE, None),
    (MeasuredBy(("bcLoco",), False), PROFILE, None),
    (MeasuredBy((), True), PROFILE, None),
    (MeasuredBy(), MOCAP, None),
    (MeasuredBy(("bcLedRing", "bcZRanger2"), False), PROFILE, "no position comes from outside"),
    (MeasuredBy(), PROFILE, "not told"),
])  # fmt: skip
def test_something_tells_the_vehicle_where_it_is(
    by: MeasuredBy, profile: Profile, words: str | None
) -> None:
    problem = unmeasured_problem(by, profile)
    assert (problem is None) is (words is None)
    assert problem is None or (words is not None and words in problem.sentence)


# --- The loop -------------------------------------------------------------------------------


class Outside:
    """The positions of a capture that sees the scripted vehicle, but for `hidden`."""

    def __init__(
        self,
        link: Vehicle,
        hidden: Callable[[float], bool] = lambda t_s: False,
        place: Callable[[ExternalPosition], ExternalPosition] = lambda place: place,
    ) -> None:
        self._link, self._hidden, self._place = link, hidden, place
        self._sent_s, self._newest = -math.inf, None

    def stop(self) -> None:
        self._hidden = lambda t_s: True

    def status(self, now_s: float) -> FeedStatus:
        hidden = self._hidden(now_s)
        if not hidden:
            self._sent_s = now_s - 0.01
            self._newest = self._place(at(0.0, 0.0, self._link.z_m))
        return FeedStatus(
            now_s - self._sent_s, HIDDEN if hidden else None, 7, self._newest, 99.0, self._newest
        )


def rig(positions: Callable[[Vehicle], Outside | None] = Outside, **changes: Any) -> Rig:
    it = Rig(Vehicle(lambda sample: replace(sample, **changes)))
    it.profile = MOCAP
    it.positions = positions(it.link)
    return it


def test_positions_that_lead_astray_are_sent_no_more() -> None:
    """It slides by them while it rises: swapped axes, which did not show at rest."""
    it = Rig(
        Vehicle(lambda tel: replace(tel, position_m=(tel.position_m[2], 0.0, tel.position_m[2])))
    )
    it.profile = MOCAP
    outside = it.positions = Outside(it.link)
    stopped_s: list[float] = []
    outside.stop = lambda: stopped_s.append(it.link.now_s)  # type: ignore[method-assign]
    assert "swapped axes" in it.fly().reason
    assert len(stopped_s) == 1


def test_positions_that_never_come_keep_it_on_the_ground() -> None:
    it = rig(lambda link: Outside(link, lambda t_s: True))
    it.refused(TimedOut, f"positions of the motion capture .{HIDDEN}")
    assert not it.link.said(PositionSetpoint)


def test_positions_that_come_late_are_waited_for() -> None:
    it = rig(lambda link: Outside(link, lambda t_s: t_s < 2.0))
    it.operator = lambda: Operator.LAND if it.link.said(PositionSetpoint) else Operator.NONE
    assert it.fly().outcome is Outcome.OPERATOR
    assert it.link.said(PositionSetpoint)[0] >= 2.0


@pytest.mark.parametrize(("place", "error", "words"), [
    (lambda p: at(250.0, -100.0, 12.0), SafetyAbort, "millimetres"),
    (
        lambda p: at(0.0, 0.0, 0.0, quaternion_from_rotation(rotation_from_rpy(-1.5708, 0, 0))),
        SafetyAbort, "swapped axes: up is -?y",
    ),
    (lambda p: at(1.0, 0.0, 0.0), TimedOut, "agree with the motion capture .they are 1.00 m"),
])  # fmt: skip
def test_positions_of_another_world_keep_it_on_the_ground(
    place: Any, error: type[Exception], words: str
) -> None:
    it = rig(lambda link: Outside(link, place=place))
    it.refused(error, words)
    assert not it.link.said(PositionSetpoint)


def test_nobody_to_send_positions_is_a_refusal() -> None:
    rig(lambda link: None).refused(SafetyAbort, "nothing sends positions")


def test_no_deck_and_no_position_is_a_refusal() -> None:
    it = Rig(Vehicle())
    it.link.measured_by = lambda: MeasuredBy((), False)  # type: ignore[method-assign]
    it.refused(SafetyAbort, "no positioning deck.*set positioning: mocap")


def hidden_in_flight(link: Vehicle, for_s: float) -> Outside:
    def hidden(t_s: float) -> bool:
        first = link.said(PositionSetpoint)
        return bool(first) and first[0] + 1.0 <= t_s < first[0] + 1.0 + for_s

    return Outside(link, hidden)


@pytest.mark.parametrize(("for_s", "lands"), [(0.3, False), (60.0, True)])
def test_an_occlusion_is_held_and_a_lasting_one_landed(for_s: float, lands: bool) -> None:
    it = rig(lambda link: hidden_in_flight(link, for_s))
    seen = it.watcher
    end_s = 4.0
    it.operator = lambda: Operator.LAND if it.link.now_s > end_s + 5.0 else Operator.NONE
    report = it.fly()
    held = [e for e in seen.events if e.kind.value == "hold" and HIDDEN in e.reason]
    assert len(held) == 1
    assert (report.outcome is Outcome.SAFETY) is lands
    assert (HIDDEN in report.reason) is lands
    ages = np.array([tick.outside.age_s for tick in seen.ticks if tick.outside])
    assert len(ages) == len(seen.ticks)
    assert ages.max() > 0.25


def test_an_occlusion_that_holds_nothing_is_told() -> None:
    """On the way down it is not held for it; the pilot reads it all the same, once."""
    it = Rig(Vehicle())
    it.profile = MOCAP
    landing: list[float] = []
    it.positions = Outside(it.link, lambda t_s: bool(landing) and t_s > landing[0] + 0.2)
    seen = it.watcher

    def operator() -> Operator:
        if it.link.now_s > 3.0:
            landing.append(it.link.now_s)
            return Operator.LAND
        return Operator.NONE

    it.operator = operator
    it.fly()
    notes = [e.reason for e in seen.events if e.kind.value == "note" and HIDDEN in e.reason]
    assert len(notes) == 1


# --- only what is fresh is judged -------------------------------------------------------------


def asked(at_rest: AtRest, x_m: float, tel_age_s: float, age_s: float, **changes: Any) -> None:
    place = at(x_m, 0.0, 0.012)
    status = FeedStatus(age_s, None, 9, place, 100.0, place)
    sample = replace(REST, t_s=50.0 - tel_age_s, **changes)
    refuse_strange(status, sample, MOCAP, 50.0, at_rest)


OLD_S = MOCAP.safety.proof_age_s + 0.01
LATE_S = MOCAP.positioning.hold_s + 0.01


@pytest.mark.parametrize(
    ("tel_age_s", "age_s", "refused"),
    [(0.02, 0.02, True), (OLD_S, 0.02, False), (0.02, LATE_S, False)],
)
def test_a_body_that_moves_is_judged_by_fresh_telemetry_and_a_fresh_position(
    tel_age_s: float, age_s: float, refused: bool
) -> None:
    at_rest = AtRest()
    asked(at_rest, 0.0, tel_age_s, age_s)
    with pytest.raises(SafetyAbort, match="has moved") if refused else nullcontext():
        asked(at_rest, 0.5, tel_age_s, age_s)


def test_telemetry_whose_place_is_behind_is_old() -> None:
    at_rest = AtRest()
    asked(at_rest, 0.0, 0.02, 0.02)
    asked(at_rest, 0.5, 0.02, 0.02, behind_s=OLD_S)


def test_what_is_not_known_for_a_while_forgets_nothing() -> None:
    """It moved unseen, and the vehicle was not seen to: that is another's body all the same."""
    at_rest = AtRest()
    asked(at_rest, 0.0, 0.02, 0.02)
    asked(at_rest, 0.3, OLD_S, 0.02)
    with pytest.raises(SafetyAbort, match="has moved"):
        asked(at_rest, 0.5, 0.02, 0.02)


def test_a_vehicle_that_is_carried_begins_anew() -> None:
    at_rest = AtRest()
    asked(at_rest, 0.0, 0.02, 0.02)
    asked(at_rest, 0.3, 0.02, LATE_S, acc_z_g=1.3)  # hidden in a hand
    asked(at_rest, 0.5, 0.02, 0.02)
