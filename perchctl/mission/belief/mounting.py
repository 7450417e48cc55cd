"""Verify that the camera is mounted as the profile says: the target must stand still in the world.

If `camera.mount` is wrong by a rotation about the vehicle's upward axis, the target moves by (1 -
M) times the motion of the point where that axis meets the target's plane; M is the rotation as a
complex number. A least-squares fit over a decimetre of motion determines M (docs/mission.md, "The
mounting").
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

from perchctl.geometry import Array, rotation_from_rpy
from perchctl.values import replace
from perchctl.vehicle import Telemetry

MOUNTING_WINDOW_S = 3.0  # older sightings are dropped because the estimate drifts
MOUNTING_LEAST_SIGHTS = 10
"""Number of sightings that a judgement requires."""
JUDGED_M, PROVEN_M = 0.12, 0.3
"""Motion of the axis, m, above which the mounting is judged and above which it is proven."""
STANDS_STILL, MOVES_ALONG = 0.35, 0.6
"""Share of the vehicle's motion by which the target moves: below the first it stands still, above
the second it moves along. Undisturbed flights show 0.25 at most, a quarter turn 1.4."""
LEAST_SPREAD_M = 0.05
"""Least spread of the target's positions that shows a motion, m."""
MOST_UNEXPLAINED = 0.45  # share of the target's spread
LEAST_TURN = 0.5  # magnitude of M; near 0, the world frame drifts
# with a smaller rotation, the vehicle still reaches the target on a curve
LEAST_TURN_RAD = math.radians(65.0)
SIGHTS_IN_A_ROW = 4
"""Number of successive contradicting sightings that prove a wrong mounting. Smaller: single wrong
poses end the flight."""
JUMPS, SETTLES_S = ((0.1, 0.1), (0.15, 0.2)), 0.4
"""`JUMPS` are pairs of a distance, m, and a time, s: a target that moves by more than the distance
plus twice the vehicle's motion within the time was moved. `SETTLES_S` is the pause after a move,
s."""
ESTIMATE_JUMP_M = 0.05
"""Motion of the vehicle between two sightings, m, beyond `ESTIMATE_JUMP_MPS`, above which the
estimate has jumped. Larger: sightings from before and after a jump are compared."""
ESTIMATE_JUMP_MPS = 1.5
"""Increase of that limit for each second between the sightings, m/s. Smaller: the sightings of a
fast vehicle are dropped."""
_LONGEST_JUMP_S = max(within_s for _, within_s in JUMPS)


@dataclass(frozen=True)
class MountSample:
    """Positions of vehicle and target at `t_s` in the world, as x + iy in m.

    `lean_m` is the vector from the vehicle to the point where its upward axis meets the target's
    plane.
    """

    t_s: float
    vehicle_m: complex
    target_m: complex
    lean_m: complex = 0j

    @property
    def aim_m(self) -> complex:
        """Point where the vehicle's upward axis meets the target's plane."""
        return self.vehicle_m + self.lean_m


def mount_sample(t_s: float, telemetry: Telemetry, target_m: Array) -> MountSample:
    """Return the sample for a target at `target_m` (3,), world, and the vehicle's pose in
    `telemetry`."""
    x, y, z = telemetry.position_m
    up = rotation_from_rpy(telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad)[:, 2]
    lean_m = (float(target_m[2]) - z) * up
    place = complex(float(target_m[0]), float(target_m[1]))
    return MountSample(t_s, complex(x, y), place, complex(float(lean_m[0]), float(lean_m[1])))


@dataclass(frozen=True)
class MountingMonitor:
    """The sightings since the target came into view, and their verdict on the mounting."""

    sights: tuple[MountSample, ...] = ()
    paused_until_s: float = -math.inf
    mounting_fits: bool = False  # the target has stood still over `PROVEN_M`: the check is complete
    target_still: bool = False  # the target has stood still so far
    doubts: int = 0  # successive sightings that contradict the mounting
    turn_rad: float = 0.0  # rotation of the mounting with which the target would stand still

    @property
    def is_wrong(self) -> bool:
        """True once enough successive sightings contradict the mounting."""
        return self.doubts >= SIGHTS_IN_A_ROW

    @property
    def is_unconfirmed(self) -> bool:
        """True while no motion has shown yet that the target stands still."""
        return not (self.mounting_fits or self.target_still)


def update_monitor(old: MountingMonitor, sight: MountSample) -> MountingMonitor:
    """Return the monitor after one more sighting of a measured target."""
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
