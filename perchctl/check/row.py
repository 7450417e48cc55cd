"""A row of a check's output: the check's name, its verdict, the finding and advice."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple, ParamSpec

from perchctl.errors import Problem


class Verdict(StrEnum):
    """Verdict of a check: passed, warning, failed or skipped."""

    PASS = "pass"
    WARN = "warn"
    """The vehicle can fly, but not as well as it could."""
    FAIL = "fail"
    """The vehicle must not fly in this state."""
    SKIPPED = "skipped"
    """The check could not be carried out; `found` says why. A skipped check never counts as
    passed."""


@dataclass(frozen=True)
class Row:
    """Result of a check: what it `found`, with units, and `advice` (may be empty)."""

    name: str
    verdict: Verdict
    found: str
    """What was observed, with units; for a skipped row, the reason."""
    advice: str = ""
    """What to do; empty if the row passes."""


class Finding(NamedTuple):
    """Result of a check without the check's name, which `Row` adds."""

    verdict: Verdict
    found: str
    advice: str = ""


class Unanswerable(Exception):
    """Raised if a check cannot be carried out; `finding` is the skipped finding to report."""

    def __init__(self, why: str, advice: str = "") -> None:
        super().__init__(why)
        self.finding = skipped(why, advice)


P = ParamSpec("P")


def evaluate_row(name: str, judge: Callable[P, Finding], *args: P.args, **kwargs: P.kwargs) -> Row:
    """Return the row with the finding of `judge`, skipped if it raises `Unanswerable`."""
    try:
        return Row(name, *judge(*args, **kwargs))
    except Unanswerable as unknown:
        return Row(name, *unknown.finding)


def evaluate_rows(
    judges: Mapping[str, Callable[P, Finding]], *args: P.args, **kwargs: P.kwargs
) -> list[Row]:
    """Return a row for each check function, in the order of the mapping."""
    return [evaluate_row(name, judge, *args, **kwargs) for name, judge in judges.items()]


def skipped_rows(names: Iterable[str], why: str, advice: str = "") -> list[Row]:
    """A skipped row for each name, all with the same reason."""
    return [Row(name, *skipped(why, advice)) for name in names]


def passed(found: str) -> Finding:
    """A passing finding; `found` is the observation, with units."""
    return Finding(Verdict.PASS, found)


def warned(found: str, advice: str) -> Finding:
    """A warning finding, with advice."""
    return Finding(Verdict.WARN, found, advice)


def failed(found: str, advice: str) -> Finding:
    """A failing finding, with advice."""
    return Finding(Verdict.FAIL, found, advice)


def skipped(why: str, advice: str = "") -> Finding:
    """A skipped finding, with the reason."""
    return Finding(Verdict.SKIPPED, why, advice)


def problem_finding(problem: Problem | None, found: str) -> Finding:
    """Return a failing finding for `problem`, by the criteria of `fly`; a passing finding if it is
    None."""
    return passed(found) if problem is None else failed(problem.found, problem.advice)


def limits_finding(
    value: float, warn_above: float, fail_above: float, found: str, advice: str
) -> Finding:
    """Check a value for which smaller is better; NaN fails."""
    if value <= warn_above:
        return passed(found)
    return (warned if value <= fail_above else failed)(found, advice)


def worst_finding(*findings: Finding) -> Finding:
    """Return the worst finding; the first one if several are equally bad."""
    order = (Verdict.PASS, Verdict.SKIPPED, Verdict.WARN, Verdict.FAIL)
    return max(findings, key=lambda finding: order.index(finding.verdict))
