"""The live display of a fleet: one line for each vehicle on a terminal, and its events."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TextIO

from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from perchctl.display.panel import (
    EVENTS_KEPT,
    PANEL_CLOSE_TIMEOUT_S,
    PANEL_COLUMNS,
    PANEL_PERIOD_S,
    new_live,
    phase_style,
)

_WIDTHS = {"": 2, "name": 10, "phase": 8, "height": 7, "error": 8, "battery": 7, "link": 6}
_REASON_COLUMNS = PANEL_COLUMNS - 4 - sum(_WIDTHS.values()) - len(_WIDTHS)
"""What the frame and the other fields, with a blank after each, leave."""


@dataclass(frozen=True, kw_only=True)
class FleetRow:
    """What the panel shows of one vehicle. Unknown numbers are None."""

    number: int
    name: str
    phase: str
    reason: str
    height_m: float | None = None
    error_m: float | None = None
    battery_v: float | None = None
    link_s: float | None = None  # age of the newest telemetry


class FleetPanel:
    """Prints events and, on a terminal, a line for each vehicle below them.

    A thread of its own draws, so that a terminal that stands still (Ctrl-S, a stalled ssh) holds
    up nobody. No method raises, and only `close` waits (bounded). `failure` says why the output
    stopped.

    `frame`: sentences below and above, as far as the panel's width allows.
    """

    def __init__(self, stream: TextIO, frame: tuple[str, str] = ("", "")) -> None:
        self.failure: str | None = None
        self._frame = frame
        self._stream = stream
        is_terminal = stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
        self._live: Live | None = new_live(stream) if is_terminal else None
        self._closing = threading.Event()
        self._lines: deque[str] = deque(maxlen=EVENTS_KEPT)
        self._rows: tuple[FleetRow, ...] = ()
        self._drawn: tuple[FleetRow, ...] = ()
        self._thread = threading.Thread(target=self._draw, name="display", daemon=True)
        self._thread.start()

    def show(self, rows: Sequence[FleetRow]) -> None:
        """Show these lines in place of those before."""
        self._rows = tuple(rows)

    def event(self, line: str) -> None:
        """Print a line above the panel."""
        self._lines.append(line)

    def close(self) -> None:
        """Print what is pending and release the terminal; waits at most a second."""
        self._closing.set()
        self._thread.join(PANEL_CLOSE_TIMEOUT_S)

    def _draw(self) -> None:
        try:
            with self._live or contextlib.nullcontext():
                while not self._closing.wait(PANEL_PERIOD_S):
                    self._draw_once()
                self._draw_once()
        except Exception as error:
            self.failure = f"the display failed: {error.__class__.__name__}: {error}"

    def _draw_once(self) -> None:
        while self._lines:
            line = self._lines.popleft()
            if self._live is not None:
                self._live.console.print(Text(line), soft_wrap=True)
            else:
                self._stream.write(line + "\n")
                self._stream.flush()
        rows = self._rows
        if self._live is not None and rows and rows != self._drawn:
            self._drawn = rows
            self._live.update(fleet_table(rows, *self._frame), refresh=True)


def fleet_table(rows: Sequence[FleetRow], below: str = "", above: str = "") -> Panel:
    """The panel of these vehicles, `PANEL_COLUMNS` wide: a heading, and one line for each."""
    table = Table.grid(padding=(0, 1))
    for name, width in _WIDTHS.items():
        is_text = name in ("name", "phase")
        table.add_column(
            no_wrap=True,
            overflow="ellipsis",
            width=width,
            justify="left" if is_text else "right",
        )
    table.add_column(no_wrap=True, overflow="ellipsis", width=_REASON_COLUMNS)
    table.add_row(*(Text(name, style="dim") for name in (*_WIDTHS, "reason")))
    for row in rows:
        table.add_row(
            Text(str(row.number), style="bold"),
            Text(row.name),
            Text(row.phase, style=phase_style(row.phase)),
            Text("" if row.height_m is None else f"{row.height_m:.2f} m"),
            Text("" if row.error_m is None else f"{100.0 * row.error_m:.1f} cm"),
            Text("" if row.battery_v is None else f"{row.battery_v:.2f} V"),
            Text(_age_text(row.link_s)),
            Text(row.reason),
        )
    return Panel(
        table,
        title=Text(f"perchctl: {above}" if above else "perchctl"),
        subtitle=Text(below) if below else None,
        title_align="left",
        subtitle_align="left",
        width=PANEL_COLUMNS,
    )


def _age_text(age_s: float | None) -> str:
    if age_s is None:
        return ""
    return f"{1e3 * age_s:.0f} ms" if age_s < 10.0 else ">10 s"
