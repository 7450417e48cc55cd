"""How flights with faults ended: one flight's result, and a campaign's figures for JSON and as a
table of faults and phases."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from perchctl.campaign import align_columns, peak_mb, rate_record, rate_text
from perchctl.faults.catalogue import AIR, FAULTS
from perchctl.faults.claims import NOT_KNOWN, UNCONFIRMED
from perchctl.faults.expected_outcomes import EXPECTED_OUTCOMES
from perchctl.faults.oracle import FLAGS, Flag
from perchctl.sim import Scenario

End = Literal["perched", "landed", "aborted", "refused", "failed", "gone"]
"""`refused`: never took off; `failed`: an exception ended the flight, behind its rescue; `gone`:
the program ended before its flight."""


@dataclass(frozen=True)
class FaultResult:
    """One flight.

    Attributes:
        flags: what went wrong, with when.
        counted: the flags that no expected outcome covers.
        expected: the names of the expected outcomes whose cause came, whether or not a flag was
            raised; `unavoidable`: their reasons, None where there are none.
        begin_s: when the fault began; None when the flight was over before.
        row: of the mission's table, that ended the flight; empty where none did.
        drop_m: the deepest fall until caught, in the simulation's truth; `slip_ratio`: the
            magnet's hold over the weight, where that was a slip from the magnet.
        touchdown_mps, touchdown_aside_mps: the hardest touchdown, downwards and sideways.
        astray_m: in the air, the farthest from where it should have been.
        log, log_problem: the flight's log, and what it lacks; None without.
        cpu_s, peak_memory_mb, scenario: as `perchctl.campaign.FlightResult` has them.
    """

    seed: int
    fault: str
    phase: str
    moment_s: float
    begin_s: float | None
    parameters: dict[str, Any]
    end: End
    cause: str
    reason: str
    flags: dict[Flag, float]
    counted: tuple[Flag, ...]
    unavoidable: str | None
    time_s: float
    miss_m: float | None
    drop_m: float
    slip_ratio: float | None = None
    wall_s: float = 0.0
    way: tuple[str, ...] = field(default=())
    log: Path | None = None
    log_problem: str | None = None
    cpu_s: float = 0.0
    peak_memory_mb: float = 0.0
    scenario: Scenario | None = None
    row: str = ""
    expected: tuple[str, ...] = ()
    touchdown_mps: float = 0.0
    touchdown_aside_mps: float = 0.0
    astray_m: float = 0.0

    @property
    def outcome(self) -> str:
        return self.end

    @property
    def badness(self) -> tuple[bool, int, int, float]:
        """The larger the worse: by the gravest flag that counts, by how many, then the misses."""
        gravest = max((-FLAGS.index(flag) for flag in self.counted), default=-len(FLAGS))
        return bool(self.counted), gravest, len(self.counted), self.miss_m or 0.0


# --- A campaign's figures ----------------------------------------------------------------------


ENDS: tuple[End, ...] = get_args(End)
WORST = 20
PHASES = tuple(phase.value for phase in AIR)
SLIPS = {"to 0.3": (0.0, 0.3), "to 0.75": (0.3, 0.75), "above": (0.75, math.inf)}
"""What the magnet held, over the weight, where it let go."""
HEADS = ("appr", "srch", "est", "align", "asc", "perch", "compl", "recov", "land")
"""The phases' heads, as narrow as their columns."""


def fault_summary(results: Sequence[FaultResult]) -> dict[str, Any]:
    """Ready for JSON. The flags are counted outside the unavoidable; `unavoidable` is the
    number of flights in which one was expected, `expected_outcomes` the share of flights in which
    the cause of each came, `rare_outcomes` that of all that nobody chose; `wrong` the share of
    flights with a flag, `not_known` of those that ended without the program's knowing whether the
    vehicle hangs or stands, `unconfirmed` of those whose landing it did not see; `drop_m` the
    deepest slips from a magnet that held up to so much of the weight, `touchdown` the hardest
    ones outside of expected outcomes."""
    return {
        "flights": len(results),
        **{end: sum(r.end == end for r in results) for end in ENDS},
        **{flag: sum(flag in r.counted for r in results) for flag in FLAGS},
        "wrong": rate_record(sum(bool(r.counted) for r in results), len(results)),
        "unavoidable": sum(_is_unavoidable(r) for r in results),
        "expected_outcomes": {
            name: rate_record(count, len(results)) for name, count in expected(results).items()
        },
        "rare_outcomes": rate_record(_rare(results), len(results)),
        "not_known": rate_record(_ended_by(results, NOT_KNOWN), len(results)),
        "unconfirmed": rate_record(_ended_by(results, UNCONFIRMED), len(results)),
        "drop_m": {name: _deepest_m(results, *bounds) for name, bounds in SLIPS.items()},
        "touchdown": {
            "down_mps": _hardest_mps(results, "touchdown_mps"),
            "aside_mps": _hardest_mps(results, "touchdown_aside_mps"),
        },
        "peak_memory_mb": peak_mb(results),
        "worst_seeds": [r.seed for r in worst_first(results)[:WORST]],
    }


def expected(results: Iterable[FaultResult]) -> dict[str, int]:
    """In how many flights the cause of each expected outcome came."""
    names = Counter(name for r in results for name in r.expected)
    return {outcome.name: names[outcome.name] for outcome in EXPECTED_OUTCOMES}


def _rare(results: Iterable[FaultResult]) -> int:
    """Flights with an expected outcome that neither the user nor the firmware chose."""
    rare = {outcome.name for outcome in EXPECTED_OUTCOMES if not outcome.chosen}
    return sum(bool(rare & set(r.expected)) for r in results)


def _ended_by(results: Iterable[FaultResult], row: str) -> int:
    return sum(r.row == row for r in results)


def _hardest_mps(
    results: Iterable[FaultResult], of: Literal["touchdown_mps", "touchdown_aside_mps"]
) -> float:
    found: list[float] = [getattr(r, of) for r in results if not r.expected]
    return round(max(found, default=0.0), 3)


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
    lines = align_columns(cells)
    lines += ["", "a cell: flights, !k of them wrong, u: unavoidable among them", ""]
    ends = ", ".join(f"{figures[end]} {end}" for end in ENDS if figures[end])
    lines.append(f"flights            {figures['flights']}" + (f": {ends}" if ends else ""))
    lines.append(f"with a flag        {rate_text(len(worst_first(results)), len(results))}")
    lines += [f"{flag.replace('_', ' '):<18} {figures[flag]}" for flag in FLAGS]
    flights = len(results)
    lines.append(f"unavoidable        {figures['unavoidable']}")
    lines.append(f"expected outcomes  {rate_text(_rare(results), flights)}, those chosen aside")
    lines += [
        f"  {rate_text(count, flights)} {name}"
        for name, count in expected(results).items()
        if count
    ]
    lines.append(f"not known          {rate_text(_ended_by(results, NOT_KNOWN), flights)}")
    lines.append(f"unconfirmed        {rate_text(_ended_by(results, UNCONFIRMED), flights)}")
    hardest = figures["touchdown"]
    lines.append(
        f"hardest touchdown  {hardest['down_mps']:.2f} m/s down, "
        f"{hardest['aside_mps']:.2f} m/s sideways"
    )
    drops = ", ".join(f"{d:.2f} m {n}" for n, d in figures["drop_m"].items() if d is not None)
    if drops:
        lines.append(f"deepest slip       {drops} of the weight")
    worst = worst_first(results)[:WORST]
    if worst:
        lines += ["", "worst flights"]
        lines += align_columns([("seed", "fault", "phase", "what", "end"), *map(_line, worst)])
    return "\n".join(lines)


def _is_unavoidable(result: FaultResult) -> bool:
    """Whether something went wrong that could not be avoided."""
    return len(result.counted) < len(result.flags)


def _cell(results: Iterable[FaultResult], fault: str, phase: str) -> str:
    here = [r for r in results if r.fault == fault and r.phase == phase]
    if not here:
        return "."
    wrong = sum(bool(r.counted) for r in here)
    unavoidable = "u" if any(_is_unavoidable(r) for r in here) else ""
    return f"{len(here)}{f'!{wrong}' if wrong else ''}{unavoidable}"


def _line(r: FaultResult) -> tuple[str, ...]:
    flags = ", ".join(flag.replace("_", " ") for flag in r.counted)
    return str(r.seed), r.fault, r.phase, flags, r.end
