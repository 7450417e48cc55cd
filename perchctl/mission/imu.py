"""The vehicle's motion by accelerometer and attitude, where no position tells it.

`ImuMotion` integrates the specific force over each sample of the telemetry, and notes when the
vehicle fell, sank or was silent. `DeadReckoning` is the planner's: the speed and the place under
the target, carried on from the last good position.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter

from perchctl.geometry import GRAVITY_MPS2
from perchctl.values import replace
from perchctl.vehicle import FLYING, FULL_THRUST, Telemetry

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)

GAP_S = 0.2  # a silence in which a vehicle falls 20 cm, more than it may and still hang
NO_FALL_MPS, NO_FALL_M = 0.25, 0.25
"""What hangs gains no more speed in a silence, nor way beyond its speed before."""
SINKS_MPS = -0.3  # what hangs is no faster: 5 cm of a fall are
FROZEN_S = 0.2  # the same reading for so long counts as a silence
FALL_G, FALL_S = 0.6, 0.1  # of a fall: an impact is shorter
SINK_MPS = -0.25  # it begins to come down, whatever the offsets
SINK_MEMORY_S, OFFSET_MEMORY_S = 1.5, 3.0
IMPACT_G = -0.3  # what brakes a climb harder is an impact on the ceiling
BLOW_MPS, BLOW_S = 0.22, 0.1  # gained upwards by the floor: no thrust gives it
BEFORE_BLOW_S, BOUNCES_S = 0.05, 0.5  # a blow shows so much later; what follows belongs to it
STEADY_MPS, STEADY_ASIDE_MPS, ASIDE_MEMORY_S = 0.06, 0.15, 0.15
"""Speeds so near to each other are one speed; sideways, near to the mean of the last moment."""
REST_MEMORY_S = 0.5  # at rest on the ground the offsets are learned in so long
SPEED_MEMORY_S, BIAS_MEMORY_S = 3.0, 4.0
"""In so long the reckoned speed is drawn to a believed estimate's, and the offsets are learned."""
MOST_BIAS_MPS2 = 1.5
"""A wind of 4 m/s, which the firmware takes for a tilt, makes 1.2 m/s2. Larger: wrong positions
teach a bias that no attitude has."""
MOST_WRONG_MPS2 = 2.0
"""In one sample; more is a blow, or a correction of the estimate, and no bias. Larger: a kick of 40
ms teaches one. Smaller: a gust is not learned."""
CLIMB_SPARE_MPS = 0.1  # it may climb faster than reckoned
MOST_CLIMB_MPS = 1.0  # in a silence, by the position mode's own limit
REACH_M = 0.04  # a gear so near below the target may have been caught by its magnet
BOUNCE_WITHIN_M = 0.1
"""So near below the target the vertical speed follows the estimate: a bounce off the ceiling falls
between two samples of telemetry, and the firmware integrates it at 1 kHz. Larger: what late
pictures do to the estimate is taken over. Smaller: a bounce is missed by up to 0.3 m/s."""
MISSED_MEMORY_S = 1.0
"""In so long positions correct a speed that the estimate has missed. Larger: what a wrong attitude
adds in seconds looks like a blow. Smaller: a blow just before the last sight is forgotten."""
MOST_VELOCITY_BIAS_MPS = 0.6
"""A wind of 4 m/s makes 0.4 m/s. Larger: a vehicle that moves counts as still while its position
creeps. Smaller: it is never steady in a wind."""
VELOCITY_MEMORY_S = 2.0
"""In so long the bias of the estimated velocity is learned. Larger: a wind that has turned makes
the vehicle seem to move for longer. Smaller: noise of the position is taken for a bias."""
BESIDE_MEMORY_S, PUSHED_G, PUSHED_S = 0.5, 0.06, 1.5
"""A push from the side shows in the estimate a second or two later."""
PUSH_MEMORY_S = 0.05  # turning motors shake single samples by as much as a push gives
STEP_M, STEP_MPS = 0.005, 0.2
"""Motion of the estimated position beyond its speed, and the same for each second."""
UNSEEN_S = 0.15  # after a longer silence a step may be the vehicle's motion
CARRIED_S = 0.05  # a position is carried on for at most so long
BIAS_SIGMA_MPS2, SPEED_SIGMA_MPS, BLOW_SHARE = 0.06, 0.01, 0.3
"""Spread of a reckoned place: by the offset, by the speed at the last sight, and by the way."""
CORRECTED_MPS, CORRECTED_MPS2, CORRECTED_MEMORY_S = 0.08, 5.0, 6.0
"""A sideways speed that the estimate gains at once is a correction by a position."""
HOVER_MEMORY_S, LEAST_FLYING, SATURATED = 0.5, 0.4, 0.95
LED_PER_S = 1.5  # acceleration that positions feign for each m/s of lead
UNCORRECTED_M2PS2_PER_S, UNCORRECTED_S = 5e-4, 0.45
"""Half of what the variance of the vertical speed grows by if nothing corrects it."""


@dataclass(frozen=True)
class Corrections:
    """The estimate's variance of vertical speed, which only grows when nothing corrects it."""

    variance_m2ps2: float | None = None  # the newest
    changed_s: float = -math.inf  # when that variance came
    none_since_s: float = math.inf  # since when it has only grown

    def age_s(self, now_s: float) -> float:
        """Age of the last correction if corrections have certainly ceased; else 0."""
        certain = self.changed_s - self.none_since_s >= UNCORRECTED_S
        return now_s - self.none_since_s if certain else 0.0

    def add_sample(self, sample: Telemetry) -> Corrections:
        variance, before = sample.climb_variance_m2ps2, self.variance_m2ps2
        if variance is None or variance == before:
            return self
        least = UNCORRECTED_M2PS2_PER_S * (sample.t_s - self.changed_s)
        grows = before is not None and variance - before >= least
        none_since_s = min(self.none_since_s, self.changed_s) if grows else math.inf
        return Corrections(variance, sample.t_s, none_since_s)


@dataclass(frozen=True)
class Impact:
    """A blow from below, such as a touchdown's."""

    t_s: float = -math.inf  # -inf: there was none
    estimated_mps: float = 0.0  # vertical speed just before it, by the state estimate
    felt_mps: float = 0.0  # the same by `ImuMotion.velocity_mps`
    peak_g: float = 0.0  # the largest specific force read in it, along the body's z axis
    z_m: float = 0.0  # where the state estimate had the vehicle


@dataclass(frozen=True)
class ImuMotion:
    """The vehicle's motion by accelerometer and attitude alone; loop times are -inf for never."""

    t_s: float = -math.inf  # of the newest sample
    velocity_mps: Vector = ZERO  # since the first sample, world axes
    offset_g: Vector = ZERO  # what the accelerometer read too much at rest, body axes
    fell_s: float = -math.inf  # when it last fell, or came down and met the floor
    silent_s: float = -math.inf  # end of the newest silence
    gap_s: float = -math.inf  # of the newest that may hide a fall
    started_s: float = -math.inf  # first heard again after it had started anew
    sunk_m: float = 0.0  # by the estimate, while the accelerometer has stood still
    steady_s: float = math.inf  # since when the vertical speed has stayed what it is
    steady_mps: float = 0.0
    steady_aside_s: float = math.inf  # the same of the sideways speed
    steady_aside_mps: tuple[float, float] = (0.0, 0.0)  # the mean of the last moment
    light_since_s: float = math.inf
    sink_mps: float = 0.0
    offset_mps2: float = 0.0
    blow_mps: float = 0.0
    blow_s: float = -math.inf
    frozen_s: float = 0.0  # for how long the accelerometer has read the very same
    attitude_frozen_s: float = -math.inf  # the same of the attitude; -inf before a change
    place_frozen_s: float = -math.inf  # the same of position and velocity
    hover_thrust: float = 0.0  # for each measured g in flight
    aside_g: tuple[float, float] = (0.0, 0.0)  # mean sideways force, body axes
    pushed_s: float = -math.inf  # when something last pushed it sideways
    misled_rad: tuple[float, float] = (0.0, 0.0)  # roll and pitch turned by corrections
    turning_radps: tuple[float, float] = (0.0, 0.0)
    corrections: Corrections = Corrections()  # of the estimate beside this motion
    last_moment: tuple[Impact, ...] = ()  # what a blow that begins now has ended
    blow: Impact = Impact()  # the newest from below
    off_s: float = math.inf  # since when the motors have been off; inf while they turn

    @property
    def attitude_age_s(self) -> float:
        """Seconds for which the attitude has read the same while the accelerometer changed."""
        return max(0.0, self.attitude_frozen_s - self.frozen_s)

    @property
    def place_age_s(self) -> float:
        """Seconds of the same position and velocity readings while the accelerometer changed."""
        return max(0.0, self.place_frozen_s - self.frozen_s)

    def with_sample(self, last: Telemetry | None, new: Telemetry) -> ImuMotion:
        """The motion with one more sample; `last`: the sample before it, None at the first."""
        dt_s = math.inf if last is None else new.t_s - last.t_s
        started_anew = last is not None and new.start != last.start
        motion = replace(
            self,
            t_s=new.t_s,
            started_s=new.t_s if started_anew else self.started_s,
            frozen_s=_frozen_s(self.frozen_s, last, new, _ACCELERATION),
            attitude_frozen_s=_frozen_s(self.attitude_frozen_s, last, new, _ATTITUDE),
            place_frozen_s=_frozen_s(self.place_frozen_s, last, new, _PLACE),
            corrections=self.corrections.add_sample(new),
            off_s=min(self.off_s, new.t_s) if new.thrust < 1 else math.inf,
        )
        if last is None or not 0.0 < dt_s <= GAP_S or motion.frozen_s > FROZEN_S:
            return _after_silence(motion, last, new)
        offset_g = motion.offset_g
        if new.thrust < 1 and not new.has_bit(FLYING):
            offset_g = _offset_at_rest(offset_g, new, min(1.0, dt_s / REST_MEMORY_S))
        misled_rad, turning_radps = _misled(motion, last, new, dt_s)
        before = ImuMotion.acceleration_mps2(last, offset_g, motion.misled_rad)
        after = ImuMotion.acceleration_mps2(new, offset_g, misled_rad)
        dv = tuple(0.5 * (a + b) * dt_s for a, b in zip(before, after, strict=True))
        x, y, z = (v + d for v, d in zip(motion.velocity_mps, dv, strict=True))
        up_mps2 = dv[2] / dt_s
        offset = motion.offset_mps2 + (
            max(IMPACT_G * GRAVITY_MPS2, min(-IMPACT_G * GRAVITY_MPS2, up_mps2))
            - motion.offset_mps2
        ) * min(1.0, dt_s / OFFSET_MEMORY_S)
        felt_mps2 = max(up_mps2, IMPACT_G * GRAVITY_MPS2) - offset
        sink = motion.sink_mps + felt_mps2 * dt_s
        sink = min(0.0, sink - sink * dt_s / SINK_MEMORY_S)
        blow = max(0.0, motion.blow_mps * math.exp(-dt_s / BLOW_S) + up_mps2 * dt_s)
        light = min(motion.light_since_s, new.t_s) if new.acc_z_g < FALL_G else math.inf
        fell = sink < SINK_MPS or new.t_s - light >= FALL_S
        steady_s, steady_mps = motion.steady_s, motion.steady_mps
        if abs(z - steady_mps) > STEADY_MPS:
            steady_s, steady_mps = new.t_s, z
        steady_aside_s, (mean_x, mean_y) = motion.steady_aside_s, motion.steady_aside_mps
        keeps = math.exp(-dt_s / ASIDE_MEMORY_S)
        steady_aside_mps = (x + keeps * (mean_x - x), y + keeps * (mean_y - y))
        if math.dist((x, y), steady_aside_mps) > STEADY_ASIDE_MPS:
            steady_aside_s = new.t_s
        now = Impact(new.t_s, new.velocity_mps[2], z, new.acc_z_g)
        keeps = math.exp(-dt_s / PUSH_MEMORY_S)
        x_g, y_g = new.acc_x_g - offset_g[0], new.acc_y_g - offset_g[1]
        mean_x_g, mean_y_g = motion.aside_g
        aside_g = (
            x_g + keeps * (mean_x_g - new.acc_x_g + offset_g[0]),
            y_g + keeps * (mean_y_g - new.acc_y_g + offset_g[1]),
        )
        last_moment = (*(m for m in motion.last_moment if new.t_s - m.t_s <= BEFORE_BLOW_S), now)
        return replace(
            motion,
            velocity_mps=(x, y, z),
            offset_g=offset_g,
            fell_s=new.t_s if fell else motion.fell_s,
            sunk_m=0.0,
            steady_s=steady_s,
            steady_mps=steady_mps,
            steady_aside_s=steady_aside_s,
            steady_aside_mps=steady_aside_mps,
            light_since_s=light,
            sink_mps=sink,
            offset_mps2=offset,
            blow_mps=blow,
            blow_s=new.t_s if blow > BLOW_MPS else motion.blow_s,
            hover_thrust=_hover_thrust(motion.hover_thrust, new, dt_s),
            aside_g=aside_g,
            pushed_s=new.t_s if math.hypot(*aside_g) > PUSHED_G else motion.pushed_s,
            misled_rad=misled_rad,
            turning_radps=turning_radps,
            last_moment=last_moment,
            blow=_struck(motion, new, last_moment, blow),
        )

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
    alive = 0.0 <= motion.place_frozen_s <= FROZEN_S and new.start == last.start
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


def _struck(
    motion: ImuMotion, new: Telemetry, last_moment: tuple[Impact, ...], mps: float
) -> Impact:
    """The newest blow, which has gained `mps` by now; of its bounces the hardest counts. The
    onboard estimate has the whole of a blow before its second sample arrives."""
    old = motion.blow
    follows = new.t_s - old.t_s <= BOUNCES_S
    if mps > BLOW_MPS:
        begun = Impact(
            new.t_s,
            min(moment.estimated_mps for moment in last_moment),
            min(moment.felt_mps for moment in last_moment),
            max(moment.peak_g for moment in last_moment),
            new.position_m[2],
        )
        if not follows:
            return begun
        return replace(
            old,
            peak_g=max(old.peak_g, begun.peak_g),
            estimated_mps=min(old.estimated_mps, begun.estimated_mps),
            felt_mps=min(old.felt_mps, begun.felt_mps),
        )
    return replace(old, peak_g=max(old.peak_g, new.acc_z_g)) if follows else old


def _misled(
    motion: ImuMotion, last: Telemetry, new: Telemetry, dt_s: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return how far corrections have turned roll and pitch, and the own rates."""
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
    flies = sample.has_bit(FLYING) and sample.thrust < SATURATED * FULL_THRUST
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


@dataclass(frozen=True)
class DeadReckoning:
    """Velocity of the vehicle and place of its gear under the target, world axes, carried on by the
    accelerometer. `beside_mps`: sideways velocity that the state estimate alone has gained."""

    imu: ImuMotion | None = None  # the motion up to which it is reckoned
    velocity_mps: Vector = ZERO
    bias_mps2: Vector = ZERO  # excess of accelerometer and attitude
    aside_mps2: tuple[float, float] = (0.0, 0.0)  # mean of what the accelerometer reads sideways
    estimated_mps: Vector = ZERO
    beside_mps: tuple[float, float] = (0.0, 0.0)  # recently gained by the estimate alone
    missed_mps: tuple[float, float] = (0.0, 0.0)  # recently gained by the accelerometer alone
    below_m: float = math.inf  # gear below the target; inf if unseen or fallen
    nearest_m: float = math.inf  # the same with a climb in silences; a fall only adds to it
    unsure_s: float = -math.inf  # end of the newest silence that may have led to the magnet
    aside_m: tuple[float, float] = (0.0, 0.0)  # from the gear to the target's axis
    aside_sigma_m: float = math.inf  # standard deviation of that; inf if unknown
    sight_s: float = -math.inf  # exposure of the sight that it is carried on from
    stepped_m: tuple[float, float] = (0.0, 0.0)  # steps of the estimate since
    stepped_s: float = -math.inf  # the newest of them
    struck_mps: float = 0.0  # vertical speed just before `ImuMotion.blow`
    velocity_bias_mps: tuple[float, float] = (0.0, 0.0)  # sideways, of the estimated velocity
    mean_velocity_mps: tuple[float, float] = (0.0, 0.0)  # of the estimate, over the last seconds
    mean_position_m: tuple[float, float] | None = None  # the same of its position
    held_s: float = 0.0  # in the open and by positions, in all


def advance_reckoning(
    old: DeadReckoning,
    imu: ImuMotion,
    sample: Telemetry,
    *,
    believed: bool,
    astray: bool = False,
    corrected: bool = False,
    pushed: bool = False,
) -> DeadReckoning:
    """The reckoning one tick later.

    `corrected`: positions have come lately, and correct the estimated velocity;
    `believed`: the sample's estimated velocity is true, with `pushed` its vertical part only: what
    pushes a vehicle sideways, the firmware's estimator does not see until a position corrects it;
    `astray`: that velocity may be in other axes, so the reckoned velocity is kept even after a
    silence.
    """
    estimated, blow = sample.velocity_mps, imu.blow
    if old.imu is not None and blow.t_s > old.imu.blow.t_s:
        carried = not old.imu.t_s < imu.silent_s <= blow.t_s
        carried_mps = old.velocity_mps[2] + blow.felt_mps - old.imu.velocity_mps[2]
        old = replace(old, struck_mps=carried_mps if carried else blow.estimated_mps)
    frozen = imu.attitude_frozen_s > FROZEN_S
    if old.imu is None or imu.silent_s > old.imu.t_s or frozen:
        velocity_mps = estimated if believed else ZERO
        if astray:
            vx, vy, vz = old.velocity_mps
            if old.imu is not None and imu.silent_s <= old.imu.t_s:
                vz += imu.velocity_mps[2] - old.imu.velocity_mps[2]
            velocity_mps = (vx, vy, vz)
        elif not believed and old.imu is not None:
            vx, vy, vz = (
                v + e - o
                for v, e, o in zip(old.velocity_mps, estimated, old.estimated_mps, strict=True)
            )
            velocity_mps = (vx, vy, vz)
        unknown = replace(
            old,
            imu=imu,
            velocity_mps=velocity_mps,
            estimated_mps=estimated,
            beside_mps=(0.0, 0.0),
            missed_mps=(0.0, 0.0),
        )
        if old.imu is not None and imu.silent_s > old.imu.t_s:
            # Not with motors that were off around the silence, nor started anew.
            off = old.imu.off_s <= old.imu.t_s and imu.off_s <= imu.t_s
            flew = not (off or imu.started_s > old.imu.t_s)
            climb_mps = max(0.0, old.velocity_mps[2]) + CLIMB_SPARE_MPS
            climb_m = climb_mps**2 / (2.0 * GRAVITY_MPS2)
            if flew:
                climb_m = MOST_CLIMB_MPS * (imu.t_s - old.imu.t_s)
            nearest_m = old.nearest_m - climb_m
            near = nearest_m < REACH_M
            unknown = replace(
                unknown,
                nearest_m=nearest_m,
                unsure_s=imu.t_s if near else old.unsure_s,
                below_m=old.below_m if near or flew else math.inf,
            )
        return unknown if old.imu is None else replace(unknown, aside_sigma_m=math.inf)
    dt_s = imu.t_s - old.imu.t_s
    if not dt_s > 0.0:
        return old
    velocity, bias, beside, missed = [], [], [0.0, 0.0], [0.0, 0.0]
    remembers = math.exp(-dt_s / MISSED_MEMORY_S) if corrected else 1.0
    keeps = math.exp(-dt_s / BESIDE_MEMORY_S)
    calm = believed and imu.t_s - imu.pushed_s > PUSHED_S
    cos, sin = math.cos(sample.yaw_rad), math.sin(sample.yaw_rad)
    ahead_g, left_g = imu.aside_g
    reads_mps2 = (
        GRAVITY_MPS2 * (ahead_g * cos - left_g * sin),
        GRAVITY_MPS2 * (ahead_g * sin + left_g * cos),
    )
    aside_mps2 = [*old.aside_mps2]
    for i in range(3):
        gained = imu.velocity_mps[i] - old.imu.velocity_mps[i]
        if i == 2 and believed and old.below_m < BOUNCE_WITHIN_M:
            gained = estimated[2] - old.estimated_mps[2] + old.bias_mps2[2] * dt_s
        v, b = old.velocity_mps[i] + gained - old.bias_mps2[i] * dt_s, old.bias_mps2[i]
        if i < 2:
            alone = gained - b * dt_s - (estimated[i] - old.estimated_mps[i])
            missed[i] = remembers * old.missed_mps[i] + alone
        if believed and (i == 2 or not pushed):
            v += (estimated[i] - v) * min(1.0, dt_s / SPEED_MEMORY_S)
            wrong = (gained - (estimated[i] - old.estimated_mps[i])) / dt_s
            if calm and i < 2:
                more = estimated[i] - old.estimated_mps[i] - gained + b * dt_s
                beside[i] = keeps * old.beside_mps[i] + more
            if abs(wrong) <= MOST_WRONG_MPS2:
                share = min(1.0, dt_s / BIAS_MEMORY_S)
                b = max(-MOST_BIAS_MPS2, min(MOST_BIAS_MPS2, b + share * (wrong - b)))
                if i < 2:
                    aside_mps2[i] += share * (reads_mps2[i] - aside_mps2[i])
        velocity.append(v)
        bias.append(b)
    vx, vy, vz = velocity
    unseen_s = max(0.0, imu.t_s - old.sight_s)
    fell = imu.fell_s > max(old.imu.fell_s, old.sight_s)
    step_m = math.hypot(vx, vy) * dt_s
    growth_m = (SPEED_SIGMA_MPS + BIAS_SIGMA_MPS2 * unseen_s) * dt_s + BLOW_SHARE * step_m
    ex, ey = old.aside_m
    return replace(
        old,
        imu=imu,
        velocity_mps=(vx, vy, vz),
        bias_mps2=(bias[0], bias[1], bias[2]),
        aside_mps2=(aside_mps2[0], aside_mps2[1]),
        estimated_mps=estimated,
        beside_mps=(beside[0], beside[1]),
        missed_mps=(missed[0], missed[1]),
        below_m=math.inf if fell else old.below_m - (vz + CLIMB_SPARE_MPS) * dt_s,
        nearest_m=old.nearest_m - vz * dt_s,
        aside_m=(ex - vx * dt_s, ey - vy * dt_s),
        aside_sigma_m=old.aside_sigma_m + growth_m,
    )


def learn_velocity_bias(old: DeadReckoning, last: Telemetry, new: Telemetry) -> DeadReckoning:
    """The reckoning with the bias of the estimated velocity, from two samples of a flight in which
    positions hold the vehicle in the open.

    In a steady wind the firmware takes the air's drag for a tilt, and its estimate reads up to
    0.4 m/s while the vehicle stands still in the air. The bias is the estimated velocity less what
    the estimated position moves by, both through the same low pass. It is wrong for some
    `VELOCITY_MEMORY_S` after the wind has changed.
    """
    dt_s = new.t_s - last.t_s
    if not 0.0 < dt_s <= GAP_S:
        return forget_means(old)
    share = 1.0 - math.exp(-dt_s / VELOCITY_MEMORY_S)
    before_m = old.mean_position_m or new.position_m[:2]
    before_mps = old.velocity_bias_mps if old.mean_position_m is None else old.mean_velocity_mps
    velocity, position, bias = [], [], []
    for i in range(2):
        velocity.append(before_mps[i] + share * (new.velocity_mps[i] - before_mps[i]))
        position.append(before_m[i] + share * (new.position_m[i] - before_m[i]))
        bias.append(velocity[i] - (new.position_m[i] - position[i]) / VELOCITY_MEMORY_S)
    size_mps = math.hypot(*bias)
    part = 1.0 if size_mps <= MOST_VELOCITY_BIAS_MPS else MOST_VELOCITY_BIAS_MPS / size_mps
    return replace(
        old,
        velocity_bias_mps=(part * bias[0], part * bias[1]),
        mean_velocity_mps=(velocity[0], velocity[1]),
        mean_position_m=(position[0], position[1]),
        held_s=old.held_s + dt_s,
    )


def learn_bias_at_rest(
    old: DeadReckoning, before: ImuMotion | None, now: ImuMotion
) -> DeadReckoning:
    """The reckoning of a vehicle that something holds still: all acceleration sideways between the
    two motions is bias. The attitude's error, and the bias with it, changes within a second there,
    since the wind that the estimate has taken for a tilt no longer moves the vehicle."""
    if before is None or not 0.0 < now.t_s - before.t_s <= GAP_S or now.silent_s > before.t_s:
        return old
    dt_s = now.t_s - before.t_s
    share = 1.0 - math.exp(-dt_s / REST_MEMORY_S)
    x_mps2, y_mps2 = ((now.velocity_mps[i] - before.velocity_mps[i]) / dt_s for i in range(2))
    bx, by, bz = old.bias_mps2
    bias = bx + share * (x_mps2 - bx), by + share * (y_mps2 - by)
    return replace(old, bias_mps2=(*bias, bz))


def forget_means(old: DeadReckoning) -> DeadReckoning:
    """The reckoning after a time in which the velocity's bias could not be learned: the bias stays,
    and the means begin anew."""
    return old if old.mean_position_m is None else replace(old, mean_position_m=None)


def discount_wrong_positions(old: DeadReckoning) -> DeadReckoning:
    """The reckoning with its bias corrected for an attitude that wrong positions have tilted."""
    (bx, by, bz), (x_mps, y_mps) = old.bias_mps2, old.beside_mps
    return replace(old, bias_mps2=(bx + LED_PER_S * x_mps, by + LED_PER_S * y_mps, bz))


def add_position_step(old: DeadReckoning, last: Telemetry, sample: Telemetry) -> DeadReckoning:
    """The reckoning with one more step of the estimated position: the part of the way between two
    samples that the velocity does not explain. After a gap in the samples no step is added."""
    dt_s = _position_s(sample) - _position_s(last)
    if not 0.0 < dt_s <= UNSEEN_S:
        return old
    x_m, y_m = (
        sample.position_m[i]
        - last.position_m[i]
        - 0.5 * (last.velocity_mps[i] + sample.velocity_mps[i]) * dt_s
        for i in range(2)
    )
    if math.hypot(x_m, y_m) <= STEP_M + STEP_MPS * dt_s:
        return old
    sx_m, sy_m = old.stepped_m
    return replace(old, stepped_m=(sx_m + x_m, sy_m + y_m), stepped_s=sample.t_s)


def _position_s(sample: Telemetry) -> float:
    """Time of the position, carried on by at most `CARRIED_S`."""
    return sample.t_s - max(0.0, sample.behind_s - CARRIED_S)


def add_sighting(
    old: DeadReckoning, t_s: float, aside_m: tuple[float, float], below_m: float, sigma_m: float
) -> DeadReckoning:
    """The reckoning restarted at a sight; `aside_m` +- `sigma_m`: world x, y, gear to target."""
    return replace(
        old, sight_s=t_s, aside_m=aside_m, below_m=below_m, nearest_m=below_m, aside_sigma_m=sigma_m
    )
