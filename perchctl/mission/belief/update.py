"""Compute the belief one tick later: `update_belief(belief, observation, sent, profile)`.

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
from perchctl.mission.belief.battery import read_battery
from perchctl.mission.belief.belief import POSITION_RETURNS_S, Belief
from perchctl.mission.belief.contact import (
    CARRIED,
    DOWN,
    HANGING_S,
    MOST_RAW,
    STANDING_BELOW_M,
    SUPPORT_CONDITIONS,
    counts,
    is_carried_by_other_than_thrust,
    is_hover_thrust,
)
from perchctl.mission.belief.evidence import Condition, lasting, update_since
from perchctl.mission.belief.maneuver import Sent
from perchctl.mission.belief.motion import ZERO, Vector
from perchctl.mission.belief.mounting import MountingMonitor, mount_sample, update_monitor
from perchctl.mission.belief.quality import QUALITY_CONDITIONS, hold_reason
from perchctl.mission.belief.reckoning import (
    MAGNET_REACH_M,
    MOST_SILENT_MOVE_S,
    UNSEEN_S,
    DeadReckoning,
    add_position_step,
    add_sighting,
    advance_reckoning,
    forget_means,
    learn_bias_at_rest,
    learn_velocity_bias,
)
from perchctl.mission.observation import Observation
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import FULL_THRUST, Command, Idle, PositionSetpoint, RawThrust

CONDITIONS = (*SUPPORT_CONDITIONS, *QUALITY_CONDITIONS)
"""All conditions of the belief."""
CARRIED_WITHIN_M = 0.3
"""Distance below the target within which any support is the target, m."""
AT_REST_S = 0.3
"""Time for which a vehicle at its contact must be still to count as at rest, s."""
MOST_LEARNED_S = 0.1
"""Largest weight of one sample in the hover-thrust filter, s. Larger: after a gap, a single sample
has the weight of many."""
UNANSWERED_PART = 0.12
"""Difference between ordered and reported thrust that no ramp causes, as a share of full thrust."""
STILL_THRUST = 1000
"""Raw thrust below which the motors stand still while the setpoint watchdog stays satisfied."""
SPREAD_KEEPS = 0.9
"""Share of the target's spread that remains after each frame."""


def update_belief(belief: Belief, obs: Observation, sent: Sent, profile: Profile) -> Belief:
    """Return the belief after one more observation; `sent` holds the planner's orders so far.

    A wrong observation makes the belief wrong for some seconds; each part documents the data it
    depends on.
    """
    b = replace(belief, obs=obs, profile=profile, sent=sent, shift_m=ZERO)
    b = _see_target(b)
    if has_gap(belief, obs, profile):
        b = _after_gap(b)
    if b.position_is_stale:
        b = replace(b, stale_s=obs.t_s)
    if obs.jumped:
        b = _move_with_estimate(b)
    if obs.turned_rad > math.radians(profile.safety.heading_lost_deg):
        b = replace(b, heading_lost=True, hover=hover.best_estimate(b))
    b = _compare_thrust(b)
    b = _reckon(b)
    comes_down = sent.maneuver.descends and sent.is_motor_borne
    if comes_down and b.dead_reckoned_s is None and b.has_lost_its_position:
        b = give_up_position(b)
    return _learn(b)


def has_gap(belief: Belief, obs: Observation, profile: Profile) -> bool:
    """True if the planner has not run for longer than a position may be missing."""
    return belief.last is not None and obs.t_s - belief.t_s > profile.positioning.hold_s


def give_up_position(b: Belief) -> Belief:
    """Return the belief that, permanently, uses only accelerometer and attitude."""
    return replace(
        b,
        dead_reckoned_s=b.obs.t_s,
        reckoned_height_m=b.height_m,
        hover=hover.best_estimate(b),
    )


def forget_evidence(b: Belief) -> Belief:
    """Return the belief after a change of maneuver: all conditions restart, except for those that
    last."""
    return replace(b, since=lasting(b.since))


def after_command(b: Belief, command: Command) -> Belief:
    """Return the belief after a command was sent. A setpoint ends the comparison with a raw
    thrust."""
    if isinstance(command, (RawThrust, Idle)):
        return b
    return replace(b, unanswered_s=None)


# --- Direct consequences of the observation ---


def _see_target(b: Belief) -> Belief:
    """Return the belief with the target's position and spread, and the velocity from pictures,
    after a frame that measured the target."""
    target = b.obs.target
    if not b.obs.new_frame or target is None or not target.measured:
        return b
    b = replace(b, target_motion=b.target_motion.with_detection(target))
    if target.world_m is None:
        return b
    spread_m = 0.0
    if b.last_target_m is not None:
        moved_m = float(np.linalg.norm(target.world_m - b.last_target_m))
        spread_m = max(moved_m, SPREAD_KEEPS * b.target_spread_m)
    return replace(b, last_target_m=target.world_m, target_spread_m=spread_m)


def _after_gap(b: Belief) -> Belief:
    """Return the belief after a gap in which the planner did not run: all conditions restart."""
    imu = b.obs.imu
    kept: dict[Condition[Any], float] = lasting(b.since)
    off_s = max(imu.off_s, imu.silent_s)
    if DOWN in b.since and math.isfinite(off_s):
        # All samples from the gap have arrived, and the motors are off in each. Without this
        # exception, a loop with a gap in every tick would never see the end of a landing.
        kept[DOWN] = max(off_s, b.since[DOWN])
    return replace(b, since=kept, stale_s=b.obs.t_s if b.by_target else b.stale_s)


def _move_with_estimate(b: Belief) -> Belief:
    """Return the belief after a jump of the estimate's world frame, which has not moved the
    vehicle. Ground, contact and all other remembered positions move with the frame. They stay if
    samples are missing before the jump, since the vehicle may have moved, or if external positions
    have just returned and the jump ends a drift."""
    obs, last = b.obs, b.last
    jump_s = obs.t_s if b.jump_s is None else b.jump_s
    if last is None:
        return replace(b, jump_s=jump_s)
    tel = obs.telemetry
    x, y, z = tel.position_m
    vx, vy, vz = tel.velocity_mps
    dt_s = tel.t_s - tel.behind_s - (last.t_s - last.behind_s)
    lx, ly, lz = last.position_m
    moved_m = (x - lx - vx * dt_s, y - ly - vy * dt_s, z - lz - vz * dt_s)
    returns = b.stale_s is not None and obs.t_s - b.stale_s <= POSITION_RETURNS_S
    if dt_s > UNSEEN_S or returns:
        moved_m = (0.0, 0.0, 0.0)
    setpoint = b.sent.setpoint
    if setpoint is not None:
        z_m = z if b.contact_z_m is None else setpoint.z_m + moved_m[2]
        setpoint = PositionSetpoint(x, y, z_m, tel.yaw_rad)
    return replace(
        b,
        reckoning=forget_means(b.reckoning),
        ground_m=None if b.ground_m is None else _moved(b.ground_m, moved_m),
        contact_z_m=None if b.contact_z_m is None else b.contact_z_m + moved_m[2],
        sent=b.sent.moved(setpoint, moved_m),
        shift_m=moved_m,
        jump_s=jump_s,
    )


def _moved(place_m: Vector, by_m: Vector) -> Vector:
    return (place_m[0] + by_m[0], place_m[1] + by_m[1], place_m[2] + by_m[2])


def _compare_thrust(b: Belief) -> Belief:
    """Return the belief with the time since which the reported thrust differs from an ordered
    one."""
    order = b.sent.raw_thrust
    if order is None:
        return b
    wanted = 0.0 if order < STILL_THRUST else min(MOST_RAW, order)
    apart = abs(b.telemetry.thrust - wanted) > UNANSWERED_PART * FULL_THRUST
    since_s = b.obs.t_s if b.unanswered_s is None else b.unanswered_s
    b = replace(b, unanswered_s=since_s if apart else None)
    return b if b.thrust_is_known else replace(b, unread_s=b.obs.t_s)


# --- Dead reckoning ---


def _reckon(b: Belief) -> Belief:
    """Return the belief with the reckoning one tick later, the time within the magnet's reach, and
    the height of a vehicle without a position."""
    new = _carried_on(b)
    new = _at_rest_on_contact(b, new)
    new = _by_pictures(b, new)
    new = _with_sighting(b, new)
    new = _carried_at_target(b, new)
    return replace(
        b,
        reckoning=new,
        reach_s=_reach_s(b, new),
        reckoned_height_m=b.reckoned_height_m + _climbed_m(b, new),
    )


def _carried_on(b: Belief) -> DeadReckoning:
    """Integrate accelerometer and estimate, and learn biases from positions in the open."""
    obs, source = b.obs, b.profile.positioning.source
    believed = b.position_valid and b.proves and b.dead_reckoned_s is None and b.jump_s is None
    new = advance_reckoning(
        b.reckoning,
        obs.imu,
        obs.telemetry,
        believed=believed,
        diverged=b.diverged and not source.is_target,
        corrected=b.is_corrected,
        # A motion that no sighting has corrected yet is not a bias of the accelerometer.
        pushed=source.is_target and not b.is_corrected,
    )
    in_the_open = b.sent.maneuver.in_the_open and b.height_m > STANDING_BELOW_M
    if believed and b.is_corrected and in_the_open and b.last:
        new = learn_velocity_bias(new, b.last, obs.telemetry)
    else:
        new = forget_means(new)
    if b.position_trusted and not source.is_target and b.last is not None:
        new = add_position_step(new, b.last, obs.telemetry)
    return new


def _at_rest_on_contact(b: Belief, new: DeadReckoning) -> DeadReckoning:
    """Set the velocity to zero for a vehicle that has been steady at its contact, or within the
    magnet's reach at a thrust too small to support it: otherwise the accelerometer's bias would
    carry a hanging vehicle out of the reach within ten seconds."""
    obs = b.obs
    rests = obs.t_s - obs.imu.steady_s >= AT_REST_S and obs.t_s - obs.imu.fell_s > HANGING_S
    hangs = b.reach_s is not None and is_carried_by_other_than_thrust(b)
    touched = b.contact_z_m is not None or hangs
    if not touched or not new.below_m < MAGNET_REACH_M or not rests:
        return new
    blown = obs.t_s - obs.imu.steady_aside_s < AT_REST_S
    x_mps, y_mps, _ = new.velocity_mps
    new = replace(new, velocity_mps=(x_mps, y_mps, 0.0) if blown else (0.0, 0.0, 0.0))
    if not blown:
        new = learn_bias_at_rest(new, b.reckoning.imu, obs.imu)
    if obs.telemetry.thrust < 1:  # a hanging vehicle stays in place
        old = b.reckoning
        new = replace(new, aside_m=old.aside_m, aside_sigma_m=old.aside_sigma_m)
    return new


def _by_pictures(b: Belief, new: DeadReckoning) -> DeadReckoning:
    """Adopt the velocity on which pictures and accelerometer agree, once per new result."""
    felt, before = b.obs.felt, b.reckoning.imu
    if felt is None or not (before is None or felt.t_s > before.t_s):
        return new
    # Late pictures make the estimated height diverge, too.
    climb_mps = felt.climb_mps if b.mismatch.later_s != 0.0 else None
    climb_mps = new.velocity_mps[2] if climb_mps is None else climb_mps
    return replace(
        new,
        velocity_mps=(*felt.velocity_mps, climb_mps),
        bias_mps2=(*felt.bias_mps2, new.bias_mps2[2]),
    )


def _with_sighting(b: Belief, new: DeadReckoning) -> DeadReckoning:
    """Restart at a frame that measured the target; with a deck or motion capture, also in each
    tick, from the target's position in the world."""
    obs, target = b.obs, b.obs.target
    if target is None:
        return new
    seen = obs.new_frame and target.measured
    if not seen and not (b.position_valid and not b.by_target):
        return new
    yaw_rad, (ex, ey, ez) = obs.telemetry.yaw_rad, target.e_m
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    sigma_m = float(max(target.sigma_m[:2]))
    aside_m = (float(cos * ex - sin * ey), float(sin * ex + cos * ey))
    if not seen and b.stale_s is not None and b.stale_s >= target.measured_s:
        aside_m, sigma_m = new.aside_m, new.aside_sigma_m
    new = add_sighting(new, target.measured_s, aside_m, float(ez), sigma_m)
    if seen and target.measured_s > new.stepped_s:
        new = replace(new, stepped_m=(0.0, 0.0))
    return new


def _carried_at_target(b: Belief, new: DeadReckoning) -> DeadReckoning:
    """Correct the height with the target alone: a support just below the target is the target. Late
    pictures make the vehicle seem lower."""
    near = b.by_target and not b.sent.maneuver.descends and new.below_m < CARRIED_WITHIN_M
    if not near or b.held_s(CARRIED) < b.profile.planner.perch.contact_dwell_s:
        return new
    return replace(
        new,
        below_m=min(0.0, new.below_m),
        nearest_m=min(0.0, new.nearest_m),
        velocity_mps=(*new.velocity_mps[:2], 0.0),
    )


def _reach_s(b: Belief, new: DeadReckoning) -> float | None:
    """Return the time since which the magnet may hold the vehicle."""
    reach_s = b.reach_s
    # a released or stopped vehicle does not move into or out of reach
    if not b.sent.is_motor_borne:
        return reach_s
    # A vehicle that has touched the floor does not climb, whatever the reckoning says.
    near = new.below_m < MAGNET_REACH_M and b.sent.floor_felt_s is None
    if b.contact_z_m is None and not near:
        return None
    # A vehicle caught below the magnet may be drawn to it again, so an earlier fall proves nothing.
    again = reach_s is not None and b.imu.fell_s > reach_s and new.below_m < MAGNET_REACH_M
    return b.obs.t_s if reach_s is None or again else reach_s


def _climbed_m(b: Belief, new: DeadReckoning) -> float:
    """Return the climb since the previous tick of a vehicle without a position, m; 0 with a
    position."""
    obs, before, last = b.obs, b.reckoning.imu, b.last
    if b.dead_reckoned_s is None or before is None:
        return 0.0
    dt_s = max(0.0, min(MOST_SILENT_MOVE_S, obs.imu.t_s - before.t_s))
    tel = obs.telemetry
    heard_again = obs.imu.silent_s > before.t_s and b.proves and not obs.jumped
    if heard_again and last is not None and tel.start == last.start:
        return tel.position_m[2] - last.position_m[2]
    return new.velocity_mps[2] * dt_s


# --- Evidence and learning ---


def _learn(b: Belief) -> Belief:
    """Return the belief with its conditions, hover thrust, battery and mounting after the tick."""
    obs, maneuver = b.obs, b.sent.maneuver
    held = bool(hold_reason(b, maneuver))
    fresh = [each for each in CONDITIONS if counts(b, each)]
    since: dict[Condition[Any], float] = update_since(b.since, fresh, b, obs.t_s)
    if held:
        since = lasting(since)  # a hold interrupts the evidence
    dt_s = max(0.0, obs.t_s - b.t_s)
    last_s = obs.telemetry.t_s - dt_s if b.last is None else b.last.t_s
    sample_s = max(0.0, min(MOST_LEARNED_S, obs.telemetry.t_s - last_s))  # 0: no new sample
    near_m = b.profile.planner.ascend.near_m
    away = not maneuver.nears_target or b.target.error_z_m > near_m
    b = replace(b, hover=b.hover.aged(dt_s), lagged_thrust=hover.lagged_thrust(b, sample_s))
    found = b.hover
    if away and maneuver.learns_hover and is_hover_thrust(b):
        found = hover.learn_in_quiet_flight(b, sample_s)
    elif b.sent.is_level_descent:
        found = hover.learn_in_descent(b, sample_s)
    mah = b.profile.vehicle.battery_mah
    return replace(
        b,
        t_s=obs.t_s,
        last=obs.telemetry,
        since=since,
        hover=found,
        energy=read_battery(b.energy, obs.telemetry, obs.battery_age_s, dt_s, mah),
        mounting=b.mounting if held else _watch_mounting(b),
    )


def _watch_mounting(b: Belief) -> MountingMonitor:
    obs, target = b.obs, b.obs.target
    measured = target is not None and target.measured and target.world_m is not None
    if not (obs.new_frame and measured and b.proves and b.sent.maneuver.in_the_open):
        return b.mounting
    assert b.last_target_m is not None
    return update_monitor(b.mounting, mount_sample(obs.t_s, obs.telemetry, b.last_target_m))
