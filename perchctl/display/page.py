"""The live page of a flight: pictures, numbers, and a STOP button that lands."""

from __future__ import annotations

import contextlib
import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.camera import FrameSource, WatchedSource
from perchctl.display.live import LivePage, PageState
from perchctl.display.panel import status_of, status_rows
from perchctl.display.sketch import Sketch
from perchctl.log import FlightSummary
from perchctl.mission import RESCUE, Event, EventKind, Phase, Tick
from perchctl.vision import MARKERS, CameraModel, Frame, PipelineOutput

AXES_OF_SIDE = 0.5
"""Length of the drawn axes, in sides of the large marker."""


class FlightPage:
    """A flight's watcher; the pictures come through `watched`.

    A page that fails is no reason to land: `problem` is always None, `page.problem` holds
    the error.
    """

    def __init__(self, page: LivePage, large_side_m: float) -> None:
        self.page = page
        self._axis_m = AXES_OF_SIDE * large_side_m
        self._frame: Frame | None = None
        self._flying = False
        self._events: list[Event] = []
        self._pressed_s: float | None = None
        waiting = {"phase": "WAITING", "rows": [["reason", "vehicle and camera"]]}
        page.tell(lambda: waiting, live=False)

    @property
    def problem(self) -> str | None:
        return None

    def watched(self, source: FrameSource) -> FrameSource:
        """The same source; each frame it gives is remembered for the page."""
        return WatchedSource(source, self._seen)

    def tick(self, tick: Tick) -> None:
        try:
            self._flying = True
            frame = self._frame
            if frame is not None:
                self._frame = None
                self.page.show(frame.index, sketch_of(frame, tick.output, self._axis_m))
            if self._pressed_s is None and self.page.stop_requested:
                self._pressed_s = tick.t_s
            did = answered(self._events, self._pressed_s)
            self.page.tell(partial(flight_state, tick, did), live=not tick.state.phase.is_over)
        except Exception as error:
            self.page.remember(error)

    def event(self, event: Event) -> None:
        self._events.append(event)

    def end(self, card: Card) -> None:
        """The flight is over, and this is how: the last that the page shows. After an error in
        flight, with what the rescue said."""
        notes = [e for e in self._events if e.kind is EventKind.NOTE]
        rescue = next((e for e in reversed(notes) if RESCUE in e.reason), None)
        if rescue is not None and not card["good"]:
            card = card | {"rows": [["flight", rescue.reason], *card["rows"]]}
        self.page.end(card)

    def _seen(self, frame: Frame) -> None:
        self._frame = frame
        if not self._flying:  # no ticks yet that would show it
            self.page.show(frame.index, Sketch(frame.image))


def sketch_of(frame: Frame, output: PipelineOutput | None, axis_m: float) -> Sketch:
    """The frame with what the pipeline found in it; bare where it was not looked at."""
    if output is None or output.detections.frame_index != frame.index:
        return Sketch(frame.image)
    found = ((name, output.detections.get(name)) for name in MARKERS)
    poses = output.poses
    pose = next((poses[name] for name in ("joint", "large", "small") if name in poses), None)
    return Sketch(
        frame.image,
        tuple((name, seen.corners_px) for name, seen in found if seen is not None),
        None if pose is None else (pose.rvec_rad, pose.tvec_m, axis_m),
    )


def flight_state(tick: Tick, stop_did: str = "") -> PageState:
    """The tick for the page: phase, battery, the rows of the terminal's panel, whether the flight
    is over, and what it did for STOP."""
    status = status_of(tick)
    volts = status.battery_v
    return {
        "phase": status.phase,
        "battery": f"{volts:.2f} V" if math.isfinite(volts) else "battery unknown",
        "battery_v": volts if math.isfinite(volts) else None,
        "rows": [list(row) for row in status_rows(status)],
        "note": f"held: {status.hold}" if status.hold else _seen_note(tick.output),
        "over": tick.state.phase.is_over,
        "stop_did": stop_did,
    }


def _seen_note(output: PipelineOutput | None) -> str:
    mirrored = output is not None and output.detections.mirrored
    return "the picture is mirrored (camera.mirrored in the profile)" if mirrored else ""


@contextlib.contextmanager
def flight_page(
    camera: CameraModel,
    title: str,
    large_side_m: float,
    port: int,
    land: Callable[[], None],
    report: Callable[[str], None],
) -> Iterator[FlightPage]:
    """A page for one flight. Raises InvalidValue for a port in use.

    `land` is called by STOP; `report` prints a line.
    """
    page = LivePage(camera, title, port, on_stop=land)
    report(f"live page with a STOP button: {page.url}")
    try:
        yield FlightPage(page, large_side_m)
    finally:
        page.close()
        if page.problem is not None:
            report(f"the live page failed: {page.problem}")


# --- What the live page says of the operator's commands and of the flight's end -----------------
# By the flight's own events, not by what was clicked.


Card = dict[str, Any]
GOOD = "perched"
_ORDERED = {"operator-land": "landing ordered", "operator-stop": "motors cut"}


def answered(events: Sequence[Event], pressed_s: float | None) -> str:
    """What the flight did for STOP, or for a Ctrl-C; empty where neither came.

    `pressed_s`: the turn of the loop in which STOP was there, on the loop's clock."""
    phases = [e for e in events if e.kind is EventKind.PHASE and e.phase is not None]
    ordered = [e for e in phases if e.row in _ORDERED]
    if not phases or (pressed_s is None and not ordered):
        return ""
    start_s = phases[0].t_s
    parts = [f"{_ORDERED[e.row]} at {e.t_s - start_s:.1f} s" for e in ordered]
    landing = next((e for e in phases if e.phase is Phase.LANDING), None)
    if not ordered and landing is not None:
        parts.append(f"it lands already, since {landing.t_s - start_s:.1f} s: {landing.reason}")
    last = phases[-1]
    if last.phase is not None and last.phase.is_over and last.row not in _ORDERED:
        parts.append(f"{last.phase.value} at {last.t_s - start_s:.1f} s: {last.reason}")
    if not parts:
        parts.append("STOP has come; the flight has not answered yet")
    return "; ".join(parts)


def summary_card(summary: FlightSummary, log: Path) -> Card:
    """How the flight ended, and where to look next."""
    rows = [["cause", summary.cause]] if summary.cause not in ("", summary.outcome) else []
    if summary.miss_m is not None:
        rows.append(["miss", f"{summary.miss_m * 1e3:.1f} mm"])
    if summary.contact is not None:
        rows.append(["contact", summary.contact.text])
    if summary.touchdown is not None and summary.touchdown.is_hard:
        rows.append(["vehicle", summary.touchdown.text])
    rows.append(["flight", f"{summary.duration_s:.1f} s, attempts {summary.attempts}"])
    if summary.battery_min_v is not None:
        rows.append(["battery", f"{summary.battery_min_v:.2f} V at its lowest"])
    if summary.locked:
        rows.append(["vehicle", "locked by its supervisor: inspect and restart it"])
    if summary.log_problem is not None:
        rows.append(["log lost", summary.log_problem])
    return _card(summary.outcome, summary.reason, rows, log)


def failed_card(error: BaseException, log: Path | None) -> Card:
    """Of a flight that ended in an error, or that never began; `log` where there is one."""
    return _card("failed", str(error) or type(error).__name__, [], log)


def _card(outcome: str, reason: str, rows: list[list[str]], log: Path | None) -> Card:
    if log is not None:
        path = log.resolve()
        rows += [["log", str(path)], ["report", f"perchctl log report {shlex.quote(str(path))}"]]
    return {"outcome": outcome.upper(), "good": outcome == GOOD, "reason": reason, "rows": rows}
