"""The work behind `perchctl simulate --faults`: a fault a seed, judged by the truth."""

from __future__ import annotations

import contextlib
from dataclasses import asdict, replace

from perchctl.commands.flight_plot import plot_of
from perchctl.commands.output import print_record
from perchctl.commands.simulate_request import SimulateRequest, and_problem, fly_each, tell_logs
from perchctl.errors import PerchError
from perchctl.faults import (
    FAULTS,
    FaultResult,
    fault_summary,
    fault_table,
    run_fault_campaign,
    select_faults,
)
from perchctl.flight import align_columns
from perchctl.log import to_plain
from perchctl.profile import Profile


def run_faults(request: SimulateRequest) -> int:
    """Fly the seeds with their faults and print. Errors: NotFound, InvalidValue, UsageError."""
    if request.faults == "list":
        _list(request.as_json)
        return 0
    names = tuple(fault.name for fault in select_faults(request.faults or "all"))
    profile = request.loaded()
    if request.only is not None:
        request = replace(request, log_dir=request.log_folder(profile))

    def report(results: list[FaultResult], problem: PerchError | None) -> None:
        if request.only is not None:
            for result in results:
                _tell(result, profile, request.as_json)
            return
        if request.as_json:
            print_record(and_problem(fault_summary(results), problem))
        else:
            print(fault_table(results), flush=True)
        tell_logs(results, request.log_dir, request.keep)

    with request.results(profile, FaultResult, names) as kept:
        return fly_each(
            lambda executor, note: run_fault_campaign(
                profile, kept.left, names, executor, note, request.log_dir, request.record
            ),
            request,
            report,
            kept,
            profiles=[profile],
        )


def _list(as_json: bool) -> None:
    if as_json:
        print_record({"faults": {fault.name: fault.what for fault in FAULTS}})
    else:
        print("\n".join(align_columns([(fault.name, fault.what) for fault in FAULTS])))


def _tell(result: FaultResult, profile: Profile, as_json: bool) -> None:
    """All that is known of one flight."""
    told = asdict(result)
    if not as_json:
        print("\n".join(f"{name:<18} {value}" for name, value in told.items()), flush=True)
    assert result.log is not None
    plot = None
    with contextlib.suppress(KeyboardInterrupt):
        plot = plot_of(result.log, profile)
    if as_json:
        print_record(to_plain({**told, "plot": plot}))
    elif plot is not None:
        print(f"{'plot':<18} {plot}")
