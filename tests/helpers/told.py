"""Logs for the tests of the report: the made-up flight, changed where a test asks."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from perchctl.mission import Event, EventKind, Phase
from perchctl.record import FlightLog
from perchctl.record.exact import to_rounded_json
from perchctl.record.fields import event_record
from tests.helpers import log as synthetic

Change = Callable[[dict[str, Any]], None]
NO_CHANGE: Change = lambda record: None  # noqa: E731
SUMMARY: Mapping[str, Any] = synthetic.SUMMARY
START_S = 1.1
"""The made-up flight's first tick, on the loop's clock."""


def made(
    change: Change = NO_CHANGE,
    summary: Mapping[str, Any] | None = SUMMARY,
    events: tuple[Event, ...] = (),
    **header: Any,
) -> FlightLog:
    """The flight of `tests.helpers.log.PLAN` as it is read back, without a file; `change` is given
    each tick's record."""
    records = [record.copy() for record in _flown()]
    for record in records:
        change(record)
    return FlightLog(
        path=Path("logs/flight.jsonl"),
        header=copy.deepcopy(_header()) | header,
        records=records,
        events=[event_record(event) for event in events],
        summary=None if summary is None else dict(summary),
        truncated=summary is None,
    )


@cache
def _flown() -> tuple[dict[str, Any], ...]:
    records = [to_rounded_json(record) for record in synthetic.ticks()]
    for record in records:
        if record["frame_t_s"] is not None:  # there it is on another clock than the ticks
            record["frame_t_s"] += START_S
    return tuple(records)


@cache
def _header() -> dict[str, Any]:
    plain: dict[str, Any] = to_rounded_json(synthetic.header())
    return plain


def entered(t_s: float, phase: Phase, reason: str, row: str = "", simulated: str = "") -> Event:
    """A phase's event, `t_s` after the flight's first tick."""
    return Event(START_S + t_s, EventKind.PHASE, reason, phase, row, simulated_fault=simulated)


def flown_s(record: Mapping[str, Any]) -> float:
    """Since the flight's first tick."""
    return float(record["t_s"]) - START_S
