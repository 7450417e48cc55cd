"""The live display for a fleet: events and, on a terminal, one line for each vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TextIO

from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from perchctl.display.terminal import (
    PANEL_COLUMNS,
    TerminalDisplay,
    age_text,
    frame_table,
    phase_style,
)
from perchctl.mission import Phase

_WIDTHS = {"": 2, "name": 10, "phase": 8, "height": 7, "error": 8, "battery": 7, "link": 6}
_REASON_COLUMNS = PANEL_COLUMNS - 4 - sum(_WIDTHS.values()) - len(_WIDTHS)
"""Columns that remain for the reason: all but the panel's frame and the other fields, each followed
by a space."""


@dataclass(frozen=True, kw_only=True)
class FleetRow:
    """The values that the panel and the page show for one vehicle. Unknown numbers are None.

    Attributes:
        link_s: age of the newest telemetry.
        has_ended: its flight is over.
        hangs: its flight is over, and the vehicle is hanging with its motors off.
        is_silent: its process has not sent anything for too long.
        picture_port: local port at which its process serves its images.
    """

    number: int
    name: str
    phase: str
    reason: str
    height_m: float | None = None
    error_m: float | None = None
    battery_v: float | None = None
    link_s: float | None = None
    has_ended: bool = False
    hangs: bool = False
    is_silent: bool = False
    picture_port: int | None = None

    def texts(self) -> tuple[str, str, str, str]:
        """Height, error, battery and link; empty if unknown. For a vehicle that hangs, the error is
        left out: its camera no longer measures how far the gear is from the centre."""
        is_hanging = self.hangs or self.phase == Phase.PERCHED.value
        return (
            "" if self.height_m is None else f"{self.height_m:.2f} m",
            "" if self.error_m is None or is_hanging else f"{100.0 * self.error_m:.1f} cm",
            "" if self.battery_v is None else f"{self.battery_v:.2f} V",
            "" if self.link_s is None else age_text(self.link_s),
        )


class FleetPanel(TerminalDisplay):
    """Prints events and, on a terminal, a line for each vehicle below them.

    `frame`: sentences for the panel's lower and upper border until all flights are over, truncated
    to the panel's width.
    """

    def __init__(self, stream: TextIO, frame: tuple[str, str] = ("", "")) -> None:
        self._frame = frame
        self._rows: tuple[FleetRow, ...] = ()
        self._drawn: tuple[FleetRow, ...] = ()
        super().__init__(stream)

    def show(self, rows: Sequence[FleetRow]) -> None:
        """Show these lines instead of the previous ones."""
        self._rows = tuple(rows)
        self._wake.set()

    def event(self, line: str) -> None:
        """Print a line above the panel."""
        self._add_line(line)

    def _new_panel(self) -> Panel | None:
        rows = self._rows
        if not rows or rows == self._drawn:
            return None
        self._drawn = rows
        return fleet_table(rows, *(() if all(row.has_ended for row in rows) else self._frame))


def fleet_table(rows: Sequence[FleetRow], below: str = "", above: str = "") -> Panel:
    """Return the panel for these vehicles, `PANEL_COLUMNS` wide: a heading, and one line per
    vehicle."""
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
            *map(Text, row.texts()),
            Text(row.reason),
        )
    return frame_table(table, below, above)
