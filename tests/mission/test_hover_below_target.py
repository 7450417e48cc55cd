"""The mission that hovers below the target: it sinks, climbs back only in ASCEND, and claims only
what it did."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from perchctl.mission import Outcome, Phase
from perchctl.mission.phases.hover import (
    MAX_HEIGHT_RETURN_DURATION_TO_KEEP_HOVER_TIMER_S,
    MAX_SINK_BELOW_HOVER_HEIGHT_BEFORE_CLIMB_BACK_M,
)
from perchctl.mission.report import HoverReport
from perchctl.mission.state import HoverErrorAccumulator
from perchctl.profile import Profile
from perchctl.vehicle import LOCKED, PositionSetpoint
from tests.helpers.mission import (
    CEILING_M,
    HANG_Z_M,
    HOVERING,
    PROFILE,
    READY,
    changed,
    observation,
    remembering,
    state_in,
    target_at,
)
from tests.mission.rig import BEGIN_S, TICK_S, Look, at, fly

DURATION_S = 5.0
STANDOFF_Z_M = HANG_Z_M - PROFILE.planner.ascend.standoff_m


def nearer(by_m: float) -> dict[str, Any]:
    """What is observed of a target that hangs lower than where the hover began."""
    return {"target": target_at(BEGIN_S + TICK_S, (0.0, 0.0, CEILING_M - by_m))}


@pytest.mark.parametrize(("by_m", "down_m"), [(0.1, 0.08), (0.0, 0.0), (-0.05, 0.0)])
def test_it_sinks_below_a_nearer_target_and_never_follows_one_that_is_farther(
    by_m: float, down_m: float
) -> None:
    """By 2 cm it may come closer, so that noise does not lower it step by step."""
    flight = fly(state_in(Phase.HOVER), at(obs=nearer(by_m)), 0.26, HOVERING, one_phase=True)
    lowest_m = min(tick.state.setpoint.z_m for tick in flight.ticks if tick.state.setpoint)
    assert lowest_m == pytest.approx(1.0 - down_m, abs=0.005)
    heights_m = [c.z_m for c in flight.commands if isinstance(c, PositionSetpoint)]
    assert max(heights_m) <= 1.0 + 1e-9


def sunk_for(low_s: float) -> Look:
    """The vehicle is 8 cm too low for that time, and then at its place."""
    low, there = at(1.0 - MAX_SINK_BELOW_HOVER_HEIGHT_BEFORE_CLIMB_BACK_M - 0.02), at()
    return lambda t_s: (low if t_s < BEGIN_S + low_s else there)(t_s)


@pytest.mark.parametrize(
    ("low_s", "goes_on"),
    [(1.0, True), (MAX_HEIGHT_RETURN_DURATION_TO_KEEP_HOVER_TIMER_S + 1.0, False)],
)
def test_the_time_of_a_hover_goes_on_while_it_climbs_back(low_s: float, goes_on: bool) -> None:
    """Unless that takes so long that it was no hover."""
    profile = changed({"planner.hover.duration_s": 20.0}, HOVERING)
    flight = fly(state_in(Phase.HOVER), sunk_for(low_s), low_s + 1.0, profile)
    way = [state.phase for state in {id(t.state.entry): t.state for t in flight.ticks}.values()]
    assert way == [Phase.HOVER, Phase.ASCEND, Phase.HOVER]
    assert "sunk" in flight.rows
    errors = flight.state.hover_errors
    assert (errors.hover_began_at_s == BEGIN_S) is goes_on
    if goes_on:  # the frames of the ascent count, too
        assert errors.frame_count == len(flight.ticks)


def test_the_time_starts_anew_once_the_vehicle_has_left_its_place() -> None:
    away, there = at(position_m=(0.4, 0.0, 1.0)), at()
    flight = fly(
        state_in(Phase.HOVER), lambda t_s: (away if t_s < BEGIN_S + 0.1 else there)(t_s), 2.0,
        HOVERING,
    )  # fmt: skip
    assert "left-place" in flight.rows
    assert flight.state.phase is Phase.HOVER
    assert flight.state.hover_errors.hover_began_at_s > BEGIN_S + 0.5


def test_a_hover_is_completed_only_while_the_target_is_seen() -> None:
    remembered = target_at(
        BEGIN_S, is_measured_in_newest_frame=False, tracked=False, last_measured_at_s=BEGIN_S - 1.0
    )
    late = remembering(
        state_in(Phase.HOVER), hover_errors=HoverErrorAccumulator(BEGIN_S - DURATION_S - 1.0)
    )
    assert fly(late, at(obs={"target": remembered}), 0.1, HOVERING).state.phase is Phase.HOVER
    assert fly(late, at(), 0.1, HOVERING).state.outcome is Outcome.HOVERED


@pytest.mark.parametrize("seen", ["hung", "locked"])
def test_a_hover_that_ends_on_the_magnet_is_no_hover(seen: str) -> None:
    """Its exit code says that the vehicle has landed."""
    off = {"thrust": 0.0, "supervisor": READY | (LOCKED if seen == "locked" else 0)}
    state = remembering(
        state_in(Phase.LANDING, BEGIN_S, HANG_Z_M), motor_stop_commanded_at_s=BEGIN_S - 1.0,
        vehicle_world_z_at_last_contact_m=HANG_Z_M, outcome=Outcome.HOVERED,
    )  # fmt: skip
    end = fly(state, at(HANG_Z_M, **off), 0.3, HOVERING).state
    assert (end.phase, end.outcome) == (Phase.PERCHED, Outcome.SAFETY)
    assert Outcome.HOVERED.exit_code == 0 != end.outcome.exit_code


@pytest.mark.parametrize("below_m", [0.2, PROFILE.planner.ascend.standoff_m])
def test_a_mission_that_hovers_never_presses(below_m: float) -> None:
    """Whatever the distance: where a perch would settle and press, it hovers."""
    profile = changed({"planner.hover.below_m": below_m}, HOVERING)
    flight = fly(
        state_in(Phase.ASCEND, z_m=HANG_Z_M - below_m), at(HANG_Z_M - below_m), 3.0, profile
    )
    assert {tick.state.phase for tick in flight.ticks} == {Phase.ASCEND, Phase.HOVER}


def test_a_hover_needs_no_thrust_for_a_press() -> None:
    """A press by raw thrust has at most 60,000, so a vehicle that hovers with 59,500 cannot."""
    raw = changed({"planner.perch.mode": "raw"})
    hover = changed({"planner.hover": HOVERING.planner.hover}, raw)
    rows = []
    for profile in (raw, hover):
        heavy = remembering(state_in(Phase.ASCEND, z_m=STANDOFF_Z_M), hover_thrust=59500.0)
        rows.append(
            fly(heavy, at(STANDOFF_Z_M, thrust=59500.0), 0.1, profile).state.transition_name
        )
    assert rows == ["too-weak", ""]


@pytest.mark.parametrize(("flown_s", "row"), [(124.0, ""), (126.0, "time-over")])
def test_the_time_of_the_mission_includes_that_of_the_hover(flown_s: float, row: str) -> None:
    state = remembering(state_in(Phase.ALIGN), flight_started_at_s=BEGIN_S - flown_s)
    assert fly(state, at(), TICK_S, HOVERING).state.transition_name == row


def test_the_battery_has_to_last_for_the_hover() -> None:
    """The same battery is enough for five seconds, and not for five minutes."""
    rows = []
    for duration_s in (5.0, 300.0):
        profile = changed({"planner.hover.duration_s": duration_s}, HOVERING)
        rows.append(
            fly(state_in(Phase.ALIGN), at(), 0.6, profile, one_phase=True).state.transition_name
        )
    assert rows == ["aligned", "too-little-left"]


def test_each_frame_counts_once_and_the_errors_are_those_of_the_place() -> None:
    """3 cm aside, 4 cm too low, and turned by a tenth."""
    place = HOVERING.planner.hover
    assert place is not None
    e_m = np.array([0.03, 0.0, place.below_m + 0.04])
    state = state_in(Phase.HOVER)
    for number in range(1, 5):
        t_s = BEGIN_S + number * TICK_S
        seen = target_at(t_s, e_m=e_m, e_yaw_rad=0.1)
        obs = observation(t_s, target=seen, has_new_frame=number % 2 == 0)
        state = fly(state, lambda _t_s, obs=obs: obs, TICK_S, HOVERING).state
    assert state.hover_errors.frame_count == 2
    report = HoverReport.from_state(state, HOVERING)
    assert report is not None
    assert report.gear_to_hover_position_rms_xyz_m == pytest.approx((0.03, 0.0, 0.04))
    assert report.yaw_error_rms_rad == pytest.approx(0.1)
    assert report.duration_s == pytest.approx(4 * TICK_S)
    assert "RMS error x 30.0, y 0.0, z 40.0 mm, heading 5.7 deg" in report.text
    assert HoverReport.from_state(state, PROFILE) is None
    assert all(math.isnan(each) for each in HoverErrorAccumulator().rms_level_xyz_m_yaw_rad)


def hovers_at(below_m: float, **safety: float) -> Profile:
    changes: dict[str, Any] = {"planner.hover.below_m": below_m}
    return changed(changes | {f"safety.{k}": v for k, v in safety.items()}, HOVERING)


@pytest.mark.parametrize(("profile", "words"), [
    (hovers_at(1.9), "1.9 m below the target is 0.27 m above the ground, but the vehicle hovers "),
    (hovers_at(0.5, max_height_m=1.7), "0.5 m below the target is 1.67 m above the ground, but "
     "the vehicle hovers only 0.3 to 1.65 m above the ground: change the distance"),
])  # fmt: skip
def test_a_hover_near_the_ground_or_the_limit_is_refused_in_a_sentence(
    profile: Profile, words: str
) -> None:
    state = fly(state_in(Phase.ALIGN), at(), 0.6, profile, one_phase=True).state
    assert (state.phase, state.transition_name) == (Phase.LANDING, "hover-height")
    assert words in state.transition_reason
