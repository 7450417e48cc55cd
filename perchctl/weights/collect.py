"""Collecting the data: a person places the camera, checked rows of the session's file come out.

A session is a CSV (`perchctl.weights.data`) to which whole positions are appended, each in one
write: it can be stopped at any time and continued, and a line that a crash cut in two is taken
off when it is continued. Shaken and half-seen positions are refused and taken again.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perchctl.calibration import polled
from perchctl.camera import FrameSource, check_size
from perchctl.errors import Interrupted, InvalidValue, NotFound
from perchctl.files import cannot_be_written
from perchctl.geometry import Array, wrap_rad
from perchctl.profile import Profile
from perchctl.vision import (
    MARKERS,
    Attitude,
    CameraModel,
    Frame,
    MarkerPose,
    PipelineState,
    estimate_pose,
    make_pipeline,
    step,
)
from perchctl.weights.data import HEADER, row_text
from perchctl.weights.truth import Actual, Ask, Truth, moved

SEEN_SHARE = 0.9
"""Of a position's frames both markers must be in so many."""
STILL_PX = 1.0
"""The target's picture must not wander farther than this within a position (between its
thirds), nor shake with a greater standard deviation."""
FAR_M, FAR_RAD = 0.03, math.radians(10.0)
"""A typed pose that differs from the camera's by more is asked about."""
_LEAST_FRAMES = 3

Bar = Callable[[str, int], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True, eq=False)
class MarkerReading:
    """What one frame gives: poses (x, y, z, yaw), each (4,) or None where it was not found.

    `center_px` (2,) is the mean of both markers' corners, None where one is missing."""

    t_s: float
    large: Array | None
    small: Array | None
    joint: Array | None
    center_px: Array | None


def read_markers(
    frames: Iterable[Frame],
    profile: Profile,
    camera: CameraModel,
    attitude: Attitude | None = None,
) -> Iterator[MarkerReading]:
    """The poses in the frames of one place, relative to the gear in the level frame, by the
    profile's pipeline as it is when it merges by weights."""
    merge = profile.merge.model_copy(update={"method": "weights"})
    setup = make_pipeline(profile.model_copy(update={"merge": merge}), camera)
    state = PipelineState()
    for frame in frames:
        state, output = step(state, frame, attitude, setup)
        seen = [d for name in MARKERS if (d := output.detections.get(name)) is not None]
        both = len(seen) == 2
        joint = estimate_pose(seen, frame.t_s, attitude, setup.pose) if both else None
        yield MarkerReading(
            frame.t_s,
            _vector(output.poses.get("large")),
            _vector(output.poses.get("small")),
            _vector(joint),
            np.concatenate([d.corners_px for d in seen]).mean(axis=0) if both else None,
        )


def _vector(pose: MarkerPose | None) -> Array | None:
    return None if pose is None else np.array([*pose.e_m, pose.e_yaw_rad])


def fault_of(readings: list[MarkerReading]) -> str | None:
    """Why a position must be taken again, in one sentence; None when it is good."""
    count = len(readings)
    if count < _LEAST_FRAMES:
        return f"only {count} frames came"
    for name in MARKERS:
        seen = sum(getattr(reading, name) is not None for reading in readings)
        if seen < SEEN_SHARE * count:
            return (
                f"half seen: the {name} marker was found in {seen} of {count} frames; move so "
                f"that both markers are whole in the picture"
            )
    centers = np.array([r.center_px for r in readings if r.center_px is not None])
    if len(centers) < _LEAST_FRAMES:
        return f"half seen: both markers at once were found in {len(centers)} of {count} frames"
    thirds = np.array([part.mean(axis=0) for part in np.array_split(centers, 3)])
    drift_px = float(np.linalg.norm(np.ptp(thirds, axis=0)))
    wander_px = max(float(np.linalg.norm(centers.std(axis=0))), drift_px)
    if wander_px > STILL_PX:
        return (
            f"shaken: the target wandered {wander_px:.1f} px in the picture (allowed is "
            f"{STILL_PX:g}); fix the camera and hold still"
        )
    return None


def rows_of(position: int, readings: Iterable[MarkerReading], actual: Array) -> str:
    """The lines of a position in the session's file."""
    return "".join(row_text(position, r.t_s, [r.large, r.small, actual, r.joint]) for r in readings)


class SessionFile:
    """The file of a session. Errors: InvalidValue for a file that is something else.

    Attributes:
        note: a sentence, if an unfinished end was taken off.
        done: numbers of the positions that are complete.
    """

    def __init__(self, path: Path, frames: int) -> None:
        self.path = path
        self.note = ""
        self.done: list[int] = []
        if path.exists() and path.stat().st_size:
            self._continue(frames)
        else:
            self._write(HEADER + "\n", "w")

    @property
    def next_position(self) -> int:
        return max(self.done, default=0) + 1

    def append(self, position: int, rows: str) -> None:
        """One whole position, brought to the disk."""
        self._write(rows, "a")
        self.done.append(position)

    def _write(self, text: str, mode: str) -> None:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open(mode, encoding="utf-8", newline="") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise cannot_be_written(self.path, error) from None

    def _continue(self, frames: int) -> None:
        *lines, torn = self.path.read_bytes().split(b"\n")
        if not lines or lines[0].strip() != HEADER.encode():
            raise InvalidValue(
                f"{self.path}: line 1: not a session of perchctl (its header differs), so "
                f"nothing is appended; name a new file"
            )
        try:
            positions = [int(line.partition(b",")[0]) for line in lines[1:]]
        except ValueError:
            raise InvalidValue(f"{self.path}: a row's position is not a whole number") from None
        counts = Counter(positions)
        if torn:
            # The position that was being written: its tail is lost, so all of it is taken again.
            if positions and counts[positions[-1]] < frames:
                del lines[-counts.pop(positions[-1]) :]
            os.truncate(self.path, sum(len(line) + 1 for line in lines))
            self.note = f"{self.path}: an unfinished end was taken off"
        self.done = list(counts)


class Experiment:
    """Takes positions with a person until the session is full.

    `ask` prints a question and returns the answer, `say` prints a sentence; `bar` shows
    progress; `now` and `wait` are the clock.
    """

    def __init__(
        self,
        session: SessionFile,
        source: FrameSource,
        profile: Profile,
        camera: CameraModel,
        truth: Truth,
        ask: Ask,
        say: Callable[[str], None],
        bar: Bar,
        now: Callable[[], float],
        wait: Callable[[float], None],
    ) -> None:
        self._session, self._source, self._truth = session, source, truth
        self._profile, self._camera = profile, camera
        self._ask, self._say, self._bar, self._now, self._wait = ask, say, bar, now, wait

    def run(self, positions: int, frames: int) -> None:
        """Errors: Interrupted when the person stops (the session keeps what is complete),
        and those of the source and the truth."""
        while len(self._session.done) < positions:
            number = self._session.next_position
            self._say(
                f"position {len(self._session.done) + 1} of {positions}: place the camera so "
                f"that both markers are whole in the picture, at another height, place and heading"
            )
            fault = self._take(number, frames)
            if fault is None:
                self._say(f"position {number} is kept in {self._session.path}")
            else:
                self._say(f"position {number} is refused, take it again: {fault}")

    def _take(self, number: int, frames: int) -> str | None:
        """One position into the file; a sentence if it must be taken again."""
        try:
            before = self._truth.actual(self._answer)
        except InvalidValue as error:
            return str(error)
        self._answer("hold still and press Enter (q stops): ")
        shown = self._frames(frames)
        readings = []
        with self._bar("frames", frames) as advance:
            for reading in read_markers(shown, self._profile, self._camera, before.attitude):
                readings.append(reading)
                advance()
        fault = fault_of(readings)
        if fault is None and self._truth.repeatable:
            fault = moved(before, self._truth.actual(self._answer))
        if fault is None:
            fault = self._mismatch(before, readings)
        if fault is None:
            self._session.append(number, rows_of(number, readings, before.pose))
        return fault

    def _answer(self, question: str) -> str:
        try:
            text = self._ask(question)
        except EOFError:
            text = "q"
        if text.strip().lower() in ("q", "quit"):
            raise Interrupted(
                f"stopped with {len(self._session.done)} positions in {self._session.path}; the "
                f"same command goes on from there"
            )
        return text

    def _mismatch(self, actual: Actual, readings: list[MarkerReading]) -> str | None:
        """A sentence if the camera measures another pose, and the person does not keep it."""
        poses = np.array([r.large for r in readings if r.large is not None])
        poses[:, 3] = np.unwrap(poses[:, 3])
        seen = np.median(poses, axis=0)
        off_m = float(np.linalg.norm(seen[:3] - actual.pose[:3]))
        off_rad = abs(wrap_rad(float(seen[3] - actual.pose[3])))
        if off_m <= FAR_M and off_rad <= FAR_RAD:
            return None
        expected = _pose_text(actual.pose)
        self._say(f"the camera measures {_pose_text(seen)}, but the actual pose is {expected}")
        if self._answer("keep it all the same? [y/N] ").strip().lower() in ("y", "yes"):
            return None
        return "the actual pose does not fit what the camera sees"

    def _frames(self, count: int) -> Iterator[Frame]:
        if self._source.live:
            self._source.poll(self._now())  # taken before Enter was pressed
        got = 0
        for _, frame in polled(self._source, self._now, self._wait):
            if frame is None or frame.repeated:
                continue
            if got == 0:
                height, width = frame.image.shape[:2]
                check_size((width, height), self._camera, self._source.describe())
            got += 1
            yield frame
            if got == count:
                return
        raise NotFound(
            f"{self._source.describe()} ended after {got} of {count} frames of the position"
        )


def _pose_text(pose: Array) -> str:
    x, y, z = (float(v) * 100.0 for v in pose[:3])
    return f"({x:.1f}, {y:.1f}, {z:.1f}) cm at {math.degrees(wrap_rad(float(pose[3]))):.0f} deg"
