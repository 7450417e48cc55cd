"""Collecting the data: a person places the camera, checked rows of the session's file come out.

A session is a CSV (`perchctl.weights.data`) to which whole positions are appended, each in one
write: it can be stopped at any time and continued, and a line that a crash cut in two is taken
off when it is continued. Shaken and half-seen positions are refused and taken again.

The actual pose of a position is given by a person or by motion capture. It is what the pipeline
measures: the target relative to the gear's tip in the level frame, (x, y, z, yaw).
"""

from __future__ import annotations

import math
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from perchctl.calibration import poll_frames
from perchctl.camera import FrameSource, check_size
from perchctl.errors import ConnectionFailed, Interrupted, InvalidValue, NotFound, PerchError
from perchctl.files import cannot_be_written
from perchctl.geometry import Array, rot_z, rotation_from_rpy, rpy_from_rotation, wrap_rad
from perchctl.positioning import BodyPose, CaptureFrame, Placed
from perchctl.profile import PositioningConfig, Profile
from perchctl.vision import (
    MARKERS,
    Attitude,
    CameraModel,
    Frame,
    MarkerPose,
    PipelineState,
    make_pipeline,
    step,
)
from perchctl.weights.data import HEADER, row_text

SEEN_SHARE = 0.9
"""Of a position's frames both markers must be in so many."""
STILL_PX = 1.0
"""The target's picture must not wander farther than this within a position (between its
thirds), nor shake with a greater standard deviation."""
FAR_M, FAR_RAD = 0.03, math.radians(10.0)
"""A typed pose that differs from the camera's by more must be confirmed."""
SAMPLES = 30
"""Poses of motion capture whose median is the actual pose; they must come within `WITHIN_S`."""
WITHIN_S = 5.0
MOVED_M, MOVED_RAD = 0.003, math.radians(1.0)
"""A vehicle that moved farther than this while its frames were taken was not held still."""
_LEAST_FRAMES = 3

Ask = Callable[[str], str]
"""Prints a question and returns the answer."""
Bar = Callable[[str, int], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True, eq=False)
class MarkerReading:
    """The poses (x, y, z, yaw) in one frame, each (4,) or None where it was not found.

    `center_px` (2,) is the mean of both markers' corners, None where one is missing."""

    t_s: float
    large: Array | None
    small: Array | None
    center_px: Array | None


def read_markers(
    frames: Iterable[Frame],
    profile: Profile,
    camera: CameraModel,
    attitude: Attitude | None = None,
) -> Iterator[MarkerReading]:
    """Yield the poses in the frames of one place, relative to the gear in the level frame, by the
    profile's pipeline as it is when it merges by weights."""
    merge = profile.merge.model_copy(update={"method": "weights"})
    setup = make_pipeline(profile.model_copy(update={"merge": merge}), camera)
    state = PipelineState()
    for frame in frames:
        state, output = step(state, frame, attitude, setup)
        seen = [d for name in MARKERS if (d := output.detections.get(name)) is not None]
        yield MarkerReading(
            frame.t_s,
            _vector(output.poses.get("large")),
            _vector(output.poses.get("small")),
            np.concatenate([d.corners_px for d in seen]).mean(axis=0) if len(seen) == 2 else None,
        )


def _vector(pose: MarkerPose | None) -> Array | None:
    return None if pose is None else np.array([*pose.e_m, pose.e_yaw_rad])


def position_fault(readings: list[MarkerReading]) -> str | None:
    """Return why a position must be taken again, in one sentence; None when it is good."""
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


def session_rows(position: int, readings: Iterable[MarkerReading], actual: Array) -> str:
    """Return the lines of a position in the session's file."""
    return "".join(row_text(position, r.t_s, [r.large, r.small, actual]) for r in readings)


class SessionFile:
    """The file of a session. Raises InvalidValue for a file that is something else.

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
        """Number of the position to take next, from 1."""
        return max(self.done, default=0) + 1

    def append(self, position: int, rows: str) -> None:
        """Append one whole position, and bring it to the disk."""
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


# --- The actual pose --------------------------------------------------


@dataclass(frozen=True, eq=False)
class ActualPose:
    """The actual pose (4,), and the attitude of the vehicle, None where it stands level."""

    pose: Array
    attitude: Attitude | None = None


def motion_fault(before: ActualPose, after: ActualPose) -> str | None:
    """Return one sentence if the vehicle moved in between, None if it was held still."""
    way_m = float(np.linalg.norm(after.pose[:3] - before.pose[:3]))
    turn_rad = abs(wrap_rad(float(after.pose[3] - before.pose[3])))
    if way_m <= MOVED_M and turn_rad <= MOVED_RAD:
        return None
    return (
        f"shaken: the vehicle moved by {way_m * 1e3:.1f} mm and {math.degrees(turn_rad):.1f} deg "
        f"while the frames were taken; hold still"
    )


class TypedTruth:
    """A person with a ruler: centimetres and degrees, as in the paper's tables."""

    repeatable = False  # a second answer would show nothing

    def actual(self, ask: Ask) -> ActualPose:
        """Ask the person for the pose. Raises InvalidValue for an answer that is no pose."""
        text = ask("actual pose of the target from the gear, x y z [cm] and yaw [deg]: ")
        try:
            x, y, z, yaw = (float(cell) for cell in text.replace(",", " ").split())
        except ValueError:
            x = y = z = yaw = math.nan
        if not math.isfinite(x + y + z + yaw):
            raise InvalidValue(
                f"{text.strip()!r} is not a pose: four numbers are needed, x y z and yaw"
            )
        return ActualPose(np.array([0.01 * x, 0.01 * y, 0.01 * z, wrap_rad(math.radians(yaw))]))

    def close(self) -> None:
        """Do nothing: a person needs no closing."""


class CapturedFrames(Protocol):
    """The part of a motion capture that is needed here."""

    def frames(self) -> list[CaptureFrame]: ...

    def problem(self, now_s: float) -> str | None: ...

    def close(self) -> None: ...


class MocapTruth:
    """Motion capture, by the reader that flights have.

    Args:
        config: names the capture and the vehicle's rigid body, and how that lies in body axes.
        target: rigid body of the target; its x axis is the heading.
    """

    repeatable = True

    def __init__(
        self,
        capture: CapturedFrames,
        config: PositioningConfig,
        target: str,
        gear_body_m: Array,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._capture, self._config, self._target = capture, config, target
        self._gear, self._now, self._wait = gear_body_m, now, wait

    def actual(self, ask: Ask) -> ActualPose:
        """Return the median of `SAMPLES` captured poses. Raises ConnectionFailed, NotFound."""
        self._capture.frames()  # older ones do not count
        poses: dict[str, list[BodyPose]] = {self._config.body: [], self._target: []}
        seen: set[str] = set()
        until_s = self._now() + WITHIN_S
        while missing := [name for name, found in poses.items() if len(found) < SAMPLES]:
            frames = self._capture.frames()
            for frame in frames:
                seen |= set(frame.bodies)
                for name in poses.keys() & frame.bodies.keys():
                    poses[name].append(frame.bodies[name])
            if self._now() > until_s:
                raise self._unseen(missing[0], seen)
            if not frames:
                self._wait(0.01)
        for name, found in poses.items():
            if len(set(found)) == 1:
                raise NotFound(
                    f"{self._config.label} has {name!r} frozen: {SAMPLES} times the same numbers, "
                    f"and a measured pose has noise"
                )
        target_m, (_, _, target_yaw) = _median(poses[self._target], PositioningConfig())
        body_m, (roll, pitch, yaw) = _median(poses[self._config.body], self._config)
        level = rot_z(-yaw) @ (target_m - body_m)
        e_m = level - rotation_from_rpy(roll, pitch, 0.0) @ self._gear
        attitude = Attitude(0.0, roll, pitch, yaw, (body_m[0], body_m[1], body_m[2]))
        return ActualPose(np.array([*e_m, wrap_rad(target_yaw - yaw)]), attitude)

    def close(self) -> None:
        """End the capture."""
        self._capture.close()

    def _unseen(self, missing: str, seen: set[str]) -> PerchError:
        problem = self._capture.problem(self._now())
        if problem is not None:
            return ConnectionFailed(problem)
        return NotFound(
            f"{self._config.label} does not see the rigid body {missing!r}; it sees "
            f"{', '.join(sorted(seen)) or 'none'}"
        )


def _median(
    poses: list[BodyPose], mounted: PositioningConfig
) -> tuple[Array, tuple[float, float, float]]:
    """Return the position (3,) m, and roll, pitch, yaw in rad of the body's axes in the world."""
    placed = [Placed.of(pose, mounted) for pose in poses]
    rpy = np.unwrap([rpy_from_rotation(each.R) for each in placed], axis=0)
    roll, pitch, yaw = (float(angle) for angle in np.median(rpy, axis=0))
    return np.median([each.position_m for each in placed], axis=0), (roll, pitch, wrap_rad(yaw))


# --- The dialogue -----------------------------------------------------


@dataclass(frozen=True, eq=False)
class Experiment:
    """Takes positions with a person until the session is full.

    `say` prints a sentence; `bar` shows progress; `now` and `wait` are the clock.
    """

    session: SessionFile
    source: FrameSource
    profile: Profile
    camera: CameraModel
    truth: TypedTruth | MocapTruth
    ask: Ask
    say: Callable[[str], None]
    bar: Bar
    now: Callable[[], float]
    wait: Callable[[float], None]

    def run(self, positions: int, frames: int) -> None:
        """Take positions until the session holds so many. Raises Interrupted when the person stops
        (the session keeps what is complete), and the errors of the source and the truth."""
        while len(self.session.done) < positions:
            number = self.session.next_position
            self.say(
                f"position {len(self.session.done) + 1} of {positions}: place the camera so "
                f"that both markers are whole in the picture, at another height, place and heading"
            )
            fault = self._take(number, frames)
            if fault is None:
                self.say(f"position {number} is kept in {self.session.path}")
            else:
                self.say(f"position {number} is refused, take it again: {fault}")

    def _take(self, number: int, frames: int) -> str | None:
        """Take one position into the file; return a sentence if it must be taken again."""
        try:
            before = self.truth.actual(self._answer)
        except InvalidValue as error:
            return str(error)
        self._answer("hold still and press Enter (q stops): ")
        shown = self._frames(frames)
        readings = []
        with self.bar("frames", frames) as advance:
            for reading in read_markers(shown, self.profile, self.camera, before.attitude):
                readings.append(reading)
                advance()
        fault = position_fault(readings)
        if fault is None and self.truth.repeatable:
            fault = motion_fault(before, self.truth.actual(self._answer))
        if fault is None:
            fault = self._mismatch(before, readings)
        if fault is None:
            self.session.append(number, session_rows(number, readings, before.pose))
        return fault

    def _answer(self, question: str) -> str:
        try:
            text = self.ask(question)
        except EOFError:
            text = "q"
        if text.strip().lower() in ("q", "quit"):
            raise Interrupted(
                f"stopped with {len(self.session.done)} positions in {self.session.path}; the "
                f"same command goes on from there"
            )
        return text

    def _mismatch(self, actual: ActualPose, readings: list[MarkerReading]) -> str | None:
        """Return a sentence if the camera measures another pose, and the person does not keep
        it."""
        poses = np.array([r.large for r in readings if r.large is not None])
        poses[:, 3] = np.unwrap(poses[:, 3])
        seen = np.median(poses, axis=0)
        off_m = float(np.linalg.norm(seen[:3] - actual.pose[:3]))
        off_rad = abs(wrap_rad(float(seen[3] - actual.pose[3])))
        if off_m <= FAR_M and off_rad <= FAR_RAD:
            return None
        expected = _pose_text(actual.pose)
        self.say(f"the camera measures {_pose_text(seen)}, but the actual pose is {expected}")
        if self._answer("keep it all the same? [y/N] ").strip().lower() in ("y", "yes"):
            return None
        return "the actual pose does not fit what the camera sees"

    def _frames(self, count: int) -> Iterator[Frame]:
        if self.source.live:
            self.source.poll(self.now())  # taken before Enter was pressed
        got = 0
        for _, frame in poll_frames(self.source, self.now, self.wait):
            if frame is None or frame.repeated:
                continue
            if got == 0:
                height, width = frame.image.shape[:2]
                check_size((width, height), self.camera, self.source.describe())
            got += 1
            yield frame
            if got == count:
                return
        raise NotFound(
            f"{self.source.describe()} ended after {got} of {count} frames of the position"
        )


def _pose_text(pose: Array) -> str:
    x, y, z = (float(v) * 100.0 for v in pose[:3])
    return f"({x:.1f}, {y:.1f}, {z:.1f}) cm at {math.degrees(wrap_rad(float(pose[3]))):.0f} deg"
