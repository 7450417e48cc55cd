"""Recording a vehicle that is moved by hand, with guidance on what is still missing."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from perchctl.calibration.mounting.eye import Eye
from perchctl.calibration.mounting.recording import (
    AttitudeSample,
    MountingPart,
    MountingRecording,
    SeenPose,
)
from perchctl.calibration.mounting.solve import MIRRORED, missing
from perchctl.calibration.types import Grey
from perchctl.camera import FrameSource
from perchctl.errors import InvalidValue, TimedOut
from perchctl.geometry import Array

LEAST_S: dict[MountingPart, float] = {"carry": 30.0, "pivot": 20.0}
"""For which a part is recorded, also where no turn is missing any more: more pictures, and as
many times smaller intervals."""
MOST_S = 180.0
JUDGED_EVERY_S = 0.5
POLL_S = 0.005
GONE_AFTER_S = 3.0
BEFORE_S = 1.5
"""Attitudes older than this when a part begins belong to no picture of it."""
MIRRORED_PICTURES = 60
"""So many without one that is not mirrored, and nobody need go on."""
SHARE_OVER = 60
"""Pictures over which the share with a target is taken."""
LEAST_SHARE = 0.3


class MountingTape:
    """What one part has recorded so far."""

    def __init__(self, part: MountingPart, seen_by: str = "") -> None:
        self.part: MountingPart = part
        self.seen_by = seen_by
        self.attitudes: list[AttitudeSample] = []
        self.poses: list[SeenPose] = []
        self.mirrored = 0

    def recording(self) -> MountingRecording:
        attitudes, poses = tuple(self.attitudes), tuple(self.poses)
        return MountingRecording(self.part, attitudes, poses, self.mirrored, self.seen_by)

    def __bool__(self) -> bool:
        return bool(self.attitudes or self.poses)


@dataclass(frozen=True, eq=False)
class Moment:
    """What to show of a frame.

    Attributes:
        seconds, poses: recorded so far.
        share: of the last pictures, those with the target.
        missing: what motion is, in a few words each.
        advice: the one thing to do now.
    """

    index: int
    image: Grey
    outlines: tuple[tuple[str, Array], ...]
    part: MountingPart
    seconds: float
    poses: int
    share: float
    missing: tuple[str, ...]
    advice: str


@dataclass(frozen=True)
class VehicleSensors:
    """The vehicle's side: new attitudes, oldest first, and what is wrong, if anything is."""

    attitudes: Callable[[], list[AttitudeSample]] = list
    problem: Callable[[float], str | None] = lambda now_s: None


def capture(
    tape: MountingTape,
    source: FrameSource,
    eye: Eye,
    sensors: VehicleSensors,
    show: Callable[[Moment], None],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Fill the tape until no motion is missing, a recorded source has ended, or `stopped`.

    Raises:
        TimedOut: camera or vehicle are gone; the tape keeps what came before.
        InvalidValue: the picture is mirrored.
    """
    run = _Run(tape, eye, clock())
    while not (stopped() or (source.live and run.over)):
        now_s = clock()
        if (problem := sensors.problem(now_s)) is not None:
            raise TimedOut(f"the vehicle is gone: {problem}")
        tape.attitudes += sensors.attitudes()
        run.drop_old()
        frame = source.poll(now_s)
        if frame is not None:
            poses = eye.look(frame)
            if frame.repeated and not eye.trouble:  # no picture without a target: no picture
                run.alive(now_s)
                continue
            tape.poses += poses
            tape.mirrored = eye.mirrored
            if tape.mirrored >= MIRRORED_PICTURES and not tape.poses:
                raise InvalidValue(MIRRORED)
            run.judge(frame.t_s if not source.live else now_s, bool(poses))
            show(run.moment(frame.index, frame.image))
            continue
        if source.finished:
            return
        gone = source.problem(now_s)
        if gone is not None and now_s - run.last_s > GONE_AFTER_S:
            raise TimedOut(gone)
        sleep(POLL_S)


class _Run:
    """How far a part is."""

    def __init__(self, tape: MountingTape, eye: Eye, now_s: float) -> None:
        self._tape, self._eye = tape, eye
        self._start_s: float | None = None
        self._judged_s = -JUDGED_EVERY_S
        self._with_target: deque[bool] = deque(maxlen=SHARE_OVER)
        self._missing: tuple[str, ...] = ("",)
        self._oldest_s = now_s - BEFORE_S
        self.last_s = now_s
        self._seconds = 0.0

    @property
    def over(self) -> bool:
        enough = not self._missing and self._seconds >= LEAST_S[self._tape.part]
        return enough or self._seconds >= MOST_S

    @property
    def share(self) -> float:
        return sum(self._with_target) / max(len(self._with_target), 1)

    def drop_old(self) -> None:
        attitudes = self._tape.attitudes
        while attitudes and attitudes[0].t_s < self._oldest_s:
            attitudes.pop(0)

    def alive(self, now_s: float) -> None:
        """The camera is; time goes on."""
        if self._start_s is None:
            self._start_s = now_s
        self.last_s, self._seconds = now_s, now_s - self._start_s

    def judge(self, now_s: float, seen: bool) -> None:
        self.alive(now_s)
        self._with_target.append(seen)
        if self._seconds - self._judged_s >= JUDGED_EVERY_S:
            self._judged_s = self._seconds
            self._missing = missing(self._tape.recording())

    def moment(self, index: int, image: Grey) -> Moment:
        return Moment(
            index,
            image,
            self._eye.outlines,
            self._tape.part,
            self._seconds,
            len(self._tape.poses),
            self.share,
            self._missing,
            self._advice(),
        )

    def _advice(self) -> str:
        if self._eye.trouble:
            return self._eye.trouble
        if self._tape.mirrored > len(self._tape.poses):
            return MIRRORED
        if self.share < LEAST_SHARE:
            return "no target in view"
        if self._missing:
            return self._missing[0]
        return "enough; a little longer makes it surer"
