"""The one way down: what each evidence commands, and the laws that nothing breaks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perchctl.mission import (
    CameraImuMismatch,
    ImuMotion,
    Observation,
    OperatorRequest,
    Phase,
    PlannerState,
    RestState,
    VisualInertialMotion,
    descent,
    planner,
    rest,
)
from perchctl.mission.belief.contact import IMU_SHOWS_SUPPORT, MOTORS_OFF_AS_COMMANDED
from perchctl.mission.belief.motion import EstimateFusionMonitor
from perchctl.mission.belief.mounting import (
    MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG,
    CameraMountingMonitor,
)
from perchctl.mission.belief.quality import BATTERY_LOW
from perchctl.mission.belief.reckoning import DeadReckoningState
from perchctl.mission.context import Context
from perchctl.mission.descent import PEEL_OFF_MAGNET_TIMEOUT_S
from perchctl.mission.phase import PRE_LANDING_PHASES, VehicleDiagnosis
from perchctl.mission.table import PHASES
from perchctl.profile import Profile
from perchctl.vehicle import (
    HL_ACTIVE,
    LOW_POWER,
    Command,
    Idle,
    Land,
    PositionSetpoint,
    RawThrust,
    StopMotors,
)
from tests.helpers.mission import (
    AIRBORNE,
    BY_TARGET,
    CEILING_M,
    HANG_Z_M,
    HOVER_THRUST,
    MOCAP,
    PROFILE,
    PROFILES,
    READY,
    Felt,
    context_at,
    observation,
    observing,
    remembering,
    state_in,
    target_at,
    telemetry,
)
from tests.mission.rig import BEGIN_S, TICK_S, at, fly, is_setpoint, times

DECKS = PROFILES["deck"]
NOW_S = 10.0
MIN_HEIGHT_TO_INFER_HANGING_M, LOW_M = 1.5, 0.2
# --- By what is known ---------------------------------------------------------------------

# Profile; what is observed, and what is remembered, beyond a hover that all is known of; what is
# sent then to a vehicle that is free.
KNOWN: dict[str, tuple[Profile, dict[str, Any], dict[str, Any], type[Any]]] = {
    "position": (DECKS, {}, {}, PositionSetpoint),
    "sight": (BY_TARGET, {"external_position_age_s": 0.05}, {}, PositionSetpoint),
    "onboard": (DECKS, {"link_problem": "gone"}, {}, Land),
    "height": (DECKS, {}, {"is_heading_lost": True}, RawThrust),
    "imu": (
        BY_TARGET, {"external_position_age_s": 3.0}, {"dead_reckoning_began_at_s": NOW_S - 1.0},
        RawThrust,
    ),
    "nothing": (
        BY_TARGET, {"external_position_age_s": 3.0, "age_s": 0.6},
        {"dead_reckoning_began_at_s": NOW_S - 1.0}, RawThrust,
    ),
}  # fmt: skip
# What goes on whatever is known: what is remembered of it, and what may be sent.
BEGUN: dict[str, tuple[dict[str, Any], type[Any]]] = {
    "ordered": (
        {"stop_or_land_command_count": 1, "last_stop_or_land_command_at_s": NOW_S - 1.0},
        Land,
    ),
    "released": ({"weight_transfer_began_at_s": NOW_S - 0.5}, RawThrust),
    "stopped": (
        {
            "motor_stop_commanded_at_s": NOW_S - 0.2,
            "stop_or_land_command_count": 1,
            "last_stop_or_land_command_at_s": NOW_S - 0.2,
        },
        StopMotors,
    ),
}


def context(
    known: str,
    held: bool = False,
    z_m: float | None = None,
    since_s: float = 0.5,
    tel: dict[str, Any] | None = None,
    **changes: Any,
) -> Context:
    """A vehicle of which that is known, `held` within the magnet's reach, `since_s` after its way
    down began; with changes of its telemetry and of what is remembered."""
    profile, observed, remembered, _ = KNOWN[known]
    if changes.get("last_order_s") and profile is BY_TARGET:
        # What once had positions from outside, and was found astray, knows as little.
        profile, remembered = MOCAP, {"is_position_diverged": True}
    z_m = z_m if z_m is not None else HANG_Z_M if held else MIN_HEIGHT_TO_INFER_HANGING_M
    observed = dict(observed)
    sample = telemetry(NOW_S - observed.pop("age_s", 0.01), z_m)
    state = remembering(
        state_in(Phase.LANDING, NOW_S - since_s, z_m),
        t_s=NOW_S - TICK_S, last_telemetry=sample, dead_reckoned_height_m=z_m,
        vehicle_world_z_at_last_contact_m=z_m if held else None,
        magnet_reach_entered_at_s=NOW_S - 2.0 if held else None,
        dead_reckoning=DeadReckoningState(imu_at_last_update=ImuMotion(t_s=sample.t_s)),
    )  # fmt: skip
    state = remembering(state, **{**remembered, **changes})
    obs = observation(NOW_S, telemetry=replace(sample, **(tel or {})), target=None, **observed)
    return context_at(state, obs, profile)


@pytest.mark.parametrize("held", [False, True])
@pytest.mark.parametrize("known", KNOWN)
def test_what_is_known_decides_how_it_comes_down(known: str, held: bool) -> None:
    free = KNOWN[known][-1]
    c = context(known, held)
    state, command = descent.act_in_landing(c)
    assert isinstance(command, PositionSetpoint if held and free is Land else free)
    assert state.severity >= c.state.severity
    if isinstance(command, PositionSetpoint):
        assert command.z_m < c.obs.telemetry.position_m[2]
    if isinstance(command, RawThrust):
        assert 20000 < command.thrust < HOVER_THRUST


@pytest.mark.parametrize("name", BEGUN)
@pytest.mark.parametrize("known", KNOWN)
def test_what_has_begun_goes_on_whatever_is_known(known: str, name: str) -> None:
    """By the target no landing of its own is ordered."""
    if (known, name) == ("sight", "ordered"):
        return
    remembered, sent = BEGUN[name]
    _, command = descent.act_in_landing(context(known, name != "ordered", **remembered))
    assert isinstance(command, sent)
    assert not isinstance(command, RawThrust) or command.thrust <= 20000


@pytest.mark.parametrize("known", KNOWN)
def test_below_the_hand_over_it_lands_by_itself_or_level(known: str) -> None:
    assert DECKS.planner.landing.handover_m > LOW_M
    command = descent.act_in_landing(context(known, z_m=LOW_M))[1]
    assert isinstance(command, Land if known in ("position", "onboard") else RawThrust)


@pytest.mark.parametrize("known", ["position", "sight", "onboard"])
def test_what_does_not_peel_off_is_given_to_the_magnet(known: str) -> None:
    """By no landing of its own, whose trajectory ends while the magnet still holds. Deaf, nobody
    can watch what the weight does: it goes on by setpoints."""
    assert is_setpoint(
        descent.act_in_landing(context(known, True, since_s=PEEL_OFF_MAGNET_TIMEOUT_S - 0.1))[1]
    )
    state, command = descent.act_in_landing(
        context(known, True, since_s=PEEL_OFF_MAGNET_TIMEOUT_S + 0.1)
    )
    assert isinstance(command, RawThrust)
    assert state.weight_transfer_began_at_s == NOW_S
    if known == "onboard":
        deaf, command = descent.act_in_landing(
            context(known, True, since_s=PEEL_OFF_MAGNET_TIMEOUT_S + 0.1, tel={"t_s": 8.0})
        )
        assert is_setpoint(command, distance_below_m=HANG_Z_M)
        assert deaf.weight_transfer_began_at_s is None


# --- What each part of it takes --------------------------------------------------------------


def sent(profile: Profile, state: dict[str, Any], **observed: Any) -> type[Command]:
    """The kind of command that a way down gives a vehicle high up: setpoints by a position, its own
    landing where telemetry, link or loop are doubtful, else raw thrust."""
    began = remembering(
        state_in(Phase.LANDING, NOW_S - 1.0, MIN_HEIGHT_TO_INFER_HANGING_M),
        t_s=NOW_S - TICK_S,
        **state,
    )
    age_s, behind_s = observed.pop("age_s", 0.01), observed.pop("behind_s", 0.0)
    obs = at(MIN_HEIGHT_TO_INFER_HANGING_M, age_s=age_s, obs=observed, behind_s=behind_s)(NOW_S)
    return type(descent.act_in_landing(Context(observing(began, obs, profile)))[1])


@pytest.mark.parametrize(
    ("observed", "with_decks", "is_target_positioned"),
    [
        ({}, PositionSetpoint, PositionSetpoint),
        ({"external_position_age_s": 0.6}, RawThrust, RawThrust),
        (
            {"camera_imu_mismatch": CameraImuMismatch(camera_latency_error_s=0.2)},
            PositionSetpoint,
            RawThrust,
        ),
        ({"has_estimated_position_jumped": True}, Land, RawThrust),
        ({"tick_start_delay_s": 0.5}, Land, RawThrust),
        ({"link_problem": "gone"}, Land, RawThrust),
        ({"behind_s": 0.5}, Land, RawThrust),
        ({"age_s": 0.6}, Land, RawThrust),
        # One setpoint with the new heading, so that the firmware does not turn by the jump.
        (
            {"has_estimated_position_jumped": True, "heading_jump_rad": 1.5},
            PositionSetpoint,
            PositionSetpoint,
        ),
        (
            {"has_estimated_position_jumped": True, "heading_jump_rad": 1.5, "behind_s": 0.5},
            RawThrust,
            RawThrust,
        ),
        # A level descent does not change its mode for a moment; without a vertical speed raw thrust
        # would be blind, and the vehicle's own landing is left.
        (
            {"has_estimated_position_jumped": True, "heading_jump_rad": 1.5, "age_s": 0.2},
            RawThrust,
            RawThrust,
        ),
        (
            {"has_estimated_position_jumped": True, "heading_jump_rad": 1.5, "age_s": 0.6},
            Land,
            RawThrust,
        ),
    ],
)
def test_each_part_of_what_is_known_has_its_own_age(
    observed: dict[str, Any], with_decks: type[Command], is_target_positioned: type[Command]
) -> None:
    """A dead position block leaves acceleration and thrust fresh; and what a picture carries is
    doubted sooner than what decks measure."""
    assert sent(DECKS, {}, **observed) is with_decks
    assert sent(BY_TARGET, {}, **observed) is is_target_positioned


@given(jumps=st.lists(st.booleans(), min_size=1, max_size=120))
def test_a_jump_of_the_heading_is_set_anew_at_most_twice_a_second(jumps: list[bool]) -> None:
    """Under raw thrust the firmware turns back to the heading that it was told last: it is told the
    new one in place. A heading that keeps jumping hands the vehicle to no position control."""
    state = remembering(state_in(Phase.LANDING, NOW_S - 1.0), t_s=NOW_S - TICK_S)
    told_s: list[float] = []
    for tick, jumped in enumerate([True, *jumps]):
        t_s, yaw_rad = NOW_S + tick * TICK_S, 0.7 + tick
        jump = {"has_estimated_position_jumped": True, "heading_jump_rad": 1.5} if jumped else {}
        state, command = descent.step_landing(state, at(obs=jump, yaw_rad=yaw_rad)(t_s), DECKS)
        if isinstance(command, PositionSetpoint):
            assert jumped
            assert (command.x_m, command.y_m, command.yaw_rad) == (0.0, 0.0, yaw_rad)
            assert command.z_m <= 1.0
            told_s.append(t_s)
        else:
            assert isinstance(command, RawThrust)
    assert told_s[0] == NOW_S
    assert all(b - a >= 0.5 - 1e-9 for a, b in pairwise(told_s))


@pytest.mark.parametrize(
    ("z_m", "tel"),
    [
        (0.02, {}),  # a setpoint must be higher than that
        (1.0, {"position_m": (math.nan, 0.0, 1.0)}),
        (1.0, {"yaw_rad": math.nan}),
    ],
)
def test_a_heading_is_not_set_anew_where_that_would_lift_the_vehicle_or_is_no_number(
    z_m: float, tel: dict[str, Any]
) -> None:
    jump = {"has_estimated_position_jumped": True, "heading_jump_rad": 1.5}
    began = remembering(state_in(Phase.LANDING, NOW_S - 1.0), t_s=NOW_S - TICK_S)
    _, command = descent.step_landing(began, at(z_m, obs=jump, **tel)(NOW_S), DECKS)
    assert isinstance(command, RawThrust)


def uncorrected(for_s: float) -> dict[str, Any]:
    """A deck that has given no positions for so long."""
    return {
        "imu": ImuMotion(
            t_s=NOW_S, estimate_fusion_monitor=EstimateFusionMonitor(1e-3, NOW_S, NOW_S - for_s)
        )
    }


@pytest.mark.parametrize(
    ("profile", "state", "observed", "placed"),
    [
        (MOCAP, {}, {}, True),
        (MOCAP, {}, {"external_position_age_s": 0.6}, False),  # its last ones have it stand still
        (DECKS, {}, uncorrected(0.6), False),
        (DECKS, {}, uncorrected(0.3), True),
        # What once came down blindly, or went astray, believes no sight and no position again.
        (MOCAP, {"dead_reckoning_began_at_s": NOW_S - 1.0}, {}, False),
        (BY_TARGET, {"dead_reckoning_began_at_s": NOW_S - 1.0}, {}, False),
        (MOCAP, {"is_position_diverged": True}, {}, False),
        (MOCAP, {"is_position_diverged": True}, {"age_s": 0.6}, False),
    ],
)
def test_positions_that_end_or_lead_astray_leave_what_is_felt(
    profile: Profile, state: dict[str, Any], observed: dict[str, Any], placed: bool
) -> None:
    assert sent(profile, state, **observed) is (PositionSetpoint if placed else RawThrust)


@pytest.mark.parametrize(("positioning", "astray"), [("mocap", True), ("deck", False)])
def test_a_mounting_that_seems_turned_may_be_the_capture_s_axes(
    positioning: str, astray: bool
) -> None:
    """By such positions a landing would speed up until it tilts over."""
    begin = remembering(
        state_in(Phase.ALIGN, NOW_S),
        camera_mounting_monitor=CameraMountingMonitor(
            contradicting_sighting_count=MIN_CONTRADICTING_SIGHTINGS_TO_JUDGE_MOUNTING_WRONG
        ),
    )
    obs = observation(NOW_S + TICK_S)
    state, command = planner.step_mission(begin, obs, PROFILES[positioning])
    assert (state.phase, state.transition_name, state.belief.is_position_diverged) == (
        Phase.LANDING,
        "mounting",
        astray,
    )
    assert ("motion capture may have swapped axes" in state.transition_reason) is astray
    assert isinstance(command, RawThrust if astray else PositionSetpoint)


def landed_onboard(z_m: float, for_s: float, **tel: Any) -> list[tuple[float, Command]]:
    """The commands, with their times, of a landing of the vehicle's own, which the estimate shows
    at this height all along."""
    state = remembering(state_in(Phase.LANDING, NOW_S - 1.0, z_m), t_s=NOW_S - TICK_S)
    sent_: list[tuple[float, Command]] = []
    for t_s in times(for_s):
        bits = AIRBORNE | HL_ACTIVE if sent_ and isinstance(sent_[-1][1], Land) else AIRBORNE
        state, command = descent.step_landing(state, at(z_m, supervisor=bits, **tel)(t_s), DECKS)
        sent_ += [] if isinstance(command, Idle) else [(t_s, command)]
    return sent_


@given(
    z_m=st.floats(-2.0, -0.11) | st.floats(0.07, 0.25),
    thrust=st.floats(0.86, 1.1).map(lambda r: r * HOVER_THRUST),
)
@settings(max_examples=20)  # each is a landing of 500 ticks
def test_a_landing_of_its_own_does_not_end_in_the_air(z_m: float, thrust: float) -> None:
    """On hover thrust a vehicle still flies: below its floor (seed 21211562 was cut at 0.4 m), and
    above it, where it floats in its ground effect (extreme, seed 2612023021: at 0.1 m)."""
    given_ = landed_onboard(z_m, 10.0, thrust=thrust)
    assert isinstance(given_[0][1], Land)
    ends_s, lands = math.inf, False
    for t_s, command in given_:
        assert t_s < ends_s
        if isinstance(command, Land):
            assert command.height_m <= z_m - DECKS.planner.landing.undershoot_m
            # The first of several: the firmware refuses to land while it is landing.
            ends_s = ends_s if lands else t_s + command.duration_s
        else:
            assert command == PositionSetpoint(0.0, 0.0, z_m, 0.0)  # here: it climbs nowhere
            ends_s = math.inf
        lands = isinstance(command, Land)
    assert ends_s > NOW_S + 10.0


@pytest.mark.parametrize(
    ("z_m", "thrust"),
    [
        (-0.3, 0.8 * HOVER_THRUST),
        (-0.05, HOVER_THRUST),
        (0.03, HOVER_THRUST),
        (0.2, 0.8 * HOVER_THRUST),
    ],
)
def test_a_landing_that_has_reached_the_floor_is_not_drawn_out(z_m: float, thrust: float) -> None:
    commands = [command for _, command in landed_onboard(z_m, 10.0, thrust=thrust)]
    assert [type(command) for command in commands] == [Land] * 3


def test_a_landing_is_not_drawn_out_at_a_place_that_is_no_number() -> None:
    nowhere = (math.nan, 0.0, -0.3)
    commands = landed_onboard(-0.3, 10.0, thrust=HOVER_THRUST, position_m=nowhere)
    assert not any(isinstance(command, PositionSetpoint) for _, command in commands)


def test_a_landing_is_drawn_out_a_few_times_only() -> None:
    """A vehicle that never arrives is one that its estimate carries upwards."""
    commands = landed_onboard(-0.3, 25.0, thrust=HOVER_THRUST)
    assert sum(isinstance(command, PositionSetpoint) for _, command in commands) == 4


@pytest.mark.parametrize(
    ("known", "changes", "spent"),
    [
        # Nothing flies for long on the least thrust; on more it may, and motors stop on proof only.
        ("nothing", {"last_commanded_raw_thrust": 0.4 * HOVER_THRUST}, True),
        ("nothing", {"last_commanded_raw_thrust": 0.9 * HOVER_THRUST}, False),
        # What only ended the stream to a setpoint on the floor would be cut and locked.
        ("onboard", {"setpoint": PositionSetpoint(0.0, 0.0, 0.1, 0.0)}, True),
        ("onboard", {"setpoint": PositionSetpoint(0.0, 0.0, 1.0, 0.0)}, False),
    ],
    ids=["least thrust", "more thrust", "setpoint on the floor", "setpoint above"],
)
def test_a_way_down_that_is_spent_ends_without_a_lock(
    known: str, changes: dict[str, Any], spent: bool
) -> None:
    c = context(
        known,
        known == "onboard",
        phase=Phase.ABORTED,
        diagnosis=VehicleDiagnosis.LANDING_UNCONFIRMED,
        **changes,
    )
    _, command = PHASES[Phase.ABORTED].act(c)
    assert isinstance(command, StopMotors if spent else Idle)


@pytest.mark.parametrize(("acc_z_g", "stands"), [(0.93, True), (0.8, True), (0.55, False)])
def test_a_floor_that_was_felt_is_one_unless_it_falls_with_its_thrust(
    acc_z_g: float, stands: bool
) -> None:
    """On half of the hover thrust: in the air the accelerometer reads half a g."""
    half = 0.5 * HOVER_THRUST
    aside = DeadReckoningState(
        imu_at_last_update=ImuMotion(t_s=NOW_S - 0.01), velocity_world_mps=(0.8, 0.0, 0.0)
    )
    c = context(
        "imu", z_m=0.02, tel={"acc_z_g": acc_z_g, "thrust": half},
        floor_detected_at_s=NOW_S - 0.5, last_commanded_raw_thrust=half, dead_reckoning=aside,
    )  # fmt: skip
    state, command = descent.act_in_landing(c)
    assert (state.descent.floor_detected_at_s is not None) is stands
    assert isinstance(command, RawThrust)
    assert (command.pitch_rad == 0.0) is stands  # tilted on the floor, it would slide


@pytest.mark.parametrize(("impact_mps", "floor"), [(-0.3, True), (0.3, False)])
def test_a_blow_from_below_is_the_floor_s_only_if_it_sank(impact_mps: float, floor: bool) -> None:
    """A vehicle that climbs, just after the lift-off, has not met the floor."""
    imu = ImuMotion(t_s=NOW_S - 0.01, last_impact_or_bounce_at_s=NOW_S - 0.05)
    struck = DeadReckoningState(
        imu_at_last_update=imu, climb_rate_before_newest_impact_mps=impact_mps
    )
    c = context("imu", z_m=0.15, dead_reckoning=struck)
    c = Context(
        replace(c.state, belief=c.belief.with_observation(replace(c.obs, imu=imu), c.profile))
    )
    state, _ = descent.act_in_landing(c)
    assert (state.descent.floor_detected_at_s is not None) is floor


@pytest.mark.parametrize(("vz_mps", "stops"), [(-0.35, False), (-0.05, True), (0.2, False)])
def test_below_5_cm_it_stops_only_at_rest(vz_mps: float, stops: bool) -> None:
    """The height may be wrong by as much: what sinks still is not on the floor, nor what climbs,
    as where the landing is ordered just after the lift-off."""
    sinks = {"velocity_mps": (0.0, 0.0, vz_mps)}
    c = context("sight", z_m=0.0, tel=sinks, last_commanded_raw_thrust=0.9 * HOVER_THRUST)
    assert isinstance(descent.act_in_landing(c)[1], StopMotors if stops else RawThrust)


# --- What pictures and accelerometer agree on ---------------------------------------------------


@given(
    wrong_rad=st.floats(-0.1, 0.1),
    wind_g=st.floats(-0.09, 0.09),
    heading_rad=st.floats(-3.1, 3.1),
    age_s=st.sampled_from([0.05, 2.0, 7.0]),
    true_for_s=st.sampled_from([0.0, 1.0, 4.0, 30.0]),
)
def test_level_is_against_the_wind_and_the_error_of_the_attitude(
    wrong_rad: float, wind_g: float, heading_rad: float, age_s: float, true_for_s: float
) -> None:
    """An attitude that is 0.02 rad wrong makes 0.2 m/s of speed a second. In a wind the estimate
    takes for a tilt, both cancel, and the level that it reads is what stands against the wind. A
    position of less than 4 s has taught only a part of it; the rest is what pictures show."""
    acceleration_bias_mps2 = 9.81 * wrong_rad
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    imu, reads_mps2 = ImuMotion(t_s=NOW_S - 0.01), 9.81 * wind_g
    dead_reckoning = DeadReckoningState(
        imu_at_last_update=imu,
        acceleration_bias_world_mps2=(
            acceleration_bias_mps2 * cos,
            acceleration_bias_mps2 * sin,
            0.0,
        ),
        mean_specific_force_world_xy_mps2=(reads_mps2 * cos, reads_mps2 * sin),
        time_under_position_control_s=true_for_s,
    )
    c = context("imu", dead_reckoning=dead_reckoning, tel={"yaw_rad": heading_rad})
    felt = VisualInertialMotion(
        NOW_S - age_s, (0.0, 0.0), dead_reckoning.acceleration_bias_world_mps2[:2], 0.0
    )
    c = context_at(c.state, replace(c.obs, imu=imu, visual_inertial_motion=felt), c.profile)
    command = descent.act_in_landing(c)[1]
    assert isinstance(command, RawThrust)
    assert command.roll_rad == pytest.approx(0.0, abs=1e-9)
    known = min(1.0, true_for_s / 4.0)
    shown = max(0.0, 1.0 - age_s / 6.0)
    against_rad = math.atan((known + (1.0 - known) * shown) * wrong_rad - known * wind_g)
    assert command.pitch_rad == pytest.approx(against_rad, abs=1e-9)


def test_the_felt_speed_is_braked_whatever_the_estimate_says() -> None:
    c = context(
        "imu", dead_reckoning=DeadReckoningState(imu_at_last_update=ImuMotion(t_s=NOW_S - 0.03))
    )
    motion = VisualInertialMotion(NOW_S - 0.01, (0.3, 0.0), (0.0, 0.0), 0.0)
    obs = replace(c.obs, visual_inertial_motion=motion, imu=replace(c.obs.imu, t_s=NOW_S - 0.01))
    state = observing(c.state, obs, c.profile)
    assert state.belief.dead_reckoning.velocity_world_mps[:2] == (0.3, 0.0)
    later = replace(obs, imu=replace(obs.imu, t_s=NOW_S + 0.01))  # the same motion again
    moved = remembering(
        state,
        dead_reckoning=replace(state.belief.dead_reckoning, velocity_world_mps=(0.1, 0.0, 0.0)),
    )
    assert observing(moved, later, c.profile).belief.dead_reckoning.velocity_world_mps[0] < 0.2


@pytest.mark.parametrize(("phase", "since_s", "is_there"), [
    (Phase.PERCH, 1.0, True), (Phase.PERCH, 0.1, False), (Phase.LANDING, 1.0, False),
])  # fmt: skip
def test_what_carries_it_near_its_only_position_is_the_target(
    phase: Phase, since_s: float, is_there: bool
) -> None:
    """Late pictures show it lower. On its way down the floor carries it, too."""
    c = context("sight", phase=phase, condition_start_times_s={IMU_SHOWS_SUPPORT: NOW_S - since_s})
    dead_reckoning = replace(c.state.belief.dead_reckoning, gear_below_target_m=0.1)
    state = observing(remembering(c.state, dead_reckoning=dead_reckoning), c.obs, c.profile)
    assert (state.belief.dead_reckoning.gear_below_target_m == 0.0) is is_there


@pytest.mark.parametrize("later_s", [0.0, 0.5])
def test_late_pictures_have_led_the_height_astray_too(later_s: float) -> None:
    """Its vertical speed is what they tell with the right delay, and the floor may be near."""
    dead_reckoning = DeadReckoningState(
        imu_at_last_update=ImuMotion(t_s=NOW_S - 0.03), velocity_world_mps=(0.0, 0.0, -0.7)
    )
    c = context("imu", dead_reckoned_height_m=2.0, dead_reckoning=dead_reckoning)
    motion = VisualInertialMotion(NOW_S - 0.01, (0.0, 0.0), (0.0, 0.0), -0.4)
    obs = replace(
        c.obs,
        visual_inertial_motion=motion,
        camera_imu_mismatch=CameraImuMismatch(later_s) if later_s else None,
    )
    obs = replace(obs, imu=replace(obs.imu, t_s=NOW_S))
    state = observing(c.state, obs, c.profile)
    assert state.belief.dead_reckoning.velocity_world_mps[2] == pytest.approx(
        -0.4 if later_s else -0.7, abs=0.05
    )
    state = remembering(
        state,
        dead_reckoning=replace(state.belief.dead_reckoning, velocity_world_mps=(0.0, 0.0, -0.4)),
    )
    _, command = descent.act_in_landing(context_at(state, obs, c.profile))
    assert isinstance(command, RawThrust)
    assert (command.thrust > 0.97 * HOVER_THRUST) is (later_s > 0.0)


@pytest.mark.parametrize("behind_s", [0.0, 0.05, 0.5, 5.0])
def test_without_the_state_block_pictures_measure_the_climb_rate(behind_s: float) -> None:
    """Seed 2612011437: the accelerometer alone was wrong by 0.25 m/s after three seconds."""
    dead_reckoning = DeadReckoningState(
        imu_at_last_update=ImuMotion(t_s=NOW_S - 0.03), velocity_world_mps=(0.0, 0.0, -0.7)
    )
    c = context("imu", dead_reckoning=dead_reckoning, tel={"behind_s": behind_s})
    motion = VisualInertialMotion(NOW_S - 0.01, (0.0, 0.0), (0.0, 0.0), -0.95)
    obs = replace(c.obs, visual_inertial_motion=motion, imu=replace(c.obs.imu, t_s=NOW_S))
    climb_mps = observing(c.state, obs, c.profile).belief.climb_mps
    is_old = behind_s > c.profile.safety.proof_age_s
    assert climb_mps == pytest.approx(-0.95 if is_old else -0.7, abs=0.05)


@pytest.mark.parametrize("diverged", [False, True])
def test_positions_that_have_diverged_place_the_floor_anywhere(diverged: bool) -> None:
    """Seed 20591183: late motion capture placed the floor 0.9 m too low, and the vehicle struck it
    at the speed that is meant for free air."""
    dead_reckoning = DeadReckoningState(
        imu_at_last_update=ImuMotion(t_s=NOW_S), velocity_world_mps=(0.0, 0.0, -0.4)
    )
    c = context(
        "imu",
        dead_reckoned_height_m=2.0,
        dead_reckoning=dead_reckoning,
        is_position_diverged=diverged,
    )
    _, command = descent.act_in_landing(c)
    assert isinstance(command, RawThrust)
    assert (command.thrust > 0.97 * HOVER_THRUST) is diverged


@pytest.mark.parametrize("hung", [0.9, 1.1])
@pytest.mark.parametrize("positioning", PROFILES)
def test_after_a_hang_everything_from_before_is_stale(positioning: str, hung: float) -> None:
    """Whoever notices: what was debounced before begins anew, a catch is over, and a sight of
    before is none."""
    profile, stale = PROFILES[positioning], hung > 1.0
    state = remembering(
        state_in(Phase.LANDING, z_m=MIN_HEIGHT_TO_INFER_HANGING_M),
        last_telemetry=telemetry(NOW_S, MIN_HEIGHT_TO_INFER_HANGING_M),
        fall_catch_setpoint_above_vehicle_m=1.0,
        condition_start_times_s={MOTORS_OFF_AS_COMMANDED: 0.0, BATTERY_LOW: 1.0},
    )  # fmt: skip
    later_s = NOW_S + hung * profile.positioning.hold_s
    off = {"thrust": 0.0, "supervisor": READY, "battery_state": LOW_POWER}
    obs = observation(later_s, telemetry=telemetry(later_s, MIN_HEIGHT_TO_INFER_HANGING_M, **off))
    after = observing(state, obs, profile)
    assert after.belief.condition_start_times_s[MOTORS_OFF_AS_COMMANDED] == (
        later_s if stale else 0.0
    )
    assert after.belief.condition_start_times_s[BATTERY_LOW] == 1.0
    assert (after.fall_catch_setpoint_above_vehicle_m is None) is stale
    # The setpoint of a catch is far above, and would press; any other is held.
    assert (after.setpoint is None) is stale
    held = remembering(state, fall_catch_setpoint_above_vehicle_m=None)
    assert observing(held, obs, profile).setpoint == held.setpoint
    if positioning == "target":
        assert (after.belief.dead_reckoning_began_at_s is not None) is stale


# --- Where it is, in the end --------------------------------------------------------------------

UNMOVED, UNRECKONED = ImuMotion(t_s=NOW_S), DeadReckoningState()


def ended(
    magnet_reach_entered_at_s: float | None = None,
    imu: ImuMotion = UNMOVED,
    dead_reckoning: DeadReckoningState = UNRECKONED,
    floor_detected_at_s: float | None = None,
    profile: Profile = BY_TARGET,
    **observed: Any,
) -> RestState:
    seen = {"target": None, "external_position_age_s": 3.0, "imu": imu, **observed}
    obs = at(HANG_Z_M, obs=seen, thrust=0.0, supervisor=READY)(NOW_S)
    state = remembering(
        state_in(Phase.LANDING, NOW_S - 5.0, HANG_Z_M), motor_stop_commanded_at_s=NOW_S - 1.0,
        magnet_reach_entered_at_s=magnet_reach_entered_at_s,
        floor_detected_at_s=floor_detected_at_s,
        dead_reckoning=replace(dead_reckoning, imu_at_last_update=imu),
    )  # fmt: skip
    return rest.find_rest_state(context_at(state, obs, profile))


@pytest.mark.parametrize(
    ("magnet_reach_entered_at_s", "fell_s", "gap_s", "found"),
    [
        (4.0, -math.inf, -math.inf, RestState.HANGS),
        (4.0, 3.0, 3.5, RestState.HANGS),  # before it came there
        (4.0, 6.0, -math.inf, RestState.STANDS),
        (4.0, 6.0, 7.0, RestState.STANDS),
        (4.0, -math.inf, 6.0, RestState.UNKNOWN),
        (None, -math.inf, 6.0, RestState.STANDS),
    ],
)
def test_what_was_in_reach_and_has_not_fallen_since_hangs(
    magnet_reach_entered_at_s: float | None, fell_s: float, gap_s: float, found: RestState
) -> None:
    assert (
        ended(
            magnet_reach_entered_at_s,
            ImuMotion(
                t_s=NOW_S, last_fall_at_s=fell_s, last_gap_that_may_hide_fall_ended_at_s=gap_s
            ),
        )
        is found
    )


@pytest.mark.parametrize("by_target", [True, False])
@pytest.mark.parametrize("restarted_s", [-2.0, -5.5])
@pytest.mark.parametrize(("seen_s", "found"), [(-5.8, RestState.UNKNOWN), (-1.0, RestState.STANDS)])
def test_after_a_restart_only_a_new_sighting_shows_the_floor(
    by_target: bool, restarted_s: float, seen_s: float, found: RestState
) -> None:
    """Its estimate is at the origin again, so the target on which it hangs seemed far above, and it
    was reported to be on the floor (seed 2612021214)."""
    restarted = ImuMotion(
        t_s=NOW_S,
        vehicle_restarted_at_s=NOW_S + restarted_s,
        last_gap_that_may_hide_fall_ended_at_s=NOW_S + restarted_s,
    )
    assert (
        ended(
            NOW_S - 6.0,
            restarted,
            DeadReckoningState(
                last_telemetry_gap_in_magnet_reach_ended_at_s=NOW_S + restarted_s,
                last_sighting_at_s=NOW_S + seen_s,
            ),
            profile=BY_TARGET if by_target else PROFILE,
            target=target_at(NOW_S, (0.0, 0.0, CEILING_M), (0.0, 0.0, 0.0)),
            external_position_age_s=0.01,
        )
        is found
    )


@pytest.mark.parametrize("part", [0.35, 1.0])
def test_what_hangs_stays_in_reach_however_the_accelerometer_drifts(part: float) -> None:
    """On a thrust that does not carry it, it hangs; on hover thrust a slow sink leads away (seed
    20591162: ten seconds in its own landing, by a state block that had died)."""
    feels = Felt().at_rest(BEGIN_S - 0.1)

    def look(t_s: float) -> Observation:
        shakes_rad = 1e-4 * math.sin(40.0 * t_s)  # no reading stands still
        tel = {"thrust": part * HOVER_THRUST, "acc_z_g": 0.99, "behind_s": 5.0}
        unseen = {"target": None, "has_new_frame": False}
        return at(HANG_Z_M, obs=unseen, roll_rad=shakes_rad, **tel)(t_s)

    begun = remembering(
        state_in(Phase.LANDING, BEGIN_S, HANG_Z_M), stop_or_land_command_count=6,
        last_stop_or_land_command_at_s=BEGIN_S,
        magnet_reach_entered_at_s=BEGIN_S - 1.0,
        dead_reckoning=DeadReckoningState(gear_below_target_m=0.0),
    )  # fmt: skip
    state = fly(begun, look, 8.0, feels=feels).state
    assert (state.belief.magnet_reach_entered_at_s is not None) is (part < 1.0)


@pytest.mark.parametrize("magnet_reach_entered_at_s", [None, NOW_S - 2.0])
def test_a_silence_that_may_have_brought_it_to_the_magnet_leaves_it_unknown(
    magnet_reach_entered_at_s: float | None,
) -> None:
    """Whether it counted as in reach since or not: it may have met the floor meanwhile, too. A
    sight or a floor that was felt afterwards tells."""
    silence = DeadReckoningState(last_telemetry_gap_in_magnet_reach_ended_at_s=NOW_S - 3.0)
    assert ended(magnet_reach_entered_at_s, dead_reckoning=silence) is RestState.UNKNOWN
    assert (
        ended(magnet_reach_entered_at_s, dead_reckoning=silence, floor_detected_at_s=NOW_S - 1.5)
        is RestState.STANDS
    )
    seen = replace(silence, last_sighting_at_s=NOW_S - 2.5)
    told = RestState.STANDS if magnet_reach_entered_at_s is None else RestState.HANGS
    assert ended(magnet_reach_entered_at_s, dead_reckoning=seen) is told


@pytest.mark.parametrize(
    ("phase", "gear_below_target_m"), [(Phase.PERCH, math.inf), (Phase.ASCEND, 0.02)]
)
def test_what_the_watchdog_let_hang_hangs_though_the_loop_never_saw_it(
    phase: Phase, gear_below_target_m: float
) -> None:
    """The loop comes back after 11 s, and the motors stand still already."""
    seen = {"target": None, "external_position_age_s": 11.0, "imu": UNMOVED}
    obs = at(3.0, obs=seen, thrust=0.0, supervisor=READY)(NOW_S)
    before = state_in(phase, NOW_S - 11.0, HANG_Z_M)
    before = remembering(
        before, dead_reckoning=DeadReckoningState(UNMOVED, gear_below_target_m=gear_below_target_m)
    )
    entered = remembering(before, phase=Phase.LANDING, entered_s=NOW_S, t_s=NOW_S)
    new = descent.enter_descent(
        context_at(entered, obs, BY_TARGET).state, context_at(before, obs, BY_TARGET).state
    )
    assert new.motor_stop_commanded_at_s == NOW_S
    assert rest.find_rest_state(context_at(new, obs, BY_TARGET)) is RestState.HANGS


def test_a_target_seen_far_above_tells_that_it_stands() -> None:
    silent = ImuMotion(t_s=NOW_S, last_gap_that_may_hide_fall_ended_at_s=6.0)
    for z_m, found in ((CEILING_M - 1.0, RestState.STANDS), (HANG_Z_M, RestState.UNKNOWN)):
        target = target_at(NOW_S, body_m=(0.0, 0.0, z_m))
        assert ended(4.0, silent, target=target) is found


# --- No state that can be reached breaks these ---------------------------------------------------

BIT = st.fixed_dictionaries(
    {
        "ticks": st.integers(1, 25),
        "z_m": st.sampled_from([-0.2, 0.02, 0.3, 1.0, HANG_Z_M - 0.05, HANG_Z_M]),
        "climb_mps": st.sampled_from([0.0, 0.0, -0.3, -1.5, 0.4]),
        "acc_z_g": st.sampled_from([1.0, 1.0, 1.1, 0.3, 0.0]),
        "thrust": st.sampled_from([0.0, 1000.0, 20000.0, 33000.0, HOVER_THRUST, 65535.0]),
        "supervisor": st.sampled_from([AIRBORNE, AIRBORNE, READY, AIRBORNE | HL_ACTIVE]),
        "age_s": st.sampled_from([0.01, 0.01, 0.15, 0.3, 0.7]),
        "behind_s": st.sampled_from([0.0, 0.0, 0.5]),
        "external_position_age_s": st.sampled_from([0.02, 0.02, 0.6, 2.0, math.inf]),
        "target": st.sampled_from(["seen", "unseen", "none"]),
        "once": st.sampled_from(
            [
                {},
                {},
                {"has_estimated_position_jumped": True},
                {"has_estimated_position_jumped": True, "heading_jump_rad": 1.5},
                {"tick_start_delay_s": 1.2},
                {"link_problem": "gone"},
                {"operator_request": OperatorRequest.LAND},
            ]
        ),
    }
)
BITS = st.lists(BIT, min_size=1, max_size=5)
REMEMBERED = st.sampled_from(
    [
        {},
        {"vehicle_world_z_at_last_contact_m": HANG_Z_M, "magnet_reach_entered_at_s": 9.0},
        {
            "vehicle_world_z_at_last_contact_m": HANG_Z_M,
            "magnet_reach_entered_at_s": 9.0,
            "weight_transfer_began_at_s": 9.9,
        },
        {
            "vehicle_world_z_at_last_contact_m": HANG_Z_M,
            "magnet_reach_entered_at_s": 9.0,
            "weight_transfer_began_at_s": 9.0,
            "motor_stop_commanded_at_s": 9.8,
            "stop_or_land_command_count": 2,
        },
        {"fall_catch_setpoint_above_vehicle_m": 1.0},
        {"must_end_press": True},
        {"hover_thrust": 0.0},
        {"dead_reckoning_began_at_s": 9.0, "dead_reckoned_height_m": 1.0},
    ]
)


def began(phase: Phase, remembered: dict[str, Any], profile: Profile) -> PlannerState:
    """In that phase; a way down has begun as it does."""
    flies = state_in(Phase.ALIGN if phase is Phase.LANDING else phase, z_m=1.0)
    state = remembering(flies, hover_thrust=remembered.get("hover_thrust", HOVER_THRUST))
    if phase is Phase.LANDING:
        state = descent.begin_landing(context_at(state, observation(NOW_S, 1.0), profile).state)
    return remembering(state, **{k: v for k, v in remembered.items() if k != "hover_thrust"})


def observed(bits: list[dict[str, Any]]) -> Iterator[Observation]:
    felt, t_s = Felt(), NOW_S
    for bit in bits:
        for i in range(bit["ticks"]):
            t_s += TICK_S
            tel = telemetry(
                t_s - bit["age_s"], bit["z_m"], velocity_mps=(0.0, 0.0, bit["climb_mps"]),
                acc_z_g=bit["acc_z_g"], thrust=bit["thrust"], supervisor=bit["supervisor"],
                behind_s=bit["behind_s"],
            )  # fmt: skip
            seen = bit["target"] == "seen"
            target = target_at(
                t_s, body_m=tel.position_m, is_measured_in_newest_frame=seen, tracked=seen
            )
            yield felt(
                observation(
                    t_s, telemetry=tel, target=None if bit["target"] == "none" else target,
                    has_new_frame=seen, external_position_age_s=bit["external_position_age_s"],
                    **(bit["once"] if i == 0 else {}),
                )
            )  # fmt: skip


@settings(max_examples=60)
@given(
    positioning=st.sampled_from(sorted(PROFILES)),
    phase=st.sampled_from(sorted(PRE_LANDING_PHASES,
        key=lambda p: p.value)) | st.just(Phase.LANDING),
    remembered=REMEMBERED, bits=BITS, alone=st.booleans(),
)  # fmt: skip
def test_nothing_climbs_but_a_catch_and_severity_only_rises(
    positioning: str, phase: Phase, remembered: dict[str, Any], bits: list[Any], alone: bool
) -> None:
    """`alone`: without the mission's table, as watchdog and rescue fly it. By the target no landing
    of its own is ordered: it would go by an estimate that rests on pictures."""
    profile = PROFILES[positioning]
    state = began(phase, remembered, profile)
    for obs in observed(bits):
        before, step = state, descent.step_landing if alone else planner.step_mission
        state, command = step(before, obs, profile)
        assert profile is not BY_TARGET or not isinstance(command, Land)
        if state.phase.is_final:
            return
        if Phase.LANDING not in (before.phase, state.phase):
            continue
        assert state.severity >= before.severity
        z_m, takeoff_position_m = obs.telemetry.position_m[2], state.belief.takeoff_position_m
        floor_m = takeoff_position_m[2] if takeoff_position_m else 0.0
        if (
            isinstance(command, PositionSetpoint)
            and state.fall_catch_setpoint_above_vehicle_m is None
            and before.phase is state.phase
        ):
            assert command.z_m <= max(z_m, floor_m + 0.05) + 1e-9
        if isinstance(command, Land):
            assert command.height_m < z_m
