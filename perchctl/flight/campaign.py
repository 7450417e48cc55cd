"""Seeded flights over randomised scenarios, one lockstep flight a seed."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import TypeVar

import cv2

from perchctl.flight.lockstep import fly_lockstep
from perchctl.flight.results import FlightEnd, FlightResult
from perchctl.mission.state import Phase
from perchctl.profile import Profile

R = TypeVar("R")

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
    log_dir: Path | None = None,
) -> list[FlightResult]:
    """Fly all seeds; results in the order of the seeds. With an executor (any of
    `concurrent.futures`' kind) the flights are handed to it, otherwise flown here."""
    return fly_all(partial(_fly_logged, profile, log_dir), seeds, executor, on_result)


def _fly_logged(profile: Profile, log_dir: Path | None, seed: int) -> FlightResult:
    return fly_seed(profile, seed, log_of(seed, log_dir))


def log_of(seed: int, log_dir: Path | None) -> Path | None:
    """The file for a seed's log, in a folder that is made where it is missing."""
    if log_dir is None:
        return None
    log_dir.mkdir(parents=True, exist_ok=True)
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
        by_seed[futures[future]] = result = future.result()
        on_result(result)
    return [by_seed[seed] for seed in seeds]


@contextlib.contextmanager
def job_processes(jobs: int) -> Iterator[Executor]:
    """So many processes that fly. Ctrl-C is this process's alone: left by an exception,
    they are ended where they are."""
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(jobs, mp_context=context)
    try:
        yield executor
    except BaseException:
        with uninterrupted():
            executor.shutdown(wait=False, cancel_futures=True)
            children = context.active_children()
            for child in children:
                child.terminate()
            for child in children:
                child.join()
        raise
    executor.shutdown()


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C waits until after the block; processes started within never see it."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
