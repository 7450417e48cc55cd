"""What `perchctl simulate` shares between plain campaigns and those with faults."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TypeVar

from perchctl.commands.interrupt import signals_to
from perchctl.commands.output import say
from perchctl.errors import Interrupted

R = TypeVar("R")


@dataclass(frozen=True)
class SimulateRequest:
    """The command line as it was given; None is not given."""

    profile: str = "sim"
    flights: int = 10
    seed: int = 0
    jobs: int = 1
    only: int | None = None
    log_dir: Path | None = None
    as_json: bool = False
    faults: str | None = None
    heat_map: Path | None = None

    @property
    def seeds(self) -> list[int]:
        if self.only is not None:
            return [self.only]
        return list(range(self.seed, self.seed + self.flights))


def noting(results: list[R], advance: Callable[[R], None]) -> Callable[[R], None]:
    """Keeps each result as it comes, and moves the bar."""

    def note(result: R) -> None:
        results.append(result)
        advance(result)

    return note


@contextlib.contextmanager
def flying(flights: int, jobs: int) -> Iterator[Executor | None]:
    """Yields the executor of more than one flight. Ctrl-C and SIGTERM end the block early,
    and nothing else: what was flown by then is there.

    More than one flight is always flown by processes of their own, which are ended where
    they are; a flight of this process would be landed first.
    """
    from perchctl.flight.campaign import job_processes

    with signals_to(_stop()), contextlib.suppress(KeyboardInterrupt):
        if flights == 1:
            yield None
        else:
            with job_processes(min(jobs, flights)) as executor:
                yield executor


def _stop() -> Callable[[int, FrameType | None], None]:
    """The first signal ends the flights; while they are ended, further ones do nothing."""
    pressed: list[int] = []

    def press(number: int, _frame: FrameType | None) -> None:
        pressed.append(number)
        if len(pressed) == 1:
            raise KeyboardInterrupt

    return press


def exit_code(flown: int, wanted: int) -> int:
    if flown == wanted:
        return 0
    say(f"stopped: {flown} of {wanted} flights were flown")
    return Interrupted.exit_code
