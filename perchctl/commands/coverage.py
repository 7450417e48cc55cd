"""Progress of a calibration on the terminal: one bar while pictures are searched, four
bars of coverage while they are taken. A pipe gets one line an event instead."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table
from rich.text import Text

_BAR_WIDTH = 30
_REFRESH_HZ = 8


@contextlib.contextmanager
def search_bar(stream: TextIO | None = None) -> Iterator[Callable[[int, int | None], None]]:
    """Yields the function to call with pictures done, and how many there are if known."""
    console = Console(file=stream or sys.stderr)
    if not console.is_terminal:
        yield lambda done, total: None
        return
    columns = (TextColumn("searching the board"), BarColumn(), MofNCompleteColumn())
    with Progress(
        *columns, console=console, refresh_per_second=_REFRESH_HZ, redirect_stdout=False
    ) as progress:
        task = progress.add_task("", total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)


@contextlib.contextmanager
def coverage_bars(
    stream: TextIO | None = None,
) -> Iterator[Callable[[Mapping[str, float], int, str], None]]:
    """Yields the function to call with the coverage (0..1 each), the views taken, and the
    advice of the moment."""
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
