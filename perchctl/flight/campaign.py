"""Seeded flights over randomised scenarios, one lockstep flight a seed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, as_completed
from pathlib import Path

import cv2

from perchctl.flight.lockstep import fly_lockstep
from perchctl.flight.results import FlightEnd, FlightResult
from perchctl.mission.state import Phase
from perchctl.profile import Profile

OUTCOMES: dict[Phase, FlightEnd] = {
    Phase.PERCHED: "perched",
    Phase.LANDED: "landed",
    Phase.ABORTED: "aborted",
}


def fly_seed(profile: Profile, seed: int, log_path: Path | None = None) -> FlightResult:
    """Fly one seed of the profile's scenario; a function of its own so that any
    executor can carry it to another process or machine."""
    cv2.setNumThreads(1)  # a job is one core, so that the rates are rates a core
    began_s = time.perf_counter()
    flight = fly_lockstep(profile, seed, log_path)
    wall_s = time.perf_counter() - began_s
    return FlightResult(
        seed=seed,
        outcome=OUTCOMES[flight.report.phase] if not flight.fell else "aborted",
        reason=flight.report.reason,
        miss_m=flight.perched_miss_m,
        time_s=flight.report.duration_s,
        attempts=flight.report.attempts,
        locked=flight.locked,
        fell=flight.fell,
        realtime_factor=flight.simulated_s / wall_s,
    )


def run_campaign(
    profile: Profile,
    seeds: Iterable[int],
    executor: Executor | None = None,
    on_result: Callable[[FlightResult], None] = lambda result: None,
) -> list[FlightResult]:
    """Fly all seeds; results in the order of the seeds. With an executor (any of
    `concurrent.futures`' kind) the flights are handed to it, otherwise flown here."""
    seeds = list(seeds)
    if executor is None:
        results = []
        for seed in seeds:
            results.append(fly_seed(profile, seed))
            on_result(results[-1])
        return results
    futures = {executor.submit(fly_seed, profile, seed): seed for seed in seeds}
    by_seed = {}
    for future in as_completed(futures):
        result = future.result()
        by_seed[result.seed] = result
        on_result(result)
    return [by_seed[seed] for seed in seeds]
