"""A dask scheduler and workers as a user starts them, on loopback."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from perchctl.campaign import FlightResult
from perchctl.campaign.flights import fly_seed
from perchctl.flight import fly_lockstep
from perchctl.mission import Event, Phase, Watcher
from perchctl.profile import Profile
from tests.helpers.flights import ROOT
from tests.helpers.waiting import until

UP_S = 60.0


@contextlib.contextmanager
def scheduler(folder: Path) -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Its address and its process. `folder`: for what it writes."""
    file = folder / "scheduler.json"
    words = ["scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    with started(folder, *words, "--dashboard-address", ":0", "--scheduler-file", file) as process:

        def address() -> str | None:
            assert process.poll() is None, "the scheduler has ended"
            with contextlib.suppress(OSError, ValueError):
                return str(json.loads(file.read_text())["address"])
            return None

        yield until(address, UP_S), process


@contextlib.contextmanager
def worker(
    address: str, folder: Path, *options: str, root: Path = ROOT
) -> Iterator[subprocess.Popen[bytes]]:
    """One process without a nanny. `root`: where its perchctl is."""
    words = ["worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    with started(folder, *words, "--memory-limit", "0", *options, root=root) as process:
        yield process


@contextlib.contextmanager
def started(
    folder: Path, *words: str | Path, root: Path = ROOT
) -> Iterator[subprocess.Popen[bytes]]:
    place = {"PYTHONPATH": str(root), "DASK_TEMPORARY_DIRECTORY": str(folder)}
    process = subprocess.Popen(
        [sys.executable, "-m", "dask", *words],
        env=os.environ | place,
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


class _Killer(Watcher):
    def event(self, event: Event) -> None:
        if event.phase is Phase.ASCEND:
            os.kill(os.getpid(), signal.SIGKILL)


def dies_in_flight(
    profile: Profile, folder: Path, seeds: tuple[int, ...], seed: int
) -> FlightResult:
    """The flight of the seed; of `seeds` each loses its process at the first time, on the way up,
    and leaves a mark."""
    mark = folder / str(seed)
    if seed in seeds and not mark.exists():
        mark.touch()
        fly_lockstep(profile, seed, watchers=(_Killer(),))
    return fly_seed(profile, seed)
