"""What the flight notices of its camera's latency and mounting, picture by picture.

With `camera.latency_s: measured` the latency is used, too: taken off the pictures' times, once
it is sure, slowly, and within bounds. What is estimated rests on the pictures' times before
that, so that its use does not feed back.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from perchctl.flight.history import History, attitude_at, velocity_at
from perchctl.geometry import finite
from perchctl.profile import USED_LATENCY_S, CameraConfig
from perchctl.values import replace
from perchctl.vision import (
    ATTITUDE_STEP_S,
    LEAST_CONSISTENCY_RANGE_M,
    Consistency,
    ConsistencySums,
    MarkerPose,
    PoseSetup,
    add_moment,
    consistency_moment,
    solve_consistency,
)

SOLVE_EVERY_S = 1.0
LIKELY_S = 0.02
"""A delay whose sigma is smaller is where the next pictures' factors are taken."""
USED_SIGMA_S = 0.008
"""A delay that is less sure is not used: of its 95 % interval, half is 16 ms, and 30 ms make an
alignment swing."""
SLEW = 0.02
"""Seconds a second: at 0.4 m/s the target's place moves by 8 mm/s, as a drift does."""
LONGEST_STEP_S = 0.1


@dataclass(frozen=True, eq=False)
class Noticed:
    """`newest` is what `sums` said at `solved_s`, and `used_s` what is taken off the pictures'
    times beyond the profile's latency, since the picture of `seen_s`."""

    sums: ConsistencySums = field(default_factory=ConsistencySums)
    newest: Consistency | None = None
    solved_s: float = -math.inf
    used_s: float = 0.0
    seen_s: float = -math.inf


def noticed(
    old: Noticed,
    t_s: float,
    pose: MarkerPose,
    history: History,
    setup: PoseSetup,
    camera: CameraConfig,
    attitude_sigma_rad: float,
) -> Noticed:
    """With one more picture of the target. `t_s`: its arrival less the profile's latency."""
    new = _learned(old, t_s, pose, history, setup, attitude_sigma_rad)
    if camera.latency_s != "measured":
        return new
    return replace(new, seen_s=t_s, used_s=_slewed(new, camera, t_s - old.seen_s))


def _learned(
    old: Noticed,
    t_s: float,
    pose: MarkerPose,
    history: History,
    setup: PoseSetup,
    attitude_sigma_rad: float,
) -> Noticed:
    if (
        pose.cov is None
        or not finite(pose.cov)
        or float(pose.tvec_m[2]) < LEAST_CONSISTENCY_RANGE_M
    ):
        return old
    likely = old.newest is not None and old.newest.delay_sigma_s < LIKELY_S
    delay_s = old.newest.delay_s if old.newest is not None and likely else 0.0
    delay_s = max(-USED_LATENCY_S[1], min(USED_LATENCY_S[1], delay_s))
    before = attitude_at(history, t_s - delay_s - ATTITUDE_STEP_S)
    after = attitude_at(history, t_s - delay_s + ATTITUDE_STEP_S)
    if before is None or after is None:
        return old
    velocity_mps = velocity_at(history, t_s - delay_s)
    moment = consistency_moment(t_s, pose, before, after, velocity_mps, delay_s, setup)
    new = replace(old, sums=add_moment(old.sums, moment))
    if t_s - old.solved_s >= SOLVE_EVERY_S:
        newest = solve_consistency(new.sums, attitude_sigma_rad)
        new = replace(new, newest=newest, solved_s=t_s)
    return new


def _slewed(new: Noticed, camera: CameraConfig, dt_s: float) -> float:
    """What is used, one picture on: towards what is measured, or as it was where that is
    unsure."""
    if new.newest is None or not new.newest.delay_sigma_s <= USED_SIGMA_S:
        return new.used_s
    (least_s, most_s), start_s = USED_LATENCY_S, camera.start_latency_s
    goal_s = max(least_s, min(most_s, start_s + new.newest.delay_s)) - start_s
    step_s = SLEW * max(0.0, min(dt_s, LONGEST_STEP_S))
    return new.used_s + max(-step_s, min(step_s, goal_s - new.used_s))
