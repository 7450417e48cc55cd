"""What a hand that lifts, turns and tilts a vehicle shows of its motion capture. Pure.

The vehicle's own attitude knows how it is turned, and which way is up; the capture says the same
in its own axes. With R_own and R_seen the attitudes that both have of it, and A the capture's
world, B the rigid body's axes, where they should be none:

    R_seen = A R_own B

A turn between two moments, as a vector, is ``A w`` in the capture's world where the vehicle has
``w``, and ``B^T v`` in the body's axes where it has ``v``: two rotations between sets of vectors,
each solved by least squares (Kabsch, by the singular value decomposition). A's turn about the
vertical is the capture's own affair, since the vehicle's heading is set by it; its tilt is
another axis up. B is a body whose axes were not defined along the vehicle's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.check.row import Row, failed, passed, skipped, warned
from perchctl.flight import nearest_axis
from perchctl.geometry import Array, rotation_from_rpy, rpy_from_rotation
from perchctl.perception import History, attitude_at
from perchctl.positioning import Placed
from perchctl.profile import PositioningConfig
from perchctl.vehicle import Telemetry

NAME = "lifted"
HOW = "lift it straight up by 30 cm, turn it by 90 deg, tilt it forward and aside, put it back"
EVERY_S = 0.1
LEAST_STEP_RAD, MOST_STEP_RAD = math.radians(12.0), math.radians(120.0)
"""Turns between two moments: smaller ones are noise, larger ones have no certain axis."""
MOVED_RAD, MOVED_M, MOVED_G = math.radians(12.0), 0.06, 0.05
STILL_RAD, STILL_M = math.radians(4.0), 0.03
MANY_SHARE = 0.9
"""All turns are about one axis where so many of them leave it by less than `LEAST_STEP_RAD`. A
spread over all of them would say so of who turns far and tilts little, or lets it stand long."""
UPRIGHT_DEG, BODY_WARN_DEG, BODY_FAIL_DEG = 25.0, 5.0, 15.0
LIFTED_M = 0.12
REACH_M = 5.0
"""A hand lifts no farther: what moved farther is told in another unit."""
STRANGER = 0.4
"""Of a turn: what A and B leave unexplained, on the average."""


@dataclass(frozen=True, eq=False)
class Moved:
    """Pairs of one moment each: attitudes as the vehicle (n, 3, 3) and the capture (n, 3, 3)
    have them, the capture's places (n, 3), and the accelerometer's largest difference from 1 g."""

    own: Array
    seen: Array
    place_m: Array
    moved_g: float


@dataclass(frozen=True, eq=False)
class Turns:
    """What the turns say. `up`: the vertical in the capture's world, (3,), None where all turns
    were about one other axis. `R_body`: the rigid body's axes in the vehicle's, (3, 3), None
    where they were all about one. `unexplained`: of a turn, on the average, 0 to 1 and more."""

    up: Array | None
    R_body: Array | None
    unexplained: float


def paired(telemetry: Sequence[Telemetry], places: Sequence[Placed]) -> Moved | None:
    """The attitude of each place's moment, every `EVERY_S`; None of less than three."""
    if len(telemetry) < 2:
        return None
    history = History(tuple(telemetry))
    own, seen, place_m, last_s = [], [], [], -math.inf
    for placed in places:
        inside = telemetry[0].t_s <= placed.t_s <= telemetry[-1].t_s
        if not inside or placed.t_s < last_s + EVERY_S:
            continue
        attitude = attitude_at(history, placed.t_s)
        if attitude is None:
            continue
        own.append(rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad))
        seen.append(placed.R)
        place_m.append(placed.position_m)
        last_s = placed.t_s
    if len(own) < 3:
        return None
    moved_g = max(abs(t.acc_z_g - 1.0) for t in telemetry)
    return Moved(np.array(own), np.array(seen), np.array(place_m), moved_g)


def is_enough(moved: Moved) -> bool:
    """Lifted, turned and tilted, and put back: more would tell no more."""
    turns, ways_m = turns_of(moved), np.linalg.norm(moved.place_m - moved.place_m[0], axis=1)
    back = ways_m[-1] < STILL_M and _angle_rad(moved.own[0].T @ moved.own[-1]) < MOVED_RAD
    whole = turns is not None and turns.up is not None and turns.R_body is not None
    return whole and bool(back) and float(ways_m.max()) > 2.0 * LIFTED_M


def row(moved: Moved | None, config: PositioningConfig) -> Row:
    """The comparison as one row: the gravest that was found."""
    if moved is None:
        return skipped(NAME, "no moments at which both vehicle and capture said something", HOW)
    own_rad, seen_rad = _largest_rad(moved.own), _largest_rad(moved.seen)
    way_m = float(np.linalg.norm(moved.place_m - moved.place_m[0], axis=1).max())
    body = f"rigid body {config.body!r}"
    moves = own_rad > MOVED_RAD or moved.moved_g > MOVED_G
    follows = seen_rad > STILL_RAD or way_m > STILL_M
    if moves and not follows:
        return failed(
            NAME, f"the vehicle moves, and the {body} stands still",
            "it is another body's: correct positioning.body",
        )  # fmt: skip
    if not moves and (way_m > MOVED_M or seen_rad > MOVED_RAD):
        return failed(
            NAME, f"the {body} moves, and the vehicle stands still",
            "it is another body's: correct positioning.body",
        )  # fmt: skip
    if not moves:
        return skipped(NAME, "it was not moved", HOW)
    if way_m > REACH_M:
        return failed(
            NAME, f"the {body} moved by {way_m:.0f} m: these look like millimetres",
            "set the unit of the capture's stream to metres",
        )  # fmt: skip
    return _turned(moved, own_rad, config)


def _turned(moved: Moved, own_rad: float, config: PositioningConfig) -> Row:
    body = f"rigid body {config.body!r}"
    turns = turns_of(moved)
    if turns is not None and turns.unexplained > STRANGER:
        return failed(
            NAME, f"the {body} does not turn as the vehicle does",
            "it is another body's, or its markers are too few or too symmetric to tell its turns",
        )  # fmt: skip
    risen = _rise(moved, None if turns is None else turns.up)
    if turns is not None and turns.up is not None:
        if wrong := _wrong_up(turns.up):
            return wrong
        if risen is not None and risen[2] < 0.0 and abs(risen[2]) == max(abs(risen)):
            return failed(
                NAME, "mirrored: lifted, the body goes down in the capture",
                "its axes are left-handed: calibrate its volume anew, with z up",
            )  # fmt: skip
    if risen is not None and nearest_axis(risen / np.linalg.norm(risen)) != "z":
        return _sideways(risen)
    if turns is None or turns.up is None or turns.R_body is None:
        return warned(
            NAME, f"turned by {math.degrees(own_rad):.0f} deg, about too few axes to tell all", HOW
        )
    return _body(turns.R_body, risen, config)


def _wrong_up(up: Array) -> Row | None:
    off_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(up[2])))))
    if off_deg <= UPRIGHT_DEG:
        return None
    axis = nearest_axis(up)
    if axis is None:
        x, y, z = (float(v) for v in up)
        return failed(
            NAME, f"the capture's world is tilted by {off_deg:.0f} deg: up is {x:.2f} {y:.2f} "
            f"{z:.2f}", "calibrate its volume anew, with z up",
        )  # fmt: skip
    return failed(
        NAME, f"swapped axes: up is {axis} in the motion capture",
        "set its world to z up, and define the rigid body anew with the vehicle level",
    )  # fmt: skip


def _sideways(risen: Array) -> Row:
    axis = nearest_axis(risen / np.linalg.norm(risen))
    along = f"along its {axis}" if axis else f"by x {risen[0]:.2f}, y {risen[1]:.2f} m"
    return failed(
        NAME, f"swapped axes: lifted, the body goes {along} in the motion capture",
        "set its world to z up; if you carried it aside, once more, straight up",
    )  # fmt: skip


def _body(R_body: Array, risen: Array | None, config: PositioningConfig) -> Row:
    """`R_body`: what is left of the body's turn, beyond the profile's."""
    off_deg = math.degrees(_angle_rad(R_body))
    if off_deg > BODY_WARN_DEG:
        profiled = rotation_from_rpy(*(math.radians(a) for a in config.body_rpy_deg))
        rpy = rpy_from_rotation(R_body @ profiled)
        wanted = ", ".join(f"{math.degrees(angle):.0f}" for angle in rpy)
        verdict = failed if off_deg > BODY_FAIL_DEG else warned
        return verdict(
            NAME, f"the rigid body's axes are turned by {off_deg:.0f} deg against the vehicle's",
            f"set positioning.body_rpy_deg: [{wanted}], or define the body anew with the vehicle "
            f"along x",
        )  # fmt: skip
    found = f"turns as the vehicle does, within {off_deg:.0f} deg"
    if risen is None:
        return warned(NAME, f"{found}; it was not lifted", HOW)
    return passed(NAME, f"{found}; rose by {risen[2]:.2f} m")


def turns_of(moved: Moved) -> Turns | None:
    """A and B by all pairs of moments between which it was turned; None of no such pair."""
    i, j = np.triu_indices(len(moved.own), 1)
    world_own = _rotation_vectors(moved.own[j] @ moved.own[i].transpose(0, 2, 1))
    size = np.linalg.norm(world_own, axis=1)
    kept = (size >= LEAST_STEP_RAD) & (size <= MOST_STEP_RAD)
    if kept.sum() < 3:
        return None
    i, j, world_own, size = i[kept], j[kept], world_own[kept], size[kept]
    world_seen = _rotation_vectors(moved.seen[j] @ moved.seen[i].transpose(0, 2, 1))
    body_own = _rotation_vectors(moved.own[i].transpose(0, 2, 1) @ moved.own[j])
    body_seen = _rotation_vectors(moved.seen[i].transpose(0, 2, 1) @ moved.seen[j])
    A, many, axis = _rotation_between(world_own, world_seen)
    B_T, many_body, _ = _rotation_between(body_own, body_seen)
    left = np.linalg.norm(world_seen - world_own @ A.T, axis=1)
    unexplained = float(np.mean(left / size))
    about_z = abs(float(axis[2])) > math.cos(math.radians(UPRIGHT_DEG))
    up = A[:, 2] if many else A @ axis * math.copysign(1.0, axis[2]) if about_z else None
    return Turns(up, B_T.T if many_body else None, unexplained)


def _rotation_between(before: Array, after: Array) -> tuple[Array, bool, Array]:
    """The rotation that takes (n, 3) to (n, 3), whether the vectors span more than one axis,
    and the axis that they have most of."""
    u, _, vt = np.linalg.svd(after.T @ before)
    sign = np.sign(np.linalg.det(u @ vt))
    axis = np.linalg.eigh(before.T @ before)[1][:, 2]  # the largest comes last
    aside_rad = np.linalg.norm(before - np.outer(before @ axis, axis), axis=1)
    many = bool(np.quantile(aside_rad, MANY_SHARE) > LEAST_STEP_RAD)
    return u @ np.diag([1.0, 1.0, sign]) @ vt, many, axis


def _rise(moved: Moved, up: Array | None) -> Array | None:
    """The place at its farthest, (3,) from the first; where the vertical is known, at its
    farthest along that. None where it was not lifted."""
    ways = moved.place_m - moved.place_m[0]
    along = np.linalg.norm(ways, axis=1) if up is None else np.abs(ways @ up)
    far = ways[int(np.argmax(along))]
    if float(np.linalg.norm(far)) < LIFTED_M:
        far = ways[int(np.argmax(np.linalg.norm(ways, axis=1)))]
    return far if float(np.linalg.norm(far)) >= LIFTED_M else None


def _largest_rad(attitudes: Array) -> float:
    """The largest turn from the first."""
    return max(_angle_rad(attitudes[0].T @ R) for R in attitudes)


def _angle_rad(R: Array) -> float:
    return math.acos(max(-1.0, min(1.0, (float(np.trace(R)) - 1.0) / 2.0)))


def _rotation_vectors(R: Array) -> Array:
    """Axes times angles (rad), (n, 3), of (n, 3, 3); below 180 deg."""
    half_trace = np.clip((np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)
    angle = np.arccos(half_trace)
    axis = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    sine = np.maximum(np.sin(angle), 1e-9)
    return np.asarray(axis * (angle / (2.0 * sine))[:, None])
