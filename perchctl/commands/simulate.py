"""The work behind `perchctl simulate`: seeds in, a table or one JSON object out."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from perchctl.commands.output import print_record
from perchctl.commands.progress import progress_bar
from perchctl.errors import UsageError
from perchctl.flight.results import FlightResult, campaign_summary, campaign_table
from perchctl.profile import load_profile


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


def run(request: SimulateRequest) -> int:
    """Fly the seeds and print; progress goes to stderr, the result to stdout.

    Errors: NotFound, InvalidValue, UsageError.
    """
    profile = load_profile(request.profile)
    try:
        from perchctl.flight.campaign import fly_seed, run_campaign
    except ImportError as error:
        raise UsageError(
            f"the simulator is not installed ({error.name} is missing): pip install 'perchctl[sim]'"
        ) from None
    only, folder = request.only, request.log_dir
    seeds = (
        [only] if only is not None else list(range(request.seed, request.seed + request.flights))
    )
    with ExitStack() as stack:
        advance: Callable[[FlightResult], None] = stack.enter_context(progress_bar(len(seeds)))
        if only is not None and folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            results = [fly_seed(profile, only, folder / f"flight_seed{only}.jsonl")]
            advance(results[0])
        else:
            executor: Executor | None = None
            if request.jobs > 1 and len(seeds) > 1:
                context = multiprocessing.get_context("spawn")
                executor = stack.enter_context(
                    ProcessPoolExecutor(min(request.jobs, len(seeds)), mp_context=context)
                )
            results = run_campaign(profile, seeds, executor, advance)
    if request.as_json:
        print_record(campaign_summary(results))
    else:
        print(campaign_table(results))
    return 0
