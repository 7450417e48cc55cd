"""From where on the camera is blind as the gear comes near to the target.

With the gear under the target's centre, the vehicle level and its heading the target's, as in
an ascent: so the outline of the markers is upright in body axes. A camera beside the gear sees
the target aside of its axis, and its picture is wider than high: with the offset along the
picture's width it loses the target later.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import R_MARKER_TARGET, Array, rot_z, rpy_from_rotation
from perchctl.profile import DetectorConfig, Profile, TargetConfig
from perchctl.target.visible import FieldOfView, square_outline
from perchctl.vision import CameraModel, RigidPose, make_aruco_detector, shows_enough_of_target

FROM_M = 0.10
"""The last stretch that is looked at, from gear to target."""
_STEP_M, _FINE_M = 0.005, 0.0005
_WORTH_M = 0.002  # less is no reason to turn a camera
_OWN_AXES = np.diag([1.0, -1.0, -1.0])  # of a marker's own coordinates, in its axes


@dataclass(frozen=True)
class Blind:
    """Ranges from the gear's tip to the target from which on nothing is measured any more, m: by
    whole markers, and by what is left of their drawing. 0: down to contact; None: all of the
    last 10 cm."""

    whole_m: float | None
    left_m: float | None


@dataclass(frozen=True)
class Mounted:
    """A mounting's blind range, and, where the camera should rather be turned by 90 degrees about
    its view, its mounting's `rpy_deg` and blind range then."""

    blind: Blind
    turned: Blind | None = None
    turned_rpy_deg: tuple[float, float, float] | None = None


def mounted_camera(target: TargetConfig, camera: CameraModel, profile: Profile) -> Mounted:
    """Of the profile's `camera.mount` and `vehicle.gear_body_m`."""
    T_body_cam = profile.camera.mount.T_body_cam
    gear_m = np.asarray(profile.vehicle.gear_body_m) - T_body_cam[:3, 3]
    here = _blind(target, camera, T_body_cam[:3, :3], gear_m)
    R_turned = T_body_cam[:3, :3] @ rot_z(math.pi / 2.0)
    turned = _blind(target, camera, R_turned, gear_m)
    if not _better(turned, here):
        return Mounted(here)
    roll, pitch, yaw = (round(math.degrees(a), 1) + 0.0 for a in rpy_from_rotation(R_turned))
    return Mounted(here, turned, (roll, pitch, yaw))


def sees_small_marker(camera: CameraModel, profile: Profile, range_m: float) -> bool:
    """Whether the whole small marker is in the picture with the gear's tip so far under it."""
    T_body_cam = profile.camera.mount.T_body_cam
    R = T_body_cam[:3, :3].T
    target_m = np.add(profile.vehicle.gear_body_m, (0.0, 0.0, range_m))
    outline = square_outline(profile.target.small.side_m)
    return _holds(FieldOfView(camera), outline, R, R @ (target_m - T_body_cam[:3, 3]))


def blind_lines(mount: Mounted) -> list[str]:
    """For people, a line or two."""
    lines = [f"{_both(mount.blind)}, the gear under the target's centre"]
    if mount.turned is not None and mount.turned_rpy_deg is not None:
        turn = ", ".join(f"{a:g}" for a in mount.turned_rpy_deg)
        lines.append(
            "turn the camera by 90 degrees about its view, so that the gear is beside it along the "
            f"picture's width (camera.mount.rpy_deg: [{turn}]): {_both(mount.turned)}"
        )
    return lines


def blind_record(mount: Mounted) -> dict[str, object]:
    """For machines; m."""
    turned = mount.turned
    return {
        "whole_m": mount.blind.whole_m,
        "left_m": mount.blind.left_m,
        "turned_left_m": None if turned is None else turned.left_m,
        "turned_rpy_deg": mount.turned_rpy_deg,
    }


def _blind(target: TargetConfig, camera: CameraModel, R_body_cam: Array, gear_m: Array) -> Blind:
    """`gear_m` is the gear from the camera, body axes."""
    R, offset = R_body_cam.T, R_body_cam.T @ gear_m
    view, patterns = FieldOfView(camera), make_aruco_detector(DetectorConfig(), target).patterns
    outlines = [square_outline(marker.side_m) for marker in (target.large, target.small)]
    half_m = target.large.side_m / 2.0

    def centre(range_m: float) -> Array:
        at_m: Array = R @ np.array([0.0, 0.0, range_m]) + offset
        return at_m

    def whole(range_m: float) -> bool:
        return any(_holds(view, outline, R, centre(range_m)) for outline in outlines)

    def left(range_m: float) -> bool:
        pose = RigidPose(R @ R_MARKER_TARGET @ _OWN_AXES, centre(range_m) / half_m)
        return whole(range_m) or shows_enough_of_target(pose, patterns, camera)

    return Blind(*(_nearest_m(seen) for seen in (whole, left)))


def _holds(view: FieldOfView, outline_m: Array, R: Array, centre: Array) -> bool:
    """Whether an outline (n, 2) about that centre, in the camera's axes, is in the picture."""
    return view.holds(np.column_stack([outline_m, np.zeros(len(outline_m))]) @ R.T + centre)


def _nearest_m(seen: Callable[[float], bool]) -> float | None:
    """The range down to which the target is seen from `FROM_M` on."""
    low = FROM_M
    for step_m in (_STEP_M, _FINE_M):
        for k in range(round(FROM_M / step_m) + 1):
            range_m = low - k * step_m
            if range_m < 0.5 * _FINE_M:
                return 0.0
            if not seen(range_m):
                if range_m == FROM_M:
                    return None
                low = range_m + step_m
                break
    return low


def _better(turned: Blind, here: Blind) -> bool:
    """Whether it is worth the turn; a whole marker is the surer sight."""
    gain_m = _range_m(here.left_m) - _range_m(turned.left_m)
    whole_m = _range_m(here.whole_m) - _range_m(turned.whole_m)
    return gain_m >= _WORTH_M or (gain_m >= 0.0 and whole_m >= _WORTH_M)


def _range_m(nearest_m: float | None) -> float:
    return FROM_M if nearest_m is None else nearest_m


def _both(blind: Blind) -> str:
    return f"{_words(blind.left_m)} (by whole markers alone: {_words(blind.whole_m)})"


def _words(nearest_m: float | None) -> str:
    if nearest_m is None:
        return f"blind in all of the last {1e2 * FROM_M:g} cm"
    return "never blind" if nearest_m == 0.0 else f"blind from {1e3 * nearest_m:.0f} mm to contact"
