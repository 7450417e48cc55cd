"""Checks whether the pictures show the motion that the accelerometer measures.

The way from the body to the target, turned by the attitude at the exposure, and the body's own
motion by its accelerometer add up to one place, but for the speed at the window's begin and a
constant offset. If pictures are later than assumed, or the camera is turned about the upward axis,
the sum wanders; with the right delay or turn it comes to rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.mission import ImuMotion, Mismatch, VisualInertialMotion
from perchctl.values import replace
from perchctl.vehicle import Telemetry

Vector = tuple[float, float, float]

WINDOW_S, LEAST_S, LEAST_SIGHTS = 1.2, 0.6, 10
EVERY_S, AGREED = 0.05, 3  # between judgements, and how many in a row have to agree
STEP_S = 0.02
_DELAYS_S, _QUARTERS_RAD = np.arange(-8, 32) * STEP_S, np.array([0.5, 1.0, -0.5]) * math.pi
LATER_S = np.concatenate([_DELAYS_S, np.zeros(len(_QUARTERS_RAD))])
TURNS_RAD = np.concatenate([np.zeros(len(_DELAYS_S)), _QUARTERS_RAD])
"""What is tried: delays beyond the assumed one, and turns of the camera."""
OFFSET_MPS2, SIGMA_M = 0.2, 0.003  # sigma of the offset (with 1 deg of attitude) and of a sight
LEAST_LATER_S = 0.1  # less swings an alignment by centimetres, and is reported after the flight
WANDERS_M, WANDERS_MORE = 0.005, 3.0  # by so much, and so much more than with the right delay
ROUGH_M = 0.03  # a sum that wanders so far within a second gives the speed to 0.05 m/s
ALIKE_S = 3 * STEP_S


@dataclass(frozen=True)
class VisualInertialWindow:
    """The sights of the last `WINDOW_S`, and the mismatch and motion that they show."""

    sights: tuple[tuple[float, Vector], ...] = ()  # time, way from body to target, body axes, m
    judged_s: float = -math.inf
    latest: Mismatch | None = None  # the newest judgement; once enough agree, it stays
    latest_s: float = -math.inf
    agree_count: int = 0  # judgements in a row that say the same
    motion: VisualInertialMotion | None = None  # the newest in which the sum wandered by at most
    motion_within_m: float = WANDERS_M  # ... this

    @property
    def mismatch(self) -> Mismatch | None:
        """The newest mismatch, once enough judgements in a row agree; None before that."""
        return self.latest if self.agree_count >= AGREED else None


def drop_sightings(old: VisualInertialWindow) -> VisualInertialWindow:
    """The window without its sights; from now on the window accepts a rougher motion."""
    return replace(old, sights=(), motion_within_m=ROUGH_M)


def estimate_motion(
    old: VisualInertialWindow,
    t_s: float,
    body_to_target_m: Vector,
    samples: tuple[Telemetry, ...],
    offset_g: Vector,
) -> VisualInertialWindow:
    """The window with one more sight, `body_to_target_m` in body axes at `t_s`; `samples`:
    telemetry of the last 2 s, oldest first; `offset_g`: what the accelerometer reads too much."""
    kept = tuple(s for s in old.sights if t_s - WINDOW_S <= s[0] < t_s)
    new = replace(old, sights=(*kept, (t_s, body_to_target_m)))
    short = t_s - new.sights[0][0] < LEAST_S or len(new.sights) < LEAST_SIGHTS
    if short or len(samples) < LEAST_SIGHTS or t_s - old.judged_s < EVERY_S:
        return new
    wanders_m, velocity_mps, bias_mps2 = fit_hypotheses(new.sights, samples, offset_g)
    if old.mismatch is None:  # else it stays
        found, before = _found(wanders_m), old.latest
        agreed = 0 if found is None else 1
        if found is not None and before is not None and found.turn_rad == before.turn_rad:
            agreed += old.agree_count if abs(found.later_s - before.later_s) <= ALIKE_S else 0
        new = replace(new, latest=found, latest_s=t_s, agree_count=agreed)
    i = _best_about(new.mismatch or Mismatch(), wanders_m)
    if wanders_m[i] <= new.motion_within_m:
        (vx, vy, vz), (bx, by, _) = velocity_mps[:, i].tolist(), bias_mps2[:, i].tolist()
        climb_mps = vz if t_s - new.latest_s <= WINDOW_S else None
        new = replace(
            new, motion=VisualInertialMotion(samples[-1].t_s, (vx, vy), (bx, by), climb_mps)
        )
    return replace(new, judged_s=t_s)


def _best_about(mismatch: Mismatch, wanders_m: Array) -> int:
    """The index that wanders least among those that are no other mismatch."""
    about = np.abs(LATER_S - mismatch.later_s) < LEAST_LATER_S
    about &= mismatch.turn_rad == TURNS_RAD
    return int(np.argmin(np.where(about, wanders_m, np.inf)))


def _found(wanders_m: Array) -> Mismatch | None:
    """The mismatch that explains the pictures; None if the profile does."""
    best = int(np.argmin(wanders_m))
    as_it_is = float(wanders_m[np.argmin(np.abs(LATER_S) + np.abs(TURNS_RAD))])
    if as_it_is < max(WANDERS_M, WANDERS_MORE * float(wanders_m[best])):
        return None
    found = Mismatch(float(LATER_S[best]), float(TURNS_RAD[best]))
    return found if found.turn_rad or abs(found.later_s) >= LEAST_LATER_S else None


def fit_hypotheses(
    sights: tuple[tuple[float, Vector], ...], samples: tuple[Telemetry, ...], offset_g: Vector
) -> tuple[Array, Array, Array]:
    """The motion under each of n hypotheses: the delay `LATER_S[i]` and camera turn `TURNS_RAD[i]`.

    `sights`: times, and ways from body to target, m, body axes. Returns the target's apparent
    sideways motion, rms in m, (n,); the vehicle's velocity at the newest sample, m/s, (3, n);
    and the offset of its acceleration, m/s2, (3, n).
    """
    stamps_s = np.array([s.t_s for s in samples])
    attitudes = np.array([(s.roll_rad, s.pitch_rad, s.yaw_rad) for s in samples])
    attitudes[:, 2] = np.unwrap(attitudes[:, 2])
    forces = np.array([ImuMotion.acceleration_mps2(s, offset_g) for s in samples])
    speeds = _integral(stamps_s, forces)
    moved = _integral(stamps_s, speeds)

    seen_s = np.array([t_s for t_s, _ in sights])
    x, y, z = np.array([way_m for _, way_m in sights]).T
    then_s = seen_s - LATER_S[:, None]
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
    left = ((sums - found @ unknown.T) * sums)[:2].sum(axis=(0, 2))
    newest_u = stamps_s[-1] + LATER_S - seen_s.mean()
    velocity = speeds[-1][:, None] - found[..., 1] - found[..., 2] * newest_u
    return np.sqrt(np.maximum(left, 0.0) / len(u)), velocity, found[..., 2]


def _turned(a: Array, b: Array, by_rad: Array) -> tuple[Array, Array]:
    c, s = np.cos(by_rad), np.sin(by_rad)
    return c * a - s * b, s * a + c * b


def _integral(t_s: Array, values: Array) -> Array:
    """The integral by trapezia, (n, k); 0 at the first."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(t_s)[:, None]
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(steps, axis=0)])
