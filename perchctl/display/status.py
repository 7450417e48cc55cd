"""What the live display shows of one moment of a flight."""

from __future__ import annotations

import math
from dataclasses import dataclass

from perchctl.mission import BatteryOutlook, Event, EventKind, ExternalPositions
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
