"""The panel as a watcher of the loop."""

from __future__ import annotations

import math

from perchctl.display.panel import Reporter
from perchctl.display.status import FlightStatus
from perchctl.mission import BEFORE_CONTACT, Event, Tick


class DisplayWatcher:
    """Shows the flight. A display that fails is no reason to land: no problem, ever."""

    def __init__(self, reporter: Reporter) -> None:
        self.reporter = reporter

    def tick(self, tick: Tick) -> None:
        self.reporter.update(status_of(tick))

    def event(self, event: Event) -> None:
        self.reporter.event(event)

    @property
    def problem(self) -> str | None:
        return None


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
        battery=state.battery if state.phase in BEFORE_CONTACT else None,
    )
