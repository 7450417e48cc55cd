"""Bars of progress on stderr: on a terminal only, nothing in a pipe or a file."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
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


class TimeLeft(ProgressColumn):
    """From the first one that is done; rich's own looks at the last 30 s only, in which no
    flight may have ended."""

    def render(self, task: Task) -> Text:
        if not task.completed or task.total is None or task.elapsed is None:
            return Text("")
        left_s = round(task.elapsed / task.completed * (task.total - task.completed))
        minutes, seconds = divmod(left_s, 60)
        hours, minutes = divmod(minutes, 60)
        return Text(f"{hours}:{minutes:02}:{seconds:02} left")


class Ended(Protocol):
    """A flight's result, of whatever campaign."""

    @property
    def outcome(self) -> str: ...


@contextlib.contextmanager
def progress_bar(total: int, stream: TextIO | None = None) -> Iterator[Callable[[Ended], None]]:
    """Yields the function to call with each finished flight."""
    ends: dict[str, int] = {}
    columns = (TimeLeft(), TextColumn("{task.description}"))
    with _bar("flights", *columns, total=total, stream=stream) as update:

        def advance(result: Ended) -> None:
            ends[result.outcome] = ends.get(result.outcome, 0) + 1
            text = ", ".join(f"{n} {end}" for end, n in ends.items())
            update(advance=1, description=text)

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
) -> Iterator[Callable[..., Any]]:
    """Yields what changes the bar, as `Progress.update` does. stdout is left alone."""
    console = Console(file=stream or sys.stderr)
    if not (wanted and console.is_terminal):
        yield lambda **changes: None
        return
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), *more)
    with Progress(
        *columns, console=console, refresh_per_second=_REFRESH_HZ, redirect_stdout=False
    ) as progress:
        yield partial(progress.update, progress.add_task("", total=total))
