"""`perchctl simulate`: count the outcomes of seeded flights, compare two profiles, or sweep a
key."""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import analysis
from perchctl import campaign as campaigns
from perchctl import faults as fault_campaigns
from perchctl import profile as profiles
from perchctl.commands.command_line import (
    ForceOption,
    Group,
    JsonOption,
    PositioningOption,
    ProfileOption,
    command,
    new_app,
)
from perchctl.commands.fly import with_positioning
from perchctl.commands.interrupt import handle_signals
from perchctl.commands.output import add_problem, print_result, say, say_on_terminal
from perchctl.errors import (
    Interrupted,
    LogIncomplete,
    PerchError,
    UsageError,
    no_cluster,
)
from perchctl.wrapping import wrap_line

CAMPAIGN_SAME_PRESS_S = 0.5
"""Shortest time after the first Ctrl-C at which a second one counts, s. Presses that are closer
together count as one."""
_NO_DIFFERENCE = ("name", "description", "date")


FlightsOption = Annotated[
    int, typer.Option("-n", "--flights", min=1, help="Number of seeds to fly.")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="First seed.")]
JobsOption = Annotated[
    int | None, typer.Option("--jobs", "-j", min=1, help="Number of parallel flights. Default: 1.")
]
ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Fly on the workers of a Dask scheduler, such as tcp://10.0.0.5:8786.",
    ),
]
app = new_app(Group)


@command(
    app,
    "perchctl simulate -n 100 --jobs 4",
    "perchctl simulate -n 1 --seed 17 --log-dir logs",
    "perchctl simulate --faults all -n 1000 --jobs 4 --out flown.jsonl",
)
def run(
    flights: FlightsOption = 10,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
    profile: ProfileOption = "sim",
    faults: Annotated[
        str | None,
        typer.Option(
            "--faults",
            metavar="all|list|NAME,NAME",
            help="Inject a fault into each flight, and judge the outcome by the simulator's ground "
            "truth. Use list to print all faults.",
        ),
    ] = None,
    positioning: PositioningOption = None,
    as_json: JsonOption = False,
    cluster: ClusterOption = None,
    log_dir: Annotated[
        Path | None,
        typer.Option("--log-dir", help="Write the flight logs to this folder."),
    ] = None,
    record: Annotated[
        bool,
        typer.Option(
            "--record",
            help="Record the images to an MCAP file next to each log.",
        ),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="JSONL file to which each result is written as its flight ends."
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue the --out file: fly only the seeds that are not in it yet.",
        ),
    ] = False,
    force: ForceOption = False,
) -> int:
    """Simulate many seeded flights, faster than real time, and count the outcomes."""
    if faults == "list":
        say_on_terminal("listing the faults")
        return print_faults(
            {fault.name: fault.description for fault in fault_campaigns.FAULTS}, as_json
        )
    if record and log_dir is None:
        raise UsageError(
            "--record writes its files next to the flight logs: name their folder with --log-dir"
        )
    if resume and out is None:
        raise UsageError("--resume continues a results file: name it with --out")
    say_on_terminal(f"reading profile {profile}")
    flown = with_positioning(profiles.load_profile(profile), positioning)
    if cluster is not None and log_dir is not None:
        log_dir = log_dir.absolute()  # workers run in other folders
    seeds = range(seed, seed + flights)
    flyers = make_executor(jobs, cluster, [flown], flights)
    if faults is None:
        names = None
        campaign = _Campaign(
            campaigns.FlightResult,
            partial(campaigns.fly_in_folder, flown, log_dir, record),
            campaigns.campaign_summary,
            campaigns.campaign_table,
            lambda results: campaigns.all_refused_error(results) or log_error(results),
        )
    else:
        names = tuple(fault.name for fault in fault_campaigns.select_faults(faults))
        campaign = _Campaign(
            fault_campaigns.FaultResult,
            partial(fault_campaigns.fly_fault_in_folder, flown, names, log_dir, record),
            fault_campaigns.fault_summary,
            fault_campaigns.fault_table,
            log_error,
        )

    def report(results: list[Any], problem: PerchError | None) -> None:
        figures = add_problem(campaign.summary(results), problem) if as_json else None
        print_result(figures or campaign.table(results))
        print_log_folder(results, log_dir)
        lost = log_error(results)
        if lost is not None and not isinstance(problem, LogIncomplete):
            say(str(lost))

    with (
        handle_signals(stop_handler()),
        campaigns.campaign_results(
            flown,
            seeds,
            campaign.kind,
            faults=names,
            out=out,
            resume=resume,
            force=force,
            log_dir=log_dir,
        ) as kept,
    ):
        return run_campaign(
            lambda executor, note: campaigns.fly_all(campaign.fly, kept.remaining, executor, note),
            report,
            len(seeds),
            flyers,
            kept.earlier,
            kept.write_result,
            campaign.objection,
        )


@dataclass(frozen=True)
class _Campaign:
    kind: type[Any]
    fly: Callable[[int], Any]
    summary: Callable[[list[Any]], Mapping[str, Any]]
    table: Callable[[list[Any]], str]
    objection: Callable[[list[Any]], PerchError | None]


@command(
    app,
    "perchctl simulate compare sim paper -n 60 --jobs 4",
    "perchctl simulate compare mine.yaml changed.yaml -n 200 --jobs 4",
    "perchctl simulate compare sim rough --positioning mocap --json",
)
def compare(
    profile_a: Annotated[
        str,
        typer.Argument(metavar="PROFILE_A", help="First profile, by name or path."),
    ],
    profile_b: Annotated[
        str,
        typer.Argument(metavar="PROFILE_B", help="Second profile, by name or path."),
    ],
    flights: FlightsOption = 10,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    positioning: PositioningOption = None,
    as_json: JsonOption = False,
) -> int:
    """Fly every seed with two profiles, and report which differences are significant."""
    names = (profile_a, profile_b)
    say_on_terminal(f"reading profiles {profile_a} and {profile_b}")
    pair = [with_positioning(profiles.load_profile(name), positioning) for name in names]
    keys = analysis.profile_differences(*(p.model_dump(mode="json") for p in pair))
    keys = {key: values for key, values in keys.items() if key not in _NO_DIFFERENCE}

    def report(results: list[campaigns.FlightResult], problem: PerchError | None) -> None:
        found = campaigns.compare_variants(results)
        if as_json:
            differences = {key: {"a": a, "b": b} for key, (a, b) in keys.items()}
            record = {"a": profile_a, "b": profile_b, **found, "profile": differences}
            print_result(add_problem(record, problem))
            return
        print(campaigns.comparison_text(names, found))
        for key, (a, b) in keys.items():
            print(f"differs: {key} is {a} in A, {b} in B")
        if not keys:
            print("the profiles do not differ")

    return _fly_by_each(pair, range(seed, seed + flights), jobs, cluster, report)


@command(
    app,
    "perchctl simulate sweep planner.align.xy_m=0.02,0.04,0.08 -n 30",
    "perchctl simulate sweep planner.integral_per_s=0,0.4 -n 30 --jobs 4",
    "perchctl simulate sweep planner.ascend.speed_mps=0.1,0.2 --json",
)
def sweep(
    values: Annotated[
        str,
        typer.Argument(metavar="KEY=VALUE,VALUE", help="Profile key and the values to try."),
    ],
    profile: ProfileOption = "sim",
    flights: FlightsOption = 10,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
    cluster: ClusterOption = None,
    positioning: PositioningOption = None,
    as_json: JsonOption = False,
) -> int:
    """Fly the same seeds with several values of a profile key, and report the best."""
    say_on_terminal(f"reading profile {profile}")
    asked = campaigns.make_sweep(
        with_positioning(profiles.load_profile(profile), positioning), values
    )

    def report(results: list[campaigns.FlightResult], problem: PerchError | None) -> None:
        record = asked.record(results)
        print_result(add_problem(record, problem) if as_json else asked.text(record))

    return _fly_by_each(asked.profiles, range(seed, seed + flights), jobs, cluster, report)


def _fly_by_each(
    flown: Sequence[profiles.Profile],
    seeds: Sequence[int],
    jobs: int | None,
    cluster: str | None,
    report: Callable[[list[campaigns.FlightResult], PerchError | None], None],
) -> int:
    with handle_signals(stop_handler()):
        return run_campaign(
            lambda executor, note: campaigns.fly_variants(flown, seeds, executor, note),
            report,
            len(flown) * len(seeds),
            make_executor(jobs, cluster, flown, len(flown) * len(seeds)),
        )


# --- Run a campaign with an executor ---


def make_executor(
    jobs: int | None, cluster: str | None, flown: Sequence[profiles.Profile], flights: int
) -> AbstractContextManager[Executor]:
    """Return the executor for a campaign: processes on this computer, or the workers of a cluster,
    which must have the files of the profiles in `flown`. Errors: UsageError."""
    if cluster is None:
        return campaigns.flight_processes(max(1, min(jobs or 1, flights)))
    if jobs is not None:
        raise UsageError(
            f"--cluster {cluster} runs as many flights at a time as it has workers, so "
            f"--jobs {jobs} does not apply: leave out one of the two"
        )
    if find_spec("distributed") is None:
        raise no_cluster()
    try:
        with campaigns.defer_interrupts():
            from perchctl.campaign import cluster_pool
    except ImportError as error:
        raise no_cluster(str(error)) from error
    return cluster_pool(cluster, flown)


def run_campaign(
    campaign: Callable[[Executor, Callable[[Any], None]], object],
    report: Callable[[list[Any], PerchError | None], None],
    total: int,
    executor_context: AbstractContextManager[Executor],
    earlier: Sequence[Any] = (),
    store_result: Callable[[Any], None] = lambda result: None,
    find_error: Callable[[list[Any]], PerchError | None] = lambda results: None,
    unit: str = "flights",
) -> int:
    """Fly a campaign of `total` flights (or other units of work, named by `unit`); return the exit
    code. However the campaign ends, the results so far are reported.

    `campaign` gets the executor and the function to call with each result; `report` gets the
    results, and the error if there is one. `earlier` results are counted as well; `store_result`
    writes each new result. `find_error` returns an error that concerns the results as a whole, or
    None.
    Errors: PerchError if no flight was flown.
    """
    from perchctl.commands.progress import progress_bar

    results = list(earlier)
    problem: PerchError | None = None
    begun = False
    try:
        with (
            contextlib.suppress(KeyboardInterrupt),
            executor_context as executor,
            progress_bar(total, list(results), unit=unit) as advance,
        ):
            begun = True

            def note(result: Any) -> None:
                with campaigns.defer_interrupts():
                    results.append(result)
                    store_result(result)
                    advance(result)

            campaign(executor, note)
    except PerchError as error:
        if not begun:
            raise
        problem = error
    flown = f"{len(results)} of {total} {unit} were flown"
    if problem is None and len(results) < total:
        problem = Interrupted(f"stopped: {flown}")
    elif problem is not None:
        problem.args = (f"{problem}; {flown}",)
    if problem is not None and not results:
        raise problem
    problem = problem or find_error(results)
    report(sorted(results, key=lambda result: result.seed), problem)
    if problem is None:
        return 0
    say(str(problem))
    return problem.exit_code


def stop_handler(
    clock: Callable[[], float] = time.monotonic, exit_process: Callable[[int], object] = os._exit
) -> Callable[[int, FrameType | None], None]:
    """Return a signal handler: the first signal raises KeyboardInterrupt; a signal at least
    `CAMPAIGN_SAME_PRESS_S` later exits at once."""
    first_s: list[float] = []

    def press(_number: int, _frame: FrameType | None) -> None:
        if not first_s:
            first_s.append(clock())
            raise KeyboardInterrupt
        if clock() - first_s[0] >= CAMPAIGN_SAME_PRESS_S:
            exit_process(Interrupted.exit_code)

    return press


# --- What is printed ---


def print_log_folder(results: Sequence[campaigns.CampaignFlight], log_dir: Path | None) -> None:
    """Print on stderr the folder of the logs."""
    if log_dir is not None and results:
        say(f"the flights' logs are in {log_dir}")


def log_error(results: Sequence[campaigns.CampaignFlight]) -> PerchError | None:
    """Return an error if some of the flights' logs are incomplete; None if all are complete."""
    problems = [result.log_problem for result in results if result.log_problem is not None]
    if not problems:
        return None
    return LogIncomplete(f"{len(problems)} of {len(results)} logs are incomplete: {problems[0]}")


def print_faults(faults: Mapping[str, str], as_json: bool) -> int:
    """Print the name and the description of each fault; returns the exit code."""
    indent, columns = 2 + max(map(len, faults)), shutil.get_terminal_size().columns
    table = "\n".join(
        wrap_line(f"{name:<{indent}}{text}", columns, indent) for name, text in faults.items()
    )
    print_result({"faults": dict(faults)} if as_json else table)
    return 0
