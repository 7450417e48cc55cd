"""THE pipeline: one frame through detection, pose, filter and merge.

`step` is the only way from a picture to a pose; flying, weight fitting, tracking and
replaying all call it. It keeps no memory of its own: what it must remember is in
`PipelineState`, which goes in and comes out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array, rot_z, wrap_rad
from perchctl.profile import KalmanConfig, MergeConfig, Mounting, Profile
from perchctl.vision.filter import (
    MAX_GAP_S,
    POSITION,
    VELOCITY,
    YAW,
    FilterSetup,
    make_filter,
    measured_noise,
    step_track,
)
from perchctl.vision.markers.detect import DetectorSetup, detect, make_detector
from perchctl.vision.merge import (
    better,
    choose_stage,
    disagree,
    merge_pair,
    merge_variance,
    stage_of,
)
from perchctl.vision.pose import (
    PoseSetup,
    estimate_pose,
    level_rotation,
    make_pose_setup,
    normal_cam,
)
from perchctl.vision.poses import Poses
from perchctl.vision.predict import expected_corners
from perchctl.vision.types import (
    MARKERS,
    Attitude,
    CameraModel,
    Detections,
    Frame,
    MarkerPose,
    MarkerTrack,
    PipelineOutput,
    PipelineState,
    Sighting,
    Stage,
    TargetPose,
)

__all__ = ["Pipeline", "PipelineOutput", "PipelineState", "make_pipeline", "step"]


@dataclass(frozen=True, eq=False)
class Pipeline:
    """What does not change from frame to frame, made once by `make_pipeline`."""

    detector: DetectorSetup
    pose: PoseSetup
    level_filter: FilterSetup
    world_filter: FilterSetup
    kalman: KalmanConfig
    merge: MergeConfig
    camera: CameraModel


@dataclass(frozen=True, eq=False)
class _Merged:
    """The target in the tracks' frame: (x, y, z, yaw), velocity, covariances."""

    vector: Array
    velocity_mps: Array
    cov_m2: Array
    var_yaw_rad2: float
    unseen: int
    stage: Stage


def make_pipeline(profile: Profile, camera: CameraModel) -> Pipeline:
    """The profile's pipeline for a calibrated camera. One serves one thread: it owns an
    OpenCV detector."""
    mount, gear_body_m = profile.camera.mount, profile.vehicle.gear_body_m
    return Pipeline(
        detector=make_detector(profile.detector, profile.target),
        pose=make_pose_setup(profile.pose, profile.target, mount.T_body_cam, gear_body_m, camera),
        level_filter=make_filter(profile.kalman, in_world=False),
        world_filter=make_filter(profile.kalman, in_world=True),
        kalman=profile.kalman,
        merge=profile.merge,
        camera=camera,
    )


def camera_profile(profile: Profile) -> Profile:
    """The profile with the camera in the place of vehicle and gear: without a vehicle the
    target's pose is asked for in the camera frame."""
    bare = Mounting(position_m=(0.0, 0.0, 0.0), rpy_deg=(0.0, 0.0, 0.0))
    return profile.model_copy(
        update={
            "camera": profile.camera.model_copy(update={"mount": bare}),
            "vehicle": profile.vehicle.model_copy(update={"gear_body_m": (0.0, 0.0, 0.0)}),
        }
    )


def step(
    state: PipelineState, frame: Frame, attitude: Attitude | None, setup: Pipeline
) -> tuple[PipelineState, PipelineOutput]:
    """One frame. `attitude` is the vehicle's at the frame's time, None without one.

    Without an attitude the vehicle counts as level and at rest: the filter then works
    in the level frame, whatever `kalman.frame` says.
    """
    expected, near = expected_corners(state.sight, frame.t_s, attitude, setup.pose)
    # A first picture is looked at thoroughly, and of a stream without the target every Nth.
    thorough = state.empty_frames % setup.detector.blurred_every == 0
    detections = detect(frame, state.last, setup.detector, setup.camera, expected, thorough)
    normal = state.normal_cam
    poses = _poses(detections, attitude, setup, normal, near)
    disagreeing = state.disagreeing_frames
    contradiction = False
    if detections.large is not None and detections.small is not None:
        if not poses.consistent:
            large, small = poses.get("large"), poses.get("small")
            if large is not None and small is not None:
                contradiction = disagree(large, small, setup.merge.disagreement_m)
        disagreeing = disagreeing + 1 if contradiction else 0

    in_world = setup.kalman.frame == "world" and attitude is not None
    tracks = state.tracks if in_world == state.in_world else {}
    chosen = _chosen(poses, contradiction, attitude, setup)
    tracks = _step_tracks(tracks, chosen, frame.t_s, attitude if in_world else None, setup)
    merged = _merge_tracks(tracks, chosen, attitude, in_world, setup)
    target = None
    if merged is not None:
        fresh = any(n in tracks and tracks[n].t_s == frame.t_s for n in chosen)
        target = _target(merged, frame.t_s, fresh, attitude, in_world, setup)

    anything = detections.large is not None or detections.small is not None
    first = poses.first
    new_state = PipelineState(
        tracks=tracks,
        last=detections if anything else _still_useful(state.last, frame.t_s),
        disagreeing_frames=disagreeing,
        in_world=in_world,
        normal_cam=normal_cam(first) if first is not None else (normal if tracks else None),
        sight=Sighting(first, attitude) if first is not None else (state.sight if tracks else None),
        empty_frames=0 if anything else state.empty_frames + 1,
    )
    output = PipelineOutput(
        detections=detections,
        poses=poses,
        target=target,
        stage=stage_of(detections.large is not None, detections.small is not None),
        disagreeing_frames=disagreeing,
    )
    return new_state, output


def _still_useful(last: Detections | None, t_s: float) -> Detections | None:
    return last if last is not None and 0.0 <= t_s - last.t_s <= MAX_GAP_S else None


def _poses(
    detections: Detections,
    attitude: Attitude | None,
    setup: Pipeline,
    normal: Array | None,
    near: MarkerPose | None,
) -> Poses:
    seen = [d for name in MARKERS if (d := detections.get(name)) is not None]
    joint = None
    if len(seen) == 2 and setup.merge.method == "joint":
        joint = estimate_pose(seen, detections.t_s, attitude, setup.pose, normal, near)

    def singles() -> dict[str, MarkerPose]:
        # The joint tilt is the surest: the single markers of its frame start from it.
        found = (
            estimate_pose([d], detections.t_s, attitude, setup.pose, normal, joint or near)
            for d in seen
        )
        return {pose.source: pose for pose in found if pose is not None}

    return Poses(singles()) if joint is None else Poses({"joint": joint}, singles)


def _chosen(
    poses: Poses,
    contradiction: bool,
    attitude: Attitude | None,
    setup: Pipeline,
) -> dict[str, MarkerPose]:
    """Which pose feeds which track in this frame."""
    if poses.consistent and setup.merge.stages == "seen":
        return {"joint": poses["joint"]}
    kept: dict[str, MarkerPose] = {name: poses[name] for name in MARKERS if name in poses}
    if len(kept) == 2:
        use = better(kept["large"], kept["small"])
        z_m = float(use.e_m[2]) + _gear_above_camera(attitude, setup)
        stage = choose_stage(True, True, z_m, setup.merge)
        if contradiction:
            kept = {use.source: use}
        elif stage is not Stage.BOTH:
            kept = {stage.value: poses[stage.value]}
    if setup.merge.method == "weights" or not (kept or poses):
        return kept
    if len(kept) == 1:
        return {"joint": next(iter(kept.values()))}
    return {"joint": poses["joint"]} if "joint" in poses else {"joint": use}


def _gear_above_camera(attitude: Attitude | None, setup: Pipeline) -> float:
    offset = setup.pose.gear_body_m - setup.pose.T_body_cam[:3, 3]
    return float((level_rotation(attitude) @ offset)[2])


def _step_tracks(
    tracks: dict[str, MarkerTrack],
    chosen: dict[str, MarkerPose],
    t_s: float,
    world: Attitude | None,
    setup: Pipeline,
) -> dict[str, MarkerTrack]:
    """All tracks one frame on; `world` is the attitude where they live in the world."""
    constants = setup.level_filter if world is None else setup.world_filter
    stepped: dict[str, MarkerTrack] = {}
    for name in ("joint",) if setup.merge.method == "joint" else MARKERS:
        pose = chosen.get(name)
        z = None if pose is None else _measurement(pose, world, setup)
        R = None if pose is None else _noise(pose, world, constants, setup)
        track = step_track(tracks.get(name), z, t_s, constants, R)
        if track is not None:
            stepped[name] = track
    return stepped


def _measurement(pose: MarkerPose, world: Attitude | None, setup: Pipeline) -> Array:
    """(yaw, x, y, z) in the tracks' frame."""
    if world is None:
        return np.array([pose.e_yaw_rad, *pose.e_m])
    position, yaw = _to_world(pose.e_m, pose.e_yaw_rad, world, setup)
    return np.array([yaw, *position])


def _noise(
    pose: MarkerPose, world: Attitude | None, constants: FilterSetup, setup: Pipeline
) -> Array | None:
    """Covariance (4, 4) of `_measurement`, None for the fixed one."""
    if pose.cov is None or constants.attitude_sigma_rad is None:
        return None
    cov, arm = pose.cov, setup.pose.T_body_cam[:3, :3] @ pose.tvec_m
    if world is not None:
        arm = level_rotation(world) @ arm
        turn = np.eye(4)
        turn[:3, :3] = rot_z(world.yaw_rad)
        cov, arm = turn @ cov @ turn.T, turn[:3, :3] @ arm
    return measured_noise(cov, arm, constants)


def _to_world(
    e_m: Array, e_yaw_rad: float, attitude: Attitude, setup: Pipeline
) -> tuple[Array, float]:
    gear_level = level_rotation(attitude) @ setup.pose.gear_body_m
    position = np.asarray(attitude.position_m) + rot_z(attitude.yaw_rad) @ (e_m + gear_level)
    return position, wrap_rad(e_yaw_rad + attitude.yaw_rad)


def _to_level(
    position_m: Array, yaw_rad: float, attitude: Attitude, setup: Pipeline
) -> tuple[Array, float]:
    """Inverse of `_to_world`."""
    gear_level = level_rotation(attitude) @ setup.pose.gear_body_m
    arm = rot_z(-attitude.yaw_rad) @ (position_m - np.asarray(attitude.position_m))
    return arm - gear_level, wrap_rad(yaw_rad - attitude.yaw_rad)


def _merge_tracks(
    tracks: dict[str, MarkerTrack],
    chosen: dict[str, MarkerPose],
    attitude: Attitude | None,
    in_world: bool,
    setup: Pipeline,
) -> _Merged | None:
    """The tracks that this frame fed, or else those unseen for the shortest time."""
    if not tracks:
        return None
    least = min(track.unseen for track in tracks.values())
    used = {name: track for name, track in tracks.items() if track.unseen == least}
    if chosen and setup.merge.method == "weights":
        used = {name: track for name, track in used.items() if name in chosen} or used
    if len(used) == 1:
        name, track = next(iter(used.items()))
        pose = chosen.get(name)
        source = pose.source if pose is not None else name
        stage = {"joint": Stage.BOTH, "large": Stage.LARGE, "small": Stage.SMALL}[source]
        stage = Stage.NONE if pose is None else stage
        return _Merged(
            vector=np.array([*track.x[POSITION], track.x[YAW]]),
            velocity_mps=track.x[VELOCITY],
            cov_m2=track.P[np.ix_(POSITION, POSITION)],
            var_yaw_rad2=float(track.P[YAW, YAW]),
            unseen=track.unseen,
            stage=stage,
        )
    large, small = used["large"], used["small"]
    weights = setup.merge.weights
    order = [*POSITION, YAW]
    variance = merge_variance(np.diag(large.P)[order], np.diag(small.P)[order], weights)
    w = np.array([weights.x, weights.y, weights.z])
    return _Merged(
        vector=merge_pair(large.x[order], small.x[order], weights),
        velocity_mps=w * large.x[VELOCITY] + (1.0 - w) * small.x[VELOCITY],
        cov_m2=np.diag(variance[:3]),
        var_yaw_rad2=float(variance[3]),
        unseen=least,
        stage=Stage.BOTH if chosen else Stage.NONE,
    )


def _target(
    merged: _Merged,
    t_s: float,
    measured: bool,
    attitude: Attitude | None,
    in_world: bool,
    setup: Pipeline,
) -> TargetPose:
    position, yaw = merged.vector[:3], float(merged.vector[3])
    velocity, cov = merged.velocity_mps, merged.cov_m2
    world_m: Array | None = None
    world_yaw_rad: float | None = None
    world_velocity: Array | None = None
    if in_world and attitude is not None:
        world_m, world_yaw_rad, world_velocity = position, yaw, velocity
        turn = rot_z(-attitude.yaw_rad)
        position, yaw = _to_level(world_m, world_yaw_rad, attitude, setup)
        velocity, cov = turn @ velocity, turn @ cov @ turn.T
    elif attitude is not None:
        world_m, world_yaw_rad = _to_world(position, yaw, attitude, setup)
    return TargetPose(
        t_s=t_s,
        stage=merged.stage,
        e_m=position,
        e_yaw_rad=yaw,
        velocity_mps=velocity,
        measured=measured,
        unseen=merged.unseen,
        sigma_m=np.sqrt(np.maximum(np.diag(cov), 0.0)),
        sigma_yaw_rad=float(np.sqrt(max(merged.var_yaw_rad2, 0.0))),
        world_m=world_m,
        world_yaw_rad=world_yaw_rad,
        world_velocity_mps=world_velocity,
    )
