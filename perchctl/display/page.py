"""The live page for a flight: images, numbers, and buttons to land and to cut the motors."""

from __future__ import annotations

import math
import shlex
from collections import deque
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from perchctl.display.live import LivePage, Sketch, make_sketch
from perchctl.display.panel import status_rows
from perchctl.mission import Event, Outcome, Phase, Tick
from perchctl.profile import Profile
from perchctl.record import FlightSummary
from perchctl.vision import Frame

TRACE_S = 20.0
"""Span of the page's trace of the error, s; `page.html` uses the same value."""
PAST_PERIOD_S = 0.5
"""Time between two points of the trace that a page opened in mid-flight receives, s. Smaller: a
finer trace, but larger messages."""
Past = tuple[float, float | None, float | None]
"""The time of a tick in s, and the target's lateral offset and distance above in m."""
PERCH_STEPS = [phase.value for phase in tuple(Phase)[:7]]
"""The paper's seven phases, in the order in which they are flown."""
HOVER_STEPS = [*PERCH_STEPS[:5], Phase.HOVER.value]
"""The phases of a hover mission, in the order in which they are flown."""


class FlightPage:
    """Watches the flight loop and updates the live page.

    A failing page does not land the vehicle: `problem` stays None, and `page.problem` contains the
    error.
    """

    name = "the live page"
    problem: str | None = None

    def __init__(self, page: LivePage, large_side_m: float, gear_up_m: float) -> None:
        self.page = page
        self._side_m = large_side_m
        self._drawn = {"large_m": large_side_m, "gear_m": gear_up_m}  # m, for the page's drawings
        self._frame: Frame | None = None
        self._flying = False
        self._rescue = ""
        self._past: deque[Past] = deque(maxlen=round(TRACE_S / PAST_PERIOD_S))
        waiting = {"phase": "WAITING", "rows": [["reason", "vehicle and camera"]]}
        page.set_state(lambda: waiting, live=False)

    @classmethod
    def of(cls, page: LivePage, profile: Profile) -> FlightPage:
        """The watcher for a flight with this profile."""
        return cls(page, profile.target.large.side_m, profile.vehicle.gear_body_m[2])

    def frame(self, frame: Frame) -> None:
        self._frame = frame
        try:
            if not self._flying:  # before take-off, no tick updates the page
                self.page.show(Sketch(frame.image))
        except Exception as error:
            self.page.store_error(error)

    def tick(self, tick: Tick) -> None:
        try:
            self._flying = True
            frame = self._frame
            if frame is not None:
                self._frame = None
                self.page.show(make_sketch(frame, tick.output, self._side_m))
            self._remember(tick)
            describe = partial(flight_state, tick, self._drawn, tuple(self._past))
            self.page.set_state(describe, live=not tick.state.phase.is_final)
        except Exception as error:
            self.page.store_error(error)

    def _remember(self, tick: Tick) -> None:
        if not self._past or tick.t_s - self._past[-1][0] >= PAST_PERIOD_S:
            self._past.append((tick.t_s, *(tick.gear_to_target_lateral_and_up_m or (None, None))))

    def event(self, event: Event) -> None:
        if event.rest_state is not None:
            self._rescue = event.reason

    def end(self, summary: FlightSummary, log: Path) -> None:
        """Show the final state: the flight's outcome, its log, and the command that makes a
        report."""
        rows = [list(row) for row in summary.rows()]
        good = summary.outcome == "perched" or summary.is_hover_completed
        self._end(summary.outcome, summary.reason_text, rows, log, good)

    def fail(self, error: BaseException, log: Path | None) -> None:
        """Show that the flight ended with an error or never began, the report of the rescue after
        the error, and the log if there is one."""
        rows = [["flight", self._rescue]] if self._rescue else []
        self._end("failed", str(error) or type(error).__name__, rows, log)

    def _end(
        self,
        outcome: str,
        reason: str,
        rows: list[list[str]],
        log: Path | None,
        good: bool = False,
    ) -> None:
        if log is not None:
            path = log.resolve()
            command = f"perchctl log report {shlex.quote(str(path))}"
            rows = [*rows, ["log", str(path)], ["report", command]]
        self.page.end({"outcome": outcome.upper(), "good": good, "reason": reason, "rows": rows})


def flight_state(
    tick: Tick, drawing_sizes: dict[str, float], past: Sequence[Past] = ()
) -> dict[str, Any]:
    """The page's state for a tick: phase, battery, the rows of the terminal's panel, and a flag
    that says whether the flight is over. For the page's drawings, it also contains the height, the
    target's lateral offset and its distance above the vehicle in m (None: unknown), and
    `drawing_sizes` (`large_m`, `gear_m`). `past`: earlier values for a page that is opened late,
    sent as age in s, offset and distance."""
    state, volts = tick.state, tick.telemetry.battery_v
    off_m, below_m = tick.gear_to_target_lateral_and_up_m or (None, None)
    ground_m, hover = state.belief.ground_z_m, state.belief.profile.planner.hover
    return {
        "phase": state.phase.value,
        "battery": f"{volts:.2f} V" if math.isfinite(volts) else "battery unknown",
        "rows": [list(row) for row in status_rows(tick) if row[0] != "phase"],
        "note": f"held: {state.pause_reason}" if state.pause_reason else "",
        "over": state.phase.is_final,
        "steps": PERCH_STEPS if hover is None else HOVER_STEPS,
        "done": state.phase is Phase.PERCHED or state.outcome is Outcome.HOVERED,
        "height_m": tick.telemetry.position_m[2] - ground_m,
        "off_m": off_m,
        "below_m": below_m,
        "past": [(tick.t_s - t_s, *lengths_m) for t_s, *lengths_m in past],
        **drawing_sizes,
    }
