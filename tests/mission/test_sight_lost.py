"""Down without a position or a heading: hold, sink, and level by raw thrust."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission import ImuMotion, Observation, OperatorRequest, Phase, PlannerState
from perchctl.mission.belief.belief import (
    MAX_POSITION_AGE_BEYOND_LATENCY_TO_CORRECT_VELOCITY_S,
    MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS,
)
from perchctl.mission.belief.reckoning import DeadReckoningState
from perchctl.mission.level_descent import (
    BRAKE_TILT_GAIN_RAD_PER_MPS,
    MAX_BRAKE_TILT_RAD,
    SINK_RATE_SETPOINT_MPS,
)
from perchctl.mission.phase import Severity
from perchctl.mission.planner import step_mission
from perchctl.mission.release import (
    MAX_LATERAL_SPEED_BRAKED_IN_FALL_CATCH_MPS,
    ONBOARD_POSITION_TO_VELOCITY_GAIN_PER_S,
)
from perchctl.mission.setpoints import MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M
from perchctl.vehicle import PositionSetpoint, RawThrust, StopMotors
from tests.helpers.mission import BY_TARGET as PROFILE
from tests.helpers.mission import (
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    remembering,
    state_in,
    target_at,
)
from tests.helpers.mission import PROFILE as DECKS
from tests.mission.rig import BEGIN_S, TICK_S, Flight, Look, Motors, at, fly, is_setpoint

HOLD_S, LAND_S = PROFILE.positioning.hold_s, PROFILE.positioning.land_s
IN_THE_AIR = (
    Phase.APPROACH, Phase.SEARCH, Phase.ESTIMATE, Phase.ALIGN, Phase.ASCEND, Phase.RECOVER,
)  # fmt: skip


def unseen(z_m: float, since_s: float = 0.0, for_s: float | None = None, **tel: Any) -> Look:
    """The target is not seen since `since_s` before the begin, or at each time for `for_s`."""

    def look(t_s: float) -> Observation:
        obs = {
            "external_position_age_s": t_s - BEGIN_S + since_s if for_s is None else for_s,
            "external_position_problem": "the target is not seen",
            "has_new_frame": False,
        }
        return at(z_m, obs=obs, **tel)(t_s)

    return look


def blinded(
    z_m: float, velocity_mps: tuple[float, float, float] = (0.0, 0.0, 0.0), **changes: object
) -> PlannerState:
    """On its way down by accelerometer and attitude alone, with that reckoned speed."""
    dead_reckoning = DeadReckoningState(
        imu_at_last_update=ImuMotion(t_s=BEGIN_S), velocity_world_mps=velocity_mps
    )
    state = remembering(
        state_in(Phase.LANDING, z_m=z_m), dead_reckoning_began_at_s=BEGIN_S,
        dead_reckoned_height_m=z_m, severity=Severity.LAND, dead_reckoning=dead_reckoning,
    )  # fmt: skip
    return remembering(state, **changes)  # type: ignore[arg-type]


def lost(state: PlannerState, lasts_s: float, z_m: float = 1.0, **tel: Any) -> Flight:
    """Turn by turn, without a sight from the first one on."""
    return fly(state, unseen(z_m, **{"velocity_variance_m2ps2": 1e-3, **tel}), lasts_s, PROFILE)


@pytest.mark.parametrize("phase", IN_THE_AIR)
def test_it_is_held_then_sinks_and_then_comes_down_level(phase: Phase) -> None:
    height_m = 0.45 if phase is Phase.APPROACH else 1.0
    flight = lost(state_in(phase, z_m=height_m), LAND_S + 0.3, height_m)
    heights: list[float] = []
    for tick in flight.ticks:
        unseen_s = tick.t_s - BEGIN_S
        if unseen_s < LAND_S - 1e-6:
            assert isinstance(tick.command, PositionSetpoint)
            assert tick.state.setpoint is not None
            heights.append(tick.state.setpoint.z_m)
            assert unseen_s <= HOLD_S + TICK_S + 1e-6 or "not seen" in tick.state.hold_reason
        elif unseen_s > LAND_S + TICK_S + 1e-6:
            assert tick.state.phase is Phase.LANDING
            assert isinstance(tick.command, RawThrust)
    blind_m = heights[round(HOLD_S / TICK_S) + 1 :]
    assert all(after <= before for before, after in pairwise(blind_m))
    assert blind_m[-1] < blind_m[0]
    assert flight.state.transition_name == "position-lost"
    assert "descending level" in flight.state.transition_reason


@pytest.mark.parametrize(
    ("beside_m", "age_s", "lands"),
    [(0.4, 0.4, True), (0.2, 0.4, False), (0.4, 0.2, False), (0.0, 0.4, False)],
)
def test_what_sightings_contradict_is_not_flown_by(
    beside_m: float, age_s: float, lands: bool
) -> None:
    """It comes down level as soon as they have done so for longer than one of them may be wrong."""
    seen = at(
        1.0,
        obs={
            "rejected_sighting_to_estimate_distance_m": beside_m,
            "external_position_age_s": age_s,
        },
    )
    state = fly(state_in(Phase.ALIGN), seen, profile=PROFILE).state
    assert (state.phase is Phase.LANDING) is lands
    assert ("from its estimate" in state.transition_reason) is lands


@given(age_s=st.floats(0.0, 1.4), z_m=st.floats(0.3, 2.0), phase=st.sampled_from(IN_THE_AIR))
def test_nothing_climbs_without_a_sight(age_s: float, z_m: float, phase: Phase) -> None:
    """Not even a search, which would climb by a position that drifts."""
    state = remembering(
        state_in(phase, z_m=z_m), searched_position_count=2, search_step_began_at_s=0.0
    )
    after = fly(state, unseen(z_m, for_s=max(age_s, HOLD_S + 0.01)), profile=PROFILE).state
    assert after.setpoint is None or after.setpoint.z_m <= z_m


def test_sinking_ends_above_the_floor() -> None:
    state = lost(
        state_in(Phase.ALIGN, z_m=MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M + 0.05),
        LAND_S - 0.1,
        MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M + 0.05,
    ).state
    assert state.setpoint is not None
    assert state.setpoint.z_m == pytest.approx(MIN_HELD_SETPOINT_HEIGHT_ABOVE_GROUND_M)


@given(
    vx_mps=st.floats(-1.5, 1.5),
    vy_mps=st.floats(-1.5, 1.5),
    yaw_rad=st.floats(-math.pi, math.pi),
    age_s=st.sampled_from([0.05, 2.0]),
)
def test_it_brakes_the_felt_speed_aside_whether_or_not_the_target_is_seen_again(
    vx_mps: float, vy_mps: float, yaw_rad: float, age_s: float
) -> None:
    """A blow may have thrown it: level it would fly on aside, 2 m and more until the floor. A
    speed that the attitude leaves unsure is left alone."""
    assume(math.hypot(vx_mps, vy_mps) > 0.1)
    sinks = {"velocity_mps": (0.0, 0.0, -0.5), "yaw_rad": yaw_rad}
    look = at(obs={"external_position_age_s": age_s}, **sinks)
    command = fly(
        blinded(1.0, (vx_mps, vy_mps, -SINK_RATE_SETPOINT_MPS)), look, profile=PROFILE
    ).command
    assert isinstance(command, RawThrust)
    # Nose down is forwards, roll to the right is to the right (docs/firmware.md).
    ahead, left = command.pitch_rad, -command.roll_rad
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    x, y = ahead * cos - left * sin, ahead * sin + left * cos
    speed_mps = math.hypot(vx_mps, vy_mps)
    assert max(abs(ahead), abs(left)) <= MAX_BRAKE_TILT_RAD + 1e-9
    assert x * vx_mps + y * vy_mps <= -0.1 * min(speed_mps, 1.0) * speed_mps
    if speed_mps * BRAKE_TILT_GAIN_RAD_PER_MPS < MAX_BRAKE_TILT_RAD:
        assert x * vy_mps - y * vx_mps == pytest.approx(0.0, abs=1e-9)


@given(aside_g=st.floats(-1.0, 1.0), ahead_g=st.floats(-1.0, 1.0), yaw_rad=st.floats(-3.1, 3.1))
def test_a_blow_that_only_the_accelerometer_feels_ends_the_waiting_and_is_braked(
    aside_g: float, ahead_g: float, yaw_rad: float
) -> None:
    """For 0.1 s without a sight: sideways the estimate feels none of it."""
    gained_mps = 9.81 * 0.1 * math.hypot(aside_g, ahead_g)
    assume(abs(gained_mps - MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS) >= 0.05)

    def look(t_s: float) -> Observation:
        passed_s = t_s - BEGIN_S
        blown = 0.2 + 1e-6 < passed_s <= 0.3 + 1e-6
        felt = {"acc_x_g": ahead_g, "acc_y_g": aside_g} if blown else {"acc_x_g": 0.0}
        return unseen(1.0, for_s=max(0.01, passed_s - 0.1), yaw_rad=yaw_rad, **felt)(t_s)

    flight = fly(state_in(Phase.ALIGN), look, 0.58, PROFILE, feels=True, one_phase=True)
    assert (flight.state.phase is Phase.LANDING) is (
        gained_mps > MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS
    )
    if flight.state.phase is Phase.LANDING:
        assert flight.state.transition_name == "position-lost"
        assert (
            flight.ticks[-1].t_s - BEGIN_S
            >= 0.1 + MAX_POSITION_AGE_BEYOND_LATENCY_TO_CORRECT_VELOCITY_S
        )
        assert isinstance(flight.command, RawThrust)
        assert flight.command.pitch_rad * ahead_g <= 1e-3
        assert flight.command.roll_rad * aside_g >= -1e-3


@given(later_s=st.floats(0.0, 0.13), lost=st.integers(0, 2))
def test_pictures_that_come_late_are_no_blow(later_s: float, lost: int) -> None:
    """At ten pictures a second the newest sight is as old as the latency and a tenth of a second,
    and older where one is lost: what the accelerometer adds up meanwhile is a wrong attitude."""
    period_s = 0.1 * (1 + lost)
    slow = {"acc_x_g": 0.02}

    def look(t_s: float) -> Observation:
        age_s = 0.07 + later_s + (t_s - BEGIN_S) % period_s
        return at(
            obs={"external_position_age_s": age_s, "camera_latency_above_profile_s": later_s},
            **slow,
        )(t_s)

    flight = fly(state_in(Phase.ALIGN), look, 3.0, PROFILE, feels=True, one_phase=True)
    assert flight.state.phase is not Phase.LANDING


def test_a_landing_that_loses_it_goes_on_blindly() -> None:
    ordered = at(obs={"operator_request": OperatorRequest.LAND})
    state = fly(state_in(Phase.ALIGN), ordered, profile=PROFILE).state
    assert state.phase is Phase.LANDING
    assert state.belief.dead_reckoning_began_at_s is None
    state, command = step_mission(state, unseen(0.9, for_s=LAND_S + 0.1)(BEGIN_S + 2.0), PROFILE)
    assert state.belief.dead_reckoning_began_at_s is not None
    assert isinstance(command, RawThrust)


@given(x_mps=st.floats(-2.0, 2.0), y_mps=st.floats(-2.0, 2.0))
def test_a_catch_brakes_a_speed_aside_that_the_estimate_has_not(x_mps: float, y_mps: float) -> None:
    """Knocked off the magnet it is caught by position, and the position mode would tilt it by its
    estimate, which has felt no blow: the setpoint asks for the opposite of what that lacks."""
    unknown_mps = math.hypot(x_mps, y_mps)
    assume(abs(unknown_mps - MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS) > 0.01)
    imu = ImuMotion(t_s=BEGIN_S)
    state = remembering(
        state_in(Phase.LANDING, z_m=1.9), vehicle_world_z_at_last_contact_m=1.9,
        weight_transfer_began_at_s=BEGIN_S - 1.0,
        magnet_reach_entered_at_s=BEGIN_S - 6.0, dead_reckoning_began_at_s=BEGIN_S - 3.0,
        dead_reckoning=DeadReckoningState(
            imu_at_last_update=imu, velocity_world_mps=(x_mps, y_mps, -0.5),
            recent_imu_minus_estimate_velocity_world_xy_mps=(x_mps, y_mps),
        ),
    )  # fmt: skip
    falls = unseen(1.85, for_s=2.0, velocity_mps=(0.0, 0.0, -0.5), acc_z_g=0.2, thrust=0.0)
    obs = replace(falls(BEGIN_S + TICK_S), imu=replace(imu, t_s=BEGIN_S + TICK_S))
    _, command = step_mission(state, obs, PROFILE)
    assert is_setpoint(command, above_m=1.85)
    assert isinstance(command, PositionSetpoint)
    if unknown_mps > MIN_LATERAL_SPEED_GAIN_TO_DETECT_GUST_MPS:
        for way_m, mps in ((command.x_m, x_mps), (command.y_m, y_mps)):
            braked_mps = max(
                -MAX_LATERAL_SPEED_BRAKED_IN_FALL_CATCH_MPS,
                min(MAX_LATERAL_SPEED_BRAKED_IN_FALL_CATCH_MPS, mps),
            )
            assert way_m == pytest.approx(
                -braked_mps / ONBOARD_POSITION_TO_VELOCITY_GAIN_PER_S, abs=0.02
            )
    else:
        assert (command.x_m, command.y_m) == (0.0, 0.0)


@given(speed_mps=st.floats(-1.5, 0.5), blind=st.booleans())
def test_level_it_brakes_what_sinks_fast_and_lets_sink_what_does_not(
    speed_mps: float, blind: bool
) -> None:
    """Blind by the felt speed, whatever the estimate says; without a heading by the estimate's."""
    state = blinded(1.0, (0.0, 0.0, speed_mps)) if blind else is_heading_lost()
    look = unseen(1.0, for_s=2.0) if blind else at()
    estimated_mps = 0.5 if blind else speed_mps

    def sinks(t_s: float) -> Observation:
        obs = look(t_s)
        tel = replace(obs.telemetry, velocity_mps=(0.0, 0.0, estimated_mps))
        return replace(obs, telemetry=tel)

    command = fly(state, sinks, profile=PROFILE if blind else DECKS).command
    assert isinstance(command, RawThrust)
    beside = abs(speed_mps + SINK_RATE_SETPOINT_MPS) < 0.02
    assert beside or (command.thrust > HOVER_THRUST) == (speed_mps < -SINK_RATE_SETPOINT_MPS)
    assert command.thrust <= 60000  # more is clipped
    assert blind or (command.roll_rad, command.pitch_rad) == (0.0, 0.0)


# --- the last centimetres ------------------------------------------------------------------


def test_a_press_without_a_contact_backs_off_before_dead_reckoning_leads_aside() -> None:
    """By other means it has the time that it always had."""
    flight = lost(state_in(Phase.PERCH, z_m=2.1), 1.4, 2.1)
    rows = [
        tick.state.transition_name for tick in flight.ticks if tick.state.phase is Phase.RECOVER
    ]
    assert rows[0] == "pressed-blindly"
    assert flight.state.failed_attempts == 1
    assert "after the last sight" in flight.state.transition_reason
    decks = fly(state_in(Phase.PERCH, z_m=2.1), unseen(2.1, for_s=1.3))
    assert decks.state.transition_name != "pressed-blindly"


def pressed_past_the_sight(
    lateral_offset_m: float = 0.0, sigma_m: float = 1e-3, climb_mps: float = 0.0
) -> PlannerState:
    """The last sight was 4.5 cm below the target. From there on the estimate sinks at 0.1 m/s, as
    after an impact, and the accelerometer feels `climb_mps` more each second; it holds."""

    def look(t_s: float) -> Observation:
        i = round((t_s - BEGIN_S) / TICK_S) - 1
        z_m = HANG_Z_M - 0.045 - 0.1 * TICK_S * i
        target = target_at(
            t_s, (lateral_offset_m, 0.0, CEILING_M), (0.0, 0.0, z_m),
            is_measured_in_newest_frame=not i, last_measured_at_s=BEGIN_S + TICK_S,
            sigma_m=np.full(3, sigma_m),
        )  # fmt: skip
        return at(
            z_m,
            obs={"target": target, "has_new_frame": not i, "external_position_age_s": TICK_S * i},
            velocity_mps=(0.0, 0.0, -0.1 if i else 0.0), thrust=1.1 * HOVER_THRUST,
            acc_z_g=1.0 + climb_mps / GRAVITY_MPS2,
        )(t_s)  # fmt: skip

    begin = state_in(Phase.PERCH, z_m=HANG_Z_M - 0.045)
    return fly(begin, look, 0.9, PROFILE, feels=True, one_phase=True).state


def test_a_contact_that_holds_is_proven_past_the_last_sight_by_what_is_felt() -> None:
    """Though the estimate sinks, and half a second later places nothing any more."""
    state = pressed_past_the_sight()
    assert (state.phase, state.transition_name) == (Phase.COMPLETE, "contact")
    assert state.entry.t_s - BEGIN_S > HOLD_S
    assert pressed_past_the_sight(climb_mps=0.5).phase is Phase.PERCH  # it rises still


@pytest.mark.parametrize(
    ("lateral_offset_m", "sigma_m"), [(0.03, 1e-3), (0.02, 0.01), (0.0, math.inf)]
)
def test_a_contact_beside_the_magnet_or_nobody_knows_where_is_none(
    lateral_offset_m: float, sigma_m: float
) -> None:
    state = pressed_past_the_sight(lateral_offset_m, sigma_m)
    assert (state.phase, state.transition_name, state.failed_attempts) == (
        Phase.RECOVER,
        "beside-the-magnet",
        1,
    )


# --- Without a heading: level, on the vertical speed alone ----------------------------------------


def is_heading_lost() -> PlannerState:
    return remembering(state_in(Phase.LANDING), is_heading_lost=True)


def test_what_does_not_sink_gets_less_until_the_floor_proves_itself() -> None:
    class OnTheFloor(Motors):
        def look(self, t_s: float, state: PlannerState) -> Observation:
            return at(0.05, thrust=self.thrust)(t_s)

    flight = fly(is_heading_lost(), OnTheFloor(HOVER_THRUST), 4.0, DECKS)
    stopped = next(i for i, c in enumerate(flight.commands) if isinstance(c, StopMotors))
    thrusts = [c.thrust for c in flight.commands[:stopped] if isinstance(c, RawThrust)]
    assert len(thrusts) == stopped
    assert all(after < before + 1 for before, after in pairwise([HOVER_THRUST, *thrusts]))
