"""Positions from outside before take-off and in the loop: waited for, compared, refused by name."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import SafetyAbort, TimedOut
from perchctl.flight import GroundCriteria
from perchctl.flight.criteria import RestCheck, estimate_problem, up_axis_problem
from perchctl.flight.preflight import refuse_wrong_positions
from perchctl.geometry import quaternion_from_rotation, rotation_from_rpy
from perchctl.mission import OperatorRequest, Outcome
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.vehicle import ExternalPosition, PositionSetpoint
from tests.helpers.capture import TURNS, named_up
from tests.helpers.loop_rig import SOON, Rig, Vehicle
from tests.helpers.mission import MOCAP, READY, changed, telemetry

REST = telemetry(1.0, 0.02, thrust=0.0, supervisor=READY)
HIDDEN = "motion capture vicon:lab does not see the rigid body 'cf2'"


def at(x: float, y: float, z: float, R: Any = None) -> ExternalPosition:
    level = (1.0, 0.0, 0.0, 0.0)
    return ExternalPosition((x, y, z), level if R is None else quaternion_from_rotation(R))


def turned(yaw_rad: float) -> ExternalPosition:
    return at(0.0, 0.0, 0.02, rotation_from_rpy(0.0, 0.0, yaw_rad))


# --- Of a vehicle at rest ------------------------------------------------------------------

REACH = changed({"target.expected_xy_m": (0.3, 0.0), "target.expected_within_m": 0.3}, MOCAP)


@pytest.mark.parametrize(("place", "profile", "words"), [
    (at(0.3, -0.2, 0.012), MOCAP, None),
    (at(300.0, -200.0, 12.0), MOCAP, "x 300, y -200, z 12 m, which appears to be in millimetres"),
    (at(0.0, 0.0, 12.0), MOCAP, "millimetres"),
    (at(-1200.0, 0.0, 0.04), MOCAP, "millimetres"),
    (at(0.3, 0.02, 0.4), MOCAP, "at 0.40 m, but the ground .* 0.00 m: its axes"),
    (at(0.3, 0.4, 2.1), MOCAP, "its axes may be swapped"),
    (at(0.0, 0.0, 0.012, rotation_from_rpy(-1.5708, 0, 0)), MOCAP, "swapped axes: up is -?y"),
    # Two vehicles in one room: the other one stands level, on the ground, two metres aside.
    (at(0.2, -0.5, 0.012), REACH, None),
    (at(3.0, -0.5, 0.012), MOCAP, None),  # nobody has said where the target hangs
    (at(3.0, -0.5, 0.012), REACH, "target is expected 2.7 m from the vehicle.*another vehicle's"),
    (at(math.nan, -0.5, 0.012), MOCAP, "x nan"),
])  # fmt: skip
def test_a_place_that_is_none_is_named(
    place: ExternalPosition, profile: Profile, words: str | None
) -> None:
    problem = GroundCriteria(REST, profile).position_frame_problem(place)
    assert (problem is None) is (words is None)
    assert problem is None or re.search(words or "", problem.sentence)


def test_a_body_that_goes_about_while_the_vehicle_stands_is_another_s() -> None:
    def told(places: list[Any]) -> list[bool]:
        at_rest = RestCheck()
        return [at_rest.moved_body_problem(place, MOCAP) is not None for place in places]

    walks = [at(0.02 * k, 0.0, 0.012) for k in range(8)]
    assert told(walks) == [False] * 6 + [True] * 2
    assert not any(told([at(0.004 * (k % 2), 0.0, 0.012) for k in range(100)])), "noise"
    assert told([at(0.0, 0.0, 0.0), at(math.nan, 0.0, 0.0)]) == [False, True], "not a number"
    # What was carried there, or is not known for a while, begins anew.
    assert not any(told([*walks[:4], None, *walks[4:]]))


@given(st.sampled_from(TURNS), st.floats(-3.1, 3.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_another_axis_up_is_named_by_the_attitude(
    turn: Any, yaw: float, roll: float, pitch: float
) -> None:
    """As long as the body's own axes are the vehicle's, in whatever heading it stands."""
    own = rotation_from_rpy(roll, pitch, yaw)
    tel = replace(REST, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
    problem = up_axis_problem(at(0.0, 0.0, 0.0, turn @ own), tel)
    up = named_up(turn)
    assert (problem is None) is (up == "z")
    assert problem is None or f"up is {up} in the motion-capture system" in problem.found


@pytest.mark.parametrize(("place", "agrees"), [
    (at(0.05, 0.0, 0.05), True), (at(0.2, 0.0, 0.02), False), (at(0.0, 0.0, math.nan), False),
    (turned(0.2), True), (turned(0.4), False),
])  # fmt: skip
def test_the_estimate_has_to_agree(place: ExternalPosition, agrees: bool) -> None:
    assert (estimate_problem(place, REST) is None) is agrees


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
        self.stopped_s: list[float] = []

    def stop(self) -> None:
        self.stopped_s.append(self._link.now_s)

    def status(self, now_s: float) -> FeedStatus:
        hidden = self._hidden(now_s)
        if not hidden:
            self._sent_s = now_s - 0.01
            self._newest = self._place(at(0.0, 0.0, self._link.z_m))
        return FeedStatus(
            now_s - self._sent_s, HIDDEN if hidden else None, 7, self._newest, 99.0, self._newest
        )


def rig(link: Vehicle | None = None, **how: Any) -> tuple[Rig, Outside]:
    it = Rig(link or Vehicle(), profile=MOCAP)
    it.positions = outside = Outside(it.link, **how)
    return it, outside


def test_positions_that_lead_astray_are_sent_no_more() -> None:
    """It slides by them while it rises: swapped axes, which did not show at rest."""
    it, outside = rig(
        Vehicle(lambda tel: replace(tel, position_m=(tel.position_m[2], 0.0, tel.position_m[2])))
    )
    it.profile = changed(SOON, MOCAP)
    assert "swapped axes" in it.fly().reason
    assert len(outside.stopped_s) == 1


@pytest.mark.parametrize(("how", "error", "words"), [
    ({"hidden": lambda t_s: True}, TimedOut, f"positions from the motion-capture system .{HIDDEN}"),
    ({"place": lambda p: at(250.0, -100.0, 12.0)}, SafetyAbort, "millimetres"),
    (
        {"place": lambda p: at(1.0, 0.0, 0.0)},
        TimedOut,
        "the motion-capture system .the positions differ by 1",
    ),
])  # fmt: skip
def test_positions_that_are_none_keep_it_on_the_ground(
    how: dict[str, Any], error: type[Exception], words: str
) -> None:
    it, _ = rig(**how)
    it.refused(error, words)
    assert not it.link.said(PositionSetpoint)


def test_nothing_that_tells_the_position_is_a_refusal() -> None:
    Rig(profile=MOCAP).refused(SafetyAbort, "nothing sends positions")
    it = Rig()
    it.link.decks = lambda: ()  # type: ignore[method-assign]
    it.refused(SafetyAbort, "no positioning deck.*set positioning: mocap")


@pytest.mark.parametrize(
    ("for_s", "lands"), [(0.3, False), pytest.param(60.0, True, marks=pytest.mark.long)]
)
def test_an_occlusion_is_held_and_a_lasting_one_landed(for_s: float, lands: bool) -> None:
    def hidden(t_s: float) -> bool:
        first = it.link.said(PositionSetpoint)
        return bool(first) and first[0] + 1.0 <= t_s < first[0] + 1.0 + for_s

    it, _ = rig(hidden=hidden)
    it.operator = lambda: OperatorRequest.LAND if it.link.now_s > 9.0 else OperatorRequest.NONE
    report = it.fly()
    held = [e for e in it.watcher.events if e.kind.value == "hold" and HIDDEN in e.reason]
    assert len(held) == 1
    assert (report.outcome is Outcome.SAFETY) is lands
    assert (HIDDEN in report.reason) is lands
    ages_s = [
        tick.external_positions.newest_position_age_s
        for tick in it.watcher.ticks
        if tick.external_positions
    ]
    assert len(ages_s) == len(it.watcher.ticks)
    assert max(ages_s) > 0.25


# --- only what is fresh is judged -------------------------------------------------------------

OLD_S = MOCAP.safety.proof_age_s + 0.01
LATE_S = MOCAP.positioning.hold_s + 0.01
IN_A_HAND = {"acc_z_g": 1.3}


@pytest.mark.parametrize(("turns", "refused"), [
    # Each: where the body is, the ages of telemetry and position, and what telemetry says.
    ([(0.0, 0.02, 0.02, {}), (0.5, 0.02, 0.02, {})], True),
    ([(0.0, 0.02, 0.02, {}), (0.5, OLD_S, 0.02, {})], False),
    ([(0.0, 0.02, 0.02, {}), (0.5, 0.02, LATE_S, {})], False),
    ([(0.0, 0.02, 0.02, {}), (0.5, 0.02, 0.02, {"behind_s": OLD_S})], False),
    # It moved unseen, and the vehicle was not seen to: that is another's body all the same.
    ([(0.0, 0.02, 0.02, {}), (0.3, OLD_S, 0.02, {}), (0.5, 0.02, 0.02, {})], True),
    ([(0.0, 0.02, 0.02, {}), (0.3, 0.02, LATE_S, IN_A_HAND), (0.5, 0.02, 0.02, {})], False),
])  # fmt: skip
def test_a_body_that_moves_is_judged_by_fresh_telemetry_and_a_fresh_position(
    turns: list[tuple[float, float, float, dict[str, float]]], refused: bool
) -> None:
    at_rest = RestCheck()

    def asked(x_m: float, tel_age_s: float, age_s: float, changes: dict[str, float]) -> None:
        place = at(x_m, 0.0, 0.012)
        sample = replace(REST, t_s=50.0 - tel_age_s, **changes)  # type: ignore[arg-type]
        status = FeedStatus(age_s, None, 9, place, 100.0, place)
        refuse_wrong_positions(status, sample, MOCAP, 50.0, at_rest)

    for turn in turns[:-1]:
        asked(*turn)
    with pytest.raises(SafetyAbort, match="shows a motion") if refused else nullcontext():
        asked(*turns[-1])
