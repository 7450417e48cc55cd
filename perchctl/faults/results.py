"""Results of flights with faults: the result of a single flight, and the figures of a campaign for
JSON and as a table."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from perchctl.campaign import CampaignFlight, align_columns, rate_record, rate_text
from perchctl.faults.catalogue import FAULTS
from perchctl.faults.expected_outcomes import EXPECTED_OUTCOMES
from perchctl.faults.oracle import FLAGS, NOT_KNOWN, UNCONFIRMED, Flag

ENDS = {
    "perched": "vehicle hanging on the magnet, motors off",
    "landed": "vehicle on the ground, motors off",
    "aborted": "stopped by the operator, by the vehicle or for safety",
    "refused": "never took off",
    "failed": "ended with an exception, after the rescue routine ran",
    "gone": "the program ended before the flight did",
}
"""The ways in which a flight can end, and their meanings."""


@dataclass(frozen=True)
class FaultResult(CampaignFlight):
    """Result of one flight with a fault.

    Attributes:
        outcome: one of `ENDS`.
        flags: what went wrong: each flag with the time at which it was first raised.
        counted: the flags that count against the program, because no expected outcome covers them.
        expected: the names of the expected outcomes whose cause occurred, whether or not a flag was
            raised.
        begin_s: when the fault began, `moment_s` into `phase`; None if the flight ended before
            that.
        miss_m: distance from the target's centre; None if the vehicle did not perch.
        way: the phases of the flight, in order.
        row: name of the transition that ended the flight; empty if no transition did.
        drop_m: true depth of the deepest fall until it was caught.
        astray_m: largest distance in the air from where the vehicle should have been.
    """

    fault: str
    phase: str
    moment_s: float
    begin_s: float | None
    parameters: dict[str, Any]
    reason: str
    flags: dict[Flag, float]
    counted: tuple[Flag, ...]
    time_s: float
    miss_m: float | None
    drop_m: float
    way: tuple[str, ...] = ()
    row: str = ""
    expected: tuple[str, ...] = ()
    astray_m: float = 0.0

    @property
    def is_bad(self) -> bool:
        """True if a flag counts against the program."""
        return bool(self.counted)

    @property
    def is_excused(self) -> bool:
        """True if an expected outcome covers one of the flags."""
        return len(self.counted) < len(self.flags)


# --- A campaign's figures ---


WORST_CASES = 20
SHARES = {
    "wrong": "with a flag that counts against perchctl",
    "not_known": "vehicle either hanging or on the floor",
    "unconfirmed": "perchctl did not see the vehicle land",
}
"""The counts that are given as shares of all flights, and what they mean."""


def fault_summary(results: Sequence[FaultResult]) -> dict[str, Any]:
    """The figures of a campaign as a JSON object.

    A flag is not counted in flights in which an expected outcome covers it. `unavoidable` is the
    number of flights with a covered flag, and `expected_outcomes` the number of flights with each
    cause. The figures in `SHARES` are shares of all flights.
    """
    return {
        "flights": len(results),
        **{end: sum(r.outcome == end for r in results) for end in ENDS},
        **{flag: sum(flag in r.counted for r in results) for flag in FLAGS},
        "unavoidable": sum(r.is_excused for r in results),
        "expected_outcomes": dict(Counter(name for r in results for name in r.expected)),
        **{name: rate_record(count, len(results)) for name, count in _counts(results).items()},
        "worst_seeds": [r.seed for r in worst_first(results)[:WORST_CASES]],
    }


def _counts(results: Sequence[FaultResult]) -> dict[str, int]:
    return {
        "wrong": sum(r.is_bad for r in results),
        "not_known": sum(r.row == NOT_KNOWN for r in results),
        "unconfirmed": sum(r.row == UNCONFIRMED for r in results),
    }


def worst_first(results: Iterable[FaultResult]) -> list[FaultResult]:
    """Return the flights with a flag that counts against the program, the most serious first."""
    bad, order = [r for r in results if r.is_bad], list(FLAGS)
    return sorted(bad, key=lambda r: (min(map(order.index, r.counted)), -len(r.counted), r.seed))


def fault_table(results: Sequence[FaultResult]) -> str:
    """Return the flights by fault, the figures and the worst flights as plain text."""
    figures, flown = fault_summary(results), Counter(r.fault for r in results)
    wrong = Counter(r.fault for r in results if r.is_bad)
    excused = Counter(r.fault for r in results if r.is_excused)
    rows = [(f.name, flown[f.name], wrong[f.name], excused[f.name]) for f in FAULTS]
    lines = align_columns(
        [("fault", "flights", "wrong", "unavoidable")]
        + [(name, *map(str, counts)) for name, *counts in rows if counts[0]]
    )
    lines.append("")
    for name, count in _counts(results).items():
        lines.append(f"{rate_text(count, len(results)):<29}{_explained(name, SHARES[name])}")
    meanings = {
        "flights": "all flights",
        **ENDS,
        **FLAGS,
        "unavoidable": "with a flag that physics or the firmware excuses",
    }
    lines += [f"{figures[name]:>6}  {_explained(name, text)}" for name, text in meanings.items()]
    for each in EXPECTED_OUTCOMES:
        if count := figures["expected_outcomes"].get(each.name):
            lines.append(f"{count:>8}  {_explained(each.name, each.reason)}")
    worst = worst_first(results)[:WORST_CASES]
    if worst:
        lines += ["", "worst flights"]
        lines += align_columns([("seed", "fault", "phase", "what", "end"), *map(_line, worst)])
    return "\n".join(lines)


def _explained(name: str, meaning: str) -> str:
    return f"{name.replace('_', ' ')}: {meaning}"


def _line(r: FaultResult) -> tuple[str, ...]:
    flags = ", ".join(flag.replace("_", " ") for flag in r.counted)
    return str(r.seed), r.fault, r.phase, flags, r.outcome
