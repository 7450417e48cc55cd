"""The live display for a flight on a terminal: its content for one tick, and its drawing."""

from __future__ import annotations

import math
from typing import TextIO

from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from perchctl.display.terminal import (
    PANEL_PERIOD_S,
    TerminalDisplay,
    age_text,
    frame_table,
    phase_style,
)
from perchctl.mission import Event, EventKind, ExternalPositionStatus, Phase, PlannerState, Tick
from perchctl.vehicle import NO_BATTERY_READING_V


def status_rows(tick: Tick) -> list[tuple[str, str]]:
    """Return the name and the text of each row in the status panel, in m, cm and degrees. A text
    with several figures fits into one line of the panel; a sentence may be longer."""
    state, target = tick.state, tick.target
    stage = "none" if target is None else target.stage.value
    height_m = tick.telemetry.position_m[2] - state.belief.ground_z_m
    ages = (
        f"link {age_text(tick.telemetry_age_s)}   camera {age_text(tick.last_good_frame_age_s)}"
        f"   loop late {age_text(tick.tick_start_delay_s)}"
    )
    return [
        ("phase", f"{state.phase.value}  {tick.t_s - state.entry.t_s:.1f} s"),
        *_error_row(tick),
        ("markers", f"{stage}   failed attempts {state.failed_attempts}"),
        ("height", f"{height_m:.2f} m   battery {_battery_text(tick)}"),
        ("ages", ages),
        *(
            []
            if tick.external_positions is None
            else [("outside", _outside_text(tick.external_positions))]
        ),
        *([("hover", _hover_text(state))] if state.phase is Phase.HOVER else []),
        ("held" if state.pause_reason else "reason", state.pause_reason or state.transition_reason),
    ]


def _error_row(tick: Tick) -> list[tuple[str, str]]:
    """The error to the target or, from a proven contact on, the offset at the contact. No row for a
    target that is not seen after the contact or after the flight, because that estimate drifts."""
    target = tick.target_to_show
    if tick.gear_to_target_at_contact is not None:
        return [("contact", tick.gear_to_target_at_contact.text)]
    if target is None:
        return [("error", "no target seen yet")] if tick.target is None else []
    x, y, z = (f"{100.0 * v:+.1f}" for v in target.e_m)
    yaw_deg = math.degrees(target.e_yaw_rad)
    yaw = "-" if math.isnan(yaw_deg) else f"{yaw_deg:+.1f}"
    seen = "" if target.tracked else "   (not seen)"
    return [("error", f"x {x}  y {y}  z {z} cm   yaw {yaw} deg{seen}")]


def _hover_text(state: PlannerState) -> str:
    errors, hover = state.hover_errors, state.belief.profile.planner.hover
    of = "" if hover is None else f" of {hover.duration_s:g}"
    *axes, yaw_rad = errors.rms_level_xyz_m_yaw_rad
    if not errors.frame_count:
        return f"{errors.duration_s:.0f}{of} s"
    x, y, z = (f"{1e3 * each:.1f}" for each in axes)
    return (
        f"{errors.duration_s:.0f}{of} s   RMS x {x}  y {y}  z {z} mm   "
        f"yaw {math.degrees(yaw_rad):.1f} deg"
    )


def _battery_text(tick: Tick) -> str:
    battery_v, battery = tick.telemetry.battery_v, tick.state.battery
    if not battery_v >= NO_BATTERY_READING_V:
        return "unknown"
    text = f"{battery_v:.2f} V"
    if not tick.state.phase.is_before_contact or battery.hover_time_left_s is None:
        return text
    if battery.affordable_attempts is None:
        return f"{text}, {_whole(battery.hover_time_left_s)} left"
    attempts = battery.affordable_attempts
    if attempts == 0:
        return f"{text}, not enough for an attempt"
    return f"{text}, enough for {attempts} attempt{'s' if attempts > 1 else ''}"


def _whole(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"


def _outside_text(outside: ExternalPositionStatus) -> str:
    if outside.problem is not None:
        return outside.problem
    return f"position {outside.rate_hz:.0f} Hz   {age_text(outside.newest_position_age_s)}"


def event_text(event: Event) -> str:
    """The text of an event, as one line."""
    match event.kind:
        case EventKind.PHASE:
            text = f"{event.phase.value if event.phase else '?'}: {event.reason}"
        case EventKind.HOLD:
            text = f"holding: {event.reason}"
        case EventKind.NOTE:
            text = event.reason
    return f"{text} (simulated: {event.simulated_fault})" if event.simulated_fault else text


class FlightPanel(TerminalDisplay):
    """Watches the flight loop, and prints events and, on a terminal, a status panel below them. No
    method raises an exception, and only `close` waits (with a timeout). A failing display must not
    land the vehicle, so `problem` is always None; `failure` says why the output stopped.
    """

    name = "the panel"
    problem: str | None = None
    help: tuple[str, str] = ("", "")
    """Sentences in the panel's lower and upper border until the flight is over, at most 60 columns
    each."""

    def __init__(self, stream: TextIO) -> None:
        self._tick: Tick | None = None
        self._drawn: Tick | None = None
        self._start_s: float | None = None
        self._next_s = -math.inf
        super().__init__(stream)

    def tick(self, tick: Tick) -> None:
        """Show a tick at once if the phase has changed, otherwise at most every 0.1 s. The last
        tick is always shown."""
        is_new = self._tick is None or self._tick.state.phase is not tick.state.phase
        self._tick = tick
        if is_new or tick.t_s >= self._next_s:
            self._next_s = tick.t_s + PANEL_PERIOD_S
            self._wake.set()

    def event(self, event: Event) -> None:
        """Print an event as one line, at once."""
        if self._start_s is None:
            self._start_s = event.t_s
        self._add_line(f"[{event.t_s - self._start_s:7.2f} s] {event_text(event)}")

    def _new_panel(self) -> Panel | None:
        tick = self._tick
        if tick is None or tick is self._drawn:
            return None
        self._drawn = tick
        return status_panel(tick, *(() if tick.state.phase.is_final else self.help))


def status_panel(tick: Tick, below: str = "", above: str = "") -> Panel:
    """The status panel for a tick: at most `PANEL_COLUMNS` columns wide, with a line for each row,
    and more lines for a long reason. `below` and `above` are sentences for its lower and upper
    border."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True, min_width=7)
    table.add_column()
    for name, text in status_rows(tick):
        style = phase_style(tick.state.phase.value) if name == "phase" else ""
        style = "bold yellow" if name == "held" else style
        table.add_row(Text(name, style="dim"), Text(text, style=style))
    return frame_table(table, below, above)
