"""How flights ended: one flight's result and the figures of a campaign of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

FlightEnd = Literal["perched", "landed", "aborted"]
ENDS: tuple[FlightEnd, ...] = get_args(FlightEnd)


@dataclass(frozen=True)
class FlightResult:
    """One simulated flight.

    Attributes:
        outcome: the terminal phase, in small letters.
        miss_m: horizontal distance of the gear from the target's centre in the
            simulation's truth; None when it did not perch.
        time_s: duration of the flight in the loop's time.
        attempts: perching attempts, the successful one included.
        locked: the supervisor had locked the vehicle at the end.
        fell: it hit the floor other than by landing.
        realtime_factor: loop time over wall time.
    """

    seed: int
    outcome: FlightEnd
    reason: str
    miss_m: float | None
    time_s: float
    attempts: int
    locked: bool
    fell: bool
    realtime_factor: float


def campaign_summary(
    results: Sequence[FlightResult], wall_s: float | None = None, worst: int = 5
) -> dict[str, Any]:
    """A campaign's figures, ready for JSON.

    `miss_m` is taken over the perched flights (None without any; p95 by linear
    interpolation). `realtime_factor` is flight time over `wall_s`, or over the
    sum of the flights' own wall times without it. `worst_seeds` names at most
    `worst` flights: those that did not perch first, then the largest misses.
    """
    misses = [r.miss_m for r in results if r.outcome == "perched" and r.miss_m is not None]
    flown_s = sum(r.time_s for r in results)
    if wall_s is None:
        wall_s = sum(r.time_s / r.realtime_factor for r in results if r.realtime_factor > 0)
    return {
        "flights": len(results),
        **{end: sum(r.outcome == end for r in results) for end in ENDS},
        "locked": sum(r.locked for r in results),
        "fell": sum(r.fell for r in results),
        "miss_m": {
            "median": _rounded(np.median(misses)) if misses else None,
            "p95": _rounded(np.percentile(misses, 95)) if misses else None,
            "max": _rounded(max(misses)) if misses else None,
        },
        "realtime_factor": _rounded(flown_s / wall_s) if wall_s > 0 else None,
        "worst_seeds": [r.seed for r in worst_first(results)[:worst]],
    }


def worst_first(results: Sequence[FlightResult]) -> list[FlightResult]:
    """Not perched first (aborted before landed), then the largest misses, then by seed."""
    return sorted(results, key=lambda r: (-ENDS.index(r.outcome), -(r.miss_m or 0.0), r.seed))


def _rounded(value: Any) -> float:
    return round(float(value), 6)
