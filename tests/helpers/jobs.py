"""Flights that are none, for tests of the processes that fly; run as a program, a campaign of
them that says when its first is done, and then waits for a signal."""

from __future__ import annotations

import os
import secrets
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from perchctl.commands.interrupt import signals_to
from perchctl.commands.simulate_request import SimulateRequest, fly_each, stop_once
from perchctl.errors import PerchError
from perchctl.flight.campaign import fly_all

FOR_EVER_S = 300.0


@dataclass(frozen=True)
class Ended:
    seed: int
    outcome: str = "perched"
    log_problem: str | None = None
    pid: int = 0
    deaf: bool = False  # to Ctrl-C and SIGTERM


def ends_at_once(seed: int) -> Ended:
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
    return Ended(seed, pid=os.getpid(), deaf={signal.SIGINT, signal.SIGTERM} <= blocked)


def ends_first_only(seed: int) -> Ended:
    """The flight of seed 0 does, the others go on for ever."""
    if seed:
        time.sleep(FOR_EVER_S)
    return ends_at_once(seed)


def fails_later(seed: int) -> Ended:
    if seed:
        raise ZeroDivisionError("no such luck")
    return ends_at_once(seed)


def no_form() -> object:
    return lambda: None


def is_lost(seed: int, folder: Path, times: int) -> Ended:
    """The flight of seed 1 loses its process so many times; each flight leaves a mark."""
    mark = folder / f"{seed}_{secrets.token_hex(4)}"
    mark.touch()
    if seed == 1 and len(list(folder.glob("1_*"))) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return ends_at_once(seed)


def is_killed_later(seed: int) -> Ended:
    if seed:
        os.kill(os.getpid(), signal.SIGKILL)
    return ends_at_once(seed)


def campaign(
    fly: Callable[[int], Ended],
    request: SimulateRequest,
    report: Callable[[list[Ended], PerchError | None], None],
    on_result: Callable[[Ended], None] = lambda result: None,
) -> int:
    """As `perchctl simulate` has it."""

    def flown(executor: object, note: Callable[[Ended], None]) -> None:
        def noted(result: Ended) -> None:
            note(result)
            on_result(result)

        fly_all(fly, request.seeds, executor, noted)  # type: ignore[arg-type]

    with signals_to(stop_once()):
        return fly_each(flown, request, report)


if __name__ == "__main__":
    say = partial(print, flush=True)
    sys.exit(
        campaign(
            ends_first_only,
            SimulateRequest(flights=6, jobs=2),
            lambda flown, problem: say("report", len(flown), problem),
            lambda result: say(result.pid),
        )
    )
