"""Compare two flights: their figures, their phases and their profiles."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from typing import Any

from perchctl.analysis.flight import FlightAnalysis, Measures
from perchctl.analysis.show import printable_text, with_hanging_indent

_HEADING, _CELL = 32, 14
_NOT_THERE = "not there"


@dataclass(frozen=True, eq=False)
class FlightComparison:
    """Two flights side by side, A and B."""

    flights: tuple[FlightAnalysis, FlightAnalysis]

    @cached_property
    def phase_times(self) -> list[dict[str, Any]]:
        """One dict for each phase that A or B flew: its name `phase`, and how long each flight
        spent in it (`a_s`, `b_s`)."""
        names = dict.fromkeys(stay.phase for flight in self.flights for stay in flight.log.phases)
        found = []
        for name in names:
            a_s, b_s = (
                sum(stay.duration_s for stay in flight.log.phases if stay.phase == name)
                for flight in self.flights
            )
            found.append({"phase": name, "a_s": round(a_s, 6), "b_s": round(b_s, 6)})
        return found

    @cached_property
    def changed_keys(self) -> dict[str, tuple[Any, Any]]:
        """The dotted profile keys that differ, each with its value in A and in B."""
        a, b = (flight.log.header.get("profile") for flight in self.flights)
        return profile_differences(a, b)

    @cached_property
    def differences(self) -> dict[str, Any]:
        """The difference, B minus A, for each field of `Measures`; None if either value is
        unknown."""
        a, b = (asdict(flight.measures) for flight in self.flights)
        return {
            name: None if a[name] is None or b[name] is None else b[name] - a[name] for name in a
        }

    def record(self) -> dict[str, Any]:
        """The comparison as a JSON object, in SI units; differences are B minus A."""
        a, b = (_flight_record(flight) for flight in self.flights)
        return {
            "a": a,
            "b": b,
            "differences": self.differences,
            "phases": self.phase_times,
            "profile": {key: {"a": a, "b": b} for key, (a, b) in self.changed_keys.items()},
        }

    def text(self) -> str:
        """The comparison as a text table."""
        return "\n".join(self._lines())

    def _lines(self) -> Iterator[str]:
        for name, flight in zip("AB", self.flights, strict=True):
            log, end = flight.log, flight.summary
            yield from with_hanging_indent(f"{name}:  ", f"{log.path} ({log.setup_text})")
            yield from with_hanging_indent(
                "    ", f"{end.outcome.upper()}: {end.reason}".rstrip(": ")
            )
        yield ""
        yield _row("", "A", "B", "B - A")
        yield from self._measure_rows()
        if self.phase_times:
            yield ""
            yield "time in each phase [s]"
        for each in self.phase_times:
            name, a_s, b_s = printable_text(each["phase"]), each["a_s"], each["b_s"]
            yield _row(f"  {name}", f"{a_s:.2f}", f"{b_s:.2f}", f"{b_s - a_s:+.2f}")
        yield ""
        yield (
            "profile keys that differ, with their values in A and B"
            if self.changed_keys
            else "A and B have the same profile"
        )
        for key, values in self.changed_keys.items():
            a, b = ("none" if value is None else value for value in values)
            yield from with_hanging_indent(
                f"  {printable_text(key):<{_HEADING - 2}}  ", f"{a}  {b}"
            )

    def _measure_rows(self) -> Iterator[str]:
        a, b = (flight.measures for flight in self.flights)
        for f in fields(Measures):
            if getattr(a, f.name) is None and getattr(b, f.name) is None:
                continue
            meta, difference = f.metadata, self.differences[f.name]
            label = meta["label"] + (f" [{meta['unit']}]" if meta["unit"] else "")
            less = "" if difference is None else f"{difference * meta['scale']:+.{meta['digits']}f}"
            yield _row(label, a.value_text(f.name), b.value_text(f.name), less)


def _flight_record(flight: FlightAnalysis) -> dict[str, Any]:
    return {
        "log": str(flight.log.path),
        "profile": flight.log.profile_name,
        "seed": flight.log.header.get("seed"),
        "outcome": flight.summary.outcome,
        "reason": flight.summary.reason,
        **asdict(flight.measures),
    }


def _row(name: str, a: str, b: str, difference: str) -> str:
    return f"{name:<{_HEADING}}{a:>{_CELL}}{b:>{_CELL}}{difference:>{_CELL}}".rstrip()


def profile_differences(profile_a: Any, profile_b: Any) -> dict[str, tuple[Any, Any]]:
    """The dotted keys whose values differ between two profiles (nested dicts, as read from JSON),
    each with the values in A and B (``not there`` for a missing key)."""
    a, b = _flat(profile_a), _flat(profile_b)
    return {
        key: (a.get(key, _NOT_THERE), b.get(key, _NOT_THERE))
        for key in dict.fromkeys((*a, *b))
        if a.get(key, _NOT_THERE) != b.get(key, _NOT_THERE)
    }


def _flat(values: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(values, Mapping):
        return {}
    found: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping) and value:
            found |= _flat(value, f"{prefix}{key}.")
        else:
            found[f"{prefix}{key}"] = value
    return found
