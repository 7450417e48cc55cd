"""Whether the camera is mounted as the profile says: the target stands still in the world.

Where `camera.mount` is turned by an angle a about the vehicle's upward axis, the target is
placed T = p + M (t - p), with the true target t, M the turn by -a, and p the place where that
axis meets the target's plane: it moves with the vehicle and with each of its tilts, by
(1 - M) of the motion of p. In the plane a turn is a complex number of length 1, so one least
squares over a decimetre of that motion gives s = 1 - M (docs/mission.md, "The mounting").
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

from perchctl.geometry import Array, rotation_from_rpy
from perchctl.values import replace
from perchctl.vehicle import Telemetry

WINDOW_S = 3.0
"""Older sights are left out: a drifting estimate moves both, slowly and together."""
LEAST_SIGHTS = 10
JUDGED_M = 0.12
"""The vehicle's own motion, as its upward axis draws it at the target's height, from which on
it is judged, and ..."""
PROVEN_M = 0.3
"""... beyond which a target that has stood still ends the watch."""
STANDS_STILL = 0.35
MOVES_ALONG = 0.6
"""Of the vehicle's motion: below the first the target stands still, above the second it
moves with it. Undisturbed flights show 0.25 at most, a quarter turn 1.4."""
LEAST_SPREAD_M = 0.05
MOST_UNEXPLAINED = 0.45
"""Of the target's spread: more of it, and no turn explains how it moves."""
LEAST_TURN = 0.5
"""Length of M. About 0 is a world that drifts under both, and no turn."""
LEAST_TURN_RAD = math.radians(65.0)
"""A lesser turn leads to the target all the same, in a bow."""
SIGHTS_IN_A_ROW = 4
JUMPS = ((0.1, 0.1), (0.15, 0.2))
"""Metres, seconds: a target that moves so much farther than twice the vehicle within so short
a time has been moved, or is another one. What was seen before says nothing then, ..."""
SETTLES_S = 0.4
"""... nor does the filter's way to the new place."""
ESTIMATE_JUMP_M, FASTEST_MPS = 0.05, 1.5
"""A vehicle that moves more between two sights has a new world."""
_LONGEST_JUMP_S = max(within_s for _, within_s in JUMPS)

Turn = float


@dataclass(frozen=True)
class Sight:
    """Vehicle and target in the plane of the estimate's world, x + iy, in metres. `lean`: from
    the vehicle to where its upward axis meets the target's plane."""

    t_s: float
    vehicle: complex
    target: complex
    lean: complex = 0j

    @property
    def aim(self) -> complex:
        return self.vehicle + self.lean


def sight_of(t_s: float, telemetry: Telemetry, target_m: Array) -> Sight:
    """Of a target at `target_m` (3,) in the estimate's world, by the vehicle's newest sample."""
    x, y, z = telemetry.position_m
    up = rotation_from_rpy(telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad)[:, 2]
    lean_m = (float(target_m[2]) - z) * up
    place = complex(float(target_m[0]), float(target_m[1]))
    return Sight(t_s, complex(x, y), place, complex(float(lean_m[0]), float(lean_m[1])))


@dataclass(frozen=True)
class MountWatch:
    """What was seen since the target came into view.

    Attributes:
        fits: the target has stood still over `PROVEN_M`: nothing is watched any more.
        still: so far it has, judged by the newest sight.
        against: sights in a row that speak against the mounting.
        turn_rad: the turn about the vertical that would make the target stand still.
    """

    sights: tuple[Sight, ...] = ()
    deaf_until_s: float = -math.inf
    fits: bool = False
    still: bool = False
    against: int = 0
    turn_rad: Turn = 0.0

    @property
    def wrong(self) -> bool:
        return self.against >= SIGHTS_IN_A_ROW

    @property
    def last_from(self) -> tuple[float, float] | None:
        """Where the vehicle was at the last sight."""
        place = self.sights[-1].vehicle if self.sights else None
        return None if place is None else (place.real, place.imag)

    @property
    def open(self) -> bool:
        """Nothing speaks for the mounting yet."""
        return not (self.fits or self.still)


def watched(old: MountWatch, sight: Sight) -> MountWatch:
    """The watch with one more sight of a target that was measured."""
    if old.fits or old.wrong:
        return old
    kept = tuple(s for s in old.sights if sight.t_s - s.t_s <= WINDOW_S)
    if kept and _jumped(kept, sight):
        return MountWatch(deaf_until_s=sight.t_s + SETTLES_S)
    if sight.t_s < old.deaf_until_s:
        return old
    new = replace(old, sights=(*kept, sight), still=False, against=0)
    return new if len(new.sights) < LEAST_SIGHTS else _judged(new, old.against)


def _jumped(before: tuple[Sight, ...], sight: Sight) -> bool:
    last = before[-1]
    far = ESTIMATE_JUMP_M + FASTEST_MPS * (sight.t_s - last.t_s)
    if abs(sight.vehicle - last.vehicle) > far:
        return True
    for s in reversed(before):
        age_s = sight.t_s - s.t_s
        if age_s > _LONGEST_JUMP_S:
            return False
        target_m, vehicle_m = abs(sight.target - s.target), abs(sight.aim - s.aim)
        for jump_m, within_s in JUMPS:
            if age_s <= within_s and target_m > jump_m + 2.0 * vehicle_m:
                return True
    return False


def _judged(watch: MountWatch, against: int) -> MountWatch:
    aims, targets = [s.aim for s in watch.sights], [s.target for s in watch.sights]
    n, first = len(aims), aims[0]
    moved_m = max(abs(aim - first) for aim in aims)
    if moved_m < JUDGED_M:
        return watch
    p0, q0 = sum(aims) / n, sum(targets) / n
    pairs = [(aim - p0, target - q0) for aim, target in zip(aims, targets, strict=True)]
    along = sum(p.conjugate() * q for p, q in pairs) / sum(abs(p) ** 2 for p, _ in pairs)
    if abs(along) < STANDS_STILL:
        return replace(watch, fits=moved_m >= PROVEN_M, still=True)
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
        return replace(watch, against=against + 1, turn_rad=-cmath.phase(turn))
    return watch


def explained(turn_rad: Turn) -> str:
    """In words, the turn to the nearest quarter where it is about one, else to 10 degrees."""
    turn_deg = math.degrees(turn_rad)
    quarter = 90.0 * round(turn_deg / 90.0)
    near = abs(turn_deg - quarter) <= 35.0 and quarter != 0.0
    shown = quarter if near else 10.0 * round(turn_deg / 10.0)
    shown = 180.0 if shown == -180.0 else shown
    return (
        f"camera seems turned by about {shown:.0f} deg from what the profile says: the target "
        f"moves with the vehicle; measure it with `perchctl calibrate mount`, or add "
        f"{shown:.0f} to the last of camera.mount.rpy_deg"
    )
