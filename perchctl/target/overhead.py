"""From where on the ground a target over it is seen by a camera that looks up: it has to be where
it is the vehicle's positioning system.

The vehicle stands level. Directions are the vehicle's: forward and left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array, rot_z
from perchctl.profile import Mounting, TargetConfig
from perchctl.target.lengths import mm_text
from perchctl.target.visible import FieldOfView, turned_outline
from perchctl.vision import CameraModel, square_corners

SURE_PX = 18.0
"""A search finds sides of 13 px in 7 of 8 pictures, those of 15 px and more in all, at a blur of
0.6 px and noise of 4 to 8, by rendered pictures at any turn: with a fifth to spare."""
BLURRED = 1.15
"""Times the least side that a plain search reads through a measured blur."""
STRAIGHT_DEG = 2.0
"""No eye sees such a lean."""
LEAST_UP = 0.2
"""Of the view's upward part: a camera that looks farther aside sees no target over it."""


@dataclass(frozen=True)
class Reach:
    """What is seen of one height above the camera: the large marker at any turn whose centre is
    within `radius_m` of where the camera's axis goes, `axis_xy_m` from the camera."""

    height_m: float
    axis_xy_m: tuple[float, float]
    radius_m: float


@dataclass(frozen=True)
class Overhead:
    """`highest_m` above the camera; of the heights in `reaches`."""

    side_m: float
    highest_m: float
    lean_deg: tuple[float, float]
    """Of the camera's axis: forward, left; NaN for one that does not look up."""
    reaches: tuple[Reach, ...]

    @property
    def words(self) -> str:
        """Where the target has to be, for people."""
        if not self.reaches:
            return f"in the picture of a camera that looks up, not {_lean(self.lean_deg)}"
        within = ", ".join(
            f"{r.radius_m:.2g} m at {r.height_m:.2g} m above it" for r in self.reaches
        )
        return (
            f"at most {self.highest_m:.1f} m above the camera, and its centre no farther from the "
            f"camera's axis than {within}; the axis {_lean(self.lean_deg)}"
        )


def least_side_px(plain_px: float | None = None) -> float:
    """The side from which on the ground's search finds the large marker surely. `plain_px`: what a
    plain one reads through the camera's own blur, where that was measured."""
    return SURE_PX if plain_px is None else max(SURE_PX, BLURRED * plain_px)


def overhead_view(
    target: TargetConfig, camera: CameraModel, mount: Mounting, plain_px: float | None = None
) -> Overhead:
    """Of the large marker."""
    side_m, view = target.large.side_m, mount.T_body_cam[:3, 2]
    highest_m = float(math.sqrt(camera.K[0, 0] * camera.K[1, 1])) * side_m / least_side_px(plain_px)
    lean = math.degrees(math.atan2(view[0], view[2])), math.degrees(math.atan2(view[1], view[2]))
    if view[2] < LEAST_UP:
        return Overhead(side_m, highest_m, lean, ())
    field = FieldOfView(camera)
    heights_m = sorted({min(h, highest_m) for h in (1.0, 2.0)})
    reaches = (reach_at(side_m, field, mount, h) for h in heights_m)
    return Overhead(side_m, highest_m, lean, tuple(r for r in reaches if r is not None))


def reach_at(side_m: float, field: FieldOfView, mount: Mounting, height_m: float) -> Reach | None:
    """None where not even a marker on the camera's axis is wholly in the picture, or the camera
    does not look up."""
    R = mount.T_body_cam[:3, :3]
    view = R[:, 2]
    if view[2] < LEAST_UP:
        return None
    axis = height_m / view[2] * view

    def seen(radius_m: float) -> bool:
        around = turned_outline(math.sqrt(2.0) * radius_m + side_m)
        level = np.column_stack([around, np.zeros(len(around))])
        return field.holds((level + axis) @ R)

    if not seen(0.0):
        return None
    low_m, high_m = 0.0, 10.0 * height_m
    while high_m - low_m > 1e-3:
        middle_m = (low_m + high_m) / 2.0
        low_m, high_m = (middle_m, high_m) if seen(middle_m) else (low_m, middle_m)
    return Reach(height_m, (float(axis[0]), float(axis[1])), low_m)


@dataclass(frozen=True)
class TargetFromBody:
    """A target as a level body at some place has it.

    Attributes:
        whole: whether one of its markers is wholly in the picture.
        height_m: above the camera.
        aside_m: from the camera's axis, forward and left; NaN for a camera that does not look up.
    """

    whole: bool
    height_m: float
    aside_m: tuple[float, float]


def sight_from(
    body_m: Array,
    body_yaw_rad: float,
    target_m: Array,
    target_yaw_rad: float,
    target: TargetConfig,
    camera: CameraModel,
    mount: Mounting,
) -> TargetFromBody:
    """Positions (3,) and headings in one world, z up; the body level, the target too."""
    T, field = mount.T_body_cam, FieldOfView(camera)
    R, camera_m = T[:3, :3], T[:3, 3]
    centre = rot_z(body_yaw_rad).T @ (target_m - body_m) - camera_m
    turn = rot_z(target_yaw_rad - body_yaw_rad)
    large, small = (
        (square_corners(side_m) @ turn.T + centre) @ R
        for side_m in (target.large.side_m, target.small.side_m)
    )
    view = R[:, 2]
    aside = centre - centre[2] / view[2] * view if view[2] >= LEAST_UP else np.full(3, math.nan)
    return TargetFromBody(
        whole=field.holds(large) or (field.holds(small) and _is_readable(target, camera, centre)),
        height_m=float(centre[2]),
        aside_m=(float(aside[0]), float(aside[1])),
    )


def _is_readable(target: TargetConfig, camera: CameraModel, centre: Array) -> bool:
    """The small marker by its size alone."""
    return float(camera.K[0, 0]) * target.small.side_m >= SURE_PX * float(centre[2])


def edge_margin(points_px: Array, size_px: tuple[int, int]) -> float:
    """The least way of points (n, 2) px to the picture's edge, a share of its larger side."""
    size = np.array(size_px, dtype=np.float64)
    least_px = np.minimum(points_px + 0.5, size - 0.5 - points_px).min()
    return float(least_px) / max(size_px)


def offset_text(aside_m: tuple[float, float]) -> str:
    """``0.31 m forward and 0.12 m to the right``."""
    forward_m, left_m = aside_m
    parts = [
        f"{abs(way_m):.2f} m {names[0] if way_m > 0.0 else names[1]}"
        for way_m, names in (
            (forward_m, ("forward", "back")),
            (left_m, ("to the left", "to the right")),
        )
        if abs(way_m) >= 0.01
    ]
    return " and ".join(parts) or "less than 1 cm"


def _lean(lean_deg: tuple[float, float]) -> str:
    parts = [
        f"{abs(deg):.0f} deg {names[0] if deg > 0.0 else names[1]}"
        for deg, names in (
            (lean_deg[0], ("forward", "back")),
            (lean_deg[1], ("to the left", "to the right")),
        )
        if abs(deg) >= STRAIGHT_DEG
    ]
    return f"leans {' and '.join(parts)}" if parts else "points straight up"


def marker_words(target: TargetConfig) -> str:
    """``the target's large marker of 150 mm``."""
    return f"the target's large marker of {mm_text(target.large.side_m)} mm"
