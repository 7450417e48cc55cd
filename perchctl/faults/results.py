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
"""`refused`: it never took off; `failed`: an exception ended the flight, after the rescue;
`gone`: the program ended before its flight."""


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
    def is_bad(self) -> bool:
        """True if a flag counts against the program."""
        return bool(self.counted)


# --- A campaign's figures ----------------------------------------------------------------------


ENDS: tuple[End, ...] = get_args(End)
WORST = 20
PHASES = tuple(phase.value for phase in AIR)
SLIPS = {"to 0.3": (0.0, 0.3), "to 0.75": (0.3, 0.75), "above": (0.75, math.inf)}
"""Classes of slips by the magnet's hold over the weight."""
HEADS = ("appr", "srch", "est", "align", "asc", "perch", "compl", "recov", "land")
"""The column heads of the phases."""
RARE = {outcome.name for outcome in EXPECTED_OUTCOMES if not outcome.chosen}
"""The expected outcomes that neither the user nor the firmware chose."""


def fault_summary(results: Sequence[FaultResult]) -> dict[str, Any]:
    """Return a campaign's figures as a record for JSON.

    Each flag is counted where no expected outcome covers it. `unavoidable` is the number of flights
    with a covered flag; `expected_outcomes` gives the share of flights with each cause,
    `rare_outcomes` the share with one that nobody chose; `wrong` is the share of flights with a
    flag that counts, `not_known` of those whose program did not know whether the vehicle hangs or
    stands, `unconfirmed` of those whose landing it did not see. `drop_m` has the deepest slip by
    the magnet's hold, `touchdown` the hardest one without an expected outcome.
    """
    counts, expected = _counts(results), _expected(results)
    own = [r for r in results if not r.expected]
    return {
        "flights": len(results),
        **{end: sum(r.end == end for r in results) for end in ENDS},
        **{flag: sum(flag in r.counted for r in results) for flag in FLAGS},
        "unavoidable": sum(_is_unavoidable(r) for r in results),
        "expected_outcomes": {
            name: rate_record(count, len(results)) for name, count in expected.items()
        },
        **{name: rate_record(count, len(results)) for name, count in counts.items()},
        "drop_m": {name: _deepest_m(results, *bounds) for name, bounds in SLIPS.items()},
        "touchdown": {
            "down_mps": round(max((r.touchdown_mps for r in own), default=0.0), 3),
            "aside_mps": round(max((r.touchdown_aside_mps for r in own), default=0.0), 3),
        },
        "peak_memory_mb": peak_mb(results),
        "worst_seeds": [r.seed for r in worst_first(results)[:WORST]],
    }


def _counts(results: Sequence[FaultResult]) -> dict[str, int]:
    """Return the numbers of flights that the table gives as shares."""
    return {
        "wrong": sum(r.is_bad for r in results),
        "rare_outcomes": sum(bool(RARE & set(r.expected)) for r in results),
        "not_known": sum(r.row == NOT_KNOWN for r in results),
        "unconfirmed": sum(r.row == UNCONFIRMED for r in results),
    }


def _expected(results: Iterable[FaultResult]) -> dict[str, int]:
    """Return in how many flights the cause of each expected outcome came."""
    names = Counter(name for r in results for name in r.expected)
    return {outcome.name: names[outcome.name] for outcome in EXPECTED_OUTCOMES}


def _deepest_m(results: Iterable[FaultResult], above: float, to: float) -> float | None:
    slips = [r.drop_m for r in results if r.slip_ratio is not None and above < r.slip_ratio <= to]
    return round(max(slips), 3) if slips else None


def worst_first(results: Iterable[FaultResult]) -> list[FaultResult]:
    """Return the flights with a flag that counts, the gravest first."""
    bad = [r for r in results if r.is_bad]
    return sorted(bad, key=lambda r: (min(map(FLAGS.index, r.counted)), -len(r.counted), r.seed))


def fault_table(results: Sequence[FaultResult]) -> str:
    """Return the figures, a table of faults by phases, and the worst flights as plain text."""
    figures, counts = fault_summary(results), _counts(results)
    flown = {r.fault for r in results}
    lines = align_columns(
        [
            ("fault", *HEADS),
            *(
                (fault.name, *(_cell(results, fault.name, phase) for phase in PHASES))
                for fault in FAULTS
                if fault.name in flown
            ),
        ]
    )
    ends = ", ".join(f"{figures[end]} {end}" for end in ENDS if figures[end])
    shares = {name: rate_text(count, len(results)) for name, count in counts.items()}
    hardest = figures["touchdown"]
    drops = ", ".join(f"{d:.2f} m {n}" for n, d in figures["drop_m"].items() if d is not None)
    rows = [
        ("flights", str(figures["flights"]) + (f": {ends}" if ends else "")),
        ("with a flag", shares["wrong"]),
        *((flag.replace("_", " "), str(figures[flag])) for flag in FLAGS),
        ("unavoidable", str(figures["unavoidable"])),
        ("expected outcomes", f"{shares['rare_outcomes']}, those chosen aside"),
        *(
            (f"  {rate_text(count, len(results))} {name}", "")
            for name, count in _expected(results).items()
            if count
        ),
        ("not known", shares["not_known"]),
        ("unconfirmed", shares["unconfirmed"]),
        (
            "hardest touchdown",
            f"{hardest['down_mps']:.2f} m/s down, {hardest['aside_mps']:.2f} m/s sideways",
        ),
        *([("deepest slip", f"{drops} of the weight")] if drops else []),
    ]
    lines += ["", "a cell: flights, !k of them wrong, u: unavoidable among them", ""]
    lines += [f"{name:<18} {text}".rstrip() for name, text in rows]
    worst = worst_first(results)[:WORST]
    if worst:
        lines += ["", "worst flights"]
        lines += align_columns([("seed", "fault", "phase", "what", "end"), *map(_line, worst)])
    return "\n".join(lines)


def _is_unavoidable(result: FaultResult) -> bool:
    """Return True if the flight has a flag that an expected outcome covers."""
    return len(result.counted) < len(result.flags)


def _cell(results: Iterable[FaultResult], fault: str, phase: str) -> str:
    here = [r for r in results if r.fault == fault and r.phase == phase]
    if not here:
        return "."
    wrong = sum(r.is_bad for r in here)
    unavoidable = "u" if any(_is_unavoidable(r) for r in here) else ""
    return f"{len(here)}{f'!{wrong}' if wrong else ''}{unavoidable}"


def _line(r: FaultResult) -> tuple[str, ...]:
    flags = ", ".join(flag.replace("_", " ") for flag in r.counted)
    return str(r.seed), r.fault, r.phase, flags, r.end
