"""What `perchctl simulate` may be asked together: the options that answer a question by flights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from perchctl.errors import UsageError

MOST_UNTIL = 10_000
"""Flights of `--until` where -n does not say how many at the most."""
_NARROWEST, _WIDEST = 0.01, 100.0
_LOGS = ("--log-dir", "--record", "--keep", "--out", "--resume")
_ANSWERS = ("--compare", "--sweep", "--until", "--minimise")
_NOT_WITH: dict[str, tuple[tuple[str, ...], str]] = {
    "--compare": (
        (*_LOGS, "--heat-map", "--output"),
        "flies each seed by two profiles, and prints a table",
    ),
    "--sweep": ((*_LOGS, "--output"), "flies each seed by many profiles, and keeps no logs"),
    "--until": (("--heat-map", "--output", "--keep"), "is a plain campaign that ends by itself"),
    "--minimise": (
        (*_LOGS, "-n", "--seed", "--heat-map"),
        "flies one seed under other and other conditions",
    ),
}


def check_modes(options: Mapping[str, Any]) -> None:
    """By the options' names; None or an empty tuple was not given. Errors: UsageError for options
    that do not go together."""
    given = {name: value for name, value in options.items() if value is not None and value != ()}
    asked = [name for name in (*_ANSWERS, "--faults", "--only") if name in given]
    answers = [name for name in asked if name in _ANSWERS]
    if answers and len(asked) > 1:
        raise UsageError(
            f"{' and '.join(asked)} do not go together: each flies its own seeds; ask for one "
            f"after the other"
        )
    if not answers:
        if "--output" in given:
            raise UsageError("--output is the profile that --minimise finds: name its SEED, too")
        return
    others, what = _NOT_WITH[answers[0]]
    wrong = [name for name in others if name in given]
    if wrong:
        does, it = ("does", "it") if len(wrong) == 1 else ("do", "them")
        raise UsageError(
            f"{answers[0]} {what}: {' and '.join(wrong)} {does} not apply; leave {it} out"
        )
    if "--heat-map" in given and len(given["--sweep"]) != 2:
        raise UsageError("--heat-map is drawn of two keys: give --sweep twice")
    if "--until" in given:
        width_of(given["--until"])


def width_of(text: str) -> float:
    """The width of an interval, as a share, of ``0.5%``. Errors: UsageError."""
    number, sign, rest = text.partition("%")
    try:
        percent = float(number)
    except ValueError:
        percent = 0.0
    if not sign or rest.strip() or not _NARROWEST <= percent < _WIDEST:
        raise UsageError(
            f"--until {text} must be a width in per cent, from {_NARROWEST:g}% to below "
            f"{_WIDEST:g}%, as in --until 0.5%"
        )
    return percent / 100.0
