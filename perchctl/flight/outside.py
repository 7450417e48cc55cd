"""What is asked of positions from outside before a flight, by `fly` and by `check`. Pure.

Of a vehicle at rest two things are known without any capture: where the ground is, and which way
is up. A world with another axis up, or a body whose axes are turned, shows against the second as
soon as the vehicle stands in another heading than the one in which its body was defined; a height
in millimetres against the first. What a vehicle at rest cannot tell is told by a hand that lifts
and turns it (`perchctl check --lift`), or by its first centimetres in the air
(`perchctl.mission.guards.is_astray`).
"""

from __future__ import annotations

import math

import numpy as np

from perchctl.flight.criteria import Problem
from perchctl.geometry import (
    Array,
    rotation_from_quaternion,
    rotation_from_rpy,
    wrap_rad,
    yaw_of,
)
from perchctl.positioning import FeedStatus
from perchctl.profile import Profile
from perchctl.vehicle import ExternalPosition, Telemetry

ROOM_M = 50.0
"""No capture is larger: what is farther off is told in another unit."""
HIGH_M = 4.0
"""Of a vehicle that stands where it takes off: higher it is told in another unit."""
UPRIGHT_DEG = 20.0
"""What attitude and capture may differ by: the attitude of a rigid body is defined by eye."""
AXIS_DEG = 30.0
"""Within it of an axis, up is that axis."""
WANDERED_M = 0.1
"""Far beyond a capture's noise."""
AGREE_M, AGREE_DEG = 0.1, 15.0
"""Estimate and capture, once positions are fused and the heading was set by them."""


def measurer(profile: Profile) -> str:
    """What the positions come from."""
    by_sight = profile.positioning.by == "target"
    return "the sight of the target" if by_sight else "the motion capture"


def world_problem(
    place: ExternalPosition, telemetry: Telemetry, profile: Profile
) -> Problem | None:
    """What waiting will not mend: another unit, another axis up, another place. The world that
    the target measures in is the vehicle's own, from where it stands: there is no other."""
    if profile.positioning.by == "target":
        return unreachable(place, profile)
    return (
        millimetres_problem(place, profile)
        or with_another_up(place, telemetry)
        or external_height_problem(place, profile)
        or unreachable(place, profile)
    )


def unreachable(place: ExternalPosition, profile: Profile) -> Problem | None:
    """Where the target is told to be, no flight from there comes: another vehicle's body stands
    there, perhaps, which looks right in all else."""
    target, (x, y, _) = profile.target, place.position_m
    if target.expected_xy_m is None:
        return None
    away_m = math.dist((x, y), target.expected_xy_m)
    if not away_m > profile.safety.fence_radius_m + target.expected_within_m:
        return None
    if profile.positioning.by == "target":
        return Problem(
            f"the target is expected {away_m:.1f} m from where the vehicle stands, and the fence "
            f"is {profile.safety.fence_radius_m:g} m",
            "with positioning: target the world's zero is where it stands: correct "
            "target.expected_xy_m",
        )
    return Problem(
        f"the motion capture has the vehicle at x {x:.2f}, y {y:.2f} m, {away_m:.1f} m from where "
        f"its target is expected, and the fence is {profile.safety.fence_radius_m:g} m",
        f"is the rigid body {profile.positioning.body!r} another vehicle's? correct "
        f"positioning.body, or target.expected_xy_m",
    )


def millimetres_problem(place: ExternalPosition, profile: Profile) -> Problem | None:
    """The external position seems to be in millimetres: off by a factor of a thousand."""
    safety, (x, y, z) = profile.safety, place.position_m
    far_m = max(abs(v) for v in place.position_m)
    on_ground = abs(z / 1000.0 - safety.ground_z_m) <= safety.ground_tolerance_m
    if not far_m >= ROOM_M and not (z >= HIGH_M and on_ground):
        return None
    return Problem(
        f"the motion capture has the vehicle at x {x:.0f}, y {y:.0f}, z {z:.0f} m: these look "
        f"like millimetres",
        "set the unit of its stream to metres",
    )


def with_another_up(place: ExternalPosition, telemetry: Telemetry) -> Problem | None:
    """By the vehicle's own attitude, which knows gravity."""
    if place.quaternion is None:
        return None
    up = up_in_capture(place.quaternion, telemetry)
    off_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(up[2])))))
    if not off_deg > UPRIGHT_DEG:
        return None
    axis = nearest_axis(up)
    if axis is None:
        return Problem(
            f"the motion capture has the vehicle tilted by {off_deg:.0f} deg against its own "
            f"attitude",
            "is it the right rigid body? set its axes level in the capture, or "
            "positioning.body_rpy_deg; perchctl check --lift tells by how much",
        )
    return Problem(
        f"swapped axes: up is {axis} in the motion capture",
        "set its world to z up; if only the rigid body's own axes lie so, define them anew "
        "with the vehicle level, or set positioning.body_rpy_deg",
    )


def up_in_capture(quaternion: tuple[float, float, float, float], telemetry: Telemetry) -> Array:
    """The world's vertical as the capture has it, if its body's axes are the vehicle's: (3,)."""
    R_own = rotation_from_rpy(telemetry.roll_rad, telemetry.pitch_rad, telemetry.yaw_rad)
    return np.asarray(rotation_from_quaternion(quaternion) @ R_own.T[:, 2])


def nearest_axis(direction: Array) -> str | None:
    """The axis that lies within `AXIS_DEG` of a unit vector, such as ``-y``; None where none."""
    i = int(np.argmax(np.abs(direction)))
    if abs(float(direction[i])) < math.cos(math.radians(AXIS_DEG)):
        return None
    return f"{'-' if direction[i] < 0 else ''}{'xyz'[i]}"


def external_height_problem(place: ExternalPosition, profile: Profile) -> Problem | None:
    """Elsewhere than where it takes off."""
    safety, z_m = profile.safety, place.position_m[2]
    if abs(z_m - safety.ground_z_m) <= safety.ground_tolerance_m:
        return None
    found = (
        f"the motion capture has the vehicle at {z_m:.2f} m, and the ground is at "
        f"{safety.ground_z_m:.2f} m"
    )
    level = [
        axis
        for axis, v in zip("xy", place.position_m[:2], strict=True)
        if abs(v - safety.ground_z_m) <= safety.ground_tolerance_m
    ]
    perhaps = f"swapped axes (is its {' or its '.join(level)} up?)" if level else "swapped axes"
    return Problem(
        found,
        f"{perhaps}, another rigid body or zero: perchctl check --lift tells; "
        f"safety.ground_z_m is the height that it has where it stands",
    )


class AtRest:
    """A body that goes about in the capture while the vehicle stands still is another's."""

    def __init__(self) -> None:
        self._from: ExternalPosition | None = None

    def strange(self, place: ExternalPosition | None, profile: Profile) -> Problem | None:
        """Asked in each turn of which fresh telemetry and a fresh position tell; `place` None
        where the vehicle does not stand still: then it begins anew."""
        self._from = None if place is None else self._from or place
        if place is None or self._from is None:
            return None
        way_m = math.dist(self._from.position_m, place.position_m)
        if not way_m > WANDERED_M:
            return None
        if profile.positioning.by == "target":
            return Problem(
                f"by the target the vehicle has moved by {way_m:.2f} m, and it stands still",
                "the target has moved: let it hang still, then start anew",
            )
        body = profile.positioning.body
        return Problem(
            f"the rigid body {body!r} has moved by {way_m:.2f} m in the motion capture, and the "
            f"vehicle stands still",
            "it is another body's: correct positioning.body; if somebody carried it, put it down",
        )


def missing(status: FeedStatus, profile: Profile) -> Problem | None:
    """None while fresh positions are sent."""
    if status.problem is not None:
        return Problem(status.problem, "see perchctl check")
    if status.age_s <= profile.positioning.hold_s:
        return None
    age = f"{status.age_s:.2f} s old" if math.isfinite(status.age_s) else "none was sent yet"
    return Problem(age, "see perchctl check")


def apart(place: ExternalPosition, telemetry: Telemetry) -> Problem | None:
    """The vehicle's estimate is not where the capture has it, or has another heading."""
    away_m = math.dist(place.position_m, telemetry.position_m)
    turned_deg = 0.0
    if place.quaternion is not None:
        yaw_rad = yaw_of(rotation_from_quaternion(place.quaternion))
        turned_deg = abs(math.degrees(wrap_rad(telemetry.yaw_rad - yaw_rad)))
    if away_m <= AGREE_M and turned_deg <= AGREE_DEG:
        return None
    return Problem(
        f"they are {away_m:.2f} m and {turned_deg:.0f} deg of heading apart",
        "do the positions arrive at this vehicle, and is it this rigid body?",
    )
