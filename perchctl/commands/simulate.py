"""The work behind `perchctl simulate`: seeds in, a table or one JSON object out."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from perchctl.commands.progress import progress_bar
from perchctl.errors import UsageError
from perchctl.flight.results import FlightResult, campaign_summary, campaign_table
from perchctl.profile import load_profile


def run(
    profile_name: str, seeds: list[int], jobs: int, log_dir: Path | None, as_json: bool
) -> None:
    """Fly the seeds and print; progress goes to stderr, the result to stdout."""
    profile = load_profile(profile_name)
    try:
        from perchctl.flight.campaign import fly_seed, run_campaign
    except ImportError as error:
        raise UsageError(
            f"the simulator is not installed ({error.name} is missing): pip install 'perchctl[sim]'"
        ) from None
    with ExitStack() as stack:
        advance: Callable[[FlightResult], None] = stack.enter_context(progress_bar(len(seeds)))
        if log_dir is not None and len(seeds) == 1:
            log_dir.mkdir(parents=True, exist_ok=True)
            results = [fly_seed(profile, seeds[0], log_dir / f"flight_seed{seeds[0]}.jsonl")]
            advance(results[0])
        else:
            executor: Executor | None = None
            if jobs > 1 and len(seeds) > 1:
                context = multiprocessing.get_context("spawn")
                executor = stack.enter_context(
                    ProcessPoolExecutor(min(jobs, len(seeds)), mp_context=context)
                )
            results = run_campaign(profile, seeds, executor, advance)
    print(json.dumps(campaign_summary(results)) if as_json else campaign_table(results))
