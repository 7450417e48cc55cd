"""Progress of a campaign or a recording: a bar on a terminal, nothing in a pipe or a file."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from perchctl.flight.results import FlightResult


@contextlib.contextmanager
def progress_bar(
    total: int, stream: TextIO | None = None
) -> Iterator[Callable[[FlightResult], None]]:
    """Yields the function to call with each finished flight; writes to stderr."""
    console = Console(file=stream or sys.stderr)
    if not console.is_terminal:
        yield lambda result: None
        return
    columns = (
        TextColumn("flights"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    # stdout is for data and is left alone.
    with Progress(
        *columns, console=console, refresh_per_second=4, redirect_stdout=False
    ) as progress:
        task = progress.add_task("", total=total)
        ends: dict[str, int] = {}

        def advance(result: FlightResult) -> None:
            ends[result.outcome] = ends.get(result.outcome, 0) + 1
            text = ", ".join(f"{n} {end}" for end, n in ends.items())
            progress.update(task, advance=1, description=text)

        yield advance


@contextlib.contextmanager
def count_bar(
    what: str, total: int | None, wanted: bool = True, stream: TextIO | None = None
) -> Iterator[Callable[[], None]]:
    """Yields the function to call for each one done; `total` None is an unknown number."""
    console = Console(file=stream or sys.stderr)
    if not (wanted and console.is_terminal):
        yield lambda: None
        return
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(
        *columns, console=console, refresh_per_second=4, redirect_stdout=False
    ) as progress:
        task = progress.add_task("", total=total)
        yield lambda: progress.advance(task)
