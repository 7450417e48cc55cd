"""Dead reckoning: the vehicle's motion carried on by the accelerometer from the last good position.

While a position corrects the state estimate, the reckoned velocity v is drawn to the estimate's e
and the bias b, the excess of accelerometer and attitude, is learned from the difference:

    v += (dv_imu - b dt)                          each sample
    v += (e - v) dt / SPEED_MEMORY_S              while e is believed
    b += (dv_imu - de - b dt) / BIAS_MEMORY_S     while e is believed

Without one, v runs on by the first line alone. The gear's place under the target runs on with v
from the last sighting, and its standard deviation grows with the time since and the way flown. All
of it is wrong by what the bias has changed since the position was lost: 0.1 m/s2 is 0.45 m after
3 s. The gains are fixed; a Kalman filter of velocity, bias and the pictures' positions is no better
(`benchmarks/reckoning.py`), since what limits both is that change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.geometry import GRAVITY_MPS2
from perchctl.mission.belief.motion import (
    FROZEN_READING_S,
    GAP_S,
    PUSHED_S,
    REST_MEMORY_S,
    ZERO,
    ImuMotion,
    Vector,
)
from perchctl.values import replace
from perchctl.vehicle import Telemetry

SPEED_MEMORY_S = 3.0
"""Time in which the reckoned velocity is drawn to a believed estimate's. Larger: an old error of it
stays. Smaller: a wrong estimate is followed."""
BIAS_MEMORY_S = 4.0
"""Time in which the bias is learned. Larger: a wind that has turned is followed late. Smaller: a
gust is taken for a bias."""
MOST_BIAS_MPS2 = 1.5
"""A wind of 4 m/s, which the firmware takes for a tilt, makes 1.2 m/s2. Larger: wrong positions
teach a bias that no attitude has."""
MOST_WRONG_MPS2 = 2.0
"""In one sample; more is a blow, or a correction of the estimate, and no bias. Larger: a kick of 40
ms teaches one. Smaller: a gust is not learned."""
CLIMB_SPARE_MPS = 0.1
"""Speed by which it may climb faster than reckoned. Larger: the magnet seems near too early."""
MOST_CLIMB_MPS = 1.0
"""Climb in a silence, by the position mode's own limit."""
MAGNET_REACH_M = 0.04
"""A gear this close below the target may have been caught by its magnet. Larger: a vehicle in the
air is treated as one that may hang. Smaller: a caught one is treated as flying."""
BOUNCE_WITHIN_M = 0.1
"""So near below the target the vertical speed follows the estimate: a bounce off the ceiling falls
between two samples of telemetry, and the firmware integrates it at 1 kHz. Larger: what late
pictures do to the estimate is taken over. Smaller: a bounce is missed by up to 0.3 m/s."""
MISSED_MEMORY_S = 1.0
"""In so long positions correct a speed that the estimate has missed. Larger: what a wrong attitude
adds in seconds looks like a blow. Smaller: a blow just before the last sighting is forgotten."""
MOST_VELOCITY_BIAS_MPS = 0.6
"""A wind of 4 m/s makes 0.4 m/s. Larger: a vehicle that moves counts as still while its position
creeps. Smaller: it is never steady in a wind."""
VELOCITY_MEMORY_S = 2.0
"""In so long the bias of the estimated velocity is learned. Larger: a wind that has turned makes
the vehicle seem to move for longer. Smaller: noise of the position is taken for a bias."""
BESIDE_MEMORY_S = 0.5
"""Time in which a velocity that the estimate alone has gained is forgotten."""
STEP_M = 0.005
"""Motion of the estimated position beyond its speed that is a step. Smaller: noise is one."""
STEP_MPS = 0.2
"""The same for each second between two samples."""
UNSEEN_S = 0.15
"""After a longer silence a step may be the vehicle's motion."""
CARRIED_S = 0.05
"""A position is carried on for at most so long."""
BIAS_SIGMA_MPS2 = 0.06
"""Spread of the bias behind a reckoned place. Smaller: contacts are claimed too precisely."""
SPEED_SIGMA_MPS = 0.01
"""The same of the speed at the last sighting."""
BLOW_SHARE = 0.3
"""Share of the way flown unseen that adds to the spread of a reckoned place."""
LED_PER_S = 1.5
"""Acceleration, m/s2, that positions in other axes feign for each m/s by which they lead."""
MOST_SILENT_MOVE_S = 0.5
"""Longest step of the reckoned height; a longer one is a silence."""


@dataclass(frozen=True)
class DeadReckoning:
    """Velocity of the vehicle and place of its gear under the target, world axes, carried on by the
    accelerometer. `beside_mps`: sideways velocity that the state estimate alone has gained."""

    imu: ImuMotion | None = None  # the motion up to which it is reckoned
    velocity_mps: Vector = ZERO
    bias_mps2: Vector = ZERO  # excess of accelerometer and attitude
    mean_lateral_mps2: tuple[float, float] = (0.0, 0.0)  # what the accelerometer reads sideways
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
    diverged: bool = False,
    corrected: bool = False,
    pushed: bool = False,
) -> DeadReckoning:
    """The reckoning one tick later.

    `corrected`: positions have come lately, and correct the estimated velocity;
    `believed`: the sample's estimated velocity is true, with `pushed` its vertical part only: what
    pushes a vehicle sideways, the firmware's estimator does not see until a position corrects it;
    `diverged`: that velocity may be in other axes, so the reckoned velocity is kept even after a
    silence.
    """
    estimated, blow = sample.velocity_mps, imu.blow
    if old.imu is not None and blow.t_s > old.imu.blow.t_s:
        carried = not old.imu.t_s < imu.silent_s <= blow.t_s
        carried_mps = old.velocity_mps[2] + blow.felt_mps - old.imu.velocity_mps[2]
        old = replace(old, struck_mps=carried_mps if carried else blow.estimated_mps)
    frozen = imu.attitude_frozen_s > FROZEN_READING_S
    if old.imu is None or imu.silent_s > old.imu.t_s or frozen:
        return _begin_anew(old, imu, estimated, believed=believed, diverged=diverged)
    return _carry_on(
        old, old.imu, imu, sample, believed=believed, corrected=corrected, pushed=pushed
    )


def _begin_anew(
    old: DeadReckoning, imu: ImuMotion, estimated: Vector, *, believed: bool, diverged: bool
) -> DeadReckoning:
    """The reckoning at the first sample, after a silence, or while the attitude stands still: the
    velocity is the estimate's, or what the estimate has gained since."""
    velocity_mps = estimated if believed else ZERO
    if diverged:
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
    if old.imu is None:
        return unknown
    if imu.silent_s > old.imu.t_s:
        # Not with motors that were off around the silence, nor started anew.
        off = old.imu.off_s <= old.imu.t_s and imu.off_s <= imu.t_s
        flew = not (off or imu.started_s > old.imu.t_s)
        climb_mps = max(0.0, old.velocity_mps[2]) + CLIMB_SPARE_MPS
        climb_m = climb_mps**2 / (2.0 * GRAVITY_MPS2)
        if flew:
            climb_m = MOST_CLIMB_MPS * (imu.t_s - old.imu.t_s)
        nearest_m = old.nearest_m - climb_m
        near = nearest_m < MAGNET_REACH_M
        unknown = replace(
            unknown,
            nearest_m=nearest_m,
            unsure_s=imu.t_s if near else old.unsure_s,
            below_m=old.below_m if near or flew else math.inf,
        )
    return replace(unknown, aside_sigma_m=math.inf)


def _carry_on(
    old: DeadReckoning,
    before: ImuMotion,
    imu: ImuMotion,
    sample: Telemetry,
    *,
    believed: bool,
    corrected: bool,
    pushed: bool,
) -> DeadReckoning:
    """The reckoning one sample after `before`, by the equations above."""
    estimated, dt_s = sample.velocity_mps, imu.t_s - before.t_s
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
    mean_lateral_mps2 = [*old.mean_lateral_mps2]
    for i in range(3):
        gained = imu.velocity_mps[i] - before.velocity_mps[i]
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
                    mean_lateral_mps2[i] += share * (reads_mps2[i] - mean_lateral_mps2[i])
        velocity.append(v)
        bias.append(b)
    vx, vy, vz = velocity
    unseen_s = max(0.0, imu.t_s - old.sight_s)
    fell = imu.fell_s > max(before.fell_s, old.sight_s)
    step_m = math.hypot(vx, vy) * dt_s
    growth_m = (SPEED_SIGMA_MPS + BIAS_SIGMA_MPS2 * unseen_s) * dt_s + BLOW_SHARE * step_m
    ex, ey = old.aside_m
    return replace(
        old,
        imu=imu,
        velocity_mps=(vx, vy, vz),
        bias_mps2=(bias[0], bias[1], bias[2]),
        mean_lateral_mps2=(mean_lateral_mps2[0], mean_lateral_mps2[1]),
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
