"""The command line: parse, load the profile, one call, an exit code."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from perchctl import __version__
from perchctl.errors import EXIT_CODES, Interrupted, PerchError, UsageError

EXIT_TABLE = "Exit codes:\n\n" + "\n\n".join(
    f"{code:>3}  {meaning}" for code, meaning in sorted(EXIT_CODES.items())
)

app = typer.Typer(
    name="perchctl",
    help="Hang a Crazyflie onto a ceiling by the sight of a printed target.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


@contextlib.contextmanager
def reported() -> Iterator[None]:
    """Turns every failure into one sentence on stderr and its exit code."""
    try:
        yield
    except typer.Exit:
        raise
    except PerchError as error:
        print(f"perchctl: {error}", file=sys.stderr)
        raise typer.Exit(error.exit_code) from None
    except KeyboardInterrupt:
        print("perchctl: Ctrl-C", file=sys.stderr)
        raise typer.Exit(Interrupted.exit_code) from None
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(PerchError.exit_code) from None
    except Exception as error:
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        print(
            f"perchctl: unforeseen {type(error).__name__}: {error} "
            f"(PERCHCTL_DEBUG=1 shows where; please report it)",
            file=sys.stderr,
        )
        raise typer.Exit(PerchError.exit_code) from None


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"perchctl {__version__}")
        raise typer.Exit


@app.callback()
def _top(
    version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_print_version, is_eager=True, help="Version."),
    ] = False,
) -> None:
    pass


ProfileOption = Annotated[
    str, typer.Option("--profile", "-p", help="Profile by name or path.", show_default=True)
]


@app.command(epilog=EXIT_TABLE)
def fly(
    profile: ProfileOption = "sim",
    uri: Annotated[
        str | None,
        typer.Option(
            "--uri",
            "-u",
            envvar="CFLIB_URI",
            help="Vehicle: sim://, radio://0/80/2M/E7E7E7E7E7, usb://0, udp://HOST:PORT.",
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option(
            "--source", help="Camera: camera:N, video:FILE, images:DIR, http://..., sim:."
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the simulated scenario.")] = 0,
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder for the flight log and its plot.")
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the resolved plan; connect nothing.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask before arming.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on stdout at the end.")
    ] = False,
) -> None:
    """Fly the seven phases: find the target, align, ascend, perch, stop the motors.

    Without options it flies the simulated vehicle. Ctrl-C once lands, twice cuts the motors.
    """
    with reported():
        from perchctl import flying

        options = flying.resolve(profile, uri, source, seed, log_dir)
        if dry_run:
            print(flying.plan_json(options) if as_json else flying.plan_text(options))
            return
        if not (yes or options.simulated):
            _ask_before_arming(options.uri)
        code = flying.run(options, as_json=as_json)
        raise typer.Exit(code)


def _ask_before_arming(uri: str) -> None:
    if not sys.stdin.isatty():
        raise UsageError(f"about to arm {uri}, and there is nobody to ask: add --yes")
    answer = input(f"About to arm and fly {uri}. Is the space under the target clear? [y/N] ")
    if answer.strip().lower() not in ("y", "yes"):
        raise UsageError("not confirmed: nothing was started")


@app.command()
def simulate(
    flights: Annotated[int, typer.Option("-n", "--flights", min=1, help="How many.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the first flight.")] = 0,
    jobs: Annotated[int, typer.Option("--jobs", "-j", min=1, help="Flights at a time.")] = 1,
    only: Annotated[
        int | None, typer.Option("--only", min=0, help="Repeat the one flight of this seed.")
    ] = None,
    profile: ProfileOption = "sim",
    log_dir: Annotated[
        Path | None, typer.Option("--log-dir", help="Folder for the log of an --only flight.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Fly many seeded scenarios in lockstep, faster than real time, and count."""
    with reported():
        from perchctl import simulating

        simulating.run(
            profile,
            seeds=[only] if only is not None else list(range(seed, seed + flights)),
            jobs=jobs,
            log_dir=log_dir if only is not None else None,
            as_json=as_json,
        )


def main() -> Any:
    """Entry point of the console script."""
    try:
        return app()
    except KeyboardInterrupt:
        print("perchctl: Ctrl-C", file=sys.stderr)
        return Interrupted.exit_code
