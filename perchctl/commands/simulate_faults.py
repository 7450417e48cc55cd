"""The work behind `perchctl simulate --faults`: a fault a seed, judged by the truth."""

from __future__ import annotations

from dataclasses import asdict

from perchctl.commands.output import print_record, say
from perchctl.commands.progress import progress_bar
from perchctl.commands.simulate_request import SimulateRequest, exit_code, flying, noting
from perchctl.faults.campaign import run_fault_campaign
from perchctl.faults.catalogue import FAULTS, selected
from perchctl.faults.result import FaultResult
from perchctl.faults.summary import fault_summary, fault_table
from perchctl.flight.results import aligned
from perchctl.profile import load_profile


def run_faults(request: SimulateRequest) -> int:
    """Fly the seeds with their faults and print. Errors: NotFound, InvalidValue, UsageError."""
    if request.faults == "list":
        print("\n".join(aligned([(fault.name, fault.what) for fault in FAULTS])))
        return 0
    names = tuple(fault.name for fault in selected(request.faults or "all"))
    profile, seeds = load_profile(request.profile), request.seeds
    results: list[FaultResult] = []
    with progress_bar(len(seeds)) as advance, flying(len(seeds), request.jobs) as executor:
        on_result = noting(results, advance)
        run_fault_campaign(profile, seeds, names, executor, on_result, request.log_dir)
    results.sort(key=lambda result: result.seed)
    if request.heat_map is not None:
        from perchctl.faults.plot import plot_heat_map

        plot_heat_map(results, request.heat_map)
        say(f"{request.heat_map} is drawn")
    if request.as_json:
        print_record(fault_summary(results))
    else:
        print(fault_table(results))
        if request.only is not None:
            for result in results:
                print("\n" + _told(result))
    return exit_code(len(results), len(seeds))


def _told(result: FaultResult) -> str:
    """All that is known of one flight."""
    return "\n".join(f"{name:<18} {value}" for name, value in asdict(result).items())
