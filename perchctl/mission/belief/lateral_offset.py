"""Estimate the vehicle's lateral offset from the target with a separate Kalman filter.

Below the target, a picture measures the offset to a fraction of a millimetre, but it arrives a
tenth of a second late, and the estimated position wanders by two millimetres meanwhile. Attitude
and estimated velocity show better how the vehicle has moved since the exposure: a hovering vehicle
accelerates in the direction in which it leans. For each of the axes x and y, with the offset e from
the gear to the target, the vehicle's velocity v, and the acceleration a due to the tilt:

    de/dt = -v        dv/dt = a + w        picture: e + n_e        state estimate: v + n_v

w is white noise (gusts, thrust fluctuations, an error of the mean tilt), n_e is the noise of a
picture's pose, and n_v is the noise of the estimated velocity. Pictures arrive late, so the
filter's state stays at the exposure time of the newest picture. The filter keeps the telemetry
samples since then and uses them to predict the state at a later time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from perchctl.values import replace

LateralVector = tuple[float, float]

ACCELERATION_PROCESS_NOISE_SIGMA_MPS2 = 0.15
"""Standard deviation of the acceleration that the tilt does not explain, m/s^2. Larger: the
velocity follows the noise of single pictures. Smaller: after a gust, the offset lags behind."""
ACCELERATION_PROCESS_NOISE_CORRELATION_TIME_S = 0.1
"""Correlation time of the acceleration that the tilt does not explain, s. A larger value has the
same effect as a larger standard deviation."""
MIN_MEASURED_OFFSET_SIGMA_M = 0.0005
"""Smallest standard deviation of an offset measured in a picture, m: attitude and exposure time are
not exact either. Smaller: the velocity follows their errors."""
INITIAL_VELOCITY_SIGMA_MPS = 0.3
"""Standard deviation of the unknown velocity at the first picture, m/s."""
ESTIMATED_VELOCITY_MEASUREMENT_SIGMA_MPS = 0.04
"""Standard deviation of the estimated velocity, m/s, with the errors of the samples treated as
independent; the error of a Flow deck is 8 mm/s, but lasts for a tenth of a second. Larger: an
acceleration that the tilt does not explain is noticed one picture later. Smaller: the error of the
estimate moves the vehicle."""
MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S = 0.5
"""Longest time between two pictures, and from the newest picture to a prediction, s. Larger: a gust
moves the vehicle unnoticed. Smaller: the vehicle flies the last centimetres with the state estimate
instead of this filter."""
MIN_NIS_TO_RESTART_FILTER = 20.0
"""Normalized innovation squared (two degrees of freedom) above which a picture restarts the filter;
by chance, one in 20,000 pictures exceeds it. Larger: after a jump of the pose, the velocity is
wrong."""
MAX_VELOCITY_SIGMA_TO_USE_FILTER_MPS = 0.03
"""Largest standard deviation of the filter's velocity at which the filter is used, m/s; above it,
`predict` returns None. Larger: the noise of the first pictures steers the vehicle."""


@dataclass(frozen=True)
class LateralOffsetAndVelocity:
    """Horizontal vector from the gear to the target and horizontal velocity of the vehicle, both
    (x, y) in world axes, with their standard deviations per axis."""

    gear_to_target_world_xy_m: LateralVector
    vehicle_velocity_world_xy_mps: LateralVector
    gear_to_target_sigma_m: float
    velocity_sigma_mps: float


class LateralMotionSample(NamedTuple):
    """Lateral motion of the vehicle at `t_s`, the time of a telemetry sample: the acceleration that
    its tilt causes and its estimated velocity, both (x, y) in world axes."""

    t_s: float
    acceleration_from_tilt_world_xy_mps2: LateralVector
    estimated_velocity_world_xy_mps: LateralVector


class OffsetVelocityCovariance(NamedTuple):
    """Covariance matrix of lateral offset and lateral velocity along one axis. The matrix is the
    same for x and y."""

    offset_variance_m2: float = 0.0  # variance of the offset
    offset_velocity_covariance_m2ps: float = 0.0  # covariance of offset and velocity
    velocity_variance_m2ps2: float = 0.0  # variance of the velocity


UNSET_COVARIANCE = OffsetVelocityCovariance()
"""Placeholder for the covariance before the first picture; its values are never used."""


@dataclass(frozen=True)
class LateralOffsetFilter:
    """Kalman filter of the horizontal vector from gear to target and of the vehicle's horizontal
    velocity, both (x, y) in world axes. Pictures measure the offset, and the vehicle's tilt
    determines its acceleration.

    The state is valid at `t_s`, the exposure time of the newest picture, which is -inf before the
    first picture. `samples` holds the telemetry since then and a few earlier samples.
    """

    t_s: float = -math.inf
    gear_to_target_world_xy_m: LateralVector = (0.0, 0.0)
    vehicle_velocity_world_xy_mps: LateralVector = (0.0, 0.0)
    covariance: OffsetVelocityCovariance = UNSET_COVARIANCE
    samples: tuple[LateralMotionSample, ...] = ()

    def with_sample(self, sample: LateralMotionSample) -> LateralOffsetFilter:
        """Return the filter with one more telemetry sample. A sample that is not newer than the
        last one is ignored. Samples too old for any later picture are dropped."""
        kept = self.samples
        if kept and sample.t_s <= kept[-1].t_s:
            return self
        first = 0
        while (
            first < len(kept)
            and kept[first].t_s < sample.t_s - MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S
        ):
            first += 1
        return replace(self, samples=(*kept[first:], sample))

    def with_picture_measurement(
        self, t_s: float, gear_to_target_world_xy_m: LateralVector, sigma_m: float
    ) -> LateralOffsetFilter:
        """Return the filter, now valid at `t_s`, after a picture exposed at `t_s` that measured the
        vector from the gear to the target (world x and y, m) with the standard deviation `sigma_m`
        per axis.

        A picture that is not newer than the last one changes nothing. After a gap of more than
        `MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S`, or if the normalized innovation squared
        exceeds `MIN_NIS_TO_RESTART_FILTER`, the filter restarts at the measured vector with unknown
        velocity.
        """
        if t_s <= self.t_s:
            return self
        variance_m2 = max(sigma_m, MIN_MEASURED_OFFSET_SIGMA_M) ** 2
        if t_s - self.t_s > MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S:
            return self._restart(t_s, gear_to_target_world_xy_m, variance_m2)
        predicted = self._propagate_through_samples(t_s)
        p_ee, p_ev, p_vv = predicted.covariance
        innovation_m = (
            gear_to_target_world_xy_m[0] - predicted.gear_to_target_world_xy_m[0],
            gear_to_target_world_xy_m[1] - predicted.gear_to_target_world_xy_m[1],
        )
        innovation_variance_m2 = p_ee + variance_m2
        if math.hypot(*innovation_m) ** 2 > MIN_NIS_TO_RESTART_FILTER * innovation_variance_m2:
            return self._restart(t_s, gear_to_target_world_xy_m, variance_m2)
        gain_e, gain_v = p_ee / innovation_variance_m2, p_ev / innovation_variance_m2
        return replace(
            predicted,
            gear_to_target_world_xy_m=_add_scaled(
                predicted.gear_to_target_world_xy_m, gain_e, innovation_m
            ),
            vehicle_velocity_world_xy_mps=_add_scaled(
                predicted.vehicle_velocity_world_xy_mps, gain_v, innovation_m
            ),
            covariance=OffsetVelocityCovariance(
                (1.0 - gain_e) * p_ee, (1.0 - gain_e) * p_ev, p_vv - gain_v * p_ev
            ),
        )

    def predict(self, t_s: float) -> LateralOffsetAndVelocity | None:
        """Return the estimate at `t_s`; None if the newest picture is older than
        `MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S`, or while the velocity is less certain than
        `MAX_VELOCITY_SIGMA_TO_USE_FILTER_MPS`."""
        if not 0.0 <= t_s - self.t_s <= MAX_FILTER_PREDICTION_TIME_WITHOUT_PICTURE_S:
            return None
        if (
            math.sqrt(self.covariance.velocity_variance_m2ps2)
            > MAX_VELOCITY_SIGMA_TO_USE_FILTER_MPS
        ):
            return None
        predicted = self._propagate_through_samples(t_s)
        p_ee, _, p_vv = predicted.covariance
        return LateralOffsetAndVelocity(
            predicted.gear_to_target_world_xy_m,
            predicted.vehicle_velocity_world_xy_mps,
            math.sqrt(p_ee),
            math.sqrt(p_vv),
        )

    def _restart(
        self, t_s: float, gear_to_target_world_xy_m: LateralVector, variance_m2: float
    ) -> LateralOffsetFilter:
        return replace(
            self,
            t_s=t_s,
            gear_to_target_world_xy_m=gear_to_target_world_xy_m,
            vehicle_velocity_world_xy_mps=(0.0, 0.0),
            covariance=OffsetVelocityCovariance(variance_m2, 0.0, INITIAL_VELOCITY_SIGMA_MPS**2),
        )

    def _propagate_through_samples(self, t_s: float) -> LateralOffsetFilter:
        """Return the filter at the later time `t_s`: propagated with the acceleration from the
        samples' tilt, and corrected with the estimated velocity of each sample up to `t_s`. Between
        two samples, the acceleration is their mean; after the last sample, it stays constant."""
        predicted, before = self, self.samples[0] if self.samples else None
        for sample in self.samples:
            if sample.t_s > predicted.t_s:
                assert before is not None
                mean_mps2 = _add_scaled(
                    (
                        0.5 * before.acceleration_from_tilt_world_xy_mps2[0],
                        0.5 * before.acceleration_from_tilt_world_xy_mps2[1],
                    ),
                    0.5,
                    sample.acceleration_from_tilt_world_xy_mps2,
                )
                predicted = predicted._propagate(min(t_s, sample.t_s), mean_mps2)
                if sample.t_s > t_s:
                    return predicted
                predicted = predicted._with_velocity_measurement(
                    sample.estimated_velocity_world_xy_mps
                )
            before = sample
        return predicted._propagate(
            t_s, (0.0, 0.0) if before is None else before.acceleration_from_tilt_world_xy_mps2
        )

    def _propagate(self, t_s: float, acceleration_mps2: LateralVector) -> LateralOffsetFilter:
        """Return the filter at `t_s`, which is not before its own time, after the vehicle has
        accelerated at the constant `acceleration_mps2` (world x and y) since then. The vector from
        the gear to the target changes by minus the vehicle's motion."""
        dt_s = t_s - self.t_s
        density = (
            ACCELERATION_PROCESS_NOISE_SIGMA_MPS2**2 * ACCELERATION_PROCESS_NOISE_CORRELATION_TIME_S
        )
        p_ee, p_ev, p_vv = self.covariance
        moved_m = _add_scaled(
            self.gear_to_target_world_xy_m, -dt_s, self.vehicle_velocity_world_xy_mps
        )
        return replace(
            self,
            t_s=t_s,
            gear_to_target_world_xy_m=_add_scaled(moved_m, -0.5 * dt_s * dt_s, acceleration_mps2),
            vehicle_velocity_world_xy_mps=_add_scaled(
                self.vehicle_velocity_world_xy_mps, dt_s, acceleration_mps2
            ),
            covariance=OffsetVelocityCovariance(
                p_ee - 2.0 * dt_s * p_ev + dt_s**2 * p_vv + density * dt_s**3 / 3.0,
                p_ev - dt_s * p_vv - density * dt_s**2 / 2.0,
                p_vv + density * dt_s,
            ),
        )

    def _with_velocity_measurement(
        self, estimated_velocity_world_xy_mps: LateralVector
    ) -> LateralOffsetFilter:
        """Return the filter after a Kalman update, at its own time `t_s`, with the vehicle's
        velocity from the state estimate (world x and y), which has the standard deviation
        `ESTIMATED_VELOCITY_MEASUREMENT_SIGMA_MPS` per axis."""
        p_ee, p_ev, p_vv = self.covariance
        variance = p_vv + ESTIMATED_VELOCITY_MEASUREMENT_SIGMA_MPS**2
        gain_e, gain_v = p_ev / variance, p_vv / variance
        innovation_mps = _add_scaled(
            estimated_velocity_world_xy_mps, -1.0, self.vehicle_velocity_world_xy_mps
        )
        return replace(
            self,
            gear_to_target_world_xy_m=_add_scaled(
                self.gear_to_target_world_xy_m, gain_e, innovation_mps
            ),
            vehicle_velocity_world_xy_mps=_add_scaled(
                self.vehicle_velocity_world_xy_mps, gain_v, innovation_mps
            ),
            covariance=OffsetVelocityCovariance(
                p_ee - gain_e * p_ev, (1.0 - gain_v) * p_ev, (1.0 - gain_v) * p_vv
            ),
        )


def _add_scaled(vector: LateralVector, factor: float, added_vector: LateralVector) -> LateralVector:
    """Return ``vector + factor * added_vector``."""
    return vector[0] + factor * added_vector[0], vector[1] + factor * added_vector[1]
