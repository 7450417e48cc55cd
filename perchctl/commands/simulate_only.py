"""The work behind `perchctl simulate --only`: one flight, told as `perchctl fly` tells it."""

from __future__ import annotations

import contextlib
from functools import partial

from perchctl.commands.flight_plot import plot_of
from perchctl.commands.output import print_record
from perchctl.commands.simulate_request import SimulateRequest, fly_each
from perchctl.display import timed_event_text
from perchctl.errors import PerchError
from perchctl.flight import LoggedFlight, fly_all, fly_logged
from perchctl.log import summary_text
from perchctl.profile import Profile


def run_only(request: SimulateRequest) -> int:
    """Fly the seed, log it, and print the flight. Errors: NotFound, InvalidValue."""
    profile = request.loaded()
    fly = partial(fly_logged, profile, request.log_folder(profile), record=request.record)

    def report(flown: list[LoggedFlight], _problem: PerchError | None) -> None:
        for flight in flown:
            _tell(flight, profile, request.as_json)

    return fly_each(
        lambda executor, note: fly_all(fly, request.seeds, executor, note), request, report
    )


def _tell(flight: LoggedFlight, profile: Profile, as_json: bool) -> None:
    if not as_json:
        start_s = flight.events[0].t_s
        for event in flight.events:
            print(timed_event_text(event, start_s))
        print(summary_text(flight.summary, flight.log), flush=True)
    plot = None
    with contextlib.suppress(KeyboardInterrupt):  # the flight is flown, and is told all the same
        plot = plot_of(flight.log, profile)
    if as_json:
        lacks = {
            "lost_records": flight.summary.lost_records,
            "log_problem": flight.summary.log_problem,
        }
        files = {"log": str(flight.log), "plot": None if plot is None else str(plot)}
        print_record({"seed": flight.seed} | flight.summary.as_record() | lacks | files)
    elif plot is not None:
        print(f"plot:      {plot}")
