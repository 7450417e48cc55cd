"""Workers of a cluster on this computer.

dask's own `LocalCluster` gives each worker a nanny: with flights in the air it takes four seconds
to close, it starts again and again what cannot start, and its folder stays where the program is
killed. These are plain processes that end with this one, killed or not, and leave nothing behind.
"""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import os
import shutil
import tempfile
import threading
import warnings
from collections import Counter
from collections.abc import AsyncIterator, Container
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

from perchctl.children import end_with_parent
from perchctl.errors import PerchError

HOST = "127.0.0.1"
_NO_PAGES = f"{HOST}:0"
"""dask opens a port for its web pages in any case: on loopback, any that is free, and no page."""
STARTS = 3
"""A worker that has ended so many times before it was there is not started again."""
_PARENT_S = 1.0
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_CONTEXT = multiprocessing.get_context("spawn")


@asynccontextmanager
async def local_scheduler(folder: str) -> AsyncIterator[Any]:
    """Yield a scheduler in this event loop, on loopback. `folder`: for what it must write."""
    import dask
    from distributed import Scheduler

    settings = {
        "distributed.scheduler.allowed-failures": 0,  # a lost flight is the campaign's to fly again
        "distributed.scheduler.http.routes": [],
        "temporary-directory": folder,
    }
    warnings.filterwarnings("ignore", message="Creating scratch")  # slow on a busy computer
    with dask.config.set(settings):
        async with Scheduler(
            host=HOST, port=0, protocol="tcp://", dashboard=False, dashboard_address=_NO_PAGES
        ) as scheduler:
            yield scheduler


class LocalWorkers:
    """`count` worker processes, each started again if it is lost. They inherit the signals' mask of
    the thread that starts them. `folder`: their own, until they are killed."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._lock = threading.Lock()
        self._ended = False
        self.folder = tempfile.mkdtemp(prefix="perchctl-cluster-")
        self._failed: Counter[int] = Counter()
        self._processes: dict[int, Any] = {}

    async def start(self, address: str) -> None:
        """Start them at the scheduler of this address."""
        for number in range(self._count):
            self._start(address, number)
            await asyncio.sleep(0)

    def look_after(self, address: str, there: Container[str]) -> None:
        """Start those again that are gone. `there`: names of those that the scheduler knows.
        Errors: PerchError if one cannot start."""
        for number, process in list(self._processes.items()):
            if str(number) in there:
                self._failed[number] = 0
            if process.exitcode is None:
                continue
            self._failed[number] += 1
            if self._failed[number] >= STARTS:
                raise PerchError(
                    f"worker {number} of --cluster local:{self._count} ends at its start (exit "
                    f"{process.exitcode}): fly with --jobs, or with fewer workers where memory is "
                    f"short (PERCHCTL_DEBUG=1 shows more)"
                )
            self._start(address, number)

    def kill(self) -> None:
        """End them where they are, for good; from any thread."""
        with self._lock:
            self._ended = True
            for process in self._processes.values():
                process.kill()
            for process in self._processes.values():
                process.join()
            shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def pids(self) -> list[int]:
        return [process.pid for process in self._processes.values()]

    def _start(self, address: str, number: int) -> None:
        with self._lock:
            if self._ended:
                return
            process = _CONTEXT.Process(
                target=serve, args=(address, self.folder, number), daemon=True,
                name=f"perchctl-worker-{number}",
            )  # fmt: skip
            process.start()
            self._processes[number] = process


def serve(address: str, folder: str, number: int) -> None:
    """Run a worker; this is the life of its process."""
    tidy = partial(shutil.rmtree, folder, ignore_errors=True)
    end_with_parent(tidy)
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))  # before numpy is loaded
    if not os.environ.get("PERCHCTL_DEBUG"):
        logging.disable(logging.CRITICAL)
        warnings.simplefilter("ignore")
    asyncio.run(_work(address, folder, number))
    # The scheduler is gone: so is the parent, or is about to be, and this may be before the above.
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join(_PARENT_S)
    if not parent.is_alive():
        tidy()


async def _work(address: str, folder: str, number: int) -> None:
    import dask
    from distributed import Worker

    settings = {"distributed.worker.profile.enabled": False, "distributed.worker.http.routes": []}
    with dask.config.set(settings):
        async with Worker(
            address, name=str(number), host=HOST, nthreads=1, memory_limit=0,
            local_directory=folder, dashboard=False, dashboard_address=_NO_PAGES,
        ) as worker:  # fmt: skip
            await worker.finished()
