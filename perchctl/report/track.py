"""A flight's ticks by time, and the places where something changed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from perchctl.geometry import Array
from perchctl.log import FlightLog, PhaseSpan
from perchctl.report.motion import Motion, motion_of

SAME_S = 1e-3


@dataclass(frozen=True)
class Step:
    """A phase that was entered; times from the flight's first tick, `end_s` that of the next."""

    phase: str
    start_s: float
    end_s: float
    reason: str
    row: str = ""
    severity: str = ""
    simulated: str = ""


@dataclass(frozen=True, eq=False)
class Track:
    """A log with what the report asks of it again and again. Times start at 0."""

    log: FlightLog

    @cached_property
    def t_s(self) -> Array:
        return self.log.since(self.log.column("t_s"))

    @cached_property
    def motion(self) -> Motion:
        return motion_of(self.log)

    @property
    def end_s(self) -> float:
        return float(self.t_s[-1]) if self.t_s.size else 0.0

    def index_at(self, t_s: float) -> int:
        """The newest tick at that time."""
        return max(0, int(np.searchsorted(self.t_s, t_s + SAME_S / 2, side="right")) - 1)

    def at(self, t_s: float, key: str) -> float:
        """A field then, NaN where it is missing."""
        if not self.log.records:
            return math.nan
        value = self.log.records[self.index_at(t_s)].get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return math.nan
        return float(value)

    def height_m(self, t_s: float) -> float:
        """Above the place of the first tick."""
        return self.at(t_s, "z_m") - self.at(0.0, "z_m")

    def within(self, start_s: float, end_s: float) -> slice:
        """The ticks from one time to another."""
        first, last = np.searchsorted(self.t_s, (start_s - SAME_S / 2, end_s + SAME_S / 2))
        return slice(int(first), int(last))

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        """The phases as they were entered, with the rows that led there where events tell."""
        events = [e for e in self.log.events if e.get("event") == "phase"]
        steps = [self._step(span, events) for span in self.log.phases]
        told = {round(step.start_s, 2) for step in steps}
        for event in events:  # an end that no tick followed
            start_s = self.log.since(float(event["t_s"]))
            if steps and start_s > steps[-1].end_s - SAME_S and round(start_s, 2) not in told:
                span = PhaseSpan(
                    str(event.get("phase") or ""),
                    float(event["t_s"]),
                    float(event["t_s"]),
                    str(event.get("reason") or ""),
                )
                steps.append(self._step(span, [event]))
        return tuple(steps)

    def _step(self, span: PhaseSpan, events: list[dict[str, Any]]) -> Step:
        event = next(
            (
                e
                for e in events
                if e.get("phase") == span.phase and abs(float(e["t_s"]) - span.start_s) < SAME_S
            ),
            {},
        )
        return Step(
            span.phase,
            self.log.since(span.start_s),
            self.log.since(span.end_s),
            span.reason or str(event.get("reason") or ""),
            str(event.get("row") or ""),
            str(event.get("severity") or ""),
            str(event.get("simulated") or ""),
        )

    def runs(self, key: str) -> Iterator[tuple[float, float, str]]:
        """Stretches over which a text stayed the same, without those that have none."""
        began_s, text = 0.0, ""
        for t_s, record in zip(self.t_s, self.log.records, strict=True):
            now = str(record.get(key) or "")
            if now == text:
                continue
            if text:
                yield began_s, float(t_s), text
            began_s, text = float(t_s), now
        if text:
            yield began_s, self.end_s, text
