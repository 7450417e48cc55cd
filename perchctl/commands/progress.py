"""Displays during a command: progress bars, and guidance through a measurement."""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import partial
from typing import Any, Protocol, TextIO

from rich.console import Console
from rich.live import Live
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import calibration as calibrations
from perchctl import display as displays

_WHOLE_RUN_S = 1e6
"""Period over which progress is averaged to estimate the remaining time, s. Rich's default of 30 s
is too short: not a single flight might end within it."""


class FinishedFlight(Protocol):
    """Result of a flight that has ended, in any kind of campaign."""

    @property
    def outcome(self) -> str: ...


@contextlib.contextmanager
def progress_bar(
    total: int,
    earlier: Iterable[FinishedFlight] = (),
    stream: TextIO | None = None,
    unit: str = "flights",
) -> Iterator[Callable[[FinishedFlight], None]]:
    """Show a bar that counts flights; yield the function to call with each result. The bar starts
    with the `earlier` results."""
    ends = Counter(result.outcome for result in earlier)
    columns = (TimeRemainingColumn(), TextColumn("{task.description}"))
    with _bar(unit, *columns, total=total, stream=stream, width=8) as update:

        def show() -> None:
            counted = " ".join(f"{n} {end}" for end, n in ends.items())
            update(completed=ends.total(), description=counted)

        def advance(result: FinishedFlight) -> None:
            ends[result.outcome] += 1
            show()

        show()
        yield advance


@contextlib.contextmanager
def count_bar(label: str, total: int | None, is_shown: bool = True) -> Iterator[Callable[[], None]]:
    """Show a progress bar; yield the function that advances it by one. `total`: None if unknown."""
    with _bar(label, TimeRemainingColumn(), total=total, is_shown=is_shown) as update:
        yield lambda: update(advance=1)


@contextlib.contextmanager
def done_of_total_bar(
    label: str, total: int | None = None
) -> Iterator[Callable[[int, int | None], None]]:
    """Show a progress bar; yield the function that sets the number done and the total. `total`:
    the total until then, None if unknown."""
    with _bar(label, total=total) as update:
        yield lambda done, total: update(completed=done, total=total)


class _DoneOfTotalColumn(ProgressColumn):
    """The number done, and the total if it is known."""

    def render(self, task: Task) -> Text:
        of = "" if task.total is None else f"/{int(task.total)}"
        return Text(f"{int(task.completed)}{of}", style="progress.download")


@contextlib.contextmanager
def _bar(
    label: str,
    *more: ProgressColumn,
    total: int | None = None,
    stream: TextIO | None = None,
    is_shown: bool = True,
    width: int = 40,
) -> Iterator[Callable[..., Any]]:
    console = Console(file=stream or sys.stderr)
    if not (is_shown and console.is_terminal):
        yield lambda **changes: None
        return
    with Progress(
        TextColumn(label),
        BarColumn(width),
        _DoneOfTotalColumn(),
        *more,
        console=console,
        redirect_stdout=False,
        speed_estimate_period=_WHOLE_RUN_S,
    ) as progress:
        yield partial(progress.update, progress.add_task("", total=total))


# --- Guidance for the user ---

_BAR_WIDTH = 30
_GUIDE_HZ = 8


@contextlib.contextmanager
def guidance_display(
    page: displays.LivePage | None, stream: TextIO | None = None
) -> Iterator[Callable[[calibrations.GuidedFrame], None]]:
    """Yield the function that shows a guided frame: on a terminal as a table, otherwise as one line
    per change, and also on the live page if there is one."""
    console = Console(file=stream or sys.stderr)
    with contextlib.ExitStack() as stack:
        table: Live | None = None
        if console.is_terminal:
            table = stack.enter_context(
                Live(console=console, refresh_per_second=_GUIDE_HZ, redirect_stdout=False)
            )
        last_line = ""

        def show(guided: calibrations.GuidedFrame) -> None:
            nonlocal last_line
            if table is not None:
                table.update(_table(guided))
            elif guided.status_line != last_line:
                last_line = guided.status_line
                line = f"perchctl: {guided.status_line}"
                console.print(line, markup=False, highlight=False, soft_wrap=True)
            if page is not None:
                page.show(displays.Sketch(guided.image, guided.outlines))
                page.set_state(lambda: page_state(guided))

        yield show


def _table(guided: calibrations.GuidedFrame) -> Table:
    table = Table.grid(padding=(0, 1))
    for name, text, bar in guided.rows:
        if bar is None:
            table.add_row(name, Text(text), "")
            continue
        until = round(_BAR_WIDTH * bar.end)
        before = max(0, min(round(_BAR_WIDTH * bar.start), until - 1))
        drawn = Text.assemble(
            ("." * before, "dim"),
            ("#" * (until - before), "green" if bar.is_enough else "yellow"),
            ("." * (_BAR_WIDTH - until), "dim"),
        )
        table.add_row(name, drawn, text)
    table.add_row("", Text(guided.advice, style="bold"), "")
    return table


def page_state(guided: calibrations.GuidedFrame) -> dict[str, Any]:
    """Return the state of the live page: rows (some with a bar) and headline."""
    rows = [[name, text, bar and asdict(bar)] for name, text, bar in guided.rows]
    return {"rows": rows, "phase": guided.advice}
