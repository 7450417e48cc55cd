"""The vision pipeline, which runs each frame through detection, pose, filter and merge.

`step` is the only path from an image to a pose, and `estimate` predicts the target's pose for any
later time. All memory is in `PipelineState`, which the functions take and return. Small matrices
are multiplied with `dot` because `@` takes twice as long.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue
from perchctl.extensions import error_at, load_extension
from perchctl.opencv_threads import one_thread
from perchctl.profile import KalmanConfig, MergeConfig, Mounting, Profile, read_mask
from perchctl.values import replace
from perchctl.vision.fields import classify_interlacing, deinterlace_frame
from perchctl.vision.filter import (
    MAX_FRAME_GAP_TO_CONTINUE_TRACK_S,
    make_filter_setup,
    predict_track,
)
from perchctl.vision.markers.cut import warm_up_truncated_marker_fit
from perchctl.vision.markers.detect import detect_markers
from perchctl.vision.markers.detector import DetectorSetup, make_detector_setup
from perchctl.vision.merge import (
    TargetMergedFromTracks,
    classify_visible_markers,
    estimate_marker_poses,
    merge_tracks,
    widen_covariance_for_rival,
)
from perchctl.vision.pose import PoseCandidate, PoseSetup, target_normal_cam
from perchctl.vision.target_selection import (
    ExpectedOwnTargetPosition,
    gear_to_target_shift_per_bias_sigma_m,
    marker_to_own_target_distance_m,
    target_level_to_world,
    target_world_to_level,
)
from perchctl.vision.tracks import (
    TrackSetup,
    TrackUpdateResult,
    predict_corners,
    predict_rival_state,
    update_last_pose,
    update_tracks,
)
from perchctl.vision.types import (
    MARKERS,
    CameraModel,
    Detection,
    Detections,
    Frame,
    MarkerName,
    PictureKind,
    PipelineOutput,
    PipelineState,
    TargetEstimate,
    VehicleState,
    VisibleMarkers,
    to_grey,
)

SEVERAL_TARGETS_TEXT = "more than one target in view: perchctl keeps following the tracked one"


class Detector(Protocol):
    """Signature of a custom detection function, named by ``detector.own`` in a profile. It takes a
    grey image (height, width) and returns a dict with the detected markers, ``large`` and
    ``small``. Each value is an array of corners (4, 2) px in the order top left, top right, bottom
    right, bottom left on the paper, or a tuple of corners and their standard deviation, px (0.5 by
    default). (0, 0) is the centre of the top-left pixel."""

    def __call__(self, image: NDArray[np.uint8], /) -> Mapping[str, Any]: ...


StepFunction = Callable[
    [PipelineState, Frame, VehicleState | None, "Pipeline"], tuple[PipelineState, PipelineOutput]
]
"""Type of functions with the signature of `step`."""


@dataclass(frozen=True, eq=False)
class Pipeline:
    """The constant parameters of all steps of the vision pipeline, created by `make_pipeline` from
    a profile and a camera. If `custom_detector` is set, it replaces the detection of markers. If
    `custom_step` is set, `perchctl.perception` calls it instead of `step`."""

    detector_setup: DetectorSetup
    pose_setup: PoseSetup
    merge: MergeConfig
    track_setup: TrackSetup
    kalman: KalmanConfig
    camera: CameraModel
    custom_detector: Detector | None = None
    custom_step: StepFunction | None = None


def make_pipeline(
    profile: Profile, camera: CameraModel, hidden_mask: NDArray[np.bool_] | None = None
) -> Pipeline:
    """Return the pipeline for a profile and a calibrated camera. Several image streams may share
    one pipeline.

    `hidden_mask` (h, w) is True for pixels that the vehicle covers in the camera's images, before
    `camera.mirrored` flips them, and replaces the mask in the file `camera.mask`. If it is None,
    this file is read. If the profile names no file, no pixels are masked. Raises NotFound if the
    file is missing, and InvalidValue if it is invalid.
    """
    pose_setup = PoseSetup(
        config=profile.pose,
        target=profile.target,
        T_body_cam=profile.camera.mount.T_body_cam,
        gear_body_m=np.asarray(profile.vehicle.gear_body_m, dtype=np.float64),
        camera=camera,
        rolling_shutter_readout_s=profile.camera.readout_s,
    )
    mask = hidden_mask
    if mask is None and profile.camera.mask is not None:
        mask = read_mask(profile.camera.mask, camera.size_px)
    if mask is not None and profile.camera.mirrored:
        mask = mask[:, ::-1]
    detector_setup = make_detector_setup(profile.detector, profile.target, mask)
    if detector_setup.is_line_fit_enabled:
        warm_up_truncated_marker_fit(detector_setup.patterns, camera)
    target = profile.target
    # Without `target.expected_xy_m`, use the position at which the vehicle searches for the target.
    own = ExpectedOwnTargetPosition(profile.planner.approach_xy_m)
    if target.expected_xy_m is not None:
        own = ExpectedOwnTargetPosition(target.expected_xy_m, target.expected_within_m)
    return Pipeline(
        detector_setup=detector_setup,
        pose_setup=pose_setup,
        merge=profile.merge,
        track_setup=TrackSetup(
            level_frame_filter=make_filter_setup(profile.kalman, is_world_frame=False),
            world_frame_filter=make_filter_setup(profile.kalman, is_world_frame=True),
            pose_setup=pose_setup,
            is_innovation_gate_enabled=profile.kalman.gate,
            own_target=own,
        ),
        kalman=profile.kalman,
        camera=camera,
        custom_detector=None
        if profile.detector.own is None
        else load_extension(profile.detector.own, "detector.own"),
    )


def make_camera_only_profile(profile: Profile) -> Profile:
    """Return a copy of the profile for tracking with a camera that is not on a vehicle. This
    profile has no mounting and no gear, so that poses are in the camera frame, and it reports a
    separate pose for each marker."""
    bare = Mounting(position_m=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0))
    return profile.model_copy(
        update={
            "camera": profile.camera.model_copy(update={"mount": bare}),
            "vehicle": profile.vehicle.model_copy(update={"gear_body_m": (0.0, 0.0, 0.0)}),
            "pose": profile.pose.model_copy(update={"each_marker": True}),
        }
    )


def deinterlace(
    state: PipelineState, frame: Frame, pipeline: Pipeline
) -> tuple[PipelineState, tuple[Frame, ...]]:
    """Return the new state, and the frames to pass to `step` one by one: the frame itself, or its
    two fields in time order if the frame is interlaced and the order of its fields is known. All
    are grey. Raises InvalidValue if the image is invalid or does not have the size given in the
    calibration."""
    with one_thread():
        frame = _convert_to_grey(frame, pipeline.camera)
        fields, found = deinterlace_frame(state.interlacing_state, frame)
    return replace(state, interlacing_state=fields), found


def step(
    state: PipelineState, frame: Frame, attitude: VehicleState | None, pipeline: Pipeline
) -> tuple[PipelineState, PipelineOutput]:
    """Process a grey or colour frame, and return the new state and the output for this frame.
    Raises InvalidValue if the image is invalid or does not have the size given in the calibration.

    `attitude` is the vehicle's state at the frame's time. If it is None, the vehicle is assumed to
    be level and at rest, and the filter works in the level frame regardless of `kalman.frame`.
    """
    frame = classify_interlacing(_convert_to_grey(frame, pipeline.camera))
    expected_corners_px, start_pose = predict_corners(
        state.last_accepted_pose, frame.t_s, attitude, pipeline.pose_setup
    )
    if pipeline.custom_detector is not None:
        detections = _run_custom_detector(frame, pipeline.custom_detector)
    else:
        # In the first image, all methods search for the target.
        first = (
            state.last_detections is None
            and state.rival is None
            and state.successive_frames_without_markers == 0
        )
        empty = None if first else state.successive_frames_without_markers
        own_target = pipeline.track_setup.own_target
        measure_marker_to_own_target_distance_m = partial(
            marker_to_own_target_distance_m, own_target, frame.t_s, attitude, pipeline.pose_setup
        )
        with nullcontext() if state.last_detections is None else one_thread():
            detections = detect_markers(
                frame,
                state.last_detections,
                pipeline.detector_setup,
                pipeline.camera,
                expected_corners_px,
                empty,
                measure_marker_to_own_target_distance_m,
            )
    return step_from_detections(
        state, detections, attitude, pipeline, start_pose, frame.picture_kind or "whole"
    )


def _convert_to_grey(frame: Frame, camera: CameraModel) -> Frame:
    """Return the frame with a grey image. Raises InvalidValue if the image is invalid or does not
    have the camera's size."""
    grey, size_px = to_grey(frame.image), camera.size_px
    if grey is not frame.image:
        frame = replace(frame, image=grey, source_jpeg=None)
    height, width = grey.shape
    if (width, height) != size_px:
        raise InvalidValue(
            f"the picture is {width}x{height} px, but the calibration was made at "
            f"{size_px[0]}x{size_px[1]} px: calibrate the camera at this size"
        )
    return frame


def _run_custom_detector(frame: Frame, detect: Detector) -> Detections:
    """Run a custom detector on the frame's grey image and return its detections. Without a standard
    deviation from the detector, 0.5 px is assumed. A marker with a corner that is not finite is
    omitted. Raises InvalidValue if the detector raises an exception or returns values that cannot
    be corners."""
    found: dict[MarkerName, Detection] = {}
    try:
        for name, value in dict(detect(frame.image) or {}).items():
            corners, sigma_px = value if isinstance(value, tuple) else (value, 0.5)
            corners_px, sigma_px = np.asarray(corners, dtype=np.float64), float(sigma_px)
            if name not in MARKERS or corners_px.shape != (4, 2) or not 1e-3 <= sigma_px <= 1e3:
                raise ValueError(f"{name!r}, {corners_px.shape}, sigma {sigma_px}")
            if np.isfinite(corners_px).all():
                found[name] = Detection(name, corners_px, sigma_px, are_corners_fitted=True)
    except Exception as error:
        raise InvalidValue(
            f"detector.own failed: {error_at(error)}; it must return the corners of large and "
            f"small, each (4, 2) px, or a tuple of corners and a sigma of 0.001 to 1000 px"
        ) from error
    return Detections(frame.index, frame.t_s, found.get("large"), found.get("small"))


def step_from_detections(
    state: PipelineState,
    detections: Detections,
    attitude: VehicleState | None,
    pipeline: Pipeline,
    start_pose: PoseCandidate | None = None,
    picture_kind: PictureKind = "whole",
) -> tuple[PipelineState, PipelineOutput]:
    """Run the part of `step` that follows detection: poses, tracks and target estimate. `attitude`
    is the vehicle's state at the time of the detections; None if unknown. `start_pose` is the
    target's expected pose in the camera frame; None if unknown. `picture_kind` is passed on to the
    output: whether the image is a whole frame, interlaced, or a field."""
    last_accepted_pose, t_s = state.last_accepted_pose, detections.t_s
    normal = (
        target_normal_cam(last_accepted_pose.pose)
        if last_accepted_pose is not None and attitude is None
        else None
    )
    marker_poses = estimate_marker_poses(
        detections, attitude, start_pose, normal, pipeline.merge, pipeline.pose_setup
    )

    is_in_world_frame = pipeline.kalman.frame == "world" and attitude is not None
    track_update = update_tracks(
        state, marker_poses, t_s, attitude, is_in_world_frame, pipeline.track_setup
    )
    marker_poses, verdict = track_update.marker_poses, track_update.verdict

    stage = classify_visible_markers(detections.large is not None, detections.small is not None)
    anything = stage is not VisibleMarkers.NONE
    disagreeing = state.successive_frames_with_contradicting_markers
    if stage is VisibleMarkers.BOTH and verdict.is_accepted:
        disagreeing = disagreeing + 1 if marker_poses.do_markers_contradict else 0
    most_certain_pose = marker_poses.most_certain_pose
    sees = most_certain_pose is not None and verdict.is_accepted
    if most_certain_pose is not None and sees:
        last_accepted_pose = update_last_pose(
            last_accepted_pose, most_certain_pose, attitude, pipeline.pose_setup
        )
    target = _estimate_at_frame(
        track_update, state.target, t_s, attitude, is_in_world_frame, pipeline
    )
    last = state.last_detections
    if anything and verdict.is_accepted:
        last = detections
    elif last is not None and not 0.0 <= t_s - last.t_s <= MAX_FRAME_GAP_TO_CONTINUE_TRACK_S:
        last = None
    new = PipelineState(
        tracks=track_update.tracks,
        are_tracks_in_world_frame=is_in_world_frame,
        marker_poses=marker_poses,
        target=target or state.target,
        last_detections=last,
        last_accepted_pose=last_accepted_pose if sees or track_update.tracks else None,
        successive_frames_with_contradicting_markers=disagreeing,
        successive_frames_without_markers=0
        if anything
        else state.successive_frames_without_markers + 1,
        lock=track_update.lock,
        rival=track_update.rival,
        interlacing_state=state.interlacing_state,
    )
    output = PipelineOutput(
        detections=detections,
        poses=marker_poses.poses_by_source,
        target=target,
        stage=stage,
        successive_frames_with_contradicting_markers=disagreeing,
        target_lock_message=verdict.reason
        or (SEVERAL_TARGETS_TEXT if detections.target_count > 1 else ""),
        picture_kind=picture_kind,
        is_other_vehicles_target_seen=verdict.is_other_vehicles_target,
    )
    return new, output


def estimate(
    state: PipelineState,
    t_s: float,
    attitude: VehicleState | None,
    pipeline: Pipeline,
) -> TargetEstimate | None:
    """Return the target estimate at `t_s`, a time after the newest frame, given the vehicle's
    `attitude` and position at that time.

    If the filter works in the world frame, a tracked target is predicted with its filter.
    Otherwise, or if the target is no longer tracked, it stays at its last position in the world,
    and only the vehicle's motion changes its position relative to the gear. Returns None before the
    first measurement. If the attitude is unknown, or was unknown when the last estimate was made,
    that estimate is returned unchanged.
    """
    target = state.target
    if target is None or attitude is None or target.world_m is None:
        return target
    if state.tracks and state.are_tracks_in_world_frame:
        world = pipeline.track_setup.world_frame_filter
        tracks = {n: predict_track(t, t_s, world) for n, t in state.tracks.items()}
        merged = merge_tracks(
            tracks, state.marker_poses.poses_by_updated_track, pipeline.merge.weights
        )
        assert merged is not None
        rival = predict_rival_state(state.lock, state.rival, True, t_s, world)
        merged = merged if rival is None else widen_covariance_for_rival(merged, rival)
        frames = _express_in_level_and_world(merged, attitude, True, pipeline)
        return replace(target, t_s=t_s, **frames)
    if not state.tracks:
        nothing = np.zeros(3)
        target = replace(
            target,
            stage=VisibleMarkers.NONE,
            is_measured_in_newest_frame=False,
            tracked=False,
            velocity_mps=nothing,
            world_velocity_mps=nothing,
        )
    assert target.world_m is not None
    assert target.world_yaw_rad is not None
    e_m, e_yaw_rad = target_world_to_level(
        target.world_m, target.world_yaw_rad, attitude, pipeline.pose_setup
    )
    return replace(target, t_s=t_s, e_m=e_m, e_yaw_rad=e_yaw_rad)


# --- From the tracks to the target ---


def _estimate_at_frame(
    track_update: TrackUpdateResult,
    previous_estimate: TargetEstimate | None,
    t_s: float,
    attitude: VehicleState | None,
    is_in_world_frame: bool,
    pipeline: Pipeline,
) -> TargetEstimate | None:
    poses_by_updated_track, tracks = (
        track_update.marker_poses.poses_by_updated_track,
        track_update.tracks,
    )
    merged = merge_tracks(tracks, poses_by_updated_track, pipeline.merge.weights)
    if merged is None:
        return None
    filter_setup = pipeline.track_setup.select_filter(is_in_world_frame)
    rival = predict_rival_state(
        track_update.lock, track_update.rival, is_in_world_frame, t_s, filter_setup
    )
    merged = merged if rival is None else widen_covariance_for_rival(merged, rival)
    measured = any(n in tracks and tracks[n].t_s == t_s for n in poses_by_updated_track)
    small = measured and merged.stage in (VisibleMarkers.BOTH, VisibleMarkers.SMALL)
    never = -np.inf
    frames = _express_in_level_and_world(merged, attitude, is_in_world_frame, pipeline)
    offset_m, offset_sigma_m = None, math.inf
    if not measured and previous_estimate is not None:
        offset_m = previous_estimate.measured_gear_to_target_world_m
        offset_sigma_m = previous_estimate.measured_gear_to_target_sigma_m
    elif measured and attitude is not None:
        offset_m = attitude.R_world_level.dot(frames["e_m"])
        offset_sigma_m = float(frames["sigma_m"][:2].max())
    return TargetEstimate(
        t_s=t_s,
        last_measured_at_s=t_s
        if measured
        else never
        if previous_estimate is None
        else previous_estimate.last_measured_at_s,
        small_marker_last_measured_at_s=t_s
        if small
        else never
        if previous_estimate is None
        else previous_estimate.small_marker_last_measured_at_s,
        stage=merged.stage,
        is_measured_in_newest_frame=measured,
        tracked=True,
        unseen_frames=merged.unseen_frames,
        measured_gear_to_target_world_m=offset_m,
        measured_gear_to_target_sigma_m=offset_sigma_m,
        **frames,
    )


def _express_in_level_and_world(
    merged: TargetMergedFromTracks,
    attitude: VehicleState | None,
    is_in_world_frame: bool,
    pipeline: Pipeline,
) -> dict[str, Any]:
    place_m, yaw_rad = merged.track_frame_xyz_yaw[:3], float(merged.track_frame_xyz_yaw[3])
    position_cov_m2, error_shifts_m = (
        merged.track_frame_position_cov_m2,
        merged.track_frame_position_shift_per_bias_sigma_m,
    )
    seen: dict[str, Any] = {"velocity_mps": merged.track_frame_velocity_mps}
    if attitude is not None and is_in_world_frame:
        turn = attitude.R_world_level.T
        seen["world_m"], seen["world_yaw_rad"] = place_m, yaw_rad
        seen["e_m"], seen["e_yaw_rad"] = target_world_to_level(
            place_m, yaw_rad, attitude, pipeline.pose_setup
        )
        seen["velocity_mps"] = turn.dot(merged.track_frame_velocity_mps)
        seen["world_velocity_mps"] = merged.track_frame_velocity_mps
        position_cov_m2 = turn.dot(position_cov_m2).dot(turn.T)
        error_shifts_m = gear_to_target_shift_per_bias_sigma_m(
            error_shifts_m, attitude, pipeline.track_setup.world_frame_filter, pipeline.pose_setup
        )
    else:
        seen["e_m"], seen["e_yaw_rad"] = place_m, yaw_rad
        if attitude is not None:
            world = target_level_to_world(place_m, yaw_rad, attitude, pipeline.pose_setup)
            seen["world_m"], seen["world_yaw_rad"] = world
    variance = position_cov_m2.diagonal() + (error_shifts_m * error_shifts_m).sum(axis=1)
    seen["sigma_m"] = np.asarray(np.sqrt(np.maximum(variance, 0.0)))
    seen["sigma_yaw_rad"] = math.sqrt(max(merged.yaw_var_rad2, 0.0))
    return seen
