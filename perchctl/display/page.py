"""The live page of a flight: pictures, numbers, and a STOP button that lands."""

from __future__ import annotations

import math
import shlex
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.camera import FrameSource, WatchedSource
from perchctl.display.live import LivePage, PageState
from perchctl.display.panel import status_rows
from perchctl.display.sketch import Sketch
from perchctl.mission import Event, Tick
from perchctl.record import FlightSummary, summary_text
from perchctl.vision import MARKERS, Frame, PipelineOutput

Card = dict[str, Any]
"""Outcome, reason, and rows of a name and a text, as the page shows them at the end."""
GOOD = "perched"
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
        self._rescue = ""
        waiting = {"phase": "WAITING", "rows": [["reason", "vehicle and camera"]]}
        page.set_state(lambda: waiting, live=False)

    @property
    def problem(self) -> str | None:
        return None

    def watched(self, source: FrameSource) -> FrameSource:
        """Return the same source; each frame it gives is remembered for the page."""
        return WatchedSource(source, self._seen)

    def tick(self, tick: Tick) -> None:
        try:
            self._flying = True
            frame = self._frame
            if frame is not None:
                self._frame = None
                self.page.show(frame.index, sketch_of(frame, tick.output, self._axis_m))
            self.page.set_state(partial(flight_state, tick), live=not tick.state.phase.is_over)
        except Exception as error:
            self.page.remember(error)

    def event(self, event: Event) -> None:
        if event.is_rescue:
            self._rescue = event.reason

    def end(self, card: Card) -> None:
        """Show how the flight ended, as the last that the page shows; after an error in flight also
        what the rescue reported."""
        if self._rescue and not card["good"]:
            card = card | {"rows": [["flight", self._rescue], *card["rows"]]}
        self.page.end(card)

    def _seen(self, frame: Frame) -> None:
        self._frame = frame
        if not self._flying:  # no ticks yet that would show it
            self.page.show(frame.index, Sketch(frame.image))


def sketch_of(frame: Frame, output: PipelineOutput | None, axis_m: float) -> Sketch:
    """Return the frame with what the pipeline found in it; bare if it was not searched."""
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


def flight_state(tick: Tick) -> PageState:
    """Return what the page shows of a tick: phase, battery, the rows of the terminal's panel, and
    whether the flight is over."""
    state, volts = tick.state, tick.telemetry.battery_v
    mirrored = tick.output is not None and tick.output.detections.mirrored
    seen = "the picture is mirrored (camera.mirrored in the profile)" if mirrored else ""
    return {
        "phase": state.phase.value,
        "battery": f"{volts:.2f} V" if math.isfinite(volts) else "battery unknown",
        "battery_v": volts if math.isfinite(volts) else None,
        "rows": [list(row) for row in status_rows(tick)],
        "note": f"held: {state.hold}" if state.hold else seen,
        "over": state.phase.is_over,
    }


# --- How the flight ended ---------------------------------------------------------------------


def summary_card(summary: FlightSummary, log: Path) -> Card:
    """Return the card that says how the flight ended, and where to look next."""
    first, *lines = summary_text(summary).splitlines()
    rows = [[part.strip() for part in line.split(":", maxsplit=1)] for line in lines]
    return _card(summary.outcome, first.partition(": ")[2], rows, log)


def failed_card(error: BaseException, log: Path | None) -> Card:
    """Return the card of a flight that ended in an error, or that never began; `log` if there is
    one."""
    return _card("failed", str(error) or type(error).__name__, [], log)


def _card(outcome: str, reason: str, rows: list[list[str]], log: Path | None) -> Card:
    if log is not None:
        path = log.resolve()
        rows += [["log", str(path)], ["report", f"perchctl log report {shlex.quote(str(path))}"]]
    return {"outcome": outcome.upper(), "good": outcome == GOOD, "reason": reason, "rows": rows}
