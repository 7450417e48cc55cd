"""The processes that fly a campaign's flights.

The standard library's pool is of one piece: where one process is lost, all flights are. Here each
process has a thread that gives it one flight at a time and waits for it. One that is lost costs
the flight it was flying, which the future tells by `BrokenExecutor`; the next flight gets a new
process.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import queue
import signal
import threading
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from perchctl.children import end_with_parent

R = TypeVar("R")

_END_S = 2.0
"""A process that has nothing to do any more may take so long to end."""
_CONTEXT = multiprocessing.get_context("spawn")
_Order = tuple["Future[Any]", Callable[..., Any], tuple[Any, ...]]


class Hands(Executor):
    """`count` processes, each started with its first flight. Signals are the parent's alone: no
    process sees them; and all of them end where the parent is killed."""

    def __init__(self, count: int) -> None:
        self._orders: queue.SimpleQueue[_Order | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._ended = False
        self._alive: set[Any] = set()
        self._threads = [
            threading.Thread(target=self._work, name=f"perchctl-hand-{i}", daemon=True)
            for i in range(count)
        ]
        resource_tracker.ensure_running()  # it lifts the mask of the thread that starts it
        with defer_interrupts():  # threads and processes have the mask of who starts them
            for thread in self._threads:
                thread.start()

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """The future fails with `BrokenExecutor` where the process that flew was lost."""
        if kwargs:
            raise TypeError("a flight has no arguments by name")
        if self._ended:
            raise RuntimeError("no flight can be handed to processes that were ended")
        future: Future[R] = Future()
        self._orders.put((future, fn, args))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Ends the processes as they have flown what was handed to them."""
        if cancel_futures:
            self._drop_orders()
        for _ in self._threads:
            self._orders.put(None)
        if wait:
            for thread in self._threads:
                thread.join()

    def kill(self) -> None:
        """Ends the processes where they are; what they were flying is lost."""
        with self._lock:  # none is just being started, and none will be
            self._ended = True
            for process in self._alive:
                process.kill()
        self.shutdown(cancel_futures=True)

    def _drop_orders(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                order = self._orders.get_nowait()
                if order is not None:
                    order[0].cancel()

    def _work(self) -> None:
        """A thread's life."""
        hand: tuple[Any, Connection] | None = None
        while (order := self._orders.get()) is not None:
            future, fn, args = order
            if not future.set_running_or_notify_cancel():
                continue
            try:
                hand = hand or self._started()
                hand[1].send_bytes(flight_order(fn, args))
                good, answer = pickle.loads(hand[1].recv_bytes())
            except (EOFError, OSError):
                self._let_go(hand)
                hand = None
                future.set_exception(BrokenExecutor("the process that flew was lost"))
            except Exception as error:  # nothing that can be sent
                future.set_exception(error)
            else:
                (future.set_result if good else future.set_exception)(answer)
        self._let_go(hand)

    def _started(self) -> tuple[Any, Connection]:
        here, there = _CONTEXT.Pipe()
        process = _CONTEXT.Process(target=_serve, args=(there,), name="perchctl-hand", daemon=True)
        with self._lock:
            if self._ended:
                raise EOFError
            process.start()
            self._alive.add(process)
        there.close()
        return process, here

    def _let_go(self, hand: tuple[Any, Connection] | None) -> None:
        if hand is None:
            return
        process, connection = hand
        connection.close()  # it ends by this
        process.join(_END_S)
        if process.exitcode is None:
            process.kill()
            process.join()
        with self._lock:
            self._alive.discard(process)


def _serve(connection: Connection) -> None:
    """A process's life: fly what comes, until nothing comes any more."""
    end_with_parent()
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.send_bytes(run_order(connection.recv_bytes()))


def flight_order(fn: Callable[..., Any], args: tuple[Any, ...]) -> bytes:
    """A flight in the form in which it is sent."""
    return pickle.dumps((fn, args))


def run_order(order: bytes) -> bytes:
    """What became of it, as sent back: whether it is good, and its result or its error."""
    answer = _answer(order)
    try:
        return pickle.dumps(answer)
    except Exception as error:
        return pickle.dumps((False, RuntimeError(f"a result without a form: {error}")))


def _answer(order: bytes) -> tuple[bool, Any]:
    try:
        fn, args = pickle.loads(order)
        return True, fn(*args)
    except Exception as error:
        error.add_note(traceback.format_exc())  # where it was is not sent with it
        return False, error


@contextlib.contextmanager
def flight_processes(jobs: int) -> Iterator[Executor]:
    """So many processes that fly; left by an exception, they are ended where they are."""
    hands = Hands(jobs)
    try:
        yield hands
    except BaseException:
        hands.kill()
        raise
    hands.shutdown()


# --- What no signal may end halfway ------------------------------------------------------------


SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextlib.contextmanager
def defer_interrupts() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait until after the block; what is started within, processes and
    threads, never sees them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        with _kept_for_later():
            yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _kept_for_later() -> Iterator[None]:
    """A mask is one thread's: some other, of a library, takes the signal, and Python handles it
    in the main thread all the same."""
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
