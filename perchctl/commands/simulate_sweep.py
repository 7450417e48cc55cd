"""The work behind `perchctl simulate --sweep`: a table of cells."""

from __future__ import annotations

from perchctl.commands.output import print_record, say
from perchctl.commands.simulate_request import SimulateRequest, and_problem, fly_each
from perchctl.errors import PerchError
from perchctl.flight import (
    VariantResult,
    fly_variants,
    sweep_grid,
    sweep_record,
    sweep_results,
    sweep_text,
    whole_seeds,
)


def run_sweep(request: SimulateRequest) -> int:
    """Fly each seed in each cell and print. Errors: NotFound, InvalidValue, UsageError."""
    grid = sweep_grid(request.loaded(), request.sweep)
    profiles = [cell.profile for cell in grid.cells]
    flights = len(profiles) * len(request.seeds)
    say(f"{len(profiles)} cells of {len(request.seeds)} seeds are {flights} flights")

    def report(results: list[VariantResult], problem: PerchError | None) -> None:
        found = sweep_results(grid, whole_seeds(results, len(profiles)))
        if request.as_json:
            print_record(and_problem(sweep_record(found), problem))
        else:
            print(sweep_text(found), flush=True)

    return fly_each(
        lambda executor, note: fly_variants(profiles, request.seeds, executor, note),
        request,
        report,
        flights=flights,
        profiles=profiles,
    )
