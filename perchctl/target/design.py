"""What a target will do with a camera: from where to where each marker is seen, and how
exactly.

z1 and z2 are the farthest ranges of the large and the small marker, z3 the nearest of the
whole large one (paper, section III-B: 115, 25, 12 cm). They follow from the smallest side
that is read through the blur, and from the picture's edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.profile import Profile, TargetConfig
from perchctl.target.blind import Mounted, mounted_camera
from perchctl.target.drawing import marker_corners_m
from perchctl.target.limits import TRIALS, Optics, smallest_side_px
from perchctl.target.overhead import least_side_px
from perchctl.target.visible import FieldOfView, square_outline, turned_outline
from perchctl.vision import CameraModel

CORNER_SIGMA_PX = 0.2
"""Spread of a corner that the error bound is drawn for: a plainly refined one."""
CURVE_POINTS = 160
PAPER_CM = {"z1": 115.0, "z2": 25.0, "z3": 12.0}
PAPER_FOCAL_PX, PAPER_SIZE_PX = 380.0, (640, 480)


@dataclass(frozen=True)
class Ranges:
    """Ranges from the camera's centre to a target on its axis, straight on, m; None where
    the marker is never read.

    Attributes:
        z1_m, z2_m: farthest of the large and of the small marker, at any turn.
        z3_m: nearest of the whole large marker, at any turn; z3_upright_m where its sides
            are parallel to the picture's.
        z4_m: nearest of the whole small marker, at any turn.
        large_px, small_px: the smallest sides that are read.
    """

    z1_m: float | None
    z2_m: float | None
    z3_m: float | None
    z3_upright_m: float | None
    z4_m: float | None
    large_px: float | None
    small_px: float | None
    focal_px: float


@dataclass(frozen=True)
class GearRanges:
    """The same while the gear is right under the target, so that the target lies beside
    the camera's axis; ranges from the gear's tip to the target, at any turn, m."""

    large_nearest_m: float | None
    small_nearest_m: float | None


@dataclass(frozen=True)
class TargetDesign:
    target: TargetConfig
    camera: CameraModel
    optics: Optics
    ranges: Ranges
    gear: GearRanges
    mount: Mounted
    standoff_m: float
    search_range_m: float | None  # camera to target at the highest search position
    search_height_m: float
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """The bound over the range: `z_m` (n,), and x, z (m) and yaw (rad) for each of
    ``large``, ``small`` and ``both``, NaN where that is not seen."""

    z_m: Array
    bounds: dict[str, Array]  # (n, 3)


def focal_px(camera: CameraModel) -> float:
    return math.sqrt(float(camera.K[0, 0] * camera.K[1, 1]))


def design_ranges(
    target: TargetConfig, camera: CameraModel, optics: Optics, trials: int = TRIALS
) -> Ranges:
    """By trial through the detector (far) and by geometry (near)."""
    f = focal_px(camera)
    picture_px = max(camera.size_px)
    large_px = smallest_side_px(target, "large", optics, picture_px, trials)
    small_px = smallest_side_px(target, "small", optics, picture_px, trials)
    return _ranges(target, FieldOfView(camera), f, large_px, small_px)


def _ranges(
    target: TargetConfig,
    view: FieldOfView,
    f: float,
    large_px: float | None,
    small_px: float | None,
) -> Ranges:
    large, small = target.large.side_m, target.small.side_m
    ahead = (np.eye(3), np.zeros(3))
    return Ranges(
        z1_m=None if large_px is None else f * large / large_px,
        z2_m=None if small_px is None else f * small / small_px,
        z3_m=view.nearest_m(turned_outline(large), *ahead),
        z3_upright_m=view.nearest_m(square_outline(large), *ahead),
        z4_m=view.nearest_m(turned_outline(small), *ahead),
        large_px=large_px,
        small_px=small_px,
        focal_px=f,
    )


def gear_ranges(target: TargetConfig, camera: CameraModel, profile: Profile) -> GearRanges:
    """With the camera mounted as in the profile, the vehicle level."""
    T_body_cam = profile.camera.mount.T_body_cam
    R_cam_body = T_body_cam[:3, :3].T
    gear_cam = R_cam_body @ (np.asarray(profile.vehicle.gear_body_m) - T_body_cam[:3, 3])
    view = FieldOfView(camera)
    return GearRanges(
        view.nearest_m(turned_outline(target.large.side_m), R_cam_body, gear_cam),
        view.nearest_m(turned_outline(target.small.side_m), R_cam_body, gear_cam),
    )


def is_seen_from_ground(profile: Profile) -> bool:
    """It has to be where the target is the positioning system."""
    return profile.positioning.by == "target"


def make_design(
    target: TargetConfig,
    camera: CameraModel,
    optics: Optics,
    profile: Profile,
    ceiling_m: float | None = None,
    ranges: Ranges | None = None,
) -> TargetDesign:
    """Ranges and what is wrong with them for a flight by that profile under a ceiling of
    that height over the floor (None: unknown)."""
    ranges = ranges or design_ranges(target, camera, optics)
    gear = gear_ranges(target, camera, profile)
    standoff = profile.planner.ascend.standoff_m
    height = 0.0 if is_seen_from_ground(profile) else profile.planner.search.max_height_m
    search = None
    if ceiling_m is not None:
        search = ceiling_m - height - profile.camera.mount.position_m[2]
    warnings = _warnings(target, ranges, gear, standoff, height, ceiling_m, search)
    return TargetDesign(
        target=target,
        camera=camera,
        optics=optics,
        ranges=ranges,
        gear=gear,
        mount=mounted_camera(target, camera, profile),
        standoff_m=standoff,
        search_range_m=search,
        search_height_m=height,
        warnings=tuple(warnings),
    )


def _warnings(
    target: TargetConfig,
    ranges: Ranges,
    gear: GearRanges,
    standoff_m: float,
    height_m: float,
    ceiling_m: float | None,
    search_m: float | None,
) -> list[str]:
    found: list[str] = []
    if ranges.z1_m is None or ranges.z2_m is None or ranges.z3_m is None:
        return ["a marker is never read through this blur and noise: a sharper picture is needed"]
    if search_m is not None and height_m == 0.0:
        sure_m = ranges.focal_px * target.large.side_m / least_side_px(ranges.large_px)
        if search_m > sure_m:
            found.append(
                f"gap on the ground: under a ceiling of {ceiling_m:g} m the target is "
                f"{search_m:.2f} m from the camera, and is surely found up to {sure_m:.2f} m"
            )
    elif search_m is not None and search_m > ranges.z1_m:
        found.append(
            f"gap at the search height: from {height_m:g} m the target under a ceiling of "
            f"{ceiling_m:g} m is {search_m:.2f} m away, and is seen from {ranges.z1_m:.2f} m on"
        )
    if search_m is not None and search_m < 0.3 and height_m > 0.0:
        found.append(
            f"the ceiling ({ceiling_m:g} m) is hardly above the search height ({height_m:g} m): "
            f"lower planner.search.max_height_m"
        )
    if ranges.z2_m <= ranges.z3_m:
        found.append(
            f"gap between the markers: the small one is read up to {cm_text(ranges.z2_m)} cm, and "
            f"the large one is whole at any turn only from {cm_text(ranges.z3_m)} cm on"
        )
    elif ranges.z2_m < 1.15 * ranges.z3_m:
        found.append("the overlap is short: less than 15 % of the range")
    if gear.small_nearest_m is None or gear.small_nearest_m > standoff_m:
        at = (
            ""
            if gear.small_nearest_m is None
            else f" (only from {cm_text(gear.small_nearest_m)} cm on)"
        )
        found.append(
            f"gap before contact: with the gear {cm_text(standoff_m)} cm under the target the "
            f"small marker is not wholly in the picture{at}; mount the camera nearer to the gear"
        )
    return found


def error_curve(design: TargetDesign, sigma_px: float = CORNER_SIGMA_PX) -> ErrorCurve:
    """The Cramer-Rao bound over the range from contact to z1."""
    r = design.ranges
    spans = {"large": (r.z3_m, r.z1_m), "small": (r.z4_m, r.z2_m)}
    ends = [v for span in spans.values() for v in span if v is not None]
    z = np.geomspace(min(ends, default=0.02), max(ends, default=2.0), CURVE_POINTS)
    sides = {"large": design.target.large.side_m, "small": design.target.small.side_m}
    bounds = {name: np.full((len(z), 3), np.nan) for name in ("large", "small", "both")}
    for i, z_m in enumerate(z):
        seen = [
            name
            for name, (near, far) in spans.items()
            if near is not None and far is not None and near * 0.9999 <= z_m <= far * 1.0001
        ]
        for name, used in (
            *((n, [n]) for n in seen),
            *([("both", seen)] if len(seen) == 2 else []),
        ):
            bounds[name][i] = _row(
                pose_bound([sides[n] for n in used], float(z_m), r.focal_px, sigma_px)
            )
    return ErrorCurve(z, bounds)


def _row(bound: PoseBound) -> tuple[float, float, float]:
    return bound.x_m, bound.z_m, bound.yaw_rad


def cm_text(length_m: float) -> str:
    """A length in centimetres, without its unit, for a sentence."""
    return f"{100.0 * length_m:.3g}"


# --- The least pose error that corners of a given spread allow (Cramer-Rao bound) --------------


@dataclass(frozen=True)
class PoseBound:
    """Standard deviations of the target's position in the camera frame and of its turn."""

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: float


def pose_bound(sides_m: list[float], z_m: float, focal_px: float, sigma_px: float) -> PoseBound:
    """The bound for centred, concentric markers of these sides, seen straight on from
    `z_m`, all corners solved together; every corner has `sigma_px` in x and in y.

    The pose has all six degrees of freedom. Perturbed by a turn w and a shift t, a corner
    X moves by w x X + t.
    """
    X = np.concatenate([marker_corners_m(side) for side in sides_m])
    X = X * (1.0, -1.0, -1.0)  # facing the camera
    x, y = X[:, 0], X[:, 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    dx = np.stack([zero, zero, -y, one, zero, zero], axis=1)
    dy = np.stack([zero, zero, x, zero, one, zero], axis=1)
    dz = np.stack([y, -x, zero, zero, zero, one], axis=1)
    du = focal_px * (dx / z_m - x[:, None] * dz / z_m**2)
    dv = focal_px * (dy / z_m - y[:, None] * dz / z_m**2)
    J: Array = np.concatenate([du, dv])
    covariance = np.linalg.inv(J.T @ J) * sigma_px**2
    sigma = np.sqrt(np.diag(covariance))
    return PoseBound(float(sigma[3]), float(sigma[4]), float(sigma[5]), float(sigma[2]))


def degrees(bound: PoseBound) -> float:
    return math.degrees(bound.yaw_rad)
