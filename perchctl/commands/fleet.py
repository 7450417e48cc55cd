"""`perchctl fleet`: plan, fly and simulate a fleet, and make fleet files from other programs'
lists."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import campaign as campaigns
from perchctl import check as checks
from perchctl import fleet as fleets
from perchctl import flight as flights
from perchctl.commands.check import exit_code as rows_exit_code
from perchctl.commands.check import format_rows
from perchctl.commands.command_line import (
    EXIT_TABLE,
    ForceOption,
    Group,
    JsonOption,
    ViewOption,
    command,
    new_app,
)
from perchctl.commands.fly_fleet import FleetSettings, fly_fleet, refuse_before_start
from perchctl.commands.interrupt import handle_signals, interruptible
from perchctl.commands.output import (
    add_problem,
    ask_to_confirm,
    print_lines,
    print_result,
    say,
    say_on_terminal,
)
from perchctl.commands.simulate import (
    ClusterOption,
    JobsOption,
    SeedOption,
    make_executor,
    print_faults,
    run_campaign,
    stop_handler,
)
from perchctl.errors import Interrupted, InvalidValue, PerchError, UsageError
from perchctl.files import check_output, write_files
from perchctl.wrapping import wrap_line

PLAN_COLUMNS = 80
PICTURE = "a drawing of the room"

FleetArgument = Annotated[
    str | None,
    typer.Argument(metavar="FLEET.yaml", help="Fleet file. Default: four simulated vehicles."),
]
PictureOption = Annotated[
    Path | None,
    typer.Option("--output", "-o", help="Also draw the room to this SVG file."),
]

app = new_app(Group)


@command(
    app,
    "perchctl fleet check",
    "perchctl fleet check atrium.yaml -o atrium.svg",
    "perchctl fleet check atrium.yaml --identify",
    short_help="Plan a fleet's flight, and reject plans that cannot be flown.",
)
def check(
    file: FleetArgument = None,
    output: PictureOption = None,
    identify: Annotated[
        bool,
        typer.Option(
            "--identify",
            help="Also verify, with the vehicles on the floor, that each one is matched to the "
            "right camera, motion-capture body and home position.",
        ),
    ] = False,
    as_json: JsonOption = False,
    force: ForceOption = False,
) -> int:
    """Plan, fly and simulate several vehicles in one room, and import other fleet files.

    By default (subcommand check), perchctl reads the fleet file, checks that each radio dongle can
    carry its vehicles, decides which vehicles fly together and in which order, and draws the room
    from above. It does not connect to anything. If the plan cannot be flown, perchctl still draws
    it, and states the reason in one sentence.

    With --identify, perchctl then connects to the vehicles one at a time and checks that each
    one is at its home. It does not arm any vehicle. The exit codes are the same as for
    perchctl check.
    """
    if output is not None:
        check_output(output, (".svg",), force, PICTURE)
    _say_reading(file)
    loaded = fleets.load_fleet(file or fleets.EXAMPLE_FLEET)
    refusal: InvalidValue | None = None
    plan: fleets.FleetPlan | None = None
    try:
        plan = fleets.make_plan(loaded)
    except InvalidValue as error:
        refusal = InvalidValue(f"{loaded.path}: {error}")
    for vehicle in loaded.vehicles:
        for row in checks.profile_rows(vehicle.profile):
            if row.name == "short address":
                say(f"{vehicle.name}: {row.found}: {row.advice}")
    groups = plan.schedule.groups if plan is not None else ()
    if output is not None:
        write_files({output: fleets.draw_svg(loaded, groups).encode()})
        say(f"wrote {output}")
    if plan is None and not as_json:
        print_lines(fleets.draw_text(loaded))
    if refusal is not None:
        raise refusal
    assert plan is not None, "a plan or its refusal"
    if identify:
        return identify_and_report(plan, as_json)
    print_result(plan.record() if as_json else plan_text(plan))
    return 0


def identify_and_report(plan: fleets.FleetPlan, as_json: bool) -> int:
    """Print the plan, and each vehicle's rows as soon as they are known; return the exit code of
    the first vehicle with a failing row. For each real vehicle, ask the user on the terminal."""
    real = [vehicle for vehicle in plan.fleet.vehicles if not vehicle.simulated]
    if real and not sys.stdin.isatty():
        raise UsageError(
            f"--identify asks you whether {real[0].name} is blinking, but the input is not a "
            f"terminal: run the command in a terminal"
        )
    if not as_json:
        print_result(plan_text(plan))
    found: dict[str, list[checks.Row]] = {vehicle.name: [] for vehicle in plan.fleet.vehicles}
    rows = fleets.identify_fleet(plan, checks.CheckScope(announce=say), ask_to_confirm)
    try:
        with interruptible():
            for name, row in rows:
                found[name].append(row)
    except KeyboardInterrupt:
        code = Interrupted.exit_code
        say("stopped by Ctrl-C: these are the checks made so far")
    except PerchError:
        if not as_json:
            print_lines(_identity_text(found, finished=False), stdout=True)
        raise
    else:
        code = next(filter(None, map(rows_exit_code, found.values())), 0)
    if as_json:
        records = {name: [asdict(row) for row in each] for name, each in found.items()}
        print_result(plan.record() | {"identified": records})
    else:
        print_result(_identity_text(found, finished=code != Interrupted.exit_code))
    return code


def _identity_text(found: dict[str, list[checks.Row]], *, finished: bool) -> str:
    return "\n".join(
        f"\n{name}\n{format_rows(rows, finished=finished)}" for name, rows in found.items() if rows
    )


@command(
    app,
    "perchctl fleet fly",
    "perchctl fleet fly atrium.yaml --dry-run",
    "perchctl fleet fly atrium.yaml --view",
    ending=EXIT_TABLE,
    short_help="Fly all vehicles of a fleet, in the order of its plan.",
)
def fly(
    file: FleetArgument = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Seed of the simulated fleet. Default: 11."),
    ] = None,
    log_dir: Annotated[
        Path | None,
        typer.Option("--log-dir", help="Folder in which to create the folder of this flight."),
    ] = None,
    record: Annotated[
        bool | None,
        typer.Option(
            "--record/--no-record",
            help="Record the images to MCAP files next to the logs. Default: only for real "
            "vehicles.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the plan without connecting to anything.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Arm without asking for confirmation.")
    ] = False,
    view: ViewOption = False,
    as_json: JsonOption = False,
) -> int:
    """Fly all vehicles of a fleet in the order of the plan, each one in its own process.

    No vehicle is armed until all of them are ready. Press Ctrl-C to land all vehicles except
    those that are hanging. Press it again to cut the motors. The space bar cuts the motors at once.
    To land a single vehicle, press its number. The exit code is 0 only if all vehicles are hanging
    at the end.
    """
    _say_reading(file)
    loaded = fleets.load_fleet(file or fleets.EXAMPLE_FLEET)
    try:
        plan = fleets.make_plan(loaded)
    except InvalidValue as error:
        if not as_json:
            print_lines(fleets.draw_text(loaded))
        raise InvalidValue(f"{loaded.path}: {error}") from None
    settings = FleetSettings(
        seed=flights.FlyOptions.seed if seed is None else seed,
        log_dir=log_dir,
        record=record,
        yes=yes,
        as_json=as_json,
        view=view,
    )
    if not dry_run:
        return fly_fleet(plan, settings)
    refused: PerchError | None = None
    try:
        refuse_before_start(plan, settings)
    except PerchError as error:
        refused = error
    print_result(add_problem(plan.record(), refused) if as_json else plan_text(plan))
    if refused is None:
        return 0
    say(f"perchctl fleet fly would refuse to start: {refused}")
    return refused.exit_code


def _say_reading(file: str | None) -> None:
    say_on_terminal("reading the example fleet" if file is None else f"reading fleet {file}")


def plan_text(plan: fleets.FleetPlan) -> str:
    """The plan as text: the room, which vehicles fly when and why some cannot fly together, and the
    radio."""
    schedule = plan.schedule
    rows = [("nearest", sentence) for sentence in plan.reassigned]
    rows += [("order", f"group {n}: {', '.join(g)}") for n, g in enumerate(schedule.groups, 1)]
    rows += [("not together", f"{c.first}, {c.second}: {c.why}") for c in schedule.conflicts]
    rows += [("first", f"{p.first} before {p.then}: {p.why}") for p in schedule.precedences]
    for load in plan.dongles:
        periods = {
            plan.fleet.vehicle(name).profile.link.telemetry_period_s for name in load.vehicles
        }
        rows.append(
            (
                f"dongle {load.dongle}",
                f"channel {load.channel}: {', '.join(load.vehicles)}; carries "
                f"{load.carries_per_s:.0f} packets/s for each, {load.needs_per_s:.0f} needed, "
                f"telemetry every {', '.join(f'{s * 1e3:g}' for s in sorted(periods))} ms",
            )
        )
    rows.append(("separation", f"at least {plan.separation_m:g} m between corridors in use"))
    return "\n".join(
        [
            fleets.draw_text(plan.fleet, schedule.groups),
            "",
            *(wrap_line(f"{name:<14}{text}", PLAN_COLUMNS, 14) for name, text in rows),
        ]
    )


@command(
    app,
    "perchctl fleet simulate -n 20 --jobs 2",
    "perchctl fleet simulate atrium.yaml -n 50 --seed 0 --json",
    "perchctl fleet simulate --faults all -n 200 --jobs 2 --out flown.jsonl",
)
def simulate(
    file: FleetArgument = None,
    fleets_flown: Annotated[
        int, typer.Option("-n", "--fleets", min=1, help="Number of seeds to fly.")
    ] = 10,
    seed: SeedOption = 0,
    jobs: JobsOption = None,
    faults: Annotated[
        str | None,
        typer.Option(
            "--faults",
            metavar="all|list|NAME,NAME",
            help="Inject a fault into one vehicle, or a common-cause fault into several, and judge "
            "all vehicles by the simulator's ground truth. Use list to print all faults.",
        ),
    ] = None,
    as_json: JsonOption = False,
    cluster: ClusterOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="JSONL file to which each result is written as its flight ends."
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume", help="Continue the --out file: fly only the seeds that are not in it yet."
        ),
    ] = False,
    force: ForceOption = False,
) -> int:
    """Fly a fleet of simulated vehicles in one room many times, faster than real time.

    Each vehicle flies as in perchctl simulate. They share one clock, feel each other's downwash,
    and fly in the order of the plan. perchctl reports how their flights ended, how close they came
    to each other, and what went wrong according to the simulator's ground truth.
    """
    if faults == "list":
        say_on_terminal("listing the faults")
        return print_faults(fleets.fleet_faults(), as_json)
    if resume and out is None:
        raise UsageError("--resume continues a results file: name it with --out")
    _say_reading(file)
    loaded = fleets.load_fleet(file or fleets.EXAMPLE_FLEET)
    names = () if faults is None else fleets.select_fleet_faults(faults)
    try:
        plan = fleets.make_plan(loaded)
    except InvalidValue as error:
        raise InvalidValue(f"{loaded.path}: {error}") from None
    profiles = [vehicle.profile for vehicle in plan.fleet.vehicles]
    seeds = range(seed, seed + fleets_flown)
    flyers = make_executor(jobs, cluster, profiles, fleets_flown)
    fly = partial(fleets.fly_fleet, plan, names)

    def report(results: list[Any], problem: PerchError | None) -> None:
        figures = add_problem(fleets.fleet_summary(results), problem) if as_json else None
        print_result(figures or fleets.fleet_table(results))

    with (
        handle_signals(stop_handler()),
        campaigns.campaign_results(
            profiles[0],
            seeds,
            fleets.FleetResult,
            faults=names or None,
            fleet=fleets.plan_sha256(plan),
            out=out,
            resume=resume,
            force=force,
        ) as kept,
    ):
        return run_campaign(
            lambda executor, note: campaigns.fly_all(fly, kept.remaining, executor, note),
            report,
            len(seeds),
            flyers,
            kept.earlier,
            kept.write_result,
            unit="fleets",
        )


@command(
    app,
    "perchctl fleet convert crazyflies.yaml -o fleet.yaml",
    "perchctl fleet convert ~/.config/cf-cli/swarms/lab.yaml",
    "perchctl fleet convert lab.yaml -o lab_fleet.yaml --force",
)
def convert(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Crazyswarm2's crazyflies.yaml, or a swarm file from cfcli or Swarmkeeper.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Fleet file to write.")] = Path(
        "fleet.yaml"
    ),
    force: ForceOption = False,
) -> None:
    """Make a fleet file from Crazyswarm2's or cfcli's list of Crazyflies.

    perchctl copies names, URIs and, from Crazyswarm2, initial positions and motion-capture bodies.
    These lists contain no targets or cameras: add them to the fleet file.
    """
    say_on_terminal(f"reading {file}")
    found = fleets.convert_fleet(file)
    check_output(output, (".yaml", ".yml"), force, "a fleet file")
    write_files({output: found.text().encode()})
    if found.skipped:
        say(f"left out because they are switched off: {', '.join(found.skipped)}")
    count = len(found.vehicles)
    print(f"wrote {output}: {count} vehicle{'s' if count > 1 else ''}")
    defaults = found.missing_defaults
    to_defaults = f"add {', '.join(defaults)} to defaults, and " if defaults else "add "
    print(
        f"{to_defaults}{', '.join(found.missing)} to each vehicle, then run: "
        f"perchctl fleet check {shlex.quote(str(output))}"
    )
