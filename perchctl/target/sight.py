"""Compute which part of the ceiling a camera sees, from the ground and when the gear is close.

The vehicle is assumed to be level, on the ground as well as in flight. Directions are the
vehicle's: forward and left.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import R_MARKER_TARGET, Array, rot_z
from perchctl.profile import Mounting, Profile, TargetConfig
from perchctl.vision import (
    CameraModel,
    can_fit_truncated_target,
    square_corners,
    undistort_to_normalised,
)

ARUCO_MARGIN_PX = 3.0
"""cv2.aruco drops markers that are closer than this to the image border."""
NEAREST_M, FARTHEST_M = 1e-3, 50.0
_EDGE_POINTS = 200


class FieldOfView:
    """The edges of the image, as the tangent of the angle from the camera's axis in each
    direction."""

    def __init__(self, camera: CameraModel, margin_px: float = ARUCO_MARGIN_PX) -> None:
        low = margin_px - 0.5
        right, bottom = (size - 0.5 - margin_px for size in camera.size_px)
        corners = np.array([[low, low], [right, low], [right, bottom], [low, bottom]])
        s = np.linspace(0.0, 1.0, _EDGE_POINTS, endpoint=False)[:, None]
        ways = zip(corners, np.roll(corners, -1, axis=0), strict=True)
        rays = undistort_to_normalised(np.concatenate([a + s * (b - a) for a, b in ways]), camera)
        rays = rays[np.isfinite(rays).all(axis=1)]
        angle = np.arctan2(rays[:, 1], rays[:, 0])
        order = np.argsort(angle)
        self._angle = angle[order]
        self._reach = np.hypot(*rays.T)[order]

    def contains(self, points_cam_m: Array) -> bool:
        """True if all points (n, 3) of the camera frame are in the image."""
        x, y, z = points_cam_m.T
        if (z <= 0.0).any():
            return False
        reach = np.interp(np.arctan2(y, x), self._angle, self._reach, period=2.0 * math.pi)
        return bool((np.hypot(x, y) <= reach * z).all())

    def nearest_m(self, outline_m: Array, R: Array, offset_m: Array) -> float | None:
        """The distance d beyond which ``R (x, y, d) + offset`` is in the image for all points (x,
        y) of `outline_m` (n, 2); None if there is no such distance."""

        def seen(d: float) -> bool:
            return self.contains(outline_points_3d(outline_m, d) @ R.T + offset_m)

        low, high = NEAREST_M, FARTHEST_M
        if not seen(high):
            return None
        if seen(low):
            return low
        while high / low > 1.0005:
            middle = math.sqrt(low * high)
            low, high = (low, middle) if seen(middle) else (middle, high)
        return high


def square_outline(side_m: float) -> Array:
    """Return points (n, 2) along the sides of a square centred at 0."""
    s = np.linspace(-0.5, 0.5, 21) * side_m
    h = np.full_like(s, side_m / 2.0)
    return np.concatenate([np.column_stack(pair) for pair in ((s, h), (s, -h), (h, s), (-h, s))])


def circle_outline(side_m: float) -> Array:
    """Return points (n, 2) of the circle through the corners of a square with the side `side_m`."""
    a = np.linspace(0.0, 2.0 * math.pi, 180, endpoint=False)
    return np.asarray(side_m / math.sqrt(2.0) * np.column_stack([np.cos(a), np.sin(a)]))


def outline_points_3d(outline_m: Array, z_m: float) -> Array:
    """The points (x, y, `z_m`), (n, 3), of an outline (n, 2)."""
    return np.column_stack([outline_m, np.full(len(outline_m), z_m)])


# --- From the ground: a target that is the positioning system must be in view ---


SURE_PX = 18.0
"""Side of a marker that the search finds reliably, px: it finds markers of 15 px in all rendered
images, and a fifth is added as a margin."""
BLURRED = 1.15
"""Factor applied to the smallest side that a plain search can read despite a measured blur."""
STRAIGHT_DEG = 2.0
"""Tilt of the camera's axis below which no tilt is reported, deg."""
LEAST_UP = 0.2
"""Smallest vertical component of the viewing direction: a camera that looks farther to the side
cannot see a target above it."""


def reliable_side_px(detected_px: float | None = None) -> float:
    """The smallest side, px, of a large marker that the search on the ground reliably finds.

    `detected_px`: the smallest side detected through the camera's blur; None if not measured."""
    return SURE_PX if detected_px is None else max(SURE_PX, BLURRED * detected_px)


def overhead_text(target: TargetConfig, camera: CameraModel, mount: Mounting) -> str:
    """Return in words where a camera on the ground reliably finds the large marker: up to which
    height, and how far from the camera's axis at some heights."""
    side_m = target.large.side_m
    view = mount.T_body_cam[:3, 2]
    highest_m = float(math.sqrt(camera.K[0, 0] * camera.K[1, 1])) * side_m / reliable_side_px()
    lean = math.degrees(math.atan2(view[0], view[2])), math.degrees(math.atan2(view[1], view[2]))
    axis = _directions(lean, STRAIGHT_DEG, ".0f", "deg")
    axis = f"leans {axis}" if axis else "points straight up"
    heights_m = sorted({min(h, highest_m) for h in (1.0, 2.0)})
    reaches = [(h, overhead_reach_m(side_m, camera, mount, h)) for h in heights_m]
    within = [f"{r:.2g} m (at {h:.2g} m above it)" for h, r in reaches if r is not None]
    if not within:
        only = "the large marker is visible only to a camera that looks up"
        return f"{only}; the axis of this one {axis}"
    return (
        f"the large marker is found at most {highest_m:.1f} m above the camera, with its centre "
        f"within {', '.join(within)} of the camera's axis, which {axis}"
    )


def overhead_reach_m(
    side_m: float, camera: CameraModel, mount: Mounting, height_m: float
) -> float | None:
    """Return the largest distance from the camera's axis at which a marker with the side `side_m`,
    `height_m` above the camera, is wholly in the image in any rotation; None if it is not wholly
    in the image even on the axis, or if the camera does not look up."""
    R = mount.T_body_cam[:3, :3]
    view, field = R[:, 2], FieldOfView(camera)
    if view[2] < LEAST_UP:
        return None
    axis = height_m / view[2] * view

    def seen(radius_m: float) -> bool:
        around = circle_outline(math.sqrt(2.0) * radius_m + side_m)
        return field.contains((outline_points_3d(around, 0.0) + axis) @ R)

    if not seen(0.0):
        return None
    low_m, high_m = 0.0, 10.0 * height_m
    while high_m - low_m > 1e-3:
        middle_m = (low_m + high_m) / 2.0
        low_m, high_m = (middle_m, high_m) if seen(middle_m) else (low_m, middle_m)
    return low_m


@dataclass(frozen=True)
class TargetView:
    """A target's position in the view of a level vehicle.

    Attributes:
        has_marker: True if a marker is whole in the image, and large enough.
        height_m: height above the camera.
        aside_m: offset from the camera's axis, forward and left; NaN unless the axis points up.
        reach_m: largest distance from the axis at which the large marker is wholly in the
            image in any rotation; None if it is not wholly in the image even on the axis.
    """

    has_marker: bool
    height_m: float
    aside_m: tuple[float, float]
    reach_m: float | None

    @property
    def aside_text(self) -> str:
        """`aside_m` in words: ``0.31 m forward and 0.12 m to the right``."""
        return _directions(self.aside_m, 0.01, ".2f", "m") or "less than 1 cm"


def view_from(
    body_m: Array,
    body_yaw_rad: float,
    target_m: Array,
    target_yaw_rad: float,
    target: TargetConfig,
    camera: CameraModel,
    mount: Mounting,
) -> TargetView:
    """Return how a level vehicle sees a level target; positions (3,) in one world, z up."""
    T = mount.T_body_cam
    field = FieldOfView(camera)
    R, camera_m = T[:3, :3], T[:3, 3]
    centre = rot_z(body_yaw_rad).T @ (target_m - body_m) - camera_m
    height_m = float(centre[2])
    turn = rot_z(target_yaw_rad - body_yaw_rad)
    large, small = (
        field.contains((square_corners(side_m) @ turn.T + centre) @ R)
        for side_m in (target.large.side_m, target.small.side_m)
    )
    # For the small marker, only the size is checked.
    readable = float(camera.K[0, 0]) * target.small.side_m >= SURE_PX * height_m
    view = R[:, 2]
    aside = centre - height_m / view[2] * view if view[2] >= LEAST_UP else np.full(3, math.nan)
    reach_m = None
    if height_m > 0.0:
        reach_m = overhead_reach_m(target.large.side_m, camera, mount, height_m)
    aside_m = (float(aside[0]), float(aside[1]))
    return TargetView(large or (small and readable), height_m, aside_m, reach_m)


def _directions(values: tuple[float, float], least: float, figures: str, unit: str) -> str:
    names = (("forward", "back"), ("to the left", "to the right"))
    return " and ".join(
        f"{abs(value):{figures}} {unit} {ahead if value > 0.0 else behind}"
        for value, (ahead, behind) in zip(values, names, strict=True)
        if abs(value) >= least
    )


# --- Near the target: the range below which the camera cannot see it ---
# Assumes an ascent: the gear is under the target's centre, the vehicle is level, and its heading is
# that of the target, so the outline of the markers is aligned with the body axes.


FROM_M = 0.10
"""Distance from gear to target below which the view is checked, m."""
_STEP_M = 0.0005


@dataclass(frozen=True)
class BlindRange:
    """Ranges from gear tip to target, m, below which the target is no longer measured: `whole_m` if
    only whole markers are measured, `left_m` if visible parts are measured as well. 0 means that
    the target is measured down to contact, and None that it is not measured at all in the last 10
    cm."""

    whole_m: float | None
    left_m: float | None

    @property
    def text(self) -> str:
        """Both ranges in words."""
        left, whole = (_blind_words(range_m) for range_m in (self.left_m, self.whole_m))
        return f"{left} (with whole markers only: {whole}), with the gear under the target's centre"


def _blind_words(nearest_m: float | None) -> str:
    if nearest_m is None:
        return f"blind throughout the last {1e2 * FROM_M:g} cm"
    return "never blind" if nearest_m == 0.0 else f"blind from {1e3 * nearest_m:.0f} mm to contact"


def blind_range(target: TargetConfig, camera: CameraModel, profile: Profile) -> BlindRange:
    """The blind range of a level target directly above the gear, for the profile's mounting."""
    R, offset = camera_rotation_and_gear(profile)
    view = FieldOfView(camera)
    outlines = [square_outline(marker.side_m) for marker in (target.large, target.small)]

    def whole(range_m: float) -> bool:
        return any(
            view.contains(outline_points_3d(each, range_m) @ R.T + offset) for each in outlines
        )

    def left(range_m: float) -> bool:
        centre = R @ np.array([0.0, 0.0, range_m]) + offset
        return whole(range_m) or can_fit_truncated_target(
            R @ R_MARKER_TARGET, centre, target, camera
        )

    return BlindRange(_lost_at_m(whole), _lost_at_m(left))


def _lost_at_m(seen: Callable[[float], bool]) -> float | None:
    count = round(FROM_M / _STEP_M)
    lost = next((k for k in range(count, 0, -1) if not seen(k * _STEP_M)), 0)
    if lost == count:
        return None
    return 0.0 if lost == 0 else (lost + 1) * _STEP_M


def sees_small_marker(camera: CameraModel, profile: Profile, range_m: float) -> bool:
    """True if the whole small marker is in the image with the gear `range_m` below it."""
    R, gear = camera_rotation_and_gear(profile)
    outline = outline_points_3d(square_outline(profile.target.small.side_m), range_m)
    return FieldOfView(camera).contains(outline @ R.T + gear)


def camera_rotation_and_gear(profile: Profile) -> tuple[Array, Array]:
    """The rotation (3, 3) from body to camera axes, and the gear's tip (3,) in them, m."""
    T_body_cam = profile.camera.mount.T_body_cam
    R = T_body_cam[:3, :3].T
    return R, R @ (np.asarray(profile.vehicle.gear_body_m) - T_body_cam[:3, 3])
