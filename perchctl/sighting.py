"""Measure the target's pose in each image of any source, without a vehicle."""

from __future__ import annotations

import contextlib
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from perchctl.calibration import load_calibration
from perchctl.camera import (
    VERDICT_TEXTS,
    FrameSource,
    WrappedSource,
    check_size,
    mirrored_problem,
    open_camera,
    parse_source,
    unmirror_frame,
)
from perchctl.errors import ConnectionFailed, InvalidValue, Note, require_type
from perchctl.geometry import R_MARKER_TARGET, Array, make_T
from perchctl.perception import Perception
from perchctl.places import is_shipped_example
from perchctl.profile import Profile, find_calibration, load_profile
from perchctl.values import replace
from perchctl.vision import (
    CameraModel,
    Detection,
    Frame,
    Pipeline,
    PipelineOutput,
    PipelineState,
    VehicleState,
    make_camera_only_profile,
    make_pipeline,
    target_rotation_translation_cov_cam,
    to_grey,
)

TRACK_POLL_S = 0.002
"""Polling period for new frames, s. Larger: frames are read later."""
FRAME_TIMEOUT_S = 2.0
"""Time without a frame after which a live source counts as lost, s. Smaller: a short pause ends the
tracking."""
INTERLACED = "interlaced: each field of a frame is measured separately"
_NO_POSE = "no pose fits the marker's corners"
_DISAGREE = "the two markers contradict each other: check the printed sizes and the calibration"
AttitudeAt = Callable[[float], VehicleState | None]
Named = tuple[Frame, str | None]
"""A frame, and its file name if it has one."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """The target in one image; frames and signs are those of docs/conventions.md.

    Attributes:
        index: number of the image in its source, from 0.
        t_s: exposure time, s; for a live source, by `time.monotonic`.
        name: the image's file name, or None.
        markers: the detected markers, keyed by ``large`` and ``small``, with `corners_px` (4, 2)
            (top left, top right, bottom right, bottom left on the paper) and their standard
            deviation `sigma_px`.
        T_cam_target: pose of the target in the camera frame, (4, 4), m, measured in this image and
            not filtered; None without an accepted pose. In a video or stream, earlier images decide
            where to search for the markers, and which of two tilts to choose if both fit.
        covariance: covariance of that pose, (6, 6), in ROS's order: shifts along the camera's x, y,
            z (m), then small rotations about the camera's x, y, z (rad); None without a pose.
        T_level_target: pose in the level frame, from the vehicle's centre, (4, 4), m, computed with
            `camera.mount`; None without a pose or an attitude.
        note: what is wrong with the image or the target; otherwise empty.
    """

    index: int
    t_s: float
    name: str | None
    markers: Mapping[Any, Detection]
    T_cam_target: Array | None = None
    covariance: Array | None = None
    T_level_target: Array | None = None
    note: str = ""


def track(
    source: str | Path | FrameSource | Iterable[Any],
    profile: Profile | Path | str = "sim",
    calibration: CameraModel | Path | str | None = None,
    *,
    attitude: VehicleState | AttitudeAt | None = None,
    rate_hz: float | None = None,
) -> Iterator[Sighting]:
    """Yield a `Sighting` for each image of a source, or for each field of an interlaced one.

    Args:
        source: a source text as for `perchctl track`, such as ``camera:0``, ``video:flight.mp4`` or
            ``images:pictures``; an open `FrameSource`; or an iterable of `Frame` or of uint8
            arrays, (height, width) in grey or (height, width, 3) in BGR.
        profile: a profile, its name, or its file; contains the target's sizes, and how it is
            measured.
        calibration: the camera's calibration, or its file; by default that of the profile.
        attitude: the vehicle's attitude, or a function that returns it for a frame's `t_s`; needed
            for `T_level_target`.
        rate_hz: frame rate, if the arrays are a stream. Without a rate, and for ``images:``, each
            image is searched thoroughly and independently.

    Raises:
        NotFound: there is no such source, profile or calibration. InvalidValue: an image is None,
            or a type, shape, size or number is wrong. ConnectionFailed: a live source has stopped
            delivering frames.
    """
    profile = load_profile(profile)
    if calibration is None:
        calibration = find_calibration(profile.camera.calibration)
        if is_shipped_example(calibration) and source != "sim:":
            what = f"{calibration.name} is the example calibration: pass your own camera's"
            warnings.warn(what, Note, stacklevel=2)
    require_type("calibration", calibration, CameraModel, Path, str)
    camera = calibration if isinstance(calibration, CameraModel) else load_calibration(calibration)
    if rate_hz is not None and not 0.0 < rate_hz < math.inf:
        raise InvalidValue(f"rate_hz must be positive, found {rate_hz}")
    stills = rate_hz is None
    if isinstance(source, str | Path):
        source = str(source)
        stills = parse_source(source).scheme == "images"
    elif isinstance(source, FrameSource):
        stills = False
    elif not isinstance(source, Iterable) or isinstance(source, np.ndarray):
        raise InvalidValue(
            "a source must be a string such as camera:0, a FrameSource, or an iterable of "
            f"pictures, as in track([picture]); found {type(source).__name__}"
        )
    at = None if attitude is None else partial(_attitude_at, attitude)
    return _sightings(source, profile, camera, at, stills, rate_hz or 1.0)


def _attitude_at(attitude: VehicleState | AttitudeAt, t_s: float) -> VehicleState | None:
    found = attitude(t_s) if callable(attitude) else attitude
    if found is None:
        return None
    require_type("the attitude", found, VehicleState)
    if not np.isfinite(found.R_level_body).all():
        raise InvalidValue(f"the attitude at {t_s} s is not finite: {found}")
    return found


def _sightings(
    source: str | FrameSource | Iterable[Any],
    profile: Profile,
    camera: CameraModel,
    attitude: AttitudeAt | None,
    stills: bool,
    rate_hz: float,
) -> Iterator[Sighting]:
    with contextlib.ExitStack() as stack:
        if isinstance(source, str):
            source = open_camera(source, config=profile.camera, size_px=camera.size_px)
            stack.callback(source.close)
        if isinstance(source, FrameSource):
            live, frames = source.live, _polled(source, camera)
        else:
            live, frames = False, _numbered(source, rate_hz)
        # If `open_camera` was given the profile's section, it already flips the images.
        turns = profile.camera.mirrored and not isinstance(source, WrappedSource)
        tracker = Tracker(profile, camera, live=live, stills=stills, attitude=attitude)
        for frame, name in frames:
            right = unmirror_frame(frame) if turns else frame
            for picture, output, notes in tracker.process(right):
                yield tracker.make_sighting(picture, output, notes, name)


def _polled(source: FrameSource, camera: CameraModel) -> Iterator[Named]:
    """Yield all frames of a recording, or the newest frames of a live source. Raises
    ConnectionFailed."""
    paths = getattr(getattr(source, "inner", source), "paths", ())
    heard_s = time.monotonic()
    while True:
        now_s = time.monotonic()
        frame = source.poll(now_s)
        if frame is not None:
            frame = replace(frame, image=to_grey(frame.image))
            place = str(paths[frame.index]) if paths else source.describe()
            check_size((frame.image.shape[1], frame.image.shape[0]), camera, place)
            yield frame, paths[frame.index].name if paths else None
            heard_s = time.monotonic()
        elif source.finished:
            return
        elif (problem := source.problem(now_s)) is not None:
            raise ConnectionFailed(problem)
        elif source.live and now_s - heard_s > FRAME_TIMEOUT_S:
            raise ConnectionFailed(f"{source.describe()}: no frame for {FRAME_TIMEOUT_S:g} s")
        else:
            time.sleep(TRACK_POLL_S)


def _numbered(images: Iterable[Any], rate_hz: float) -> Iterator[Named]:
    for index, image in enumerate(images):
        frame = image if isinstance(image, Frame) else Frame(index, index / rate_hz, image)
        yield replace(frame, image=to_grey(frame.image)), None


class Tracker:
    """Runs the profile's pipeline on one source's frames, without a vehicle.

    `live`: the source is a camera. `stills`: each image is searched thoroughly and independently.
    Without `attitude`, poses are relative to the camera instead of the gear.
    """

    def __init__(
        self,
        profile: Profile,
        camera: CameraModel,
        *,
        live: bool,
        stills: bool,
        attitude: AttitudeAt | None = None,
    ) -> None:
        bare = profile if attitude else make_camera_only_profile(profile)
        self.pipeline = make_pipeline(bare, camera)
        self._perception = Perception(self.pipeline, stills=stills, attitude=attitude)
        self._attitude = attitude
        self._config, self._live, self._stills = profile.camera, live, stills
        self._disagreement_frames = 1 if stills else profile.merge.disagreement_frames

    def process(self, frame: Frame) -> Iterator[tuple[Frame, PipelineOutput | None, list[str]]]:
        """Yield the frame, or both fields of an interlaced one, with the pipeline's output and
        notes. A live image that is frozen or noise has no output. A repeated image is left out."""
        kind = self._perception.health.assess(frame, self._live or not self._stills)
        if self._live and kind == "repeated":
            return
        about = [] if kind in ("ok", "repeated") else [VERDICT_TEXTS[kind]]
        if self._live and kind in ("frozen", "snow"):
            yield frame, None, about
            return
        for picture, output in self._perception.process_fields(frame):
            yield picture, output, [*about, *self._notes(output)]

    def make_sighting(
        self,
        picture: Frame,
        output: PipelineOutput | None,
        notes: list[str],
        name: str | None = None,
    ) -> Sighting:
        """Return the sighting for the result that `process` has just yielded; `name` is the image's
        file name."""
        seen = Sighting(picture.index, picture.t_s, name, {}, note="; ".join(notes))
        if output is None or not output.detections.markers:
            return seen
        markers = {each.marker: each for each in output.detections.markers}
        attitude = None if self._attitude is None else self._attitude(picture.t_s)
        seen = replace(seen, markers=markers)
        return _add_pose(seen, self._perception.state, attitude, self.pipeline)

    def _notes(self, output: PipelineOutput) -> Iterator[str]:
        if output.picture_kind != "whole":
            yield INTERLACED
        if output.target_lock_message:
            yield output.target_lock_message
        if output.detections.markers and not output.poses:
            yield _NO_POSE
        if output.detections.is_mirrored_marker_seen:
            yield mirrored_problem(self._config).sentence
        if output.successive_frames_with_contradicting_markers >= self._disagreement_frames:
            yield _DISAGREE


def _add_pose(
    seen: Sighting, state: PipelineState, attitude: VehicleState | None, pipeline: Pipeline
) -> Sighting:
    """The sighting with its pose, if the pipeline accepted a pose from this image."""
    if state.last_accepted_pose is None or state.last_accepted_pose.pose.t_s != seen.t_s:
        return seen
    pose, T_body_cam = state.last_accepted_pose.pose, pipeline.pose_setup.T_body_cam
    R_cam_target = np.asarray(cv2.Rodrigues(pose.rvec_rad)[0]) @ R_MARKER_TARGET
    T_cam_target = make_T(R_cam_target, pose.tvec_m)
    R_level_body = np.eye(3) if attitude is None else attitude.R_level_body
    T_level_cam = make_T(R_level_body, np.zeros(3)) @ T_body_cam
    order = [3, 4, 5, 0, 1, 2]
    covariance = target_rotation_translation_cov_cam(pose)[np.ix_(order, order)]
    print_m = T_level_cam[:3, :3].T @ pose.position_shift_per_print_error_sigma_m
    covariance[:3, :3] += print_m @ print_m.T
    level = None if attitude is None else T_level_cam @ T_cam_target
    return replace(seen, T_cam_target=T_cam_target, covariance=covariance, T_level_target=level)
