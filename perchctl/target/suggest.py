"""Sizes and ids that cover the way from the search height to the contact."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.profile import MarkerConfig, Profile, TargetConfig
from perchctl.target.design import TargetDesign, focal_px, is_seen_from_ground, make_design
from perchctl.target.drawing import mm_text
from perchctl.target.page import PAGES_MM, parse_page
from perchctl.target.reading import Optics, check_target, smallest_side_px
from perchctl.target.sheets import fits, fitting_page
from perchctl.target.sight import (
    FieldOfView,
    gear_from_camera,
    least_side_px,
    raised,
    turned_outline,
)
from perchctl.vision import CameraModel

DEFAULT_SEARCH_M = 1.15
"""Range to cover where no ceiling is named: the paper's z1."""
DEFAULT_CEILING_M = 2.5
"""Of a room, where none is named and the target has to be seen from the ground."""
FAR_MARGIN, OVERLAP_MARGIN, NEAR_MARGIN = 1.10, 1.20, 0.95
SMALL_RANGE = (0.08, 0.19)
"""Side of the small marker per side of the large one: up to 0.19 the large one is read as far
as around a smaller one, by trial (from 13 px on at a blur of 0.6 px; at 0.21 from 36 px on)."""
TILE = "a3"
"""Sheets for a page that is larger than the named ones."""
_LARGE = ("DICT_4X4_1000", 997)
_SMALL = ("DICT_ARUCO_ORIGINAL", 5)
_LARGE_STEP_M, _SMALL_STEP_M = 0.005, 0.0005
_LARGE_LIMITS_M = (0.03, 1.0)


@dataclass(frozen=True)
class Suggestion:
    """`page` holds the target; `reasons` say what its sizes follow from, `notes` name what
    could not be met."""

    target: TargetConfig
    page: str
    reasons: tuple[str, ...]
    notes: tuple[str, ...]

    def command(self) -> str:
        large, small = self.target.large, self.target.small
        return (
            f"perchctl make-target --large {large.side_m * 1e3:g}mm --large-id {large.id} "
            f"--large-dict {large.dictionary} --small {small.side_m * 1e3:g}mm "
            f"--small-id {small.id} --small-dict {small.dictionary} --page {self.page}"
            + ("" if self.page in PAGES_MM else f" --tile {TILE}")
        )


@dataclass(frozen=True)
class _Smalls:
    """The small marker's side beside a large one: at least so much that it is seen before the
    large one leaves the picture, at most what `why` says."""

    least_m: float
    most_m: float
    why: str


def suggest_target(
    camera: CameraModel,
    optics: Optics,
    profile: Profile,
    magnet_m: float,
    ceiling_m: float | None = None,
    page: str = "a4",
) -> tuple[Suggestion, TargetDesign]:
    """The largest markers that the page holds and that are seen all the way, as every error
    falls with the size; a larger page only where the search needs it.

    Raises InvalidValue where the blur leaves nothing to read, or for a ceiling too low.
    """
    search_m = _search_range_m(profile, ceiling_m)
    base = _target(0.150, 0.025)
    picture_px = max(camera.size_px)
    large_px = smallest_side_px(base, "large", optics, picture_px)
    small_px = smallest_side_px(base, "small", optics, picture_px)
    if large_px is None or small_px is None:
        raise InvalidValue(
            f"no marker is read through a blur of {optics.blur_px:g} px and noise "
            f"{optics.noise:g}: a sharper picture is needed"
        )
    f, notes = focal_px(camera), []
    bridging = partial(_smalls, FieldOfView(camera), profile, magnet_m, small_px / f)
    far_px = FAR_MARGIN * large_px
    if is_seen_from_ground(profile):
        far_px = least_side_px(large_px)
    needed_m = math.ceil(search_m * far_px / f / _LARGE_STEP_M) * _LARGE_STEP_M
    if not _LARGE_LIMITS_M[0] <= needed_m <= _LARGE_LIMITS_M[1]:
        notes.append(f"a large marker of {1e3 * needed_m:.0f} mm would be needed")
    needed_m = min(max(needed_m, _LARGE_LIMITS_M[0]), _LARGE_LIMITS_M[1])
    large_m = _largest_m(needed_m, parse_page(page), bridging)
    smalls = bridging(large_m)
    if smalls.least_m > smalls.most_m:
        notes.append(
            f"the small marker would have to be {1e3 * smalls.least_m:.1f} mm to be seen before "
            f"the large one leaves the picture, and can be {1e3 * smalls.most_m:.1f} mm at most"
        )
    small_m = max(smalls.most_m, SMALL_RANGE[0] * large_m, 0.005)
    small_m = math.floor(small_m / _SMALL_STEP_M + 1e-6) * _SMALL_STEP_M
    target = _target(round(large_m, 4), round(small_m, 4))
    check_target(target, max(magnet_m, math.sqrt(2.0) * target.small.side_m))
    held = page if fits(target, parse_page(page)) else fitting_page(target)
    read = f"read from {100 * search_m:.0f} cm away with {mm_text(needed_m)} mm"
    wider = fits(_target(large_m + _LARGE_STEP_M, small_m), parse_page(page))
    bound = "beside a larger one no small one takes over" if wider else f"{held} holds no larger"
    reasons = (
        f"large {mm_text(large_m)} mm: {read} and more; the larger, the more exact, and {bound}"
        if large_m > needed_m
        else f"large {mm_text(large_m)} mm: {read} and no less",
        f"small {mm_text(small_m)} mm: takes over from the large one with "
        f"{1e3 * smalls.least_m:.1f} mm and more; the larger, the more exact, and beyond that "
        f"{smalls.why}",
    )
    design = make_design(target, camera, optics, profile, ceiling_m)
    return Suggestion(target, held, reasons, tuple(notes)), design


def _search_range_m(profile: Profile, ceiling_m: float | None) -> float:
    """Camera to target at the highest search position, or on the ground where it has to be seen
    from there."""
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


def _smalls(
    view: FieldOfView, profile: Profile, magnet_m: float, angle: float, large_m: float
) -> _Smalls:
    """`angle`: the smallest side that is read, per range."""
    near_m = view.nearest_m(turned_outline(large_m), np.eye(3), np.zeros(3))
    least_m = 0.0 if near_m is None else OVERLAP_MARGIN * near_m * angle
    most_m, why = min(
        (SMALL_RANGE[1] * large_m, "the large one is not read as far around it"),
        (magnet_m / math.sqrt(2.0), "it is not inside of the magnet"),
        (
            NEAR_MARGIN * _largest_at_standoff_m(view, profile),
            "it is not whole in the picture at the stand-off",
        ),
    )
    return _Smalls(least_m, most_m, why)


def _largest_m(
    needed_m: float, page: tuple[float, float], bridging: Callable[[float], _Smalls]
) -> float:
    """The largest side, from the needed one on, that the page holds and that a small marker
    takes over from; else the needed one."""
    count = int((_LARGE_LIMITS_M[1] - needed_m) / _LARGE_STEP_M)
    for side_m in (needed_m + k * _LARGE_STEP_M for k in range(count, 0, -1)):
        if fits(_target(side_m, SMALL_RANGE[0] * side_m), page):
            smalls = bridging(side_m)
            if smalls.least_m <= smalls.most_m:
                return side_m
    return needed_m


def _target(large_m: float, small_m: float) -> TargetConfig:
    return TargetConfig(
        large=MarkerConfig(dictionary=_LARGE[0], id=_LARGE[1], side_m=large_m),
        small=MarkerConfig(dictionary=_SMALL[0], id=_SMALL[1], side_m=small_m),
    )


def _largest_at_standoff_m(view: FieldOfView, profile: Profile) -> float:
    """The largest side whose circle is in the picture with the gear at the stand-off."""
    R, gear = gear_from_camera(profile)
    low, high = 0.0, 1.0
    while high - low > 1e-4:
        middle = (low + high) / 2.0
        points = raised(turned_outline(middle), profile.planner.ascend.standoff_m)
        low, high = (middle, high) if view.holds(points @ R.T + gear) else (low, middle)
    return low
