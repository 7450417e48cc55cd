"""Compute the belief one tick later: `update_belief(belief, observation, command_history,
profile)`.

    observation ──> target, gaps, jumps, heading, thrust
                                    │
                                    v
                  dead reckoning ──> offset from the target, magnet's reach
                                    │
                                    v
                  start times of conditions ──> hover thrust, battery, mounting

Conditions use the hover thrust of the previous tick, so that a press cannot change the reference
that proves it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from perchctl.mission.belief import hover
from perchctl.mission.belief.battery import update_battery_fit_from_telemetry
from perchctl.mission.belief.belief import ESTIMATE_SETTLING_TIME_AFTER_POSITIONS_RETURN_S, Belief
from perchctl.mission.belief.contact import (
    HANGING_CONFIRMATION_DWELL_S,
    IMU_SHOWS_SUPPORT,
    MAX_HEIGHT_TO_COUNT_AS_STANDING_BEFORE_TAKEOFF_M,
    MAX_RAW_THRUST_APPLIED_BY_FIRMWARE,
    MOTORS_OFF_AS_COMMANDED,
    SUPPORT_CONDITIONS,
    is_evidence_fresh,
    is_flying_at_hover_thrust,
    is_thrust_too_low_to_fly,
)
from perchctl.mission.belief.evidence import (
    Condition,
    keep_start_times_across_phases,
    update_condition_start_times,
)
from perchctl.mission.belief.lateral_offset import LateralMotionSample
from perchctl.mission.belief.maneuver import CommandHistory
from perchctl.mission.belief.motion import ZERO_VECTOR, Vector
from perchctl.mission.belief.mounting import (
    CameraMountingMonitor,
    make_camera_mounting_sample,
    update_camera_mounting_monitor,
)
from perchctl.mission.belief.quality import QUALITY_CONDITIONS, hold_reason
from perchctl.mission.belief.reckoning import (
    MAGNET_REACH_BELOW_TARGET_M,
    MAX_HEIGHT_INTEGRATION_STEP_S,
    MAX_SAMPLE_INTERVAL_TO_DETECT_POSITION_STEP_S,
    DeadReckoningState,
    accumulate_unexplained_position_step,
    advance_dead_reckoning,
    learn_acceleration_bias_at_rest,
    learn_estimated_velocity_bias,
    restart_dead_reckoning_at_sighting,
    restart_velocity_bias_filters,
)
from perchctl.mission.observation import Observation
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import FULL_THRUST, Command, Idle, PositionSetpoint, RawThrust

BELIEF_CONDITIONS = (*SUPPORT_CONDITIONS, *QUALITY_CONDITIONS)
"""All conditions that are evaluated on the belief."""
MAX_GEAR_BELOW_TARGET_TO_COUNT_AS_HELD_BY_TARGET_M = 0.3
"""Distance of the gear below the target within which it must be the target that supports the
vehicle, m."""
MOTIONLESS_AT_CONTACT_DWELL_S = 0.3
"""Time for which a vehicle at its contact must be still to count as at rest, s."""
SAMPLE_INTERVAL_UPPER_CLAMP_IN_FILTERS_S = 0.1
"""Longest time that a single sample may represent in the filters of hover thrust and tilt, s.
Larger: after a gap, a single sample has the weight of many."""
MAX_REPORTED_THRUST_DEVIATION_FRACTION_IF_COMMAND_FOLLOWED = 0.12
"""Difference between commanded and reported thrust that no ramp can cause, as a fraction of full
thrust."""
COMMANDED_KEEPALIVE_RAW_THRUST = 1000
"""Raw thrust, 0..65535, that does not turn the motors but still satisfies the setpoint watchdog."""
MEAN_THRUST_DIRECTION_TIME_CONSTANT_S = 0.5
"""Time constant of the mean tilt, s. Larger: a gust, or a changing error of the estimated attitude,
moves the vehicle off the target's axis. Smaller: feedback of the tilt no longer damps the
motion."""
RECENT_MAX_TARGET_SHIFT_DECAY_FACTOR_PER_PICTURE = 0.9
"""Fraction of the target's scatter that remains after each frame."""


def update_belief(
    belief: Belief, obs: Observation, command_history: CommandHistory, profile: Profile
) -> Belief:
    """Return the belief after one more observation; `command_history` holds the planner's commands
    so far.

    A wrong observation makes the belief wrong for up to a few seconds, until the filters forget it.
    """
    b = replace(
        belief,
        obs=obs,
        profile=profile,
        command_history=command_history,
        world_frame_shift_in_tick_m=ZERO_VECTOR,
    )
    sample = LateralMotionSample(
        obs.telemetry.t_s, b.acceleration_from_tilt_world_xy_mps2, b.velocity_world_mps[:2]
    )
    b = replace(b, lateral_offset_filter=b.lateral_offset_filter.with_sample(sample))
    b = _update_target(b)
    if has_tick_gap(belief, obs, profile):
        b = _reset_conditions_after_tick_gap(b)
    if b.is_position_stale:
        b = replace(b, position_last_stale_at_s=obs.t_s)
    if obs.has_estimated_position_jumped:
        b = _shift_stored_positions_after_frame_jump(b)
    if obs.heading_jump_rad > math.radians(profile.safety.heading_lost_deg):
        b = replace(b, is_heading_lost=True, hover_thrust_estimate=hover.estimate_hover_thrust(b))
    b = _compare_thrust_with_command(b)
    b = _update_dead_reckoning(b)
    comes_down = (
        command_history.maneuver.descends_to_floor
        and command_history.is_before_weight_transfer_and_motor_stop
    )
    if comes_down and b.dead_reckoning_began_at_s is None and b.has_only_imu_for_descent:
        b = start_dead_reckoning(b)
    return _update_estimators(b)


def has_tick_gap(belief: Belief, obs: Observation, profile: Profile) -> bool:
    """True if more than `positioning.hold_s`, the longest time for which positions may be missing,
    has passed since the planner's last tick."""
    return belief.last_telemetry is not None and obs.t_s - belief.t_s > profile.positioning.hold_s


def start_dead_reckoning(b: Belief) -> Belief:
    """Return the belief switched permanently to dead reckoning from accelerometer and attitude,
    which starts at the present height and with the present estimate of the hover thrust."""
    return replace(
        b,
        dead_reckoning_began_at_s=b.obs.t_s,
        dead_reckoned_height_m=b.height_m,
        hover_thrust_estimate=hover.estimate_hover_thrust(b),
    )


def reset_phase_dependent_conditions(b: Belief) -> Belief:
    """Return the belief after a change of maneuver: the times since when conditions have been true
    are forgotten, except for conditions that persist across phases."""
    return replace(
        b, condition_start_times_s=keep_start_times_across_phases(b.condition_start_times_s)
    )


def update_thrust_check_after_command(b: Belief, command: Command) -> Belief:
    """Return the belief after `command` was sent. The belief keeps the time since which the
    reported thrust has differed from the commanded raw thrust if `command` is a raw thrust or
    `Idle`, and forgets it after any other command."""
    if isinstance(command, (RawThrust, Idle)):
        return b
    return replace(b, thrust_began_to_differ_from_command_at_s=None)


# --- Direct consequences of the observation ---


def _update_target(b: Belief) -> Belief:
    """Return the belief after a frame that measured the target, with the target's position in the
    world, the scatter of its recent measured positions, m, the filtered lateral offset, and the
    vehicle's velocity from pictures. In a tick without such a frame, the belief is unchanged."""
    target = b.obs.target
    if not b.obs.has_new_frame or target is None or not target.is_measured_in_newest_frame:
        return b
    b = replace(b, visual_velocity_filter=b.visual_velocity_filter.with_detection(target))
    if target.measured_gear_to_target_world_m is not None and math.isfinite(
        target.measured_gear_to_target_sigma_m
    ):
        x_m, y_m, _ = target.measured_gear_to_target_world_m.tolist()
        filtered = b.lateral_offset_filter.with_picture_measurement(
            target.last_measured_at_s, (x_m, y_m), target.measured_gear_to_target_sigma_m
        )
        b = replace(b, lateral_offset_filter=filtered)
    if target.world_m is None:
        return b
    spread_m = 0.0
    if b.last_target_position_world_m is not None:
        moved_m = float(np.linalg.norm(target.world_m - b.last_target_position_world_m))
        spread_m = max(
            moved_m,
            RECENT_MAX_TARGET_SHIFT_DECAY_FACTOR_PER_PICTURE
            * b.recent_max_target_world_shift_between_pictures_m,
        )
    return replace(
        b,
        last_target_position_world_m=target.world_m,
        recent_max_target_world_shift_between_pictures_m=spread_m,
    )


def _reset_conditions_after_tick_gap(b: Belief) -> Belief:
    """Return the belief after a gap in which the planner did not run: the times since when
    conditions have been true are forgotten, except for conditions that persist across phases.
    Motors that are off as commanded count as off since the end of the last gap in the telemetry, or
    since a later time at which they stopped. With the target as the only position source, the
    position counts as stale in this tick."""
    imu = b.obs.imu
    kept: dict[Condition[Any], float] = keep_start_times_across_phases(b.condition_start_times_s)
    off_s = max(imu.motors_stopped_at_s, imu.last_telemetry_gap_ended_at_s)
    if MOTORS_OFF_AS_COMMANDED in b.condition_start_times_s and math.isfinite(off_s):
        # All samples from the gap have arrived, and the motors are off in each. If this condition
        # restarted as well, a loop with a gap in every tick would never see the end of a landing.
        kept[MOTORS_OFF_AS_COMMANDED] = max(
            off_s, b.condition_start_times_s[MOTORS_OFF_AS_COMMANDED]
        )
    return replace(
        b,
        condition_start_times_s=kept,
        position_last_stale_at_s=b.obs.t_s
        if b.is_target_position_source
        else b.position_last_stale_at_s,
    )


def _shift_stored_positions_after_frame_jump(b: Belief) -> Belief:
    """Return the belief after a jump of the estimated position, which has moved the estimate's
    world frame but not the vehicle.

    The stored positions (take-off, height of the contact, start of the maneuver) are shifted with
    the frame, so that they stay in place relative to the vehicle. They are not shifted if samples
    are missing before the jump, since the vehicle itself may have moved, or if external positions
    have just returned and the jump ends a drift. In all cases, the setpoint moves to the vehicle's
    new position and heading; with a recorded contact, it keeps its height, shifted with the frame.
    """
    obs, last = b.obs, b.last_telemetry
    first_estimate_jump_at_s = (
        obs.t_s if b.first_estimate_jump_at_s is None else b.first_estimate_jump_at_s
    )
    if last is None:
        return replace(b, first_estimate_jump_at_s=first_estimate_jump_at_s)
    tel = obs.telemetry
    x, y, z = tel.position_m
    vx, vy, vz = tel.velocity_mps
    dt_s = tel.t_s - tel.behind_s - (last.t_s - last.behind_s)
    lx, ly, lz = last.position_m
    moved_m = (x - lx - vx * dt_s, y - ly - vy * dt_s, z - lz - vz * dt_s)
    returns = (
        b.position_last_stale_at_s is not None
        and obs.t_s - b.position_last_stale_at_s <= ESTIMATE_SETTLING_TIME_AFTER_POSITIONS_RETURN_S
    )
    if dt_s > MAX_SAMPLE_INTERVAL_TO_DETECT_POSITION_STEP_S or returns:
        moved_m = (0.0, 0.0, 0.0)
    setpoint = b.command_history.setpoint
    if setpoint is not None:
        z_m = z if b.vehicle_world_z_at_last_contact_m is None else setpoint.z_m + moved_m[2]
        setpoint = PositionSetpoint(x, y, z_m, tel.yaw_rad)
    return replace(
        b,
        dead_reckoning=restart_velocity_bias_filters(b.dead_reckoning),
        takeoff_position_m=None
        if b.takeoff_position_m is None
        else _translate(b.takeoff_position_m, moved_m),
        vehicle_world_z_at_last_contact_m=None
        if b.vehicle_world_z_at_last_contact_m is None
        else b.vehicle_world_z_at_last_contact_m + moved_m[2],
        command_history=b.command_history.with_frame_shift(setpoint, moved_m),
        world_frame_shift_in_tick_m=moved_m,
        first_estimate_jump_at_s=first_estimate_jump_at_s,
    )


def _translate(position_m: Vector, shift_m: Vector) -> Vector:
    return (position_m[0] + shift_m[0], position_m[1] + shift_m[1], position_m[2] + shift_m[2])


def _compare_thrust_with_command(b: Belief) -> Belief:
    """Return the belief after comparing the reported thrust with the commanded raw thrust;
    unchanged if no raw thrust is commanded. `thrust_began_to_differ_from_command_at_s` is the loop
    time since which the two have differed by more than
    `MAX_REPORTED_THRUST_DEVIATION_FRACTION_IF_COMMAND_FOLLOWED` of full thrust, None while they
    agree. If the difference has lasted too long for the reported thrust to be reliable,
    `thrust_last_differed_from_command_at_s` becomes the present time."""
    order = b.command_history.commanded_raw_thrust
    if order is None:
        return b
    wanted = (
        0.0
        if order < COMMANDED_KEEPALIVE_RAW_THRUST
        else min(MAX_RAW_THRUST_APPLIED_BY_FIRMWARE, order)
    )
    apart = (
        abs(b.telemetry.thrust - wanted)
        > MAX_REPORTED_THRUST_DEVIATION_FRACTION_IF_COMMAND_FOLLOWED * FULL_THRUST
    )
    since_s = (
        b.obs.t_s
        if b.thrust_began_to_differ_from_command_at_s is None
        else b.thrust_began_to_differ_from_command_at_s
    )
    b = replace(b, thrust_began_to_differ_from_command_at_s=since_s if apart else None)
    return (
        b
        if b.is_reported_thrust_reliable
        else replace(b, thrust_last_differed_from_command_at_s=b.obs.t_s)
    )


# --- Dead reckoning ---


def _update_dead_reckoning(b: Belief) -> Belief:
    """Return the belief with three fields advanced by one tick: `dead_reckoning`;
    `magnet_reach_entered_at_s`, the time at which the gear came within the magnet's reach; and
    `dead_reckoned_height_m`, which changes only once dead reckoning has replaced the position."""
    new = _integrate_dead_reckoning(b)
    new = _zero_reckoned_velocity_at_contact(b, new)
    new = _adopt_visual_inertial_velocity(b, new)
    new = _restart_at_sighting(b, new)
    new = _correct_height_of_supported_vehicle(b, new)
    return replace(
        b,
        dead_reckoning=new,
        magnet_reach_entered_at_s=_find_magnet_reach_entry_time_s(b, new),
        dead_reckoned_height_m=b.dead_reckoned_height_m + _climb_since_last_tick_m(b, new),
    )


def _integrate_dead_reckoning(b: Belief) -> DeadReckoningState:
    """Return the dead reckoning advanced by the newest sample of accelerometer and state estimate.

    The bias of the estimated velocity is learned as well while three conditions are met: the
    vehicle is in free air, the estimate is trusted, and external positions still correct the
    estimated velocity. Otherwise, the low-pass filters for this bias restart. With a deck or motion
    capture, unexplained steps of a trusted position are accumulated.
    """
    obs, source = b.obs, b.profile.positioning.source
    is_estimate_trusted = (
        b.is_position_valid
        and b.is_telemetry_fresh
        and b.dead_reckoning_began_at_s is None
        and b.first_estimate_jump_at_s is None
    )
    new = advance_dead_reckoning(
        b.dead_reckoning,
        obs.imu,
        obs.telemetry,
        is_estimate_trusted=is_estimate_trusted,
        is_position_diverged=b.is_position_diverged and not source.is_target,
        is_estimated_velocity_being_corrected=b.is_estimated_velocity_being_corrected,
        # A motion that no sighting has corrected yet is not a bias of the accelerometer.
        ignores_lateral_estimate=source.is_target and not b.is_estimated_velocity_being_corrected,
    )
    is_in_free_air = (
        b.command_history.maneuver.is_in_free_air
        and b.height_m > MAX_HEIGHT_TO_COUNT_AS_STANDING_BEFORE_TAKEOFF_M
    )
    if (
        is_estimate_trusted
        and b.is_estimated_velocity_being_corrected
        and is_in_free_air
        and b.last_telemetry
    ):
        new = learn_estimated_velocity_bias(new, b.last_telemetry, obs.telemetry)
    else:
        new = restart_velocity_bias_filters(new)
    if b.is_position_trusted and not source.is_target and b.last_telemetry is not None:
        new = accumulate_unexplained_position_step(new, b.last_telemetry, obs.telemetry)
    return new


def _zero_reckoned_velocity_at_contact(b: Belief, new: DeadReckoningState) -> DeadReckoningState:
    """Return the dead reckoning `new`, without vertical speed if the vehicle is at rest at the
    target: the gear is within the magnet's reach, the climb rate has been steady for
    `MOTIONLESS_AT_CONTACT_DWELL_S` without a recent fall, and either a contact is recorded or the
    thrust is too small to fly. Otherwise, `new` is returned unchanged.

    For a vehicle at rest, the lateral velocity becomes zero too, and the acceleration bias is
    learned, if the lateral velocity has also been steady for that time. With the motors off, the
    offset from the target stays that of the previous tick.

    Without this, the accelerometer's bias would move the reckoned position of a hanging vehicle out
    of the magnet's reach within ten seconds.
    """
    obs = b.obs
    rests = (
        obs.t_s - obs.imu.climb_rate_became_steady_at_s >= MOTIONLESS_AT_CONTACT_DWELL_S
        and obs.t_s - obs.imu.last_fall_at_s > HANGING_CONFIRMATION_DWELL_S
    )
    hangs = b.magnet_reach_entered_at_s is not None and is_thrust_too_low_to_fly(b)
    touched = b.vehicle_world_z_at_last_contact_m is not None or hangs
    if not touched or not new.gear_below_target_m < MAGNET_REACH_BELOW_TARGET_M or not rests:
        return new
    is_laterally_unsteady = (
        obs.t_s - obs.imu.lateral_velocity_became_steady_at_s < MOTIONLESS_AT_CONTACT_DWELL_S
    )
    x_mps, y_mps, _ = new.velocity_world_mps
    new = replace(
        new, velocity_world_mps=(x_mps, y_mps, 0.0) if is_laterally_unsteady else (0.0, 0.0, 0.0)
    )
    if not is_laterally_unsteady:
        new = learn_acceleration_bias_at_rest(new, b.dead_reckoning.imu_at_last_update, obs.imu)
    if obs.telemetry.thrust < 1:  # a hanging vehicle stays in place
        old = b.dead_reckoning
        new = replace(
            new,
            gear_to_target_world_xy_m=old.gear_to_target_world_xy_m,
            gear_to_target_sigma_m=old.gear_to_target_sigma_m,
        )
    return new


def _adopt_visual_inertial_velocity(b: Belief, new: DeadReckoningState) -> DeadReckoningState:
    """Return the dead reckoning `new` with the lateral velocity and acceleration bias (world axes)
    of the visual-inertial estimate (`VisualInertialMotion`), on which pictures and accelerometer
    agree. If that estimate is not newer than the sample at which the previous tick's dead reckoning
    ended, `new` is returned unchanged.

    The climb rate is adopted, if known, only in two cases: if the telemetry is old, because the
    accelerometer alone is off by a quarter of a metre per second within three seconds; and if the
    pictures are known to be late, because they then also make the estimated height wrong.
    """
    motion, before = b.obs.visual_inertial_motion, b.dead_reckoning.imu_at_last_update
    if motion is None or not (before is None or motion.t_s > before.t_s):
        return new
    is_estimate_late = b.camera_imu_mismatch.camera_latency_error_s != 0.0
    climb_mps = motion.climb_mps if is_estimate_late or not b.is_telemetry_fresh else None
    climb_mps = new.velocity_world_mps[2] if climb_mps is None else climb_mps
    return replace(
        new,
        velocity_world_mps=(*motion.velocity_world_xy_mps, climb_mps),
        acceleration_bias_world_mps2=(
            *motion.acceleration_bias_world_xy_mps2,
            new.acceleration_bias_world_mps2[2],
        ),
    )


def _restart_at_sighting(b: Belief, new: DeadReckoningState) -> DeadReckoningState:
    """Return the dead reckoning `new`, restarted from the target's position relative to the gear
    after each frame that measured the target. With a deck or motion capture and a valid position,
    it restarts in every tick, since the target's position in the world is known. If the position
    has been stale since the last sighting, such a restart leaves the lateral offset unchanged."""
    obs, target = b.obs, b.obs.target
    if target is None:
        return new
    seen = obs.has_new_frame and target.is_measured_in_newest_frame
    if not seen and not (b.is_position_valid and not b.is_target_position_source):
        return new
    yaw_rad, (ex, ey, ez) = obs.telemetry.yaw_rad, target.e_m
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    sigma_m = float(max(target.sigma_m[:2]))
    gear_to_target_world_xy_m = (float(cos * ex - sin * ey), float(sin * ex + cos * ey))
    if (
        not seen
        and b.position_last_stale_at_s is not None
        and b.position_last_stale_at_s >= target.last_measured_at_s
    ):
        gear_to_target_world_xy_m, sigma_m = (
            new.gear_to_target_world_xy_m,
            new.gear_to_target_sigma_m,
        )
    new = restart_dead_reckoning_at_sighting(
        new, target.last_measured_at_s, gear_to_target_world_xy_m, float(ez), sigma_m
    )
    if seen and target.last_measured_at_s > new.last_unexplained_position_step_at_s:
        new = replace(new, unexplained_position_step_sum_world_xy_m=(0.0, 0.0))
    return new


def _correct_height_of_supported_vehicle(b: Belief, new: DeadReckoningState) -> DeadReckoningState:
    """Return the dead reckoning `new` with the gear at the target's height and no vertical speed if
    accelerometer and thrust have shown for `perch.contact_dwell_s` that something supports the
    vehicle, and `new` places the gear less than
    `MAX_GEAR_BELOW_TARGET_TO_COUNT_AS_HELD_BY_TARGET_M` below the target. This applies only with
    the target as the only position source, and not in a descent.

    Late pictures make the vehicle seem lower than it is, but a vehicle that is supported just below
    the target must be touching it.
    """
    near = (
        b.is_target_position_source
        and not b.command_history.maneuver.descends_to_floor
        and new.gear_below_target_m < MAX_GEAR_BELOW_TARGET_TO_COUNT_AS_HELD_BY_TARGET_M
    )
    if not near or b.true_for_s(IMU_SHOWS_SUPPORT) < b.profile.planner.perch.contact_dwell_s:
        return new
    return replace(
        new,
        gear_below_target_m=min(0.0, new.gear_below_target_m),
        gear_below_target_lower_bound_m=min(0.0, new.gear_below_target_lower_bound_m),
        velocity_world_mps=(*new.velocity_world_mps[:2], 0.0),
    )


def _find_magnet_reach_entry_time_s(b: Belief, new: DeadReckoningState) -> float | None:
    """Return the loop time from which the magnet may have held the vehicle; None if the magnet
    cannot hold the vehicle, because no contact is recorded and either the dead reckoning `new`
    places the gear outside the magnet's reach or the floor was detected.

    The time is that of the first tick within reach, or of a later tick within reach after a fall.
    Once the weight transfer or the motor stop has begun, it does not change.
    """
    magnet_reach_entered_at_s = b.magnet_reach_entered_at_s
    # once the weight transfer or the motor stop has begun, the vehicle does not move into or out of
    # the magnet's reach
    if not b.command_history.is_before_weight_transfer_and_motor_stop:
        return magnet_reach_entered_at_s
    # A vehicle that has touched the floor does not climb, whatever the dead reckoning says.
    near = (
        new.gear_below_target_m < MAGNET_REACH_BELOW_TARGET_M
        and b.command_history.floor_detected_at_s is None
    )
    if b.vehicle_world_z_at_last_contact_m is None and not near:
        return None
    # A vehicle caught below the magnet may be drawn to it again, so an earlier fall proves nothing.
    again = (
        magnet_reach_entered_at_s is not None
        and b.imu.last_fall_at_s > magnet_reach_entered_at_s
        and new.gear_below_target_m < MAGNET_REACH_BELOW_TARGET_M
    )
    return b.obs.t_s if magnet_reach_entered_at_s is None or again else magnet_reach_entered_at_s


def _climb_since_last_tick_m(b: Belief, new: DeadReckoningState) -> float:
    """Return how far a vehicle without a position has climbed since the previous tick, m, positive
    up: the climb rate of the dead reckoning `new` times the time or, after a gap in the telemetry,
    the change of the estimated height. 0 for a vehicle with a position."""
    obs, before, last = b.obs, b.dead_reckoning.imu_at_last_update, b.last_telemetry
    if b.dead_reckoning_began_at_s is None or before is None:
        return 0.0
    dt_s = max(0.0, min(MAX_HEIGHT_INTEGRATION_STEP_S, obs.imu.t_s - before.t_s))
    tel = obs.telemetry
    heard_again = (
        obs.imu.last_telemetry_gap_ended_at_s > before.t_s
        and b.is_telemetry_fresh
        and not obs.has_estimated_position_jumped
    )
    if heard_again and last is not None and tel.start == last.start:
        return tel.position_m[2] - last.position_m[2]
    return new.velocity_world_mps[2] * dt_s


# --- Evidence and learning ---


def _update_estimators(b: Belief) -> Belief:
    """Return the belief with `t_s` and `last_telemetry` of this tick, and with its condition start
    times, hover thrust, rotor thrust, battery fit, mean thrust direction and camera mounting
    updated. During a hold, only conditions that persist across phases keep their start times, and
    the mounting is not checked."""
    obs, maneuver = b.obs, b.command_history.maneuver
    held = bool(hold_reason(b, maneuver))
    fresh = [each for each in BELIEF_CONDITIONS if is_evidence_fresh(b, each)]
    condition_start_times_s: dict[Condition[Any], float] = update_condition_start_times(
        b.condition_start_times_s, fresh, b, obs.t_s
    )
    if held:
        # a hold interrupts the evidence
        condition_start_times_s = keep_start_times_across_phases(condition_start_times_s)
    dt_s = max(0.0, obs.t_s - b.t_s)
    last_s = obs.telemetry.t_s - dt_s if b.last_telemetry is None else b.last_telemetry.t_s
    # 0: no new sample
    sample_dt_s = max(
        0.0, min(SAMPLE_INTERVAL_UPPER_CLAMP_IN_FILTERS_S, obs.telemetry.t_s - last_s)
    )
    near_m = b.profile.planner.ascend.near_m
    away = not maneuver.climbs_to_target or b.target.gear_to_target_z_m > near_m
    b = replace(
        b,
        hover_thrust_estimate=b.hover_thrust_estimate.propagate_with_bounded_sigma(dt_s),
        lagged_rotor_raw_thrust=hover.filter_rotor_thrust(b, sample_dt_s),
    )
    found = b.hover_thrust_estimate
    if away and maneuver.learns_hover_thrust and is_flying_at_hover_thrust(b):
        found = hover.learn_hover_thrust_in_quiet_flight(b, sample_dt_s)
    elif b.command_history.is_descending_by_raw_thrust:
        found = hover.learn_hover_thrust_in_descent(b, sample_dt_s)
    mah = b.profile.vehicle.battery_mah
    return replace(
        b,
        t_s=obs.t_s,
        last_telemetry=obs.telemetry,
        condition_start_times_s=condition_start_times_s,
        hover_thrust_estimate=found,
        battery_fit=update_battery_fit_from_telemetry(
            b.battery_fit, obs.telemetry, obs.battery_reading_age_s, dt_s, mah
        ),
        camera_mounting_monitor=b.camera_mounting_monitor if held else _update_camera_mounting(b),
        mean_thrust_direction_world_xy=_filter_thrust_direction(b, sample_dt_s),
    )


def _filter_thrust_direction(b: Belief, sample_dt_s: float) -> tuple[float, float]:
    """Return the low-pass filtered horizontal part (x, y) of the unit vector along the thrust, in
    world axes, after a sample that covers `sample_dt_s`; the time constant is
    `MEAN_THRUST_DIRECTION_TIME_CONSTANT_S`."""
    gain = 1.0 - math.exp(-sample_dt_s / MEAN_THRUST_DIRECTION_TIME_CONSTANT_S)
    (x, y), (mean_x, mean_y) = b.thrust_direction_world_xy, b.mean_thrust_direction_world_xy
    return mean_x + gain * (x - mean_x), mean_y + gain * (y - mean_y)


def _update_camera_mounting(b: Belief) -> CameraMountingMonitor:
    obs, target = b.obs, b.obs.target
    measured = (
        target is not None and target.is_measured_in_newest_frame and target.world_m is not None
    )
    if not (
        obs.has_new_frame
        and measured
        and b.is_telemetry_fresh
        and b.command_history.maneuver.is_in_free_air
    ):
        return b.camera_mounting_monitor
    assert b.last_target_position_world_m is not None
    return update_camera_mounting_monitor(
        b.camera_mounting_monitor,
        make_camera_mounting_sample(obs.t_s, obs.telemetry, b.last_target_position_world_m),
    )
