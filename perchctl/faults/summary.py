"""A fault campaign's figures: for JSON, and as a table of faults and phases."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, get_args

from perchctl.faults.catalogue import AIR, FAULTS
from perchctl.faults.oracle import FLAGS
from perchctl.faults.result import End, FaultResult
from perchctl.flight.rates import rate_record, rate_text
from perchctl.flight.results import aligned, peak_mb

ENDS: tuple[End, ...] = get_args(End)
WORST = 20
PHASES = tuple(phase.value for phase in AIR)
SLIPS = {"to 0.3": (0.0, 0.3), "to 0.75": (0.3, 0.75), "above": (0.75, math.inf)}
"""What the magnet held, over the weight, where it let go."""
HEADS = ("appr", "srch", "est", "align", "asc", "perch", "compl", "recov", "land")
"""The phases' heads, as narrow as their columns."""


def fault_summary(results: Sequence[FaultResult]) -> dict[str, Any]:
    """Ready for JSON. The flags are counted outside the unavoidable; `unavoidable` is the
    number of flights in which one was excused, `wrong` the share of flights with a flag and its
    interval, `drop_m` the deepest slips from a magnet that
    held up to so much of the weight."""
    return {
        "flights": len(results),
        **{end: sum(r.end == end for r in results) for end in ENDS},
        **{flag: sum(flag in r.counted for r in results) for flag in FLAGS},
        "wrong": rate_record(sum(bool(r.counted) for r in results), len(results)),
        "unavoidable": sum(_is_excused(r) for r in results),
        "drop_m": {name: _deepest_m(results, *bounds) for name, bounds in SLIPS.items()},
        "peak_memory_mb": peak_mb(results),
        "worst_seeds": [r.seed for r in worst_first(results)[:WORST]],
    }


def _deepest_m(results: Iterable[FaultResult], above: float, to: float) -> float | None:
    slips = [r.drop_m for r in results if r.slip_ratio is not None and above < r.slip_ratio <= to]
    return round(max(slips), 3) if slips else None


def worst_first(results: Iterable[FaultResult]) -> list[FaultResult]:
    """Flights with flags of their own, the gravest first."""
    bad = [r for r in results if r.counted]
    return sorted(bad, key=lambda r: (min(map(FLAGS.index, r.counted)), -len(r.counted), r.seed))


def fault_table(results: Sequence[FaultResult]) -> str:
    """The figures, faults against phases, and the worst flights, as plain text."""
    figures = fault_summary(results)
    flown = {r.fault for r in results}
    cells: list[tuple[str, ...]] = [("fault", *HEADS)]
    cells += [
        (fault.name, *(_cell(results, fault.name, phase) for phase in PHASES))
        for fault in FAULTS
        if fault.name in flown
    ]
    lines = aligned(cells)
    lines += ["", "a cell: flights, !k of them wrong, u: unavoidable among them", ""]
    ends = ", ".join(f"{figures[end]} {end}" for end in ENDS if figures[end])
    lines.append(f"flights            {figures['flights']}" + (f": {ends}" if ends else ""))
    lines.append(f"with a flag        {rate_text(len(worst_first(results)), len(results))}")
    lines += [f"{flag.replace('_', ' '):<18} {figures[flag]}" for flag in FLAGS]
    lines.append(f"unavoidable        {figures['unavoidable']}")
    lines += [f"  {count} x {reason}" for reason, count in reasons(results).items()]
    drops = ", ".join(f"{d:.2f} m {n}" for n, d in figures["drop_m"].items() if d is not None)
    if drops:
        lines.append(f"deepest slip       {drops} of the weight")
    worst = worst_first(results)[:WORST]
    if worst:
        lines += ["", "worst flights"]
        lines += aligned([("seed", "fault", "phase", "what", "end"), *map(_line, worst)])
    return "\n".join(lines)


def reasons(results: Iterable[FaultResult]) -> dict[str, int]:
    """Why flights were excused, and how many."""
    return dict(Counter(r.unavoidable or "" for r in results if _is_excused(r)))


def _is_excused(result: FaultResult) -> bool:
    """Whether something went wrong that could not be avoided."""
    return len(result.counted) < len(result.flags)


def _cell(results: Iterable[FaultResult], fault: str, phase: str) -> str:
    here = [r for r in results if r.fault == fault and r.phase == phase]
    if not here:
        return "."
    wrong = sum(bool(r.counted) for r in here)
    excused = "u" if any(_is_excused(r) for r in here) else ""
    return f"{len(here)}{f'!{wrong}' if wrong else ''}{excused}"


def _line(r: FaultResult) -> tuple[str, ...]:
    flags = ", ".join(flag.replace("_", " ") for flag in r.counted)
    return str(r.seed), r.fault, r.phase, flags, r.end
