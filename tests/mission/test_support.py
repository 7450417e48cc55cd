"""What supports the vehicle, in one word, and what the rows make of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from perchctl.mission import Context, Observation, Phase, step_mission
from perchctl.mission.belief.contact import Support
from tests.helpers.mission import (
    HANG_Z_M,
    HOVER_THRUST,
    PROFILE,
    observation,
    state_in,
    target_at,
    telemetry,
)

T_S = 10.0
LOW_THRUST = 0.4 * HOVER_THRUST
ORDER = [Support.MAGNET, Support.UNKNOWN, Support.HELD_BY_OTHER_OBJECT]
"""The farther from the magnet, the later."""
heights_m = st.floats(-0.05, 0.0)
angles_rad = st.floats(-math.pi, math.pi)


def supported(obs: Observation, phase: Phase = Phase.ALIGN) -> Support:
    """What the planner believes after one tick with `obs`, while it does not climb."""
    state, _ = step_mission(state_in(phase, T_S, obs.telemetry.position_m[2]), obs, PROFILE)
    assert state.phase is phase
    return Context(state).vehicle_support


def hanging(
    offset_m: float, angle_rad: float = 0.0, below_m: float = 0.0, sigma_m: float = 0.001
) -> Observation:
    """A motionless vehicle with too little thrust to fly, `offset_m` from the target's axis."""
    place_m = offset_m * math.cos(angle_rad), offset_m * math.sin(angle_rad), HANG_Z_M - below_m
    t_s = T_S + 0.02
    seen = target_at(t_s, body_m=place_m, sigma_m=np.full(3, sigma_m))
    sample = telemetry(t_s, place_m[2], position_m=place_m, thrust=LOW_THRUST)
    return observation(t_s, telemetry=sample, target=seen)


@given(
    offsets_m=st.lists(st.floats(0.0, 0.2), min_size=2, max_size=6),
    angle_rad=angles_rad,
    sigma_m=st.floats(0.0005, 0.03),
)
def test_the_farther_from_the_axis_the_less_it_is_the_magnet(
    offsets_m: list[float], angle_rad: float, sigma_m: float
) -> None:
    found = [supported(hanging(at_m, angle_rad, 0.0, sigma_m)) for at_m in sorted(offsets_m)]
    assert [ORDER.index(each) for each in found] == sorted(ORDER.index(each) for each in found)


@given(angle_rad=angles_rad)
def test_an_offset_in_doubt_is_neither_the_magnet_nor_something_else(angle_rad: float) -> None:
    radius_m = PROFILE.planner.perch.contact_xy_m
    assert supported(hanging(0.5 * radius_m, angle_rad)) is Support.MAGNET
    assert supported(hanging(0.9 * radius_m, angle_rad, sigma_m=0.01)) is Support.UNKNOWN
    assert supported(hanging(1.1 * radius_m, angle_rad, sigma_m=0.01)) is Support.UNKNOWN
    assert supported(hanging(3.0 * radius_m, angle_rad)) is Support.HELD_BY_OTHER_OBJECT


@given(below_m=st.floats(0.15, 0.6))
def test_what_holds_it_below_the_target_is_something_else(below_m: float) -> None:
    assert supported(hanging(0.0, below_m=below_m)) is Support.HELD_BY_OTHER_OBJECT


@given(above_m=st.floats(0.15, 0.4), angle_rad=angles_rad)
def test_what_holds_it_at_an_impossible_height_may_be_the_target(
    above_m: float, angle_rad: float
) -> None:
    """No vehicle hangs above the plane of a target on the ceiling: the estimate is wrong. Its
    offset from the axis still counts."""
    radius_m = PROFILE.planner.perch.contact_xy_m
    assert supported(hanging(0.5 * radius_m, angle_rad, -above_m)) is Support.UNKNOWN
    assert supported(hanging(3.0 * radius_m, angle_rad, -above_m)) is Support.HELD_BY_OTHER_OBJECT


@given(ratio=st.floats(0.97, 1.03), offset_m=st.floats(0.0, 0.2))
def test_a_vehicle_with_the_thrust_to_hover_flies(ratio: float, offset_m: float) -> None:
    obs = hanging(offset_m, below_m=0.5)
    flies = replace(obs, telemetry=replace(obs.telemetry, thrust=ratio * HOVER_THRUST))
    assert supported(flies) is Support.AIR
    climbs = replace(obs, telemetry=replace(obs.telemetry, thrust=1.1 * HOVER_THRUST))
    assert supported(climbs) is Support.UNKNOWN


def test_a_maneuver_that_has_just_begun_knows_nothing_yet() -> None:
    """Its evidence starts anew; a vehicle that hangs does not fly for that."""
    state, _ = step_mission(state_in(Phase.ASCEND, T_S, HANG_Z_M), hanging(0.2), PROFILE)
    assert state.phase is Phase.ALIGN
    assert Context(state).vehicle_support is Support.UNKNOWN


def test_a_vehicle_with_late_telemetry_is_supported_by_nothing_known() -> None:
    obs = hanging(0.0)
    late = replace(obs, t_s=obs.t_s + 0.3)
    assert supported(late) is Support.UNKNOWN


def test_it_presses_against_the_target_with_more_thrust_than_it_hovers_by() -> None:
    obs = hanging(0.0)
    presses = replace(obs, telemetry=replace(obs.telemetry, thrust=1.3 * HOVER_THRUST))
    assert supported(presses, Phase.PERCH) is Support.PRESSED_SURFACE


def test_a_vehicle_that_has_come_down_and_cannot_fly_stands_on_the_floor() -> None:
    state, _ = step_mission(
        replace(state_in(Phase.LANDING, T_S, 0.02), setpoint=None),
        hanging(0.0, below_m=HANG_Z_M - 0.02),
        PROFILE,
    )
    assert Context(state).vehicle_support is Support.FLOOR
