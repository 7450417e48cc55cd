"""Fly seeded flights over randomised scenarios, one lockstep flight per seed."""

from __future__ import annotations

import contextlib
import gc
import os
import time
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import cv2

from perchctl.campaign.pool import flight_processes
from perchctl.campaign.results import FlightEnd, FlightResult
from perchctl.errors import (
    ConnectionFailed,
    InvalidValue,
    PerchError,
    SafetyAbort,
    TimedOut,
    require_type,
)
from perchctl.flight import fly_lockstep
from perchctl.mission import Phase
from perchctl.profile import Profile, load_profile
from perchctl.record import LogWatcher
from perchctl.sim import Scenario, draw_scenario

R = TypeVar("R")
K = TypeVar("K", bound=Hashable)
"""A seed, or any other key that identifies one flight; its text names the flight in messages."""

OUTCOMES: dict[Phase, FlightEnd] = {
    Phase.PERCHED: "perched",
    Phase.LANDED: "landed",
    Phase.ABORTED: "aborted",
}


# --- One flight ---


def fly_measured(profile: Profile, seed: int, fly: Callable[[Scenario], R]) -> R:
    """Call `fly` on one core with the scenario drawn from `seed`, and return its result (a
    dataclass) with the CPU time and the scenario filled in. Frees the flight's memory."""

    def fly_drawn() -> R:
        scenario = draw_scenario(profile, seed)
        result: Any = fly(scenario)
        flown: R = replace(result, scenario=scenario)
        return flown

    return run_measured(fly_drawn)


def run_measured(job: Callable[[], R]) -> R:
    """Call `job`, one unit of a campaign's work, on one core, and return its result (a dataclass)
    with the CPU time filled in. Frees the memory that it used."""
    cv2.setNumThreads(1)  # each job uses one core, so that rates are per core
    cpu_began_s = time.process_time()
    result: Any = job()
    cpu_s = time.process_time() - cpu_began_s
    _give_back_memory()
    flown: R = replace(result, cpu_s=cpu_s)
    return flown


def _give_back_memory() -> None:
    """Free a flight's memory at once; its objects refer to each other, so Python would not free
    them until its next garbage collection."""
    gc.collect()
    if not gc.get_freeze_count():
        # The remaining objects are used by all flights; scanning them after each flight takes as
        # long as processing 30 images.
        gc.freeze()


def fly_seed(
    profile: Profile, seed: int, log_path: Path | None = None, record: bool = False
) -> FlightResult:
    """Fly one seed of the profile's scenario. Any executor can send this function to a worker.

    `record`: store the images next to the log. A refused flight has a result too, but no log.
    Errors: NotFound, InvalidValue (calibration, log).
    """

    def fly(_scenario: Scenario) -> FlightResult:
        log = (
            None if log_path is None else LogWatcher.open_lockstep(log_path, profile, seed, record)
        )
        try:
            flight = fly_lockstep(profile, seed, log)
        except (SafetyAbort, TimedOut) as error:
            return FlightResult(seed, "refused", str(error), None, 0.0, 0, False, False)
        summary = None if log is None else flight.close_log(log)
        return FlightResult(
            seed=seed,
            outcome=OUTCOMES[flight.final_phase],
            reason=flight.report.reason,
            miss_m=flight.perched_miss_m,
            time_s=flight.report.duration_s,
            attempts=flight.report.attempts,
            locked=flight.locked,
            fell=flight.fell,
            log=log_path,
            log_problem=None if summary is None else summary.log_problem,
        )

    return fly_measured(profile, seed, fly)


def seed_log_path(seed: int, log_dir: Path) -> Path:
    """The path in `log_dir` of the flight log for a seed."""
    return log_dir / f"flight_seed{seed}.jsonl"


# --- Many flights ---


def fly_in_folder(profile: Profile, log_dir: Path | None, record: bool, seed: int) -> FlightResult:
    """Fly a seed as `fly_seed` does, with a log in the folder `log_dir` unless that is None."""
    log_path = None if log_dir is None else seed_log_path(seed, log_dir)
    return fly_seed(profile, seed, log_path, record)


def fly_all(
    fly: Callable[[K], R],
    seeds: Iterable[K],
    executor: Executor | None = None,
    on_result: Callable[[R], None] = lambda result: None,
) -> list[R]:
    """Call `fly` on each seed, and return the results in the order of the seeds. `on_result` is
    called with each result as soon as the flight has ended.

    `executor`: as in `concurrent.futures`, or None for this process; its optional attribute `lost`
    lists the exceptions that a future raises if the process that flew its flight was lost. Errors:
    PerchError, as soon as one flight fails.
    """
    seeds = list(dict.fromkeys(seeds))
    by_seed: dict[K, R] = {}
    if executor is None:
        for seed in seeds:
            by_seed[seed] = fly(seed)
            on_result(by_seed[seed])
        return list(by_seed.values())
    lost = (BrokenExecutor, *getattr(executor, "lost", ()))
    futures = {executor.submit(fly, seed): seed for seed in seeds}
    for future in as_completed(futures):
        seed = futures[future]
        by_seed[seed] = _result(future, seed, lost)
        on_result(by_seed[seed])
    return [by_seed[seed] for seed in seeds]


def simulate(
    profile: Profile | Path | str,
    seeds: Iterable[int],
    jobs: int = 1,
    executor: Executor | None = None,
    *,
    log_dir: Path | str | None = None,
) -> list[FlightResult]:
    """Fly each distinct seed of the profile's scenario in lockstep, and return the results in the
    order of the seeds.

    Args:
        profile: a profile, its name, or its file.
        seeds: integers from 0 on. The same seed always gives the same flight.
        jobs: number of processes; with more than one, a script needs ``if __name__ ==
            "__main__":``.
        executor: used instead of `jobs` processes; any executor as in `concurrent.futures`, such as
            dask's.
        log_dir: folder for the flight logs; None: no logs are written.

    A result has `seed`, `outcome` (perched, landed, aborted, refused), `reason`, `miss_m` (None if
    the vehicle did not perch), `time_s`, `attempts`, `fell`, `locked`, `log` and the drawn
    `scenario`.

    Raises:
        NotFound, InvalidValue: the profile or the seeds are invalid. UsageError: no simulator is
            installed.
    """
    profile, seeds = load_profile(profile), list(seeds)
    for value in (*seeds, jobs):
        require_type("a seed, or jobs,", value, int)
    if min([*seeds, jobs - 1]) < 0:
        raise InvalidValue(f"seeds must be at least 0 and jobs at least 1; found {seeds}, {jobs}")
    one = partial(fly_in_folder, profile, None if log_dir is None else Path(log_dir), False)
    with contextlib.ExitStack() as stack:
        if executor is None and jobs > 1:
            executor = stack.enter_context(flight_processes(jobs))
        return fly_all(one, seeds, executor)


def _result(future: Future[R], seed: object, lost: tuple[type[BaseException], ...]) -> R:
    try:
        return future.result()
    except PerchError:
        raise
    except lost as error:
        raise PerchError(
            "a flight's process was killed; if memory is short, run fewer flights at a time "
            "(--jobs); if you gave --out, add --resume to continue its file"
        ) from error
    except CancelledError as error:
        raise ConnectionFailed(
            "the scheduler given with --cluster no longer answers: restart it; if you gave --out, "
            "add --resume to continue its file"
        ) from error
    except ImportError as error:
        raise InvalidValue(
            f"a worker cannot load the flight ({type(error).__name__}: {error}): install "
            "this version of perchctl there, with the extras sim and cluster"
        ) from error
    except Exception as error:
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        raise PerchError(
            f"unexpected {type(error).__name__} in the flight with seed {seed}: {error} "
            "(PERCHCTL_DEBUG=1 shows where; please report it)"
        ) from error
