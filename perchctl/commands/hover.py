"""`perchctl hover`: hover below the target for some time, and land."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import flight as flights
from perchctl import profile as profiles
from perchctl.commands.command_line import (
    EXIT_TABLE,
    JsonOption,
    PositioningOption,
    ProfileOption,
    SourceOption,
    UriOption,
    ViewOption,
    command,
    new_app,
)
from perchctl.commands.fly import (
    DryRunOption,
    LogDirOption,
    RecordOption,
    SeedOption,
    YesOption,
    plan_or_fly,
    resolve_options,
)
from perchctl.commands.output import say_on_terminal

app = new_app()


@command(
    app,
    "perchctl hover",
    "perchctl hover -p my_vehicle.yaml --below 0.8 --dry-run",
    "perchctl hover -p my_vehicle.yaml -u radio://0/80/2M/E7E7E7E7E7 --view",
    ending=EXIT_TABLE,
)
def hover(
    profile: ProfileOption = "sim",
    below: Annotated[
        float | None,
        typer.Option(
            "--below",
            min=0.2,
            max=2.0,
            help="Distance of the gear below the target, m. Default: as in the profile, or 0.5.",
        ),
    ] = None,
    duration: Annotated[
        float | None,
        typer.Option(
            "--time",
            min=1.0,
            max=300.0,
            help="Duration of the hover, s. Default: as in the profile, or 20.",
        ),
    ] = None,
    uri: UriOption = None,
    source: SourceOption = None,
    positioning: PositioningOption = None,
    seed: SeedOption = None,
    log_dir: LogDirOption = None,
    record: RecordOption = None,
    dry_run: DryRunOption = False,
    yes: YesOption = False,
    as_json: JsonOption = False,
    view: ViewOption = False,
) -> int:
    """Hover below the target for a set time, land, and report the position error.

    Hover before the first perch to check the camera, its mounting and the tuning: the vehicle
    finds the target, aligns and climbs as in a perching flight, but stays away from the ceiling.
    The exit code is 0 only if the vehicle hovered for the whole time and then landed. Ctrl-C and
    the space bar work as in `perchctl fly`.
    """
    say_on_terminal(f"reading profile {profile}")
    options = resolve_options(profile, uri, source, positioning, seed, log_dir, record)
    options = with_hover(options, below, duration)
    return plan_or_fly(options, dry_run=dry_run, yes=yes, as_json=as_json, view=view)


def with_hover(
    options: flights.FlyOptions, below_m: float | None, duration_s: float | None
) -> flights.FlyOptions:
    """Return the options for a hover; arguments that are None leave the profile's values. Errors:
    InvalidValue."""
    profile = options.profile
    if profile.planner.hover is None:
        profile = profile.with_({"planner.hover": dict(profiles.HoverConfig())})
    given = {"planner.hover.below_m": below_m, "planner.hover.duration_s": duration_s}
    changes = {key: value for key, value in given.items() if value is not None}
    return replace(options, profile=profile.with_(changes))
