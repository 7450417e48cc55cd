"""The two ways from one frame's markers to the target.

`weights` is the paper's (section II-A): a pose and a Kalman filter for each marker, then W.
`joint` solves both markers' corners at once and filters that one pose. A strategy names its
tracks, measures (which poses there are, and which track each feeds) and merges the tracks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from perchctl.geometry import Array, circular_mean
from perchctl.profile import MergeConfig, WeightsConfig
from perchctl.vision.filter import POSITION, VELOCITY, YAW, X, Y, Z
from perchctl.vision.pose import PoseCandidate, PoseSetup, estimate_pose, level_rotation
from perchctl.vision.types import (
    MARKERS,
    Attitude,
    Detection,
    Detections,
    MarkerPose,
    MarkerTrack,
    MeasuredMarkers,
    Stage,
)

CONSISTENT_CHI2 = 4.0
"""Per degree of freedom: below it, both markers' corners fit one pose so well that the two
cannot contradict (that takes four standard deviations)."""
_PLACE_YAW = [X, Y, Z, YAW]
_STAGE_OF = {"joint": Stage.BOTH, "large": Stage.LARGE, "small": Stage.SMALL}


@dataclass(frozen=True, eq=False)
class Merged:
    """The target in the tracks' frame: (x, y, z, yaw), velocity, covariances; `bias_m` (3, 4) is
    what the tracks' `bias` makes of the place."""

    vector: Array
    velocity_mps: Array
    cov_m2: Array
    bias_m: Array
    var_yaw_rad2: float
    unseen: int
    stage: Stage


@dataclass(frozen=True, eq=False)
class MergePrior:
    """What is known before a frame is solved.

    `near` is the target's last pose, moved by the vehicle's motion since; `normal_cam` (3,)
    the target's normal at that last pose, in the camera's axes of then.
    """

    attitude: Attitude | None
    near: PoseCandidate | None
    normal_cam: Array | None


@dataclass(frozen=True, eq=False)
class Weights:
    """The paper's: each marker its pose and its filter, merged by W (equations 5, 8, 12).
    `tracks` are the names of its filters."""

    config: MergeConfig
    pose: PoseSetup
    tracks: tuple[str, ...] = MARKERS

    def measure(self, detections: Detections, prior: MergePrior) -> MeasuredMarkers:
        """Solve each marker's pose, and choose the tracks that they feed."""
        seen = seen_at_once(detections, self.pose)
        singles = _singles(seen, detections.t_s, prior, self.pose, prior.near)
        contradicting = _contradict(singles, self.config)
        fed = _usable(singles, contradicting, prior, self.config, self.pose)
        return MeasuredMarkers(singles, fed, contradicting)

    def merge(
        self, tracks: Mapping[str, MarkerTrack], fed: Mapping[str, MarkerPose]
    ) -> Merged | None:
        """Return the target by the tracks that this frame `fed`, or else by those unseen for the
        shortest time; None without a track."""
        if not tracks:
            return None
        least = min(track.unseen for track in tracks.values())
        used = {name: track for name, track in tracks.items() if track.unseen == least}
        used = {name: track for name, track in used.items() if name in fed} or used
        if len(used) == 1:
            name, track = next(iter(used.items()))
            return _alone(track, fed.get(name))
        large, small = used["large"], used["small"]
        weights = self.config.weights
        order = _PLACE_YAW
        variance = merge_variance(np.diag(large.P)[order], np.diag(small.P)[order], weights)
        w = np.array([weights.x, weights.y, weights.z])
        return Merged(
            vector=merge_pair(large.x[order], small.x[order], weights),
            velocity_mps=w * large.x[VELOCITY] + (1.0 - w) * small.x[VELOCITY],
            cov_m2=np.diag(variance[:3]),
            bias_m=w[:, None] * large.bias[POSITION] + (1.0 - w[:, None]) * small.bias[POSITION],
            var_yaw_rad2=float(variance[3]),
            unseen=least,
            stage=Stage.BOTH if fed else Stage.NONE,
        )


@dataclass(frozen=True, eq=False)
class Joint:
    """Both markers' corners in one solve, one filter; a marker alone feeds the same one."""

    config: MergeConfig
    pose: PoseSetup
    tracks: tuple[str, ...] = ("joint",)

    def measure(self, detections: Detections, prior: MergePrior) -> MeasuredMarkers:
        """Solve both markers at once, and single ones where the frame needs them."""
        seen, t_s = seen_at_once(detections, self.pose), detections.t_s
        joint = None
        if len(seen) == 2:
            joint = estimate_pose(
                seen, t_s, prior.attitude, self.pose, prior.normal_cam, prior.near
            )
        clear = joint is not None and joint.chi2 < CONSISTENT_CHI2
        enough = joint is not None and clear and self.config.stages == "seen"
        # The joint tilt is the surest: the single markers of its frame start from it.
        singles = {}
        if not enough or self.pose.config.each_marker:
            near = prior.near if joint is None else PoseCandidate(joint.rvec_rad, joint.tvec_m)
            singles = _singles(seen, t_s, prior, self.pose, near)
        if joint is None:
            contradicting = _contradict(singles, self.config)
            fed = _usable(singles, contradicting, prior, self.config, self.pose)
            if len(fed) == 2:
                return MeasuredMarkers(
                    singles, {"joint": better_conditioned(fed["large"], fed["small"])}
                )
            return MeasuredMarkers(singles, _as_joint(fed), contradicting)
        poses = {"joint": joint, **singles}
        if enough:
            return MeasuredMarkers(poses, {"joint": joint})
        contradicting = not clear and _contradict(singles, self.config)
        fed = _usable(singles, contradicting, prior, self.config, self.pose)
        return MeasuredMarkers(
            poses, _as_joint(fed) if len(fed) == 1 else {"joint": joint}, contradicting
        )

    def merge(
        self, tracks: Mapping[str, MarkerTrack], fed: Mapping[str, MarkerPose]
    ) -> Merged | None:
        """Return the target by the one track; None without it."""
        return _alone(tracks["joint"], fed.get("joint")) if tracks else None


MergeStrategy = Weights | Joint
"""How poses of both markers become one."""


def _singles(
    seen: list[Detection],
    t_s: float,
    prior: MergePrior,
    setup: PoseSetup,
    start: PoseCandidate | None,
) -> dict[str, MarkerPose]:
    """Solve the pose of each marker that was seen, by its name."""
    found = (estimate_pose([d], t_s, prior.attitude, setup, prior.normal_cam, start) for d in seen)
    return {pose.source: pose for pose in found if pose is not None}


def _contradict(singles: Mapping[str, MarkerPose], config: MergeConfig) -> bool:
    """Return True if there are both markers' poses and they exclude each other."""
    if len(singles) < 2:
        return False
    return disagree(singles["large"], singles["small"], config.disagreement_m)


def _usable(
    singles: Mapping[str, MarkerPose],
    contradicting: bool,
    prior: MergePrior,
    config: MergeConfig,
    setup: PoseSetup,
) -> dict[str, MarkerPose]:
    """Return the single markers' poses that count: of two that contradict the better, else what the
    stage asks for."""
    if len(singles) < 2:
        return dict(singles)
    use = better_conditioned(singles["large"], singles["small"])
    if contradicting:
        return {use.source: use}
    offset = setup.gear_body_m - setup.T_body_cam[:3, 3]
    z_m = float(use.e_m[2] + (level_rotation(prior.attitude) @ offset)[2])
    stage = choose_stage(True, True, z_m, config)
    return dict(singles) if stage is Stage.BOTH else {stage.value: singles[stage.value]}


def _as_joint(fed: Mapping[str, MarkerPose]) -> dict[str, MarkerPose]:
    """Return the one pose that counts as what feeds the joint track."""
    pose = next(iter(fed.values()), None)
    return {} if pose is None else {"joint": pose}


def _alone(track: MarkerTrack, pose: MarkerPose | None) -> Merged:
    """Return the target by one track, and the pose that has fed it in this frame."""
    return Merged(
        vector=track.x[_PLACE_YAW],
        velocity_mps=track.x[VELOCITY],
        cov_m2=track.P[POSITION, POSITION],
        bias_m=track.bias[POSITION],
        var_yaw_rad2=float(track.P[YAW, YAW]),
        unseen=track.unseen,
        stage=Stage.NONE if pose is None else _STAGE_OF[pose.source],
    )


# --- Corners of a rolling shutter at one moment -----------------------
# The rows of such a picture are exposed one after the other within the read-out time, and what
# moves is sheared, stretched or squeezed: at 20 ms and 0.3 m/s by as much as the target moves in
# a few milliseconds. A frame's time is its middle row's. Each corner is moved back along
# its own motion in the picture, by the time that its row was exposed later.


UNKNOWN_READOUT_S = 0.012
"""One standard deviation of a camera's read-out time where nobody has said it."""
FLOW_SIGMA, TURN_SIGMA = 0.05, 0.015
"""Of a motion, along and across, as shares of it: it was measured from the frame before to this
one, and changes."""


def seen_at_once(detections: Detections, setup: PoseSetup) -> list[Detection]:
    """Return the markers with their corners at the frame's own time, as far as their motion is
    known.

    `setup.readout_s` is from a picture's first row to its last; where it is None the corners stay
    where they are, with what a likely read-out would do to them for an error (`common_px`);
    else with what the motion's own error does.
    """
    readout_s, height_px = setup.readout_s, setup.camera.size_px[1]
    if readout_s == 0.0:
        return detections.markers
    late = UNKNOWN_READOUT_S if readout_s is None else readout_s
    out = []
    for d in detections.markers:
        flow = detections.flow_px_s.get(d.marker, detections.velocity_px_s)
        if flow is None:
            out.append(d)
            continue
        # From frame to frame a corner that moves down is also seen later.
        flow = flow / (1.0 + flow[..., 1:] * late / (height_px - 1.0))
        # How much later than the middle row each corner's row is exposed.
        late_s = (d.corners_px[:, 1:] / (height_px - 1.0) - 0.5) * late
        moved_px = flow * late_s
        if readout_s is None:
            out.append(replace(d, common_px=moved_px))
        else:
            turned_px = TURN_SIGMA * float(np.abs(moved_px).max())
            cov_px2 = None if d.cov_px2 is None else d.cov_px2 + turned_px**2 * np.eye(8)
            out.append(
                replace(
                    d,
                    corners_px=d.corners_px - moved_px,
                    sigma_px=float(np.hypot(d.sigma_px, turned_px)),
                    cov_px2=cov_px2,
                    common_px=FLOW_SIGMA * moved_px,
                )
            )
    return out


# --- Merging the two markers into the one pose of the target (paper, section II-A.2) ---


def stage_of(large: bool, small: bool) -> Stage:
    """Return the stage by the markers that are there."""
    if large:
        return Stage.BOTH if small else Stage.LARGE
    return Stage.SMALL if small else Stage.NONE


def choose_stage(large: bool, small: bool, z_m: float | None, config: MergeConfig) -> Stage:
    """Return what to merge: all that is there, or (`merge.stages: range`) what the distance from
    the camera to the target's plane asks for (equations 4, 6 and 11), as far as it is there. Beyond
    z1 the large marker is all that could be seen."""
    there = stage_of(large, small)
    if config.stages == "seen" or there is not Stage.BOTH or z_m is None:
        return there
    if z_m > config.z2_m:
        return Stage.LARGE
    return Stage.BOTH if z_m > config.z3_m else Stage.SMALL


def weight_matrix(weights: WeightsConfig) -> Array:
    """Return W of equation 9, (4, 8), for the vector of equation 7."""
    W = np.zeros((4, 8))
    for row, w in enumerate((weights.x, weights.y, weights.z, weights.yaw)):
        W[row, 2 * row : 2 * row + 2] = w, 1.0 - w
    return W


def merge_pair(large: Array, small: Array, weights: WeightsConfig) -> Array:
    """Merge (x, y, z, yaw) of both markers, each (4,), by equation 8; the yaw on the circle."""
    W = weight_matrix(weights)
    merged = W @ np.stack([large, small], axis=1).ravel()
    merged[3] = circular_mean(W[3, 6:8], np.array([large[3], small[3]]))
    return np.asarray(merged)


def merge_variance(large: Array, small: Array, weights: WeightsConfig) -> Array:
    """Return the variances (4,) of `merge_pair` for markers with independent errors."""
    W = weight_matrix(weights)
    return np.asarray(W**2 @ np.stack([large, small], axis=1).ravel())


def disagree(large: MarkerPose, small: MarkerPose, limit_m: float) -> bool:
    """Return True if the markers contradict: farther apart than the limit and than four standard
    deviations, in any axis (a far small marker is merely vague). What is wrong with the print moves
    both alike, and excuses no gap."""
    gap = np.abs(large.e_m - small.e_m)
    variance = [np.maximum(p.sigma_m**2 - (p.print_m**2).sum(axis=1), 0.0) for p in (large, small)]
    vague = 4.0 * np.sqrt(variance[0] + variance[1])
    return bool((gap > np.maximum(limit_m, vague)).any())


def better_conditioned(large: MarkerPose, small: MarkerPose) -> MarkerPose:
    """Return the better-conditioned of the two poses, by the spread of its position."""
    spread_large, spread_small = (float(np.linalg.norm(p.sigma_m)) for p in (large, small))
    return small if spread_small < spread_large else large
