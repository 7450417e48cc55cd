"""The work behind `perchctl simulate`: seeds in, a table or one JSON object out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec

from perchctl.commands.interrupt import signals_to
from perchctl.commands.output import print_record
from perchctl.commands.simulate_request import (
    SimulateRequest,
    and_problem,
    fly_each,
    stop_once,
    tell_logs,
)
from perchctl.errors import PerchError, no_simulator
from perchctl.flight import (
    FlightResult,
    campaign_summary,
    campaign_table,
    defer_interrupts,
    none_took_off,
)
from perchctl.log import make_log_folder
from perchctl.startup import leave_at_ctrl_c, loaded

__all__ = ["SimulateRequest", "run"]


def run(request: SimulateRequest) -> int:
    """Fly the seeds and print; progress goes to stderr, the result to stdout.

    Errors: NotFound, InvalidValue, UsageError.
    """
    request.check()
    if find_spec("mujoco") is None:
        raise no_simulator()
    # A library that is half loaded fails with words of its own; nothing is open, nothing is lost.
    leave_at_ctrl_c()
    try:
        from perchctl.commands.simulate_faults import run_faults
        from perchctl.commands.simulate_only import run_only
    finally:
        loaded()
    if request.log_dir is not None:
        make_log_folder(request.log_dir)
        if request.cluster is not None:  # whose workers are started in other folders
            request = replace(request, log_dir=request.log_dir.absolute())
    with signals_to(stop_once()):
        if request.faults is not None:
            return run_faults(request)
        if request.only is not None:
            return run_only(request)
        answer = _answer(request)
        if answer is not None:
            return answer(request)
        return _campaign(request)


def _answer(request: SimulateRequest) -> Callable[[SimulateRequest], int] | None:
    """What answers the question that was asked; None: it is a plain campaign."""
    with defer_interrupts():
        if request.compare is not None:
            from perchctl.commands.simulate_compare import run_compare

            return run_compare
        if request.sweep:
            from perchctl.commands.simulate_sweep import run_sweep

            return run_sweep
    return None


def _campaign(request: SimulateRequest) -> int:
    from perchctl.flight import run_campaign

    profile = request.loaded()

    def report(results: list[FlightResult], problem: PerchError | None) -> None:
        if request.as_json:
            print_record(and_problem(campaign_summary(results), problem))
        else:
            print(campaign_table(results), flush=True)
        tell_logs(results, request.log_dir, request.keep)

    with request.results(profile, FlightResult) as kept:
        return fly_each(
            lambda executor, note: run_campaign(
                profile, kept.left, executor, note, request.log_dir, request.record
            ),
            request,
            report,
            kept,
            profiles=[profile],
            objection=none_took_off,
        )
