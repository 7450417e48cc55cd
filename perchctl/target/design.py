"""What a target will do with a camera: from where to where each marker is seen, and sizes that
cover the way from the search height to the contact.

z1 and z2 are the farthest ranges of the large and the small marker, z3 the nearest of the
whole large one (paper, section III-B: 115, 25, 12 cm). They follow from the smallest side
that is read through the blur, and from the picture's edge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.profile import MarkerConfig, Profile, TargetConfig
from perchctl.target.drawing import mm_text
from perchctl.target.page import parse_page
from perchctl.target.reading import Optics, check_target, smallest_side_px
from perchctl.target.sheets import fits, fitting_page
from perchctl.target.sight import (
    FieldOfView,
    MountingView,
    assess_mounting,
    gear_from_camera,
    least_side_px,
    raised,
    square_outline,
    turned_outline,
)
from perchctl.vision import CameraModel


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
class TargetDesign:
    """A target, a camera and a profile, and what follows from them.

    Attributes:
        gear_nearest_m: nearest range from the gear's tip to the target at which the large and the
            small marker are whole at any turn, the gear right under the target's centre.
        search_range_m: from the camera to the target at the highest search position, where the
            ceiling's height is known.
    """

    target: TargetConfig
    camera: CameraModel
    optics: Optics
    ranges: Ranges
    gear_nearest_m: tuple[float | None, float | None]
    mount: MountingView
    search_range_m: float | None
    search_height_m: float
    ceiling_m: float | None
    standoff_m: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each gap."""
        found: list[str] = []
        ranges, search_m, height_m = self.ranges, self.search_range_m, self.search_height_m
        if ranges.z1_m is None or ranges.z2_m is None or ranges.z3_m is None:
            return (
                "a marker is never read through this blur and noise: a sharper picture is needed",
            )
        if search_m is not None and height_m == 0.0:
            sure_m = ranges.focal_px * self.target.large.side_m / least_side_px(ranges.large_px)
            if search_m > sure_m:
                found.append(
                    f"gap on the ground: under a ceiling of {self.ceiling_m:g} m the target is "
                    f"{search_m:.2f} m from the camera, and is surely found up to {sure_m:.2f} m"
                )
        elif search_m is not None and search_m > ranges.z1_m:
            found.append(
                f"gap at the search height: from {height_m:g} m the target under a ceiling of "
                f"{self.ceiling_m:g} m is {search_m:.2f} m away, and is seen from "
                f"{ranges.z1_m:.2f} m on"
            )
        if search_m is not None and search_m < 0.3 and height_m > 0.0:
            found.append(
                f"the ceiling ({self.ceiling_m:g} m) is hardly above the search height "
                f"({height_m:g} m): lower planner.search.max_height_m"
            )
        if ranges.z2_m <= ranges.z3_m:
            found.append(
                f"gap between the markers: the small one is read up to {_cm(ranges.z2_m)}, and "
                f"the large one is whole at any turn only from {_cm(ranges.z3_m)} on"
            )
        elif ranges.z2_m < 1.15 * ranges.z3_m:
            found.append("the overlap is short: less than 15 % of the range")
        nearest_m = self.gear_nearest_m[1]
        if nearest_m is None or nearest_m > self.standoff_m:
            at = "" if nearest_m is None else f" (only from {_cm(nearest_m)} on)"
            found.append(
                f"gap before contact: with the gear {_cm(self.standoff_m)} under the target the "
                f"small marker is not wholly in the picture{at}; mount the camera nearer to the "
                f"gear"
            )
        return tuple(found)

    def record(self) -> dict[str, object]:
        """Return ranges, gaps and blind range for machines; metres."""
        return {
            **vars(self.ranges),
            "gear_large_nearest_m": self.gear_nearest_m[0],
            "gear_small_nearest_m": self.gear_nearest_m[1],
            "blind": self.mount.record(),
            "search_range_m": self.search_range_m,
            "warnings": list(self.warnings),
        }

    def text(self, camera_name: str) -> str:
        """Return ranges, overlap, mounting and warnings for people; several lines."""
        r, optics, target = self.ranges, self.optics, self.target
        width, height = self.camera.size_px
        large, small = target.large, target.small
        both = "none: the two markers are never seen together at every turn"
        if r.z2_m is not None and r.z3_m is not None and r.z2_m > r.z3_m:
            both = f"{_cm(r.z3_m)} to {_cm(r.z2_m)}, both markers at any turn"
        blind, *advice = self.mount.lines()
        lines = [
            f"camera    {camera_name}, {width}x{height}, f {r.focal_px:.0f} px",
            f"optics    blur sigma {optics.blur_px:g} px, noise sigma {optics.noise:g}",
            f"target    {mm_text(large.side_m)} mm {large.dictionary}/{large.id} around "
            f"{mm_text(small.side_m)} mm {small.dictionary}/{small.id}",
            f"z1        {_cm(r.z1_m):<9} large marker from here on inwards "
            f"(side {_px(r.large_px)})",
            f"z2        {_cm(r.z2_m):<9} small marker from here on inwards "
            f"(side {_px(r.small_px)})",
            f"z3        {_cm(r.z3_m):<9} whole large marker down to here at any turn; "
            f"{_cm(r.z3_upright_m)} where it is upright",
            f"z4        {_cm(r.z4_m):<9} whole small marker down to here at any turn",
            f"overlap   {both}",
            f"at gear   whole large marker down to {_cm(self.gear_nearest_m[0])}, small down to "
            f"{_cm(self.gear_nearest_m[1])} between gear and target, the gear under its centre",
            f"mounting  {blind}",
            *(f"advice    {text}" for text in advice),
        ]
        if self.search_range_m is not None:
            where = f"at the highest search position ({self.search_height_m:g} m)"
            if self.search_height_m == 0.0:
                where = "on the ground, from where it has to be seen"
            lines.append(f"search    target {_cm(self.search_range_m)} away {where}")
        lines += ["", *(f"warning: {text}" for text in self.warnings)]
        if not self.warnings:
            lines.append("no gap from search to stand-off")
        return "\n".join(lines)


def focal_px(camera: CameraModel) -> float:
    """Return the mean focal length in px."""
    return math.sqrt(float(camera.K[0, 0] * camera.K[1, 1]))


def design_ranges(target: TargetConfig, camera: CameraModel, optics: Optics) -> Ranges:
    """Return the ranges: by trial through the detector (far) and by geometry (near)."""
    f, view, ahead = focal_px(camera), FieldOfView(camera), (np.eye(3), np.zeros(3))
    picture_px = max(camera.size_px)
    large_px = smallest_side_px(target, "large", optics, picture_px)
    small_px = smallest_side_px(target, "small", optics, picture_px)
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
    """Return true where the target is the positioning system, so that it must be seen from the
    ground."""
    return profile.positioning.by == "target"


def make_design(
    target: TargetConfig,
    camera: CameraModel,
    optics: Optics,
    profile: Profile,
    ceiling_m: float | None = None,
    ranges: Ranges | None = None,
) -> TargetDesign:
    """Return the ranges, and what is wrong with them for a flight by that profile under a ceiling
    of that height over the floor (None: unknown)."""
    ranges = ranges or design_ranges(target, camera, optics)
    view, sides = FieldOfView(camera), (target.large.side_m, target.small.side_m)
    large_m, small_m = (
        view.nearest_m(turned_outline(s), *gear_from_camera(profile)) for s in sides
    )
    height = 0.0 if is_seen_from_ground(profile) else profile.planner.search.max_height_m
    search = None
    if ceiling_m is not None:
        search = ceiling_m - height - profile.camera.mount.position_m[2]
    return TargetDesign(
        target=target,
        camera=camera,
        optics=optics,
        ranges=ranges,
        gear_nearest_m=(large_m, small_m),
        mount=assess_mounting(target, camera, profile),
        search_range_m=search,
        search_height_m=height,
        ceiling_m=ceiling_m,
        standoff_m=profile.planner.ascend.standoff_m,
    )


def _cm(length_m: float | None) -> str:
    return "never" if length_m is None else f"{100.0 * length_m:.3g} cm"


def _px(side_px: float | None) -> str:
    return "never" if side_px is None else f"{side_px:.0f} px"


# --- Sizes and ids that cover the way from the search height to the contact ----------------------


DEFAULT_SEARCH_M = 1.15
"""Range to cover where no ceiling is named: the paper's z1."""
DEFAULT_CEILING_M = 2.5
"""Of a room, where none is named and the target has to be seen from the ground."""
FAR_MARGIN, OVERLAP_MARGIN, NEAR_MARGIN = 1.10, 1.20, 0.95
SMALL_RANGE = (0.08, 0.19)
"""Side of the small marker per side of the large one: up to 0.19 the large one is read as far
as around a smaller one, by trial (from 13 px on at a blur of 0.6 px; at 0.21 from 36 px on)."""
_LARGE = ("DICT_4X4_1000", 997)
_SMALL = ("DICT_ARUCO_ORIGINAL", 5)
_LARGE_STEP_M, _SMALL_STEP_M = 0.005, 0.0005
_LARGE_LIMITS_M = (0.03, 1.0)


def suggest_target(
    camera: CameraModel,
    optics: Optics,
    profile: Profile,
    magnet_m: float,
    ceiling_m: float | None = None,
    page: str = "a4",
) -> tuple[TargetDesign, str]:
    """Return the design of the largest markers that the page holds and of which the small one takes
    over from the large one, as every error falls with the size; and the page, a larger one only
    where the search needs it. What they do not cover is in the design's warnings.

    Raises InvalidValue where the blur leaves nothing to read, for a ceiling too low, or for a
    magnet that is smaller than what the small marker needs.
    """
    search_m = _search_range_m(profile, ceiling_m)
    base, picture_px = _sized(0.150, 0.025), max(camera.size_px)
    large_px = smallest_side_px(base, "large", optics, picture_px)
    small_px = smallest_side_px(base, "small", optics, picture_px)
    if large_px is None or small_px is None:
        raise InvalidValue(
            f"no marker is read through a blur of {optics.blur_px:g} px and noise "
            f"{optics.noise:g}: a sharper picture is needed"
        )
    f, view = focal_px(camera), FieldOfView(camera)
    far_px = least_side_px(large_px) if is_seen_from_ground(profile) else FAR_MARGIN * large_px
    needed_m = math.ceil(search_m * far_px / f / _LARGE_STEP_M) * _LARGE_STEP_M
    needed_m = min(max(needed_m, _LARGE_LIMITS_M[0]), _LARGE_LIMITS_M[1])
    most_m = min(
        magnet_m / math.sqrt(2.0),
        NEAR_MARGIN * _largest_at_standoff_m(view, profile),
    )

    def target_of(large_m: float) -> TargetConfig:
        """Return the target with the largest small marker."""
        small_m = max(min(SMALL_RANGE[1] * large_m, most_m), SMALL_RANGE[0] * large_m, 0.005)
        small_m = math.floor(small_m / _SMALL_STEP_M + 1e-6) * _SMALL_STEP_M
        return _sized(round(large_m, 4), round(small_m, 4))

    def takes_over(target: TargetConfig) -> bool:
        """Return true if the small marker is read before the large one leaves the picture."""
        near_m = view.nearest_m(turned_outline(target.large.side_m), np.eye(3), np.zeros(3))
        return near_m is None or f * target.small.side_m >= OVERLAP_MARGIN * near_m * small_px

    count = int((_LARGE_LIMITS_M[1] - needed_m) / _LARGE_STEP_M)
    larger = (target_of(needed_m + k * _LARGE_STEP_M) for k in range(count, 0, -1))
    held = (each for each in larger if fits(each, parse_page(page)) and takes_over(each))
    target = next(held, target_of(needed_m))
    check_target(target, magnet_m)
    held_by = page if fits(target, parse_page(page)) else fitting_page(target)
    return make_design(target, camera, optics, profile, ceiling_m), held_by


def _search_range_m(profile: Profile, ceiling_m: float | None) -> float:
    """Return the metres from camera to target at the highest search position, or on the ground
    where it has to be seen from there."""
    if is_seen_from_ground(profile):
        return (ceiling_m or DEFAULT_CEILING_M) - profile.camera.mount.position_m[2]
    if ceiling_m is None:
        return DEFAULT_SEARCH_M
    range_m = ceiling_m - profile.planner.search.max_height_m
    if range_m <= 0.0:
        raise InvalidValue(
            f"--ceiling {ceiling_m:g} is below the highest search position "
            f"({profile.planner.search.max_height_m:g} m): lower planner.search.max_height_m"
        )
    return range_m


def _sized(large_m: float, small_m: float) -> TargetConfig:
    return TargetConfig(
        large=MarkerConfig(dictionary=_LARGE[0], id=_LARGE[1], side_m=large_m),
        small=MarkerConfig(dictionary=_SMALL[0], id=_SMALL[1], side_m=small_m),
    )


def _largest_at_standoff_m(view: FieldOfView, profile: Profile) -> float:
    """Return the largest side, m, whose circle is in the picture with the gear at the stand-off."""
    R, gear = gear_from_camera(profile)
    low, high = 0.0, 1.0
    while high - low > 1e-4:
        middle = (low + high) / 2.0
        points = raised(turned_outline(middle), profile.planner.ascend.standoff_m)
        low, high = (middle, high) if view.holds(points @ R.T + gear) else (low, middle)
    return low
