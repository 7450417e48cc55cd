"""Sizes and ids that cover the way from the search height to the contact."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.geometry import Array
from perchctl.profile import MarkerConfig, Profile, TargetConfig
from perchctl.target.checks import check_target
from perchctl.target.design import Design, focal_px, make_design
from perchctl.target.limits import Optics, smallest_side_px
from perchctl.target.sheets import fitting_page
from perchctl.target.visible import FieldOfView, turned_outline
from perchctl.vision.types import CameraModel

DEFAULT_SEARCH_M = 1.15
"""Range to cover where no ceiling is named: the paper's z1."""
FAR_MARGIN, OVERLAP_MARGIN, NEAR_MARGIN = 1.10, 1.20, 0.95
SMALL_RANGE = (0.08, 0.21)
"""Side of the small marker per side of the large one: up to 0.21 both are read with a
white centre of two cells (32 of 150 mm, by trial)."""
_LARGE = ("DICT_4X4_1000", 997)
_SMALL = ("DICT_ARUCO_ORIGINAL", 5)
_LARGE_STEP_M, _SMALL_STEP_M = 0.005, 0.0005
_LARGE_LIMITS_M = (0.03, 1.0)


@dataclass(frozen=True)
class Suggestion:
    """`page` holds the target; `notes` name what could not be met."""

    target: TargetConfig
    page: str
    notes: tuple[str, ...]

    def command(self) -> str:
        large, small = self.target.large, self.target.small
        return (
            f"perchctl make-target --large {large.side_m * 1e3:g}mm --large-id {large.id} "
            f"--large-dict {large.dictionary} --small {small.side_m * 1e3:g}mm "
            f"--small-id {small.id} --small-dict {small.dictionary} --page {self.page}"
        )


def suggest(
    camera: CameraModel,
    optics: Optics,
    profile: Profile,
    magnet_m: float,
    ceiling_m: float | None = None,
) -> tuple[Suggestion, Design]:
    """The smallest large marker that is seen from the highest search position, and a small
    one that is whole at the stand-off and seen before the large one leaves the picture.

    Raises InvalidValue where the blur leaves nothing to read.
    """
    base = _target(0.150, 0.025)
    picture_px = max(camera.size_px)
    large_px = smallest_side_px(base, "large", optics, picture_px)
    small_px = smallest_side_px(base, "small", optics, picture_px)
    if large_px is None or small_px is None:
        raise InvalidValue(
            f"no marker is read through a blur of {optics.blur_px:g} px and noise "
            f"{optics.noise:g}: a sharper picture is needed"
        )
    f, view, notes = focal_px(camera), FieldOfView(camera), []
    search_m = DEFAULT_SEARCH_M
    if ceiling_m is not None:
        search_m = ceiling_m - profile.planner.search.max_height_m
        if search_m <= 0.0:
            raise InvalidValue(
                f"--ceiling {ceiling_m:g} is below the highest search position "
                f"({profile.planner.search.max_height_m:g} m): lower planner.search.max_height_m"
            )
    large_m = math.ceil(FAR_MARGIN * search_m * large_px / f / _LARGE_STEP_M) * _LARGE_STEP_M
    if not _LARGE_LIMITS_M[0] <= large_m <= _LARGE_LIMITS_M[1]:
        notes.append(f"a large marker of {1e3 * large_m:.0f} mm would be needed")
        large_m = min(max(large_m, _LARGE_LIMITS_M[0]), _LARGE_LIMITS_M[1])
    large_near_m = view.nearest_m(turned_outline(large_m), np.eye(3), np.zeros(3))
    least_m = 0.0 if large_near_m is None else OVERLAP_MARGIN * large_near_m * small_px / f
    most_m = min(
        SMALL_RANGE[1] * large_m,
        magnet_m / math.sqrt(2.0),
        NEAR_MARGIN * _largest_at_standoff_m(view, profile),
    )
    if least_m > most_m:
        notes.append(
            f"the small marker would have to be {1e3 * least_m:.1f} mm to be seen before the large "
            f"one leaves the picture, and can be {1e3 * most_m:.1f} mm at most"
        )
    wish_m = most_m if least_m > most_m else math.sqrt(least_m * most_m) if least_m else most_m
    small_m = max(wish_m, SMALL_RANGE[0] * large_m, 0.005)
    small_m = math.floor(small_m / _SMALL_STEP_M + 1e-6) * _SMALL_STEP_M
    target = _target(round(large_m, 4), round(small_m, 4))
    check_target(target, max(magnet_m, math.sqrt(2.0) * target.small.side_m))
    page = fitting_page(target)
    design = make_design(target, camera, optics, profile, ceiling_m)
    return Suggestion(target, page, tuple(notes)), design


def _target(large_m: float, small_m: float) -> TargetConfig:
    return TargetConfig(
        large=MarkerConfig(dictionary=_LARGE[0], id=_LARGE[1], side_m=large_m),
        small=MarkerConfig(dictionary=_SMALL[0], id=_SMALL[1], side_m=small_m),
    )


def _largest_at_standoff_m(view: FieldOfView, profile: Profile) -> float:
    """The largest side whose circle is in the picture with the gear at the stand-off."""
    T_body_cam = profile.camera.mount.T_body_cam
    R: Array = T_body_cam[:3, :3].T
    gear = R @ (np.asarray(profile.vehicle.gear_body_m) - T_body_cam[:3, 3])
    low, high = 0.0, 1.0
    while high - low > 1e-4:
        middle = (low + high) / 2.0
        circle = turned_outline(middle)
        points = np.column_stack([circle, np.full(len(circle), profile.planner.ascend.standoff_m)])
        low, high = (middle, high) if view.holds(points @ R.T + gear) else (low, middle)
    return low
