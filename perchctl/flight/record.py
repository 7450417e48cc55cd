"""A flight's result as one JSON object, and back: the lines of a campaign's file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

from perchctl.flight.results import FlightResult
from perchctl.log import from_exact, to_exact

R = TypeVar("R")

TIMINGS = ("realtime_factor", "wall_s", "cpu_s", "peak_memory_mb")
"""What another computer, or the same one an hour later, measures otherwise."""
_NOT_FLOWN = ("timings", "log", "log_problem")


def result_record(result: Any) -> dict[str, Any]:
    """Of a `FlightResult`, or another campaign's: JSON's own types, floats exact. What is None by
    default is left out; what was measured of the computer is in `timings`."""
    record: dict[str, Any] = to_exact(result)
    timings = {name: record.pop(name) for name in TIMINGS if name in record}
    return {**record, "timings": timings}


def result_from(record: Mapping[str, Any], kind: type[R] = FlightResult) -> R:  # type: ignore[assignment]
    """The result that `result_record` was made of. Raises ValueError for what is none."""
    timings = record.get("timings", {})
    if not isinstance(timings, Mapping):
        raise ValueError("timings: an object is needed")
    return from_exact(kind, {**{k: v for k, v in record.items() if k != "timings"}, **timings})


def flown_record(result: Any) -> dict[str, Any]:
    """The record without timings and log: the same for the same flight, on whatever computer."""
    return {k: v for k, v in result_record(result).items() if k not in _NOT_FLOWN}
