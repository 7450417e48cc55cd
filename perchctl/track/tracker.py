"""Tracking frame by frame: the pipeline's memory, what deserves a sentence, what is counted."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from perchctl.camera import mirrored_note
from perchctl.display import PageState, Sketch
from perchctl.geometry import wrap_rad, yaw_of
from perchctl.perception import INTERLACED, Perception
from perchctl.profile import CameraConfig, Profile
from perchctl.track.result import Tracked, text_rows, track_record, tracked_of
from perchctl.vision import (
    MARKERS,
    CameraModel,
    Frame,
    MarkerPose,
    Pipeline,
    PipelineOutput,
    camera_profile,
    make_pipeline,
)

MOST_NOTES = 20
# A live picture that stands still or is noise is no measurement; the others are searched.
_NO_PICTURE = ("frozen", "snow")
_DISAGREE = "the two markers contradict: check the print's sizes and the calibration"


def camera_pipeline(profile: Profile, camera: CameraModel, stills: bool = False) -> Pipeline:
    """The profile's pipeline with the camera in the place of vehicle and gear, so that
    its target is in the camera frame. Stills are each searched as thoroughly as can be."""
    bare = camera_profile(profile)
    if stills:
        detector = bare.detector.model_copy(update={"blurred_every": 1})
        bare = bare.model_copy(update={"detector": detector})
    return make_pipeline(bare, camera)


@dataclass(eq=False)
class Tracker:
    """Frame in, results out; nothing is remembered with `stills`.

    `notes` are the sentences that the newest picture deserves.
    """

    setup: Pipeline
    live: bool
    stills: bool = False
    disagreement_frames: int = 15
    camera: CameraConfig = field(default_factory=CameraConfig)
    notes: tuple[str, ...] = ()
    output: PipelineOutput | None = None
    picture: Frame | None = None
    more: bool = False  # another field of the same frame follows
    _last: Tracked | None = None
    _pose: MarkerPose | None = None  # the newest that a picture showed
    _interlaced: bool = False

    def __post_init__(self) -> None:
        self._perception = Perception(self.setup, stills=self.stills)

    def results(self, frame: Frame, name: str | int) -> Iterator[Tracked]:
        """The frame's result, or those of its two fields; none for a live source's repetition
        of the last picture. `picture`, `notes` and `output` are those of the newest."""
        judged = self._perception.assess(frame, self.live or not self.stills)
        if self.live and judged.kind == "repeated":
            return
        self.picture, self.output = frame, None
        self.notes = () if judged.kind in ("ok", "repeated") else (judged.text,)
        if self.live and judged.kind in _NO_PICTURE:
            yield Tracked(name, frame.t_s)
            return
        about, self.notes = self.notes, ()
        looked = list(self._perception.look(frame))
        for k, (picture, output) in enumerate(looked, start=1):
            self.more = k < len(looked)
            yield self._track(picture, output, name, about)

    def _track(
        self, picture: Frame, output: PipelineOutput, name: str | int, about: tuple[str, ...]
    ) -> Tracked:
        last = None if self._last is None else self._last.target
        self.picture, self.output = picture, output
        self._last = tracked_of(name, picture.t_s, output, not self.stills, last)
        self.notes = about
        interlaced = output.fields != "whole"
        if not self.stills:  # at rest nothing is combed, and that is no news
            self._interlaced = interlaced = interlaced or self._interlaced
        if interlaced:
            self.notes += (INTERLACED,)
        if output.lock_note:
            self.notes += (output.lock_note,)
        pose = pose_in(output)
        if not self.stills and jumped(self._pose, pose):
            self.notes += (JUMPS,)
        self._pose = pose or self._pose
        if output.detections.mirrored:
            self.notes += (mirrored_note(self.camera),)
        if output.disagreeing_frames >= (1 if self.stills else self.disagreement_frames):
            self.notes += (_DISAGREE,)
        return self._last


@dataclass(eq=False)
class Tally:
    """The counts of the summary."""

    frames: int = 0
    large: int = 0
    small: int = 0
    started_s: float = 0.0
    notes: Counter[str] = field(default_factory=Counter)

    def add(self, tracked: Tracked, notes: tuple[str, ...]) -> None:
        self.frames += 1
        self.large += tracked.large is not None
        self.small += tracked.small is not None
        self.notes.update({_kind(note) for note in notes})

    def text(self, now_s: float) -> str:
        took_s = max(now_s - self.started_s, 1e-6)
        share = 100.0 / max(self.frames, 1)
        plural = "frame" if self.frames == 1 else "frames"
        counted = "".join(f"; {note} in {n}" for note, n in self.notes.items())
        return (
            f"{self.frames} {plural} in {took_s:.1f} s ({self.frames / took_s:.0f} a second): "
            f"large {share * self.large:.0f} %, small {share * self.small:.0f} %{counted}"
        )


class Notes:
    """Sentences for the user: one when a condition begins, `MOST_NOTES` at the most.

    `say` prints one.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._before: frozenset[str] = frozenset()
        self._left = MOST_NOTES
        self._silent = False

    def changes(self, frame: str | int, notes: tuple[str, ...]) -> None:
        for note in notes:
            if _kind(note) in self._before:
                continue
            where = frame if isinstance(frame, str) else f"frame {frame}"
            self._left -= 1
            if self._left >= 0:
                self._say(f"{where}: {note}")
            if self._left == 0:
                self._say("more of this kind is only counted from here on")
        self._before = frozenset(map(_kind, notes))
        self._silent = False

    def silence(self, problem: str | None) -> None:
        """`problem`: why the source gives no frame at present; None if it only has none yet."""
        if problem is not None and not self._silent:
            self._say(f"{problem}; waiting for it (Ctrl-C ends)")
        self._silent = self._silent or problem is not None


def _kind(note: str) -> str:
    """The note without what differs from frame to frame."""
    return re.split("[:,]", note, maxsplit=1)[0]


def sketch_of(frame: Frame, tracked: Tracked, axis_m: float) -> Sketch:
    """Return the frame with the outlines of its markers and, where there is a target, its axes,
    each `axis_m` long."""
    target = tracked.target
    found = ((name, tracked.get(name)) for name in MARKERS)
    return Sketch(
        frame.image,
        tuple((name, seen.corners_px) for name, seen in found if seen is not None),
        None if target is None else (target.rvec_rad, target.tvec_m, axis_m),
    )


def track_state(tracked: Tracked, notes: tuple[str, ...]) -> PageState:
    """Return what the live page shows of a frame, ready for JSON."""
    return {
        "rows": [list(row) for row in text_rows(tracked)],
        "note": "; ".join(notes),
        "track": track_record(tracked),
    }


# --- Whether the pictures of a recording belong to one movement --------------------------------


JUMPS = (
    "the target jumps from one picture to the next: pictures that do not belong together need "
    "--stills"
)
# No hand moves or turns a camera faster.
_FASTEST_MPS, _FASTEST_RADPS = 2.0, 7.0
_SAME_SIGMAS = 3.0
_JUDGED_WITHIN_S = 0.5


def pose_in(output: PipelineOutput) -> MarkerPose | None:
    """What the picture alone says."""
    poses = output.poses
    return next((poses[name] for name in ("joint", "large", "small") if name in poses), None)


def jumped(before: MarkerPose | None, after: MarkerPose | None) -> bool:
    """Whether the target moved or turned in the camera's frame as no movement can have it."""
    if before is None or after is None or not 0.0 < after.t_s - before.t_s < _JUDGED_WITHIN_S:
        return False
    dt_s = after.t_s - before.t_s
    range_m = max(float(np.linalg.norm(pose.tvec_m)) for pose in (before, after))
    moved_m = float(np.linalg.norm(after.tvec_m - before.tvec_m))
    turned_rad = abs(wrap_rad(_yaw_rad(after) - _yaw_rad(before)))
    noise_m = _SAME_SIGMAS * float(np.linalg.norm([before.sigma_m, after.sigma_m]))
    noise_rad = _SAME_SIGMAS * math.hypot(before.sigma_yaw_rad, after.sigma_yaw_rad)
    return (
        moved_m > (_FASTEST_MPS + _FASTEST_RADPS * range_m) * dt_s + noise_m
        or turned_rad > _FASTEST_RADPS * dt_s + noise_rad
    )


def _yaw_rad(pose: MarkerPose) -> float:
    return yaw_of(np.asarray(cv2.Rodrigues(pose.rvec_rad)[0], dtype=np.float64))
