"""What the subcommands share: the application, its failures as sentences, common options."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NoReturn, ParamSpec, TextIO

import typer
from typer.core import TyperGroup

from perchctl import __version__
from perchctl.commands.cli.complete import (
    complete_log,
    complete_positioning,
    complete_profile,
    complete_source,
)
from perchctl.errors import (
    EXIT_CODES,
    Interrupted,
    InvalidValue,
    Note,
    PerchError,
    UsageError,
)
from perchctl.startup import failure_record, loaded

# \b keeps the lines of a paragraph as they are.
EXIT_TABLE = "\b\nExit codes:\n" + "\n".join(
    f"{code:>5}  {meaning}" for code, meaning in sorted(EXIT_CODES.items())
)
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_BAD_PLACE = (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.ENOTDIR)


class _Commands(TyperGroup):
    """Wrong usage is told by the object of `--json`, too."""

    def invoke(self, ctx: Any) -> Any:
        as_json = "--json" in ctx.args
        try:
            return super().invoke(ctx)
        except Exception as error:
            tell = getattr(error, "format_message", None)
            if as_json and tell is not None:
                _print_failure(tell(), getattr(error, "exit_code", UsageError.exit_code))
            raise


# Without rich's panels: they cut what is longer than a cell, and leave a narrow one for it.
app = typer.Typer(
    name="perchctl",
    cls=_Commands,
    help="Hang a Crazyflie onto a ceiling by the sight of a printed target.",
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

ProfileOption = Annotated[
    str,
    typer.Option(
        "--profile", "-p", help="Profile by name or path.", autocompletion=complete_profile
    ),
]
UriOption = Annotated[
    str | None,
    typer.Option(
        "--uri",
        "-u",
        envvar="CFLIB_URI",
        help="Vehicle: sim://, radio://0/80/2M/E7E7E7E7E7, usb://0, udp://HOST:PORT.",
    ),
]
SourceOption = Annotated[
    str | None,
    typer.Option(
        "--source",
        help="Camera: camera:N or camera:NAME, rtsp://..., http://..., aideck://HOST, video:FILE, "
        "images:DIR, sim:.",
        autocompletion=complete_source,
    ),
]
PositioningOption = Annotated[
    str | None,
    typer.Option(
        "--positioning",
        help="What measures the position: deck, mocap or target; by default the profile's.",
        autocompletion=complete_positioning,
    ),
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
LogArgument = Annotated[
    Path | None,
    typer.Argument(help="A flight log; by default the newest.", autocompletion=complete_log),
]
LogProfileOption = Annotated[
    str | None,
    typer.Option(
        "--profile",
        "-p",
        help="Whose log.directory holds the newest log; by default sim's.",
        autocompletion=complete_profile,
    ),
]
LogDirOption = Annotated[
    Path | None, typer.Option("--log-dir", help="The folder that holds the newest log instead.")
]
CamOption = Annotated[
    str | None,
    typer.Option("--cam", help="Which camera of a Kalibr file of several: cam0, cam1, ..."),
]


def main() -> Any:
    """Run the command line; returns the exit code."""
    code: Any = 0
    try:
        try:
            app()
        except SystemExit as end:
            code = end.code
        sys.stdout.flush()
    except KeyboardInterrupt:
        _complain("Ctrl-C")
        return Interrupted.exit_code
    except BrokenPipeError:
        _drop_stdout()
        return PerchError.exit_code
    except OSError as error:
        sentence = _place_refused(error)
        if sentence is None:
            raise
        _drop_stdout()
        _complain(sentence)
        return InvalidValue.exit_code
    finally:
        # A key that is still held down must not end what is over with a traceback.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return code


P = ParamSpec("P")


def perform(run: Callable[P, int], *args: P.args, **kwargs: P.kwargs) -> NoReturn:
    """Do the command's work, its libraries being loaded, and leave with its exit code."""
    loaded()
    code = run(*args, **kwargs)
    sys.stdout.flush()  # a full disk or a closed pipe shows here, not after the last line
    raise typer.Exit(code)


@contextlib.contextmanager
def reported(as_json: bool = False) -> Iterator[None]:
    """Turns every failure into one sentence on stderr, an object on stdout where one is
    wanted, and its exit code, and each note on the profile into one sentence."""
    try:
        with _notes():
            yield
    except typer.Exit:
        raise
    except PerchError as error:
        _leave(str(error), error.exit_code, as_json)
    except KeyboardInterrupt:
        _leave("Ctrl-C", Interrupted.exit_code, as_json)
    except BrokenPipeError:
        _drop_stdout()
        raise typer.Exit(PerchError.exit_code) from None
    except Exception as error:
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        sentence = _place_refused(error)
        if sentence is not None:
            if not getattr(error, "filename", None):
                _drop_stdout()
            _leave(sentence, InvalidValue.exit_code, as_json)
        _leave(
            f"unforeseen {type(error).__name__}: {error} "
            f"(PERCHCTL_DEBUG=1 shows where; please report it)",
            PerchError.exit_code,
            as_json,
        )


def _leave(sentence: str, code: int, as_json: bool) -> NoReturn:
    _complain(sentence)
    if as_json:
        _print_failure(sentence, code)
    raise typer.Exit(code) from None


def _print_failure(sentence: str, code: int) -> None:
    try:
        print(failure_record(sentence, code), flush=True)
    except OSError:
        _drop_stdout()


def _drop_stdout() -> None:
    """What is left in the buffer must not fail again at the program's end."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _place_refused(error: Exception) -> str | None:
    """The operating system's refusal of a place, of which nobody closer has told; a full disk
    has the same exit code everywhere."""
    if not isinstance(error, OSError):
        return None
    if error.errno in _NO_ROOM:
        place = error.filename or "the result"
        return f"{place} cannot be written: {error.strerror}: free some space"
    if error.errno in _BAD_PLACE and error.filename:
        name = str(error.filename)
        shown = name if len(name) <= 200 else f"{name[:197]}..."
        return f"{shown} cannot be used: {error.strerror}: choose another place"
    return None


@contextlib.contextmanager
def _notes() -> Iterator[None]:
    """Prints each different `Note` once; other warnings go where they went before."""
    printed: set[str] = set()

    with warnings.catch_warnings():
        warnings.simplefilter("always", Note)
        show_others = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if not issubclass(category, Note):
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


@app.callback(invoke_without_command=True)
def _top(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option("--version", "-V", callback=_print_version, is_eager=True, help="Version."),
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())
