"""`perchctl fleet`: the plan of a fleet's flight, and fleet files from other programs' lists."""

from __future__ import annotations

import shlex
import textwrap
from pathlib import Path
from typing import Annotated

import typer

# By its package, whose names load as they are used.
from perchctl import fleet as fleets
from perchctl.commands.command_line import ForceOption, Group, JsonOption, command, new_app
from perchctl.commands.output import print_lines, print_result, say
from perchctl.errors import InvalidValue
from perchctl.files import check_output, write_files

PLAN_COLUMNS = 80
PICTURE = "how the room is drawn"

FleetArgument = Annotated[
    str | None,
    typer.Argument(metavar="[FLEET.yaml]", help="Fleet file. Default: four simulated vehicles."),
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
    "perchctl fleet check atrium.yaml --json",
    short_help="Plan a fleet's flight, and refuse what cannot be flown.",
)
def check(
    file: FleetArgument = None,
    output: PictureOption = None,
    as_json: JsonOption = False,
    force: ForceOption = False,
) -> None:
    """Plan the flight of several vehicles in one room, and convert lists of other programs.

    By default (check), perchctl reads the fleet file, checks that each radio dongle can carry its
    vehicles, decides who flies together and in which order, and draws the room from above. It
    connects to nothing. A plan that cannot be flown is drawn too, and refused in one sentence.
    """
    if output is not None:
        check_output(output, (".svg",), force, PICTURE)
    loaded = fleets.load_fleet(file or fleets.EXAMPLE)
    refusal: InvalidValue | None = None
    plan: fleets.FleetPlan | None = None
    try:
        plan = fleets.make_plan(loaded)
    except InvalidValue as error:
        refusal = InvalidValue(f"{loaded.path}: {error}")
    groups = plan.schedule.groups if plan is not None else ()
    if output is not None:
        write_files({output: fleets.draw_svg(loaded, groups).encode()})
        say(f"wrote {output}")
    if plan is None and not as_json:
        print_lines(fleets.draw_text(loaded))
    if refusal is not None:
        raise refusal
    if plan is not None:
        print_result(plan.record() if as_json else plan_text(plan))


def plan_text(plan: fleets.FleetPlan) -> str:
    """The plan for people: the room, who flies when and why not together, and the radio."""
    schedule = plan.schedule
    rows = [("order", f"group {n}: {', '.join(g)}") for n, g in enumerate(schedule.groups, 1)]
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
            *(
                textwrap.fill(
                    f"{name:<14}{text}",
                    PLAN_COLUMNS,
                    subsequent_indent=" " * 14,
                    break_on_hyphens=False,
                )
                for name, text in rows
            ),
        ]
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
            help="Crazyswarm2's crazyflies.yaml, or a swarm of cfcli or Swarmkeeper.",
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Fleet file to write.")] = Path(
        "fleet.yaml"
    ),
    force: ForceOption = False,
) -> None:
    """Make a fleet file from Crazyswarm2's or cfcli's list of Crazyflies.

    perchctl takes names, URIs and, from Crazyswarm2, initial positions and motion-capture bodies.
    Targets and cameras are not in these lists: you add them to the fleet file.
    """
    check_output(output, (".yaml", ".yml"), force, "what a fleet file is")
    found = fleets.convert_fleet(file)
    write_files({output: found.text().encode()})
    if found.skipped:
        say(f"left out, as they are switched off: {', '.join(found.skipped)}")
    count = len(found.vehicles)
    print(f"wrote {output}: {count} vehicle{'s' if count > 1 else ''}")
    print(
        f"add {', '.join(found.missing)} to each vehicle, then run: "
        f"perchctl fleet check {shlex.quote(str(output))}"
    )
