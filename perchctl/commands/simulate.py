"""The work behind `perchctl simulate`: seeds in, a table or one JSON object out."""

from __future__ import annotations

from perchctl.commands.output import print_record
from perchctl.commands.progress import progress_bar
from perchctl.commands.simulate_request import SimulateRequest, exit_code, flying, noting
from perchctl.errors import UsageError
from perchctl.flight.results import FlightResult, campaign_summary, campaign_table
from perchctl.profile import load_profile

__all__ = ["SimulateRequest", "run"]


def run(request: SimulateRequest) -> int:
    """Fly the seeds and print; progress goes to stderr, the result to stdout.

    Errors: NotFound, InvalidValue, UsageError.
    """
    try:
        from perchctl.flight.campaign import run_campaign
    except ImportError as error:
        raise UsageError(
            f"the simulator is not installed ({error.name} is missing): pip install 'perchctl[sim]'"
        ) from None
    if request.faults is not None:
        from perchctl.commands.simulate_faults import run_faults

        return run_faults(request)
    if request.heat_map is not None:
        raise UsageError("--heat-map is drawn of faults: name them with --faults")
    profile, seeds = load_profile(request.profile), request.seeds
    results: list[FlightResult] = []
    with progress_bar(len(seeds)) as advance, flying(len(seeds), request.jobs) as executor:
        on_result = noting(results, advance)
        run_campaign(profile, seeds, executor, on_result, request.log_dir)
    results.sort(key=lambda result: result.seed)
    if request.as_json:
        print_record(campaign_summary(results))
    else:
        print(campaign_table(results))
    return exit_code(len(results), len(seeds))
