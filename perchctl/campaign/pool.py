"""Worker processes of a campaign. They ignore signals and are killed if the campaign ends early."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import resource_tracker
from typing import Any, TypeVar

from perchctl.children import end_with_parent

R = TypeVar("R")

_CONTEXT = multiprocessing.get_context("spawn")
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class FlightProcesses(ProcessPoolExecutor):
    """A pool of `count` processes, which ignore signals and end when the parent is killed."""

    def __init__(self, count: int) -> None:
        super().__init__(count, _CONTEXT, end_with_parent)
        # started outside the masked block, because its start clears the calling thread's signal
        # mask
        resource_tracker.ensure_running()

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """Queue the flight ``fn(*args, **kwargs)`` for the next free process; return its future."""
        with (
            defer_interrupts()
        ):  # threads and processes inherit the signal mask of the thread that starts them
            return super().submit(fn, *args, **kwargs)


@contextlib.contextmanager
def flight_processes(jobs: int) -> Iterator[Executor]:
    """Yield an executor with `jobs` processes, which are killed on an exception."""
    pool, others = FlightProcesses(jobs), set(multiprocessing.active_children())
    try:
        yield pool
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer Ctrl-C and SIGTERM to the end of the block. Threads and processes that are started in
    the block never receive these signals. Python's handlers are replaced as well, because a thread
    started earlier by a library may still receive a signal."""
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
            signal.raise_signal(number)  # deferred by the signal mask until the next line
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
