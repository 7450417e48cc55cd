"""Store the vehicle's recent telemetry, and interpolate its attitude and position at a frame's
time."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass, field
from operator import attrgetter

from perchctl.geometry import wrap_rad
from perchctl.mission import ImuMotion
from perchctl.profile import SafetyConfig
from perchctl.values import replace
from perchctl.vehicle import Telemetry, is_battery_reading
from perchctl.vision import VehicleState

Vector = tuple[float, float, float]
_time_s = attrgetter("t_s")

KEEP_S = 2.0
"""Time for which samples are kept, s."""
SMEARED_S = 0.15
"""Time over which a jump of the estimate may be spread, s."""
FASTEST_TURN_RADPS, FASTEST_MPS2 = 7.0, 20.0
"""Limits of the vehicle's motion between two samples: 400 deg/s and 2 g. Smaller: a fast motion
counts as a jump of the estimate."""


@dataclass(frozen=True, eq=False)
class History:
    """Telemetry of the last `KEEP_S`, oldest first, plus one earlier sample, so that the samples
    cover all of that time at any sample rate.

    `jumped`: True if the state estimate jumped within the newest samples. `turned_rad`: largest
    angle by which a heading change within the newest samples exceeds any possible rotation.
    `battery_changed_s`: time at which the battery's reading first arrived or last changed. `imu`:
    motion from the accelerometer over the whole flight.
    """

    samples: tuple[Telemetry, ...] = ()
    jumped: bool = False
    turned_rad: float = 0.0
    battery_changed_s: float | None = None
    battery_v: float | None = None
    imu: ImuMotion = field(default_factory=ImuMotion)

    @property
    def newest(self) -> Telemetry | None:
        return self.samples[-1] if self.samples else None

    def battery_age_s(self, now_s: float) -> float:
        """Time since the battery's reading last changed, s; 0 before the first telemetry."""
        return 0.0 if self.battery_changed_s is None else now_s - self.battery_changed_s


def add_samples(
    history: History, new: list[Telemetry], safety: SafetyConfig, late: bool = False
) -> History:
    """Return the history with new samples.

    `jumped` and `turned_rad` describe the new samples; if `late` is True, they also cover the
    earlier samples of the same tick. A sample without position or velocity gets both from the
    previous sample. Other samples with NaN, and samples that are out of order, are dropped (fault
    35 in docs/faults.md).
    """
    jumped, turned_rad = (history.jumped, history.turned_rad) if late else (False, 0.0)
    samples, imu = list(history.samples), history.imu
    changed_s, battery_v = history.battery_changed_s, history.battery_v
    for sample in new:
        if samples and not _is_placed(sample):
            sample = _carried_on(samples[-1], sample)
        if not is_finite(sample) or (samples and sample.t_s <= samples[-1].t_s):
            continue
        if samples:
            jumped = jumped or _is_jump(samples, sample, safety)
            turned_rad = max(turned_rad, _turned_rad(samples[-1], sample))
        if changed_s is None:
            changed_s = sample.t_s
        if is_battery_reading(sample.battery_v) and sample.battery_v != battery_v:
            changed_s, battery_v = sample.t_s, sample.battery_v
        imu = imu.with_sample(samples[-1] if samples else None, sample)
        samples.append(sample)
    if samples:
        within = bisect.bisect_left(samples, samples[-1].t_s - KEEP_S, key=_time_s)
        del samples[: max(0, within - 1)]
    return History(tuple(samples), jumped, turned_rad, changed_s, battery_v, imu)


def attitude_at(history: History, t_s: float) -> VehicleState | None:
    """Return attitude, position and velocity at `t_s`, interpolated linearly between samples (yaw
    along the shorter arc).

    Before the oldest sample, the values of that sample are returned. After the newest sample, the
    position is extrapolated with its velocity for at most 0.1 s. Returns None if there are no
    samples.
    """
    samples = history.samples
    if not samples:
        return None
    i = bisect.bisect_right(samples, t_s, key=_time_s)
    if i == 0:
        return _attitude(samples[0], 0.0)
    if i == len(samples):
        return _attitude(samples[-1], min(t_s - samples[-1].t_s, 0.1))
    a, b = samples[i - 1], samples[i]
    part = (t_s - a.t_s) / (b.t_s - a.t_s)
    return VehicleState(
        t_s,
        a.roll_rad + part * wrap_rad(b.roll_rad - a.roll_rad),
        a.pitch_rad + part * wrap_rad(b.pitch_rad - a.pitch_rad),
        wrap_rad(a.yaw_rad + part * wrap_rad(b.yaw_rad - a.yaw_rad)),
        _between(a.position_m, b.position_m, part),
        _between(a.velocity_mps, b.velocity_mps, part),
    )


def _between(a: Vector, b: Vector, part: float) -> Vector:
    x, y, z = (old + part * (new - old) for old, new in zip(a, b, strict=True))
    return x, y, z


def velocity_at(history: History, t_s: float) -> tuple[float, float, float]:
    """Return the velocity (x, y, z), m/s, in world axes, of the first sample at or after `t_s` or,
    if there is none, of the newest sample; zero if there are no samples."""
    later = bisect.bisect_left(history.samples, t_s, key=_time_s)
    found = history.samples[later : later + 1] or history.samples[-1:]
    return found[0].velocity_mps if found else (0.0, 0.0, 0.0)


def _attitude(s: Telemetry, ahead_s: float) -> VehicleState:
    x, y, z = (p + v * ahead_s for p, v in zip(s.position_m, s.velocity_mps, strict=True))
    return VehicleState(
        s.t_s + ahead_s, s.roll_rad, s.pitch_rad, s.yaw_rad, (x, y, z), s.velocity_mps
    )


def _is_jump(before: list[Telemetry], new: Telemetry, safety: SafetyConfig) -> bool:
    """True if the estimate moved further than any flight could, at once or within `SMEARED_S`."""
    last = before[-1]
    first = before[bisect.bisect_left(before, last.t_s - SMEARED_S, key=_time_s)]
    faster_mps = math.dist(last.velocity_mps, new.velocity_mps)
    return (
        _is_moved(last, new, safety)
        or _is_moved(first, new, safety)
        or _turned_rad(last, new) > math.radians(safety.jump_deg)
        or faster_mps > safety.jump_mps + FASTEST_MPS2 * _between_s(last, new)
    )


def _turned_rad(a: Telemetry, b: Telemetry) -> float:
    """Return the part of the heading change between two samples, rad, that exceeds any possible
    rotation."""
    return abs(wrap_rad(b.yaw_rad - a.yaw_rad)) - FASTEST_TURN_RADPS * (b.t_s - a.t_s)


def _is_moved(a: Telemetry, b: Telemetry, safety: SafetyConfig) -> bool:
    moved_m = math.dist(a.position_m, b.position_m)
    rise_m = abs(b.position_m[2] - a.position_m[2])
    fastest = max(math.hypot(*a.velocity_mps), math.hypot(*b.velocity_mps))
    flown_m = 1.5 * fastest * _between_s(a, b)
    return moved_m > safety.jump_m + flown_m or rise_m > safety.jump_z_m + flown_m


def _between_s(a: Telemetry, b: Telemetry) -> float:
    """Return the time between two position measurements, s, taking into account how old each
    position was when its sample was taken."""
    return max(b.t_s - a.t_s, b.t_s - b.behind_s - (a.t_s - a.behind_s))


def _is_placed(s: Telemetry) -> bool:
    return all(map(math.isfinite, (*s.position_m, *s.velocity_mps)))


def _carried_on(last: Telemetry, new: Telemetry) -> Telemetry:
    behind_s = last.behind_s + max(0.0, new.t_s - last.t_s)
    return replace(
        new, position_m=last.position_m, velocity_mps=last.velocity_mps, behind_s=behind_s
    )


def is_finite(s: Telemetry) -> bool:
    """True if all values of a sample that affect the flight are finite, including its times."""
    times = s.t_s, s.behind_s
    attitude = s.roll_rad, s.pitch_rad, s.yaw_rad
    forces = s.acc_x_g, s.acc_y_g, s.acc_z_g, s.thrust
    return _is_placed(s) and all(map(math.isfinite, (*times, *attitude, *forces)))
