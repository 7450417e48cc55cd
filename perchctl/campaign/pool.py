"""The processes that fly a campaign on this computer.

Where one process of the standard library's pool is lost, all its flights are. Here each process
is a pool of its own, with a thread that hands it one flight after the other, so that a lost
process costs only the flight that it flew, which is flown again.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import (
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
)
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from perchctl.children import end_with_parent

R = TypeVar("R")

_CONTEXT = multiprocessing.get_context("spawn")
SIGNALS = (signal.SIGINT, signal.SIGTERM)
FLOWN_AGAIN = 2
"""How often a flight that was lost with its process is flown again."""


class FlightProcesses(Executor):
    """A pool of `count` processes, each started with its first flight. They ignore signals, and
    end when the parent is killed. A flight's future fails with `BrokenExecutor` if its process was
    lost `1 + FLOWN_AGAIN` times."""

    def __init__(self, count: int) -> None:
        self._threads = ThreadPoolExecutor(count)
        self._own = threading.local()
        self._processes: list[ProcessPoolExecutor] = []
        self._starting = threading.Lock()
        self._killed = False
        resource_tracker.ensure_running()  # it lifts the mask of the thread that starts it

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """Return the future of a flight, which waits for a free process."""
        with defer_interrupts():  # threads and processes inherit the mask of who starts them
            return self._threads.submit(self._fly, fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after the flights that they were given."""
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        for process in self._processes:
            process.shutdown(wait)

    def kill(self) -> None:
        """End the processes where they are; what they fly is lost."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        with self._starting:
            self._killed = True
            for process in multiprocessing.active_children():
                process.kill()

    def _fly(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> R:
        """Fly in the process of this thread, and anew in another one where it is lost."""
        for _ in range(1 + FLOWN_AGAIN):
            try:
                with self._starting:
                    if self._killed:
                        break
                    future = self._own_process().submit(fn, *args, **kwargs)
                return future.result()
            except BrokenExecutor:
                del self._own.process
        raise BrokenExecutor

    def _own_process(self) -> ProcessPoolExecutor:
        if not hasattr(self._own, "process"):
            self._own.process = ProcessPoolExecutor(1, _CONTEXT, end_with_parent)
            self._processes.append(self._own.process)
        process: ProcessPoolExecutor = self._own.process
        return process


@contextlib.contextmanager
def flight_processes(jobs: int) -> Iterator[Executor]:
    """Yield an executor of `jobs` processes; an exception ends them where they are."""
    pool = FlightProcesses(jobs)
    try:
        yield pool
    except BaseException:
        pool.kill()
        raise
    finally:
        pool.shutdown()


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM until the end of the block; threads and processes started
    within it never see them. Python's handlers are replaced meanwhile, too: a signal mask belongs
    to one thread, so a library's thread may take the signal, and Python would still handle it in
    the main thread."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    came: list[int] = []
    handlers: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {s: signal.signal(s, lambda number, _: came.append(number)) for s in SIGNALS}
    try:
        yield
    finally:
        for name, handler in handlers.items():
            signal.signal(name, handler or signal.SIG_DFL)
        for number in came:
            signal.raise_signal(number)  # held back by the mask
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
