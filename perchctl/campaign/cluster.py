"""The workers of a dask cluster as an executor of flights, by dask's own executor."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import pickle
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from multiprocessing import active_children, resource_tracker
from pathlib import Path
from typing import Any, TypeVar

import dask
from distributed import Client, KilledWorker, LocalCluster
from distributed.utils import LoopRunner
from distributed.versions import VersionMismatchWarning

from perchctl.campaign.pool import FlightPool, defer_interrupts
from perchctl.campaign.workers import (
    WorkerRequirements,
    fly_verified,
    verify_cluster,
    worker_requirements,
)
from perchctl.errors import ConnectionFailed, PerchError, UsageError
from perchctl.profile import Profile

R = TypeVar("R")

ANSWER_S = 10.0
"""The scheduler must answer within this time."""
HANGS_S = 60.0
"""A scheduler that does not answer for this long is lost."""
WORKERS_S = 20.0
"""The first worker must register within this time."""
NOBODY_S = 120.0
"""A campaign waits this long without any worker."""
_POLL_S = 0.25
_CLOSE_S = 1.0
_NO_PAGES = "127.0.0.1:0"
"""dask opens a port for its web pages in any case: on loopback, any that is free, and no page."""
_QUIET = ("distributed", "tornado", "asyncio")


class ClusterPool(FlightPool):
    """A pool of flights on the workers of a dask cluster. `notes`: remarks about the workers, a
    sentence each."""

    lost = (BrokenExecutor, KilledWorker)

    def __init__(self, client: Any, address: str, required: WorkerRequirements) -> None:
        self._client, self._address, self._required = client, address, required
        self._executor = client.get_executor(pure=False)
        self._had_worker_s = time.monotonic()
        while not self.places(WORKERS_S):
            time.sleep(_POLL_S)
        self.notes = verify_cluster(client, address, required)

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """Hand a flight to a worker. Its future fails with `KilledWorker`, or is cancelled, if
        the flight was lost, and with InvalidValue if the worker must not fly."""
        order = pickle.dumps((fn, args, kwargs))
        future: Future[R] = self._executor.submit(fly_verified, order, self._required)
        return future

    def places(self, nobody_s: float = NOBODY_S) -> int:
        """Return the number of workers. Errors: ConnectionFailed if the scheduler is gone, or
        there has been no worker for `nobody_s`."""
        client = self._client
        try:
            if client.status != "running":
                raise OSError(client.status)
            workers = len(client.sync(client.scheduler.ncores, callback_timeout=HANGS_S))
        except (OSError, TimeoutError) as error:
            raise ConnectionFailed(
                f"the scheduler of --cluster {self._address} does not answer any more: start it "
                f"again, and go on with what was written to --out by --resume"
            ) from error
        now_s = time.monotonic()
        if workers:
            self._had_worker_s = now_s
        elif now_s - self._had_worker_s >= nobody_s:
            raise ConnectionFailed(
                f"the scheduler at {self._address} has had no worker for {nobody_s:.0f} s: start "
                f"some with dask worker {self._address} --nthreads 1"
            )
        return workers


@contextlib.contextmanager
def cluster_pool(
    address: str, profiles: Sequence[Profile], folder: Path | None = None
) -> Iterator[ClusterPool]:
    """Yield an executor of the workers of the scheduler at `address` (``HOST:PORT``,
    ``tcp://HOST:PORT``, or ``local:N`` for one of this computer with N workers), which have this
    computer's program, its data for these `profiles`, and its `folder` if one is given.
    Errors: UsageError, ConnectionFailed, InvalidValue."""
    if not os.environ.get("PERCHCTL_DEBUG"):
        for name in (*_QUIET, *logging.root.manager.loggerDict):
            if name.startswith(_QUIET):
                logging.getLogger(name).setLevel(logging.CRITICAL)
    # `verify_cluster` compares the versions that matter.
    warnings.filterwarnings("ignore", category=VersionMismatchWarning)
    with contextlib.ExitStack() as stack:
        required = stack.enter_context(worker_requirements(profiles, folder))
        resource_tracker.ensure_running()  # it lifts the mask of the thread that starts it
        with defer_interrupts():  # threads and processes inherit the mask of who starts them
            runner = LoopRunner(asynchronous=False)
            runner.start()
        stack.callback(runner.stop)
        if address.startswith("local:"):
            address = stack.enter_context(_local_scheduler(address, runner.loop))
        client = stack.enter_context(_connected(address, runner.loop))
        yield ClusterPool(client, address, required)


@contextlib.contextmanager
def _local_scheduler(address: str, loop: Any) -> Iterator[str]:
    """Start a scheduler and workers on this computer; yields the scheduler's address. They end
    with this program, killed or not."""
    workers = address.removeprefix("local:")
    if not (workers.isascii() and workers.isdigit() and int(workers[:9])):
        raise UsageError(f"--cluster {address} must be local:N with N workers, as in local:4")
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
            cluster = LocalCluster(
                n_workers=int(workers), threads_per_worker=1, memory_limit=0, loop=loop,
                dashboard_address=None, scheduler_kwargs={"dashboard_address": _NO_PAGES},
                silence_logs=logging.CRITICAL,
            )  # fmt: skip
            try:
                yield cluster.scheduler_address
            finally:
                for worker in active_children():  # what they fly would be waited for
                    worker.kill()
                with contextlib.suppress(Exception):
                    cluster.close(timeout=_CLOSE_S)


@contextlib.contextmanager
def _connected(address: str, loop: Any) -> Iterator[Any]:
    """Yield a client of the scheduler. Errors: UsageError, ConnectionFailed."""
    problem: PerchError | None = None
    try:
        client = Client(address, loop=loop, set_as_default=False, timeout=ANSWER_S)
    except ValueError as error:
        problem = UsageError(
            f"--cluster {address} must be the address of a dask scheduler, as in "
            f"--cluster tcp://10.0.0.5:8786, or local:N ({error})"
        )
    except Exception as error:
        problem = ConnectionFailed(
            f"no dask scheduler answers at {address} within {ANSWER_S:.0f} s "
            f"({type(error).__name__}): start dask scheduler there, or mend the address"
        )
    if problem is not None:
        gc.collect()  # a client that did not connect is closed as long as its loop runs
        raise problem
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=_CLOSE_S)
