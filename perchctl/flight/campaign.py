"""Seeded flights over randomised scenarios, one lockstep flight a seed."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
)
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2

from perchctl.children import end_with_parent
from perchctl.errors import PerchError
from perchctl.flight.lockstep import LockstepFlight, fly_lockstep
from perchctl.flight.results import FlightEnd, FlightResult
from perchctl.flight.uninterrupted import uninterrupted
from perchctl.log.summary import FlightSummary
from perchctl.log.watch import LogWatcher
from perchctl.mission.state import Phase
from perchctl.mission.watch import Event, EventKeeper, Watcher
from perchctl.profile import Profile

R = TypeVar("R")

OUTCOMES: dict[Phase, FlightEnd] = {
    Phase.PERCHED: "perched",
    Phase.LANDED: "landed",
    Phase.ABORTED: "aborted",
}


@dataclass(frozen=True)
class LoggedFlight:
    """All that is told of one flight; `events` are what happened, in order."""

    seed: int
    outcome: FlightEnd
    summary: FlightSummary
    log: Path
    events: tuple[Event, ...]

    @property
    def log_problem(self) -> str | None:
        return self.summary.log_problem


def fly_seed(
    profile: Profile, seed: int, log_path: Path | None = None, record: bool = False
) -> FlightResult:
    """Fly one seed of the profile's scenario; a function of its own so that any
    executor can carry it to another process or machine. `record`: with the pictures beside
    the log."""
    began_s = time.perf_counter()
    log = None if log_path is None else LogWatcher.lockstep(log_path, profile, seed, record)
    flight, summary = _flown(profile, seed, log)
    return FlightResult(
        seed=seed,
        outcome=_outcome(flight),
        reason=flight.report.reason,
        miss_m=flight.perched_miss_m,
        time_s=flight.report.duration_s,
        attempts=flight.report.attempts,
        locked=flight.locked,
        fell=flight.fell,
        realtime_factor=flight.simulated_s / (time.perf_counter() - began_s),
        log=None if log is None else log.path,
        log_problem=None if summary is None else summary.log_problem,
    )


def fly_logged(profile: Profile, folder: Path, seed: int, record: bool = False) -> LoggedFlight:
    """Fly one seed to look at it closely. Errors: NotFound, InvalidValue (calibration, log)."""
    log = LogWatcher.lockstep(log_of(seed, folder), profile, seed, record)
    events = EventKeeper()
    flight, summary = _flown(profile, seed, log, events)
    assert summary is not None
    return LoggedFlight(seed, _outcome(flight), summary, log.path, tuple(events.seen))


def _flown(
    profile: Profile, seed: int, log: LogWatcher | None, *watchers: Watcher
) -> tuple[LockstepFlight, FlightSummary | None]:
    cv2.setNumThreads(1)  # a job is one core, so that the rates are rates a core
    flight = fly_lockstep(profile, seed, log, watchers=watchers)
    if log is None:
        return flight, None
    return flight, log.close(flight.report, flight.perched_miss_m, flight.fell)


def _outcome(flight: LockstepFlight) -> FlightEnd:
    return OUTCOMES[flight.report.phase] if not flight.fell else "aborted"


def run_campaign(
    profile: Profile,
    seeds: Iterable[int],
    executor: Executor | None = None,
    on_result: Callable[[FlightResult], None] = lambda result: None,
    log_dir: Path | None = None,
    record: bool = False,
) -> list[FlightResult]:
    """Fly all seeds; results in the order of the seeds. With an executor (any of
    `concurrent.futures`' kind) the flights are handed to it, otherwise flown here."""
    return fly_all(partial(_fly_logged, profile, log_dir, record), seeds, executor, on_result)


def _fly_logged(profile: Profile, log_dir: Path | None, record: bool, seed: int) -> FlightResult:
    return fly_seed(profile, seed, None if log_dir is None else log_of(seed, log_dir), record)


def log_of(seed: int, log_dir: Path) -> Path:
    """The file for a seed's log."""
    return log_dir / f"flight_seed{seed}.jsonl"


def fly_all(
    fly: Callable[[int], R],
    seeds: Iterable[int],
    executor: Executor | None = None,
    on_result: Callable[[R], None] = lambda result: None,
) -> list[R]:
    """`fly` of each seed, in the order of the seeds; `on_result` as they are done."""
    seeds = list(seeds)
    if executor is None:
        results = []
        for seed in seeds:
            results.append(fly(seed))
            on_result(results[-1])
        return results
    with uninterrupted():  # the executor starts its processes as flights are handed to it
        futures = {executor.submit(fly, seed): seed for seed in seeds}
    by_seed = {}
    for future in as_completed(futures):
        by_seed[futures[future]] = result = _result(future, futures[future])
        on_result(result)
    return [by_seed[seed] for seed in seeds]


def _result(future: Future[R], seed: int) -> R:
    try:
        return future.result()
    except BrokenExecutor:
        raise PerchError(
            "a process that flew was ended from outside (where memory is short, fly fewer at a "
            "time: --jobs)"
        ) from None
    except PerchError:
        raise
    except Exception as error:
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        raise PerchError(
            f"unforeseen {type(error).__name__} in the flight of seed {seed}: {error} "
            f"(PERCHCTL_DEBUG=1 shows where; please report it)"
        ) from error


@contextlib.contextmanager
def job_processes(jobs: int) -> Iterator[Executor]:
    """So many processes that fly. Signals are this process's alone: left by an exception,
    they are ended where they are; and they end where this one is killed."""
    context = multiprocessing.get_context("spawn")
    with uninterrupted():
        executor = ProcessPoolExecutor(jobs, mp_context=context, initializer=end_with_parent)
    try:
        yield executor
    except BaseException:
        for child in context.active_children():
            child.kill()
        executor.shutdown(cancel_futures=True)
        raise
    executor.shutdown()
