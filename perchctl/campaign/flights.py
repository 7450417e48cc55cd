"""Seeded flights over randomised scenarios, one lockstep flight a seed."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import time
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import BrokenExecutor, Executor, Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import cv2

from perchctl.campaign.pool import FlightPool
from perchctl.campaign.results import FlightEnd, FlightResult, peak_memory_mb
from perchctl.errors import InvalidValue, PerchError, SafetyAbort, TimedOut
from perchctl.flight import fly_lockstep
from perchctl.mission import Event, Phase, Watcher
from perchctl.profile import Profile
from perchctl.record import FlightSummary, LogWatcher
from perchctl.sim import Scenario, draw_scenario

R = TypeVar("R")
K = TypeVar("K", bound=Hashable)
"""A seed, or another key of one flight; its text names the flight in messages."""

OUTCOMES: dict[Phase, FlightEnd] = {
    Phase.PERCHED: "perched",
    Phase.LANDED: "landed",
    Phase.ABORTED: "aborted",
}
FLOWN_AGAIN = 2
"""How often a flight that was lost with its process is flown again."""
_POLL_S = 0.25


# --- One flight --------------------------------------------------------------------------------


@dataclass(frozen=True)
class LoggedFlight:
    """One flight with its summary, its log file and its events in order."""

    seed: int
    outcome: FlightEnd
    summary: FlightSummary
    log: Path
    events: tuple[Event, ...]


def fly_measured(profile: Profile, seed: int, fly: Callable[[Scenario], R]) -> R:
    """Call `fly` with the seed's scenario on one core, and return its result (a dataclass) with
    the CPU time, the peak memory and the scenario filled in. The flight's memory is freed."""
    cv2.setNumThreads(1)  # a job is one core, so that the rates are rates a core
    cpu_began_s = time.process_time()
    scenario = draw_scenario(profile, seed)
    result: Any = fly(scenario)
    cpu_s = time.process_time() - cpu_began_s
    _give_back_memory()
    flown: R = replace(result, cpu_s=cpu_s, peak_memory_mb=peak_memory_mb(), scenario=scenario)
    return flown


def _give_back_memory() -> None:
    """Free the memory of a flight. Its objects refer to each other, so Python would free them
    many flights later; and the C library keeps small pieces that it gets back."""
    gc.collect()
    if not gc.get_freeze_count():
        # What is left are the program's own modules and what it keeps for all flights: nothing
        # to look through again and again, which takes as long as 30 pictures.
        gc.freeze()
    with contextlib.suppress(AttributeError, OSError):  # glibc has it, others do not
        ctypes.CDLL(None).malloc_trim(0)


def fly_seed(
    profile: Profile, seed: int, log_path: Path | None = None, record: bool = False
) -> FlightResult:
    """Fly one seed of the profile's scenario. Any executor can carry this function to another
    process or machine. `record` writes the pictures beside the log. A flight that is refused
    before take-off is a result, too, and leaves no log. Errors: NotFound, InvalidValue
    (calibration, log)."""
    return fly_measured(profile, seed, lambda _: _fly(profile, seed, log_path, record))


def _fly(profile: Profile, seed: int, log_path: Path | None, record: bool) -> FlightResult:
    began_s = time.perf_counter()
    log = None if log_path is None else LogWatcher.lockstep(log_path, profile, seed, record)
    try:
        flight = fly_lockstep(profile, seed, log)
    except (SafetyAbort, TimedOut) as error:
        if log is not None:
            log.abandon(str(error))
        return FlightResult(seed, "refused", str(error), None, 0.0, 0, False, False, 0.0)
    summary = None if log is None else flight.conclude(log)
    return FlightResult(
        seed=seed,
        outcome=OUTCOMES[flight.end],
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
    """Fly one seed and return it with log, summary and events. Errors: NotFound, InvalidValue
    (calibration, log)."""
    cv2.setNumThreads(1)
    log = LogWatcher.lockstep(seed_log_path(seed, folder), profile, seed, record)
    events = _EventKeeper()
    flight = fly_lockstep(profile, seed, log, watchers=(events,))
    summary = flight.conclude(log)
    assert summary is not None
    return LoggedFlight(seed, OUTCOMES[flight.end], summary, log.path, tuple(events.seen))


class _EventKeeper(Watcher):
    """A watcher that keeps the events."""

    def __init__(self) -> None:
        self.seen: list[Event] = []

    def event(self, event: Event) -> None:
        self.seen.append(event)


def seed_log_path(seed: int, log_dir: Path) -> Path:
    """Return the path of a seed's log in `log_dir`."""
    return log_dir / f"flight_seed{seed}.jsonl"


# --- Many flights ------------------------------------------------------------------------------


def run_campaign(
    profile: Profile,
    seeds: Iterable[int],
    executor: Executor | None = None,
    on_result: Callable[[FlightResult], None] = lambda result: None,
    log_dir: Path | None = None,
    record: bool = False,
) -> list[FlightResult]:
    """Fly all seeds by `fly_all`, and return the results in the order of the seeds."""
    return fly_all(partial(fly_in_folder, profile, log_dir, record), seeds, executor, on_result)


def fly_in_folder(profile: Profile, log_dir: Path | None, record: bool, seed: int) -> FlightResult:
    """Fly a seed as `fly_seed` does, with its log in a folder if one is given."""
    log_path = None if log_dir is None else seed_log_path(seed, log_dir)
    return fly_seed(profile, seed, log_path, record)


def fly_all(
    fly: Callable[[K], R],
    seeds: Iterable[K],
    executor: Executor | None = None,
    on_result: Callable[[R], None] = lambda result: None,
) -> list[R]:
    """`fly` of each seed, each once, in the order of the seeds; `on_result` as they are done.

    `executor` is anything with ``submit(fly, seed)`` that returns a future of
    `concurrent.futures`' kind, or None to fly here; a `FlightPool` gets no more flights at a time
    than it has places. A flight whose future fails with `BrokenExecutor` (or another error of
    `FlightPool.lost`), or is cancelled, was lost with the process that flew it, and is flown
    again, `FLOWN_AGAIN` times at most. Errors: PerchError.
    """
    seeds = list(dict.fromkeys(seeds))
    by_seed: dict[K, R] = {}
    if executor is None:
        for seed in seeds:
            by_seed[seed] = fly(seed)
            on_result(by_seed[seed])
        return list(by_seed.values())
    pool = executor if isinstance(executor, FlightPool) else None
    lost_errors = FlightPool.lost if pool is None else pool.lost
    waiting, flying = deque(seeds), 0
    lost: Counter[K] = Counter()
    ended: SimpleQueue[tuple[K, Future[R]]] = SimpleQueue()
    while len(by_seed) < len(seeds):
        places = len(seeds) if pool is None else pool.places()
        while waiting and flying < places:
            seed = waiting.popleft()
            future = _submitted(executor, fly, seed)
            future.add_done_callback(partial(_put, ended, seed))
            flying += 1
        try:
            seed, future = ended.get(timeout=_POLL_S)
        except Empty:
            continue
        flying -= 1
        was_lost = future.cancelled() or isinstance(future.exception(), lost_errors)
        if was_lost and lost[seed] < FLOWN_AGAIN:
            lost[seed] += 1
            waiting.appendleft(seed)
        elif was_lost:
            raise PerchError(
                f"the process that flew seed {seed} was ended from outside, {1 + FLOWN_AGAIN} "
                f"times in all (where memory is short, fly fewer at a time: --jobs)"
            )
        else:
            by_seed[seed] = result = _result(future, seed)
            on_result(result)
    return [by_seed[seed] for seed in seeds]


def _submitted(executor: Executor, fly: Callable[[K], R], seed: K) -> Future[R]:
    try:
        return executor.submit(fly, seed)
    except BrokenExecutor as error:  # the process was lost while it had no flight
        future: Future[R] = Future()
        future.set_exception(error)
        return future


def _put(ended: SimpleQueue[tuple[K, Future[R]]], seed: K, future: Future[R]) -> None:
    ended.put((seed, future))


def _result(future: Future[R], seed: K) -> R:
    try:
        return future.result()
    except PerchError:
        raise
    except ImportError as error:
        raise InvalidValue(
            f"a worker cannot load what flies ({type(error).__name__}: {error}): install this "
            f"computer's perchctl there, with the extras sim and cluster"
        ) from error
    except Exception as error:
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        raise PerchError(
            f"unforeseen {type(error).__name__} in the flight of seed {seed}: {error} "
            f"(PERCHCTL_DEBUG=1 shows where; please report it)"
        ) from error
