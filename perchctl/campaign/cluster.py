"""The workers of a dask cluster as an executor: flights in, futures of `concurrent.futures` out.

Everything of dask's runs in one event loop, in a thread that never sees a signal. A worker gets
one flight at a time; the rest wait here, where they cost the scheduler nothing. dask's own
executor would let them wait at the workers, where they are lost with the flight before them.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import pickle
import tempfile
import threading
import warnings
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

import dask
from distributed import Client, KilledWorker, LocalCluster
from distributed.versions import VersionMismatchWarning

from perchctl.campaign.pool import ClusterAddress, defer_interrupts
from perchctl.campaign.workers import (
    WorkerRequirements,
    cannot_load,
    flight_order,
    fly_order,
    verify_scheduler,
    verify_workers,
    worker_requirements,
)
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError
from perchctl.profile import Profile

R = TypeVar("R")

ANSWER_S = 10.0
"""A scheduler may take so long to answer."""
HANGS_S = 60.0
"""One that has answered before, and so long does not, is lost."""
WORKERS_S = 20.0
"""It may take so long until it has a worker."""
NOBODY_S = 120.0
"""For so long a campaign waits without any worker."""
_POLL_S = 0.25
_CLOSE_S = 0.5
_END_S = 1.0
_NO_PAGES = "127.0.0.1:0"
"""dask opens a port for its web pages in any case: on loopback, any that is free, and no page."""
_QUIET = ("distributed", "tornado", "asyncio")


class ClusterPool(Executor):
    """`notes`: what is worth saying once it has started, a sentence each."""

    def __init__(self, address: ClusterAddress, required: WorkerRequirements) -> None:
        self.notes: list[str] = []
        self._cluster, self._required = address, required
        self._orders: deque[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]] = deque()
        self._flying: set[asyncio.Task[None]] = set()
        self._lock = threading.Lock()
        self._broken: PerchError | None = None
        self._ended = False
        self._address = address.scheduler or ""
        self._workers = self._number = 0
        self._nobody_s = 0.0
        self._ready: Future[None] = Future()
        self._task: asyncio.Task[None] | None = None
        self._thread = threading.Thread(target=self._live, name="perchctl-cluster", daemon=True)

    def start(self) -> None:
        """Return as soon as flights can be handed over. Errors: PerchError."""
        resource_tracker.ensure_running()  # it lifts the mask of the thread that starts it
        with defer_interrupts():  # threads and processes inherit the mask of who starts them
            self._thread.start()
        self._ready.result()

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """The future fails with `BrokenExecutor` if the worker that flew was lost, and with
        PerchError if the worker must not fly, or no worker is left."""
        if kwargs:
            raise TypeError("a flight has no arguments by name")
        if self._ended:
            raise RuntimeError("no flight can be handed to a cluster that was left")
        future: Future[R] = Future()
        with self._lock:
            if self._broken is not None:
                future.set_exception(self._broken)
                return future
            self._orders.append((future, fn, args))
        self._call(self._hand_over)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster; the flights that it is flying are dropped."""
        self._ended = True
        self._call(self._leave)
        if wait and self._thread.ident is not None:
            self._thread.join(_END_S)
            if self._thread.is_alive() and self._cluster.scheduler is None:
                for worker in multiprocessing.active_children():  # they fly on
                    worker.kill()
                self._thread.join(_END_S)

    def _call(self, what: Callable[[], object]) -> None:
        """Call `what` in the event loop."""
        if self._task is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                self._task.get_loop().call_soon_threadsafe(what)

    def _live(self) -> None:
        """Run the event loop; this is the life of the thread."""
        try:
            asyncio.run(self._work())
        except asyncio.CancelledError:
            self._fail(PerchError("the cluster was left"))
        except PerchError as error:
            self._fail(error)
        except Exception as error:
            self._fail(self._unforeseen(error))

    def _fail(self, why: PerchError) -> None:
        """Let all flights fail that were handed over and are not flown."""
        with self._lock:
            self._broken = why
            orders = list(self._orders)
            self._orders.clear()
        for future, _, _ in orders:
            future.set_exception(why)
        if not self._ready.done():
            self._ready.set_exception(why)

    # --- in the event loop ----------------------------------------------------------------

    def _leave(self) -> None:
        assert self._task is not None
        self._task.cancel()

    async def _work(self) -> None:
        self._task = asyncio.current_task()
        if self._ended:
            return
        async with contextlib.AsyncExitStack() as stack:
            if self._cluster.scheduler is None:
                self._address = await stack.enter_async_context(_local(self._cluster.workers))
            self._client = await stack.enter_async_context(_connected(self._address))
            await verify_scheduler(self._client, self._address)
            while not self._workers:
                await self._poll(WORKERS_S)
            self.notes = await verify_workers(self._client, self._required)
            self._ready.set_result(None)
            while True:
                await self._poll(NOBODY_S)
                self._hand_over()

    async def _poll(self, nobody_s: float) -> None:
        """Count the workers, a moment from now. Errors: ConnectionFailed if the scheduler is gone,
        or there has been no worker for `nobody_s`; PerchError."""
        await asyncio.sleep(_POLL_S)
        try:
            if self._client.status != "running":
                raise OSError(self._client.status)
            self._workers = len(await asyncio.wait_for(self._client.nthreads(), HANGS_S))
        except (OSError, TimeoutError) as error:
            raise self._scheduler_lost() from error
        now_s = asyncio.get_running_loop().time()
        if self._workers or not self._nobody_s:
            self._nobody_s = now_s
        elif now_s - self._nobody_s >= nobody_s:
            raise ConnectionFailed(
                f"the scheduler at {self._address} has had no worker for {nobody_s:.0f} s: start "
                f"some with dask worker {self._address} --nthreads 1"
            )

    def _hand_over(self) -> None:
        """Send waiting flights, one a worker."""
        while self._orders and len(self._flying) < max(1, self._workers):
            with self._lock:
                order = self._orders.popleft()
            if not order[0].set_running_or_notify_cancel():
                continue
            task = asyncio.create_task(self._fly(*order))
            self._flying.add(task)
            task.add_done_callback(self._landed)

    def _landed(self, task: asyncio.Task[None]) -> None:
        self._flying.discard(task)
        self._hand_over()

    async def _fly(
        self, future: Future[Any], fn: Callable[..., Any], args: tuple[Any, ...]
    ) -> None:
        try:
            order = flight_order(fn, args)
        except Exception as error:  # it cannot be sent
            future.set_exception(error)
            return
        self._number += 1
        key = f"{self._required.campaign}-{self._number}"
        try:
            flight = self._client.submit(fly_order, order, self._required, key=key, pure=False)
            good, answer = pickle.loads(await flight.result())
        except KilledWorker:
            future.set_exception(BrokenExecutor("the worker that flew was lost"))
        except (Exception, asyncio.CancelledError) as error:
            if self._client.status != "running" or self._ended:
                future.set_exception(self._broken or self._scheduler_lost())
            elif isinstance(error, CancelledError | asyncio.CancelledError | OSError):
                future.set_exception(BrokenExecutor("the cluster has dropped the flight"))
            else:
                future.set_exception(InvalidValue(cannot_load("a worker", error)))
        else:
            (future.set_result if good else future.set_exception)(answer)

    def _scheduler_lost(self) -> ConnectionFailed:
        return ConnectionFailed(
            f"the scheduler of --cluster {self._cluster} does not answer any more: start it again, "
            f"and go on with what was written to --out by --resume"
        )

    def _unforeseen(self, error: Exception) -> PerchError:
        if os.environ.get("PERCHCTL_DEBUG"):
            logging.getLogger("perchctl").exception("the cluster failed")
        return ConnectionFailed(
            f"--cluster {self._cluster} failed ({type(error).__name__}: {error}): look at what its "
            f"scheduler says (PERCHCTL_DEBUG=1 shows more)"
        )


@contextlib.asynccontextmanager
async def _local(workers: int) -> AsyncIterator[str]:
    """Start a scheduler and workers on this computer; yields the scheduler's address. They end
    with this program, killed or not."""
    with tempfile.TemporaryDirectory(
        prefix="perchctl-cluster-", ignore_cleanup_errors=True
    ) as folder:
        settings = {
            "distributed.scheduler.allowed-failures": 0,  # `fly_all` flies a lost flight again
            "distributed.scheduler.http.routes": [],
            "distributed.worker.http.routes": [],
            "distributed.worker.profile.enabled": False,
            "temporary-directory": folder,
        }
        with dask.config.set(settings):
            async with LocalCluster(
                n_workers=workers, threads_per_worker=1, asynchronous=True, memory_limit=0,
                dashboard_address=None, scheduler_kwargs={"dashboard_address": _NO_PAGES},
                silence_logs=logging.CRITICAL,
            ) as cluster:  # fmt: skip
                yield cluster.scheduler_address


@contextlib.asynccontextmanager
async def _connected(address: str) -> AsyncIterator[Any]:
    """A client of the scheduler. Errors: ConnectionFailed."""
    # `verify_scheduler` compares the versions that matter.
    warnings.filterwarnings("ignore", category=VersionMismatchWarning)
    client = Client(address, asynchronous=True, set_as_default=False, timeout=ANSWER_S)
    try:
        try:
            await asyncio.wait_for(client, ANSWER_S + 1.0)
        except Exception as error:
            raise ConnectionFailed(
                f"no dask scheduler answers at {address} within {ANSWER_S:.0f} s "
                f"({type(error).__name__}): start dask scheduler there, or mend the address"
            ) from error
        yield client
    finally:
        with contextlib.suppress(Exception):
            await client.close(timeout=_CLOSE_S)


@contextlib.contextmanager
def cluster_pool(
    address: ClusterAddress, profiles: Sequence[Profile], folder: Path | None = None
) -> Iterator[ClusterPool]:
    """Yield an executor of the cluster's workers, which have this computer's program, its data for
    these `profiles`, and its `folder` if one is given.
    Errors: ConnectionFailed, InvalidValue, PerchError."""
    if not os.environ.get("PERCHCTL_DEBUG"):
        for name in (*_QUIET, *logging.root.manager.loggerDict):
            if name.startswith(_QUIET):
                logging.getLogger(name).setLevel(logging.CRITICAL)
    with worker_requirements(profiles, folder) as required:
        pool = ClusterPool(address, required)
        try:
            pool.start()
            yield pool
        finally:
            pool.shutdown()
