"""A campaign of flights that are none; run as a program, one that says when its first is done,
and then waits for a signal. Its argument is a cluster; without one, two processes fly."""

from __future__ import annotations

import sys
from collections.abc import Callable
from concurrent.futures import Executor
from functools import partial

from perchctl.errors import PerchError
from tests.helpers.seeds import Ended, ends_first_only


def campaign(
    fly: Callable[[int], Ended],
    flights: int,
    report: Callable[[list[Ended], PerchError | None], None],
    on_result: Callable[[Ended], None] = lambda result: None,
    jobs: int | None = None,
    cluster: str | None = None,
) -> int:
    """As `perchctl simulate` has it."""
    # Not at the top: each process that flies loads this module.
    from perchctl.campaign import fly_all
    from perchctl.commands.interrupt import handle_signals
    from perchctl.commands.simulate import make_executor, run_campaign, stop_handler

    def flown(executor: Executor, note: Callable[[Ended], None]) -> None:
        def noted(result: Ended) -> None:
            note(result)
            on_result(result)

        fly_all(fly, range(flights), executor, noted)

    with handle_signals(stop_handler()):
        return run_campaign(flown, report, flights, make_executor(jobs, cluster, [], flights))


if __name__ == "__main__":
    WHERE = sys.argv[1] if sys.argv[1:] else None
    say = partial(print, flush=True)
    sys.exit(
        campaign(
            ends_first_only,
            6,
            lambda flown, problem: say("report", len(flown), problem),
            lambda result: say(result.pid),
            jobs=None if WHERE else 2,
            cluster=WHERE,
        )
    )
