"""A campaign of flights that are none; run as a program, one that says when its first is done,
and then waits for a signal. Its argument is a cluster; without one, two processes fly."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

from perchctl.commands.interrupt import signals_to
from perchctl.commands.simulate_request import SimulateRequest, fly_each, stop_once
from perchctl.errors import PerchError
from perchctl.flight import fly_all
from tests.helpers.seeds import Ended, ends_first_only


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
    WHERE = sys.argv[1] if sys.argv[1:] else None
    say = partial(print, flush=True)
    sys.exit(
        campaign(
            ends_first_only,
            SimulateRequest(flights=6, jobs=None if WHERE else 2, cluster=WHERE),
            lambda flown, problem: say("report", len(flown), problem),
            lambda result: say(result.pid),
        )
    )
