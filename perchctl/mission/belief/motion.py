"""The vehicle's motion from accelerometer and attitude alone.

The accelerometer reads the specific force f in body axes. With the attitude R of the same sample
(yaw-pitch-roll) and the offset o that the accelerometer read at rest, the acceleration in world
axes is

    a = R (f - o) - g

and the velocity since the first sample is its integral by the trapezoid rule:

    sample ──> freeze ──> gap? ──────yes──> start over: the gap may hide a fall
                            │ no
                            v
       offset at rest, tilt due to corrections ──> a, v
                            │
                            v
              fall, impact, steady speed, push, hover thrust: one detector each

This module uses no positions, phases or commands. Each detector records when it last fired, so that
its evidence has an age. `v` drifts by 0.1 m/s per second for each 0.01 rad of attitude error, so it
is compared over short times only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple, Self

from perchctl.geometry import GRAVITY_MPS2
from perchctl.values import replace
from perchctl.vehicle import FLYING, FULL_THRUST, Telemetry

Vector = tuple[float, float, float]
ZERO_VECTOR: Vector = (0.0, 0.0, 0.0)

MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S = 0.2
"""Time without telemetry that counts as a gap, s. In this time a vehicle falls 20 cm, further than
a vehicle that is still hanging can move. Larger: a gap can hide a fall. Smaller: two lost packets
count as a gap."""
MAX_CLIMB_RATE_CHANGE_TO_EXCLUDE_FALL_IN_GAP_MPS = 0.25
"""Largest change in a hanging vehicle's vertical speed that noise of the estimate causes across a
gap, m/s. Larger: a short fall goes undetected."""
MAX_UNEXPLAINED_HEIGHT_CHANGE_TO_EXCLUDE_FALL_IN_GAP_M = 0.25
"""Largest vertical movement across a gap that the speed before the gap does not explain, m. Larger:
a short fall goes undetected."""
MIN_CLIMB_RATE_TO_EXCLUDE_FALL_IN_GAP_MPS = -0.3
"""Climb rate below which the vehicle has fallen across a gap in the telemetry, m/s: a hanging
vehicle never reaches it, and a falling one reaches it after 5 cm. Closer to 0: noise counts as a
fall."""
MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S = 0.2
"""Duration of a series of identical readings that counts as a gap, s. Smaller: readings with a
coarse resolution repeat by chance."""
MAX_SPECIFIC_FORCE_TO_COUNT_AS_FREE_FALL_G = 0.6
"""Specific force below which a vehicle counts as falling, g. Larger: the end of a press counts as a
fall."""
MIN_LOW_G_DURATION_TO_DETECT_FALL_S = 0.1
"""Time for which a falling vehicle reads less than `MAX_SPECIFIC_FORCE_TO_COUNT_AS_FREE_FALL_G`, s;
a rebound is shorter. Larger: a fall is detected 5 cm later."""
MAX_CLIMB_RATE_GAINED_TO_DETECT_FALL_MPS = -0.25
"""Climb rate gained within `FALL_DETECTOR_FORGETTING_TIME_CONSTANT_S` below which the vehicle
counts as falling, whatever the accelerometer's offset, m/s. Closer to 0: vibration counts as a
fall."""
FALL_DETECTOR_GAINED_CLIMB_RATE_UPPER_CLAMP_MPS = 0.5
"""Largest upward speed, gained within `FALL_DETECTOR_FORGETTING_TIME_CONSTANT_S`, that a vehicle
must lose before it counts as falling, m/s. Larger: a fall just after a climb is detected later.
Smaller: a climb that is braked counts as a fall."""
FALL_DETECTOR_FORGETTING_TIME_CONSTANT_S = 1.5
"""Time constant with which a gained vertical speed is forgotten, s. Larger: an offset accumulates
until it looks like a fall."""
UP_ACCELERATION_OFFSET_TIME_CONSTANT_S = 3.0
"""Time constant with which the offset of the vertical acceleration is learned, s. Smaller: a slow
fall is learned as an offset."""
MAX_UP_ACCELERATION_TO_COUNT_AS_CEILING_IMPACT_G = -0.3
"""Acceleration along the world's upward axis below which a reading is an impact on the ceiling and
not a fall, g. Closer to 0: the first samples of a fall are clipped."""
MIN_UPWARD_SPEED_GAIN_TO_DETECT_FLOOR_IMPACT_MPS = 0.22
"""Upward speed gained within `IMPACT_DETECTOR_FORGETTING_TIME_CONSTANT_S` that only the floor can
cause, m/s. Smaller: an increase in thrust is mistaken for the floor."""
IMPACT_DETECTOR_FORGETTING_TIME_CONSTANT_S = 0.1
"""Time constant with which a gained upward speed is forgotten, s. Larger: the effect of thrust
accumulates until it looks like an impact."""
MAX_IMPACT_DETECTION_DELAY_S = 0.05
"""Longest delay between the start of an impact and its detection, s; the speed before the impact is
taken from this far back."""
MAX_TIME_AFTER_IMPACT_TO_COUNT_AS_BOUNCE_S = 0.5
"""Time after an impact within which a further impact is a bounce, s."""
MAX_CLIMB_RATE_DEVIATION_TO_COUNT_AS_STEADY_MPS = 0.06
"""Largest difference between vertical speeds that count as constant, m/s. Larger: a slowly sinking
vehicle counts as motionless."""
MAX_LATERAL_VELOCITY_DEVIATION_TO_COUNT_AS_STEADY_MPS = 0.15
"""Largest difference between the lateral velocity and its mean over
`MEAN_LATERAL_VELOCITY_TIME_CONSTANT_S` that counts as constant, m/s; larger than
`MAX_CLIMB_RATE_DEVIATION_TO_COUNT_AS_STEADY_MPS` because the wind shakes the vehicle."""
MEAN_LATERAL_VELOCITY_TIME_CONSTANT_S = 0.15
"""Time constant of the mean lateral velocity, s."""
ACCELEROMETER_OFFSET_TIME_CONSTANT_S = 0.5
"""Time constant with which the accelerometer's offsets are learned at rest, s. Smaller: vibration
of the floor is learned."""
MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G = 0.06
"""Lateral specific force that only a push can cause, g. Smaller: drag in flight counts as a
push."""
MAX_PUSH_TO_ESTIMATE_RESPONSE_DELAY_S = 1.5
"""Longest time until a push shows in the state estimate, s."""
LATERAL_PUSH_FILTER_TIME_CONSTANT_S = 0.05
"""Time constant of the mean lateral force, s: the vibration of running motors affects single
samples as much as a push does."""
MIN_VELOCITY_STEP_TO_COUNT_AS_ESTIMATE_CORRECTION_MPS = 0.08
"""Lateral speed gained between two samples above which it is a correction of the estimate and not a
motion, m/s."""
ESTIMATE_CORRECTION_VELOCITY_STEP_THRESHOLD_GROWTH_MPS2 = 5.0
"""Increase of `MIN_VELOCITY_STEP_TO_COUNT_AS_ESTIMATE_CORRECTION_MPS` for each second between the
two samples, m/s^2."""
FIRMWARE_TILT_ERROR_DECAY_TIME_CONSTANT_S = 6.0
"""Time constant with which the firmware's own filter removes an error of its tilt, s."""
MEAN_THRUST_PER_G_TIME_CONSTANT_S = 0.5
"""Time constant of the mean hover thrust, s. Larger: a sagging battery is noticed later."""
MIN_FULL_THRUST_FRACTION_TO_LEARN_THRUST_PER_G = 0.4
"""Fraction of full thrust below which no vehicle can hover."""
MAX_FULL_THRUST_FRACTION_TO_LEARN_THRUST_PER_G = 0.95
"""Fraction of full thrust above which the motors are saturated and the thrust for 1 g is
unknown."""
MIN_CLIMB_VARIANCE_GROWTH_TO_COUNT_AS_UNCORRECTED_M2PS2_PER_S = 5e-4
"""Smallest growth of the vertical speed's variance that shows that corrections are missing, (m/s)^2
per second: half of its growth without any corrections."""
MIN_VARIANCE_GROWTH_TIME_TO_DETECT_FUSION_STOP_S = 0.45
"""Time of uninterrupted growth of the variance after which corrections have certainly stopped, s.
Smaller: a pause between two range measurements counts as a stop."""


@dataclass(frozen=True)
class EstimateFusionMonitor:
    """Time since the state estimate was last corrected by a measurement, derived from the variance
    of the vertical speed: without measurements, the variance only grows."""

    climb_variance_m2ps2: float | None = None  # newest variance
    variance_changed_at_s: float = -math.inf  # time at which that variance arrived
    fusion_stopped_at_s: float = math.inf  # time from which the variance has only grown

    def age_s(self, now_s: float) -> float:
        """Age of the last correction at the time `now_s`, s, if corrections have certainly stopped,
        that is, if the variance has only grown for
        `MIN_VARIANCE_GROWTH_TIME_TO_DETECT_FUSION_STOP_S`; otherwise 0."""
        certain = (
            self.variance_changed_at_s - self.fusion_stopped_at_s
            >= MIN_VARIANCE_GROWTH_TIME_TO_DETECT_FUSION_STOP_S
        )
        return now_s - self.fusion_stopped_at_s if certain else 0.0

    def update(self, sample: Telemetry) -> EstimateFusionMonitor:
        """Return the age after one more sample; unchanged if the sample has no new variance. A new
        variance shows a correction if it has grown more slowly than
        `MIN_CLIMB_VARIANCE_GROWTH_TO_COUNT_AS_UNCORRECTED_M2PS2_PER_S`."""
        variance, before = sample.climb_variance_m2ps2, self.climb_variance_m2ps2
        if variance is None or variance == before:
            return self
        least = MIN_CLIMB_VARIANCE_GROWTH_TO_COUNT_AS_UNCORRECTED_M2PS2_PER_S * (
            sample.t_s - self.variance_changed_at_s
        )
        grows = before is not None and variance - before >= least
        fusion_stopped_at_s = (
            min(self.fusion_stopped_at_s, self.variance_changed_at_s) if grows else math.inf
        )
        return EstimateFusionMonitor(variance, sample.t_s, fusion_stopped_at_s)


@dataclass(frozen=True)
class Impact:
    """An impact on the vehicle from below, for example at a touchdown: its time (-inf if there was
    none), the vertical speeds just before it (m/s, positive up; one from the state estimate, one
    integrated from the accelerometer), the largest specific force along the body's z axis (g), and
    the estimated height, world z (m).

    `ImpactDetector` also uses this class for single samples, any of which may prove to be the start
    of an impact. The values are then those of the sample, and the height is not set.
    """

    t_s: float = -math.inf  # -inf: no impact yet
    # vertical speed just before the impact, from the state estimate
    estimated_climb_rate_before_impact_mps: float = 0.0
    # vertical speed just before the impact, from `ImuMotion.velocity_since_first_sample_world_mps`
    imu_climb_rate_before_impact_mps: float = 0.0
    peak_specific_force_body_z_g: float = (
        0.0  # largest specific force during the impact along the body's z axis
    )
    world_z_m: float = 0.0  # height in the state estimate at the impact


# --- Detectors, each with one rule (tests/mission/test_detectors.py) ---


@dataclass(frozen=True)
class FreezeDetector:
    """Detector of frozen readings: three durations, s, for which the readings of the accelerometer,
    of the attitude, and of position and velocity have been identical. In the air, two successive
    readings are never identical, so a long duration means that the readings are out of date. The
    durations of attitude and of position are -inf until that reading first changes."""

    # time for which the accelerometer readings have been identical
    acceleration_frozen_for_s: float = 0.0
    # time for which the attitude readings have been identical; -inf before the first change
    attitude_frozen_for_s: float = -math.inf
    # time for which the position and velocity readings have been identical; -inf before the first
    # change
    position_frozen_for_s: float = -math.inf

    @property
    def only_attitude_frozen_for_s(self) -> float:
        """Time by which the attitude has been frozen for longer than the accelerometer, s: a large
        one shows that only the attitude is frozen. It is 0 if the accelerometer has been frozen
        for as long, and before the attitude's first change."""
        return max(0.0, self.attitude_frozen_for_s - self.acceleration_frozen_for_s)

    @property
    def only_position_frozen_for_s(self) -> float:
        """Time by which position and velocity have been frozen for longer than the accelerometer,
        s: a large one shows that only these are frozen. It is 0 if the accelerometer has been
        frozen for as long, and before their first change."""
        return max(0.0, self.position_frozen_for_s - self.acceleration_frozen_for_s)

    def update_freeze(self, last: Telemetry | None, new: Telemetry) -> Self:
        """Return the detector after one more sample. The time of a reading that equals the one in
        `last` grows by the time between the samples; otherwise, it becomes 0. `last` is None for
        the first sample, which changes nothing."""
        return replace(
            self,
            acceleration_frozen_for_s=_update_frozen_time_s(
                self.acceleration_frozen_for_s, last, new, _GET_ACCELEROMETER_READING
            ),
            attitude_frozen_for_s=_update_frozen_time_s(
                self.attitude_frozen_for_s, last, new, _GET_ATTITUDE
            ),
            position_frozen_for_s=_update_frozen_time_s(
                self.position_frozen_for_s, last, new, _GET_POSITION_AND_VELOCITY
            ),
        )


@dataclass(frozen=True)
class FallDetector:
    """Detector of falls, which records the last time at which the vehicle was falling.

    Let a be the vertical acceleration (positive up, limited to at least
    `MAX_UP_ACCELERATION_TO_COUNT_AS_CEILING_IMPACT_G`) minus its slowly learned offset. The climb
    rate v gained recently is

        v' = min(FALL_DETECTOR_GAINED_CLIMB_RATE_UPPER_CLAMP_MPS,
                 v + a dt - v dt / FALL_DETECTOR_FORGETTING_TIME_CONSTANT_S)

    The upper bound keeps the end of a climb from counting as a fall. The vehicle is falling if v <
    `MAX_CLIMB_RATE_GAINED_TO_DETECT_FALL_MPS` (a negative limit), or if the accelerometer has read
    less than `MAX_SPECIFIC_FORCE_TO_COUNT_AS_FREE_FALL_G` for
    `MIN_LOW_G_DURATION_TO_DETECT_FALL_S`, longer than a rebound lasts. A slow descent goes
    undetected because it is learned as an offset.
    """

    last_fall_at_s: float = -math.inf  # last fall
    # time from which the accelerometer has read less than
    # `MAX_SPECIFIC_FORCE_TO_COUNT_AS_FREE_FALL_G`
    low_g_began_at_s: float = math.inf
    recently_gained_climb_rate_mps: float = 0.0
    up_acceleration_offset_mps2: float = 0.0

    def update_fall(
        self, t_s: float, up_acceleration_mps2: float, specific_force_body_z_g: float, dt_s: float
    ) -> Self:
        """Return the detector at `t_s`, after `dt_s` of vertical acceleration
        `up_acceleration_mps2` (world z, without gravity). `specific_force_body_z_g` is the
        specific force along the body's z axis at `t_s`."""
        offset = self.up_acceleration_offset_mps2 + (
            max(
                MAX_UP_ACCELERATION_TO_COUNT_AS_CEILING_IMPACT_G * GRAVITY_MPS2,
                min(
                    -MAX_UP_ACCELERATION_TO_COUNT_AS_CEILING_IMPACT_G * GRAVITY_MPS2,
                    up_acceleration_mps2,
                ),
            )
            - self.up_acceleration_offset_mps2
        ) * min(1.0, dt_s / UP_ACCELERATION_OFFSET_TIME_CONSTANT_S)
        corrected_mps2 = (
            max(
                up_acceleration_mps2,
                MAX_UP_ACCELERATION_TO_COUNT_AS_CEILING_IMPACT_G * GRAVITY_MPS2,
            )
            - offset
        )
        sink = self.recently_gained_climb_rate_mps + corrected_mps2 * dt_s
        sink = min(
            FALL_DETECTOR_GAINED_CLIMB_RATE_UPPER_CLAMP_MPS,
            sink - sink * dt_s / FALL_DETECTOR_FORGETTING_TIME_CONSTANT_S,
        )
        light = (
            min(self.low_g_began_at_s, t_s)
            if specific_force_body_z_g < MAX_SPECIFIC_FORCE_TO_COUNT_AS_FREE_FALL_G
            else math.inf
        )
        fell = (
            sink < MAX_CLIMB_RATE_GAINED_TO_DETECT_FALL_MPS
            or t_s - light >= MIN_LOW_G_DURATION_TO_DETECT_FALL_S
        )
        return replace(
            self,
            last_fall_at_s=t_s if fell else self.last_fall_at_s,
            low_g_began_at_s=light,
            recently_gained_climb_rate_mps=sink,
            up_acceleration_offset_mps2=offset,
        )


@dataclass(frozen=True)
class ImpactDetector:
    """Detector of impacts from below, for example at a touchdown.

    An impact adds more upward speed in a short time than any thrust can: it is detected while
    `recently_gained_upward_speed_mps`, the integral of the vertical acceleration, which decays with
    `IMPACT_DETECTOR_FORGETTING_TIME_CONSTANT_S` and is never negative, exceeds
    `MIN_UPWARD_SPEED_GAIN_TO_DETECT_FLOOR_IMPACT_MPS`. The peak force of the newest impact includes
    that of its bounces.
    """

    recently_gained_upward_speed_mps: float = 0.0
    last_impact_or_bounce_at_s: float = -math.inf
    # samples of the last `MAX_IMPACT_DETECTION_DELAY_S`, one of which may be the start of an impact
    recent_impact_candidates: tuple[Impact, ...] = ()
    newest_impact: Impact = Impact()  # newest impact from below

    def update_impact(
        self,
        newest_impact_candidate: Impact,
        vehicle_world_z_m: float,
        up_acceleration_mps2: float,
        dt_s: float,
    ) -> Self:
        """Return the detector after `dt_s` of vertical acceleration `up_acceleration_mps2` (world
        z, without gravity). `newest_impact_candidate` describes the sample at the end of that time
        as if an impact began there: its time, its climb rates and its specific force, but no
        height. `vehicle_world_z_m` is the estimated height, world z, at that sample."""
        recently_gained_upward_speed_mps = max(
            0.0,
            self.recently_gained_upward_speed_mps
            * math.exp(-dt_s / IMPACT_DETECTOR_FORGETTING_TIME_CONSTANT_S)
            + up_acceleration_mps2 * dt_s,
        )
        recent = (
            m
            for m in self.recent_impact_candidates
            if newest_impact_candidate.t_s - m.t_s <= MAX_IMPACT_DETECTION_DELAY_S
        )
        recent_impact_candidates = (*recent, newest_impact_candidate)
        return replace(
            self,
            recently_gained_upward_speed_mps=recently_gained_upward_speed_mps,
            last_impact_or_bounce_at_s=newest_impact_candidate.t_s
            if recently_gained_upward_speed_mps > MIN_UPWARD_SPEED_GAIN_TO_DETECT_FLOOR_IMPACT_MPS
            else self.last_impact_or_bounce_at_s,
            recent_impact_candidates=recent_impact_candidates,
            newest_impact=_update_newest_impact(
                self.newest_impact,
                newest_impact_candidate,
                vehicle_world_z_m,
                recent_impact_candidates,
                recently_gained_upward_speed_mps,
            ),
        )


def _update_newest_impact(
    old: Impact,
    newest_impact_candidate: Impact,
    vehicle_world_z_m: float,
    recent_impact_candidates: tuple[Impact, ...],
    recently_gained_upward_speed_mps: float,
) -> Impact:
    """Return the newest impact after one more sample.

    `newest_impact_candidate` holds the sample's time, its two climb rates (from the state estimate
    and from the accelerometer, m/s) and its specific force along the body's z axis (g), but no
    height. `recent_impact_candidates` holds such samples from the last
    `MAX_IMPACT_DETECTION_DELAY_S`, including `newest_impact_candidate`. `vehicle_world_z_m` is the
    estimated height of the vehicle at the newest sample.

    An impact is detected while `recently_gained_upward_speed_mps` exceeds
    `MIN_UPWARD_SPEED_GAIN_TO_DETECT_FLOOR_IMPACT_MPS`:

    - More than `MAX_TIME_AFTER_IMPACT_TO_COUNT_AS_BOUNCE_S` after `old`, a new impact replaces
      `old`. Its climb rates before the impact are the lowest of `recent_impact_candidates`, because
      the onboard estimate often includes the whole impact before it is detected. Climb rates are
      signed, so the lowest one is the fastest descent. Its peak is the largest specific force of
      `recent_impact_candidates` along the body's z axis, g.
    - Up to that time, the detection is a bounce or the rest of the same impact and is merged into
      `old`: it can only lower the climb rates and raise the peak. Time and height remain those of
      `old`.

    Without a detection, a sample up to that time after `old` can still raise the peak; later, `old`
    is returned unchanged.
    """
    follows = newest_impact_candidate.t_s - old.t_s <= MAX_TIME_AFTER_IMPACT_TO_COUNT_AS_BOUNCE_S
    if recently_gained_upward_speed_mps > MIN_UPWARD_SPEED_GAIN_TO_DETECT_FLOOR_IMPACT_MPS:
        begun = Impact(
            newest_impact_candidate.t_s,
            min(
                moment.estimated_climb_rate_before_impact_mps for moment in recent_impact_candidates
            ),
            min(moment.imu_climb_rate_before_impact_mps for moment in recent_impact_candidates),
            max(moment.peak_specific_force_body_z_g for moment in recent_impact_candidates),
            vehicle_world_z_m,
        )
        if not follows:
            return begun
        return replace(
            old,
            peak_specific_force_body_z_g=max(
                old.peak_specific_force_body_z_g, begun.peak_specific_force_body_z_g
            ),
            estimated_climb_rate_before_impact_mps=min(
                old.estimated_climb_rate_before_impact_mps,
                begun.estimated_climb_rate_before_impact_mps,
            ),
            imu_climb_rate_before_impact_mps=min(
                old.imu_climb_rate_before_impact_mps, begun.imu_climb_rate_before_impact_mps
            ),
        )
    return (
        replace(
            old,
            peak_specific_force_body_z_g=max(
                old.peak_specific_force_body_z_g,
                newest_impact_candidate.peak_specific_force_body_z_g,
            ),
        )
        if follows
        else old
    )


@dataclass(frozen=True)
class SteadySpeedDetector:
    """Times from which the vertical speed, and the lateral velocity in world axes, have been
    constant, and the values to which newer velocities are compared: the vertical speed at its start
    time, and the low-passed lateral velocity. All velocities are integrated from the accelerometer.
    Both times are inf before the first sample."""

    # time from which the vertical speed has been constant
    climb_rate_became_steady_at_s: float = math.inf
    steady_climb_rate_mps: float = 0.0
    # time from which the lateral velocity has been constant
    lateral_velocity_became_steady_at_s: float = math.inf
    # mean over `MEAN_LATERAL_VELOCITY_TIME_CONSTANT_S`
    mean_lateral_velocity_world_xy_mps: tuple[float, float] = (0.0, 0.0)

    def update_steady_speed(self, t_s: float, velocity_world_mps: Vector, dt_s: float) -> Self:
        """Return the detector at `t_s`, `dt_s` after its previous sample. `velocity_world_mps` is
        the newest velocity in world axes, integrated from the accelerometer.

        Vertical speed and lateral velocity each have their own start time, from which they count as
        constant. That of the vertical speed is reset to `t_s` if the speed has changed by more than
        `MAX_CLIMB_RATE_DEVIATION_TO_COUNT_AS_STEADY_MPS` since then. That of the lateral velocity
        is reset if this velocity differs from its mean by more than
        `MAX_LATERAL_VELOCITY_DEVIATION_TO_COUNT_AS_STEADY_MPS`.
        """
        x, y, z = velocity_world_mps
        climb_rate_became_steady_at_s, steady_climb_rate_mps = (
            self.climb_rate_became_steady_at_s,
            self.steady_climb_rate_mps,
        )
        if abs(z - steady_climb_rate_mps) > MAX_CLIMB_RATE_DEVIATION_TO_COUNT_AS_STEADY_MPS:
            climb_rate_became_steady_at_s, steady_climb_rate_mps = t_s, z
        lateral_velocity_became_steady_at_s, (mean_x, mean_y) = (
            self.lateral_velocity_became_steady_at_s,
            self.mean_lateral_velocity_world_xy_mps,
        )
        keeps = math.exp(-dt_s / MEAN_LATERAL_VELOCITY_TIME_CONSTANT_S)
        mean_lateral_velocity_world_xy_mps = (x + keeps * (mean_x - x), y + keeps * (mean_y - y))
        if (
            math.dist((x, y), mean_lateral_velocity_world_xy_mps)
            > MAX_LATERAL_VELOCITY_DEVIATION_TO_COUNT_AS_STEADY_MPS
        ):
            lateral_velocity_became_steady_at_s = t_s
        return replace(
            self,
            climb_rate_became_steady_at_s=climb_rate_became_steady_at_s,
            steady_climb_rate_mps=steady_climb_rate_mps,
            lateral_velocity_became_steady_at_s=lateral_velocity_became_steady_at_s,
            mean_lateral_velocity_world_xy_mps=mean_lateral_velocity_world_xy_mps,
        )


@dataclass(frozen=True)
class LateralPushDetector:
    """Detector of lateral pushes. A push is a specific force perpendicular to the body's z axis
    that exceeds `MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G`, more than drag in flight causes, on
    average over `LATERAL_PUSH_FILTER_TIME_CONSTANT_S`."""

    mean_specific_force_body_xy_g: tuple[float, float] = (0.0, 0.0)  # mean lateral force, body axes
    last_lateral_push_at_s: float = -math.inf  # time of the last lateral push

    def update_lateral_push(
        self, new: Telemetry, accelerometer_offset_g: Vector, dt_s: float
    ) -> Self:
        """Return the detector after the sample `new`, taken `dt_s` after the previous one.
        `accelerometer_offset_g`, the accelerometer's offset at rest in body axes, is subtracted
        from the sample's specific force."""
        keeps = math.exp(-dt_s / LATERAL_PUSH_FILTER_TIME_CONSTANT_S)
        x_g, y_g = new.acc_x_g - accelerometer_offset_g[0], new.acc_y_g - accelerometer_offset_g[1]
        mean_x_g, mean_y_g = self.mean_specific_force_body_xy_g
        mean_specific_force_body_xy_g = (
            x_g + keeps * (mean_x_g - new.acc_x_g + accelerometer_offset_g[0]),
            y_g + keeps * (mean_y_g - new.acc_y_g + accelerometer_offset_g[1]),
        )
        pushes = (
            math.hypot(*mean_specific_force_body_xy_g) > MIN_LATERAL_SPECIFIC_FORCE_TO_DETECT_PUSH_G
        )
        return replace(
            self,
            mean_specific_force_body_xy_g=mean_specific_force_body_xy_g,
            last_lateral_push_at_s=new.t_s if pushes else self.last_lateral_push_at_s,
        )


# --- All detectors together ---


@dataclass(frozen=True)
class ImuMotion(
    FreezeDetector, FallDetector, ImpactDetector, SteadySpeedDetector, LateralPushDetector
):
    """The vehicle's motion from accelerometer and attitude alone: velocity gained since the first
    sample (world axes), falls, impacts, lateral pushes and telemetry gaps.

    A time of -inf means that an event has not happened yet. A time of inf means that a state has
    not begun: the motors are turning, the accelerometer reads more than in free fall, or there is
    no sample yet from which a speed could be constant.
    """

    t_s: float = -math.inf  # time of the newest sample
    # velocity gained since the first sample, world axes
    velocity_since_first_sample_world_mps: Vector = ZERO_VECTOR
    accelerometer_offset_g: Vector = ZERO_VECTOR  # offset of the accelerometer at rest, body axes
    last_telemetry_gap_ended_at_s: float = -math.inf  # end of the newest gap
    # end of the newest gap that may hide a fall
    last_gap_that_may_hide_fall_ended_at_s: float = -math.inf
    vehicle_restarted_at_s: float = -math.inf  # first sample after the vehicle restarted
    # total change of the estimated height over the successive gaps up to the newest sample; at most
    # 0, and 0 if no gap precedes that sample
    estimated_height_change_in_newest_gap_m: float = 0.0
    mean_raw_thrust_per_g: float = 0.0  # mean thrust per measured g in flight
    # roll and pitch errors caused by corrections
    error_of_estimated_roll_pitch_rad: tuple[float, float] = (0.0, 0.0)
    body_roll_pitch_rate_radps: tuple[float, float] = (0.0, 0.0)
    # age of the last correction of the state estimate, which this motion does not use
    estimate_fusion_monitor: EstimateFusionMonitor = EstimateFusionMonitor()
    # time at which the motors went off; inf while they are turning
    motors_stopped_at_s: float = math.inf

    def with_sample(self, last: Telemetry | None, new: Telemetry) -> ImuMotion:
        """Return the motion after the sample `new`. `last` is the previous sample, None at the
        first. If the samples are more than `MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S` apart, or
        the accelerometer has been frozen for more than
        `MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S`, the detectors restart instead, and the
        velocity does not change."""
        dt_s = math.inf if last is None else new.t_s - last.t_s
        started_anew = last is not None and new.start != last.start
        motion = replace(
            self.update_freeze(last, new),
            t_s=new.t_s,
            vehicle_restarted_at_s=new.t_s if started_anew else self.vehicle_restarted_at_s,
            estimate_fusion_monitor=self.estimate_fusion_monitor.update(new),
            motors_stopped_at_s=min(self.motors_stopped_at_s, new.t_s)
            if new.thrust < 1
            else math.inf,
        )
        if (
            last is None
            or not 0.0 < dt_s <= MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S
            or motion.acceleration_frozen_for_s > MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S
        ):
            return _restart_after_telemetry_gap(motion, last, new)
        motion, up_acceleration_mps2 = _integrate_acceleration(motion, last, new, dt_s)
        now = Impact(
            new.t_s,
            new.velocity_mps[2],
            motion.velocity_since_first_sample_world_mps[2],
            new.acc_z_g,
        )
        motion = (
            motion.update_fall(new.t_s, up_acceleration_mps2, new.acc_z_g, dt_s)
            .update_impact(now, new.position_m[2], up_acceleration_mps2, dt_s)
            .update_steady_speed(new.t_s, motion.velocity_since_first_sample_world_mps, dt_s)
            .update_lateral_push(new, motion.accelerometer_offset_g, dt_s)
        )
        hover_thrust = _filter_hover_thrust(motion.mean_raw_thrust_per_g, new, dt_s)
        return replace(
            motion, estimated_height_change_in_newest_gap_m=0.0, mean_raw_thrust_per_g=hover_thrust
        )

    @staticmethod
    def compute_acceleration_world_mps2(
        sample: Telemetry,
        accelerometer_offset_g: Vector,
        error_of_estimated_roll_pitch_rad: tuple[float, float] = (0.0, 0.0),
    ) -> Vector:
        """Return the vehicle's acceleration (x, y, z) in world axes, m/s^2, without gravity: 0 in
        hover and at rest.

        It is the sample's specific force, minus `accelerometer_offset_g` (body axes), rotated by
        the sample's attitude, whose roll and pitch are first reduced by
        `error_of_estimated_roll_pitch_rad`. An attitude error that remains appears as a lateral
        acceleration of about 9.8 m/s^2 per rad.
        """
        roll_rad, pitch_rad = (
            sample.roll_rad - error_of_estimated_roll_pitch_rad[0],
            sample.pitch_rad - error_of_estimated_roll_pitch_rad[1],
        )
        cr, sr = math.cos(roll_rad), math.sin(roll_rad)
        cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
        cy, sy = math.cos(sample.yaw_rad), math.sin(sample.yaw_rad)
        fx, fy = (
            sample.acc_x_g - accelerometer_offset_g[0],
            sample.acc_y_g - accelerometer_offset_g[1],
        )
        fz = sample.acc_z_g - accelerometer_offset_g[2]
        level_x = cp * fx + sp * (sr * fy + cr * fz)
        level_y = cr * fy - sr * fz
        up = -sp * fx + cp * (sr * fy + cr * fz)
        g = GRAVITY_MPS2
        return (
            g * (cy * level_x - sy * level_y),
            g * (sy * level_x + cy * level_y),
            g * (up - 1.0),
        )


def _restart_after_telemetry_gap(
    motion: ImuMotion, last: Telemetry | None, new: Telemetry
) -> ImuMotion:
    """Return the motion at the sample `new`, the first sample ever (`last` is None) or the first
    one after a gap in the telemetry. The detectors restart; the velocity and the learned offsets of
    the accelerometer are kept. After a gap, the motion records its end, and whether the vehicle may
    have fallen during it."""
    motion = replace(
        motion,
        climb_rate_became_steady_at_s=new.t_s,
        steady_climb_rate_mps=motion.velocity_since_first_sample_world_mps[2],
        lateral_velocity_became_steady_at_s=new.t_s,
        mean_lateral_velocity_world_xy_mps=motion.velocity_since_first_sample_world_mps[:2],
        recently_gained_climb_rate_mps=0.0,
        recently_gained_upward_speed_mps=0.0,
        low_g_began_at_s=math.inf,
    )
    if last is None:
        return replace(motion, estimated_height_change_in_newest_gap_m=0.0)
    estimated_height_change_in_newest_gap_m = min(
        0.0, motion.estimated_height_change_in_newest_gap_m + new.position_m[2] - last.position_m[2]
    )
    alive = (
        0.0 <= motion.position_frozen_for_s <= MAX_FROZEN_READING_DURATION_TO_TRUST_SAMPLE_S
        and new.start == last.start
    )
    if alive and _can_exclude_fall_in_telemetry_gap(
        last, new, estimated_height_change_in_newest_gap_m
    ):
        return replace(
            motion,
            last_telemetry_gap_ended_at_s=new.t_s,
            estimated_height_change_in_newest_gap_m=estimated_height_change_in_newest_gap_m,
        )
    return replace(
        motion,
        last_telemetry_gap_ended_at_s=new.t_s,
        last_gap_that_may_hide_fall_ended_at_s=new.t_s,
        estimated_height_change_in_newest_gap_m=0.0,
    )


def _can_exclude_fall_in_telemetry_gap(
    last: Telemetry, new: Telemetry, estimated_height_change_in_newest_gap_m: float
) -> bool:
    """True if the state estimate shows that the vehicle did not fall in the gap between the samples
    `last` and `new`. `estimated_height_change_in_newest_gap_m` is the total change of the estimated
    height over successive gaps, at most 0."""
    dt_s = new.t_s - last.t_s
    gained_mps = new.velocity_mps[2] - last.velocity_mps[2]
    unexplained_m = new.position_m[2] - last.position_m[2] - last.velocity_mps[2] * dt_s
    if max(last.behind_s, new.behind_s) > MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S:
        return False
    if 0.0 < dt_s <= MAX_SAMPLE_INTERVAL_WITHOUT_TELEMETRY_GAP_S:
        return (
            new.velocity_mps[2] > MIN_CLIMB_RATE_TO_EXCLUDE_FALL_IN_GAP_MPS
            and estimated_height_change_in_newest_gap_m
            > -MAX_UNEXPLAINED_HEIGHT_CHANGE_TO_EXCLUDE_FALL_IN_GAP_M
        )
    return (
        abs(gained_mps) <= MAX_CLIMB_RATE_CHANGE_TO_EXCLUDE_FALL_IN_GAP_MPS
        and abs(unexplained_m) <= MAX_UNEXPLAINED_HEIGHT_CHANGE_TO_EXCLUDE_FALL_IN_GAP_M
    )


def _integrate_acceleration(
    motion: ImuMotion, last: Telemetry, new: Telemetry, dt_s: float
) -> tuple[ImuMotion, float]:
    """Return the motion with its velocity integrated by the trapezoid rule from `last` to `new`,
    `dt_s` later, and the mean vertical acceleration between the two samples, m/s^2 (world z,
    without gravity). The accelerometer's offsets are learned while the motors are off and the
    vehicle is not flying."""
    accelerometer_offset_g = motion.accelerometer_offset_g
    if new.thrust < 1 and not new.has_bit(FLYING):
        accelerometer_offset_g = _filter_accelerometer_offset(
            accelerometer_offset_g, new, min(1.0, dt_s / ACCELEROMETER_OFFSET_TIME_CONSTANT_S)
        )
    error_of_estimated_roll_pitch_rad, body_roll_pitch_rate_radps = _estimate_tilt_error(
        motion, last, new, dt_s
    )
    before = ImuMotion.compute_acceleration_world_mps2(
        last, accelerometer_offset_g, motion.error_of_estimated_roll_pitch_rad
    )
    after = ImuMotion.compute_acceleration_world_mps2(
        new, accelerometer_offset_g, error_of_estimated_roll_pitch_rad
    )
    dv = tuple(0.5 * (a + b) * dt_s for a, b in zip(before, after, strict=True))
    x, y, z = (v + d for v, d in zip(motion.velocity_since_first_sample_world_mps, dv, strict=True))
    motion = replace(
        motion,
        velocity_since_first_sample_world_mps=(x, y, z),
        accelerometer_offset_g=accelerometer_offset_g,
        error_of_estimated_roll_pitch_rad=error_of_estimated_roll_pitch_rad,
        body_roll_pitch_rate_radps=body_roll_pitch_rate_radps,
    )
    return motion, dv[2] / dt_s


class TiltErrorAndRate(NamedTuple):
    """Error of the estimated roll and pitch (estimated minus true), rad, and the rates of both
    angles between the newest two samples without a correction of the estimate, rad/s."""

    error_of_estimated_roll_pitch_rad: tuple[float, float]
    body_roll_pitch_rate_radps: tuple[float, float]


def _estimate_tilt_error(
    motion: ImuMotion, last: Telemetry, new: Telemetry, dt_s: float
) -> TiltErrorAndRate:
    """Return the error of the estimated roll and pitch after the sample `new`, `dt_s` after `last`,
    and the rates of roll and pitch.

    If the lateral velocity steps from `last` to `new`, the estimate has been corrected, and its
    attitude with it. The rotation between the samples that the previous rates do not explain is
    then added to the error, and the previous rates are kept. The error decays as the firmware's
    filter removes it.
    """
    gained_mps = math.dist(new.velocity_mps[:2], last.velocity_mps[:2])
    turned = (new.roll_rad - last.roll_rad, new.pitch_rad - last.pitch_rad)
    kept = 1.0 - dt_s / FIRMWARE_TILT_ERROR_DECAY_TIME_CONSTANT_S
    (roll, pitch), rates = (
        motion.error_of_estimated_roll_pitch_rad,
        motion.body_roll_pitch_rate_radps,
    )
    if (
        gained_mps
        <= MIN_VELOCITY_STEP_TO_COUNT_AS_ESTIMATE_CORRECTION_MPS
        + ESTIMATE_CORRECTION_VELOCITY_STEP_THRESHOLD_GROWTH_MPS2 * dt_s
    ):
        return TiltErrorAndRate((kept * roll, kept * pitch), (turned[0] / dt_s, turned[1] / dt_s))
    error = (
        kept * roll + turned[0] - rates[0] * dt_s,
        kept * pitch + turned[1] - rates[1] * dt_s,
    )
    return TiltErrorAndRate(error, rates)


_GET_ACCELEROMETER_READING = attrgetter("acc_x_g", "acc_y_g", "acc_z_g")
_GET_ATTITUDE = attrgetter("roll_rad", "pitch_rad", "yaw_rad")
_GET_POSITION_AND_VELOCITY = attrgetter("position_m", "velocity_mps")


def _update_frozen_time_s(
    previously_frozen_for_s: float,
    last: Telemetry | None,
    new: Telemetry,
    get_reading: Callable[[Telemetry], object],
) -> float:
    if last is None:
        return previously_frozen_for_s
    return (
        0.0
        if get_reading(last) != get_reading(new)
        else previously_frozen_for_s + max(0.0, new.t_s - last.t_s)
    )


def _filter_hover_thrust(old_hover_thrust: float, sample: Telemetry, dt_s: float) -> float:
    flies = (
        sample.has_bit(FLYING)
        and sample.thrust < MAX_FULL_THRUST_FRACTION_TO_LEARN_THRUST_PER_G * FULL_THRUST
    )
    if (
        not flies
        or sample.thrust < MIN_FULL_THRUST_FRACTION_TO_LEARN_THRUST_PER_G * FULL_THRUST
        or not 0.8 <= sample.acc_z_g <= 1.2
    ):
        return old_hover_thrust
    measured = sample.thrust / sample.acc_z_g
    return (
        measured
        if old_hover_thrust == 0.0
        else old_hover_thrust
        + (measured - old_hover_thrust) * min(1.0, dt_s / MEAN_THRUST_PER_G_TIME_CONSTANT_S)
    )


def _filter_accelerometer_offset(
    old_offset_g: Vector, sample: Telemetry, new_sample_weight: float
) -> Vector:
    cr, sr = math.cos(sample.roll_rad), math.sin(sample.roll_rad)
    cp, sp = math.cos(sample.pitch_rad), math.sin(sample.pitch_rad)
    x, y, z = sample.acc_x_g + sp, sample.acc_y_g - cp * sr, sample.acc_z_g - cp * cr
    ox, oy, oz = old_offset_g
    return (
        ox + new_sample_weight * (x - ox),
        oy + new_sample_weight * (y - oy),
        oz + new_sample_weight * (z - oz),
    )
