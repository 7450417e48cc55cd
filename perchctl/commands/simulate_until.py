"""The work behind `perchctl simulate --until`: a campaign that ends when its rate is known."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor

from perchctl.commands.output import print_record
from perchctl.commands.simulate_modes import width_of
from perchctl.commands.simulate_request import (
    EnoughFlown,
    SimulateRequest,
    and_problem,
    fly_each,
    tell_logs,
)
from perchctl.errors import PerchError
from perchctl.flight import (
    FlightResult,
    StopRule,
    campaign_summary,
    campaign_table,
    none_took_off_text,
    run_campaign,
)


def run_until(request: SimulateRequest) -> int:
    """Fly until the interval is narrow enough and print. Errors: NotFound, InvalidValue."""
    assert request.until is not None
    width = width_of(request.until)
    profile = request.loaded()
    enough = StopRule(request.seeds, width)

    def count(result: FlightResult) -> None:
        if enough.note(result):
            raise EnoughFlown

    def campaign(executor: Executor, note: Callable[[FlightResult], None]) -> None:
        def noted(result: FlightResult) -> None:
            note(result)
            count(result)

        for result in kept.earlier:
            count(result)
        run_campaign(profile, kept.left, executor, noted, request.log_dir, request.record)

    def report(_results: list[FlightResult], problem: PerchError | None) -> None:
        if request.as_json:
            record = campaign_summary(enough.counted) | {
                "until": {
                    "width": width,
                    "interval": [round(bound, 6) for bound in enough.interval],
                    "met": enough.met,
                }
            }
            print_record(and_problem(record, problem))
        else:
            print(campaign_table(enough.counted))
            print(f"\n{verdict(enough, width)}", flush=True)
        tell_logs(enough.counted, request.log_dir, request.keep)

    with request.results(profile, FlightResult) as kept:
        return fly_each(
            campaign, request, report, kept, profiles=[profile], expected=enough.expected,
            objection=none_took_off_text,
        )  # fmt: skip


def verdict(enough: StopRule, width: float) -> str:
    low, high = (100.0 * bound for bound in enough.interval)
    known = f"the success rate is {low:.2f} to {high:.2f} % (95 %), {high - low:.2f} % wide"
    flights = len(enough.counted)
    if enough.met:
        return f"{known}: narrower than {100 * width:g} % after {flights} flights"
    return f"{known}: not yet narrower than {100 * width:g} % after {flights} flights"
