"""The live page of a command, and how a person is guided: rows with bars on terminal and page."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator
from typing import Any, TextIO

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from perchctl.calibration import GuidedFrame
from perchctl.display import LivePage, Sketch

_BAR_WIDTH = 30
_REFRESH_HZ = 8


@contextlib.contextmanager
def guide(
    page: LivePage | None, stream: TextIO | None = None
) -> Iterator[Callable[[GuidedFrame], None]]:
    """Yield the function that shows a guided frame: as a table on a terminal, in a pipe as a line
    whenever that changes, and on the page if there is one."""
    console = Console(file=stream or sys.stderr)
    with contextlib.ExitStack() as stack:
        table: Live | None = None
        if console.is_terminal:
            table = stack.enter_context(
                Live(console=console, refresh_per_second=_REFRESH_HZ, redirect_stdout=False)
            )
        last_line = ""

        def show(guided: GuidedFrame) -> None:
            nonlocal last_line
            if table is not None:
                table.update(_table(guided))
            elif guided.line != last_line:
                last_line = guided.line
                line = f"perchctl: {guided.line}"
                console.print(line, markup=False, highlight=False, soft_wrap=True)
            if page is not None:
                sketch = Sketch(guided.image, guided.outlines)
                page.show(guided.index, sketch)
                page.set_state(lambda: page_state(guided))

        yield show


def _table(guided: GuidedFrame) -> Table:
    table = Table.grid(padding=(0, 1))
    for name, text, share in guided.rows:
        if share is None:
            table.add_row(name, Text(text), "")
            continue
        full = round(_BAR_WIDTH * min(max(share, 0.0), 1.0))
        colour = "green" if share >= 1.0 else "yellow"
        bar = Text("#" * full, style=colour) + Text("." * (_BAR_WIDTH - full), style="dim")
        table.add_row(name, bar, text)
    table.add_row("", Text(guided.advice, style="bold"), "")
    return table


def page_state(guided: GuidedFrame) -> dict[str, Any]:
    """Return the page's rows (the shares as numbers, for bars) and its headline."""
    rows = [[value for value in row if value is not None] for row in guided.rows]
    return {"rows": rows, "phase": guided.advice}
