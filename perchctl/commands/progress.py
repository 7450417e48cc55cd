"""Bars of progress on stderr: on a terminal only; in a pipe or a file nothing, or of campaigns a
line now and then."""

from __future__ import annotations

import contextlib
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, Protocol, TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)

_REFRESH_HZ = 4
_WHOLE_RUN_S = 1e6
"""Over which the time left is estimated: in rich's own 30 s no flight may have ended."""
LINE_S = 10.0


class Ended(Protocol):
    """A flight's result, of whatever campaign."""

    @property
    def outcome(self) -> str: ...


@contextlib.contextmanager
def progress_bar(
    total: int,
    stream: TextIO | None = None,
    earlier: Iterable[Ended] = (),
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Callable[[Ended], None]]:
    """Yields the function to call with each finished flight: a line of 80 columns that changes
    on a terminal, elsewhere a new one each `LINE_S` at most. `earlier`: flown before."""
    stream = stream or sys.stderr
    ends = Counter(result.outcome for result in earlier)
    before, began_s = ends.total(), clock()
    printed_s = began_s
    text = TextColumn("{task.description}")
    with _bar("flights", text, total=total, stream=stream, width=8) as update:
        update(completed=before, description=_counted(ends))

        def advance(result: Ended) -> None:
            nonlocal printed_s
            ends[result.outcome] += 1
            flown, now_s = ends.total(), clock()
            pace = _pace(flown - before, now_s - began_s, max(0, total - flown))
            update(completed=flown, description=f"{pace} {_counted(ends)}")
            if stream.isatty() or flown >= total or now_s - printed_s < LINE_S:
                return
            printed_s = now_s
            with contextlib.suppress(OSError, ValueError):  # nobody reads any more
                line = f"perchctl: flown {flown} of {total} {pace} {_counted(ends)}"
                print(line, file=stream, flush=True)

        yield advance


def _counted(ends: Counter[str]) -> str:
    return " ".join(f"{n} {end}" for end, n in ends.items())


def _pace(flown: int, elapsed_s: float, left: int) -> str:
    """Flights a minute, and the time that is left at this pace."""
    if elapsed_s <= 0.0:
        return ""
    minutes, seconds = divmod(round(elapsed_s / flown * left), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{60.0 * flown / elapsed_s:.1f}/min {hours}:{minutes:02}:{seconds:02} left"


@contextlib.contextmanager
def count_bar(
    what: str, total: int | None, wanted: bool = True, stream: TextIO | None = None
) -> Iterator[Callable[[], None]]:
    """Yields the function to call for each one done; `total` None is an unknown number."""
    left = TimeRemainingColumn()
    with _bar(what, left, total=total, stream=stream, wanted=wanted) as update:
        yield lambda: update(advance=1)


@contextlib.contextmanager
def search_bar(
    what: str, stream: TextIO | None = None
) -> Iterator[Callable[[int, int | None], None]]:
    """Yields the function to call with the number done, and the number to do if known."""
    with _bar(what, total=None, stream=stream) as update:
        yield lambda done, total: update(completed=done, total=total)


@contextlib.contextmanager
def _bar(
    what: str,
    *more: ProgressColumn,
    total: int | None,
    stream: TextIO | None,
    wanted: bool = True,
    width: int = 40,
) -> Iterator[Callable[..., Any]]:
    """Yields what changes the bar, as `Progress.update` does. stdout is left alone."""
    console = Console(file=stream or sys.stderr)
    if not (wanted and console.is_terminal):
        yield lambda **changes: None
        return
    columns = (TextColumn(what), BarColumn(width), MofNCompleteColumn(), *more)
    with Progress(
        *columns,
        console=console,
        refresh_per_second=_REFRESH_HZ,
        redirect_stdout=False,
        speed_estimate_period=_WHOLE_RUN_S,
    ) as progress:
        yield partial(progress.update, progress.add_task("", total=total))
