"""The printed target as the vehicle's positioning system: each measured pose of it becomes the
vehicle's place in a world that is fixed to the target, carried on to the present by what the
vehicle's estimate has moved since, and is handed to its estimator.

The world is that of the vehicle's estimate at rest on the ground: there the target is measured
for `GROUND_S`, and where it is then seen it stays. So ground, fence and heights keep their
meaning, and the target is what the rest is measured from.

What if a place is the last one, late, or sent twice? The estimator takes each for the place of
now. So no exposure is sent twice, none out of order, none that is older than `OLDEST_S`, and
what lies farther from the estimate than both can explain is not believed: the age grows, and
the planner holds, sinks and lands by it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from perchctl.flight.history import History, attitude_at
from perchctl.geometry import Array, quaternion_from_rpy, rot_z, rotation_from_rpy, wrap_rad
from perchctl.positioning.feed import RATE_OVER_S, FeedStatus
from perchctl.positioning.place import TargetPlace
from perchctl.profile import Profile
from perchctl.vehicle import ExternalPosition
from perchctl.vision.types import Attitude, MarkerPose

GROUND_FRAMES = 8
OLDEST_S = 0.25
GATE_M, GATE_MPS = 0.10, 0.35
"""What estimate and measurement may be apart, and more the longer nothing was sent."""
GATE_SIGMAS = 5.0
NEAR_M, FAR_M, TAU_NEAR_S, TAU_FAR_S = 0.3, 1.0, 0.3, 1.0
WORST_SIGMA_M = 0.05


def body_place(
    pose: MarkerPose, attitude: Attitude, target: TargetPlace, gear_body_m: Array
) -> tuple[Array, float]:
    """The body's origin (3,) and heading in the target's world, by one measured pose."""
    yaw_rad = wrap_rad(target.yaw_rad - pose.e_yaw_rad)
    R_level_body = rotation_from_rpy(attitude.roll_rad, attitude.pitch_rad, 0.0)
    seen = pose.e_m + R_level_body @ gear_body_m
    return target.position_m - rot_z(yaw_rad) @ seen, yaw_rad


class SightFeed:
    """No thread and no clock: the flight loop calls `see` in each of its turns."""

    def __init__(
        self, send: Callable[[ExternalPosition], object], profile: Profile
    ) -> None:
        self._send, self._config = send, profile.positioning
        self._gear_body_m = np.asarray(profile.vehicle.gear_body_m, dtype=float)
        self._period_s = 1.0 / min(profile.positioning.rate_hz, 30.0)
        self.target: TargetPlace | None = None
        self._on_ground: list[tuple[Array, float]] = []
        self._seen_s = -math.inf
        self._exposed_s = -math.inf
        self._due_s = -math.inf
        self._pose: ExternalPosition | None = None
        self._count = 0
        self._times_s: deque[float] = deque()
        self._problem: str | None = "the target has not been seen yet"
        self.refused = 0
        self.off_m, self.off_yaw_rad = np.zeros(3), 0.0
        self._off_s = -math.inf

    def see(self, pose: MarkerPose | None, history: History, now_s: float) -> None:
        """A pose that this turn's picture gave, `pose.t_s` its exposure."""
        if pose is None or pose.t_s <= self._seen_s or history.newest is None:
            return
        self._seen_s = pose.t_s
        then = attitude_at(history, pose.t_s)
        now = attitude_at(history, now_s)
        if then is None or now is None:
            return
        if self.target is None:
            self._from_ground(pose, then)
            return
        if now_s - pose.t_s > OLDEST_S:
            self._problem = f"the picture is {now_s - pose.t_s:.2f} s old"
            return
        place_m, yaw_rad = body_place(pose, then, self.target, self._gear_body_m)
        off_m = place_m - np.asarray(then.position_m)
        sigma_m = float(np.max(pose.sigma_m))
        silent_s = min(max(0.0, pose.t_s - self._exposed_s), 2.0)
        gate_m = GATE_M + GATE_MPS * silent_s + GATE_SIGMAS * sigma_m
        if sigma_m > WORST_SIGMA_M or float(np.linalg.norm(off_m)) > gate_m:
            self.refused += 1
            self._problem = f"the target's pose is {np.linalg.norm(off_m):.2f} m beside the estimate"
            return
        dt_s = min(max(pose.t_s - self._off_s, 0.0), 0.5)
        self._off_s = pose.t_s
        near = float(np.clip((np.linalg.norm(pose.e_m) - NEAR_M) / (FAR_M - NEAR_M), 0.0, 1.0))
        share = 1.0 - math.exp(-dt_s / (TAU_NEAR_S + near * (TAU_FAR_S - TAU_NEAR_S)))
        self.off_m = self.off_m + share * (off_m - self.off_m)
        off_yaw = wrap_rad(yaw_rad - then.yaw_rad)
        self.off_yaw_rad += share * wrap_rad(off_yaw - self.off_yaw_rad)
        if now_s < self._due_s - 1e-6:
            return
        moved_m = np.asarray(now.position_m) - np.asarray(then.position_m)
        x, y, z = (float(v) for v in place_m + moved_m)
        turned = wrap_rad(now.yaw_rad - then.yaw_rad)
        quaternion = None
        if self._config.send == "pose":
            quaternion = quaternion_from_rpy(now.roll_rad, now.pitch_rad, wrap_rad(yaw_rad + turned))
        self._handed(ExternalPosition((x, y, z), quaternion), pose.t_s, now_s)

    def known(self, position_m: tuple[float, float, float], now_s: float) -> None:
        """The place is known without a picture: pressed or hanging."""
        if now_s < self._due_s - 1e-6:
            return
        self._handed(ExternalPosition(position_m, None), now_s, now_s)

    def _handed(self, place: ExternalPosition, exposed_s: float, now_s: float) -> None:
        if self._send(place) is False:
            self._problem = "the link is busy"
            return
        self._due_s = max(self._due_s + self._period_s, now_s)
        self._exposed_s, self._pose, self._problem = exposed_s, place, None
        self._count += 1
        self._times_s.append(now_s)
        while now_s - self._times_s[0] > RATE_OVER_S:
            self._times_s.popleft()

    def _from_ground(self, pose: MarkerPose, then: Attitude) -> None:
        R_level_body = rotation_from_rpy(then.roll_rad, then.pitch_rad, 0.0)
        seen = pose.e_m + R_level_body @ self._gear_body_m
        place_m = np.asarray(then.position_m) + rot_z(then.yaw_rad) @ seen
        self._on_ground.append((place_m, wrap_rad(then.yaw_rad + pose.e_yaw_rad)))
        if len(self._on_ground) < GROUND_FRAMES:
            return
        places = np.array([p for p, _ in self._on_ground])
        yaw0 = self._on_ground[0][1]
        yaw = yaw0 + float(np.median([wrap_rad(y - yaw0) for _, y in self._on_ground]))
        self.target = TargetPlace(np.median(places, axis=0), wrap_rad(yaw))

    def status(self, now_s: float) -> FeedStatus:
        age_s = now_s - self._exposed_s
        return FeedStatus(
            age_s=age_s,
            problem=self._problem if age_s > self._config.hold_s else None,
            sent=self._count,
            pose=self._pose,
            rate_hz=sum(now_s - t_s < RATE_OVER_S for t_s in self._times_s) / RATE_OVER_S,
            measured=self._pose,
        )
