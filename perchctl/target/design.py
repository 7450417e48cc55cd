"""Predict how a target works with a camera: the range in which each marker is detected.

z1 and z2 are the farthest ranges at which the large and the small marker are detected, and z3 the
nearest range at which the whole large marker is in view (paper, section III-B: 115, 25, 12 cm).
These ranges depend on the smallest side that can be read despite the blur, and on the field of
view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.profile import Profile, TargetConfig
from perchctl.target.drawing import mm_text
from perchctl.target.reading import smallest_side_px
from perchctl.target.sight import (
    BlindRange,
    FieldOfView,
    blind_range,
    camera_rotation_and_gear,
    circle_outline,
    reliable_side_px,
    square_outline,
)
from perchctl.vision import MARKERS, CameraModel


@dataclass(frozen=True)
class TargetDesign:
    """The ranges in which a camera detects a target, for a profile.

    Ranges are from the camera's centre to a target on its axis, facing it, m; None where the marker
    is never detected.

    Attributes:
        blur_px: sigma of the image's blur.
        large_px, small_px: smallest sides, px, that the detector finds in blurred trial images.
        z1_m, z2_m: farthest range of the large and of the small marker, in any rotation.
        z3_m: nearest range of the whole large marker in any rotation; z3_upright_m: the same with
            the marker's sides parallel to the sides of the image.
        small_nearest_m: nearest range from the gear's tip to the target at which the small marker
            is whole in any rotation, with the gear directly under the target's centre.
        start_range_m: from the camera to the target at the height `start_height_m`, from which the
            target must be found: the highest point of the search or, if the target is the position
            source, the ground (0). None if the ceiling's height is unknown.
        standoff_m: distance from the gear to the target before contact.
    """

    target: TargetConfig
    camera: CameraModel
    blur_px: float
    large_px: float | None
    small_px: float | None
    z1_m: float | None
    z2_m: float | None
    z3_m: float | None
    z3_upright_m: float | None
    small_nearest_m: float | None
    blind_range: BlindRange
    start_range_m: float | None
    start_height_m: float
    standoff_m: float

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each gap in which the target is not detected."""
        found: list[str] = []
        start_m = self.start_range_m
        far_m = self.z1_m
        if far_m is None or self.z2_m is None or self.z3_m is None:
            return (
                "one of the markers can never be read with this blur: a sharper image is needed",
            )
        if self.start_height_m == 0.0:
            sure_px = reliable_side_px(self.large_px)
            far_m = focal_px(self.camera) * self.target.large.side_m / sure_px
        if start_m is not None and start_m < 0.3 and self.start_height_m > 0.0:
            found.append(
                f"at the highest point of the search ({self.start_height_m:g} m above the floor), "
                "the target is less than 0.3 m above the camera: lower planner.search.max_height_m"
            )
        if start_m is not None and start_m > far_m:
            gap, place = "gap above the search", "even from its highest point"
            if self.start_height_m == 0.0:
                gap, place = "gap at the start", "from the ground"
            else:
                place += f", {self.start_height_m:g} m above the floor"
            found.append(
                f"{gap}: {place}, the target is {start_m:.2f} m from the camera, but it is found "
                f"only within {far_m:.2f} m"
            )
        if self.z2_m <= self.z3_m:
            found.append(
                f"gap between the markers: the small one is read only within {_cm(self.z2_m)}, "
                "and the large one is wholly in view at any heading only beyond "
                f"{_cm(self.z3_m)}"
            )
        nearest_m = self.small_nearest_m
        if nearest_m is None or nearest_m > self.standoff_m:
            beyond = "" if nearest_m is None else f", but only beyond {_cm(nearest_m)}"
            found.append(
                f"gap before contact: with the gear {_cm(self.standoff_m)} below the target the "
                f"small marker is not wholly in view{beyond}; mount the camera closer to the gear"
            )
        return tuple(found)

    def record(self) -> dict[str, object]:
        """Return ranges, blind range and warnings as JSON values, metres."""
        names = ("z1_m", "z2_m", "z3_m", "z3_upright_m", "large_px", "small_px", "small_nearest_m")
        ranges = {name: getattr(self, name) for name in (*names, "start_range_m")}
        return ranges | {"blind": vars(self.blind_range), "warnings": list(self.warnings)}

    def text(self, camera_name: str) -> str:
        """Return ranges, mounting and warnings as several lines of text."""
        width, height = self.camera.size_px
        large = self.target.large
        small = self.target.small
        rows = {
            "camera": f"{camera_name}, {width}x{height}, f {focal_px(self.camera):.0f} px",
            "blur": f"sigma {self.blur_px:g} px",
            "target": f"{mm_text(large.side_m)} mm {large.dictionary}/{large.id} around "
            f"{mm_text(small.side_m)} mm {small.dictionary}/{small.id}",
            "z1": f"{_cm(self.z1_m):<9} and closer: large marker readable (side "
            f"{_px(self.large_px)})",
            "z2": f"{_cm(self.z2_m):<9} and closer: small marker readable (side "
            f"{_px(self.small_px)})",
            "z3": f"{_cm(self.z3_m):<9} and farther: whole large marker in view at any heading; "
            f"{_cm(self.z3_upright_m)} if upright",
            "at gear": f"{_cm(self.small_nearest_m):<9} and farther, gear to target: whole small "
            "marker in view",
            "mounting": self.blind_range.text,
        }
        if self.start_range_m is not None:
            name, place = "search", f"{self.start_height_m:g} m above the floor, its highest point"
            if self.start_height_m == 0.0:
                name, place = "start", "the ground, where the target must be in view"
            rows[name] = f"{_cm(self.start_range_m):<9} to the target from {place}"
        lines = [f"{name:<10}{text}" for name, text in rows.items()]
        warnings = [f"warning: {text}" for text in self.warnings]
        return "\n".join([*lines, "", *(warnings or ["no gap between search and stand-off"])])


def _cm(length_m: float | None) -> str:
    return "never" if length_m is None else f"{100.0 * length_m:.3g} cm"


def _px(side_px: float | None) -> str:
    return "never" if side_px is None else f"{side_px:.0f} px"


def focal_px(camera: CameraModel) -> float:
    """The mean of the two focal lengths, px."""
    return math.sqrt(float(camera.K[0, 0] * camera.K[1, 1]))


def make_design(
    target: TargetConfig,
    camera: CameraModel,
    blur_px: float,
    profile: Profile,
    ceiling_m: float | None = None,
) -> TargetDesign:
    """The design for a profile and a ceiling `ceiling_m` above the floor (None: unknown). Far
    ranges are found by running the detector on trial images, near ones from the geometry."""
    f = focal_px(camera)
    view = FieldOfView(camera)
    ahead = (np.eye(3), np.zeros(3))
    large_px, small_px = (
        smallest_side_px(target, name, blur_px, max(camera.size_px)) for name in MARKERS
    )
    large = target.large.side_m
    small = target.small.side_m
    # A target that is the positioning system must be visible from the ground.
    ground = profile.positioning.source.is_target
    height_m = 0.0 if ground else profile.planner.search.max_height_m
    start_m = None
    if ceiling_m is not None:
        start_m = ceiling_m - height_m - profile.camera.mount.position_m[2]
    return TargetDesign(
        target=target,
        camera=camera,
        blur_px=blur_px,
        large_px=large_px,
        small_px=small_px,
        z1_m=None if large_px is None else f * large / large_px,
        z2_m=None if small_px is None else f * small / small_px,
        z3_m=view.nearest_m(circle_outline(large), *ahead),
        z3_upright_m=view.nearest_m(square_outline(large), *ahead),
        small_nearest_m=view.nearest_m(circle_outline(small), *camera_rotation_and_gear(profile)),
        blind_range=blind_range(target, camera, profile),
        start_range_m=start_m,
        start_height_m=height_m,
        standoff_m=profile.planner.ascend.standoff_m,
    )
