"""A live camera in a guided measurement: its frames, and what is shown to the user."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from perchctl.camera import FrameSource, Grey
from perchctl.errors import TimedOut
from perchctl.geometry import Array
from perchctl.vision import Frame

CALIBRATION_POLL_S = 0.005
GONE_AFTER_S = 3.0


@dataclass(frozen=True)
class GuidanceBar:
    """The filled part of a bar, from `start` to `end` (0..1), and whether it is enough."""

    start: float
    end: float
    is_enough: bool


@dataclass(frozen=True, eq=False)
class GuidedFrame:
    """A frame of a guided recording, with the guidance shown beside it.

    Attributes:
        index, image: the frame's number and image (h, w).
        outlines: kind and corners, (n, 2) px, of each detection.
        rows: name, text and bar (or None) of each value to show.
        advice: what to do now.
        status_line: the state in one line, for output to a pipe.
        taken: True if the measurement uses this frame.
    """

    index: int
    image: Grey
    outlines: tuple[tuple[str, Array], ...]
    rows: tuple[tuple[str, str, GuidanceBar | None], ...]
    advice: str
    status_line: str
    taken: bool = False


def poll_frames(
    source: FrameSource, clock: Callable[[], float], sleep: Callable[[float], None]
) -> Iterator[tuple[float, Frame | None]]:
    """Poll a source until it has ended; yield the time of each poll with the new frame, or None.

    Raises TimedOut if the source reports a problem and has delivered no frame for `GONE_AFTER_S`.
    """
    last_s = clock()
    while True:
        now_s = clock()
        frame = source.poll(now_s)
        if frame is not None:
            last_s = now_s
        elif source.finished:
            return
        elif (problem := source.problem(now_s)) and now_s - last_s > GONE_AFTER_S:
            raise TimedOut(problem)
        yield now_s, frame
        if frame is None:
            sleep(CALIBRATION_POLL_S)
