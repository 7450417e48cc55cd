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
    Task,
    TextColumn,
)
from rich.text import Text

_REFRESH_HZ = 4
LINE_S = 10.0


class TimeLeft(ProgressColumn):
    """From the first one that is done; rich's own looks at the last 30 s only, in which no
    flight may have ended."""

    def render(self, task: Task) -> Text:
        if not task.completed or task.total is None or task.elapsed is None:
            return Text("")
        left_s = task.elapsed / task.completed * (task.total - task.completed)
        return Text(f"{_clock_text(left_s)} left")


def _clock_text(s: float) -> str:
    minutes, seconds = divmod(round(s), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}"


class Ended(Protocol):
    """A flight's result, of whatever campaign."""

    @property
    def outcome(self) -> str: ...


class _Count:
    """What has been flown so far, and how fast."""

    def __init__(
        self,
        total: int,
        earlier: Iterable[Ended],
        clock: Callable[[], float],
    ) -> None:
        self.total, self._clock = total, clock
        self._ends = Counter(result.outcome for result in earlier)
        self._before, self._began_s = self._ends.total(), clock()
        self.said_s = self._began_s

    def add(self, result: Ended) -> None:
        self._ends[result.outcome] += 1

    @property
    def flown(self) -> int:
        return self._ends.total()

    @property
    def ends(self) -> str:
        return " ".join(f"{n} {end}" for end, n in self._ends.items())

    @property
    def pace(self) -> str:
        """Flights a minute and time left; of those that were flown now."""
        elapsed_s, now = self._clock() - self._began_s, self.flown - self._before
        if not now or elapsed_s <= 0.0:
            return ""
        left_s = elapsed_s / now * max(0, self.total - self.flown)
        return f"{60.0 * now / elapsed_s:.1f}/min {_clock_text(left_s)} left"

    def line(self) -> str | None:
        """For what is no terminal, each `LINE_S` at most; the last flight's is the result's."""
        if self.flown >= self.total or self._clock() - self.said_s < LINE_S:
            return None
        self.said_s = self._clock()
        return f"perchctl: flown {self.flown} of {self.total} {self.pace} {self.ends}"


@contextlib.contextmanager
def progress_bar(
    total: int,
    stream: TextIO | None = None,
    earlier: Iterable[Ended] = (),
    clock: Callable[[], float] = time.monotonic,
) -> Iterator[Callable[[Ended], None]]:
    """Yields the function to call with each finished flight: a line of 80 columns that changes
    on a terminal, elsewhere a new one each `LINE_S` at most. `earlier`: flown before."""
    count = _Count(total, earlier, clock)
    stream = stream or sys.stderr
    text = TextColumn("{task.description}")
    with _bar("flights", text, total=total, stream=stream, width=8) as update:
        update(completed=count.flown, description=count.ends)

        def advance(result: Ended) -> None:
            count.add(result)
            update(completed=count.flown, description=f"{count.pace} {count.ends}")
            if not stream.isatty() and (line := count.line()) is not None:
                with contextlib.suppress(OSError, ValueError):  # nobody reads any more
                    print(line, file=stream, flush=True)

        yield advance


@contextlib.contextmanager
def count_bar(
    what: str, total: int | None, wanted: bool = True, stream: TextIO | None = None
) -> Iterator[Callable[[], None]]:
    """Yields the function to call for each one done; `total` None is an unknown number."""
    with _bar(what, TimeLeft(), total=total, stream=stream, wanted=wanted) as update:
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
        *columns, console=console, refresh_per_second=_REFRESH_HZ, redirect_stdout=False
    ) as progress:
        yield partial(progress.update, progress.add_task("", total=total))
