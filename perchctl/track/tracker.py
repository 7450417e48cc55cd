"""Tracking frame by frame: the pipeline's memory, what deserves a sentence, what is counted."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from perchctl.camera import mirrored_note
from perchctl.display import PageState, Sketch
from perchctl.perception import BLENDED, INTERLACED, Perception
from perchctl.profile import Profile
from perchctl.track.result import CameraPose, Tracked, text_rows, track_record, tracked_of
from perchctl.vision import (
    MARKERS,
    CameraModel,
    Frame,
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


class Tracker:
    """Frame in, results out; nothing is remembered with `stills`."""

    def __init__(self, profile: Profile, camera: CameraModel, *, live: bool, stills: bool) -> None:
        self._perception = Perception(camera_pipeline(profile, camera, stills), stills=stills)
        self._config, self._live, self._stills = profile.camera, live, stills
        self._disagreement_frames = 1 if stills else profile.merge.disagreement_frames
        self._target: CameraPose | None = None
        self._interlaced = False

    def results(self, frame: Frame, name: str | int) -> list[Tracked]:
        """The frame's result, or those of its two fields; none for a live source's repetition
        of the last picture."""
        judged = self._perception.assess(frame, self._live or not self._stills)
        if self._live and judged.kind == "repeated":
            return []
        about = () if judged.kind in ("ok", "repeated") else (judged.text,)
        if self._live and judged.kind in _NO_PICTURE:
            return [Tracked(name, frame.t_s, frame.image, notes=about)]
        return [
            self._track(name, picture, output, about)
            for picture, output in self._perception.look(frame)
        ]

    def _track(
        self, name: str | int, picture: Frame, output: PipelineOutput, about: tuple[str, ...]
    ) -> Tracked:
        notes = (*about, *self._notes(output))
        tracked = tracked_of(name, picture, output, not self._stills, self._target, notes)
        self._target = tracked.target
        return tracked

    def _notes(self, output: PipelineOutput) -> Iterator[str]:
        interlaced = output.fields != "whole"
        if not self._stills:  # at rest nothing is combed, and that is no news
            self._interlaced = interlaced = interlaced or self._interlaced
        if interlaced:
            yield INTERLACED
        if output.detections.ghost_px > 0.0:
            yield BLENDED
        if output.lock_note:
            yield output.lock_note
        if output.detections.mirrored:
            yield mirrored_note(self._config)
        if output.disagreeing_frames >= self._disagreement_frames:
            yield _DISAGREE


@dataclass(eq=False)
class Tally:
    """The counts of the summary."""

    frames: int = 0
    large: int = 0
    small: int = 0
    started_s: float = 0.0
    notes: Counter[str] = field(default_factory=Counter)

    def add(self, tracked: Tracked) -> None:
        self.frames += 1
        self.large += tracked.large is not None
        self.small += tracked.small is not None
        self.notes.update({_kind(note) for note in tracked.notes})

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

    def add(self, tracked: Tracked) -> None:
        """Say what is new in this result."""
        for note in tracked.notes:
            if _kind(note) in self._before:
                continue
            name = tracked.frame
            where = name if isinstance(name, str) else f"frame {name}"
            self._left -= 1
            if self._left >= 0:
                self._say(f"{where}: {note}")
            if self._left == 0:
                self._say("more of this kind is only counted from here on")
        self._before = frozenset(map(_kind, tracked.notes))
        self._silent = False

    def silence(self, problem: str | None) -> None:
        """`problem`: why the source gives no frame at present; None if it only has none yet."""
        if problem is not None and not self._silent:
            self._say(f"{problem}; waiting for it (Ctrl-C ends)")
        self._silent = self._silent or problem is not None


def _kind(note: str) -> str:
    """The note without what differs from frame to frame."""
    return re.split("[:,]", note, maxsplit=1)[0]


def sketch_of(tracked: Tracked, axis_m: float) -> Sketch:
    """Return the picture with the outlines of its markers and, where there is a target, its axes,
    each `axis_m` long."""
    target = tracked.target
    found = ((name, tracked.get(name)) for name in MARKERS)
    return Sketch(
        tracked.image,
        tuple((name, seen.corners_px) for name, seen in found if seen is not None),
        None if target is None else (target.rvec_rad, target.tvec_m, axis_m),
    )


def track_state(tracked: Tracked) -> PageState:
    """Return what the live page shows of a frame, ready for JSON."""
    return {
        "rows": [list(row) for row in text_rows(tracked)],
        "note": "; ".join(tracked.notes),
        "track": track_record(tracked),
    }
