"""Guided capture from a live camera: it takes a picture whenever the view is new, sharp
and still, and ends when enough is covered."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from perchctl.calibration.detect import find_board
from perchctl.calibration.enough import MIN_VIEWS
from perchctl.calibration.novelty import Capture, consider, progress
from perchctl.calibration.types import BoardView, Grey
from perchctl.camera import FrameSource
from perchctl.errors import TimedOut
from perchctl.geometry import Array
from perchctl.target import Board

POLL_S = 0.005
GONE_AFTER_S = 3.0


@dataclass(frozen=True, eq=False)
class CaptureMoment:
    """What to show of a frame: the picture, the corners found, the coverage, the advice."""

    index: int
    image: Grey
    corners_px: Array
    covered: dict[str, float]
    taken: int
    advice: str
    shot: bool


def capture_views(
    source: FrameSource,
    board: Board,
    show: Callable[[CaptureMoment], None],
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    stopped: Callable[[], bool] = lambda: False,
) -> list[BoardView]:
    """Views taken, until all is covered or `stopped`; `show` gets each frame, those that are
    taken with `Moment.shot`.

    A source that is gone ends the capture with what there is, if that may be enough.

    Raises TimedOut: the camera is gone before that.
    """
    state = Capture()
    last_s = clock()
    while not (state.finished or stopped()):
        frame = source.poll(clock())
        if frame is None:
            gone = source.problem(clock())
            if source.finished or (gone and clock() - last_s > GONE_AFTER_S):
                if len(state.taken) >= MIN_VIEWS:
                    break
                raise TimedOut(
                    f"{gone or source.describe() + ' has ended'}; only {len(state.taken)} views "
                    f"were taken, at least {MIN_VIEWS} are needed"
                )
            sleep(POLL_S)
            continue
        last_s = clock()
        if frame.repeated:  # it would look still
            continue
        name = f"view {len(state.taken) + 1}"
        seen = find_board(frame.image, board, name)
        state = consider(state, seen, board)
        corners = seen.corners_px if isinstance(seen, BoardView) else np.empty((0, 2))
        show(
            CaptureMoment(
                frame.index,
                frame.image,
                corners,
                progress(state.signatures),
                len(state.taken),
                state.advice,
                state.shot,
            )
        )
    return list(state.taken)
