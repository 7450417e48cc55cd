"""What a target will do with a camera: from where to where each marker is seen, and how
exactly.

z1 and z2 are the farthest ranges of the large and the small marker, z3 the nearest of the
whole large one (paper, section III-B: 115, 25, 12 cm). They follow from the smallest side
that is read through the blur, and from the picture's edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from perchctl.geometry import Array
from perchctl.profile import Profile, TargetConfig
from perchctl.target.drawing import marker_corners_m, mm_text
from perchctl.target.reading import TRIALS, Optics, smallest_side_px
from perchctl.target.sight import (
    FieldOfView,
    Mounted,
    gear_from_camera,
    least_side_px,
    mounted_camera,
    square_outline,
    turned_outline,
)
from perchctl.vision import CameraModel

CORNER_SIGMA_PX = 0.2
"""Spread of a corner that the error bound is drawn for: a plainly refined one."""
CURVE_POINTS = 160
_TABLE_CM = (3, 5, 7, 10, 15, 20, 25, 30, 50, 75, 100, 150, 200, 300, 500)
_COMPARED_M = (1.0, 0.5, 0.2, 0.1)


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


@dataclass(frozen=True, eq=False)
class ErrorCurve:
    """The bound over the range: `z_m` (n,), and x, z (m) and yaw (rad) for each of
    ``large``, ``small`` and ``both``, NaN where that is not seen."""

    z_m: Array
    bounds: dict[str, Array]  # (n, 3)

    def best_at(self, z_m: float) -> tuple[int, str | None]:
        """The point nearest to that range, and what gives the least error there; None where
        nothing is whole and readable."""
        i = int(np.abs(self.z_m - z_m).argmin())
        names = (n for n in ("both", "large", "small") if math.isfinite(self.bounds[n][i, 0]))
        return i, next(names, None)


@dataclass(frozen=True)
class TargetDesign:
    """A target, a camera and a profile, and what follows from them.

    Attributes:
        search_range_m: from the camera to the target at the highest search position, where the
            ceiling's height is known.
        warnings: a sentence for each gap.
    """

    target: TargetConfig
    camera: CameraModel
    optics: Optics
    ranges: Ranges
    gear: GearRanges
    mount: Mounted
    standoff_m: float
    search_range_m: float | None
    search_height_m: float
    warnings: tuple[str, ...]

    @cached_property
    def curve(self) -> ErrorCurve:
        """The least pose error that the corners allow, from contact to z1."""
        return _error_curve(self.target, self.ranges)

    def record(self) -> dict[str, object]:
        """Ranges, gaps and blind range for machines; metres."""
        r = self.ranges
        return {
            "z1_m": r.z1_m,
            "z2_m": r.z2_m,
            "z3_m": r.z3_m,
            "z3_upright_m": r.z3_upright_m,
            "z4_m": r.z4_m,
            "large_px": r.large_px,
            "small_px": r.small_px,
            "gear_large_nearest_m": self.gear.large_nearest_m,
            "gear_small_nearest_m": self.gear.small_nearest_m,
            "blind": self.mount.record(),
            "search_range_m": self.search_range_m,
            "warnings": list(self.warnings),
        }

    def text(self, camera_name: str) -> str:
        """Ranges, overlap, error over the range, warnings; several lines."""
        return _text(self, camera_name)

    def compared_with(self, present: TargetDesign, name: str) -> list[str]:
        """A table of sizes, ranges and errors beside those of the present target, whose name is
        `name`."""
        pair = (self, present)
        rows: list[tuple[str, ...]] = [("", "proposed", name)]
        rows.append(("large marker, mm", *(mm_text(d.target.large.side_m) for d in pair)))
        rows.append(("small marker, mm", *(mm_text(d.target.small.side_m) for d in pair)))
        for key, what in (
            ("z1_m", "large one read up to, cm"),
            ("z2_m", "small one read up to, cm"),
            ("z3_m", "large one whole down to, cm"),
            ("z4_m", "small one whole down to, cm"),
        ):
            cells = (_cm(getattr(d.ranges, key)).removesuffix(" cm") for d in pair)
            rows.append((what, *cells))
        for z_m in _COMPARED_M:
            cells = (_height_error(d.curve, z_m) for d in pair)
            rows.append((f"least error in z at {100 * z_m:.0f} cm, mm", *cells))
        first, new, old = (max(len(row[i]) for row in rows) for i in range(3))
        return [f"   {row[0]:<{first}}  {row[1]:>{new}}  {row[2]:>{old}}" for row in rows]


def focal_px(camera: CameraModel) -> float:
    """The mean focal length."""
    return math.sqrt(float(camera.K[0, 0] * camera.K[1, 1]))


def design_ranges(
    target: TargetConfig, camera: CameraModel, optics: Optics, trials: int = TRIALS
) -> Ranges:
    """By trial through the detector (far) and by geometry (near)."""
    f, view, ahead = focal_px(camera), FieldOfView(camera), (np.eye(3), np.zeros(3))
    picture_px = max(camera.size_px)
    large_px = smallest_side_px(target, "large", optics, picture_px, trials)
    small_px = smallest_side_px(target, "small", optics, picture_px, trials)
    large, small = target.large.side_m, target.small.side_m
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
    trials: int = TRIALS,
) -> TargetDesign:
    """Ranges and what is wrong with them for a flight by that profile under a ceiling of
    that height over the floor (None: unknown). `trials` are the pictures of a side, where the
    ranges are not given."""
    ranges = ranges or design_ranges(target, camera, optics, trials)
    view, sides = FieldOfView(camera), (target.large.side_m, target.small.side_m)
    nearest = (view.nearest_m(turned_outline(s), *gear_from_camera(profile)) for s in sides)
    height = 0.0 if is_seen_from_ground(profile) else profile.planner.search.max_height_m
    search = None
    if ceiling_m is not None:
        search = ceiling_m - height - profile.camera.mount.position_m[2]
    gear, standoff = GearRanges(*nearest), profile.planner.ascend.standoff_m
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
            f"gap between the markers: the small one is read up to {_cm(ranges.z2_m)}, and "
            f"the large one is whole at any turn only from {_cm(ranges.z3_m)} on"
        )
    elif ranges.z2_m < 1.15 * ranges.z3_m:
        found.append("the overlap is short: less than 15 % of the range")
    nearest_m = gear.small_nearest_m
    if nearest_m is None or nearest_m > standoff_m:
        at = "" if nearest_m is None else f" (only from {_cm(nearest_m)} on)"
        found.append(
            f"gap before contact: with the gear {_cm(standoff_m)} under the target the "
            f"small marker is not wholly in the picture{at}; mount the camera nearer to the gear"
        )
    return found


def _text(design: TargetDesign, camera_name: str) -> str:
    r, optics, target = design.ranges, design.optics, design.target
    width, height = design.camera.size_px
    large, small = target.large, target.small
    both = "none: the two markers are never seen together at every turn"
    if r.z2_m is not None and r.z3_m is not None and r.z2_m > r.z3_m:
        both = f"{_cm(r.z3_m)} to {_cm(r.z2_m)}, both markers at any turn"
    blind, *advice = design.mount.lines()
    lines = [
        f"camera    {camera_name}, {width}x{height}, f {r.focal_px:.0f} px",
        f"optics    blur sigma {optics.blur_px:g} px, noise sigma {optics.noise:g}",
        f"target    {mm_text(large.side_m)} mm {large.dictionary}/{large.id} around "
        f"{mm_text(small.side_m)} mm {small.dictionary}/{small.id}",
        f"z1        {_cm(r.z1_m):<9} large marker from here on inwards (side {_px(r.large_px)})",
        f"z2        {_cm(r.z2_m):<9} small marker from here on inwards (side {_px(r.small_px)})",
        f"z3        {_cm(r.z3_m):<9} whole large marker down to here at any turn; "
        f"{_cm(r.z3_upright_m)} where it is upright",
        f"z4        {_cm(r.z4_m):<9} whole small marker down to here at any turn",
        f"overlap   {both}",
        f"at gear   whole large marker down to {_cm(design.gear.large_nearest_m)}, small down to "
        f"{_cm(design.gear.small_nearest_m)} between gear and target, the gear under its centre",
        f"mounting  {blind}",
        *(f"advice    {text}" for text in advice),
    ]
    if design.search_range_m is not None:
        where = f"at the highest search position ({design.search_height_m:g} m)"
        if design.search_height_m == 0.0:
            where = "on the ground, from where it has to be seen"
        lines.append(f"search    target {_cm(design.search_range_m)} away {where}")
    lines += ["", *_table(design.curve), ""]
    lines += [f"warning: {text}" for text in design.warnings] or ["no gap from search to stand-off"]
    return "\n".join(lines)


def _table(curve: ErrorCurve) -> list[str]:
    """Least possible errors at a few ranges, by the best that is seen there."""
    lines = [
        f"least error that the corners allow (sigma {CORNER_SIGMA_PX:g} px):",
        "   range cm   x, y mm     z mm   turn deg   seen",
    ]
    for z_cm in _TABLE_CM:
        if not curve.z_m[0] <= z_cm / 100.0 <= curve.z_m[-1]:
            continue
        i, name = curve.best_at(z_cm / 100.0)
        line = f"   {100 * curve.z_m[i]:8.1f}   nothing whole and readable"
        if name is not None:
            x, z, yaw = curve.bounds[name][i]
            line = (
                f"   {100 * curve.z_m[i]:8.1f}  {1e3 * x:8.3f}  {1e3 * z:7.3f}  "
                f"{math.degrees(yaw):9.3f}   {name}"
            )
        lines.append(line)
    return lines


def _height_error(curve: ErrorCurve, z_m: float) -> str:
    """By the best that is seen at the range nearest to it, in mm."""
    i, name = curve.best_at(z_m)
    if name is None or not curve.z_m[0] <= z_m <= curve.z_m[-1]:
        return "-"
    return f"{1e3 * curve.bounds[name][i, 1]:.3f}"


def _cm(length_m: float | None) -> str:
    return "never" if length_m is None else f"{100.0 * length_m:.3g} cm"


def _px(side_px: float | None) -> str:
    return "never" if side_px is None else f"{side_px:.0f} px"


# --- The least pose error that corners of a given spread allow (Cramer-Rao bound) --------------


def _error_curve(target: TargetConfig, r: Ranges) -> ErrorCurve:
    spans = {"large": (r.z3_m, r.z1_m), "small": (r.z4_m, r.z2_m)}
    ends = [v for span in spans.values() for v in span if v is not None]
    z = np.geomspace(min(ends, default=0.02), max(ends, default=2.0), CURVE_POINTS)
    sides = {"large": target.large.side_m, "small": target.small.side_m}
    bounds = {name: np.full((len(z), 3), np.nan) for name in ("large", "small", "both")}
    for i, z_m in enumerate(z):
        seen = [
            name
            for name, (near, far) in spans.items()
            if near is not None and far is not None and near * 0.9999 <= z_m <= far * 1.0001
        ]
        used = {name: [sides[name]] for name in seen}
        if len(seen) == 2:
            used["both"] = list(sides.values())
        for name, sides_m in used.items():
            x, _, z_sigma, yaw = pose_bound(sides_m, float(z_m), r.focal_px, CORNER_SIGMA_PX)
            bounds[name][i] = x, z_sigma, yaw
    return ErrorCurve(z, bounds)


def pose_bound(
    sides_m: list[float], z_m: float, focal_px: float, sigma_px: float
) -> tuple[float, float, float, float]:
    """The least standard deviations of x, y, z (m, in the camera frame) and of the turn (rad), for
    centred, concentric markers of these sides, seen straight on from `z_m`, all corners solved
    together; every corner has `sigma_px` in x and in y.

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
    sigma = sigma_px * np.sqrt(np.diag(np.linalg.inv(J.T @ J)))
    return float(sigma[3]), float(sigma[4]), float(sigma[5]), float(sigma[2])
