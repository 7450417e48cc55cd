"""Results: how one flight ended, the figures of a campaign, and rates with confidence intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.stats import binomtest

from perchctl.errors import SafetyAbort
from perchctl.sim import Scenario

FlightEnd = Literal["perched", "refused", "landed", "aborted"]
ENDS: tuple[FlightEnd, ...] = get_args(FlightEnd)
"""The ways in which a flight can end, from best to worst."""
WORST_FLIGHTS = 5
"""Number of bad flights that the table lists."""


@dataclass(frozen=True)
class CampaignFlight:
    """Result of one flight: the fields that all kinds of campaigns have in common.

    Attributes:
        log, log_problem: the path of the flight's log, and why it is incomplete; each may be None.
        cpu_s: CPU time of the flight, s.
        scenario: the scenario drawn from the seed.
    """

    seed: int
    outcome: str
    _: KW_ONLY
    log: Path | None = None
    log_problem: str | None = None
    cpu_s: float = 0.0
    scenario: Scenario | None = None

    @property
    def is_bad(self) -> bool:
        """True if the flight went wrong."""
        raise NotImplementedError


@dataclass(frozen=True)
class FlightResult(CampaignFlight):
    """One simulated flight.

    Attributes:
        outcome: the final phase, in lower case, or ``refused`` if the vehicle never took off.
        miss_m: true horizontal distance of the gear from the target's centre in the simulation;
            None if the vehicle did not perch.
        time_s: duration of the flight on the loop's clock.
        attempts: number of perching attempts, including the successful one.
        locked: True if the firmware's supervisor had locked the vehicle by the end.
        fell: True if the vehicle hit the floor other than by landing.
        variant: index of the flown profile, if several are compared.
    """

    outcome: FlightEnd
    reason: str
    miss_m: float | None
    time_s: float
    attempts: int
    locked: bool
    fell: bool
    variant: int = 0

    @property
    def is_bad(self) -> bool:
        """True if the vehicle did not perch, is locked or fell."""
        return self.outcome != "perched" or self.locked or self.fell


def campaign_summary(results: Sequence[FlightResult]) -> dict[str, Any]:
    """The figures of a campaign as a JSON object.

    `rates` are rates with intervals. `miss_m`: median, p95 (interpolated) and max over all flights
    that perched; None if none did. `worst_seeds` lists at most `WORST_FLIGHTS` bad flights.
    """
    ends: dict[str, int] = {end: sum(r.outcome == end for r in results) for end in ENDS}
    misses = [r.miss_m for r in results if r.outcome == "perched" and r.miss_m is not None]
    return {
        "flights": len(results),
        **ends,
        "rates": {end: rate_record(count, len(results)) for end, count in ends.items()},
        "locked": sum(r.locked for r in results),
        "fell": sum(r.fell for r in results),
        "miss_m": miss_percentiles(misses) | {"max": round(max(misses), 6) if misses else None},
        "worst_seeds": [r.seed for r in worst_first(results)[:WORST_FLIGHTS]],
    }


def miss_percentiles(misses_m: Sequence[float]) -> dict[str, float | None]:
    """The `median` and 95th percentile `p95` of the miss distances for JSON; None if there are
    none."""
    if not misses_m:
        return {"median": None, "p95": None}
    median_m, p95_m = np.percentile(misses_m, (50, 95)).round(6).tolist()
    return {"median": median_m, "p95": p95_m}


def worst_first(results: Iterable[FlightResult]) -> list[FlightResult]:
    """The bad flights, sorted by outcome (aborted, landed, refused, perched) and seed."""
    bad = [r for r in results if r.is_bad]
    return sorted(bad, key=lambda r: (-ENDS.index(r.outcome), r.seed))


def all_refused_error(results: Sequence[FlightResult]) -> SafetyAbort | None:
    """The error for a campaign in which every flight was refused, so that the seeds cannot be the
    cause; None for any other campaign."""
    if not results or any(r.outcome != "refused" for r in results):
        return None
    first = min(results, key=lambda r: r.seed)
    return SafetyAbort(f"every flight was refused before take-off: {first.reason}")


def campaign_table(results: Sequence[FlightResult]) -> str:
    """The campaign's figures and its worst flights as plain text."""
    figures = campaign_summary(results)
    lines = [f"{name:<18}{text}" for name, text in _rows(figures, results)]
    bad = worst_first(results)
    if bad:
        lines += ["", f"worst flights of {len(bad)}"]
        lines += align_columns(
            [("seed", "outcome", "miss [mm]", "time [s]", "attempts", "reason")]
            + [_cells(r) for r in bad[:WORST_FLIGHTS]]
        )
    return "\n".join(lines)


def align_columns(rows: Sequence[tuple[str, ...]]) -> list[str]:
    """Return rows of cells as lines with aligned columns; the first row is the heading."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _cells(r: FlightResult) -> tuple[str, ...]:
    flags = [word for word, on in (("locked", r.locked), ("fell", r.fell)) if on]
    outcome = ", ".join([r.outcome, *flags])
    miss = "-" if r.miss_m is None else f"{r.miss_m * 1e3:.1f}"
    return str(r.seed), outcome, miss, f"{r.time_s:.1f}", str(r.attempts), r.reason


def _rows(figures: Mapping[str, Any], results: Sequence[FlightResult]) -> list[tuple[str, str]]:
    rows = [("flights", str(figures["flights"]))]
    rows += [
        (end, rate_text(figures[end], figures["flights"]))
        for end in ENDS
        if end != "refused" or figures[end]
    ]
    rows += [("locked", str(figures["locked"])), ("fell", str(figures["fell"]))]
    miss = figures["miss_m"]
    if miss["max"] is not None:
        rows.append(("miss [mm]", ", ".join(f"{k} {m * 1e3:.1f}" for k, m in miss.items())))
    flown = [r for r in results if r.outcome != "refused"]
    if flown:
        times = [r.time_s for r in flown]
        attempts = [r.attempts for r in flown]
        rows.append(("flight time [s]", f"median {np.median(times):.1f}, max {max(times):.1f}"))
        rows.append(("attempts", f"mean {np.mean(attempts):.2f}, max {max(attempts)}"))
    return rows


# --- Rates with their uncertainty: k of n, and the confidence interval of the true rate ---


LEVEL = 0.95


def rate_interval(count: int, total: int, level: float = LEVEL) -> tuple[float, float]:
    """The exact two-sided confidence interval for the rate `count` / `total` (Clopper and Pearson,
    1934). The interval contains the true rate in at least a fraction `level` of all campaigns."""
    found = binomtest(count, total).proportion_ci(level, method="exact")
    return float(found.low), float(found.high)


def rate_text(count: int, total: int) -> str:
    """A rate with its interval: ``97 of 100 (91.5 to 99.4 %)``, ``100 of 100 (>= 96.4
    %)``."""
    text = f"{count} of {total}"
    if total == 0:
        return text
    low, high = (100.0 * bound for bound in rate_interval(count, total))
    if count == total:
        return f"{text} (>= {low:.1f} %)"
    if count == 0:
        return f"{text} (<= {high:.1f} %)"
    return f"{text} ({low:.1f} to {high:.1f} %)"


def rate_record(count: int, total: int) -> dict[str, float | list[float]]:
    """A rate and its interval for JSON; empty if `total` is 0."""
    if total == 0:
        return {}
    interval = [round(bound, 6) for bound in rate_interval(count, total)]
    return {"rate": round(count / total, 6), "interval": interval}
