"""Pass one frame's poses through the gate and into the filters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perchctl.geometry import Array, is_finite, wrap_rad
from perchctl.values import cached_property, replace
from perchctl.vision.filter import (
    MAX_FRAME_GAP_TO_CONTINUE_TRACK_S,
    MEASURED_STATE_ELEMENTS,
    POSITION_STATE_ELEMENTS,
    FilterSetup,
    TrackMeasurement,
    predict_track,
    start_track,
    step_track,
)
from perchctl.vision.lens import project
from perchctl.vision.markers.cut import make_coarse_lattice
from perchctl.vision.pose import PoseCandidate, PoseSetup, rotation_matrix, rotation_vector
from perchctl.vision.target_selection import (
    ExpectedOwnTargetPosition,
    make_track_measurement,
    other_vehicles_target_message,
)
from perchctl.vision.types import (
    FrameMarkerPoses,
    LastAcceptedPose,
    MarkerFilterState,
    MarkerName,
    MarkerPose,
    PipelineState,
    RivalTargetState,
    TargetBearingPredictionErrors,
    TargetLockState,
    VehicleState,
)


@dataclass(frozen=True, eq=False)
class TrackSetup:
    """Parameters for updating tracks: the filters for the level and the world frame, the pose
    estimation, and the position of the vehicle's own target. If `is_innovation_gate_enabled` is
    True, poses that do not fit the tracked target are rejected."""

    level_frame_filter: FilterSetup
    world_frame_filter: FilterSetup
    pose_setup: PoseSetup
    is_innovation_gate_enabled: bool
    own_target: ExpectedOwnTargetPosition

    def select_filter(self, is_in_world_frame: bool) -> FilterSetup:
        """Return the filter parameters for the world frame (if `is_in_world_frame`) or for the
        level frame."""
        return self.world_frame_filter if is_in_world_frame else self.level_frame_filter


@dataclass(frozen=True, eq=False)
class TrackUpdateResult:
    """Result of updating the tracks with one frame: the tracks by name (``joint``, or ``large`` and
    ``small``), the tracked target (`lock`), a competing target-like pattern (`rival`), and whether
    the frame's pose was accepted as a pose of the tracked target (`verdict`). Lock and rival are
    None if there is none.

    `marker_poses` are the frame's poses; its `poses_by_updated_track` is empty if the pose was
    rejected.
    """

    marker_poses: FrameMarkerPoses
    tracks: dict[str, MarkerFilterState]
    verdict: GateVerdict
    lock: TargetLockState | None = None
    rival: RivalTargetState | None = None


def update_tracks(
    state: PipelineState,
    marker_poses: FrameMarkerPoses,
    t_s: float,
    attitude: VehicleState | None,
    is_in_world_frame: bool,
    setup: TrackSetup,
) -> TrackUpdateResult:
    """Update the tracks, which are the Kalman filters of the target, with the poses of one frame,
    `marker_poses`. The gate (`judge_pose`) decides from the most certain pose whether the frame
    shows the locked target, which is the one that perchctl follows (`state.lock`). It accepts
    either all poses or none. Without accepted poses, the tracks are only predicted to `t_s`, the
    time of the frame. `attitude` is the vehicle's state at this time; None if unknown.

    The tracks start over if the gate restarts them, or if `is_in_world_frame`, which selects the
    world or the level frame, has changed since the last frame. If no target is locked, or if the
    lock would change to another position, a pose that shows another vehicle's target is also
    rejected. If the gate is disabled, all other poses are accepted, and the result has no lock and
    no rival.
    """
    filter_setup = setup.select_filter(is_in_world_frame)
    measurements = {
        name: make_track_measurement(
            pose, attitude, is_in_world_frame, filter_setup, setup.pose_setup
        )
        for name, pose in marker_poses.poses_by_updated_track.items()
    }
    old = state.tracks if state.are_tracks_in_world_frame == is_in_world_frame else {}
    frame_pose, verdict = None, GateVerdict(is_accepted=True, rival=state.rival)
    pose = marker_poses.most_certain_pose
    if measurements and pose is not None:
        name = next(n for n, each in marker_poses.poses_by_updated_track.items() if each is pose)
        whole = pose.source == "joint" or (
            len(marker_poses.poses_by_source) > 1 and not marker_poses.do_markers_contradict
        )
        frame_pose = FramePose(
            t_s,
            pose,
            measurements[name],
            is_in_world_frame,
            whole,
            is_attitude_unknown=attitude is None,
        )
        if state.rival is not None and state.lock is not None and attitude is not None:
            place_m = state.lock.track.x[POSITION_STATE_ELEMENTS]
            looks = not is_in_world_frame or is_in_view(place_m, attitude, setup.pose_setup)
            frame_pose = replace(frame_pose, is_locked_target_in_view=looks)
        if setup.is_innovation_gate_enabled:
            verdict = judge_pose(state.lock, state.rival, frame_pose, filter_setup)
        # A locked target stays locked, no matter how far the estimate's world frame has drifted
        # meanwhile.
        goes_on = not verdict.restarts_track or verdict.keeps_lock_at_restart
        goes_on = goes_on and drop_expired_lock_and_rival(state.lock, None, t_s)[0] is not None
        another = (
            None
            if goes_on
            else other_vehicles_target_message(pose, attitude, setup.own_target, setup.pose_setup)
        )
        if another is not None and verdict.is_accepted:
            verdict = GateVerdict(
                False, rival=state.rival, reason=another, is_other_vehicles_target=True
            )
    if not verdict.is_accepted:
        marker_poses, measurements = replace(marker_poses, poses_by_updated_track={}), {}
    begun = {} if verdict.restarts_track else old
    stepped = {
        n: step_track(begun.get(n), measurements.get(n), t_s, filter_setup)
        for n in {**begun, **measurements}
    }
    tracks = {n: track for n, track in stepped.items() if track is not None}
    if not setup.is_innovation_gate_enabled:
        return TrackUpdateResult(marker_poses, tracks, verdict)
    lock, rival = drop_expired_lock_and_rival(state.lock, verdict.rival, t_s)
    if frame_pose is not None and verdict.is_accepted and tracks:
        most_certain = min(tracks.values(), key=lambda t: (t.unseen_frames, float(np.trace(t.P))))
        lock = update_lock(lock, most_certain, frame_pose, verdict)
    return TrackUpdateResult(marker_poses, tracks, verdict, lock, rival)


# --- Gate: does a pose belong to the locked target? ---
# An image cannot distinguish another target, or a marker of another size, from the target, but the
# target does not jump. A pose that contradicts the lock by more than noise, motion and drift can
# explain belongs to a rival and updates no filter.
#
# The lock changes to a rival that is seen with both markers. The change is immediate if the locked
# target was never seen with both markers. Otherwise, the lock changes if the rival and the target
# are equally far away and the target was not seen for `MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S`
# although its position is in the image. If the lock has only a few frames, it changes to any rival
# that was seen more often.
#
# If the camera is not on a vehicle, neither its motion nor the number of frames missing from a
# recording is known, so a rival is most likely the target from a different viewpoint. The lock then
# changes when only the rival has been seen for `MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S`,
# if the rival shows both markers or if the locked target never did. A rival that was seen before
# the target was lost is a second target, and the lock only changes to it after
# `MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S`.
#
# While a rival is seen and the target is not, the target's predicted position may be wrong, so its
# covariance also covers the rival's position.
#
# A pose that passes the gate may still be wrong. If the next pose fits the track before that pose,
# but not the current track, the track restarts at the next pose.
#
# While something is seen at the position of the locked target, the search continues there and
# ignores a complete target elsewhere. If the state estimate jumps, the target seems to jump in the
# world, but not in the image.


MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S, MIN_BOTH_MARKER_FRAMES_TO_LOCK_RIVAL = 3.0, 30
"""Time, s, and number of frames with both markers after which the lock changes to a rival. Smaller:
another target captures the lock."""
MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S = 0.3
"""Time, s, for which a camera without a vehicle must see only the rival before the lock changes to
it. Larger: after lost frames, a recording has no target for longer. Smaller: fewer successive wrong
frames are enough to capture the lock."""
UNSEEN_TARGET_LOCK_TIMEOUT_S = 10.0
"""Time after which a lock in the world frame expires if the target is not seen, s."""
MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK = 5
"""If a lock has fewer frames than this, it yields to a rival that was seen more often."""

_ESTIMATE_JUMPED_TEXT = "the state estimate jumped, but the target did not"
_PREVIOUS_POSE_WRONG_TEXT = (
    "the target is where it was expected before the previous pose, which may have been wrong"
)
# With four dimensions, 5 in 100 000 squared distances exceed it by chance.
_MAX_INNOVATION_CHI2_TO_ACCEPT_POSE = 25.0
_MAX_RIVAL_RANGE_DIFFERENCE_TO_COUNT_AS_EQUAL_SIGMAS = 4.0
# Errors that no covariance includes (calibration, print, latency): constants and fractions of the
# range.
_UNMODELLED_POSE_POSITION_SIGMA_AT_ZERO_RANGE_M, _UNMODELLED_POSE_YAW_SIGMA_RAD = (
    0.01,
    math.radians(4.0),
)
_UNMODELLED_POSE_XY_SIGMA_PER_RANGE, _UNMODELLED_POSE_Z_SIGMA_PER_RANGE = 0.015, 0.02
_YAW_XYZ_POSITION_SELECTION_MATRIX: Array = np.diag([0.0, 1.0, 1.0, 1.0])
# The message about a rival mentions the rival's rotation if it is larger than this angle.
_MIN_RIVAL_ROTATION_TO_REPORT_RAD = math.radians(15.0)
# A jump of the state estimate is only looked for if the target was seen at most this long ago.
# Since then, a hovering vehicle has moved relative to the target with these standard deviations of
# speed and rotation rate.
(
    _MAX_UNSEEN_TIME_TO_DETECT_ESTIMATE_JUMP_S,
    _HOVER_SPEED_SIGMA_MPS,
    _HOVER_ROTATION_RATE_SIGMA_RADPS,
) = 0.35, 0.3, 0.5
# A jump of the state estimate, or a wrong last pose, is accepted as an explanation if it reduces
# the squared innovation to less than this fraction of its value.
_MAX_ALTERNATIVE_TO_CURRENT_CHI2_RATIO_TO_RESTART_TRACK = 0.25


@dataclass(frozen=True, eq=False)
class FramePose:
    """A frame's most certain pose, and the filter measurement made from it, which is in the world
    frame of the state estimate if `is_in_world_frame` is True, otherwise relative to the gear in
    the level frame. `t_s` is the time of the frame.

    `has_both_markers` is True if the frame shows both markers and they do not contradict each
    other. `is_locked_target_in_view` is False only if the position where the locked target is
    expected is known to be outside the image. `is_attitude_unknown` is True if there is no state
    estimate for this frame, as with a camera without a vehicle.
    """

    t_s: float
    pose: MarkerPose
    measurement: TrackMeasurement
    is_in_world_frame: bool
    has_both_markers: bool
    is_locked_target_in_view: bool = True
    is_attitude_unknown: bool = False


@dataclass(frozen=True, eq=False)
class GateVerdict:
    """The gate's decision on a pose: whether it is accepted as a pose of the target, and whether
    the tracks restart at this pose (`restarts_track`). At a restart, `keeps_lock_at_restart` is
    True if the pose still belongs to the target that was followed so far, and False if another
    target-like pattern (the rival) replaces it.

    `rival` is the track of a pattern whose position contradicts the target's, after this frame;
    None if there is none. `reason` explains a rejection or a restart, and is otherwise empty.
    """

    is_accepted: bool
    restarts_track: bool = False
    keeps_lock_at_restart: bool = False
    rival: RivalTargetState | None = None
    reason: str = ""
    is_other_vehicles_target: bool = False  # True if another vehicle's target is at this position


def judge_pose(
    lock: TargetLockState | None,
    rival: RivalTargetState | None,
    frame_pose: FramePose,
    filter_setup: FilterSetup,
) -> GateVerdict:
    """Decide whether a frame's pose belongs to the tracked target (`lock`), to a competing
    target-like pattern (`rival`), or to neither, in which case it starts a new rival. Lock and
    rival are None if there is none. Every pose is accepted if there is no lock, or if the lock is
    in another frame (level or world) than the pose. A pose that is not newer than the lock is
    rejected.

    A pose belongs to a track if its squared Mahalanobis distance from the track's prediction, with
    four degrees of freedom, is at most 25 (`_MAX_INNOVATION_CHI2_TO_ACCEPT_POSE`), and to the
    likelier of two such tracks. A pose that fits neither track is still accepted, and the track
    restarts, if the state estimate has jumped or the previous pose was wrong. A rival's pose is
    accepted, and the track restarts at the rival, if the evidence for the rival is strong enough to
    replace the target (`_is_rival_accepted_as_target`).
    """
    lock, rival = drop_expired_lock_and_rival(lock, rival, frame_pose.t_s)
    if rival is not None and rival.is_in_world_frame != frame_pose.is_in_world_frame:
        rival = None
    if lock is None or lock.is_in_world_frame != frame_pose.is_in_world_frame:
        return GateVerdict(is_accepted=True)
    if frame_pose.t_s <= lock.track.t_s:  # the tracks are already newer than this frame
        return GateVerdict(is_accepted=False, rival=rival)
    if rival is None and _is_pose_clearly_consistent(lock.track, frame_pose, filter_setup):
        return GateVerdict(is_accepted=True)
    innovation = _compute_innovation(lock.track, frame_pose, filter_setup)
    rival_misfit = (
        None if rival is None else _compute_innovation(rival.track, frame_pose, filter_setup)
    )
    theirs = (
        rival_misfit is not None
        and rival_misfit.squared_mahalanobis <= _MAX_INNOVATION_CHI2_TO_ACCEPT_POSE
    )
    if innovation.squared_mahalanobis <= _MAX_INNOVATION_CHI2_TO_ACCEPT_POSE and not (
        theirs
        and rival_misfit is not None
        and rival_misfit.log_likelihood_cost < innovation.log_likelihood_cost
    ):
        return GateVerdict(is_accepted=True, rival=rival)
    if not theirs and _has_state_estimate_jumped(lock, frame_pose, innovation.yaw_xyz):
        return GateVerdict(
            is_accepted=True,
            restarts_track=True,
            keeps_lock_at_restart=True,
            reason=_ESTIMATE_JUMPED_TEXT,
        )
    if not theirs and _was_previous_pose_wrong(lock, frame_pose, innovation.yaw_xyz, filter_setup):
        return GateVerdict(
            is_accepted=True,
            restarts_track=True,
            keeps_lock_at_restart=True,
            reason=_PREVIOUS_POSE_WRONG_TEXT,
        )
    seen = _update_rival(rival if theirs else None, frame_pose, innovation, filter_setup)
    if _is_rival_accepted_as_target(lock, seen, frame_pose):
        text = f"target reacquired {innovation.distance_m:.2f} m from its expected position"
        return GateVerdict(is_accepted=True, restarts_track=True, reason=text)
    return GateVerdict(
        is_accepted=False,
        rival=seen,
        reason=f"not the tracked target: {seen.position_relative_to_target_text}",
    )


def drop_expired_lock_and_rival(
    lock: TargetLockState | None, rival: RivalTargetState | None, t_s: float
) -> tuple[TargetLockState | None, RivalTargetState | None]:
    """Return the lock (the target that is followed) and the rival (a similar pattern at a position
    that contradicts the target's), each replaced by None if it has expired at `t_s`.

    A rival expires if it was not seen for `MAX_FRAME_GAP_TO_CONTINUE_TRACK_S` (1 s). A lock in the
    level frame expires after the same time if there is no rival. Any other lock expires if its
    target was not seen for `UNSEEN_TARGET_LOCK_TIMEOUT_S` (10 s). Without a lock, the rival is
    dropped too, and both are dropped if `t_s` is more than `MAX_FRAME_GAP_TO_CONTINUE_TRACK_S`
    before the lock's time because the clock was set back.
    """
    if rival is not None and not 0.0 <= t_s - rival.track.t_s <= MAX_FRAME_GAP_TO_CONTINUE_TRACK_S:
        rival = None
    if lock is None:
        return None, None
    age_s = t_s - lock.track.t_s
    # A position in the level frame expires soon, unless there is a rival.
    lasting = lock.is_in_world_frame or rival is not None
    # If the clock was set back, earlier tracks can no longer be confirmed.
    if age_s < -MAX_FRAME_GAP_TO_CONTINUE_TRACK_S or age_s > (
        UNSEEN_TARGET_LOCK_TIMEOUT_S if lasting else MAX_FRAME_GAP_TO_CONTINUE_TRACK_S
    ):
        return None, None
    return lock, rival


def predict_rival_state(
    lock: TargetLockState | None,
    rival: RivalTargetState | None,
    is_in_world_frame: bool,
    t_s: float,
    filter_setup: FilterSetup,
) -> Array | None:
    """Return the state of the rival, a target-like pattern whose position contradicts the locked
    target's, predicted to `t_s`: yaw, yaw rate, then position and velocity of x, y, z, (8,), in SI
    units. The caller widens the target's covariance to cover this state, because the target may be
    at either position.

    Returns None if there is no lock or no rival, if the target was seen at least as recently as the
    rival, or if lock and rival are not both in the frame of the tracks: the world frame (if
    `is_in_world_frame`) or the level frame.
    """
    if (
        lock is None
        or rival is None
        or not lock.is_in_world_frame == rival.is_in_world_frame == is_in_world_frame
    ):
        return None
    if rival.track.t_s <= lock.track.t_s:
        return None
    return predict_track(rival.track, t_s, filter_setup).x


def update_lock(
    lock: TargetLockState | None,
    track: MarkerFilterState,
    frame_pose: FramePose,
    verdict: GateVerdict,
) -> TargetLockState:
    """Return the updated lock, the record of the target that is followed, after the gate has
    accepted `frame_pose`. `track` is the track that this pose has updated.

    The count of accepted frames goes on, and the lock remembers whether both markers were ever
    seen, and its previous track. If there was no lock, if the track has restarted at another
    pattern, or if the frame of the tracks (level or world) has changed, a new lock begins without
    this history.
    """
    anew = verdict.restarts_track and not verdict.keeps_lock_at_restart
    before = (
        None
        if lock is None or anew or lock.is_in_world_frame != frame_pose.is_in_world_frame
        else lock
    )
    return TargetLockState(
        track=track,
        last_pose=frame_pose.pose,
        is_in_world_frame=frame_pose.is_in_world_frame,
        accepted_frame_count=1 if before is None else before.accepted_frame_count + 1,
        has_shown_both_markers=frame_pose.has_both_markers
        or (before is not None and before.has_shown_both_markers),
        track_before_last_pose=None if before is None else before.track,
    )


# --- How well a pose fits ---


@dataclass(frozen=True, eq=False)
class _Innovation:
    """Innovation of a pose: `yaw_xyz` (4,) is the measured minus the predicted (yaw, x, y, z), rad
    and m, in the track's frame (level or world), and `S` (4, 4) is its covariance."""

    yaw_xyz: Array
    S: Array

    @cached_property
    def squared_mahalanobis(self) -> float:
        return float(self.yaw_xyz @ np.linalg.solve(self.S, self.yaw_xyz))

    @property
    def log_likelihood_cost(self) -> float:
        """Twice the negative log likelihood of the innovation without its constant: the squared
        Mahalanobis distance plus the logarithm of the determinant of `S`. Of two tracks, a pose
        more likely belongs to the one with the smaller cost."""
        return self.squared_mahalanobis + float(np.linalg.slogdet(self.S)[1])

    @property
    def distance_m(self) -> float:
        return float(np.linalg.norm(self.yaw_xyz[1:]))


def _compute_innovation(
    track: MarkerFilterState, frame_pose: FramePose, filter_setup: FilterSetup
) -> _Innovation:
    wanted, measurement = predict_track(track, frame_pose.t_s, filter_setup), frame_pose.measurement
    # The maximum drift is assumed to be three standard deviations.
    drift_m = (
        min(filter_setup.max_predicted_target_speed_mps, 1.0)
        / 3.0
        * max(frame_pose.t_s - track.t_s, 0.0)
    )
    residual = measurement.z - wanted.x[MEASURED_STATE_ELEMENTS]
    residual[0] = wrap_rad(float(residual[0]))
    # A bias shifts the measurement and the prediction alike, so only the difference of the shifts
    # counts.
    error_shifts = (
        wanted.state_shift_per_bias_sigma[MEASURED_STATE_ELEMENTS]
        if measurement.yaw_xyz_shift_per_bias_sigma is None
        else measurement.yaw_xyz_shift_per_bias_sigma
        - wanted.state_shift_per_bias_sigma[MEASURED_STATE_ELEMENTS]
    )
    R = filter_setup.R if measurement.R is None else measurement.R
    S = (
        wanted.P[MEASURED_STATE_ELEMENTS, MEASURED_STATE_ELEMENTS]
        + drift_m**2 * _YAW_XYZ_POSITION_SELECTION_MATRIX
        + R
        + error_shifts @ error_shifts.T
    )
    return _Innovation(
        residual, S + np.diag(_unmodelled_yaw_xyz_sigma(_camera_to_target_range_m(frame_pose)) ** 2)
    )


def _is_pose_clearly_consistent(
    track: MarkerFilterState, frame_pose: FramePose, filter_setup: FilterSetup
) -> bool:
    """True if the difference between the pose and the track's prediction is so small that the
    unmodelled errors of lens, print and latency alone explain it, as in most frames. The pose then
    fits the track, and no covariance has to be computed. If False, the pose may still fit, and the
    full check with the covariance decides."""
    wanted = predict_track(track, frame_pose.t_s, filter_setup)
    residual = frame_pose.measurement.z - wanted.x[MEASURED_STATE_ELEMENTS]
    residual[0] = wrap_rad(float(residual[0]))
    residual /= _unmodelled_yaw_xyz_sigma(_camera_to_target_range_m(frame_pose))
    return float(residual @ residual) <= _MAX_INNOVATION_CHI2_TO_ACCEPT_POSE


def _camera_to_target_range_m(frame_pose: FramePose) -> float:
    return math.hypot(*frame_pose.pose.tvec_m.tolist())


def _unmodelled_yaw_xyz_sigma(range_m: float) -> Array:
    """Return the standard deviations (4,) of (yaw, x, y, z), rad and m, due to errors that no
    covariance includes (calibration, print, latency). The values of x, y and z grow linearly with
    `range_m`, the distance from the camera to the target."""
    sideways_m, along_m = (
        _UNMODELLED_POSE_POSITION_SIGMA_AT_ZERO_RANGE_M
        + _UNMODELLED_POSE_XY_SIGMA_PER_RANGE * range_m,
        _UNMODELLED_POSE_POSITION_SIGMA_AT_ZERO_RANGE_M
        + _UNMODELLED_POSE_Z_SIGMA_PER_RANGE * range_m,
    )
    return np.array([_UNMODELLED_POSE_YAW_SIGMA_RAD, sideways_m, sideways_m, along_m])


def _has_state_estimate_jumped(
    lock: TargetLockState, frame_pose: FramePose, world_innovation_yaw_xyz: Array
) -> bool:
    """True if the state estimate has jumped: relative to the gear, the target is where the vehicle
    last saw it, but in the world frame, it is not where its track predicts it. The change of the
    pose relative to the gear is then small enough for a hovering vehicle and much smaller than
    `world_innovation_yaw_xyz` (4,), which is measured minus predicted (yaw, x, y, z) in the world,
    rad and m. Always False if the track is in the level frame, or if the target was last seen more
    than `_MAX_UNSEEN_TIME_TO_DETECT_ESTIMATE_JUMP_S` (0.35 s) ago."""
    dt_s = frame_pose.t_s - lock.track.t_s
    if not frame_pose.is_in_world_frame or dt_s > _MAX_UNSEEN_TIME_TO_DETECT_ESTIMATE_JUMP_S:
        return False
    range_m = _camera_to_target_range_m(frame_pose)
    residual = np.array(
        [wrap_rad(frame_pose.pose.e_yaw_rad - lock.last_pose.e_yaw_rad), 0.0, 0.0, 0.0]
    )
    residual[1:] = frame_pose.pose.e_m - lock.last_pose.e_m
    moved_m = math.hypot(_HOVER_SPEED_SIGMA_MPS, _HOVER_ROTATION_RATE_SIGMA_RADPS * range_m) * dt_s
    moved = np.array([_HOVER_ROTATION_RATE_SIGMA_RADPS * dt_s, moved_m, moved_m, moved_m])
    unclaimed = _unmodelled_yaw_xyz_sigma(range_m)
    seen, jumped = (
        float(((o / unclaimed) ** 2).sum()) for o in (residual, world_innovation_yaw_xyz)
    )
    calm = (
        float((residual * residual / (unclaimed**2 + moved * moved)).sum())
        <= _MAX_INNOVATION_CHI2_TO_ACCEPT_POSE
    )
    return calm and seen < _MAX_ALTERNATIVE_TO_CURRENT_CHI2_RATIO_TO_RESTART_TRACK * jumped


def _was_previous_pose_wrong(
    lock: TargetLockState,
    frame_pose: FramePose,
    innovation_yaw_xyz: Array,
    filter_setup: FilterSetup,
) -> bool:
    """True if the last accepted pose was most likely wrong: the new pose fits the track without the
    last accepted pose much better than it fits the current track. At a low frame rate, a single
    wrong pose can pass the gate and corrupt the velocity of a track from a camera without a
    vehicle. `innovation_yaw_xyz` (4,) is measured minus predicted (yaw, x, y, z) for the current
    track, rad and m. Always False in the world frame."""
    if lock.track_before_last_pose is None or frame_pose.is_in_world_frame:
        return False
    innovation, unclaimed = (
        _compute_innovation(lock.track_before_last_pose, frame_pose, filter_setup),
        _unmodelled_yaw_xyz_sigma(_camera_to_target_range_m(frame_pose)),
    )
    before, now = (
        float(((o / unclaimed) ** 2).sum()) for o in (innovation.yaw_xyz, innovation_yaw_xyz)
    )
    return (
        innovation.squared_mahalanobis <= _MAX_INNOVATION_CHI2_TO_ACCEPT_POSE
        and before < _MAX_ALTERNATIVE_TO_CURRENT_CHI2_RATIO_TO_RESTART_TRACK * now
    )


# --- Rivals ---


def _update_rival(
    previous_rival: RivalTargetState | None,
    frame_pose: FramePose,
    innovation: _Innovation,
    filter_setup: FilterSetup,
) -> RivalTargetState:
    if previous_rival is not None:
        track = step_track(
            previous_rival.track, frame_pose.measurement, frame_pose.t_s, filter_setup
        )
        assert track is not None
        whole = previous_rival.frames_with_both_markers + int(frame_pose.has_both_markers)
        return replace(
            previous_rival,
            track=track,
            seen_frame_count=previous_rival.seen_frame_count + 1,
            frames_with_both_markers=whole,
        )
    turned_rad, farther_m = (
        abs(float(innovation.yaw_xyz[0])),
        float(innovation.yaw_xyz[3]),
    )
    has_different_range_from_target = (
        farther_m** 2
        > _MAX_RIVAL_RANGE_DIFFERENCE_TO_COUNT_AS_EQUAL_SIGMAS** 2 * float(innovation.S[3, 3])
    )
    where = f"{innovation.distance_m:.2f} m away from it"
    if turned_rad > _MIN_RIVAL_ROTATION_TO_REPORT_RAD:
        where += f" and rotated by {math.degrees(turned_rad):.0f} deg"
    if has_different_range_from_target:
        where = f"{abs(farther_m):.2f} m {'above' if farther_m > 0.0 else 'below'} it"
        where += ", or it has another size"
    return RivalTargetState(
        track=start_track(frame_pose.measurement, frame_pose.t_s, filter_setup),
        is_in_world_frame=frame_pose.is_in_world_frame,
        first_seen_at_s=frame_pose.t_s,
        seen_frame_count=1,
        frames_with_both_markers=int(frame_pose.has_both_markers),
        has_different_range_from_target=has_different_range_from_target,
        position_relative_to_target_text=where,
    )


def _is_rival_accepted_as_target(
    lock: TargetLockState, rival: RivalTargetState, frame_pose: FramePose
) -> bool:
    if (
        lock.accepted_frame_count < MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK
        and rival.seen_frame_count > lock.accepted_frame_count
    ):
        return True
    if frame_pose.is_attitude_unknown and _is_rival_likely_target(lock, rival, frame_pose):
        return True
    if (
        rival.frames_with_both_markers < MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK
        or not frame_pose.has_both_markers
    ):
        return False
    if not lock.has_shown_both_markers:
        return True
    unseen_s = frame_pose.t_s - max(rival.first_seen_at_s, lock.track.t_s)
    # A target whose position is outside the image may still be there.
    return (
        (
            frame_pose.is_locked_target_in_view
            or unseen_s >= 2.0 * MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S
        )
        and not rival.has_different_range_from_target
        and rival.frames_with_both_markers >= MIN_BOTH_MARKER_FRAMES_TO_LOCK_RIVAL
        and unseen_s >= MIN_TARGET_UNSEEN_TIME_TO_LOCK_RIVAL_S
    )


def _is_rival_likely_target(
    lock: TargetLockState, rival: RivalTargetState, frame_pose: FramePose
) -> bool:
    """True if the rival, a target-like pattern whose position contradicts the target's track, is
    most likely the target itself, because the camera moved during lost frames. Only valid for a
    camera without a vehicle.

    The rival must have been seen first no earlier than the target was last seen, and at least
    `MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S` (0.3 s) before this frame. It must have been
    seen in at least `MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK` (5) frames. If the target was ever seen
    with both markers, only frames that show both markers of the rival count, and this frame must
    show both.
    """
    if (
        rival.first_seen_at_s < lock.track.t_s
        or frame_pose.t_s - rival.first_seen_at_s < MIN_RIVAL_ALONE_TIME_TO_LOCK_WITHOUT_ATTITUDE_S
    ):
        return False
    if not lock.has_shown_both_markers:
        return rival.seen_frame_count >= MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK
    return (
        frame_pose.has_both_markers
        and rival.frames_with_both_markers >= MIN_FRAMES_TO_ESTABLISH_TARGET_LOCK
    )


# --- Expected position of the target in the next image ---
# The state estimate provides the vehicle's motion in two ways: as the difference of two positions,
# and as velocity times time. Each of the two is weighted by its recent errors, which are measured
# with the images of the target.


# Weight of a new frame in the running mean of the squared errors.
_NEW_BEARING_ERROR_WEIGHT_IN_RUNNING_MEAN = 0.1


def predict_corners(
    last_accepted_pose: LastAcceptedPose | None,
    t_s: float,
    attitude: VehicleState | None,
    setup: PoseSetup,
) -> tuple[dict[MarkerName, Array] | None, PoseCandidate | None]:
    """Predict the corners of both markers and the pose of the target at `t_s` from the last pose
    and the vehicle's motion since then. Returns the corners by marker, each (4, 2) px in the
    distorted image, and the pose in the camera frame. The motion is a weighted mean of two
    estimates, from positions and from velocities; the one with the smaller recent error
    (`LastAcceptedPose.bearing_prediction_errors`) has more weight.

    Returns (None, last pose) if the vehicle's attitude at either time is unknown, and (None,
    predicted pose) if the corners have no finite projection. Returns (None, None) if there is no
    last pose, if it is not before `t_s` or more than `MAX_FRAME_GAP_TO_CONTINUE_TRACK_S` (1 s) old,
    or if the target is predicted to be behind the camera.
    """
    if (
        last_accepted_pose is None
        or not 0.0 < t_s - last_accepted_pose.pose.t_s <= MAX_FRAME_GAP_TO_CONTINUE_TRACK_S
    ):
        return None, None
    pose, then = last_accepted_pose.pose, last_accepted_pose.vehicle_state
    if attitude is None or then is None:
        return None, PoseCandidate(pose.rvec_rad, pose.tvec_m)
    R_then, R_now = _R_world_cam(then, setup), _R_world_cam(attitude, setup)
    by_place, by_speed = last_accepted_pose.bearing_prediction_errors
    share = by_place / (by_place + by_speed) if by_place + by_speed > 0.0 else 0.5
    stepped_m, flown_m = _camera_displacements_m(then, attitude, setup)
    moved_m = stepped_m + share * (flown_m - stepped_m)
    R = R_now.T.dot(R_then)
    tvec = R.dot(pose.tvec_m) - R_now.T.dot(moved_m)
    if tvec[2] <= 0.0:
        return None, None
    rvec = rotation_vector(R.dot(rotation_matrix(pose.rvec_rad)))
    corners = project(setup.marker_corners_m["joint"], rvec, tvec, setup.camera)
    moved = PoseCandidate(rvec, tvec)
    if not is_finite(corners):
        return None, moved
    return {"large": corners[:4], "small": corners[4:]}, moved


def update_last_pose(
    previous: LastAcceptedPose | None,
    pose: MarkerPose,
    attitude: VehicleState | None,
    setup: PoseSetup,
) -> LastAcceptedPose:
    """Return `pose` as the new last pose, with the vehicle's `attitude` at that time (None if
    unknown) and the updated running errors of the vehicle's estimated motion
    (`TargetBearingPredictionErrors`).

    These are mean squared errors, rad^2, of the motion from positions and of the motion from
    velocities. The new error of each is the difference, across the line of sight, between the
    camera's estimated motion since the `previous` pose and its motion measured with the target,
    divided by the distance to the target. The mean errors are 0 if `previous` is None. They stay
    unchanged if an attitude is unknown, or if `previous` is not older than `pose` or more than
    `MAX_FRAME_GAP_TO_CONTINUE_TRACK_S` (1 s) older.
    """
    if previous is None:
        return LastAcceptedPose(pose, attitude)
    then, passed_s = previous.vehicle_state, pose.t_s - previous.pose.t_s
    if attitude is None or then is None or not 0.0 < passed_s <= MAX_FRAME_GAP_TO_CONTINUE_TRACK_S:
        return LastAcceptedPose(pose, attitude, previous.bearing_prediction_errors)
    R = _R_world_cam(attitude, setup)
    seen_m = _R_world_cam(then, setup).dot(previous.pose.tvec_m) - R.dot(pose.tvec_m)
    # Compare the motions only across the line of sight, because the distance of a far target along
    # it is uncertain.
    residual = [
        R.T.dot(displacement_m - seen_m)[:2] / pose.tvec_m[2]
        for displacement_m in _camera_displacements_m(then, attitude, setup)
    ]
    by_place, by_speed = (
        old + _NEW_BEARING_ERROR_WEIGHT_IN_RUNNING_MEAN * (float(new.dot(new)) - old)
        for old, new in zip(previous.bearing_prediction_errors, residual, strict=True)
    )
    return LastAcceptedPose(pose, attitude, TargetBearingPredictionErrors(by_place, by_speed))


def is_in_view(position_world_m: Array, attitude: VehicleState, setup: PoseSetup) -> bool:
    """True if a position (3,), m, in the world frame of the state estimate is in the image of the
    vehicle's camera. `attitude` is the vehicle's attitude and position in this frame; `setup`
    contains the camera and its mounting."""
    R = _R_world_cam(attitude, setup)
    tvec_m = R.T @ (
        position_world_m - attitude.position_m - _vehicle_to_camera_world_m(attitude, setup)
    )
    # Further off the optical axis, a lens model may map points back into the image.
    if (
        tvec_m[2] <= 0.0
        or np.hypot(*tvec_m[:2])
        > make_coarse_lattice(setup.camera).valid_lens_radius_normalised * tvec_m[2]
    ):
        return False
    (at_px,) = project(np.zeros((1, 3)), np.zeros(3), tvec_m, setup.camera)
    return bool((at_px > 0.0).all() and (at_px < np.subtract(setup.camera.size_px, 1)).all())


class _EstimatedCameraDisplacements(NamedTuple):
    """The camera's displacement (3,), m, in the world between two times, computed from the
    difference of the estimated positions, and from velocity times time."""

    from_position_difference_world_m: Array
    from_velocity_world_m: Array


def _camera_displacements_m(
    previous: VehicleState, current: VehicleState, setup: PoseSetup
) -> _EstimatedCameraDisplacements:
    """Return the camera's displacement (3,), m, in world axes from the `previous` to the `current`
    vehicle state, computed both from positions and from the mean of the two velocities. The
    rotation of the vehicle moves the camera too and is part of both. If a velocity is unknown, both
    results come from the positions."""
    turned_m = _vehicle_to_camera_world_m(current, setup) - _vehicle_to_camera_world_m(
        previous, setup
    )
    stepped_m = turned_m + np.subtract(current.position_m, previous.position_m)
    if current.velocity_mps is None or previous.velocity_mps is None:
        return _EstimatedCameraDisplacements(stepped_m, stepped_m)
    half_s = 0.5 * (current.t_s - previous.t_s)
    flown_m = turned_m + half_s * np.add(current.velocity_mps, previous.velocity_mps)
    return _EstimatedCameraDisplacements(stepped_m, flown_m)


def _R_world_cam(attitude: VehicleState, setup: PoseSetup) -> Array:
    R_world_cam: Array = attitude.R_world_body.dot(setup.T_body_cam[:3, :3])
    return R_world_cam


def _vehicle_to_camera_world_m(attitude: VehicleState, setup: PoseSetup) -> Array:
    """Return the vector (3,), m, from the vehicle's origin to the camera, in world axes."""
    ahead_m: Array = attitude.R_world_body.dot(setup.T_body_cam[:3, 3])
    return ahead_m
