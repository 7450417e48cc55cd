"""The vehicle's motion by accelerometer and attitude alone.

The accelerometer reads the specific force f in body axes. With the attitude R of the same sample
(yaw-pitch-roll), less the offset o that it read at rest, the acceleration in world axes is

    a = R (f - o) - g

and the velocity since the first sample is its integral by the trapezoid rule:

    sample ──> freeze ──> silence? ──yes──> begin anew: a fall may hide in the gap
                            │ no
                            v
              offset at rest, tilt by corrections ──> a, v
                            │
                            v
              fall, impact, steady speed, push, hover thrust: one detector each

Nothing here knows a position, a phase or a command. A detector notes when it last fired, so that
its evidence has an age. `v` drifts by 0.1 m/s each second for each 0.01 rad by which the attitude
is wrong: it is compared over short times only.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Self

from perchctl.geometry import GRAVITY_MPS2
from perchctl.values import replace
from perchctl.vehicle import FLYING, FULL_THRUST, Telemetry

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)

GAP_S = 0.2
"""Silence in which a vehicle falls 20 cm, more than it may and still hang. Larger: a fall hides in
it. Smaller: two lost packets count as a silence."""
NO_FALL_MPS = 0.25
"""Speed that a hanging vehicle can gain across a silence, by noise of the estimate. Larger: a short
fall passes for none."""
NO_FALL_M = 0.25
"""Distance across a silence beyond what the speed before it explains. Larger: as `NO_FALL_MPS`."""
SINKS_MPS = -0.3
"""Reached 5 cm into a fall; what hangs is never faster. Closer to 0: noise counts as a fall."""
FROZEN_READING_S = 0.2
"""The same reading for so long counts as a silence. Smaller: coarse readings freeze by chance."""
FALL_G = 0.6
"""Specific force below which a vehicle falls, g. Larger: the press's release counts as a fall."""
FALL_S = 0.1
"""A fall reads light for so long; a rebound is shorter. Larger: 5 cm more of fall."""
IMU_SINK_MPS = -0.25
"""Downward speed, gained within `SINK_MEMORY_S`, at which it comes down whatever the offsets are.
Closer to 0: vibration counts as a fall."""
SINK_MEMORY_S = 1.5
"""Time in which a gained downward speed is forgotten. Larger: an offset adds up to a fall."""
OFFSET_MEMORY_S = 3.0
"""Time in which the vertical offset is learned. Smaller: a slow fall is learned as an offset."""
IMPACT_G = -0.3
"""A deceleration harder than this is an impact on the ceiling, not a fall. Closer to 0: a fall's
first samples are cut off."""
BLOW_MPS = 0.22
"""Upward speed gained within `BLOW_S` that only the floor gives. Smaller: thrust is a floor."""
BLOW_S = 0.1
"""Time in which a blow is forgotten. Larger: thrust adds up to a blow."""
BEFORE_BLOW_S = 0.05
"""A blow shows up to this long after it began; the speed before it is looked up so far back."""
BOUNCES_S = 0.5
"""What follows a blow within this time is a bounce of it."""
STEADY_MPS = 0.06
"""Vertical speeds this close are one speed. Larger: a slow sink counts as standing still."""
STEADY_ASIDE_MPS = 0.15
"""The same sideways, to the mean of the last `ASIDE_MEMORY_S`; wider, since the wind shakes it."""
ASIDE_MEMORY_S = 0.15
"""Time of the mean sideways speed."""
REST_MEMORY_S = 0.5
"""Time in which the offsets are learned at rest. Smaller: vibration of the floor is learned."""
PUSHED_G = 0.06
"""Sideways specific force that only a push gives. Smaller: drag in flight counts as a push."""
PUSHED_S = 1.5
"""A push shows in the state estimate up to this much later."""
PUSH_MEMORY_S = 0.05
"""Time of the mean sideways force: turning motors shake single samples as hard as a push."""
CORRECTED_MPS = 0.08
"""Sideways speed that the estimate gains in one sample by a correction, not by motion."""
CORRECTED_MPS2 = 5.0
"""The same for each second between two samples."""
CORRECTED_MEMORY_S = 6.0
"""Time in which the firmware's own filter takes a wrong tilt back."""
HOVER_MEMORY_S = 0.5
"""Time in which the hover thrust follows. Larger: a sagging battery is noticed later."""
LEAST_FLYING = 0.4
"""Share of full thrust below which nothing hovers."""
HOVER_SATURATED_PART = 0.95
"""Share of full thrust from which on the thrust for 1 g is not known."""
UNCORRECTED_M2PS2_PER_S = 5e-4
"""Half of the growth of the vertical speed's variance while nothing corrects it."""
UNCORRECTED_S = 0.45
"""Growth for so long is certain. Smaller: a pause between two ranges counts."""


@dataclass(frozen=True)
class FusionAge:
    """For how long nothing has corrected the state estimate, by its variance of vertical speed,
    which only ever grows while no measurement is fused."""

    variance_m2ps2: float | None = None  # the newest
    changed_s: float = -math.inf  # when that variance came
    none_since_s: float = math.inf  # since when it has only grown

    def age_s(self, now_s: float) -> float:
        """Age of the last correction if corrections have certainly ceased; else 0."""
        certain = self.changed_s - self.none_since_s >= UNCORRECTED_S
        return now_s - self.none_since_s if certain else 0.0

    def update(self, sample: Telemetry) -> FusionAge:
        """The age with one more sample; unchanged by one without a new variance."""
        variance, before = sample.climb_variance_m2ps2, self.variance_m2ps2
        if variance is None or variance == before:
            return self
        least = UNCORRECTED_M2PS2_PER_S * (sample.t_s - self.changed_s)
        grows = before is not None and variance - before >= least
        none_since_s = min(self.none_since_s, self.changed_s) if grows else math.inf
        return FusionAge(variance, sample.t_s, none_since_s)


@dataclass(frozen=True)
class Impact:
    """A blow from below, such as a touchdown's."""

    t_s: float = -math.inf  # -inf: there was none
    estimated_mps: float = 0.0  # vertical speed just before it, by the state estimate
    felt_mps: float = 0.0  # the same by `ImuMotion.velocity_mps`
    peak_g: float = 0.0  # the largest specific force read in it, along the body's z axis
    z_m: float = 0.0  # where the state estimate had the vehicle


# --- The detectors: each a small value with a law of its own (tests/mission/test_detectors.py) ---


@dataclass(frozen=True)
class FreezeDetector:
    """How long readings have stood still. A vehicle in the air never reads the very same twice."""

    frozen_s: float = 0.0  # for how long the accelerometer has read the very same
    attitude_frozen_s: float = -math.inf  # the same of the attitude; -inf before a change
    place_frozen_s: float = -math.inf  # the same of position and velocity

    @property
    def attitude_age_s(self) -> float:
        """Seconds for which the attitude has read the same while the accelerometer changed."""
        return max(0.0, self.attitude_frozen_s - self.frozen_s)

    @property
    def place_age_s(self) -> float:
        """Seconds of the same position and velocity readings while the accelerometer changed."""
        return max(0.0, self.place_frozen_s - self.frozen_s)

    def compare(self, last: Telemetry | None, new: Telemetry) -> Self:
        """The detector with one more sample; the first is compared with nothing."""
        return replace(
            self,
            frozen_s=_frozen_s(self.frozen_s, last, new, _ACCELERATION),
            attitude_frozen_s=_frozen_s(self.attitude_frozen_s, last, new, _ATTITUDE),
            place_frozen_s=_frozen_s(self.place_frozen_s, last, new, _PLACE),
        )


@dataclass(frozen=True)
class FallDetector:
    """When the vehicle last fell, or came down and met the floor.

    With the vertical acceleration a, less its slowly learned offset, and cut off at an impact's,

        sink' = min(0, sink + a dt - sink dt / SINK_MEMORY_S)

    is the downward speed that was gained lately. The vehicle fell if that is beyond `IMU_SINK_MPS`,
    or if it has read less than `FALL_G` for longer than a rebound does. A sink that is so slow that
    the offset learns it goes unnoticed.
    """

    fell_s: float = -math.inf  # when it last fell, or came down and met the floor
    light_since_s: float = math.inf  # the accelerometer has read less than `FALL_G`
    sink_mps: float = 0.0
    offset_mps2: float = 0.0

    def with_fall(self, t_s: float, up_mps2: float, reads_g: float, dt_s: float) -> Self:
        """The detector after `dt_s` of vertical acceleration `up_mps2`, with a specific force of
        `reads_g` along the body's z axis at its end."""
        offset = self.offset_mps2 + (
            max(IMPACT_G * GRAVITY_MPS2, min(-IMPACT_G * GRAVITY_MPS2, up_mps2)) - self.offset_mps2
        ) * min(1.0, dt_s / OFFSET_MEMORY_S)
        felt_mps2 = max(up_mps2, IMPACT_G * GRAVITY_MPS2) - offset
        sink = self.sink_mps + felt_mps2 * dt_s
        sink = min(0.0, sink - sink * dt_s / SINK_MEMORY_S)
        light = min(self.light_since_s, t_s) if reads_g < FALL_G else math.inf
        fell = sink < IMU_SINK_MPS or t_s - light >= FALL_S
        return replace(
            self,
            fell_s=t_s if fell else self.fell_s,
            light_since_s=light,
            sink_mps=sink,
            offset_mps2=offset,
        )


@dataclass(frozen=True)
class ImpactDetector:
    """The newest blow from below, such as a touchdown's: within a moment it gains more upward speed
    than any thrust gives. Of a blow and its bounces the hardest counts."""

    blow_mps: float = 0.0
    blow_s: float = -math.inf
    last_moment: tuple[Impact, ...] = ()  # what a blow that begins now has ended
    blow: Impact = Impact()  # the newest from below

    def with_impact(self, now: Impact, z_m: float, up_mps2: float, dt_s: float) -> Self:
        """The detector after `dt_s` of vertical acceleration `up_mps2`; `now` is this moment, which
        a blow may have ended, `z_m` where the state estimate has the vehicle."""
        gained_mps = max(0.0, self.blow_mps * math.exp(-dt_s / BLOW_S) + up_mps2 * dt_s)
        recent = (m for m in self.last_moment if now.t_s - m.t_s <= BEFORE_BLOW_S)
        last_moment = (*recent, now)
        return replace(
            self,
            blow_mps=gained_mps,
            blow_s=now.t_s if gained_mps > BLOW_MPS else self.blow_s,
            last_moment=last_moment,
            blow=_newest_impact(self.blow, now, z_m, last_moment, gained_mps),
        )


def _newest_impact(
    old: Impact, now: Impact, z_m: float, last_moment: tuple[Impact, ...], gained_mps: float
) -> Impact:
    """The newest blow, which has gained `gained_mps` by now; of its bounces the hardest counts. The
    onboard estimate has the whole of a blow before its second sample arrives."""
    follows = now.t_s - old.t_s <= BOUNCES_S
    if gained_mps > BLOW_MPS:
        begun = Impact(
            now.t_s,
            min(moment.estimated_mps for moment in last_moment),
            min(moment.felt_mps for moment in last_moment),
            max(moment.peak_g for moment in last_moment),
            z_m,
        )
        if not follows:
            return begun
        return replace(
            old,
            peak_g=max(old.peak_g, begun.peak_g),
            estimated_mps=min(old.estimated_mps, begun.estimated_mps),
            felt_mps=min(old.felt_mps, begun.felt_mps),
        )
    return replace(old, peak_g=max(old.peak_g, now.peak_g)) if follows else old


@dataclass(frozen=True)
class SteadySpeed:
    """Since when the vertical speed has stayed what it is, and the sideways speed near its mean."""

    steady_s: float = math.inf  # since when the vertical speed has stayed what it is
    steady_mps: float = 0.0
    steady_aside_s: float = math.inf  # the same of the sideways speed
    steady_aside_mps: tuple[float, float] = (0.0, 0.0)  # the mean of the last moment

    def with_speed(self, t_s: float, velocity_mps: Vector, dt_s: float) -> Self:
        """The detector after `dt_s`, at a velocity in world axes."""
        x, y, z = velocity_mps
        steady_s, steady_mps = self.steady_s, self.steady_mps
        if abs(z - steady_mps) > STEADY_MPS:
            steady_s, steady_mps = t_s, z
        steady_aside_s, (mean_x, mean_y) = self.steady_aside_s, self.steady_aside_mps
        keeps = math.exp(-dt_s / ASIDE_MEMORY_S)
        steady_aside_mps = (x + keeps * (mean_x - x), y + keeps * (mean_y - y))
        if math.dist((x, y), steady_aside_mps) > STEADY_ASIDE_MPS:
            steady_aside_s = t_s
        return replace(
            self,
            steady_s=steady_s,
            steady_mps=steady_mps,
            steady_aside_s=steady_aside_s,
            steady_aside_mps=steady_aside_mps,
        )


@dataclass(frozen=True)
class PushDetector:
    """When something last pushed the vehicle sideways: the mean specific force across its z axis is
    more than drag in flight makes."""

    aside_g: tuple[float, float] = (0.0, 0.0)  # mean sideways force, body axes
    pushed_s: float = -math.inf  # when something last pushed it sideways

    def with_push(self, new: Telemetry, offset_g: Vector, dt_s: float) -> Self:
        """The detector after `dt_s`, with what the accelerometer reads then and read at rest."""
        keeps = math.exp(-dt_s / PUSH_MEMORY_S)
        x_g, y_g = new.acc_x_g - offset_g[0], new.acc_y_g - offset_g[1]
        mean_x_g, mean_y_g = self.aside_g
        aside_g = (
            x_g + keeps * (mean_x_g - new.acc_x_g + offset_g[0]),
            y_g + keeps * (mean_y_g - new.acc_y_g + offset_g[1]),
        )
        pushes = math.hypot(*aside_g) > PUSHED_G
        return replace(self, aside_g=aside_g, pushed_s=new.t_s if pushes else self.pushed_s)


# --- All of it ---


@dataclass(frozen=True)
class ImuMotion(FreezeDetector, FallDetector, ImpactDetector, SteadySpeed, PushDetector):
    """The vehicle's motion by accelerometer and attitude alone; loop times are -inf for never."""

    t_s: float = -math.inf  # of the newest sample
    velocity_mps: Vector = ZERO  # since the first sample, world axes
    offset_g: Vector = ZERO  # what the accelerometer read too much at rest, body axes
    silent_s: float = -math.inf  # end of the newest silence
    gap_s: float = -math.inf  # end of the newest silence that may hide a fall
    started_s: float = -math.inf  # first heard again after it had started anew
    sunk_m: float = 0.0  # by the estimate, while the accelerometer has stood still
    hover_thrust: float = 0.0  # for each measured g in flight
    misled_rad: tuple[float, float] = (0.0, 0.0)  # roll and pitch turned by corrections
    turning_radps: tuple[float, float] = (0.0, 0.0)
    corrections: FusionAge = FusionAge()  # of the estimate beside this motion
    off_s: float = math.inf  # since when the motors have been off; inf while they turn

    def with_sample(self, last: Telemetry | None, new: Telemetry) -> ImuMotion:
        """The motion with one more sample; `last`: the sample before it, None at the first."""
        dt_s = math.inf if last is None else new.t_s - last.t_s
        started_anew = last is not None and new.start != last.start
        motion = replace(
            self.compare(last, new),
            t_s=new.t_s,
            started_s=new.t_s if started_anew else self.started_s,
            corrections=self.corrections.update(new),
            off_s=min(self.off_s, new.t_s) if new.thrust < 1 else math.inf,
        )
        if last is None or not 0.0 < dt_s <= GAP_S or motion.frozen_s > FROZEN_READING_S:
            return _after_silence(motion, last, new)
        motion, up_mps2 = _integrate(motion, last, new, dt_s)
        now = Impact(new.t_s, new.velocity_mps[2], motion.velocity_mps[2], new.acc_z_g)
        motion = (
            motion.with_fall(new.t_s, up_mps2, new.acc_z_g, dt_s)
            .with_impact(now, new.position_m[2], up_mps2, dt_s)
            .with_speed(new.t_s, motion.velocity_mps, dt_s)
            .with_push(new, motion.offset_g, dt_s)
        )
        hover_thrust = _hover_thrust(motion.hover_thrust, new, dt_s)
        return replace(motion, sunk_m=0.0, hover_thrust=hover_thrust)

    @staticmethod
    def acceleration_mps2(
        sample: Telemetry, offset_g: Vector, tilt_off_rad: tuple[float, float] = (0.0, 0.0)
    ) -> Vector:
        """Acceleration in world axes by force and attitude of a sample, less the accelerometer's
        offset and the error of roll and pitch, `tilt_off_rad`."""
        roll_rad, pitch_rad = sample.roll_rad - tilt_off_rad[0], sample.pitch_rad - tilt_off_rad[1]
        cr, sr = math.cos(roll_rad), math.sin(roll_rad)
        cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
        cy, sy = math.cos(sample.yaw_rad), math.sin(sample.yaw_rad)
        fx, fy = sample.acc_x_g - offset_g[0], sample.acc_y_g - offset_g[1]
        fz = sample.acc_z_g - offset_g[2]
        level_x = cp * fx + sp * (sr * fy + cr * fz)
        level_y = cr * fy - sr * fz
        up = -sp * fx + cp * (sr * fy + cr * fz)
        g = GRAVITY_MPS2
        return (
            g * (cy * level_x - sy * level_y),
            g * (sy * level_x + cy * level_y),
            g * (up - 1.0),
        )


def _after_silence(motion: ImuMotion, last: Telemetry | None, new: Telemetry) -> ImuMotion:
    """The motion with the first sample, or with one that continues none."""
    motion = replace(
        motion,
        steady_s=new.t_s,
        steady_mps=motion.velocity_mps[2],
        steady_aside_s=new.t_s,
        steady_aside_mps=motion.velocity_mps[:2],
        sink_mps=0.0,
        blow_mps=0.0,
        light_since_s=math.inf,
    )
    if last is None:
        return replace(motion, sunk_m=0.0)
    sunk_m = min(0.0, motion.sunk_m + new.position_m[2] - last.position_m[2])
    alive = 0.0 <= motion.place_frozen_s <= FROZEN_READING_S and new.start == last.start
    if alive and _shows_no_fall(last, new, sunk_m):
        return replace(motion, silent_s=new.t_s, sunk_m=sunk_m)
    return replace(motion, silent_s=new.t_s, gap_s=new.t_s, sunk_m=0.0)


def _shows_no_fall(last: Telemetry, new: Telemetry, sunk_m: float) -> bool:
    dt_s = new.t_s - last.t_s
    gained_mps = new.velocity_mps[2] - last.velocity_mps[2]
    way_m = new.position_m[2] - last.position_m[2] - last.velocity_mps[2] * dt_s
    if max(last.behind_s, new.behind_s) > GAP_S:
        return False
    if 0.0 < dt_s <= GAP_S:
        return new.velocity_mps[2] > SINKS_MPS and sunk_m > -NO_FALL_M
    return abs(gained_mps) <= NO_FALL_MPS and abs(way_m) <= NO_FALL_M


def _integrate(
    motion: ImuMotion, last: Telemetry, new: Telemetry, dt_s: float
) -> tuple[ImuMotion, float]:
    """The motion with its velocity carried on by the trapezoid rule, and the vertical acceleration
    over the sample, m/s2. Offsets are learned while the motors are off and nothing flies."""
    offset_g = motion.offset_g
    if new.thrust < 1 and not new.has_bit(FLYING):
        offset_g = _offset_at_rest(offset_g, new, min(1.0, dt_s / REST_MEMORY_S))
    misled_rad, turning_radps = _tilt_by_corrections(motion, last, new, dt_s)
    before = ImuMotion.acceleration_mps2(last, offset_g, motion.misled_rad)
    after = ImuMotion.acceleration_mps2(new, offset_g, misled_rad)
    dv = tuple(0.5 * (a + b) * dt_s for a, b in zip(before, after, strict=True))
    x, y, z = (v + d for v, d in zip(motion.velocity_mps, dv, strict=True))
    motion = replace(
        motion,
        velocity_mps=(x, y, z),
        offset_g=offset_g,
        misled_rad=misled_rad,
        turning_radps=turning_radps,
    )
    return motion, dv[2] / dt_s


def _tilt_by_corrections(
    motion: ImuMotion, last: Telemetry, new: Telemetry, dt_s: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """How far corrections of the estimate have turned roll and pitch, rad, and the vehicle's own
    rates, rad/s. A sideways speed gained at once is a correction: what the attitude turns by in
    that sample, beyond its rates before, is no motion, and fades as the firmware takes it back."""
    gained_mps = math.dist(new.velocity_mps[:2], last.velocity_mps[:2])
    turned = (new.roll_rad - last.roll_rad, new.pitch_rad - last.pitch_rad)
    kept = 1.0 - dt_s / CORRECTED_MEMORY_S
    (roll, pitch), rates = motion.misled_rad, motion.turning_radps
    if gained_mps <= CORRECTED_MPS + CORRECTED_MPS2 * dt_s:
        return (kept * roll, kept * pitch), (turned[0] / dt_s, turned[1] / dt_s)
    return (
        kept * roll + turned[0] - rates[0] * dt_s,
        kept * pitch + turned[1] - rates[1] * dt_s,
    ), rates


_ACCELERATION = attrgetter("acc_x_g", "acc_y_g", "acc_z_g")
_ATTITUDE = attrgetter("roll_rad", "pitch_rad", "yaw_rad")
_PLACE = attrgetter("position_m", "velocity_mps")


def _frozen_s(
    before_s: float, last: Telemetry | None, new: Telemetry, reading: Callable[[Telemetry], object]
) -> float:
    if last is None:
        return before_s
    return 0.0 if reading(last) != reading(new) else before_s + max(0.0, new.t_s - last.t_s)


def _hover_thrust(old: float, sample: Telemetry, dt_s: float) -> float:
    flies = sample.has_bit(FLYING) and sample.thrust < HOVER_SATURATED_PART * FULL_THRUST
    if not flies or sample.thrust < LEAST_FLYING * FULL_THRUST or not 0.8 <= sample.acc_z_g <= 1.2:
        return old
    felt = sample.thrust / sample.acc_z_g
    return felt if old == 0.0 else old + (felt - old) * min(1.0, dt_s / HOVER_MEMORY_S)


def _offset_at_rest(old: Vector, sample: Telemetry, share: float) -> Vector:
    cr, sr = math.cos(sample.roll_rad), math.sin(sample.roll_rad)
    cp, sp = math.cos(sample.pitch_rad), math.sin(sample.pitch_rad)
    x, y, z = sample.acc_x_g + sp, sample.acc_y_g - cp * sr, sample.acc_z_g - cp * cr
    ox, oy, oz = old
    return (ox + share * (x - ox), oy + share * (y - oy), oz + share * (z - oz))
