"""Checks whether the pictures show the motion that the accelerometer measures.

The way from the body to the target, turned by the attitude at the exposure, and the body's own
motion by its accelerometer add up to one place, but for the speed at the window's begin and a
constant offset. If pictures are later than assumed, or the camera is turned about the upward axis,
the sum wanders; with the right delay or turn it comes to rest.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np

from perchctl.geometry import Array
from perchctl.mission import ImuMotion, Mismatch, VisualInertialMotion
from perchctl.values import replace
from perchctl.vehicle import Telemetry

Vector = tuple[float, float, float]

MISMATCH_WINDOW_S = 1.2
"""Older sights are left out."""
MISMATCH_LEAST_S = 0.6
"""Time that the sights must span before they are judged. Larger: a mismatch is found later."""
MISMATCH_LEAST_SIGHTS = 8
"""Number of sights, and of samples, below which none is judged. Larger: as `MISMATCH_LEAST_S`."""
MISMATCH_PERIOD_S = 0.05
"""Time between judgements. Smaller: judgements in a row rest on nearly the same sights."""
AGREED = 3
"""Number of judgements in a row that have to agree. Larger: a mismatch is found later. Smaller: one
that is none is reported."""
AGREED_MEASURED = 2
"""The same for a latency that the flight measures: what is taken for an error wrongly is taken
back, and at ten pictures a second a third judgement is a tenth of a second later."""
STEP_S = 0.02
_DELAYS_S, _QUARTERS_RAD = np.arange(-8, 32) * STEP_S, np.array([0.5, 1.0, -0.5]) * math.pi
TURNS_RAD = np.concatenate([np.zeros(len(_DELAYS_S)), _QUARTERS_RAD])
"""The hypotheses are delays beyond the profile's, and turns of the camera at the delay in use."""
OFFSET_MPS2, SIGMA_M = 0.2, 0.003  # sigma of the offset (with 1 deg of attitude) and of a sight
LEAST_LATER_S = 0.1  # less swings an alignment by centimetres, and is reported after the flight
BEYOND_S = 0.03
"""What a measured latency may seem to be beyond those that can be used: the grid's step, and a
picture's jitter. Larger: what cannot be corrected is taken for what can."""
MEASURED_LATER_S = 0.03
"""A smaller error of a latency that the flight measures is left to the finer, slower estimate of
`perchctl.perception.online_calibration`. Larger: an alignment swings for longer. Smaller: the
grid's step and the jitter of single pictures are taken for an error."""
WANDERS_M, WANDERS_MORE = 0.005, 3.0  # by so much, and so much more than with the right delay
ROUGH_M = 0.03  # a sum that wanders so far within a second gives the speed to 0.05 m/s
ALIKE_S = 3 * STEP_S


@dataclass(frozen=True)
class MeasuredLatency:
    """A latency that the flight measures, in seconds beyond the profile's: the one in use, and the
    least and the largest that can be used."""

    in_use_s: float
    least_s: float
    most_s: float

    def can_be(self, delay_s: float) -> bool:
        """True if the latency can be corrected to `delay_s`."""
        return self.least_s - BEYOND_S <= delay_s <= self.most_s + BEYOND_S


@dataclass(frozen=True, eq=False)
class FeltSamples:
    """What the hypotheses need of telemetry samples, kept from one sight to the next, since to work
    it out for all of two seconds takes as long as the fit itself.

    Attributes:
        rows: (n, 7) of each sample: time, roll, pitch, yaw, and the acceleration in world axes.
    """

    samples: tuple[Telemetry, ...] = ()
    offset_g: Vector = (0.0, 0.0, 0.0)
    rows: Array = field(default_factory=lambda: np.empty((0, 7)))

    def of(self, samples: tuple[Telemetry, ...], offset_g: Vector) -> FeltSamples:
        """The same for these samples, oldest first, of which the first ones may be known already,
        and for what the accelerometer reads too much."""
        begin = bisect.bisect_left(self.samples, samples[0].t_s, key=attrgetter("t_s"))
        known = len(self.samples) - begin
        if self.offset_g != offset_g or self.samples[begin:] != samples[:known]:
            known = 0
        new = [
            (s.t_s, s.roll_rad, s.pitch_rad, s.yaw_rad, *ImuMotion.acceleration_mps2(s, offset_g))
            for s in samples[known:]
        ]
        rows = np.concatenate([self.rows[len(self.rows) - known :], np.reshape(new, (-1, 7))])
        return FeltSamples(samples, offset_g, rows)


@dataclass(frozen=True)
class VisualInertialWindow:
    """The sights of the last `MISMATCH_WINDOW_S`, and the mismatch and motion that they show.

    Times and delays are relative to the profile's latency. `mismatch` is for the planner, None
    while there is none, or one that is corrected; `correction_s` is the delay by which a measured
    latency is to be corrected, None while the latency in use fits.
    """

    sights: tuple[tuple[float, Vector], ...] = ()  # time, way from body to target, body axes, m
    judged_s: float = -math.inf
    latest: Mismatch | None = None  # the newest judgement; once enough agree, it stays
    latest_s: float = -math.inf
    agree_count: int = 0  # judgements in a row that say the same
    is_corrected: bool = False  # `latest` is an error of a measured latency
    in_use_s: float = 0.0  # the delay from which `mismatch` counts
    motion: VisualInertialMotion | None = None  # the newest in which the sum wandered by at most
    motion_within_m: float = WANDERS_M  # ... this
    felt: FeltSamples = field(default_factory=FeltSamples, compare=False, repr=False)

    @property
    def mismatch(self) -> Mismatch | None:
        """The newest mismatch, once enough judgements in a row agree; None before that, and for
        one that is corrected. Its `later_s` counts from the latency in use."""
        if self.latest is None or self.is_corrected or self.agree_count < AGREED:
            return None
        later_s = 0.0 if self.latest.turn_rad else self.latest.later_s - self.in_use_s
        return Mismatch(later_s, self.latest.turn_rad)

    @property
    def correction_s(self) -> float | None:
        """What a measured latency is beyond the profile's, where that is not the one in use."""
        enough = self.is_corrected and self.agree_count >= AGREED_MEASURED
        return self.latest.later_s if self.latest is not None and enough else None


def drop_sightings(old: VisualInertialWindow) -> VisualInertialWindow:
    """The window without its sights; from now on the window accepts a rougher motion."""
    return replace(old, sights=(), motion_within_m=ROUGH_M)


def estimate_motion(
    old: VisualInertialWindow,
    t_s: float,
    body_to_target_m: Vector,
    samples: tuple[Telemetry, ...],
    offset_g: Vector,
    measured: MeasuredLatency | None = None,
) -> VisualInertialWindow:
    """The window with one more sight, `body_to_target_m` in body axes at `t_s`.

    Args:
        t_s: the sight's arrival less the profile's latency.
        samples: telemetry of the last 2 s, oldest first.
        offset_g: what the accelerometer reads too much.
        measured: the latency in use, with `camera.latency_s: measured`; without it the latency is
            the profile's, and a mismatch stays.
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
    if old.mismatch is None or measured is not None:  # else it stays
        found, before = _found(wanders_m, hypotheses_s, measured), old.latest
        if found is None and measured is not None:
            # An ascent hardly moves sideways. No turn of the camera shows upwards.
            found = _found(np.hypot(wanders_m, upwards_m), hypotheses_s, measured)
            found = None if found is not None and found.turn_rad else found
        agreed = 0 if found is None else 1
        if found is not None and before is not None and found.turn_rad == before.turn_rad:
            agreed += old.agree_count if abs(found.later_s - before.later_s) <= ALIKE_S else 0
        new = replace(
            new,
            latest=found,
            latest_s=t_s,
            agree_count=agreed,
            is_corrected=(
                measured is not None
                and found is not None
                and found.turn_rad == 0.0
                and measured.can_be(found.later_s)
            ),
            in_use_s=0.0 if measured is None else measured.in_use_s,
        )
    agreed_on = new.latest if new.agree_count >= AGREED else None
    i = _best_about(agreed_on or Mismatch(new.in_use_s), wanders_m, hypotheses_s)
    if wanders_m[i] <= new.motion_within_m:
        (vx, vy, vz), (bx, by, _) = velocity_mps[:, i].tolist(), bias_mps2[:, i].tolist()
        climb_mps = vz if t_s - new.latest_s <= MISMATCH_WINDOW_S else None
        new = replace(
            new, motion=VisualInertialMotion(samples[-1].t_s, (vx, vy), (bx, by), climb_mps)
        )
    return replace(new, judged_s=t_s)


def delay_hypotheses(in_use_s: float) -> Array:
    """The delay of each hypothesis, s, (n,); those of `TURNS_RAD` have the one in use."""
    return np.concatenate([_DELAYS_S, np.full(len(_QUARTERS_RAD), in_use_s)])


def _best_about(mismatch: Mismatch, wanders_m: Array, later_s: Array) -> int:
    """The index that wanders least among those that are no other mismatch."""
    about = np.abs(later_s - mismatch.later_s) < LEAST_LATER_S
    about &= mismatch.turn_rad == TURNS_RAD
    return int(np.argmin(np.where(about, wanders_m, np.inf)))


def _found(wanders_m: Array, later_s: Array, measured: MeasuredLatency | None) -> Mismatch | None:
    """The mismatch that explains the pictures; None if the latency in use does, or one near it.

    A measured latency is looked for among those that can be used first: for a moment after the
    lift-off any delay explains a target that stood still.
    """
    in_use_s, least_later_s = 0.0, LEAST_LATER_S
    best = int(np.argmin(wanders_m))
    if measured is not None:
        in_use_s, least_later_s = measured.in_use_s, MEASURED_LATER_S
        usable = (later_s >= measured.least_s) & (later_s <= measured.most_s) & (TURNS_RAD == 0.0)
        likely = int(np.argmin(np.where(usable, wanders_m, np.inf)))
        if wanders_m[likely] < max(WANDERS_M, WANDERS_MORE * float(wanders_m[best])):
            best = likely
    as_it_is = float(wanders_m[np.argmin(np.abs(later_s - in_use_s) + np.abs(TURNS_RAD))])
    if as_it_is < max(WANDERS_M, WANDERS_MORE * float(wanders_m[best])):
        return None
    found = Mismatch(_refined_s(wanders_m, later_s, best), float(TURNS_RAD[best]))
    is_off = found.turn_rad != 0.0 or abs(found.later_s - in_use_s) >= least_later_s
    return found if is_off else None


def _refined_s(wanders_m: Array, later_s: Array, best: int) -> float:
    """The delay at which a parabola through the squares about the `best` of `_DELAYS_S` is least;
    that of the grid at its ends, and for a turn."""
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
    """The motion under each of n hypotheses: the delay `later_s[i]` and camera turn `TURNS_RAD[i]`.

    `sights`: times, and ways from body to target, m, body axes. Returns the target's apparent
    motion, rms in m, sideways (n,) and upwards (n,); the vehicle's velocity at the newest sample,
    m/s, (3, n); and the offset of its acceleration, m/s2, (3, n).
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

    # What is left of both beyond a place, a speed and an offset.
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
    """The integral by trapezia, (n, k); 0 at the first."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
