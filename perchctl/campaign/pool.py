"""Who flies a campaign: processes of this computer, or the cluster at an address.

Where one process of the standard library's pool is lost, all its flights are. Here each process
is a pool of its own, so that a lost process costs only the flight that it was flying: its future
fails with `BrokenExecutor`, and the next flight starts a new process.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import multiprocessing
import queue
import re
import resource
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from perchctl.children import end_with_parent
from perchctl.errors import UsageError

R = TypeVar("R")

_CONTEXT = multiprocessing.get_context("spawn")
_Order = tuple["Future[Any]", Callable[..., Any], tuple[Any, ...]]


class FlightPool(Executor):
    """An executor of `count` processes, each started with its first flight. The processes never
    see a signal, and all of them end when the parent is killed."""

    def __init__(self, count: int) -> None:
        self._orders: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._ended = False
        self._threads = [
            threading.Thread(target=self._work, name=f"perchctl-pool-{i}", daemon=True)
            for i in range(count)
        ]
        resource_tracker.ensure_running()  # it lifts the mask of the thread that starts it
        with defer_interrupts():  # threads and processes inherit the mask of who starts them
            for thread in self._threads:
                thread.start()

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """The future fails with `BrokenExecutor` if the process that flew was lost."""
        if kwargs:
            raise TypeError("a flight has no arguments by name")
        if self._ended:
            raise RuntimeError("no flight can be handed to processes that were ended")
        future: Future[R] = Future()
        self._orders.put((future, fn, args))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes once they have flown what was handed to them."""
        if cancel_futures:
            self._cancel_orders()
        for _ in self._threads:
            self._orders.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def kill(self) -> None:
        """End the processes at once; the flights that they were flying are lost."""
        with self._lock:  # no process is being started, and none will be
            self._ended = True
            for process in multiprocessing.active_children():
                process.kill()
        self.shutdown(cancel_futures=True)

    def _cancel_orders(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                order = self._orders.get_nowait()
                if order is not None:
                    order[0].cancel()

    def _work(self) -> None:
        """Hand one flight after the other to a process; this is the life of a thread."""
        process: ProcessPoolExecutor | None = None
        while (order := self._orders.get()) is not None:
            future, fn, args = order
            if not future.set_running_or_notify_cancel():
                continue
            try:
                with self._lock:
                    if self._ended:
                        raise BrokenExecutor("the processes were ended")
                    process = process or ProcessPoolExecutor(1, _CONTEXT, end_with_parent)
                    flight = process.submit(fn, *args)
                result = flight.result()
            except BrokenExecutor:
                if process is not None:
                    process.shutdown()
                process = None
                future.set_exception(BrokenExecutor("the process that flew was lost"))
            except Exception as error:
                future.set_exception(error)
            else:
                future.set_result(result)
        if process is not None:
            process.shutdown()


@contextlib.contextmanager
def flight_processes(jobs: int) -> Iterator[Executor]:
    """Yield a `FlightPool` of `jobs` processes; an exception ends them where they are."""
    pool = FlightPool(jobs)
    try:
        yield pool
    except BaseException:
        pool.kill()
        raise
    pool.shutdown()


# --- The ADDRESS of `--cluster` ----------------------------------------------------------------


MOST_LOCAL = 1024
_FORM = re.compile(r"(tcp|tls|ws|wss)://([^\s/:]+|\[[0-9a-fA-F:.]+\]):([0-9]{1,5})")


@dataclass(frozen=True)
class ClusterAddress:
    """`scheduler`: the URL of one that runs; None where `workers` are started on this computer,
    with a scheduler."""

    scheduler: str | None
    workers: int = 0

    def __str__(self) -> str:
        return self.scheduler or f"local:{self.workers}"


def parse_address(text: str) -> ClusterAddress:
    """The address that ``local:N``, ``HOST:PORT`` or ``tcp://HOST:PORT`` names.
    Errors: UsageError."""
    kind, _, number = text.partition(":")
    if kind == "local":
        if number.isascii() and number.isdigit() and 1 <= int(number[:9]) <= MOST_LOCAL:
            return ClusterAddress(None, int(number))
        raise UsageError(
            f"--cluster {text} must be local:N with N from 1 to {MOST_LOCAL} workers, as in "
            f"--cluster local:4"
        )
    found = _FORM.fullmatch(text if "://" in text else f"tcp://{text}")
    if found is None or not 1 <= int(found[3]) <= 65535:
        raise UsageError(
            f"--cluster {text} must be the address of a dask scheduler, as in "
            f"--cluster tcp://10.0.0.5:8786, or local:N"
        )
    return ClusterAddress(found[0])


# --- What no signal may end halfway ------------------------------------------------------------


SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until the end of the block; threads and processes that are started
    within it never see them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        with _handlers_deferred():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _handlers_deferred() -> Iterator[None]:
    """A mask belongs to one thread: another thread, of a library, may take the signal, and Python
    then handles it in the main thread all the same."""
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


# --- How much memory a process takes -----------------------------------------------------------


_STATUS = Path("/proc/self/status")
_RSS_UNIT = 1 if sys.platform == "darwin" else 1024  # getrusage's, bytes


def give_back_memory() -> None:
    """Free what a flight leaves behind. Its objects refer to each other, so Python frees them when
    it next looks through everything, which may be many flights later; and the C library keeps
    what it gets back in pieces."""
    gc.collect()
    if not gc.get_freeze_count():
        # What is left are the program's own modules and what it keeps for all flights: nothing
        # to look through again and again, which takes as long as 30 pictures.
        gc.freeze()
    with contextlib.suppress(AttributeError, OSError):  # glibc has it, others do not
        ctypes.CDLL(None).malloc_trim(0)


def peak_memory_mb() -> float:
    """The most memory that this process, or any that it has waited for, ever held (1e6 bytes)."""
    own, ended = (
        resource.getrusage(who).ru_maxrss * _RSS_UNIT * 1e-6
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    # Linux hands a program the peak of the one that started it; its own stands elsewhere.
    with contextlib.suppress(OSError, ValueError, IndexError):
        lines = _STATUS.read_text().splitlines()
        own = next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) * 1024e-6
    return max(own, ended)
