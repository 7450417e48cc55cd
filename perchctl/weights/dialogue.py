"""The guided experiment: place, pose, hold still, frames; refused and repeated until good."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

import numpy as np

from perchctl.camera import FrameSource, check_size
from perchctl.errors import Interrupted, InvalidValue, NotFound, TimedOut
from perchctl.geometry import Array, wrap_rad
from perchctl.profile import Profile
from perchctl.vision import CameraModel, Frame
from perchctl.weights.collect import (
    MarkerReader,
    MarkerReading,
    SessionFile,
    collecting_pipeline,
    fault_of,
    rows_of,
    typical,
)
from perchctl.weights.truth import Actual, Ask, Truth, moved

SILENT_S = 5.0
FAR_M, FAR_RAD = 0.03, math.radians(10.0)
"""A typed pose that differs from the camera's by more is asked about."""

Bar = Callable[[str, int], AbstractContextManager[Callable[[], None]]]


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
        self._setup = collecting_pipeline(profile, camera)
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
        reader = MarkerReader(self._setup, before.attitude)
        with self._bar("frames", frames) as advance:
            readings = []
            for frame in self._frames(frames):
                readings.append(reader.read(frame))
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
        seen = typical(readings)
        off_m = float(np.linalg.norm(seen[:3] - actual.pose[:3]))
        off_rad = abs(wrap_rad(float(seen[3] - actual.pose[3])))
        if off_m <= FAR_M and off_rad <= FAR_RAD:
            return None
        expected = pose_text(actual.pose)
        self._say(f"the camera measures {pose_text(seen)}, but the actual pose is {expected}")
        if self._answer("keep it all the same? [y/N] ").strip().lower() in ("y", "yes"):
            return None
        return "the actual pose does not fit what the camera sees"

    def _frames(self, count: int) -> Iterator[Frame]:
        if self._source.live:
            self._source.poll(self._now())  # taken before Enter was pressed
        since_s = self._now()
        got = 0
        while got < count:
            now_s = self._now()
            frame = self._source.poll(now_s)
            if frame is not None and not frame.repeated:
                if got == 0:
                    check_size(
                        (frame.image.shape[1], frame.image.shape[0]),
                        self._setup.camera,
                        self._source.describe(),
                    )
                got, since_s = got + 1, now_s
                yield frame
                continue
            if self._source.finished:
                raise NotFound(
                    f"{self._source.describe()} ended after {got} of {count} frames of the position"
                )
            if now_s - since_s > SILENT_S:
                raise TimedOut(
                    self._source.problem(now_s)
                    or f"{self._source.describe()} gave no frame for {SILENT_S:g} s"
                )
            self._wait(0.002)


def pose_text(pose: Array) -> str:
    x, y, z = (float(v) * 100.0 for v in pose[:3])
    return f"({x:.1f}, {y:.1f}, {z:.1f}) cm at {math.degrees(wrap_rad(float(pose[3]))):.0f} deg"
