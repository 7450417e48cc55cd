"""The common part of the displays for a flight and for a fleet: lines of text and, on a terminal, a
panel below them.

The flight only stores new values here, and a separate thread draws them. Neither an exception nor a
stopped terminal (Ctrl-S, a stalled ssh connection) can therefore affect the flight.
"""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from perchctl.wrapping import wrap_line

PANEL_PERIOD_S = 0.1
PANEL_CLOSE_TIMEOUT_S = 1.0
EVENTS_KEPT = 1000
PANEL_COLUMNS = 78
"""Width of a panel, in columns, on an 80-column terminal: the terminal echoes ^C after the panel,
and that line must not wrap."""

_STYLES = {"PERCHED": "bold green", "LANDING": "bold yellow", "ABORTED": "bold red"}


class TerminalDisplay:
    """Prints lines and, on a terminal, a panel below them, in a separate thread.

    No method raises an exception, and only `close` waits (with a timeout). `failure` says why the
    output stopped.
    """

    def __init__(self, stream: TextIO) -> None:
        self.failure: str | None = None
        self._stream = stream
        is_terminal = stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
        self._live: Live | None = new_live(stream) if is_terminal else None
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._lines: deque[str] = deque(maxlen=EVENTS_KEPT)
        self._thread = threading.Thread(target=self._draw, name="display", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Print all pending output and release the terminal; wait at most a second."""
        self._closing.set()
        self._wake.set()
        self._thread.join(PANEL_CLOSE_TIMEOUT_S)

    def _add_line(self, line: str) -> None:
        """Print a line above the panel, at once."""
        self._lines.append(line)
        self._wake.set()

    def _new_panel(self) -> Panel | None:
        """Return the panel if its content has changed; called in the display's thread."""
        return None

    def _draw(self) -> None:
        try:
            with self._live or contextlib.nullcontext():
                while not self._closing.is_set():
                    self._wake.wait()
                    self._wake.clear()
                    self._draw_once()
                    # in lockstep, the loop's time runs faster than real time
                    self._closing.wait(PANEL_PERIOD_S)
                self._draw_once()
        except Exception as error:
            self.failure = f"the display failed: {error.__class__.__name__}: {error}"

    def _draw_once(self) -> None:
        while self._lines:
            line = self._lines.popleft()
            if self._live is not None:
                folded = wrap_line(line, self._live.console.width)
                self._live.console.print(Text(folded), soft_wrap=True)
            else:
                self._stream.write(line + "\n")
                self._stream.flush()
        panel = None if self._live is None else self._new_panel()
        if self._live is not None and panel is not None:
            self._live.update(panel, refresh=True)


def new_live(stream: TextIO) -> Live:
    """A live display on a terminal that is redrawn only by calls of `update`."""
    console = Console(
        file=stream,
        force_terminal=True,
        highlight=False,  # no colours in URIs and paths
        markup=False,
        emoji=False,
    )
    # stdout is for data and is left alone; other output on stderr appears above the panel.
    return Live(console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=True)


def frame_table(table: Table, below: str = "", above: str = "") -> Panel:
    """A panel of `PANEL_COLUMNS` columns; `below` and `above` are sentences for its lower and upper
    border."""
    return Panel(
        table,
        title=Text(f"perchctl: {above}" if above else "perchctl", overflow="ellipsis"),
        subtitle=Text(below, overflow="ellipsis") if below else None,
        title_align="left",
        subtitle_align="left",
        width=PANEL_COLUMNS,
    )


def phase_style(phase: str) -> str:
    """The style in which a phase is printed on a terminal."""
    return _STYLES.get(phase, "bold")


def age_text(seconds: float) -> str:
    """An age as text of at most six columns."""
    return f"{1e3 * seconds:.0f} ms" if seconds < 10.0 else "none" if seconds > 1e6 else ">10 s"
