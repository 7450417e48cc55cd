"""The paper's experiment in the simulator: a stationary camera at seeded positions.

The camera is placed between z3 and z2 below the target, where both markers are completely in view;
heading and offset are drawn at random.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from perchctl.errors import InvalidValue
from perchctl.geometry import R_MARKER_TARGET, Array, invert_T, make_T, rot_z, wrap_rad
from perchctl.profile import Profile
from perchctl.sim import Renderer, Scenario
from perchctl.vision import CameraModel, Frame, project, square_corners
from perchctl.weights.collect import SessionFile, position_fault, read_markers, session_rows

NOISE_SIGMA, BLUR_PX = 4.0, 1.0
CORNER_MARGIN_PX = 4.0
FRAME_S = 1.0 / 30.0
_TRIES = 400
_SESSION_STREAM = 611


@dataclass(frozen=True, eq=False)
class CameraPlace:
    """A placement of the camera. `actual` (x, y, z, yaw): pose of the target relative to the gear
    in the level frame."""

    T_world_cam: Array
    actual: Array


class SimulatedStand:
    """The simulated camera on a stand. The same seed gives the same positions and images."""

    def __init__(self, profile: Profile, camera: CameraModel, positions: int, seed: int) -> None:
        self._profile, self._camera, self._seed = profile, camera, seed
        self._positions = positions
        self._scenario = Scenario(
            seed=seed,
            large_side_m=profile.target.large.side_m,
            small_side_m=profile.target.small.side_m,
            camera_noise_sigma=NOISE_SIGMA,
            camera_defocus_px=BLUR_PX,
        )
        self._renderer = Renderer(self._scenario, camera, profile.target, seed)
        self._corners = square_corners(profile.target.large.side_m)

    def fill_session(self, session: SessionFile, frames: int, advance: Callable[[], None]) -> None:
        """Add the missing positions, with `frames` frames each; call `advance` for each frame.
        Raises InvalidValue."""
        while session.done < self._positions:
            position = session.next_position
            place, readings = self.place(position), []
            shown = self.frames(position, place, frames)
            for reading in read_markers(shown, self._profile, self._camera):
                readings.append(reading)
                advance()
            fault = position_fault(readings)
            if fault is not None:
                raise InvalidValue(
                    f"position {position} of the simulated experiment cannot be used ({fault}): "
                    "choose another --seed"
                )
            session.append(session_rows(position, readings, place.actual))

    def place(self, position: int) -> CameraPlace:
        """The place of the camera for a position, counted from 1. Each position has its own section
        of the range from z3 to z2, so that even a few positions cover it. Raises InvalidValue."""
        merge = self._profile.merge
        rng = np.random.default_rng([self._seed, _SESSION_STREAM, position])
        share = (position - 1) % self._positions
        step = (merge.z2_m - merge.z3_m) / self._positions
        for _ in range(_TRIES):
            z_m = merge.z3_m + (share + float(rng.random())) * step
            yaw = float(rng.uniform(-math.pi, math.pi))
            reach = 0.35 * z_m
            x_m, y_m = (float(v) for v in rng.uniform(-reach, reach, 2))
            place = self._at(x_m, y_m, z_m, yaw)
            if self._in_picture(place):
                return place
        raise InvalidValue(
            "this camera does not see the whole large marker from any place between z3 "
            f"({merge.z3_m:g} m) and z2 ({merge.z2_m:g} m): correct merge.z3_m and z2_m in the "
            "profile"
        )

    def frames(self, position: int, place: CameraPlace, count: int) -> Iterator[Frame]:
        """Yield `count` images of a place; `position` is its number."""
        for k in range(count):
            index = position * 100_000 + k
            image = self._renderer.render([place.T_world_cam], frame_index=index)
            yield Frame(k, k * FRAME_S, image, k * FRAME_S)

    def _at(self, x_m: float, y_m: float, z_m: float, yaw: float) -> CameraPlace:
        T_body_cam = self._profile.camera.mount.T_body_cam
        lens = np.array([x_m, y_m, z_m])  # target relative to the camera, level axes
        gear = np.asarray(self._profile.vehicle.gear_body_m)
        target_world = np.array([*self._scenario.target_xy_m, self._scenario.ceiling_z_m])
        body = target_world - rot_z(yaw) @ (lens + T_body_cam[:3, 3])
        T_world_body = make_T(rot_z(yaw), body)
        e_m = lens + T_body_cam[:3, 3] - gear
        heading = wrap_rad(self._scenario.target_yaw_rad - yaw)
        return CameraPlace(T_world_body @ T_body_cam, np.array([*e_m, heading]))

    def _in_picture(self, place: CameraPlace) -> bool:
        T_world_marker = self._renderer.T_world_target @ make_T(R_MARKER_TARGET, (0.0, 0.0, 0.0))
        T_cam_marker = invert_T(place.T_world_cam) @ T_world_marker
        rvec, tvec = np.asarray(cv2.Rodrigues(T_cam_marker[:3, :3])[0], float), T_cam_marker[:3, 3]
        corners = project(self._corners, rvec, tvec, self._camera)
        highest = np.array(self._camera.size_px) - 1 - CORNER_MARGIN_PX
        return bool((corners > CORNER_MARGIN_PX).all() and (corners < highest).all())
