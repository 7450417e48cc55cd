"""What differs between two flights: their numbers, their phases, their profiles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any

from perchctl.log.measures import Measures, measures_of, shown
from perchctl.log.read import FlightLog
from perchctl.log.shown import hung, plain, profile_name
from perchctl.log.summary import FlightSummary, summarise_flight

_NAME, _CELL = 32, 14
_NOT_THERE = "not there"


@dataclass(frozen=True)
class PhaseTimes:
    """How long, and how often, each of two flights was in a phase."""

    phase: str
    stays_s: tuple[float, float]
    visits: tuple[int, int]


@dataclass(frozen=True)
class Comparison:
    """Two flights side by side; `profile` has the keys with different values, each with both
    (None where a profile has no such key)."""

    logs: tuple[FlightLog, FlightLog]
    ends: tuple[FlightSummary, FlightSummary]
    measures: tuple[Measures, Measures]
    phases: tuple[PhaseTimes, ...]
    profile: dict[str, tuple[Any, Any]]


def compare_flights(one: FlightLog, other: FlightLog) -> Comparison:
    """Errors: InvalidValue for a field that is not a number."""
    logs = (one, other)
    return Comparison(
        logs,
        (summarise_flight(one), summarise_flight(other)),
        (measures_of(one), measures_of(other)),
        tuple(_phase_times(one, other)),
        profile_differences(one.header.get("profile"), other.header.get("profile")),
    )


def comparison_text(found: Comparison) -> str:
    """The comparison of two flights as a table, for people."""
    return "\n".join(_lines(found))


def comparison_record(found: Comparison) -> dict[str, Any]:
    """For programs: SI; a difference is the second flight's value less the first's."""
    a, b = found.measures
    return {
        "a": _flight_record(found, 0),
        "b": _flight_record(found, 1),
        "differences": {
            f.name: _less(getattr(b, f.name), getattr(a, f.name)) for f in fields(Measures)
        },
        "phases": [
            {
                "phase": each.phase,
                "a_s": round(each.stays_s[0], 6),
                "b_s": round(each.stays_s[1], 6),
                "difference_s": round(each.stays_s[1] - each.stays_s[0], 6),
                "a_visits": each.visits[0],
                "b_visits": each.visits[1],
            }
            for each in found.phases
        ],
        "profile": {key: {"a": a, "b": b} for key, (a, b) in found.profile.items()},
    }


def _flight_record(found: Comparison, which: int) -> dict[str, Any]:
    log, end, measures = found.logs[which], found.ends[which], found.measures[which]
    return {
        "log": str(log.path),
        "profile": profile_name(log.header),
        "seed": log.header.get("seed"),
        "outcome": end.outcome,
        "reason": end.reason,
        **{f.name: getattr(measures, f.name) for f in fields(measures)},
    }


def _less(of: Any, one: Any) -> Any:
    return None if of is None or one is None else of - one


def _lines(found: Comparison) -> Iterator[str]:
    for name, log, end in zip("AB", found.logs, found.ends, strict=True):
        seed = log.header.get("seed")
        which = f"profile {profile_name(log.header) or '?'}" + (
            "" if seed is None else f", {seed=}"
        )
        yield from hung(f"{name}:  ", f"{log.path} ({which.replace('=', ' ')})")
        yield from hung("    ", f"{end.outcome.upper()}: {end.reason}".rstrip(": "))
    yield ""
    yield _row("", "A", "B", "B - A")
    yield from _measure_rows(*found.measures)
    if found.phases:
        yield ""
        yield "time in each phase [s]"
    for each in found.phases:
        often = "" if each.visits == (1, 1) else f" ({each.visits[0]}x, {each.visits[1]}x)"
        a_s, b_s = each.stays_s
        name = f"  {plain(each.phase)}{often}"
        yield _row(name, f"{a_s:.2f}", f"{b_s:.2f}", f"{b_s - a_s:+.2f}")
    yield ""
    if not found.profile:
        yield "their profiles are the same"
        return
    yield "profile keys that differ, A and B"
    for key, (a, b) in found.profile.items():
        yield from hung(f"  {plain(key):<{_NAME - 2}}  ", f"{_value(a)}  {_value(b)}")


def _measure_rows(a: Measures, b: Measures) -> Iterator[str]:
    for f in fields(Measures):
        one, other = getattr(a, f.name), getattr(b, f.name)
        if one is None and other is None:
            continue
        meta = f.metadata
        name = meta["label"] + (f" [{meta['unit']}]" if meta["unit"] else "")
        difference = _less(other, one)
        told = "" if difference is None else f"{difference * meta['scale']:+.{meta['digits']}f}"
        yield _row(name, shown(a, f.name), shown(b, f.name), told)


def _row(name: str, a: str, b: str, difference: str) -> str:
    return f"{name:<{_NAME}}{a:>{_CELL}}{b:>{_CELL}}{difference:>{_CELL}}".rstrip()


def _value(value: Any) -> str:
    return "none" if value is None else str(value)


def _phase_times(one: FlightLog, other: FlightLog) -> Iterator[PhaseTimes]:
    names = dict.fromkeys(span.phase for log in (one, other) for span in log.phases)
    for name in names:
        stays = [[s.duration_s for s in log.phases if s.phase == name] for log in (one, other)]
        yield PhaseTimes(
            name,
            (sum(stays[0]), sum(stays[1])),
            (len(stays[0]), len(stays[1])),
        )


def profile_differences(one: Any, other: Any) -> dict[str, tuple[Any, Any]]:
    """The dotted keys of two profiles, as JSON has them, that have different values."""
    a, b = _flat(one), _flat(other)
    return {
        key: (a.get(key, _NOT_THERE), b.get(key, _NOT_THERE))
        for key in dict.fromkeys((*a, *b))
        if a.get(key, _NOT_THERE) != b.get(key, _NOT_THERE)
    }


def _flat(values: Any, prefix: str = "") -> dict[str, Any]:
    """Nested keys as dotted paths; an empty mapping is a value."""
    if not isinstance(values, Mapping):
        return {}
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
