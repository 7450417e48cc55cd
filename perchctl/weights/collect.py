"""Collecting the data: frames of one place in, checked rows of the session's file out.

A session is a CSV (`perchctl.weights.table`) to which whole positions are appended, each
in one write: it can be stopped at any time and continued, and a line that a crash cut in
two is taken off when it is continued.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perchctl.errors import InvalidValue
from perchctl.files import cannot_be_written
from perchctl.geometry import Array
from perchctl.profile import Profile
from perchctl.vision import (
    MARKERS,
    Attitude,
    CameraModel,
    Frame,
    MarkerPose,
    Pipeline,
    PipelineState,
    estimate_pose,
    make_pipeline,
    step,
)
from perchctl.weights.table import HEADER, row_text

SEEN_SHARE = 0.9
"""Of a position's frames both markers must be in so many."""
STILL_PX = 1.0
"""The target's picture must not wander farther than this within a position (between its
thirds), nor shake with a greater standard deviation."""
_LEAST_FRAMES = 3


@dataclass(frozen=True, eq=False)
class MarkerReading:
    """What one frame gives: poses (x, y, z, yaw), each (4,) or None where it was not found.

    `center_px` (2,) is the mean of both markers' corners, None where one is missing."""

    t_s: float
    large: Array | None
    small: Array | None
    joint: Array | None
    center_px: Array | None


def collecting_pipeline(profile: Profile, camera: CameraModel) -> Pipeline:
    """The profile's pipeline, as it is when it merges by weights."""
    merge = profile.merge.model_copy(update={"method": "weights"})
    return make_pipeline(profile.model_copy(update={"merge": merge}), camera)


class MarkerReader:
    """Takes the frames of one place through the pipeline; a new place needs a new reader."""

    def __init__(self, setup: Pipeline, attitude: Attitude | None = None) -> None:
        self._setup, self._attitude = setup, attitude
        self._state = PipelineState()

    def read(self, frame: Frame) -> MarkerReading:
        self._state, output = step(self._state, frame, self._attitude, self._setup)
        detections = output.detections
        seen = [d for name in MARKERS if (d := detections.get(name)) is not None]
        both = len(seen) == 2
        joint = estimate_pose(seen, frame.t_s, self._attitude, self._setup.pose) if both else None
        return MarkerReading(
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
    spread_px = float(np.linalg.norm(centers.std(axis=0)))
    thirds = np.array([part.mean(axis=0) for part in np.array_split(centers, 3)])
    drift_px = float(np.linalg.norm(np.ptp(thirds, axis=0)))
    if max(spread_px, drift_px) > STILL_PX:
        return (
            f"shaken: the target wandered {max(spread_px, drift_px):.1f} px in the picture "
            f"(allowed is {STILL_PX:g}); fix the camera and hold still"
        )
    return None


def typical(readings: list[MarkerReading]) -> Array:
    """Median of the large marker's pose, (4,); yaw about the first one's."""
    poses = np.array([r.large for r in readings if r.large is not None])
    poses[:, 3] = np.unwrap(poses[:, 3])
    return np.asarray(np.median(poses, axis=0))


def rows_of(position: int, readings: Iterable[MarkerReading], actual: Array) -> str:
    return "".join(row_text(position, r.t_s, [r.large, r.small, actual, r.joint]) for r in readings)


class SessionFile:
    """The file of a session. Errors: InvalidValue for a file that is something else."""

    def __init__(self, path: Path, frames: int) -> None:
        self._path = path
        self.note = ""
        self.done: list[int] = []
        """Numbers of the positions that are complete."""
        if path.exists() and path.stat().st_size:
            self._continue(frames)
        else:
            self._write(HEADER + "\n", "x" if not path.exists() else "w")

    @property
    def path(self) -> Path:
        return self._path

    @property
    def next_position(self) -> int:
        return max(self.done, default=0) + 1

    def append(self, position: int, rows: str) -> None:
        """One whole position, brought to the disk."""
        self._write(rows, "a")
        self.done.append(position)

    def _write(self, text: str, mode: str) -> None:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open(mode, encoding="utf-8", newline="") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise cannot_be_written(self._path, error) from None

    def _continue(self, frames: int) -> None:
        try:
            text = self._path.read_bytes()
        except OSError as error:
            raise InvalidValue(f"{self._path}: cannot be read: {error.strerror}") from None
        head, _, _ = text.partition(b"\n")
        if head.strip() != HEADER.encode():
            raise InvalidValue(
                f"{self._path}: line 1: not a session of perchctl (its header differs), so "
                f"nothing is appended; name a new file for --collect"
            )
        whole = text.rfind(b"\n") + 1
        lines = text[:whole].splitlines(keepends=True)
        counts: dict[int, int] = {}
        for number, line in enumerate(lines[1:], start=2):
            cell = line.partition(b",")[0]
            if not cell.isdigit():
                raise InvalidValue(f"{self._path}: line {number}: position: not a whole number")
            counts[int(cell)] = counts.get(int(cell), 0) + 1
        keep = whole
        last = int(lines[-1].partition(b",")[0]) if len(lines) > 1 else None
        if last is not None and (counts[last] < frames and whole < len(text)):
            # The position that was being written: its tail is lost, so all of it is taken again.
            keep = sum(len(line) for line in lines[: len(lines) - counts[last]])
            del counts[last]
        if keep < len(text):
            os.truncate(self._path, keep)
            self.note = f"{self._path}: an unfinished end was taken off"
        self.done = list(counts)
