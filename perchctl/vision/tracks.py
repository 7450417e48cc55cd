"""Pass one frame's poses through the gate and into the filters."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perchctl.geometry import Array, is_finite, wrap_rad
from perchctl.values import cached_property, replace
from perchctl.vision.filter import (
    MAX_TRACK_GAP_S,
    MEASURED,
    POSITION,
    FilterSetup,
    Measurement,
    predict_track,
    start_track,
    step_track,
)
from perchctl.vision.lens import project
from perchctl.vision.markers.cut import make_lattice
from perchctl.vision.pose import PoseCandidate, PoseSetup, rotation_matrix, rotation_vector
from perchctl.vision.target_selection import OwnTargetPosition, refusal_text, track_measurement
from perchctl.vision.types import (
    LastPose,
    MarkerName,
    MarkerPose,
    MarkerTrack,
    MeasuredMarkers,
    MotionErrors,
    PipelineState,
    RivalTrack,
    TargetLock,
    VehicleState,
)


@dataclass(frozen=True, eq=False)
class TrackSetup:
    """Constants of the filters in the level and the world frame and of the pose estimation; whether
    poses that do not fit the tracked target are rejected (`has_gate`); and the position of the
    vehicle's own target."""

    level_filter: FilterSetup
    world_filter: FilterSetup
    pose_setup: PoseSetup
    has_gate: bool
    own_target: OwnTargetPosition

    def select_filter(self, is_in_world_frame: bool) -> FilterSetup:
        """Return the filters' constants in the world or the level frame."""
        return self.world_filter if is_in_world_frame else self.level_filter


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """Tracks after a frame; the target that is followed (`lock`) and a competing target-like
    pattern (`rival`), None if there is none; and whether the pose was accepted as the target's
    (`verdict`, the decision of the gate).

    `measured.poses_by_track` is empty if the gate rejects the frame's pose.
    """

    measured: MeasuredMarkers
    tracks: dict[str, MarkerTrack]
    verdict: GateVerdict
    lock: TargetLock | None = None
    rival: RivalTrack | None = None


def update_tracks(
    state: PipelineState,
    measured: MeasuredMarkers,
    t_s: float,
    attitude: VehicleState | None,
    is_in_world_frame: bool,
    setup: TrackSetup,
) -> TrackedFrame:
    """Return the tracks after a frame, updated with the poses that the gate accepts."""
    filter_setup = setup.select_filter(is_in_world_frame)
    measurements = {
        name: track_measurement(pose, attitude, is_in_world_frame, filter_setup, setup.pose_setup)
        for name, pose in measured.poses_by_track.items()
    }
    old = state.tracks if state.are_tracks_in_world_frame == is_in_world_frame else {}
    frame_pose, verdict = None, GateVerdict(accepted=True, rival=state.rival)
    pose = measured.most_certain_pose
    if measurements and pose is not None:
        name = next(n for n, each in measured.poses_by_track.items() if each is pose)
        whole = pose.source == "joint" or (
            len(measured.poses) > 1 and not measured.are_markers_contradicting
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
            place_m = state.lock.track.x[POSITION]
            looks = not is_in_world_frame or is_in_view(place_m, attitude, setup.pose_setup)
            frame_pose = replace(frame_pose, is_locked_target_in_view=looks)
        if setup.has_gate:
            verdict = judge_pose(state.lock, state.rival, frame_pose, filter_setup)
        # A locked target stays locked, however far the estimate's world frame has drifted
        # meanwhile.
        goes_on = not verdict.restarts_track or verdict.restarts_for_locked_target
        goes_on = goes_on and drop_expired(state.lock, None, t_s)[0] is not None
        another = (
            None if goes_on else refusal_text(pose, attitude, setup.own_target, setup.pose_setup)
        )
        if another is not None and verdict.accepted:
            verdict = GateVerdict(False, rival=state.rival, text=another, is_foreign_target=True)
    if not verdict.accepted:
        measured, measurements = replace(measured, poses_by_track={}), {}
    begun = {} if verdict.restarts_track else old
    stepped = {
        n: step_track(begun.get(n), measurements.get(n), t_s, filter_setup)
        for n in {**begun, **measurements}
    }
    tracks = {n: track for n, track in stepped.items() if track is not None}
    if not setup.has_gate:
        return TrackedFrame(measured, tracks, verdict)
    lock, rival = drop_expired(state.lock, verdict.rival, t_s)
    if frame_pose is not None and verdict.accepted and tracks:
        most_certain = min(tracks.values(), key=lambda t: (t.unseen_frames, float(np.trace(t.P))))
        lock = update_lock(lock, most_certain, frame_pose, verdict)
    return TrackedFrame(measured, tracks, verdict, lock, rival)


# --- Gate: does a pose belong to the locked target? ---
# A picture cannot distinguish another target, or a marker of another size, from the target, but the
# target does not jump. A pose that contradicts the lock by more than noise, motion and drift
# explain belongs to a rival and updates no filter.
#
# The lock changes to a rival seen with both markers: at once if the lock never was; otherwise, if
# both are equally far away, after `REACQUIRE_S` in which the target was not seen although its
# position is in the picture. It changes to any rival that was seen more often than a lock of only a
# few frames.
#
# A camera alone, without a vehicle, knows neither its own motion nor how many frames a recording
# lacks, so a rival is most likely the target from a different viewpoint. The lock then changes
# after `MIN_RIVAL_ONLY_S` in which only the rival was seen, if the rival has both markers or the
# lock never had. A rival that was seen before the target was lost is a second target and waits
# `REACQUIRE_S`.
#
# While a rival is seen and the target is not, the target's predicted position may be wrong, and its
# covariance covers the rival's position, too.
#
# A pose that passes the gate may still be wrong. If the next pose fits the previous track and not
# the present one, the track restarts there.
#
# While something is seen at the lock's position, the search continues there and ignores a complete
# target elsewhere. If the state estimate jumps, the target seems to jump in the world, but not in
# the picture.


REACQUIRE_S, REACQUIRE_FRAMES = 3.0, 30
"""Time, s, and number of frames with both markers after which the lock changes to a rival. Smaller:
another target captures the lock."""
MIN_RIVAL_ONLY_S = 0.3
"""Time for which a camera alone must see only the rival, s. Larger: after lost frames, a recording
has no target for longer. Smaller: fewer wrong frames in succession capture the lock."""
LOCK_TIMEOUT_S = 10.0
"""Time after which a lock in the world frame expires, s."""
ESTABLISHED_FRAMES = 5
"""Number of frames below which a lock yields to a rival that was seen more often."""

_ESTIMATE_JUMPED_TEXT = "the state estimate jumped, the target did not"
_PREVIOUS_POSE_WRONG_TEXT = (
    "the target is where it was expected before the last pose: that pose may have been wrong"
)
_MAX_GATE_CHI2 = 25.0  # squared distance in four dimensions: exceeded by chance in 5 of 100 000
_MAX_SAME_RANGE_SIGMAS = 4.0  # standard deviations
# Errors outside any covariance: calibration, print, latency; plus shares of the range.
_MIN_UNMODELLED_M, _MIN_UNMODELLED_YAW_RAD = 0.01, math.radians(4.0)
_UNMODELLED_ACROSS, _UNMODELLED_ALONG = 0.015, 0.02
_POSITION_AXES: Array = np.diag([0.0, 1.0, 1.0, 1.0])
_MIN_ROTATION_TO_REPORT_RAD = math.radians(15.0)  # a larger rotation is mentioned in the message
# Limits of a hovering vehicle's motion relative to the target during a jump of the estimate.
_MAX_CALM_DURATION_S, _CALM_MPS, _CALM_RADPS = 0.35, 0.3, 0.5
# largest share of the squared misfit that the better of two explanations may leave
_MAX_MISFIT_RATIO_TO_ALTERNATIVE = 0.25


@dataclass(frozen=True, eq=False)
class FramePose:
    """A frame's pose and its measurement for the filter, with whether both markers contributed and
    whether the position of the target that is followed is in the picture
    (`is_locked_target_in_view`). `is_attitude_unknown` is True if the camera is used alone, without
    a vehicle."""

    t_s: float
    pose: MarkerPose
    measured: Measurement
    is_in_world_frame: bool
    has_both_markers: bool
    is_locked_target_in_view: bool = True
    is_attitude_unknown: bool = False


@dataclass(frozen=True, eq=False)
class GateVerdict:
    """The gate's decision on a pose: whether it is accepted as the target's, whether the tracks
    restart at the pose, and whether they restart for the target followed so far
    (`restarts_for_locked_target`) instead of for the rival.

    `rival` is the rival track after this frame; `text` explains a rejection or a restart.
    """

    accepted: bool
    restarts_track: bool = False
    restarts_for_locked_target: bool = False
    rival: RivalTrack | None = None
    text: str = ""
    is_foreign_target: bool = False  # another vehicle's target, by its position


def judge_pose(
    lock: TargetLock | None,
    rival: RivalTrack | None,
    frame_pose: FramePose,
    filter_setup: FilterSetup,
) -> GateVerdict:
    """Decide whether a frame's pose belongs to the target that is followed (`lock`), to a competing
    target-like pattern (`rival`), or to neither, which begins a new rival; lock and rival are None
    if there is none. A pose without a lock is accepted."""
    lock, rival = drop_expired(lock, rival, frame_pose.t_s)
    if rival is not None and rival.is_in_world_frame != frame_pose.is_in_world_frame:
        rival = None
    if lock is None or lock.is_in_world_frame != frame_pose.is_in_world_frame:
        return GateVerdict(accepted=True)
    if frame_pose.t_s <= lock.track.t_s:  # the tracks are newer
        return GateVerdict(accepted=False, rival=rival)
    if rival is None and _is_clearly_consistent(lock.track, frame_pose, filter_setup):
        return GateVerdict(accepted=True)
    misfit = _compute_misfit(lock.track, frame_pose, filter_setup)
    rival_misfit = None if rival is None else _compute_misfit(rival.track, frame_pose, filter_setup)
    theirs = rival_misfit is not None and rival_misfit.squared_mahalanobis <= _MAX_GATE_CHI2
    if misfit.squared_mahalanobis <= _MAX_GATE_CHI2 and not (
        theirs
        and rival_misfit is not None
        and rival_misfit.log_likelihood_cost < misfit.log_likelihood_cost
    ):
        return GateVerdict(accepted=True, rival=rival)
    if not theirs and _matches_last_view(lock, frame_pose, misfit.measured_minus_predicted_yaw_xyz):
        return GateVerdict(
            accepted=True,
            restarts_track=True,
            restarts_for_locked_target=True,
            text=_ESTIMATE_JUMPED_TEXT,
        )
    if not theirs and _matches_previous_track(
        lock, frame_pose, misfit.measured_minus_predicted_yaw_xyz, filter_setup
    ):
        return GateVerdict(
            accepted=True,
            restarts_track=True,
            restarts_for_locked_target=True,
            text=_PREVIOUS_POSE_WRONG_TEXT,
        )
    seen = _update_rival(rival if theirs else None, frame_pose, misfit, filter_setup)
    if _is_rival_accepted(lock, seen, frame_pose):
        text = f"target reacquired {misfit.distance_m:.2f} m from its expected position"
        return GateVerdict(accepted=True, restarts_track=True, text=text)
    return GateVerdict(accepted=False, rival=seen, text=f"not the tracked target: {seen.text}")


def drop_expired(
    lock: TargetLock | None, rival: RivalTrack | None, t_s: float
) -> tuple[TargetLock | None, RivalTrack | None]:
    """Return lock and rival, each replaced by None if it has not been seen for too long at `t_s`: a
    rival, or a lock in the level frame without a rival, for `MAX_TRACK_GAP_S`, any other lock for
    `LOCK_TIMEOUT_S`."""
    if rival is not None and not 0.0 <= t_s - rival.track.t_s <= MAX_TRACK_GAP_S:
        rival = None
    if lock is None:
        return None, None
    age_s = t_s - lock.track.t_s
    # A position in the level frame expires soon, but a rival stays a rival.
    lasting = lock.is_in_world_frame or rival is not None
    # After the clock was set back, no older track can be confirmed.
    if age_s < -MAX_TRACK_GAP_S or age_s > (LOCK_TIMEOUT_S if lasting else MAX_TRACK_GAP_S):
        return None, None
    return lock, rival


def predict_rival_state(
    lock: TargetLock | None,
    rival: RivalTrack | None,
    is_in_world_frame: bool,
    t_s: float,
    filter_setup: FilterSetup,
) -> Array | None:
    """Return the rival's state (8,) at `t_s` if the rival was seen more recently than the locked
    target; otherwise None.

    Until one of the two is confirmed, the target may be at either position.
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
    lock: TargetLock | None, track: MarkerTrack, frame_pose: FramePose, verdict: GateVerdict
) -> TargetLock:
    """Return the lock after the gate accepted `frame_pose`. `track` is the track that this pose
    updated."""
    anew = verdict.restarts_track and not verdict.restarts_for_locked_target
    before = (
        None
        if lock is None or anew or lock.is_in_world_frame != frame_pose.is_in_world_frame
        else lock
    )
    return TargetLock(
        track=track,
        pose=frame_pose.pose,
        is_in_world_frame=frame_pose.is_in_world_frame,
        accepted_frames=1 if before is None else before.accepted_frames + 1,
        has_both_markers=frame_pose.has_both_markers
        or (before is not None and before.has_both_markers),
        track_before_last_pose=None if before is None else before.track,
    )


# --- How well a pose fits ---


@dataclass(frozen=True, eq=False)
class _Misfit:
    """A pose as measured minus its prediction in the track's frame, (yaw, x, y, z), rad and m,
    (4,), and the covariance `S` (4, 4) of that difference."""

    measured_minus_predicted_yaw_xyz: Array
    S: Array

    @cached_property
    def squared_mahalanobis(self) -> float:
        return float(
            self.measured_minus_predicted_yaw_xyz
            @ np.linalg.solve(self.S, self.measured_minus_predicted_yaw_xyz)
        )

    @property
    def log_likelihood_cost(self) -> float:
        """The squared Mahalanobis distance plus a penalty for a larger covariance (twice the
        negative log likelihood, without its constant)."""
        return self.squared_mahalanobis + float(np.linalg.slogdet(self.S)[1])

    @property
    def distance_m(self) -> float:
        return float(np.linalg.norm(self.measured_minus_predicted_yaw_xyz[1:]))


def _compute_misfit(
    track: MarkerTrack, frame_pose: FramePose, filter_setup: FilterSetup
) -> _Misfit:
    wanted, measured = predict_track(track, frame_pose.t_s, filter_setup), frame_pose.measured
    # The largest drift counts as three standard deviations.
    drift_m = (
        min(filter_setup.max_target_speed_mps, 1.0) / 3.0 * max(frame_pose.t_s - track.t_s, 0.0)
    )
    residual = measured.z - wanted.x[MEASURED]
    residual[0] = wrap_rad(float(residual[0]))
    # A constant error shifts both.
    error_shifts = (
        wanted.shift_per_constant_error[MEASURED]
        if measured.shift_per_constant_error is None
        else measured.shift_per_constant_error - wanted.shift_per_constant_error[MEASURED]
    )
    R = filter_setup.R if measured.R is None else measured.R
    S = (
        wanted.P[MEASURED, MEASURED]
        + drift_m**2 * _POSITION_AXES
        + R
        + error_shifts @ error_shifts.T
    )
    return _Misfit(residual, S + np.diag(_unmodelled_yaw_xyz_sigma(_range_m(frame_pose)) ** 2))


def _is_clearly_consistent(
    track: MarkerTrack, frame_pose: FramePose, filter_setup: FilterSetup
) -> bool:
    """True if errors that no covariance models, of lens, print and latency, already explain the
    misfit, as in most frames: a fast check that saves the full one."""
    wanted = predict_track(track, frame_pose.t_s, filter_setup)
    residual = frame_pose.measured.z - wanted.x[MEASURED]
    residual[0] = wrap_rad(float(residual[0]))
    residual /= _unmodelled_yaw_xyz_sigma(_range_m(frame_pose))
    return float(residual @ residual) <= _MAX_GATE_CHI2


def _range_m(frame_pose: FramePose) -> float:
    return math.hypot(*frame_pose.pose.tvec_m.tolist())


def _unmodelled_yaw_xyz_sigma(range_m: float) -> Array:
    """Return the standard deviations of (yaw, x, y, z), rad and m, at a range due to errors that no
    covariance models."""
    sideways_m, along_m = (
        _MIN_UNMODELLED_M + _UNMODELLED_ACROSS * range_m,
        _MIN_UNMODELLED_M + _UNMODELLED_ALONG * range_m,
    )
    return np.array([_MIN_UNMODELLED_YAW_RAD, sideways_m, sideways_m, along_m])


def _matches_last_view(lock: TargetLock, frame_pose: FramePose, world_residual: Array) -> bool:
    """True if the target is where the vehicle saw it last, but not where the world frame predicts
    it: the pose relative to the gear has changed much less than `world_residual` (4,), measured
    minus predicted (yaw, x, y, z) in the world, rad and m. Then the state estimate has jumped."""
    dt_s = frame_pose.t_s - lock.track.t_s
    if not frame_pose.is_in_world_frame or dt_s > _MAX_CALM_DURATION_S:
        return False
    range_m = _range_m(frame_pose)
    residual = np.array([wrap_rad(frame_pose.pose.e_yaw_rad - lock.pose.e_yaw_rad), 0.0, 0.0, 0.0])
    residual[1:] = frame_pose.pose.e_m - lock.pose.e_m
    moved_m = math.hypot(_CALM_MPS, _CALM_RADPS * range_m) * dt_s
    moved = np.array([_CALM_RADPS * dt_s, moved_m, moved_m, moved_m])
    unclaimed = _unmodelled_yaw_xyz_sigma(range_m)
    seen, jumped = (float(((o / unclaimed) ** 2).sum()) for o in (residual, world_residual))
    calm = float((residual * residual / (unclaimed**2 + moved * moved)).sum()) <= _MAX_GATE_CHI2
    return calm and seen < _MAX_MISFIT_RATIO_TO_ALTERNATIVE * jumped


def _matches_previous_track(
    lock: TargetLock, frame_pose: FramePose, residual: Array, filter_setup: FilterSetup
) -> bool:
    """True if the pose fits the track as it was before the last accepted pose much better than the
    present track. The last accepted pose was then most likely wrong: at a low frame rate, a single
    wrong pose may pass the gate and give the track of a camera alone a wrong velocity. `residual`
    (4,) is the pose's distance from the present track."""
    if lock.track_before_last_pose is None or frame_pose.is_in_world_frame:
        return False
    misfit, unclaimed = (
        _compute_misfit(lock.track_before_last_pose, frame_pose, filter_setup),
        _unmodelled_yaw_xyz_sigma(_range_m(frame_pose)),
    )
    before, now = (
        float(((o / unclaimed) ** 2).sum())
        for o in (misfit.measured_minus_predicted_yaw_xyz, residual)
    )
    return (
        misfit.squared_mahalanobis <= _MAX_GATE_CHI2
        and before < _MAX_MISFIT_RATIO_TO_ALTERNATIVE * now
    )


# --- Rivals ---


def _update_rival(
    previous_rival: RivalTrack | None,
    frame_pose: FramePose,
    misfit: _Misfit,
    filter_setup: FilterSetup,
) -> RivalTrack:
    if previous_rival is not None:
        track = step_track(previous_rival.track, frame_pose.measured, frame_pose.t_s, filter_setup)
        assert track is not None
        whole = previous_rival.frames_with_both_markers + int(frame_pose.has_both_markers)
        return replace(
            previous_rival,
            track=track,
            seen_frames=previous_rival.seen_frames + 1,
            frames_with_both_markers=whole,
        )
    turned_rad, farther_m = (
        abs(float(misfit.measured_minus_predicted_yaw_xyz[0])),
        float(misfit.measured_minus_predicted_yaw_xyz[3]),
    )
    has_different_range = farther_m**2 > _MAX_SAME_RANGE_SIGMAS**2 * float(misfit.S[3, 3])
    where = f"{misfit.distance_m:.2f} m away from it"
    if turned_rad > _MIN_ROTATION_TO_REPORT_RAD:
        where += f" and rotated by {math.degrees(turned_rad):.0f} deg"
    if has_different_range:
        where = f"{abs(farther_m):.2f} m {'above' if farther_m > 0.0 else 'below'} it"
        where += ", or it has another size"
    return RivalTrack(
        track=start_track(frame_pose.measured, frame_pose.t_s, filter_setup),
        is_in_world_frame=frame_pose.is_in_world_frame,
        since_s=frame_pose.t_s,
        seen_frames=1,
        frames_with_both_markers=int(frame_pose.has_both_markers),
        has_different_range=has_different_range,
        text=where,
    )


def _is_rival_accepted(lock: TargetLock, rival: RivalTrack, frame_pose: FramePose) -> bool:
    if lock.accepted_frames < ESTABLISHED_FRAMES and rival.seen_frames > lock.accepted_frames:
        return True
    if frame_pose.is_attitude_unknown and _is_rival_likely_target(lock, rival, frame_pose):
        return True
    if rival.frames_with_both_markers < ESTABLISHED_FRAMES or not frame_pose.has_both_markers:
        return False
    if not lock.has_both_markers:
        return True
    unseen_s = frame_pose.t_s - max(rival.since_s, lock.track.t_s)
    # A position outside the picture is not known to be empty.
    return (
        (frame_pose.is_locked_target_in_view or unseen_s >= 2.0 * REACQUIRE_S)
        and not rival.has_different_range
        and rival.frames_with_both_markers >= REACQUIRE_FRAMES
        and unseen_s >= REACQUIRE_S
    )


def _is_rival_likely_target(lock: TargetLock, rival: RivalTrack, frame_pose: FramePose) -> bool:
    """True if the rival is most likely the target itself, and its distance from the track is due to
    the camera's motion during lost frames: only the rival was seen for `MIN_RIVAL_ONLY_S`, since
    after the last sight of the target, in enough frames and with as many markers as the target."""
    if rival.since_s < lock.track.t_s or frame_pose.t_s - rival.since_s < MIN_RIVAL_ONLY_S:
        return False
    if not lock.has_both_markers:
        return rival.seen_frames >= ESTABLISHED_FRAMES
    return frame_pose.has_both_markers and rival.frames_with_both_markers >= ESTABLISHED_FRAMES


# --- Expected position of the target in the next picture ---
# The state estimate provides the vehicle's motion in two ways: as the difference of two positions,
# and as velocity times time. Each is weighted by its recent errors in the target's own pictures.


_MOTION_ERROR_UPDATE_FRACTION = 0.1  # share of the old errors that each picture replaces


def expected_corners(
    last_pose: LastPose | None, t_s: float, attitude: VehicleState | None, setup: PoseSetup
) -> tuple[dict[MarkerName, Array] | None, PoseCandidate | None]:
    """Return the expected corners of both markers, (4, 2) px, and the expected pose of the target:
    the last pose, moved by the vehicle's motion.

    Without both attitudes: None and the unmoved pose. Without a recent pose: None and None.
    """
    if last_pose is None or not 0.0 < t_s - last_pose.pose.t_s <= MAX_TRACK_GAP_S:
        return None, None
    pose, then = last_pose.pose, last_pose.attitude
    if attitude is None or then is None:
        return None, PoseCandidate(pose.rvec_rad, pose.tvec_m)
    R_then, R_now = _R_world_cam(then, setup), _R_world_cam(attitude, setup)
    by_place, by_speed = last_pose.motion_errors
    share = by_place / (by_place + by_speed) if by_place + by_speed > 0.0 else 0.5
    stepped_m, flown_m = _camera_displacements_m(then, attitude, setup)
    moved_m = stepped_m + share * (flown_m - stepped_m)
    R = R_now.T.dot(R_then)
    tvec = R.dot(pose.tvec_m) - R_now.T.dot(moved_m)
    if tvec[2] <= 0.0:
        return None, None
    rvec = rotation_vector(R.dot(rotation_matrix(pose.rvec_rad)))
    corners = project(setup.corners_m["joint"], rvec, tvec, setup.camera)
    moved = PoseCandidate(rvec, tvec)
    if not is_finite(corners):
        return None, moved
    return {"large": corners[:4], "small": corners[4:]}, moved


def update_last_pose(
    previous: LastPose | None, pose: MarkerPose, attitude: VehicleState | None, setup: PoseSetup
) -> LastPose:
    """Return the record of a new pose, with the errors of the estimated motion since `previous`."""
    if previous is None:
        return LastPose(pose, attitude)
    then, passed_s = previous.attitude, pose.t_s - previous.pose.t_s
    if attitude is None or then is None or not 0.0 < passed_s <= MAX_TRACK_GAP_S:
        return LastPose(pose, attitude, previous.motion_errors)
    R = _R_world_cam(attitude, setup)
    seen_m = _R_world_cam(then, setup).dot(previous.pose.tvec_m) - R.dot(pose.tvec_m)
    # Across the line of sight, because the distance of a far target is uncertain along it.
    residual = [
        R.T.dot(displacement_m - seen_m)[:2] / pose.tvec_m[2]
        for displacement_m in _camera_displacements_m(then, attitude, setup)
    ]
    by_place, by_speed = (
        old + _MOTION_ERROR_UPDATE_FRACTION * (float(new.dot(new)) - old)
        for old, new in zip(previous.motion_errors, residual, strict=True)
    )
    return LastPose(pose, attitude, MotionErrors(by_place, by_speed))


def is_in_view(position_world_m: Array, attitude: VehicleState, setup: PoseSetup) -> bool:
    """True if a position (3,) in the world is in the picture at the vehicle's attitude."""
    R = _R_world_cam(attitude, setup)
    tvec_m = R.T @ (
        position_world_m - attitude.position_m - _vehicle_to_camera_world_m(attitude, setup)
    )
    # Further off the axis, a lens model may fold back into the picture.
    if (
        tvec_m[2] <= 0.0
        or np.hypot(*tvec_m[:2]) > make_lattice(setup.camera).valid_radius_normalised * tvec_m[2]
    ):
        return False
    (at_px,) = project(np.zeros((1, 3)), np.zeros(3), tvec_m, setup.camera)
    return bool((at_px > 0.0).all() and (at_px < np.subtract(setup.camera.size_px, 1)).all())


class _CameraDisplacements(NamedTuple):
    """The camera's displacement (3,) in the world between two attitudes: from the difference of the
    two estimated positions, and from velocity times time."""

    from_positions_m: Array
    from_velocity_m: Array


def _camera_displacements_m(
    then: VehicleState, now: VehicleState, setup: PoseSetup
) -> _CameraDisplacements:
    """Return the camera's displacement between two attitudes, computed in both ways."""
    turned_m = _vehicle_to_camera_world_m(now, setup) - _vehicle_to_camera_world_m(then, setup)
    stepped_m = turned_m + np.subtract(now.position_m, then.position_m)
    if now.velocity_mps is None or then.velocity_mps is None:
        return _CameraDisplacements(stepped_m, stepped_m)
    half_s = 0.5 * (now.t_s - then.t_s)
    flown_m = turned_m + half_s * np.add(now.velocity_mps, then.velocity_mps)
    return _CameraDisplacements(stepped_m, flown_m)


def _R_world_cam(attitude: VehicleState, setup: PoseSetup) -> Array:
    R_world_cam: Array = attitude.R_world_body.dot(setup.T_body_cam[:3, :3])
    return R_world_cam


def _vehicle_to_camera_world_m(attitude: VehicleState, setup: PoseSetup) -> Array:
    """Return the vector from the vehicle to the camera in the world, (3,)."""
    ahead_m: Array = attitude.R_world_body.dot(setup.T_body_cam[:3, 3])
    return ahead_m
