"""The live display on a terminal: what it shows of one moment of a flight, and its drawing."""

from __future__ import annotations

import math
import os
import sys
import threading
from collections import deque
from dataclasses import dataclass
from typing import Protocol, TextIO

from rich.console import Console
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from perchctl.mission import (
    BatteryOutlook,
    Event,
    EventKind,
    ExternalPositions,
    Tick,
)
from perchctl.vehicle import NO_BATTERY_READING_V


@dataclass(frozen=True)
class FlightStatus:
    """SI and radians; the display turns them into centimetres and degrees.

    Attributes:
        t_s: the loop's clock.
        in_phase_s: time since the phase was entered.
        e_m, e_yaw_rad: target relative to the gear; None while none was seen.
        tracked: the target is seen, or was a moment ago; else `e_m` is remembered.
        stage: markers seen: none, large, both, small.
        height_m: above the place of take-off.
        link_age_s, camera_age_s: since the newest telemetry and the last good frame.
        loop_late_s: how late this tick began.
        attempts: failed perching attempts so far.
        battery: what it is enough for; None outside a flight's phases.
        reason: why the phase was entered; `hold`: why the vehicle is held, or empty.
        outside: how it goes with positions from outside; None where decks measure them.
    """

    t_s: float
    phase: str
    in_phase_s: float
    e_m: tuple[float, float, float] | None
    e_yaw_rad: float | None
    tracked: bool
    stage: str
    height_m: float
    battery_v: float
    link_age_s: float
    camera_age_s: float
    loop_late_s: float
    attempts: int
    reason: str
    hold: str = ""
    outside: ExternalPositions | None = None
    battery: BatteryOutlook | None = None


def status_of(tick: Tick) -> FlightStatus:
    """The tick as the display shows it."""
    state, tel, target = tick.state, tick.telemetry, tick.target
    ground_z_m = state.ground_m[2] if state.ground_m else 0.0
    e_m = None
    if target is not None:
        x, y, z = (float(v) for v in target.e_m)
        e_m = (x, y, z)
    yaw_rad = None if target is None or math.isnan(target.e_yaw_rad) else target.e_yaw_rad
    return FlightStatus(
        t_s=tick.t_s,
        phase=state.phase.value,
        in_phase_s=tick.t_s - state.entered_s,
        e_m=e_m,
        e_yaw_rad=yaw_rad,
        tracked=target is not None and target.tracked,
        stage="none" if target is None else target.stage.value,
        height_m=tel.position_m[2] - ground_z_m,
        battery_v=tel.battery_v,
        link_age_s=tick.telemetry_age_s,
        camera_age_s=tick.camera_age_s,
        loop_late_s=tick.loop_late_s,
        attempts=state.attempts,
        reason=state.reason,
        hold=state.hold,
        outside=tick.outside,
        battery=state.battery if state.phase.is_before_contact else None,
    )


def status_rows(status: FlightStatus) -> list[tuple[str, str]]:
    """Name and text of each line of the display, at most 80 columns together."""
    if status.e_m is None:
        error = "no target seen yet"
    else:
        x, y, z = (f"{100.0 * v:+.1f}" for v in status.e_m)
        yaw = "-" if status.e_yaw_rad is None else f"{math.degrees(status.e_yaw_rad):+.1f}"
        error = f"x {x}  y {y}  z {z} cm   yaw {yaw} deg"
        error += "" if status.tracked else "   (not seen)"
    ages = (
        f"link {_age(status.link_age_s)}   camera {_age(status.camera_age_s)}"
        f"   loop late {_age(status.loop_late_s)}"
    )
    return [
        ("phase", f"{status.phase}  {status.in_phase_s:.1f} s"),
        ("error", error),
        ("markers", f"{status.stage}   attempts {status.attempts}"),
        ("height", f"{status.height_m:.2f} m   battery {battery_text(status)}"),
        ("ages", ages),
        *([] if status.outside is None else [("outside", _outside_text(status.outside))]),
        ("held" if status.hold else "reason", status.hold or status.reason),
    ]


def battery_text(status: FlightStatus) -> str:
    """Its voltage under load, and what it is enough for."""
    if not status.battery_v >= NO_BATTERY_READING_V:
        return "unknown"
    text, battery = f"{status.battery_v:.2f} V", status.battery
    if battery is None or battery.left_s is None:
        return text
    if battery.attempts is None:
        return f"{text}, {_whole(battery.left_s)} left"
    if battery.attempts == 0:
        return f"{text}, not enough for an attempt"
    return f"{text}, enough for {battery.attempts} attempt{'s' if battery.attempts > 1 else ''}"


def _whole(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"


def _outside_text(outside: ExternalPositions) -> str:
    if outside.problem is not None:
        return outside.problem
    return f"position {outside.rate_hz:.0f} Hz   {_age(outside.age_s)}"


def event_text(event: Event) -> str:
    """An event as one line."""
    text = _what_happened(event)
    return f"{text} (simulated: {event.simulated})" if event.simulated else text


def timed_event_text(event: Event, start_s: float) -> str:
    """The line with the time since the start."""
    return f"[{event.t_s - start_s:7.2f} s] {event_text(event)}"


def _what_happened(event: Event) -> str:
    match event.kind:
        case EventKind.PHASE:
            return f"{event.phase.value if event.phase else '?'}: {event.reason}"
        case EventKind.HOLD:
            return f"holding: {event.reason}"
        case EventKind.NOTE:
            return event.reason


def _age(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms" if seconds < 10.0 else "none" if seconds > 1e6 else ">10 s"


# --- The live display: a panel on a terminal, one plain line an event elsewhere ----------------
# The flight loop only leaves its newest status and its events here; a thread of
# the display's own draws them. So neither an exception nor a terminal that stands
# still (Ctrl-S, a stalled ssh) reaches the loop.


PERIOD_S = 0.1
CLOSE_TIMEOUT_S = 1.0
EVENTS_KEPT = 1000
WIDTH = 78
"""Of 80: a terminal echoes ^C behind the panel, and where that wraps, the next picture of the
panel is drawn a line too low, with a piece of the last one left above it."""

_STYLES = {"PERCHED": "bold green", "LANDING": "bold yellow", "ABORTED": "bold red"}


class Surface(Protocol):
    """Where the display draws; called from its thread only. May raise."""

    def line(self, text: str) -> None: ...

    def show(self, status: FlightStatus) -> None: ...

    def close(self) -> None: ...


class PlainSurface:
    """One line an event, nothing else."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def line(self, text: str) -> None:
        self._stream.write(text + "\n")
        self._stream.flush()

    def show(self, status: FlightStatus) -> None:
        pass

    def close(self) -> None:
        pass


class PanelSurface:
    """A panel that stays at the bottom of the terminal; events scroll above it."""

    def __init__(self, console: Console) -> None:
        self._console = console
        # stdout is for data and is left alone; what others write on stderr goes above the panel.
        self._live = Live(
            console=console, auto_refresh=False, redirect_stdout=False, redirect_stderr=True
        )
        self._live.start()

    def line(self, text: str) -> None:
        self._console.print(Text(text), soft_wrap=True)

    def show(self, status: FlightStatus) -> None:
        self._live.update(panel(status), refresh=True)

    def close(self) -> None:
        self._live.stop()


class FlightPanel:
    """The display, as a watcher of the flight loop. No method raises or waits, but `close`
    (bounded). A display that fails is no reason to land: `problem` is always None, `failure`
    says why it fell silent.
    """

    problem: str | None = None

    def __init__(self, surface: Surface) -> None:
        self.failure: str | None = None
        self._surface = surface
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._lines: deque[str] = deque(maxlen=EVENTS_KEPT)
        self._status: FlightStatus | None = None
        self._drawn: FlightStatus | None = None
        self._start_s: float | None = None
        self._next_s = -math.inf
        self._phase = self._shown = ""  # as a line has it, and as the panel has it
        self._thread = threading.Thread(target=self._draw, name="display", daemon=True)
        self._thread.start()

    def tick(self, tick: Tick) -> None:
        """Show this tick of the loop."""
        self.update(status_of(tick))

    def update(self, status: FlightStatus) -> None:
        """Show this moment: at once if the phase is a new one, or 0.1 s after the last one that
        was shown, or as the last one of all."""
        if self.failure is not None:
            return
        self._status = status
        if status.phase != self._phase:  # a change without an event
            self._line(status.t_s, f"{status.phase}: {status.reason}")
            self._phase = status.phase
        elif status.phase == self._shown and status.t_s < self._next_s:
            return
        self._shown = status.phase
        self._next_s = status.t_s + PERIOD_S
        self._wake.set()

    def event(self, event: Event) -> None:
        """One line, at once."""
        if self.failure is not None:
            return
        if event.kind is EventKind.PHASE and event.phase is not None:
            self._phase = event.phase.value
        self._line(event.t_s, event_text(event))
        self._wake.set()

    def close(self) -> None:
        """Draw what is left and give the terminal back; waits at most a second."""
        self._closing.set()
        self._wake.set()
        self._thread.join(CLOSE_TIMEOUT_S)

    def _line(self, t_s: float, text: str) -> None:
        if self._start_s is None:
            self._start_s = t_s
        self._lines.append(f"[{t_s - self._start_s:7.2f} s] {text}")

    def _draw(self) -> None:
        try:
            while True:
                self._wake.wait()
                self._wake.clear()
                closing = self._closing.is_set()  # before the last look, so that it is the last
                self._draw_once()
                if closing:
                    break
                self._closing.wait(PERIOD_S)  # in lockstep the loop's time runs faster
            self._surface.close()
        except Exception as error:
            self.failure = f"the display fell silent: {error.__class__.__name__}: {error}"
            try:
                self._surface.close()
            except Exception:
                return

    def _draw_once(self) -> None:
        while self._lines:
            self._surface.line(self._lines.popleft())
        status = self._status
        if status is not None and status is not self._drawn:
            self._drawn = status
            self._surface.show(status)


def open_panel(interactive: bool | None = None, stream: TextIO | None = None) -> FlightPanel:
    """A panel when `interactive`, plain lines when not; None: as the stream is.

    `stream` defaults to stderr. NO_COLOR takes the colours away.
    """
    stream = sys.stderr if stream is None else stream
    if interactive is None:
        interactive = stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")
    if not interactive:
        return FlightPanel(PlainSurface(stream))
    console = Console(
        file=stream,
        force_terminal=True,
        highlight=False,  # no colours in URIs and paths
        markup=False,
        emoji=False,
    )
    return FlightPanel(PanelSurface(console))


def panel(status: FlightStatus) -> Panel:
    """The status as a panel of at most `WIDTH` columns and eight lines; nine with positions from
    outside."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True, min_width=7)
    table.add_column(no_wrap=True, overflow="ellipsis")
    for name, text in status_rows(status):
        style = _STYLES.get(status.phase, "bold") if name == "phase" else ""
        style = "bold yellow" if name == "held" else style
        table.add_row(Text(name, style="dim"), Text(text, style=style))
    return Panel(table, title="perchctl", title_align="left", width=WIDTH)
