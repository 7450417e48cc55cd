"""Dead reckoning: integrate the accelerometer from the last good position.

While positions correct the state estimate, the reckoned velocity v is pulled towards the estimated
velocity e, and the bias b (the error of accelerometer and attitude) is learned from the difference:

    v += (dv_imu - b dt)                                               each sample
    v += (e - v) dt / DEAD_RECKONED_VELOCITY_CORRECTION_TIME_CONSTANT_S  while e is trusted
    b += (dv_imu - de - b dt) / ACCELERATION_BIAS_LEARNING_TIME_CONSTANT_S      while e is trusted

Without positions, only the first line applies. The gear's offset from the target is integrated with
v from the last sighting; its standard deviation grows with the time since then and with the
distance flown. A change of the bias after the position is lost makes all results wrong: 0.1 m/s^2
becomes 0.45 m after 3 s. The gains are fixed. A Kalman filter of velocity, bias and the positions
from pictures is no better (`benchmarks/reckoning.py`) because the same change limits both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission.belief.motion import (
    ACCELEROMETER_OFFSET_TIME_CONSTANT_S,
    MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S,
    MAX_PUSH_TO_ESTIMATE_RESPONSE_DELAY_S,
    MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S,
    ZERO_VECTOR,
    ImuMotion,
    Vector,
)
from perchctl.values import replace
from perchctl.vehicle import Telemetry

DEAD_RECKONED_VELOCITY_CORRECTION_TIME_CONSTANT_S = 3.0
"""Time constant with which the reckoned velocity approaches a trusted estimate, s. Larger: an old
error of the reckoned velocity persists. Smaller: a wrong estimate is followed."""
ACCELERATION_BIAS_LEARNING_TIME_CONSTANT_S = 4.0
"""Time constant with which the bias is learned, s. Larger: the bias adapts too slowly to a change
in the wind. Smaller: a gust is learned as a bias."""
MAX_LEARNED_ACCELERATION_BIAS_MPS2 = 1.5
"""Largest bias, m/s^2; a wind of 4 m/s, which the firmware mistakes for a tilt, causes 1.2. Larger:
wrong positions can cause a bias larger than any attitude error."""
MAX_INNOVATION_TO_LEARN_ACCELERATION_BIAS_MPS2 = 2.0
"""Largest difference between measured and estimated acceleration in one sample from which the bias
is learned, m/s^2; a larger difference is due to an impact or a correction of the estimate. Larger:
the effect of a 40 ms impact is learned. Smaller: a gust is not learned."""
MAX_DEAD_RECKONED_CLIMB_RATE_ERROR_MPS = 0.1
"""Margin by which the vehicle may climb faster than dead reckoning says, m/s. Larger: the magnet
seems to be in reach too early."""
MAX_POSSIBLE_CLIMB_RATE_IN_TELEMETRY_GAP_MPS = 1.0
"""Largest climb rate during a gap in the telemetry, m/s: the limit of the position mode."""
MAGNET_REACH_BELOW_TARGET_M = 0.04
"""Distance below the target at which the magnet may have caught the gear, m. Larger: a flying
vehicle is treated as one that may hang. Smaller: a caught vehicle is treated as flying."""
MAX_GEAR_BELOW_TARGET_TO_FOLLOW_ESTIMATED_CLIMB_M = 0.1
"""Distance below the target within which the reckoned vertical speed follows the estimate, m: a
bounce off the ceiling happens between two telemetry samples, but the firmware integrates it at 1
kHz. Larger: errors of the estimate due to late pictures are adopted. Smaller: after a bounce, the
reckoned speed is wrong by up to 0.3 m/s."""
IMU_MINUS_ESTIMATE_VELOCITY_FORGETTING_TIME_CONSTANT_S = 1.0
"""Time constant with which positions correct a velocity that the estimate has missed, s. Larger: a
velocity that a wrong attitude accumulates over seconds looks like an impact. Smaller: an impact
just before the last sighting is forgotten."""
MAX_LEARNED_ESTIMATED_VELOCITY_BIAS_MPS = 0.6
"""Largest bias of the estimated velocity, m/s; a wind of 4 m/s causes 0.4. Larger: a moving vehicle
counts as still while its position creeps. Smaller: in wind, the vehicle never counts as steady."""
ESTIMATED_VELOCITY_BIAS_LEARNING_TIME_CONSTANT_S = 2.0
"""Time constant with which the bias of the estimated velocity is learned, s. Larger: after a change
in the wind, the vehicle seems to move for longer. Smaller: noise of the position is learned as a
bias."""
ESTIMATE_MINUS_IMU_VELOCITY_FORGETTING_TIME_CONSTANT_S = 0.5
"""Time constant with which a velocity gained by the estimate alone is forgotten, s."""
MIN_POSITION_STEP_TO_COUNT_AS_UNEXPLAINED_M = 0.005
"""Smallest motion of the estimated position, beyond what its velocity explains, that counts as a
step, m. Smaller: noise counts as a step."""
UNEXPLAINED_POSITION_STEP_THRESHOLD_GROWTH_MPS = 0.2
"""Increase of `MIN_POSITION_STEP_TO_COUNT_AS_UNEXPLAINED_M` for each second between two samples,
m/s."""
MAX_SAMPLE_INTERVAL_TO_DETECT_POSITION_STEP_S = 0.15
"""Longest time between two samples within which a step is detected, s; over a longer time, the step
may be the vehicle's motion."""
MAX_POSITION_LAG_TO_COUNT_AS_CURRENT_S = 0.05
"""Longest time for which the position in a sample is regarded as current, s."""
ACCELERATION_BIAS_SIGMA_MPS2 = 0.06
"""Standard deviation of the acceleration bias in a dead-reckoned position, m/s^2. Smaller: the
offset of a contact is reported as more precise than it is."""
VELOCITY_SIGMA_AT_SIGHTING_MPS = 0.01
"""Standard deviation of the dead-reckoned velocity at the last sighting, m/s. Smaller: the offset
of a contact is reported as more precise than it is."""
POSITION_SIGMA_GROWTH_PER_DISTANCE_FLOWN = 0.3
"""Fraction of the distance flown without a sighting that is added to the standard deviation of a
dead-reckoned position."""
ACCELERATION_BIAS_PER_ESTIMATE_MINUS_IMU_VELOCITY_PER_S = 1.5
"""Bias of the acceleration, m/s^2, that positions in the wrong axes cause per m/s of
`recent_estimate_minus_imu_velocity_world_xy_mps`."""
MAX_HEIGHT_INTEGRATION_STEP_S = 0.5
"""Longest integration step of the dead-reckoned height, s; a longer step is a gap."""


@dataclass(frozen=True)
class DeadReckoningState:
    """Velocity of the vehicle and its position relative to the target, integrated from the
    accelerometer since the last good position or sighting, with the biases learned before.

    Attributes:
        imu_at_last_update: IMU motion up to which the values are integrated; None before the first
            sample.
        velocity_world_mps, estimated_velocity_world_mps: dead-reckoned velocity, and the velocity
            of the state estimate in the newest sample.
        acceleration_bias_world_mps2: combined error of accelerometer and attitude.
        mean_specific_force_world_xy_mps2: mean lateral reading of the accelerometer.
        recent_estimate_minus_imu_velocity_world_xy_mps: lateral velocity that the state estimate
            has gained recently but the accelerometer has not measured.
        recent_imu_minus_estimate_velocity_world_xy_mps: lateral velocity that the accelerometer has
            measured recently but the state estimate has not gained.
        gear_below_target_m: distance of the gear below the target; infinite if the target has not
            been seen or the vehicle has fallen since.
        gear_below_target_lower_bound_m: the same, reduced by the highest climb that was possible
            during gaps in the telemetry, and not reset by a fall.
        last_telemetry_gap_in_magnet_reach_ended_at_s: end of the newest gap in the telemetry after
            which the gear may be within the magnet's reach.
        gear_to_target_world_xy_m: horizontal vector from the gear to the target.
        gear_to_target_sigma_m: its standard deviation per axis; infinite while unknown.
        last_sighting_at_s: exposure time of the sighting from which the vector is integrated.
        unexplained_position_step_sum_world_xy_m: sum of the steps of the estimated position since
            that sighting that the estimated velocity does not explain.
        climb_rate_before_newest_impact_mps: vertical speed just before the newest impact, positive
            up.
        estimated_velocity_bias_world_xy_mps: lateral error of the state estimate's velocity.
        mean_estimated_velocity_world_xy_mps, mean_estimated_position_world_xy_m: low-pass filtered
            state estimate, from which that error is learned; the position is None until the filters
            have restarted.
        time_under_position_control_s: total time in free air under position control.
    """

    imu_at_last_update: ImuMotion | None = None  # IMU motion up to which this value is integrated
    velocity_world_mps: Vector = ZERO_VECTOR
    acceleration_bias_world_mps2: Vector = ZERO_VECTOR  # error of accelerometer and attitude
    # mean lateral reading of the accelerometer
    mean_specific_force_world_xy_mps2: tuple[float, float] = (0.0, 0.0)
    estimated_velocity_world_mps: Vector = ZERO_VECTOR
    # lateral velocity gained recently by the state estimate alone
    recent_estimate_minus_imu_velocity_world_xy_mps: tuple[float, float] = (0.0, 0.0)
    # lateral velocity gained recently by the accelerometer alone
    recent_imu_minus_estimate_velocity_world_xy_mps: tuple[float, float] = (0.0, 0.0)
    # distance of the gear below the target; inf if it is unseen or the vehicle has fallen
    gear_below_target_m: float = math.inf
    # lower bound of `gear_below_target_m`: it allows for climbs in telemetry gaps, and falls only
    # increase it
    gear_below_target_lower_bound_m: float = math.inf
    # end of the newest gap after which the magnet may hold the vehicle
    last_telemetry_gap_in_magnet_reach_ended_at_s: float = -math.inf
    # lateral offset from the gear to the target's axis
    gear_to_target_world_xy_m: tuple[float, float] = (0.0, 0.0)
    # standard deviation of `gear_to_target_world_xy_m`; inf if unknown
    gear_to_target_sigma_m: float = math.inf
    # exposure time of the sighting from which the offset is integrated
    last_sighting_at_s: float = -math.inf
    # sum of the steps of the estimated position since that sighting
    unexplained_position_step_sum_world_xy_m: tuple[float, float] = (0.0, 0.0)
    last_unexplained_position_step_at_s: float = -math.inf  # time of the newest step
    climb_rate_before_newest_impact_mps: float = (
        0.0  # vertical speed just before `ImuMotion.newest_impact`
    )
    # lateral bias of the estimated velocity
    estimated_velocity_bias_world_xy_mps: tuple[float, float] = (0.0, 0.0)
    # estimated velocity after a low-pass filter
    mean_estimated_velocity_world_xy_mps: tuple[float, float] = (0.0, 0.0)
    # estimated position after a low-pass filter
    mean_estimated_position_world_xy_m: tuple[float, float] | None = None
    time_under_position_control_s: float = 0.0  # total time in free air under position control


def advance_dead_reckoning(
    old: DeadReckoningState,
    imu: ImuMotion,
    sample: Telemetry,
    *,
    is_estimate_trusted: bool,
    is_position_diverged: bool = False,
    is_estimated_velocity_being_corrected: bool = False,
    ignores_lateral_estimate: bool = False,
) -> DeadReckoningState:
    """Return the dead reckoning one tick later, advanced by the velocity that `imu` has gained
    since `old`. `sample` is the newest sample of `imu`. At the first sample, after a gap in the
    telemetry, or while the attitude is frozen, the dead reckoning restarts instead: the velocity
    comes from the state estimate, and the offset from the target becomes unknown.

    - `is_estimate_trusted`: pull the reckoned velocity towards the sample's estimated velocity, or
      adopt it at a restart, and learn from it the bias of the acceleration, which is due to
      accelerometer and attitude. If False, a restart adds only the change of the estimated velocity
      since `old`.
    - `is_estimated_velocity_being_corrected`: external positions still correct the estimated
      velocity, so gradually forget the lateral velocity that only the accelerometer has measured.
    - `ignores_lateral_estimate`: use only the vertical part of the estimated velocity, because the
      firmware's estimator does not see a lateral push until a position corrects it.
    - `is_position_diverged`: at a restart, keep the reckoned velocity instead of the estimated
      velocity, which may be in the wrong axes.
    """
    estimated_velocity_world_mps, impact = sample.velocity_mps, imu.newest_impact
    if old.imu_at_last_update is not None and impact.t_s > old.imu_at_last_update.newest_impact.t_s:
        carried = not old.imu_at_last_update.t_s < imu.last_telemetry_gap_ended_at_s <= impact.t_s
        carried_mps = (
            old.velocity_world_mps[2]
            + impact.imu_climb_rate_before_impact_mps
            - old.imu_at_last_update.velocity_since_first_sample_world_mps[2]
        )
        old = replace(
            old,
            climb_rate_before_newest_impact_mps=carried_mps
            if carried
            else impact.estimated_climb_rate_before_impact_mps,
        )
    frozen = imu.attitude_frozen_for_s > MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S
    if (
        old.imu_at_last_update is None
        or imu.last_telemetry_gap_ended_at_s > old.imu_at_last_update.t_s
        or frozen
    ):
        return _restart_dead_reckoning(
            old,
            imu,
            estimated_velocity_world_mps,
            is_estimate_trusted=is_estimate_trusted,
            is_position_diverged=is_position_diverged,
        )
    return _integrate_sample(
        old,
        old.imu_at_last_update,
        imu,
        sample,
        is_estimate_trusted=is_estimate_trusted,
        is_estimated_velocity_being_corrected=is_estimated_velocity_being_corrected,
        ignores_lateral_estimate=ignores_lateral_estimate,
    )


def _restart_dead_reckoning(
    old: DeadReckoningState,
    imu: ImuMotion,
    estimated_velocity_world_mps: Vector,
    *,
    is_estimate_trusted: bool,
    is_position_diverged: bool,
) -> DeadReckoningState:
    """Return the dead reckoning at the first sample, after a gap in the telemetry, or while the
    attitude is frozen, when `imu` cannot be integrated.

    If the state estimate is trusted, the velocity becomes `estimated_velocity_world_mps` (world
    axes). Otherwise, it changes by as much as the estimated velocity has changed since `old`. With
    diverged positions, the velocity of `old` is kept, apart from the vertical speed that `imu` has
    gained. The horizontal vector from the gear to the target becomes unknown. After a gap in the
    telemetry, the lower bound of the gear's distance below the target allows for the highest climb
    that is possible during the gap.
    """
    velocity_world_mps = estimated_velocity_world_mps if is_estimate_trusted else ZERO_VECTOR
    if is_position_diverged:
        vx, vy, vz = old.velocity_world_mps
        if (
            old.imu_at_last_update is not None
            and imu.last_telemetry_gap_ended_at_s <= old.imu_at_last_update.t_s
        ):
            vz += (
                imu.velocity_since_first_sample_world_mps[2]
                - old.imu_at_last_update.velocity_since_first_sample_world_mps[2]
            )
        velocity_world_mps = (vx, vy, vz)
    elif not is_estimate_trusted and old.imu_at_last_update is not None:
        vx, vy, vz = (
            v + e - o
            for v, e, o in zip(
                old.velocity_world_mps,
                estimated_velocity_world_mps,
                old.estimated_velocity_world_mps,
                strict=True,
            )
        )
        velocity_world_mps = (vx, vy, vz)
    unknown = replace(
        old,
        imu_at_last_update=imu,
        velocity_world_mps=velocity_world_mps,
        estimated_velocity_world_mps=estimated_velocity_world_mps,
        recent_estimate_minus_imu_velocity_world_xy_mps=(0.0, 0.0),
        recent_imu_minus_estimate_velocity_world_xy_mps=(0.0, 0.0),
    )
    if old.imu_at_last_update is None:
        return unknown
    if imu.last_telemetry_gap_ended_at_s > old.imu_at_last_update.t_s:
        # A vehicle whose motors were off before and after the gap, or that has restarted, cannot
        # have climbed under power.
        off = (
            old.imu_at_last_update.motors_stopped_at_s <= old.imu_at_last_update.t_s
            and imu.motors_stopped_at_s <= imu.t_s
        )
        flew = not (off or imu.vehicle_restarted_at_s > old.imu_at_last_update.t_s)
        climb_mps = max(0.0, old.velocity_world_mps[2]) + MAX_DEAD_RECKONED_CLIMB_RATE_ERROR_MPS
        climb_m = climb_mps**2 / (2.0 * GRAVITY_MPS2)
        if flew:
            climb_m = MAX_POSSIBLE_CLIMB_RATE_IN_TELEMETRY_GAP_MPS * (
                imu.t_s - old.imu_at_last_update.t_s
            )
        gear_below_target_lower_bound_m = old.gear_below_target_lower_bound_m - climb_m
        near = gear_below_target_lower_bound_m < MAGNET_REACH_BELOW_TARGET_M
        unknown = replace(
            unknown,
            gear_below_target_lower_bound_m=gear_below_target_lower_bound_m,
            last_telemetry_gap_in_magnet_reach_ended_at_s=imu.t_s
            if near
            else old.last_telemetry_gap_in_magnet_reach_ended_at_s,
            gear_below_target_m=old.gear_below_target_m if near or flew else math.inf,
        )
    return replace(unknown, gear_to_target_sigma_m=math.inf)


def _integrate_sample(
    old: DeadReckoningState,
    previous_imu: ImuMotion,
    imu: ImuMotion,
    sample: Telemetry,
    *,
    is_estimate_trusted: bool,
    is_estimated_velocity_being_corrected: bool,
    ignores_lateral_estimate: bool,
) -> DeadReckoningState:
    """Return the dead reckoning at `sample`, the newest sample of `imu`, advanced from
    `previous_imu`, one tick earlier. It is unchanged without a new sample.

    The velocity changes by what the accelerometer has measured, minus the acceleration bias, and
    the gear's offset from the target changes by the velocity times the time. If
    `is_estimate_trusted`, two low-pass filters also pull the velocity towards the sample's
    estimated velocity and learn the acceleration bias from the difference between measured and
    estimated acceleration. `ignores_lateral_estimate` restricts these two to the vertical axis.
    `is_estimated_velocity_being_corrected`: positions correct the estimated velocity, so a lateral
    velocity that only the accelerometer has measured is forgotten gradually.
    """
    estimated_velocity_world_mps, dt_s = sample.velocity_mps, imu.t_s - previous_imu.t_s
    if not dt_s > 0.0:
        return old
    velocity, bias, recent_estimate_minus_imu_velocity_world_xy_mps, missed = (
        [],
        [],
        [0.0, 0.0],
        [0.0, 0.0],
    )
    remembers = (
        math.exp(-dt_s / IMU_MINUS_ESTIMATE_VELOCITY_FORGETTING_TIME_CONSTANT_S)
        if is_estimated_velocity_being_corrected
        else 1.0
    )
    keeps = math.exp(-dt_s / ESTIMATE_MINUS_IMU_VELOCITY_FORGETTING_TIME_CONSTANT_S)
    calm = (
        is_estimate_trusted
        and imu.t_s - imu.last_lateral_push_at_s > MAX_PUSH_TO_ESTIMATE_RESPONSE_DELAY_S
    )
    cos, sin = math.cos(sample.yaw_rad), math.sin(sample.yaw_rad)
    ahead_g, left_g = imu.mean_specific_force_body_xy_g
    reads_mps2 = (
        GRAVITY_MPS2 * (ahead_g * cos - left_g * sin),
        GRAVITY_MPS2 * (ahead_g * sin + left_g * cos),
    )
    mean_specific_force_world_xy_mps2 = [*old.mean_specific_force_world_xy_mps2]
    for i in range(3):
        gained = (
            imu.velocity_since_first_sample_world_mps[i]
            - previous_imu.velocity_since_first_sample_world_mps[i]
        )
        if (
            i == 2
            and is_estimate_trusted
            and old.gear_below_target_m < MAX_GEAR_BELOW_TARGET_TO_FOLLOW_ESTIMATED_CLIMB_M
        ):
            gained = (
                estimated_velocity_world_mps[2]
                - old.estimated_velocity_world_mps[2]
                + old.acceleration_bias_world_mps2[2] * dt_s
            )
        v, b = (
            old.velocity_world_mps[i] + gained - old.acceleration_bias_world_mps2[i] * dt_s,
            old.acceleration_bias_world_mps2[i],
        )
        if i < 2:
            alone = (
                gained
                - b * dt_s
                - (estimated_velocity_world_mps[i] - old.estimated_velocity_world_mps[i])
            )
            missed[i] = remembers * old.recent_imu_minus_estimate_velocity_world_xy_mps[i] + alone
        if is_estimate_trusted and (i == 2 or not ignores_lateral_estimate):
            v += (estimated_velocity_world_mps[i] - v) * min(
                1.0, dt_s / DEAD_RECKONED_VELOCITY_CORRECTION_TIME_CONSTANT_S
            )
            wrong = (
                gained - (estimated_velocity_world_mps[i] - old.estimated_velocity_world_mps[i])
            ) / dt_s
            if calm and i < 2:
                more = (
                    estimated_velocity_world_mps[i]
                    - old.estimated_velocity_world_mps[i]
                    - gained
                    + b * dt_s
                )
                recent_estimate_minus_imu_velocity_world_xy_mps[i] = (
                    keeps * old.recent_estimate_minus_imu_velocity_world_xy_mps[i] + more
                )
            if abs(wrong) <= MAX_INNOVATION_TO_LEARN_ACCELERATION_BIAS_MPS2:
                share = min(1.0, dt_s / ACCELERATION_BIAS_LEARNING_TIME_CONSTANT_S)
                b = max(
                    -MAX_LEARNED_ACCELERATION_BIAS_MPS2,
                    min(MAX_LEARNED_ACCELERATION_BIAS_MPS2, b + share * (wrong - b)),
                )
                if i < 2:
                    mean_specific_force_world_xy_mps2[i] += share * (
                        reads_mps2[i] - mean_specific_force_world_xy_mps2[i]
                    )
        velocity.append(v)
        bias.append(b)
    vx, vy, vz = velocity
    unseen_s = max(0.0, imu.t_s - old.last_sighting_at_s)
    fell = imu.last_fall_at_s > max(previous_imu.last_fall_at_s, old.last_sighting_at_s)
    step_m = math.hypot(vx, vy) * dt_s
    growth_m = (
        VELOCITY_SIGMA_AT_SIGHTING_MPS + ACCELERATION_BIAS_SIGMA_MPS2 * unseen_s
    ) * dt_s + POSITION_SIGMA_GROWTH_PER_DISTANCE_FLOWN * step_m
    ex, ey = old.gear_to_target_world_xy_m
    return replace(
        old,
        imu_at_last_update=imu,
        velocity_world_mps=(vx, vy, vz),
        acceleration_bias_world_mps2=(bias[0], bias[1], bias[2]),
        mean_specific_force_world_xy_mps2=(
            mean_specific_force_world_xy_mps2[0],
            mean_specific_force_world_xy_mps2[1],
        ),
        estimated_velocity_world_mps=estimated_velocity_world_mps,
        recent_estimate_minus_imu_velocity_world_xy_mps=(
            recent_estimate_minus_imu_velocity_world_xy_mps[0],
            recent_estimate_minus_imu_velocity_world_xy_mps[1],
        ),
        recent_imu_minus_estimate_velocity_world_xy_mps=(missed[0], missed[1]),
        gear_below_target_m=math.inf
        if fell
        else old.gear_below_target_m - (vz + MAX_DEAD_RECKONED_CLIMB_RATE_ERROR_MPS) * dt_s,
        gear_below_target_lower_bound_m=old.gear_below_target_lower_bound_m - vz * dt_s,
        gear_to_target_world_xy_m=(ex - vx * dt_s, ey - vy * dt_s),
        gear_to_target_sigma_m=old.gear_to_target_sigma_m + growth_m,
    )


def learn_estimated_velocity_bias(
    old: DeadReckoningState, previous_sample: Telemetry, sample: Telemetry
) -> DeadReckoningState:
    """Return the dead reckoning with the lateral bias of the estimated velocity (world x and y)
    learned from `previous_sample` and `sample`, the newest samples of two successive ticks, during
    a flight in free air under position control.

    In a steady wind, the firmware mistakes the drag for a tilt, and the estimated velocity is wrong
    by up to 0.4 m/s while the vehicle hovers in place. The bias is the estimated velocity minus the
    velocity of the estimated position, both passed through the same low-pass filter. The learned
    bias is wrong for about `ESTIMATED_VELOCITY_BIAS_LEARNING_TIME_CONSTANT_S` after a change in the
    wind.
    """
    dt_s = sample.t_s - previous_sample.t_s
    if not 0.0 < dt_s <= MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S:
        return restart_velocity_bias_filters(old)
    share = 1.0 - math.exp(-dt_s / ESTIMATED_VELOCITY_BIAS_LEARNING_TIME_CONSTANT_S)
    before_m = old.mean_estimated_position_world_xy_m or sample.position_m[:2]
    before_mps = (
        old.estimated_velocity_bias_world_xy_mps
        if old.mean_estimated_position_world_xy_m is None
        else old.mean_estimated_velocity_world_xy_mps
    )
    velocity, position, bias = [], [], []
    for i in range(2):
        velocity.append(before_mps[i] + share * (sample.velocity_mps[i] - before_mps[i]))
        position.append(before_m[i] + share * (sample.position_m[i] - before_m[i]))
        bias.append(
            velocity[i]
            - (sample.position_m[i] - position[i])
            / ESTIMATED_VELOCITY_BIAS_LEARNING_TIME_CONSTANT_S
        )
    size_mps = math.hypot(*bias)
    part = (
        1.0
        if size_mps <= MAX_LEARNED_ESTIMATED_VELOCITY_BIAS_MPS
        else MAX_LEARNED_ESTIMATED_VELOCITY_BIAS_MPS / size_mps
    )
    return replace(
        old,
        estimated_velocity_bias_world_xy_mps=(part * bias[0], part * bias[1]),
        mean_estimated_velocity_world_xy_mps=(velocity[0], velocity[1]),
        mean_estimated_position_world_xy_m=(position[0], position[1]),
        time_under_position_control_s=old.time_under_position_control_s + dt_s,
    )


def learn_acceleration_bias_at_rest(
    old: DeadReckoningState, previous_imu: ImuMotion | None, imu: ImuMotion
) -> DeadReckoningState:
    """Return the dead reckoning of a vehicle that is held still, so that the whole lateral
    acceleration between `previous_imu` and `imu` is the combined bias of accelerometer and
    attitude. A low-pass filter learns this bias; it is unchanged after a gap in the telemetry. The
    bias learned in flight does not apply: in wind, the estimated attitude has an error that
    disappears within a second after the contact."""
    if (
        previous_imu is None
        or not 0.0 < imu.t_s - previous_imu.t_s <= MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S
        or imu.last_telemetry_gap_ended_at_s > previous_imu.t_s
    ):
        return old
    dt_s = imu.t_s - previous_imu.t_s
    share = 1.0 - math.exp(-dt_s / ACCELEROMETER_OFFSET_TIME_CONSTANT_S)
    x_mps2, y_mps2 = (
        (
            imu.velocity_since_first_sample_world_mps[i]
            - previous_imu.velocity_since_first_sample_world_mps[i]
        )
        / dt_s
        for i in range(2)
    )
    bx, by, bz = old.acceleration_bias_world_mps2
    bias = bx + share * (x_mps2 - bx), by + share * (y_mps2 - by)
    return replace(old, acceleration_bias_world_mps2=(*bias, bz))


def restart_velocity_bias_filters(old: DeadReckoningState) -> DeadReckoningState:
    """Return the dead reckoning with the low-pass filters of estimated velocity and position reset,
    from which `learn_estimated_velocity_bias` learns the bias; they restart at the next sample. The
    bias learned so far is kept. Called while the bias cannot be learned, for example after a gap in
    the telemetry or a jump of the state estimate."""
    return (
        old
        if old.mean_estimated_position_world_xy_m is None
        else replace(old, mean_estimated_position_world_xy_m=None)
    )


def correct_acceleration_bias_for_wrong_positions(old: DeadReckoningState) -> DeadReckoningState:
    """Return the dead reckoning with its lateral acceleration bias (world x and y) corrected, once
    external positions are known to be wrong, for example because the axes of the motion capture are
    rotated.

    Wrong positions give the state estimate a velocity that the accelerometer does not measure and,
    in proportion to it, a wrong tilt, which was learned as part of the bias. The correction added
    to the bias is this velocity, gained recently, times
    `ACCELERATION_BIAS_PER_ESTIMATE_MINUS_IMU_VELOCITY_PER_S`.
    """
    (bx, by, bz), (x_mps, y_mps) = (
        old.acceleration_bias_world_mps2,
        old.recent_estimate_minus_imu_velocity_world_xy_mps,
    )
    return replace(
        old,
        acceleration_bias_world_mps2=(
            bx + ACCELERATION_BIAS_PER_ESTIMATE_MINUS_IMU_VELOCITY_PER_S * x_mps,
            by + ACCELERATION_BIAS_PER_ESTIMATE_MINUS_IMU_VELOCITY_PER_S * y_mps,
            bz,
        ),
    )


def accumulate_unexplained_position_step(
    old: DeadReckoningState, previous_sample: Telemetry, sample: Telemetry
) -> DeadReckoningState:
    """Return the dead reckoning after adding an unexplained step of the estimated position, if
    there was one, to the sum of such steps. Their sum makes the offset at a contact less certain.

    The step (world x and y) is the motion of the estimated position from `previous_sample` to
    `sample`, minus the mean of the two estimated velocities times the time. It is ignored below a
    threshold that grows with the time between the samples, and if this time is more than
    `MAX_SAMPLE_INTERVAL_TO_DETECT_POSITION_STEP_S`, because it may then be the vehicle's motion.
    """
    dt_s = _position_timestamp_s(sample) - _position_timestamp_s(previous_sample)
    if not 0.0 < dt_s <= MAX_SAMPLE_INTERVAL_TO_DETECT_POSITION_STEP_S:
        return old
    x_m, y_m = (
        sample.position_m[i]
        - previous_sample.position_m[i]
        - 0.5 * (previous_sample.velocity_mps[i] + sample.velocity_mps[i]) * dt_s
        for i in range(2)
    )
    if (
        math.hypot(x_m, y_m)
        <= MIN_POSITION_STEP_TO_COUNT_AS_UNEXPLAINED_M
        + UNEXPLAINED_POSITION_STEP_THRESHOLD_GROWTH_MPS * dt_s
    ):
        return old
    sx_m, sy_m = old.unexplained_position_step_sum_world_xy_m
    return replace(
        old,
        unexplained_position_step_sum_world_xy_m=(sx_m + x_m, sy_m + y_m),
        last_unexplained_position_step_at_s=sample.t_s,
    )


def _position_timestamp_s(sample: Telemetry) -> float:
    """Return the time, s, at which the sample's position was valid. The position is older than the
    attitude by the sample's `behind_s`; a difference of at most
    `MAX_POSITION_LAG_TO_COUNT_AS_CURRENT_S` is ignored."""
    return sample.t_s - max(0.0, sample.behind_s - MAX_POSITION_LAG_TO_COUNT_AS_CURRENT_S)


def restart_dead_reckoning_at_sighting(
    old: DeadReckoningState,
    t_s: float,
    gear_to_target_world_xy_m: tuple[float, float],
    gear_below_target_m: float,
    sigma_m: float,
) -> DeadReckoningState:
    """Return the dead reckoning with its position relative to the target replaced by that of a
    picture exposed at `t_s`; the velocity is kept.

    `gear_to_target_world_xy_m` is the horizontal vector from the gear to the target, with the
    standard deviation `sigma_m` per axis; `gear_below_target_m` is how far the gear is below the
    target.
    """
    return replace(
        old,
        last_sighting_at_s=t_s,
        gear_to_target_world_xy_m=gear_to_target_world_xy_m,
        gear_below_target_m=gear_below_target_m,
        gear_below_target_lower_bound_m=gear_below_target_m,
        gear_to_target_sigma_m=sigma_m,
    )
