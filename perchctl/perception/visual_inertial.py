"""Check that the images show the motion that the accelerometer measures.

Take the vector from the body to the target, rotated by the attitude at the exposure, and add the
body's own motion from the accelerometer. This sum of the two vectors is a fixed position, except
for the effects of the unknown speed at the start of the window and of a constant offset of the
accelerometer. If the images are later than assumed, or if the camera is rotated about the upward
axis, the sum moves; with the correct delay or rotation (a hypothesis), it is at rest.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np

from perchctl.geometry import Array
from perchctl.mission import CameraImuMismatch, ImuMotion, VisualInertialMotion
from perchctl.values import replace
from perchctl.vehicle import Telemetry

Vector = tuple[float, float, float]

MISMATCH_WINDOW_S = 1.2
"""Age at which a sighting is dropped, s."""
MISMATCH_LEAST_S = 0.6
"""Time that the sightings must span for a check, s. Larger: a mismatch is found later."""
MISMATCH_LEAST_SIGHTS = 8
"""Number of sightings, and of samples, that a check requires. Larger: a mismatch is found later."""
MISMATCH_PERIOD_S = 0.05
"""Time between checks, s. Smaller: successive checks use nearly the same sightings."""
AGREED = 3
"""Number of successive checks that must agree. Larger: a mismatch is found later. Smaller: a false
mismatch may be reported."""
AGREED_MEASURED = 2
"""Number of successive checks that must agree if the latency is measured in flight. It can be
smaller than `AGREED` because a false correction is undone, and at ten images per second a third
check would take another tenth of a second."""
STEP_S = 0.02
"""Step of the delay hypotheses, s."""
_DELAYS_S, _QUARTERS_RAD = np.arange(-8, 32) * STEP_S, np.array([0.5, 1.0, -0.5]) * math.pi
TURNS_RAD = np.concatenate([np.zeros(len(_DELAYS_S)), _QUARTERS_RAD])
"""Camera rotation of each hypothesis, rad: zero for the hypotheses with a delay (`_DELAYS_S`,
beyond the profile's), then the rotations, which are tested at the delay in use."""
# standard deviations of the acceleration's offset (including 1 deg of attitude error) and of a
# sighting
OFFSET_MPS2, SIGMA_M = 0.2, 0.003
# a smaller error only makes the alignment oscillate by centimetres, and is reported after the
# flight
LEAST_LATER_S = 0.1
BEYOND_S = 0.03
"""Largest amount by which a measured latency may be outside the usable range, s: the step of the
grid plus the jitter of an image's time. Larger: an error that cannot be corrected counts as
correctable."""
MEASURED_LATER_S = 0.03
"""Smallest error of a measured latency that is corrected here, s; a smaller one is left to the more
accurate, slower estimate in `perchctl.perception.online_calibration`. Larger: an alignment
oscillates for longer. Smaller: the step of the grid and the jitter of an image's time count as an
error."""
# For a mismatch, the target's apparent motion must be at least this large, m, and at least this
# multiple of the apparent motion under the best hypothesis.
WANDERS_M, WANDERS_MORE = 0.005, 3.0
# if the target appears to move by this distance, m, within a second, the speed is known to 0.05 m/s
ROUGH_M = 0.03
ALIKE_S = 3 * STEP_S
"""Two delays agree if they differ by at most this, s."""


@dataclass(frozen=True)
class MeasuredLatency:
    """A latency that is measured in flight, in seconds beyond the profile's: the current value, and
    the smallest and largest usable values."""

    in_use_s: float
    least_s: float
    most_s: float

    def can_be(self, delay_s: float) -> bool:
        """True if the latency can be corrected to `delay_s`."""
        return self.least_s - BEYOND_S <= delay_s <= self.most_s + BEYOND_S


@dataclass(frozen=True, eq=False)
class FeltSamples:
    """Values computed from telemetry samples, with which the hypotheses are tested. They are cached
    between sightings because computing them for two seconds of samples takes as long as the fit
    itself.

    Attributes:
        rows: array (n, 7) with one row for each sample: time, roll, pitch, yaw, and the
            acceleration in world axes.
    """

    samples: tuple[Telemetry, ...] = ()
    offset_g: Vector = (0.0, 0.0, 0.0)
    rows: Array = field(default_factory=lambda: np.empty((0, 7)))

    def of(self, samples: tuple[Telemetry, ...], offset_g: Vector) -> FeltSamples:
        """Return the values for these samples, oldest first, with the accelerometer's offset
        `offset_g`; rows that are already known are reused."""
        begin = bisect.bisect_left(self.samples, samples[0].t_s, key=attrgetter("t_s"))
        known = len(self.samples) - begin
        if self.offset_g != offset_g or self.samples[begin:] != samples[:known]:
            known = 0
        new = [
            (
                s.t_s,
                s.roll_rad,
                s.pitch_rad,
                s.yaw_rad,
                *ImuMotion.compute_acceleration_world_mps2(s, offset_g),
            )
            for s in samples[known:]
        ]
        rows = np.concatenate([self.rows[len(self.rows) - known :], np.reshape(new, (-1, 7))])
        return FeltSamples(samples, offset_g, rows)


@dataclass(frozen=True)
class VisualInertialWindow:
    """The sightings of the last `MISMATCH_WINDOW_S`, and the mismatch and motion computed from
    them.

    Times and delays are relative to the profile's latency. `mismatch` is for the planner; it is
    None if there is no mismatch, or if the mismatch is being corrected. `correction_s` is the delay
    to which a measured latency should be corrected; None while the latency in use fits.
    """

    # time of each sighting, and vector from the body to the target in body axes, m
    sights: tuple[tuple[float, Vector], ...] = ()
    judged_s: float = -math.inf
    # Result of the newest check; it is kept once enough checks agree.
    latest: CameraImuMismatch | None = None
    latest_s: float = -math.inf
    agree_count: int = 0  # Number of successive checks that agree.
    is_corrected: bool = False  # True if `latest` is an error of a measured latency.
    in_use_s: float = 0.0  # `mismatch` is relative to this delay.
    # newest motion with which the target appears to move by at most `motion_within_m`
    motion: VisualInertialMotion | None = None
    motion_within_m: float = WANDERS_M
    felt: FeltSamples = field(default_factory=FeltSamples, compare=False, repr=False)

    @property
    def mismatch(self) -> CameraImuMismatch | None:
        """The newest mismatch, once enough successive checks agree; None before that, or while it
        is being corrected. Its `camera_latency_error_s` is relative to the latency in use."""
        if self.latest is None or self.is_corrected or self.agree_count < AGREED:
            return None
        later_s = (
            0.0
            if self.latest.camera_yaw_error_rad
            else self.latest.camera_latency_error_s - self.in_use_s
        )
        return CameraImuMismatch(later_s, self.latest.camera_yaw_error_rad)

    @property
    def correction_s(self) -> float | None:
        """The measured latency minus the profile's latency, s, if it differs from the latency in
        use; otherwise None."""
        enough = self.is_corrected and self.agree_count >= AGREED_MEASURED
        return self.latest.camera_latency_error_s if self.latest is not None and enough else None


def drop_sightings(old: VisualInertialWindow) -> VisualInertialWindow:
    """Return the window without its sightings. From then on, the window accepts a less accurate
    motion."""
    return replace(old, sights=(), motion_within_m=ROUGH_M)


def estimate_motion(
    old: VisualInertialWindow,
    t_s: float,
    body_to_target_m: Vector,
    samples: tuple[Telemetry, ...],
    offset_g: Vector,
    measured: MeasuredLatency | None = None,
) -> VisualInertialWindow:
    """Return the window with one more sighting, `body_to_target_m` in body axes at `t_s`.

    Args:
        t_s: arrival time of the sighting minus the profile's latency.
        samples: telemetry of the last 2 s, oldest first.
        offset_g: offset of the accelerometer at rest, g, body axes.
        measured: the latency in use with `camera.latency_s: measured`. If None, the latency is the
            profile's, and a mismatch persists once it is found.
    """
    kept = tuple(s for s in old.sights if t_s - MISMATCH_WINDOW_S <= s[0] < t_s)
    new = replace(old, sights=(*kept, (t_s, body_to_target_m)))
    short = t_s - new.sights[0][0] < MISMATCH_LEAST_S or len(new.sights) < MISMATCH_LEAST_SIGHTS
    if short or len(samples) < MISMATCH_LEAST_SIGHTS or t_s - old.judged_s < MISMATCH_PERIOD_S:
        return new
    hypotheses_s = delay_hypotheses(0.0 if measured is None else measured.in_use_s)
    new = replace(new, felt=old.felt.of(samples, offset_g))
    wanders_m, upwards_m, velocity_mps, bias_mps2 = fit_hypotheses(
        new.sights, new.felt, hypotheses_s
    )
    if old.mismatch is None or measured is not None:  # otherwise the mismatch persists
        found, before = _found(wanders_m, hypotheses_s, measured), old.latest
        if found is None and measured is not None:
            # During an ascent there is little lateral motion, and a camera rotation does not affect
            # vertical motion.
            found = _found(np.hypot(wanders_m, upwards_m), hypotheses_s, measured)
            found = None if found is not None and found.camera_yaw_error_rad else found
        agreed = 0 if found is None else 1
        if (
            found is not None
            and before is not None
            and found.camera_yaw_error_rad == before.camera_yaw_error_rad
        ):
            agreed += (
                old.agree_count
                if abs(found.camera_latency_error_s - before.camera_latency_error_s) <= ALIKE_S
                else 0
            )
        new = replace(
            new,
            latest=found,
            latest_s=t_s,
            agree_count=agreed,
            is_corrected=(
                measured is not None
                and found is not None
                and found.camera_yaw_error_rad == 0.0
                and measured.can_be(found.camera_latency_error_s)
            ),
            in_use_s=0.0 if measured is None else measured.in_use_s,
        )
    agreed_on = new.latest if new.agree_count >= AGREED else None
    i = _best_about(agreed_on or CameraImuMismatch(new.in_use_s), wanders_m, hypotheses_s)
    if wanders_m[i] <= new.motion_within_m:
        (vx, vy, vz), (bx, by, _) = velocity_mps[:, i].tolist(), bias_mps2[:, i].tolist()
        climb_mps = vz if t_s - new.latest_s <= MISMATCH_WINDOW_S else None
        new = replace(
            new, motion=VisualInertialMotion(samples[-1].t_s, (vx, vy), (bx, by), climb_mps)
        )
    return replace(new, judged_s=t_s)


def delay_hypotheses(in_use_s: float) -> Array:
    """Return the delay of each hypothesis, s, (n,); hypotheses with a rotation (`TURNS_RAD`) have
    the delay in use."""
    return np.concatenate([_DELAYS_S, np.full(len(_QUARTERS_RAD), in_use_s)])


def _best_about(mismatch: CameraImuMismatch, wanders_m: Array, later_s: Array) -> int:
    """Return the index of the hypothesis with the least motion among those close to `mismatch`."""
    about = np.abs(later_s - mismatch.camera_latency_error_s) < LEAST_LATER_S
    about &= mismatch.camera_yaw_error_rad == TURNS_RAD
    return int(np.argmin(np.where(about, wanders_m, np.inf)))


def _found(
    wanders_m: Array, later_s: Array, measured: MeasuredLatency | None
) -> CameraImuMismatch | None:
    """Return the mismatch that explains the images; None if the current latency, or one close to
    it, explains them.

    If the latency is measured in flight, the usable latencies are tried first: just after lift-off,
    any delay explains a target that has not moved relative to the camera. A usable latency does not
    explain the images if it leaves more motion than their noise, and hardly less than the latency
    in use does. Such a latency is merely the usable value closest to the true latency, which is too
    long to be used.
    """
    in_use_s, least_later_s = 0.0, LEAST_LATER_S
    if measured is not None:
        in_use_s, least_later_s = measured.in_use_s, MEASURED_LATER_S
    as_it_is_m = float(wanders_m[np.argmin(np.abs(later_s - in_use_s) + np.abs(TURNS_RAD))])

    def refutes_latency_in_use(i: int) -> bool:
        return as_it_is_m >= max(WANDERS_M, WANDERS_MORE * float(wanders_m[i]))

    best = int(np.argmin(wanders_m))
    if measured is not None:
        usable = (later_s >= measured.least_s) & (later_s <= measured.most_s) & (TURNS_RAD == 0.0)
        likely = int(np.argmin(np.where(usable, wanders_m, np.inf)))
        is_as_good = wanders_m[likely] < max(WANDERS_M, WANDERS_MORE * float(wanders_m[best]))
        if is_as_good and (wanders_m[likely] < WANDERS_M or refutes_latency_in_use(likely)):
            best = likely
    if not refutes_latency_in_use(best):
        return None
    found = CameraImuMismatch(_refined_s(wanders_m, later_s, best), float(TURNS_RAD[best]))
    is_off = (
        found.camera_yaw_error_rad != 0.0
        or abs(found.camera_latency_error_s - in_use_s) >= least_later_s
    )
    return found if is_off else None


def _refined_s(wanders_m: Array, later_s: Array, best: int) -> float:
    """Return the delay, s, at the minimum of a parabola through the squared motion at the
    hypothesis `best` and its two neighbours. At an end of `_DELAYS_S`, or for a rotation, return
    the delay of the hypothesis itself."""
    if not 0 < best < len(_DELAYS_S) - 1:
        return float(later_s[best])
    before, here, after = np.square(wanders_m[best - 1 : best + 2]).tolist()
    bend = before - 2.0 * here + after
    return float(later_s[best]) + (0.5 * STEP_S * (before - after) / bend if bend > 0.0 else 0.0)


def fit_hypotheses(
    sights: tuple[tuple[float, Vector], ...],
    felt: FeltSamples,
    later_s: Array,
) -> tuple[Array, Array, Array, Array]:
    """Fit the motion under each of n hypotheses; hypothesis i has the delay `later_s[i]` and the
    rotation `TURNS_RAD[i]`.

    Each of the `sights` is a time and the vector from the body to the target, m, in body axes.
    Returns the target's apparent motion, rms in m, lateral (n,) and vertical (n,); the vehicle's
    velocity at the newest sample, m/s, (3, n); and the offset of its acceleration, m/s^2, (3, n).
    """
    stamps_s, attitudes, forces = felt.rows[:, 0], felt.rows[:, 1:4].copy(), felt.rows[:, 4:]
    attitudes[:, 2] = np.unwrap(attitudes[:, 2])
    speeds = _integral(stamps_s, forces)
    moved = _integral(stamps_s, speeds)

    seen_s = np.array([t_s for t_s, _ in sights])
    x, y, z = np.array([way_m for _, way_m in sights]).T
    then_s = seen_s - later_s[:, None]
    roll, pitch, yaw = (np.interp(then_s, stamps_s, column) for column in attitudes.T)
    x, y = _turned(x, y, TURNS_RAD[:, None])
    y, z = _turned(y, z, roll)
    z, x = _turned(z, x, pitch)
    x, y = _turned(x, y, yaw)
    x, y, z = (a + np.interp(then_s, stamps_s, b) for a, b in zip((x, y, z), moved.T, strict=True))

    # The target's apparent motion is what remains after fitting a position, a velocity and an
    # offset of the acceleration.
    u = seen_s - seen_s.mean()
    unknown = np.stack([np.ones_like(u), u, 0.5 * u * u], axis=1)
    known = np.diag([0.0, 0.0, (SIGMA_M / OFFSET_MPS2) ** 2])
    sums = np.stack([x, y, z])  # (3, n, sights)
    found = sums @ np.linalg.solve(unknown.T @ unknown + known, unknown.T).T
    left = ((sums - found @ unknown.T) * sums).sum(axis=2)  # (3, n)
    sideways_m, upwards_m = (
        np.sqrt(np.maximum(each, 0.0) / len(u)) for each in (left[0] + left[1], left[2])
    )
    newest_u = stamps_s[-1] + later_s - seen_s.mean()
    velocity = speeds[-1][:, None] - found[..., 1] - found[..., 2] * newest_u
    return sideways_m, upwards_m, velocity, found[..., 2]


def _turned(a: Array, b: Array, by_rad: Array) -> tuple[Array, Array]:
    c, s = np.cos(by_rad), np.sin(by_rad)
    return c * a - s * b, s * a + c * b


def _integral(t_s: Array, values: Array) -> Array:
    """Return the integral (n, k) of `values` over time by the trapezoidal rule, starting with 0 at
    the first sample."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
