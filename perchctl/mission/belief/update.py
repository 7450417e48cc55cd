"""The belief one tick later: `update_belief(belief, observation, sent, profile)`.

    observation ──> target, gaps, jumps, heading, thrust
                                    │
                                    v
                  dead reckoning ──> place under the target, magnet's reach
                                    │
                                    v
                  conditions since when ──> hover thrust, battery, mounting

Conditions are judged by the hover thrust of the tick before, so that a press cannot teach the
reference by which it is proven.
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
"""What carries the vehicle so near below the target is the target."""
AT_REST_S = 0.3
"""Time for which a vehicle at its contact has to be still to count as at rest."""
MOST_LEARNED_S = 0.1
"""Time since the sample before that one sample stands for at most. Larger: after a gap a single
sample counts as much as a second of them."""
UNANSWERED_PART = 0.12
"""Share of full thrust by which order and reading may differ: no ramp leads farther."""
STILL_THRUST = 1000
"""Raw thrust on which the motors stand still and the stream of setpoints lives on."""
SPREAD_KEEPS = 0.9
"""Share of the target's spread that a frame keeps."""


def update_belief(belief: Belief, obs: Observation, sent: Sent, profile: Profile) -> Belief:
    """The belief after one more observation; `sent`: what the planner has ordered until then.

    Wrong for some seconds where the observation is: each part says what it rests on.
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
    """True if nothing was decided for longer than a position may be missing."""
    return belief.last is not None and obs.t_s - belief.t_s > profile.positioning.hold_s


def give_up_position(b: Belief) -> Belief:
    """The belief from which on only accelerometer and attitude are used, for good."""
    return replace(
        b,
        dead_reckoned_s=b.obs.t_s,
        reckoned_height_m=b.height_m,
        hover=hover.best_estimate(b),
    )


def forget_evidence(b: Belief) -> Belief:
    """The belief after a change of maneuver: what has held until now begins anew, but what is the
    vehicle's own."""
    return replace(b, since=lasting(b.since))


def after_command(b: Belief, command: Command) -> Belief:
    """The belief once a command was sent: a setpoint ends what a raw thrust has left unanswered."""
    if isinstance(command, (RawThrust, Idle)):
        return b
    return replace(b, unanswered_s=None)


# --- What the observation shows at once ---


def _see_target(b: Belief) -> Belief:
    """The belief with the target's place at a frame that measured it, its spread, and the motion
    that pictures show."""
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
    """The belief after a time in which nothing was decided: evidence begins anew."""
    imu = b.obs.imu
    kept: dict[Condition[Any], float] = lasting(b.since)
    off_s = max(imu.off_s, imu.silent_s)
    if DOWN in b.since and math.isfinite(off_s):
        # All samples of the hang have come, and in none do the motors turn: else a loop that
        # hangs in every turn would never see a landing end.
        kept[DOWN] = max(off_s, b.since[DOWN])
    return replace(b, since=kept, stale_s=b.obs.t_s if b.by_target else b.stale_s)


def _move_with_estimate(b: Belief) -> Belief:
    """The estimate's world has moved, the vehicle has not: ground, contact and all that is
    remembered move with it. Not where samples are missing before the step, since the vehicle may
    have moved, nor where external positions have come again and the step ends a drift."""
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
    """The belief with since when the measured thrust differs from an ordered raw thrust."""
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
    """The belief with the reckoning one tick later, and what follows from it: the time in the
    magnet's reach, and the height of a vehicle without a position."""
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
    """By accelerometer and estimate, with the biases that positions in the open teach."""
    obs, source = b.obs, b.profile.positioning.source
    believed = b.position_valid and b.proves and b.dead_reckoned_s is None and b.jump_s is None
    new = advance_reckoning(
        b.reckoning,
        obs.imu,
        obs.telemetry,
        believed=believed,
        diverged=b.diverged and not source.is_target,
        corrected=b.is_corrected,
        # What moves it while no sighting corrects its estimate is no bias of the accelerometer.
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
    """At its contact, a vehicle that was steady for a while does not move."""
    obs = b.obs
    rests = obs.t_s - obs.imu.steady_s >= AT_REST_S and obs.t_s - obs.imu.fell_s > HANGING_S
    if b.contact_z_m is None or not new.below_m < MAGNET_REACH_M or not rests:
        return new
    blown = obs.t_s - obs.imu.steady_aside_s < AT_REST_S
    x_mps, y_mps, _ = new.velocity_mps
    new = replace(new, velocity_mps=(x_mps, y_mps, 0.0) if blown else (0.0, 0.0, 0.0))
    if not blown:
        new = learn_bias_at_rest(new, b.reckoning.imu, obs.imu)
    if obs.telemetry.thrust < 1:  # it hangs, and what hangs stays where it is
        old = b.reckoning
        new = replace(new, aside_m=old.aside_m, aside_sigma_m=old.aside_sigma_m)
    return new


def _by_pictures(b: Belief, new: DeadReckoning) -> DeadReckoning:
    """With the velocity on which pictures and accelerometer agreed, once it is new."""
    felt, before = b.obs.felt, b.reckoning.imu
    if felt is None or not (before is None or felt.t_s > before.t_s):
        return new
    # Late pictures have led the estimate's height astray, too.
    climb_mps = felt.climb_mps if b.mismatch.later_s != 0.0 else None
    climb_mps = new.velocity_mps[2] if climb_mps is None else climb_mps
    return replace(
        new,
        velocity_mps=(*felt.velocity_mps, climb_mps),
        bias_mps2=(*felt.bias_mps2, new.bias_mps2[2]),
    )


def _with_sighting(b: Belief, new: DeadReckoning) -> DeadReckoning:
    """Restarted at a frame that measured the target; by deck or motion capture at each tick, by the
    target's place in the world."""
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
    """By the target alone: what carries it near below the target is the target; late pictures show
    it lower."""
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
    """Since when the magnet may hold the vehicle."""
    reach_s = b.reach_s
    if not b.sent.is_motor_borne:  # what is released or stopped moves no more
        return reach_s
    # After the floor was touched nothing climbs, whatever was reckoned since.
    near = new.below_m < MAGNET_REACH_M and b.sent.floor_felt_s is None
    if b.contact_z_m is None and not near:
        return None
    # Caught below the magnet it may be drawn to it again: an earlier fall proves nothing then.
    again = reach_s is not None and b.imu.fell_s > reach_s and new.below_m < MAGNET_REACH_M
    return b.obs.t_s if reach_s is None or again else reach_s


def _climbed_m(b: Belief, new: DeadReckoning) -> float:
    """The way up since the tick before of a vehicle without a position; 0 with one."""
    obs, before, last = b.obs, b.reckoning.imu, b.last
    if b.dead_reckoned_s is None or before is None:
        return 0.0
    dt_s = max(0.0, min(MOST_SILENT_MOVE_S, obs.imu.t_s - before.t_s))
    tel = obs.telemetry
    heard_again = obs.imu.silent_s > before.t_s and b.proves and not obs.jumped
    if heard_again and last is not None and tel.start == last.start:
        return tel.position_m[2] - last.position_m[2]
    return new.velocity_mps[2] * dt_s


# --- Evidence, and what is learned ---


def _learn(b: Belief) -> Belief:
    """The belief with its evidence, and with hover thrust, battery and mounting after the tick."""
    obs, maneuver = b.obs, b.sent.maneuver
    held = bool(hold_reason(b, maneuver))
    fresh = [each for each in CONDITIONS if counts(b, each)]
    since: dict[Condition[Any], float] = update_since(b.since, fresh, b, obs.t_s)
    if held:
        since = lasting(since)  # a held vehicle proves nothing
    dt_s = max(0.0, obs.t_s - b.t_s)
    last_s = obs.telemetry.t_s - dt_s if b.last is None else b.last.t_s
    sample_s = max(0.0, min(MOST_LEARNED_S, obs.telemetry.t_s - last_s))  # 0: nothing new
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
