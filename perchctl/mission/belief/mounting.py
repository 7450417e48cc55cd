"""Checks that the camera is mounted as the profile says: the target stands still in the world.

Where `camera.mount` is turned about the vehicle's upward axis, the target moves by (1 - M) of the
motion of the place where that axis meets the target's plane, M being the turn as a complex number:
one least squares over a decimetre gives it (docs/mission.md, "The mounting").
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

from perchctl.geometry import Array, rotation_from_rpy
from perchctl.values import replace
from perchctl.vehicle import Telemetry

MOUNTING_WINDOW_S = 3.0  # older sights are left out: the estimate drifts
MOUNTING_LEAST_SIGHTS = 10
JUDGED_M, PROVEN_M = 0.12, 0.3
"""Motion of the axis from which on the mounting is judged, and beyond which it is proven."""
STANDS_STILL, MOVES_ALONG = 0.35, 0.6
"""Of the vehicle's motion. Undisturbed flights show 0.25 at most, a quarter turn 1.4."""
LEAST_SPREAD_M = 0.05
MOST_UNEXPLAINED = 0.45  # of the target's spread
LEAST_TURN = 0.5  # length of M; about 0 is a world that drifts
LEAST_TURN_RAD = math.radians(65.0)  # a lesser one leads to the target in a bow
SIGHTS_IN_A_ROW = 4
JUMPS, SETTLES_S = ((0.1, 0.1), (0.15, 0.2)), 0.4
"""Metres, seconds: a target that moves so much farther than twice the vehicle has been moved."""
ESTIMATE_JUMP_M = 0.05
"""A vehicle that moves farther between two sights, beyond `ESTIMATE_JUMP_MPS`, is in a new world.
Larger: sights from before and after a jump of the estimate are compared."""
ESTIMATE_JUMP_MPS = 1.5
"""The same for each second between them. Smaller: a fast vehicle drops its sights."""
_LONGEST_JUMP_S = max(within_s for _, within_s in JUMPS)


@dataclass(frozen=True)
class MountSample:
    """Positions of vehicle and target at `t_s`, as world x + iy in m.

    `lean_m`: from the vehicle to where its upward axis meets the target's plane.
    """

    t_s: float
    vehicle_m: complex
    target_m: complex
    lean_m: complex = 0j

    @property
    def aim_m(self) -> complex:
        """Where the vehicle's upward axis meets the target's plane."""
        return self.vehicle_m + self.lean_m


def mount_sample(t_s: float, telemetry: Telemetry, target_m: Array) -> MountSample:
    """The sample of a target at `target_m` (3,), world, and of the vehicle as in `telemetry`."""
    x, y, z = telemetry.position_m
    up = rotation_from_rpy(telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad)[:, 2]
    lean_m = (float(target_m[2]) - z) * up
    place = complex(float(target_m[0]), float(target_m[1]))
    return MountSample(t_s, complex(x, y), place, complex(float(lean_m[0]), float(lean_m[1])))


@dataclass(frozen=True)
class MountingMonitor:
    """The sights since the target came into view, and what they show of the mounting."""

    sights: tuple[MountSample, ...] = ()
    paused_until_s: float = -math.inf
    mounting_fits: bool = False  # the target has stood still over `PROVEN_M`: the check is over
    target_still: bool = False  # the target has stood still so far
    doubts: int = 0  # sights in a row that speak against the mounting
    turn_rad: float = 0.0  # the turn that would make the target stand still

    @property
    def is_wrong(self) -> bool:
        """True once enough sights in a row speak against the mounting."""
        return self.doubts >= SIGHTS_IN_A_ROW

    @property
    def is_unconfirmed(self) -> bool:
        return not (self.mounting_fits or self.target_still)


def update_monitor(old: MountingMonitor, sight: MountSample) -> MountingMonitor:
    """The monitor with one more sight of a measured target."""
    if old.mounting_fits or old.is_wrong:
        return old
    kept = tuple(s for s in old.sights if sight.t_s - s.t_s <= MOUNTING_WINDOW_S)
    if kept and _jumped(kept, sight):
        return MountingMonitor(paused_until_s=sight.t_s + SETTLES_S)
    if sight.t_s < old.paused_until_s:
        return old
    new = replace(old, sights=(*kept, sight), target_still=False, doubts=0)
    return new if len(new.sights) < MOUNTING_LEAST_SIGHTS else _judged(new, old.doubts)


def _jumped(before: tuple[MountSample, ...], sight: MountSample) -> bool:
    last = before[-1]
    far = ESTIMATE_JUMP_M + ESTIMATE_JUMP_MPS * (sight.t_s - last.t_s)
    if abs(sight.vehicle_m - last.vehicle_m) > far:
        return True
    for s in reversed(before):
        age_s = sight.t_s - s.t_s
        if age_s > _LONGEST_JUMP_S:
            return False
        target_m, vehicle_m = abs(sight.target_m - s.target_m), abs(sight.aim_m - s.aim_m)
        for jump_m, within_s in JUMPS:
            if age_s <= within_s and target_m > jump_m + 2.0 * vehicle_m:
                return True
    return False


def _judged(watch: MountingMonitor, against: int) -> MountingMonitor:
    aims, targets = [s.aim_m for s in watch.sights], [s.target_m for s in watch.sights]
    n, first = len(aims), aims[0]
    moved_m = max(abs(aim - first) for aim in aims)
    if moved_m < JUDGED_M:
        return watch
    p0, q0 = sum(aims) / n, sum(targets) / n
    pairs = [(aim - p0, target - q0) for aim, target in zip(aims, targets, strict=True)]
    along = sum(p.conjugate() * q for p, q in pairs) / sum(abs(p) ** 2 for p, _ in pairs)
    if abs(along) < STANDS_STILL:
        return replace(watch, mounting_fits=moved_m >= PROVEN_M, target_still=True)
    spread_m = math.sqrt(sum(abs(q) ** 2 for _, q in pairs) / n)
    unexplained_m = math.sqrt(sum(abs(q - along * p) ** 2 for p, q in pairs) / n)
    turn = 1.0 - along
    if (
        abs(along) >= MOVES_ALONG
        and abs(turn) >= LEAST_TURN
        and abs(cmath.phase(turn)) >= LEAST_TURN_RAD
        and spread_m >= LEAST_SPREAD_M
        and unexplained_m <= MOST_UNEXPLAINED * spread_m
    ):
        return replace(watch, doubts=against + 1, turn_rad=-cmath.phase(turn))
    return watch
