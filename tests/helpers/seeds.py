"""Flights that are none, for tests of the processes that fly: nothing of perchctl is loaded for
them, which each process would take seconds for."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass

FOR_EVER_S = 300.0


@dataclass(frozen=True)
class Ended:
    seed: int
    outcome: str = "perched"
    pid: int = 0
    deaf: bool = False  # to Ctrl-C and SIGTERM

    @property
    def is_bad(self) -> bool:
        return self.outcome != "perched"


def ends_at_once(seed: int) -> Ended:
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    return Ended(seed, pid=os.getpid(), deaf={signal.SIGINT, signal.SIGTERM} <= blocked)


def ends_first_only(seed: int) -> Ended:
    """The flight of seed 0 does, the others go on for ever."""
    if seed:
        time.sleep(FOR_EVER_S)
    return ends_at_once(seed)


def lacks_a_module(seed: int) -> Ended:
    raise ModuleNotFoundError("No module named 'mujoco'")


def fails_later(seed: int) -> Ended:
    if seed:
        raise ZeroDivisionError("no such luck")
    return ends_at_once(seed)


def is_killed_later(seed: int) -> Ended:
    if seed:
        os.kill(os.getpid(), signal.SIGKILL)
    return ends_at_once(seed)
