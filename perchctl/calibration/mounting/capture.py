"""Record a vehicle that is moved by hand, and advise which motions are still missing."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from perchctl.calibration.live import GuidanceBar, GuidedFrame, poll_frames
from perchctl.calibration.mounting.pose_reader import PoseReader
from perchctl.calibration.mounting.recording import (
    MIRRORED,
    AttitudeSample,
    MountingPart,
    MountingRecording,
    missing_motion,
)
from perchctl.camera import FrameSource
from perchctl.errors import InvalidValue, TimedOut
from perchctl.vision import Frame

LEAST_RECORDING_S: dict[MountingPart, float] = {"carry": 30.0, "pivot": 20.0}
"""Minimum duration of each part's recording, s, even if no motion is missing."""
MOST_S = 180.0
JUDGED_EVERY_S = 0.5
BEFORE_S = 1.5
"""Attitudes that are older than this at the start of a part, s, cannot belong to any of its
images."""
MIRRORED_PICTURES = 60
"""The recording ends after this many mirrored images if no image has yielded a pose."""
SHARE_OVER = 60
"""The displayed percentage of images with a target is computed from this many of the newest
images."""
LEAST_TARGET_SHARE = 0.3


def record_mounting(
    recording: MountingRecording,
    source: FrameSource,
    reader: PoseReader,
    show: Callable[[GuidedFrame], None],
    attitudes: Callable[[], list[AttitudeSample]] = list,
    problem: Callable[[float], str | None] = lambda now_s: None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Fill the recording until it contains all required motions, a recorded source ends, or
    `stopped` is True.

    Args:
        attitudes: returns the vehicle's new samples, oldest first.
        problem: returns the vehicle's problem at a time, or None.

    Raises:
        TimedOut: the camera or the vehicle is lost; the recording contains the data up to that
            time.
        InvalidValue: the image is mirrored.
    """
    oldest_s = clock() - BEFORE_S
    progress = _Progress(recording)
    for now_s, frame in poll_frames(source, clock, sleep):
        if (trouble := problem(now_s)) is not None:
            raise TimedOut(f"lost the vehicle: {trouble}")
        recording.attitudes += [a for a in attitudes() if a.t_s >= oldest_s]
        if stopped() or (source.live and progress.over):
            return
        if frame is None:
            continue
        poses = reader.read_poses(frame)
        progress.advance_time(frame.t_s if not source.live else now_s)
        # An image without a target is treated as missing.
        if frame.is_repeated and not reader.trouble:
            continue
        recording.poses += poses
        recording.mirrored_pictures = reader.mirrored
        if reader.mirrored >= MIRRORED_PICTURES and not recording.poses:
            raise InvalidValue(MIRRORED)
        show(progress.guided_frame(frame, bool(poses), reader))


class _Progress:
    def __init__(self, recording: MountingRecording) -> None:
        self._recording = recording
        self._least_s = LEAST_RECORDING_S[recording.part]
        self._start_s: float | None = None
        self._judged_s = -JUDGED_EVERY_S
        self._with_target: deque[bool] = deque(maxlen=SHARE_OVER)
        self._missing = [""]
        self._seconds = 0.0

    @property
    def over(self) -> bool:
        """True if no motion is missing, or if too much time has passed."""
        enough = not self._missing and self._seconds >= self._least_s
        return enough or self._seconds >= MOST_S

    def advance_time(self, now_s: float) -> None:
        self._start_s = now_s if self._start_s is None else self._start_s
        self._seconds = now_s - self._start_s

    def guided_frame(self, frame: Frame, seen: bool, reader: PoseReader) -> GuidedFrame:
        recording = self._recording
        self._with_target.append(seen)
        if self._seconds - self._judged_s >= JUDGED_EVERY_S:
            self._judged_s = self._seconds
            self._missing = missing_motion(recording)
        share = sum(self._with_target) / len(self._with_target)
        if reader.trouble:
            advice = reader.trouble
        elif recording.mirrored_pictures > len(recording.poses):
            advice = MIRRORED
        elif share < LEAST_TARGET_SHARE:
            advice = "no target in view"
        else:
            advice = (*self._missing, "enough data; continue a little for a more precise result")[0]
        done = min(self._seconds / self._least_s, 1.0)
        rows = (
            (recording.part, f"{self._seconds:.0f} s of {self._least_s:.0f}", _bar(done)),
            ("target", f"{100 * share:.0f} %", _bar(share)),
            ("pictures", str(len(recording.poses)), None),
            ("missing", ", ".join(self._missing) or "nothing", None),
        )
        line = f"{recording.part}: {advice}"
        return GuidedFrame(frame.index, frame.image, reader.outlines, rows, advice, line)


def _bar(share: float) -> GuidanceBar:
    return GuidanceBar(0.0, share, share >= 1.0)
