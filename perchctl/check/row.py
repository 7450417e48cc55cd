"""A row of the check: one question, its verdict, what was found and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class Verdict(StrEnum):
    """How a question was answered."""

    PASS = "pass"
    WARN = "warn"
    """Flies, but worse than it could."""
    FAIL = "fail"
    """Do not fly like this."""
    SKIPPED = "skipped"
    """Could not be known; `found` says why. Never taken for a pass."""

    def worse_than(self, other: Verdict) -> bool:
        return _ORDER.index(self) > _ORDER.index(other)


_ORDER = (Verdict.PASS, Verdict.SKIPPED, Verdict.WARN, Verdict.FAIL)


@dataclass(frozen=True)
class Row:
    """One question about a set-up, answered."""

    name: str
    verdict: Verdict
    found: str
    """What was seen, with units; for a skipped row, why nothing was."""
    advice: str = ""
    """What to do; empty on a pass."""


def passed(name: str, found: str) -> Row:
    return Row(name, Verdict.PASS, found)


def warned(name: str, found: str, advice: str) -> Row:
    return Row(name, Verdict.WARN, found, advice)


def failed(name: str, found: str, advice: str) -> Row:
    return Row(name, Verdict.FAIL, found, advice)


def skipped(name: str, why: str, advice: str = "") -> Row:
    return Row(name, Verdict.SKIPPED, why, advice)


def worse(one: Row, other: Row) -> Row:
    return one if one.verdict.worse_than(other.verdict) else other


def by_limits(
    name: str, value: float, warn_above: float, fail_above: float, found: str, advice: str
) -> Row:
    """A figure that is the better the smaller it is; one that is no number fails."""
    if value <= warn_above:
        return passed(name, found)
    return (warned if value <= fail_above else failed)(name, found, advice)
