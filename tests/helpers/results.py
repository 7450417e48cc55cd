"""Results of flights that were none, for tests of what is made of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from perchctl.campaign import FlightResult
from perchctl.record import to_exact_json

PERCHED = FlightResult(0, "perched", "hanging still", 0.002, 20.0, 1, False, False)
LANDED = replace(PERCHED, outcome="landed", reason="battery at 2.9 V", miss_m=None, time_s=30.0)


def perched(seed: int, miss_m: float = 0.002, time_s: float = 20.0) -> FlightResult:
    return replace(PERCHED, seed=seed, miss_m=miss_m, time_s=time_s)


def landed(seed: int) -> FlightResult:
    return replace(LANDED, seed=seed)


def aborted(seed: int) -> FlightResult:
    """It fell, and was locked."""
    return FlightResult(seed, "aborted", "tilted", None, 10.0, 1, True, True)


def flown_record(result: FlightResult) -> dict[str, Any]:
    """What equal flights share on all computers: without log and timings."""
    record: dict[str, Any] = to_exact_json(result)
    return {k: v for k, v in record.items() if k not in ("cpu_s", "log", "log_problem")}
