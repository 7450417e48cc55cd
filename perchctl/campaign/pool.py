"""The processes that fly a campaign on this computer.

Where one process of the standard library's pool is lost, all its flights are. Here each process
is a pool of its own, so that a lost process costs only the flight that it flew.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from functools import partial
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from perchctl.children import end_with_parent

R = TypeVar("R")

_CONTEXT = multiprocessing.get_context("spawn")
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class FlightPool(Executor):
    """An executor that gets one flight for each of its places, and the next when one has ended:
    what waits in a process is lost with it.

    Attributes:
        lost: the errors of a future whose flight was lost with the process that flew it.
    """

    lost: tuple[type[BaseException], ...] = (BrokenExecutor,)

    def places(self) -> int:
        """Return how many flights it takes at a time. Errors: PerchError if no process is left."""
        raise NotImplementedError


class FlightProcesses(FlightPool):
    """A pool of `count` processes, each started with its first flight. They ignore signals, and
    end when the parent is killed."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._all: list[ProcessPoolExecutor] = []
        self._idle: list[ProcessPoolExecutor] = []
        resource_tracker.ensure_running()  # it lifts the mask of the thread that starts it

    def places(self) -> int:
        return self._count

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """Hand a flight to a free process. Its future fails with `BrokenExecutor` if the process
        was lost."""
        if self._idle:
            process = self._idle.pop()
        else:
            process = ProcessPoolExecutor(1, _CONTEXT, end_with_parent)
            self._all.append(process)
        with defer_interrupts():  # threads and processes inherit the mask of who starts them
            future = process.submit(fn, *args, **kwargs)
        future.add_done_callback(partial(self._landed, process))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after the flights that they were given."""
        for process in self._all:
            process.shutdown(wait, cancel_futures=cancel_futures)

    def _landed(self, process: ProcessPoolExecutor, flight: Future[Any]) -> None:
        if not isinstance(flight.exception(), BrokenExecutor):
            self._idle.append(process)


@contextlib.contextmanager
def flight_processes(jobs: int) -> Iterator[FlightPool]:
    """Yield a `FlightPool` of `jobs` processes; an exception ends them where they are."""
    pool = FlightProcesses(jobs)
    try:
        yield pool
    except BaseException:
        for process in multiprocessing.active_children():
            process.kill()
        raise
    finally:
        pool.shutdown()


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM until the end of the block; threads and processes started
    within it never see them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        with _handlers_deferred():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _handlers_deferred() -> Iterator[None]:
    """Replace Python's handlers meanwhile: a signal mask belongs to one thread, so a library's
    thread may take the signal, and Python would still handle it in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    handlers = {s: signal.signal(s, lambda number, _frame: came.append(number)) for s in SIGNALS}
    try:
        yield
    finally:
        for name, handler in handlers.items():
            if handler is not None:  # None: not Python's own
                signal.signal(name, handler)
        for number in came:  # the mask holds these, too, until the block is left
            signal.pthread_kill(threading.get_ident(), number)
