"""Recording a vehicle that is moved by hand, with guidance on what is still missing."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.calibration.live import GuidedFrame, poll_frames
from perchctl.calibration.mounting.pose_reader import PoseReader
from perchctl.calibration.mounting.recording import (
    MIRRORED,
    AttitudeSample,
    MountingPart,
    MountingRecording,
    SeenPose,
    missing_motion,
)
from perchctl.camera import FrameSource
from perchctl.errors import InvalidValue, TimedOut
from perchctl.vision import Frame

LEAST_S: dict[MountingPart, float] = {"carry": 30.0, "pivot": 20.0}
"""For which a part is recorded, also where no turn is missing any more: more pictures, and as
many times smaller intervals."""
MOST_S = 180.0
JUDGED_EVERY_S = 0.5
BEFORE_S = 1.5
"""Attitudes older than this when a part begins belong to no picture of it."""
MIRRORED_PICTURES = 60
"""After so many mirrored pictures, and no other, the recording ends."""
SHARE_OVER = 60
"""Number of the newest pictures whose share with a target is shown."""
LEAST_SHARE = 0.3


class MountingTape:
    """The samples that one part has recorded so far."""

    def __init__(self, part: MountingPart, seen_by: str = "") -> None:
        self.part: MountingPart = part
        self.seen_by = seen_by
        self.attitudes: list[AttitudeSample] = []
        self.poses: list[SeenPose] = []
        self.mirrored = 0

    def recording(self) -> MountingRecording:
        """Return what is recorded, by now, as a value."""
        attitudes, poses = tuple(self.attitudes), tuple(self.poses)
        return MountingRecording(self.part, attitudes, poses, self.mirrored, self.seen_by)

    def __bool__(self) -> bool:
        return bool(self.attitudes or self.poses)


@dataclass(frozen=True)
class VehicleSensors:
    """How a recording reads the vehicle: `attitudes` returns those that are new, oldest first, and
    `problem` what is wrong by then, None if nothing is."""

    attitudes: Callable[[], list[AttitudeSample]] = list
    problem: Callable[[float], str | None] = lambda now_s: None


def capture(
    tape: MountingTape,
    source: FrameSource,
    reader: PoseReader,
    sensors: VehicleSensors,
    show: Callable[[GuidedFrame], None],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Fill the tape until no motion is missing, a recorded source has ended, or `stopped`.

    Raises:
        TimedOut: camera or vehicle are gone; the tape keeps what came before.
        InvalidValue: the picture is mirrored.
    """
    oldest_s = clock() - BEFORE_S
    progress = _Progress(tape.part)
    for now_s, frame in poll_frames(source, clock, sleep):
        if (problem := sensors.problem(now_s)) is not None:
            raise TimedOut(f"the vehicle is gone: {problem}")
        tape.attitudes += [a for a in sensors.attitudes() if a.t_s >= oldest_s]
        if stopped() or (source.live and progress.over):
            return
        if frame is None:
            continue
        poses = reader.look(frame)
        progress.advance_time(frame.t_s if not source.live else now_s)
        if frame.repeated and not reader.trouble:  # no picture without a target: no picture
            continue
        tape.poses += poses
        tape.mirrored = reader.mirrored
        if tape.mirrored >= MIRRORED_PICTURES and not tape.poses:
            raise InvalidValue(MIRRORED)
        progress.judge(tape, bool(poses))
        show(progress.guided(frame, tape, reader))


class _Progress:
    """How far the recording of a part is."""

    def __init__(self, part: MountingPart) -> None:
        self._least_s = LEAST_S[part]
        self._start_s: float | None = None
        self._judged_s = -JUDGED_EVERY_S
        self._with_target: deque[bool] = deque(maxlen=SHARE_OVER)
        self._missing: tuple[str, ...] = ("",)
        self._seconds = 0.0

    @property
    def over(self) -> bool:
        """True when no motion is missing, or too much time has gone."""
        enough = not self._missing and self._seconds >= self._least_s
        return enough or self._seconds >= MOST_S

    def advance_time(self, now_s: float) -> None:
        """Count the seconds from the first frame on."""
        self._start_s = now_s if self._start_s is None else self._start_s
        self._seconds = now_s - self._start_s

    def judge(self, tape: MountingTape, seen: bool) -> None:
        """Judge now and then which motion is missing; `seen` is true if the newest picture shows
        the target."""
        self._with_target.append(seen)
        if self._seconds - self._judged_s >= JUDGED_EVERY_S:
            self._judged_s = self._seconds
            self._missing = missing_motion(tape.recording())

    def guided(self, frame: Frame, tape: MountingTape, reader: PoseReader) -> GuidedFrame:
        """Return what to show of the newest frame."""
        share = sum(self._with_target) / max(len(self._with_target), 1)
        if reader.trouble:
            advice = reader.trouble
        elif tape.mirrored > len(tape.poses):
            advice = MIRRORED
        elif share < LEAST_SHARE:
            advice = "no target in view"
        else:
            advice = (*self._missing, "enough; a little longer makes it surer")[0]
        lacking = self._missing or ("nothing",)
        rows = (
            (tape.part, f"{self._seconds:.0f} s of {self._least_s:.0f}",
             min(self._seconds / self._least_s, 1.0)),
            ("target", f"{100 * share:.0f} %", share),
            ("pictures", str(len(tape.poses)), None),
            ("missing", lacking[0], None),
            *(("", motion, None) for motion in lacking[1:]),
        )  # fmt: skip
        line = f"{tape.part}: {advice}"
        return GuidedFrame(frame.index, frame.image, reader.outlines, rows, advice, line)
