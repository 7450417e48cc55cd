"""Whether this computer kept up with a simulated flight in real time.

The loop runs by the wall clock, and so does the simulated vehicle's process, as a real
vehicle would. Where the processor is too busy, pictures fail to come, telemetry is old and
the loop late, and the flight is ended for safety. The reason is then the computer, and neither
vehicle nor camera. The simulated clock is not slowed instead: the flight's ages are all taken
on the wall's clock, and a vehicle whose time runs slower would only look older.
"""

from __future__ import annotations

from collections import deque

from perchctl.mission.state import SEVEN, Outcome, Phase
from perchctl.mission.watch import Event, FlightReport, Tick
from perchctl.values import replace

WINDOW_S = 2.0
FEWEST_HZ, FEWEST_SHARE = 10.0, 0.4
LATEST_S = 0.25
FARTHEST_BEHIND_S = 0.3


class PaceWatcher:
    """Counts pictures and late turns.

    Attributes:
        frames_hz: the fewest pictures a second over `WINDOW_S` of the phases that look at
            them; infinite before the first window.
        late_s: of the latest turn.
    """

    problem: str | None = None

    def __init__(self) -> None:
        self.frames_hz = float("inf")
        self.late_s = 0.0
        self._looking_since_s: float | None = None
        self._frames_s: deque[float] = deque()

    def event(self, event: Event) -> None:
        return None

    def tick(self, tick: Tick) -> None:
        self.late_s = max(self.late_s, tick.loop_late_s)
        if tick.state.phase not in SEVEN or tick.state.phase is Phase.COMPLETE:
            self._looking_since_s = None
            return
        if self._looking_since_s is None:
            self._looking_since_s = tick.t_s
            self._frames_s.clear()
        if tick.output is not None:
            self._frames_s.append(tick.t_s)
        begin_s = tick.t_s - WINDOW_S
        while self._frames_s and self._frames_s[0] <= begin_s:
            self._frames_s.popleft()
        if self._looking_since_s <= begin_s:
            self.frames_hz = min(self.frames_hz, len(self._frames_s) / WINDOW_S)


def judged(
    report: FlightReport, pace: PaceWatcher, behind_s: float, camera_hz: float
) -> FlightReport:
    """The report of a simulated flight. Ended for safety on a computer that did not keep up,
    it names that for its reason. `behind_s`: by how much the simulator lost against the wall;
    `camera_hz`: the pictures that the simulated camera takes, of which some are lost."""
    fewest_hz = min(FEWEST_HZ, FEWEST_SHARE * camera_hz)
    kept_up = (
        pace.frames_hz >= fewest_hz and pace.late_s <= LATEST_S and behind_s <= FARTHEST_BEHIND_S
    )
    if report.outcome is not Outcome.SAFETY or kept_up:
        return report
    parts = [f"loop {pace.late_s:.1f} s late", f"simulator {max(0.0, behind_s):.1f} s behind"]
    if pace.frames_hz < float("inf"):
        parts.insert(0, f"{pace.frames_hz:.0f} frames a second")
    why = f"this computer is too slow for a flight in real time: {', '.join(parts)}"
    return replace(report, reason=f"{why} (perchctl simulate needs no real time); {report.reason}")
