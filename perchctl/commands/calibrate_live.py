"""The guided capture of `perchctl calibrate`: a live camera, four bars of coverage, a page."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

import cv2
import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from perchctl.calibration import (
    BoardView,
    CaptureMoment,
    Grey,
    capture_views,
)
from perchctl.camera import FrameSource
from perchctl.commands.interrupt import Stopper
from perchctl.commands.output import say
from perchctl.commands.page import live_page
from perchctl.display import Sketch
from perchctl.errors import InvalidValue
from perchctl.files import write_files
from perchctl.target import Board
from perchctl.vision import CameraModel

_BAR_WIDTH = 30
_REFRESH_HZ = 8
_SIZE_UNTIL_KNOWN_PX = (640, 480)


def captured_views(
    source: FrameSource, board: Board, pictures: Path | None, port: int | None
) -> list[BoardView]:
    """Views of a live camera, taken until all is covered or Ctrl-C ends it.

    Args:
        pictures: the folder that gets their pictures, each as it is taken; None: none does.
        port: of the live page; None: no page.

    Raises:
        InvalidValue: no view was taken. Those of `capture_views`.
    """
    keeper = _Keeper(pictures)
    with contextlib.ExitStack() as stack:
        stack.callback(keeper.tell)
        stop = stack.enter_context(Stopper().installed())
        camera = _any_camera(source.size_px or _SIZE_UNTIL_KNOWN_PX)
        page = stack.enter_context(live_page(camera, "perchctl calibrate", port))
        bars = stack.enter_context(coverage_bars())
        say("show the board near and far, tilted, in all corners (Ctrl-C ends and calibrates)")

        def show(moment: CaptureMoment) -> None:
            if moment.shot:
                keeper.keep(moment.image)
            bars(moment.covered, moment.taken, moment.advice)
            if page is not None:
                page.show(moment.index, sketch_of(moment))
                page.tell(lambda: page_state(moment))

        views = capture_views(source, board, show, stopped=stop.requested.is_set)
    if not views:
        raise InvalidValue(
            f"no view of the board {board.notation()} was taken from {source.describe()}"
        )
    return views


@contextlib.contextmanager
def coverage_bars(
    stream: TextIO | None = None,
) -> Iterator[Callable[[Mapping[str, float], int, str], None]]:
    """Yields the function to call with the coverage (0..1 each), the views taken, and the
    advice of the moment. A pipe gets one line a view."""
    console = Console(file=stream or sys.stderr)
    if not console.is_terminal:
        last: list[int] = [-1]

        def line(covered: Mapping[str, float], taken: int, advice: str) -> None:
            if taken == last[0]:
                return
            last[0] = taken
            shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in covered.items())
            console.print(f"perchctl: {taken} views; {shares}", markup=False, highlight=False)

        yield line
        return
    with Live(console=console, refresh_per_second=_REFRESH_HZ, redirect_stdout=False) as live:
        yield lambda covered, taken, advice: live.update(_table(covered, taken, advice))


def _table(covered: Mapping[str, float], taken: int, advice: str) -> Table:
    table = Table.grid(padding=(0, 1))
    for name, share in covered.items():
        full = round(_BAR_WIDTH * min(max(share, 0.0), 1.0))
        colour = "green" if share >= 1.0 else "yellow"
        bar = Text("#" * full, style=colour) + Text("." * (_BAR_WIDTH - full), style="dim")
        table.add_row(name, bar, f"{100 * share:3.0f} %")
    table.add_row("views", Text(str(taken)), "")
    table.add_row("", Text(advice, style="bold"), "")
    return table


def _any_camera(size_px: tuple[int, int]) -> CameraModel:
    """The page draws the picture and its corners, but no axes: any camera serves."""
    w, h = size_px
    K = np.array([[w, 0.0, w / 2], [0.0, w, h / 2], [0.0, 0.0, 1.0]])
    return CameraModel(size_px, K, np.zeros(5))


def sketch_of(moment: CaptureMoment) -> Sketch:
    outlines: tuple[tuple[str, Any], ...] = ()
    if len(moment.corners_px) >= 3:
        hull = cv2.convexHull(moment.corners_px.astype(np.float32)).reshape(-1, 2)
        outlines = (("small" if moment.shot else "large", hull.astype(np.float64)),)
    return Sketch(moment.image, outlines, None, (moment.advice,))


def page_state(moment: CaptureMoment) -> dict[str, Any]:
    rows: list[list[str | float]] = [
        [name, f"{100 * share:.0f} %", share] for name, share in moment.covered.items()
    ]
    rows.append(["views", str(moment.taken)])
    return {"rows": rows, "phase": moment.advice}


class _Keeper:
    """Writes each picture as it is taken, behind those that the folder has already."""

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._kept = 0
        self._failed = False

    def keep(self, picture: Grey) -> None:
        """Never raises: pictures that cannot be kept are still calibrated from."""
        if self._folder is None or self._failed:
            return
        numbers = (path.stem.removeprefix("view_") for path in self._folder.glob("view_*.png"))
        newest = max((int(number) for number in numbers if number.isdecimal()), default=0)
        png = cv2.imencode(".png", picture)[1].tobytes()
        try:
            write_files({self._folder / f"view_{newest + 1:03d}.png": png})
            self._kept += 1
        except InvalidValue as error:
            self._failed = True
            say(f"pictures are no longer kept: {error}")

    def tell(self) -> None:
        if self._kept:
            say(f"kept {self._kept} pictures: images:{self._folder} takes them again")
