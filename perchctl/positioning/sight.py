"""The printed target as the vehicle's positioning system: convert each measured pose to the body's
position in a world fixed to the target, add the motion of the vehicle's estimate since the
exposure, and send the result to its estimator.

The origin of this world frame is the vehicle's position on the ground when its estimate is
reset. The world's origin is sent until the target has been seen often enough from there; then
the target's position is fixed. Ground, safety limits and heights therefore keep their meaning.

No exposure is used twice, out of order, or when it is older than `OLDEST_S`. A position is rejected
if it is farther from the estimate than the errors of both can explain. The age of the position then
grows, which makes the planner hold, descend and land.
"""

from __future__ import annotations

import math

import numpy as np

from perchctl.geometry import Place, quaternion_from_rpy, rot_z, wrap_rad
from perchctl.positioning.feed import UNSEEN, FeedStatus, SendingRate
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import ExternalPosition, SendPosition
from perchctl.vision import (
    MarkerPose,
    PoseSetup,
    TargetEstimate,
    VehicleState,
    target_level_to_world,
    target_world_to_level,
)

GROUND_FRAMES = 15
"""Number of frames at rest whose median gives the target's position: half a second with a 30 Hz
camera."""
SETTLED_TILT_RAD = 0.003
"""Largest difference between the attitudes of these frames, rad: 6 mm at 2 m. Larger: if the target
is seen while the estimator is still correcting its attitude, the learned position of the target is
wrong. Smaller: noise in the attitude delays a take-off."""
SETTLED_POSITION_M = 0.02
"""Largest difference between the estimated positions of these frames, m."""
OLDEST_S = 0.3
"""Age at which a sighting is no longer sent, s."""
GATE_M, GATE_MPS, GATE_SIGMAS = 0.10, 0.35, 5.0
"""Allowed distance between estimate and sighting, m, and its growth per second without a sighting,
m/s: after 2 s without one, a vehicle is displaced by half a metre (docs/firmware.md, "Target as
position")."""
GATE_LONGEST_S = 4.0
"""Time without a sighting after which the gate stops growing, s."""
WORST_SIGMA_M = 0.05
"""Largest standard deviation of a pose that is sent, m."""
LEARN_NEAR_M = 0.3
"""Distance to the target below which the difference between estimate and sightings is learned with
the time constant `LEARN_NEAR_S`, m."""
LEARN_FAR_M = 1.0
"""Distance to the target above which this difference is learned with `LEARN_FAR_S`, m: more slowly,
because a pixel covers a larger distance."""
LEARN_NEAR_S = 0.3
"""Time constant near the target, s. Smaller: the learned difference follows the noise of single
sightings."""
LEARN_FAR_S = 1.0
"""Time constant far from the target, s. Larger: a change in the difference is learned more
slowly."""
NOWHERE = Place(np.zeros(3), 0.0)
"""Zero difference between two positions."""


def target_place(pose: MarkerPose, attitude: VehicleState, setup: PoseSetup) -> Place:
    """Return the target's position and heading from its pose in an image and the body's attitude
    and position."""
    return Place(*target_level_to_world(pose.e_m, pose.e_yaw_rad, attitude, setup))


def body_place(pose: MarkerPose, attitude: VehicleState, target: Place, setup: PoseSetup) -> Place:
    """Return the body's position and heading from its pose relative to a stationary target. Only
    the roll and pitch of `attitude` are used."""
    yaw_rad = wrap_rad(target.yaw_rad - pose.e_yaw_rad)
    way_m = pose.e_m + attitude.R_level_body.dot(setup.gear_body_m)
    return Place(target.position_m - rot_z(yaw_rad).dot(way_m), yaw_rad)


def _is_settled(earlier: VehicleState, now: VehicleState) -> bool:
    """True if the estimate of a vehicle at rest has not changed beyond its noise."""
    tilt_rad = math.hypot(now.roll_rad - earlier.roll_rad, now.pitch_rad - earlier.pitch_rad)
    moved_m = math.dist(now.position_m, earlier.position_m)
    return tilt_rad <= SETTLED_TILT_RAD and moved_m <= SETTLED_POSITION_M


class TargetFeed:
    """Sends the vehicle's position, measured from sightings of the target. Called from the flight
    loop's thread.

    `target` is the target's position and heading; None until it has been seen from the ground.
    `off` is the body's position and heading from the sightings minus the estimate, low-pass
    filtered to reduce noise. This difference is not zero, because the estimator lags behind late
    positions.
    """

    def __init__(self, send: SendPosition, profile: Profile, setup: PoseSetup) -> None:
        self._send, self._config, self._setup = send, profile.positioning, setup
        self._origin_m = (0.0, 0.0, profile.safety.ground_z_m)
        self._rate = SendingRate(self._config.rate_hz)
        self.target: Place | None = None
        self.off = NOWHERE
        self._on_ground: list[tuple[VehicleState, Place]] = []
        self._seen_s = -math.inf
        self._placed_s = -math.inf
        self._pose: ExternalPosition | None = None
        self._refusal, self._beside_m = "", 0.0

    def send_origin(self, now_s: float) -> None:
        """Send the world's origin while the vehicle is on the ground and no target is known yet."""
        if self.target is None:
            self.send_known(self._origin_m, now_s)

    def send_known(self, position_m: tuple[float, float, float], now_s: float) -> None:
        """Send a position that is known without an image, because the vehicle is on the ground,
        hanging, or in contact with the ceiling."""
        self._hand_over(ExternalPosition(position_m), now_s, now_s)

    def contact_position(self, yaw_rad: float) -> tuple[float, float, float] | None:
        """Return the position, m, of a level body whose gear is at the target's centre, for the
        estimated heading `yaw_rad`; None before the target's position is known."""
        if self.target is None:
            return None
        way_m = rot_z(yaw_rad + self.off.yaw_rad).dot(self._setup.gear_body_m)
        x, y, z = self.target.position_m - way_m
        return float(x), float(y), float(z)

    def with_fixed_target(self, seen: TargetEstimate, attitude: VehicleState) -> TargetEstimate:
        """Return `seen` with the target at the position known to the feed, in the world frame of
        the state estimate, for a vehicle with this `attitude`; unchanged while that position is
        unknown."""
        if self.target is None:
            return seen
        world_m = self.target.position_m - self.off.position_m
        world_yaw_rad = wrap_rad(self.target.yaw_rad - self.off.yaw_rad)
        e_m, e_yaw_rad = target_world_to_level(world_m, world_yaw_rad, attitude, self._setup)
        return replace(
            seen, e_m=e_m, e_yaw_rad=e_yaw_rad, world_m=world_m, world_yaw_rad=world_yaw_rad
        )

    def add_pose(
        self,
        pose: MarkerPose,
        then: VehicleState,
        now: VehicleState,
        now_s: float,
        *,
        at_rest: bool,
    ) -> None:
        """Send the vehicle's position, computed from a pose in this tick's image. While the
        target's position is unknown, send nothing, and determine the target's position if the
        vehicle is `at_rest`. `then` and `now` are the vehicle's attitude and estimated position at
        the exposure and at `now_s`."""
        if pose.t_s <= self._seen_s:
            return
        # A position that was sent without an image may be newer than this image's exposure.
        silent_s = max(0.0, min(pose.t_s - max(self._seen_s, self._placed_s), GATE_LONGEST_S))
        if self.target is None:
            self._seen_s = pose.t_s
            if at_rest:
                self._learn_place(pose, then)
            return
        place = body_place(pose, then, self.target, self._setup)
        self._refusal = self._refused(pose, place, then, silent_s, now_s)
        if self._refusal:
            return
        self._learn_off(pose, place, then)
        self._seen_s = pose.t_s
        moved_m = np.subtract(now.position_m, then.position_m)
        x, y, z = (float(v) for v in place.position_m + moved_m)
        quaternion = None
        if self._config.send == "pose":
            yaw_rad = wrap_rad(place.yaw_rad + now.yaw_rad - then.yaw_rad)
            quaternion = quaternion_from_rpy(now.roll_rad, now.pitch_rad, yaw_rad)
        self._hand_over(ExternalPosition((x, y, z), quaternion), pose.t_s, now_s)

    def status(self, now_s: float) -> FeedStatus:
        """Return the feed's status. Its `problem` is also set while the target has not been seen
        from the ground."""
        age_s = now_s - self._placed_s
        stale = age_s > self._config.hold_s
        problem = self._refusal or UNSEEN if stale or self.target is None else None
        return FeedStatus(
            age_s=age_s,
            problem=problem,
            sent=self._rate.count,
            pose=self._pose,
            rate_hz=self._rate.sent_hz(now_s),
            measured=self._pose,
            beside_m=self._beside_m,
        )

    def _refused(
        self, pose: MarkerPose, place: Place, then: VehicleState, silent_s: float, now_s: float
    ) -> str:
        """Return why a sighting is rejected; an empty string if it is accepted."""
        age_s, sigma_m = now_s - pose.t_s, float(np.max(pose.sigma_m))
        self._beside_m = 0.0
        if not age_s <= OLDEST_S:
            return f"the picture is {age_s:.2f} s old"
        if not sigma_m <= WORST_SIGMA_M:
            return f"the target's pose is uncertain by {sigma_m:.2f} m"
        off_m = float(np.linalg.norm(place.position_m - then.position_m))
        if not off_m <= GATE_M + GATE_MPS * silent_s + GATE_SIGMAS * sigma_m:
            self._beside_m = off_m
            return f"the target places the vehicle {off_m:.2f} m from its estimated position"
        return ""

    def _learn_place(self, pose: MarkerPose, then: VehicleState) -> None:
        """Learn the target's position from the frames since the estimate has settled. Without
        external positions, the estimate drifts; correcting it with the first ones tilts its
        attitude for about a second."""
        settled = [each for each in self._on_ground if _is_settled(each[0], then)]
        self._on_ground = [*settled, (then, target_place(pose, then, self._setup))]
        if len(self._on_ground) < GROUND_FRAMES:
            return
        places = [place for _, place in self._on_ground]
        first_rad = places[0].yaw_rad
        turns_rad = [wrap_rad(place.yaw_rad - first_rad) for place in places]
        position_m = np.median([place.position_m for place in places], axis=0)
        self.target = Place(position_m, wrap_rad(first_rad + float(np.median(turns_rad))))

    def _learn_off(self, pose: MarkerPose, place: Place, then: VehicleState) -> None:
        away = (float(np.linalg.norm(pose.e_m)) - LEARN_NEAR_M) / (LEARN_FAR_M - LEARN_NEAR_M)
        lasts_s = LEARN_NEAR_S + min(max(away, 0.0), 1.0) * (LEARN_FAR_S - LEARN_NEAR_S)
        share = 1.0 - math.exp(-min(max(pose.t_s - self._seen_s, 0.0), 0.5) / lasts_s)
        off_m, off_rad = self.off.position_m, self.off.yaw_rad
        beside_m = place.position_m - np.asarray(then.position_m)
        beside_rad = wrap_rad(place.yaw_rad - then.yaw_rad)
        self.off = Place(
            off_m + share * (beside_m - off_m), off_rad + share * wrap_rad(beside_rad - off_rad)
        )

    def _hand_over(self, place: ExternalPosition, placed_s: float, now_s: float) -> None:
        """Send a position and heading; `placed_s` is the time at which the body was there. If no
        position is due yet, this one is dropped, because the next one will be newer."""
        if self._rate.is_due(now_s) and self._send(place) is not False:
            self._rate.note_sent(now_s)
            self._placed_s, self._pose = placed_s, place
