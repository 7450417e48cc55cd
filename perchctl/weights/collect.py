"""Collect the data for a fit: the user places the camera, and checked rows are added to the
session's file.

A session is a CSV file (`perchctl.weights.data`) to which each position is appended in a single
write. A session can be stopped and continued at any time; a crash loses at most the last position.

The actual pose at each position is typed by the user or measured by motion capture. Like the
pipeline's poses, it is the pose of the target relative to the gear's tip in the level frame, (x, y,
z, yaw).
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

import numpy as np

from perchctl.calibration import poll_frames
from perchctl.camera import FrameSource, check_size
from perchctl.errors import ConnectionFailed, Interrupted, InvalidValue, NotFound
from perchctl.files import check_writable, write_error
from perchctl.geometry import Array, rot_z, rotation_from_rpy, rpy_from_rotation, wrap_rad
from perchctl.positioning import CaptureFrame, CaptureSource, VehiclePose
from perchctl.profile import PositioningConfig, Profile
from perchctl.vision import (
    MARKERS,
    CameraModel,
    Frame,
    MarkerPose,
    PipelineState,
    VehicleState,
    make_pipeline,
    step,
)
from perchctl.weights.data import HEADER, csv_row

SEEN_SHARE = 0.9
"""Fraction of the frames at a position that must show both markers."""
MOST_WANDER_PX = 1.0
"""Largest drift and largest jitter of the target's image at one position, px."""
MOST_MISMATCH_M = 0.03
"""Difference from the camera's pose above which an actual pose is a mistake, m. Larger: a mistake
is taken for an error in the camera's pose."""
MOST_MISMATCH_RAD = math.radians(10.0)
"""Difference from the camera's yaw above which an actual yaw is a mistake, rad."""
SAMPLES = 30
"""Number of motion-capture frames whose median is the actual pose. The frames must arrive within
`WITHIN_S`."""
WITHIN_S = 5.0
_LEAST_FRAMES = 3

Ask = Callable[[str], str]
"""Prints a question and returns the answer."""
Bar = Callable[[str, int], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True, eq=False)
class MarkerReading:
    """The poses of both markers (x, y, z, yaw; m and rad) in one frame, (4,) each; None if a marker
    was not found.

    `center_px` (2,) is the mean of both markers' corners; None if a pose is missing.
    """

    t_s: float
    large: Array | None
    small: Array | None
    center_px: Array | None


def read_markers(
    frames: Iterable[Frame],
    profile: Profile,
    camera: CameraModel,
    attitude: VehicleState | None = None,
) -> Iterator[MarkerReading]:
    """Yield the markers' poses in the frames at one position, relative to the gear in the level
    frame, from the profile's pipeline with `merge.method: weights`."""
    merge = profile.merge.model_copy(update={"method": "weights"})
    setup = make_pipeline(profile.model_copy(update={"merge": merge}), camera)
    state = PipelineState()
    for frame in frames:
        state, output = step(state, frame, attitude, setup)
        found, poses = output.detections, output.poses
        seen = [d for name in MARKERS if (d := found.get(name)) is not None and name in poses]
        yield MarkerReading(
            frame.t_s,
            _vector(output.poses.get("large")),
            _vector(output.poses.get("small")),
            np.concatenate([d.corners_px for d in seen]).mean(axis=0) if len(seen) == 2 else None,
        )


def _vector(pose: MarkerPose | None) -> Array | None:
    return None if pose is None else np.array([*pose.e_m, pose.e_yaw_rad])


def position_fault(readings: list[MarkerReading]) -> str | None:
    """Return, in one sentence, why a position must be measured again; None if it is good."""
    count = len(readings)
    if count < _LEAST_FRAMES:
        return f"only {count} frames arrived"
    centers = np.array([r.center_px for r in readings if r.center_px is not None])
    if len(centers) < SEEN_SHARE * count:
        return (
            f"both markers were seen together in only {len(centers)} of {count} frames; "
            "move the camera so that both are wholly in view"
        )
    thirds = np.array([part.mean(axis=0) for part in np.array_split(centers, 3)])
    drift_px = float(np.linalg.norm(np.ptp(thirds, axis=0)))
    wander_px = max(float(np.linalg.norm(centers.std(axis=0))), drift_px)
    if wander_px > MOST_WANDER_PX:
        return (
            f"not still: the target moved by {wander_px:.1f} px in the image (at most "
            f"{MOST_WANDER_PX:g} px allowed); fix the camera in place"
        )
    return None


def session_rows(position: int, readings: Iterable[MarkerReading], actual: Array) -> str:
    """Return the CSV lines for the position with this number, each with the actual pose (4,)."""
    return "".join(csv_row(position, r.t_s, [r.large, r.small, actual]) for r in readings)


class SessionFile:
    """The CSV file of a session. The constructor raises InvalidValue for any other file.

    Attributes:
        note: a sentence if an incomplete last position was removed; otherwise empty.
        done: number of complete positions.
        next_position: number of the next position, above all numbers in the file.
    """

    def __init__(self, path: Path, frames: int) -> None:
        self.path = path
        self.note = ""
        self.done, self.next_position = 0, 1
        if path.exists() and path.stat().st_size:
            self._continue(frames)
        else:
            check_writable(path, force=True, makes_folder=False)
            self._write(HEADER + "\n", "w")

    def append(self, rows: str) -> None:
        """Append all rows of a position, and flush them to the disk."""
        self._write(rows, "a")
        self.done += 1
        self.next_position += 1

    def _write(self, text: str, mode: str) -> None:
        try:
            with self.path.open(mode, encoding="utf-8", newline="") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise write_error(self.path, error) from None

    def _continue(self, frames: int) -> None:
        try:
            *lines, torn = self.path.read_bytes().split(b"\n")
        except OSError as error:
            raise InvalidValue(f"{self.path} cannot be read: {error.strerror}") from None
        if not lines or lines[0].strip() != HEADER.encode():
            raise InvalidValue(
                f"{self.path}: line 1: not a perchctl session (its header differs), so nothing "
                "was appended; name a new file"
            )
        try:
            positions = [int(line.partition(b",")[0]) for line in lines[1:]]
        except ValueError:
            raise InvalidValue(f"{self.path}: a row's position is not a whole number") from None
        rows = Counter(positions)
        if torn:
            # The last position was only partly written, so the whole position must be measured
            # again.
            if positions and rows[positions[-1]] < frames:
                del lines[-rows.pop(positions[-1]) :]
            os.truncate(self.path, sum(len(line) + 1 for line in lines))
            self.note = f"{self.path}: removed an incomplete position at the end"
        self.done, self.next_position = len(rows), max(rows, default=0) + 1


# --- The actual pose ---


ActualPose = tuple[Array, VehicleState | None]
"""The actual pose (4,), and the vehicle's attitude; None if the vehicle is level."""


class TypedPoses:
    """Actual poses that the user measures and types in centimetres and degrees."""

    def actual_pose(self, ask: Ask) -> ActualPose:
        """Ask the user for the pose. Raises InvalidValue if the answer is not four numbers."""
        text = ask("actual pose of the target relative to the gear, x y z [cm] and yaw [deg]: ")
        try:
            x, y, z, yaw = (float(cell) for cell in text.replace(",", " ").split())
        except ValueError:
            x = y = z = yaw = math.nan
        if not math.isfinite(x + y + z + yaw):
            raise InvalidValue(f"{text.strip()!r} is not a pose: enter four numbers, x y z and yaw")
        return np.array([0.01 * x, 0.01 * y, 0.01 * z, wrap_rad(math.radians(yaw))]), None

    def close(self) -> None:
        """Do nothing."""


class MocapPoses:
    """Actual poses from motion capture, read as in flights.

    Args:
        config: the settings of the motion-capture system, of the vehicle's rigid body and of that
            body's mounting.
        target: name of the target's rigid body; its x axis is the heading.
        gear_body_m: the gear's tip in body axes, (3,).
    """

    def __init__(
        self,
        capture: CaptureSource,
        config: PositioningConfig,
        target: str,
        gear_body_m: Array,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._capture, self._config, self._target = capture, config, target
        self._gear, self._now, self._wait = gear_body_m, now, wait

    def actual_pose(self, ask: Ask) -> ActualPose:
        """The median of `SAMPLES` measured poses. Raises ConnectionFailed, NotFound."""
        self._capture.poll(self._now())  # older frames are ignored
        frames: list[CaptureFrame] = []
        until_s = self._now() + WITHIN_S
        while len(frames) < SAMPLES:
            frame = self._capture.poll(self._now())
            if frame is not None and {self._config.body, self._target} <= frame.bodies.keys():
                frames.append(frame)
            if self._now() > until_s:
                if (problem := self._capture.problem(self._now())) is not None:
                    raise ConnectionFailed(problem)
                raise NotFound(
                    f"{self._config.label} does not see both rigid bodies, {self._config.body!r} "
                    f"and {self._target!r}"
                )
            self._wait(0.002)
        target_m, (_, _, target_yaw) = _median(frames, self._target, PositioningConfig())
        body_m, (roll, pitch, yaw) = _median(frames, self._config.body, self._config)
        level = rot_z(-yaw) @ (target_m - body_m)
        e_m = level - rotation_from_rpy(roll, pitch, 0.0) @ self._gear
        attitude = VehicleState(0.0, roll, pitch, yaw, (body_m[0], body_m[1], body_m[2]))
        return np.array([*e_m, wrap_rad(target_yaw - yaw)]), attitude

    def close(self) -> None:
        """Close the connection to the motion-capture system."""
        self._capture.close()


def _median(
    frames: list[CaptureFrame], body: str, mounted: PositioningConfig
) -> tuple[Array, tuple[float, float, float]]:
    """The median position (3,), m, and the median roll, pitch and yaw of the body's axes in the
    world, rad."""
    placed = [VehiclePose.of(frame.bodies[body], mounted) for frame in frames]
    rpy = np.unwrap([rpy_from_rotation(each.R) for each in placed], axis=0)
    roll, pitch, yaw = (float(angle) for angle in np.median(rpy, axis=0))
    return np.median([each.position_m for each in placed], axis=0), (roll, pitch, wrap_rad(yaw))


# --- The dialogue ---


@dataclass(frozen=True, eq=False)
class Experiment:
    """Collects poses at positions to which the user moves the camera.

    `truth` returns actual poses, `say` prints a sentence, and `bar` shows progress; `now` and
    `wait` are the clock.
    """

    session: SessionFile
    source: FrameSource
    profile: Profile
    camera: CameraModel
    truth: TypedPoses | MocapPoses
    ask: Ask
    say: Callable[[str], None]
    bar: Bar
    now: Callable[[], float]
    wait: Callable[[float], None]

    def run(self, positions: int, frames: int) -> None:
        """Collect positions with `frames` frames each, until the session contains `positions`
        positions.

        Raises Interrupted if the user stops (complete positions are kept), and the errors of the
        source and of `truth`.
        """
        while self.session.done < positions:
            number = self.session.next_position
            self.say(
                f"position {self.session.done + 1} of {positions}: place the camera so that "
                "both markers are wholly in view, at a different height, position and heading"
            )
            fault = self._try_position(number, frames)
            if fault is None:
                self.say(f"position {number} was saved to {self.session.path}")
            else:
                self.say(f"position {number} was rejected, measure it again: {fault}")

    def _try_position(self, number: int, frames: int) -> str | None:
        """Measure one position and add it to the file. Return a sentence if it must be measured
        again."""
        try:
            actual, attitude = self.truth.actual_pose(self._answer)
        except InvalidValue as error:
            return str(error)
        self._answer("hold still and press Enter (q stops): ")
        shown = self._frames(frames)
        readings = []
        with self.bar("frames", frames) as advance:
            for reading in read_markers(shown, self.profile, self.camera, attitude):
                readings.append(reading)
                advance()
        fault = position_fault(readings) or _mismatch(actual, readings)
        if fault is None:
            self.session.append(session_rows(number, readings, actual))
        return fault

    def _answer(self, question: str) -> str:
        try:
            text = self.ask(question)
        except EOFError:
            text = "q"
        if text.strip().lower() in ("q", "quit"):
            raise Interrupted(
                f"stopped with {self.session.done} positions in {self.session.path}; run the "
                "same command again to continue"
            )
        return text

    def _frames(self, count: int) -> Iterator[Frame]:
        if self.source.live:
            self.source.poll(self.now())  # discard a frame from before Enter was pressed
        got = 0
        for _, frame in poll_frames(self.source, self.now, self.wait):
            if frame is None or frame.is_repeated:
                continue
            if got == 0:
                height, width = frame.image.shape[:2]
                check_size((width, height), self.camera, self.source.describe())
            got += 1
            yield frame
            if got == count:
                return
        raise NotFound(
            f"{self.source.describe()} ended after {got} of the {count} frames needed at "
            "this position"
        )


def _mismatch(actual: Array, readings: list[MarkerReading]) -> str | None:
    poses = np.array([r.large for r in readings if r.large is not None])
    poses[:, 3] = np.unwrap(poses[:, 3])
    seen = np.median(poses, axis=0)
    off_m = float(np.linalg.norm(seen[:3] - actual[:3]))
    off_rad = abs(wrap_rad(float(seen[3] - actual[3])))
    if off_m <= MOST_MISMATCH_M and off_rad <= MOST_MISMATCH_RAD:
        return None
    return f"the camera measures {_pose_text(seen)}, but the actual pose is {_pose_text(actual)}"


def _pose_text(pose: Array) -> str:
    x, y, z = (float(v) * 100.0 for v in pose[:3])
    return f"({x:.1f}, {y:.1f}, {z:.1f}) cm at {math.degrees(wrap_rad(float(pose[3]))):.0f} deg"
