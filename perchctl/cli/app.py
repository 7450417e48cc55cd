"""What the subcommands share: the application, its failures as sentences, common options."""

from __future__ import annotations

import contextlib
import os
import sys
import warnings
from collections.abc import Iterator
from typing import Annotated, Any, TextIO

import typer

from perchctl import __version__
from perchctl.errors import EXIT_CODES, Interrupted, PerchError, ProfileNote

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

ProfileOption = Annotated[
    str, typer.Option("--profile", "-p", help="Profile by name or path.", show_default=True)
]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
ViewOption = Annotated[
    bool, typer.Option("--view", help="Serve a live page on 127.0.0.1 and print its address.")
]
ViewPortOption = Annotated[
    int,
    typer.Option("--view-port", min=0, max=65535, help="Port of the live page; 0: any free one."),
]
CamOption = Annotated[
    str | None,
    typer.Option("--cam", help="Which camera of a Kalibr file of several: cam0, cam1, ..."),
]


def main() -> Any:
    """Entry point of the console script."""
    try:
        return app()
    except KeyboardInterrupt:
        _complain("Ctrl-C")
        return Interrupted.exit_code


@contextlib.contextmanager
def reported() -> Iterator[None]:
    """Turns every failure into one sentence on stderr and its exit code, and each note on
    the profile into one sentence."""
    try:
        with _profile_notes():
            yield
    except typer.Exit:
        raise
    except PerchError as error:
        _complain(str(error))
        raise typer.Exit(error.exit_code) from None
    except KeyboardInterrupt:
        _complain("Ctrl-C")
        raise typer.Exit(Interrupted.exit_code) from None
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(PerchError.exit_code) from None
    except Exception as error:
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        _complain(
            f"unforeseen {type(error).__name__}: {error} "
            f"(PERCHCTL_DEBUG=1 shows where; please report it)"
        )
        raise typer.Exit(PerchError.exit_code) from None


@contextlib.contextmanager
def _profile_notes() -> Iterator[None]:
    """Prints each different `ProfileNote` once; other warnings go where they went before."""
    printed: set[str] = set()

    with warnings.catch_warnings():
        warnings.simplefilter("always", ProfileNote)
        show_others = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, ProfileNote):
                show_others(message, category, filename, lineno, file, line)
            elif str(message) not in printed:
                printed.add(str(message))
                _complain(str(message))

        warnings.showwarning = show
        yield


def _complain(sentence: str) -> None:
    with contextlib.suppress(OSError):  # a terminal that is closed keeps the exit code
        print(f"perchctl: {sentence}", file=sys.stderr, flush=True)


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
