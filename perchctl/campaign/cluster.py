"""Run flights on the workers of a dask cluster, through dask's own executor.

A flight has the same result on another computer only if program, libraries and data are the same.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import pickle
import platform
import secrets
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, TypeVar

import cv2
from distributed import Client, KilledWorker, get_worker
from distributed.versions import VersionMismatchWarning

import perchctl
from perchctl.campaign.pool import defer_interrupts
from perchctl.campaign.results_file import profile_sha256, source_sha256
from perchctl.errors import ConnectionFailed, InvalidValue, PerchError, UsageError
from perchctl.profile import Profile

R = TypeVar("R")

SCHEDULER_TIMEOUT_S = 10.0
"""Time within which the scheduler must answer, s."""
WORKERS_S = 20.0
"""Time within which the first worker must register, s."""
_CLOSE_S = 1.0
_QUIET = ("distributed", "tornado", "asyncio")
_LIBRARIES = ("numpy", "mujoco-core", "filterpy", "distributed")
"""Libraries that compute or transfer the figures of a flight. OpenCV, which has several package
names, is compared separately."""


# --- Requirements on each worker ---


@dataclass(frozen=True)
class WorkerRequirements:
    """The software and files that each worker of a campaign must have; sent with each flight.
    `campaign_id` is unique. `environment` contains versions and hashes by name, which must equal
    those of this computer."""

    campaign_id: str
    profiles: tuple[Profile, ...]
    environment: dict[str, str]


def flight_environment(profiles: Sequence[Profile], threads: int) -> dict[str, str]:
    """Return everything that a flight's result depends on, by name: versions of perchctl and its
    libraries, hashes of the `profiles`, and the number of `threads`."""
    return {
        "perchctl": f"{perchctl.__version__} ({source_sha256()[:8]})",
        "python": ".".join(platform.python_version_tuple()[:2]),
        "opencv": cv2.__version__,
        **{name: version(name) for name in _LIBRARIES},
        "--nthreads": str(threads),
        "calibration or mask": " ".join(profile_sha256(profile)[:8] for profile in profiles),
    }


def worker_requirements(profiles: Sequence[Profile]) -> WorkerRequirements:
    """Return the requirements for a campaign that is about to start."""
    state = flight_environment(profiles, threads=1)
    return WorkerRequirements(secrets.token_hex(16), tuple(profiles), state)


_differences: dict[str, str] = {}
"""The differences between this worker and the requirements of each campaign, keyed by campaign;
empty if there are none."""


def fly_verified(pickled_call: bytes, requirements: WorkerRequirements) -> Any:
    """Run a flight, given as a pickled call, after verifying this worker once per campaign.

    Errors: InvalidValue if the worker differs from `requirements`; the flight's own errors.
    """
    worker = get_worker()
    if requirements.campaign_id not in _differences:
        here = flight_environment(requirements.profiles, worker.state.nthreads)
        _differences[requirements.campaign_id] = ", ".join(
            f"{name} {here[name]} instead of {wanted}"
            for name, wanted in requirements.environment.items()
            if here[name] != wanted
        )
    if difference := _differences[requirements.campaign_id]:
        raise InvalidValue(
            f"worker {worker.address} on {platform.node()} has {difference}: correct "
            "this on the worker, and restart it"
        )
    fn, args, named = pickle.loads(pickled_call)
    return fn(*args, **named)


# --- The executor ---


class ClusterExecutor(Executor):
    """An executor that flies on the workers of a dask cluster, and repeats the flights of a lost
    worker. A future fails with an exception in `lost` if its workers were lost too often, and with
    InvalidValue if its worker does not meet the requirements. A future is cancelled if the
    scheduler stops."""

    lost = (KilledWorker,)

    def __init__(self, client: Client, requirements: WorkerRequirements) -> None:
        self._executor, self._required = client.get_executor(pure=False), requirements

    def submit(self, fn: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """Send the flight ``fn(*args, **kwargs)`` to the cluster, and return its future."""
        order = pickle.dumps((fn, args, kwargs))
        future: Future[R] = self._executor.submit(fly_verified, order, self._required)
        return future


@contextlib.contextmanager
def cluster_pool(address: str, profiles: Sequence[Profile]) -> Iterator[Executor]:
    """Yield an executor on the workers of the scheduler at `address` (``HOST:PORT`` or
    ``tcp://HOST:PORT``), which must have the same program and profile files as this computer.
    Errors: UsageError, ConnectionFailed."""
    if not os.environ.get("PERCHCTL_DEBUG"):
        for name in (*_QUIET, *logging.root.manager.loggerDict):
            if name.startswith(_QUIET):
                logging.getLogger(name).setLevel(logging.CRITICAL)
    # Each worker compares the versions that matter.
    warnings.filterwarnings("ignore", category=VersionMismatchWarning)
    client = _connected(address)
    try:
        _wait_for_worker(client, address)
        yield ClusterExecutor(client, worker_requirements(profiles))
    finally:
        with contextlib.suppress(Exception):
            client.close(timeout=_CLOSE_S)


def _connected(address: str) -> Client:
    """A client of the scheduler. Errors: UsageError, ConnectionFailed."""
    problem: PerchError
    try:
        with defer_interrupts():
            return Client(address, set_as_default=False, timeout=SCHEDULER_TIMEOUT_S)
    except ValueError as error:
        problem = UsageError(
            f"--cluster {address} must be the address of a dask scheduler, as in "
            f"--cluster tcp://10.0.0.5:8786 ({error})"
        )
    except Exception as error:
        problem = ConnectionFailed(
            f"no dask scheduler answers at {address} within {SCHEDULER_TIMEOUT_S:.0f} s "
            f"({type(error).__name__}): start a dask scheduler there, or correct the address"
        )
    gc.collect()  # close a client that could not connect, before its event loop ends
    raise problem


def _wait_for_worker(client: Client, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError:
        raise ConnectionFailed(
            f"the scheduler at {address} has no worker: start some with dask worker {address} "
            f"--nthreads 1"
        ) from None
