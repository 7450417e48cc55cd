"""Code shared by the subcommands: the application, common options, and errors reported as
sentences."""

from __future__ import annotations

import contextlib
import copy
import difflib
import errno
import functools
import importlib
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Annotated, Any, NoReturn, ParamSpec

import typer
from typer.core import TyperCommand, TyperGroup

from perchctl import __version__
from perchctl.commands.output import discard_output, say
from perchctl.errors import (
    EXIT_CODES,
    Interrupted,
    InvalidValue,
    Note,
    PerchError,
    UsageError,
)
from perchctl.startup import failure_record, restore_ctrl_c

# \b makes click keep the line breaks of the paragraph.
EXIT_TABLE = "\b\nExit codes:\n" + "\n".join(
    f"{code:>5}  {meaning}" for code, meaning in sorted(EXIT_CODES.items())
)
_FREE_SPACE = "free some space"
_REFUSED: dict[int | None, str] = {
    errno.ENOSPC: _FREE_SPACE,
    errno.EDQUOT: _FREE_SPACE,
    errno.EFBIG: _FREE_SPACE,
    errno.EROFS: "choose another place",
    errno.EACCES: "choose another place",
    errno.EPERM: "choose another place",
    errno.ENAMETOOLONG: "choose another place",
    errno.ENOTDIR: "choose another place",
}
"""Advice to the user for each error that the operating system reports for a path."""
_LONGEST_PLACE = 200

COMMANDS: dict[str, str] = {
    "make-target": (
        "Make a PDF of the target or a calibration board, design a target, or enter its printed "
        "size."
    ),
    "calibrate": "Calibrate the camera, and report the resulting error at the target in mm.",
    "profile": (
        "Show a resolved profile with every key explained, or create one for your vehicle (new)."
    ),
    "fit-weights": (
        "Using ground truth, fit weights that merge both markers' poses, and verify that they help."
    ),
    "track": "Find the target in a camera stream, a video or images, without a vehicle.",
    "check": (
        "Check vehicle, camera, computer and profile on the ground, and report what is not fit "
        "to fly."
    ),
    "fly": "Fly a perching mission: find the target, align, ascend, perch, stop the motors.",
    "hover": "Hover below the target for a set time, land, and report the position error.",
    "fleet": "Plan, fly and simulate several vehicles in one room, and import other fleet files.",
    "simulate": "Simulate many seeded flights, faster than real time, and count the outcomes.",
    "log": "Show, plot, compare, export, replay, film or summarise a flight from its log.",
}
"""The commands in the order in which a user needs them, with the first sentence of their help."""

_CLOSE = 0.75
"""Lowest similarity at which a word counts as a misspelt command rather than a file name."""
_CONTEXT_SETTINGS: dict[str, Any] = {"help_option_names": ["-h", "--help"]}


class Group(TyperGroup):
    """A group of subcommands. The first is the main subcommand, which runs if the user names
    none."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        named = (*self.commands, *_CONTEXT_SETTINGS["help_option_names"])
        # For shell completion, do not insert the main subcommand, so that all subcommands are
        # offered.
        if not ctx.resilient_parsing and (not args or args[0] not in named):
            # A word that consists only of letters must be meant as a subcommand; the name of a file
            # or source contains other characters.
            word = args[0] if args and args[0].isalpha() and not os.path.exists(args[0]) else ""
            if meant := difflib.get_close_matches(word, self.commands, 1, _CLOSE):
                raise UsageError(
                    f"{ctx.command_path} {word} is not a command; did you mean {meant[0]}? "
                    f"({ctx.command_path} --help lists all)"
                )
            args = [next(iter(self.commands)), *args]
        return super().parse_args(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a subcommand. The help of the main one, if the user names it, begins with its own
        sentence instead of the group's."""
        found = super().get_command(ctx, cmd_name)
        if found is None or cmd_name != next(iter(self.commands)) or not found.short_help:
            return found
        _, _, rest = (found.help or "").partition("\n\n")
        named = copy.copy(found)
        named.help = f"{found.short_help}\n\n{rest}".rstrip()
        return named

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the help text of the main subcommand, followed by a list of the others."""
        name, main_command = next(iter(self.commands.items()))
        inner = typer.Context(
            main_command, info_name=ctx.info_name, parent=ctx.parent, **_CONTEXT_SETTINGS
        )
        main_command.format_help(inner, formatter)
        with formatter.section(f"Subcommands (default: {name})"):
            formatter.write_dl(
                [(each.name, each.get_short_help_str(200)) for each in self.commands.values()]
            )


class _Unloaded(TyperCommand):
    """A subcommand whose module is loaded when it is used."""

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        module = importlib.import_module(f"perchctl.commands.{(self.name or '').replace('-', '_')}")
        command: Any = typer.main.get_command(module.app)
        command.name = self.name
        return command.make_context(*args, **kwargs)


class _Commands(TyperGroup):
    """The subcommands of `COMMANDS`. A failure in one of them is reported as a sentence."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        # Show the whole sentence, which the list of commands truncates by default.
        self.commands = {name: _Unloaded(name, short_help=COMMANDS[name]) for name in COMMANDS}

    def invoke(self, ctx: Any) -> Any:
        with report_failures("--json" in ctx.args):
            return super().invoke(ctx)


def new_app(cls: type[TyperGroup] = TyperGroup) -> typer.Typer:
    """Return the application for a subcommand or, with `cls=Group`, for a group of subcommands."""
    # Do not use rich's panels, because they truncate text in narrow cells.
    return typer.Typer(
        cls=cls,
        add_completion=cls is _Commands,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings=_CONTEXT_SETTINGS,
    )


app = new_app(_Commands)


P = ParamSpec("P")


def command(
    group: typer.Typer, *examples: str, ending: str = "", **settings: Any
) -> Callable[[Callable[P, int | None]], Callable[P, None]]:
    """Return the decorator for a subcommand of `group`, whose help text ends with `examples` and
    `ending`. The decorated function returns the exit code (None: 0). `settings` are passed to
    typer."""
    # \b keeps the line breaks.
    lines = "\n".join(["\b", "Examples:", *(f"  {line}" for line in examples)])
    epilog = f"{lines}\n\n{ending}"

    def add(run: Callable[P, int | None]) -> Callable[P, None]:
        @functools.wraps(run)
        def do(*args: P.args, **kwargs: P.kwargs) -> None:
            restore_ctrl_c()
            code = run(*args, **kwargs)
            sys.stdout.flush()  # report a full disk or a closed pipe here rather than at exit
            raise typer.Exit(code or 0)

        return group.command(epilog=epilog, **settings)(do)

    return add


ProfileOption = Annotated[
    str,
    typer.Option("--profile", "-p", help="Profile, by name or path."),
]
UriOption = Annotated[
    str | None,
    typer.Option(
        "--uri",
        "-u",
        envvar="CFLIB_URI",
        help="URI of the vehicle: sim://, radio://0/80/2M/E7E7E7E7E7, usb://0, udp://HOST:PORT or "
        "my_module:MyLink.",
    ),
]
SourceOption = Annotated[
    str | None,
    typer.Option(
        "--source",
        help="Camera source: camera:N, camera:NAME, rtsp://..., http://..., aideck://HOST, "
        "video:FILE, images:DIR, sim: or my_module:MyCamera.",
    ),
]
SourceArgument = Annotated[
    str,
    typer.Argument(
        help="Camera source: images:DIR or images:PATTERN, video:FILE, camera:N, camera:NAME, "
        "rtsp://..., http://..., aideck://HOST, my_module:MyCamera, or the path of a file or "
        "folder.",
    ),
]
PositioningOption = Annotated[
    str | None,
    typer.Option(
        "--positioning",
        help="Source of the vehicle's position: deck, mocap or target. Default: as in the profile.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON to stdout.")]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
ViewOption = Annotated[
    bool, typer.Option("--view", help="Serve a live page on 127.0.0.1, and print its address.")
]


def main() -> Any:
    """Run the command line; returns the exit code."""
    try:
        with (
            report_failures()
        ):  # for failures outside a subcommand, such as printing the help to a full disk
            try:
                app()
            finally:
                sys.stdout.flush()
    except SystemExit as end:
        return end.code
    except typer.Exit as end:
        return end.exit_code
    finally:
        # If Ctrl-C is still held down, a finished command must not end with a traceback.
        signal.signal(signal.SIGINT, lambda _signal, _frame: os._exit(Interrupted.exit_code))


@contextlib.contextmanager
def report_failures(as_json: bool = False) -> Iterator[None]:
    """Report a failure in the block as a sentence on stderr (with `as_json`, also as an object on
    stdout), and exit with its exit code. Print each note on the profile as a sentence."""
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
        discard_output(sys.stdout)
        raise typer.Exit(PerchError.exit_code) from None
    except Exception as error:
        if type(error) is typer.BadParameter:  # its subclass is a missing parameter
            _leave(_value_problem(error), InvalidValue.exit_code, as_json)
        if hasattr(error, "format_message"):  # a usage error, which typer prints
            if as_json:
                _print_failure(error.format_message(), UsageError.exit_code)
            raise
        if os.environ.get("PERCHCTL_DEBUG"):
            raise
        # If a disk is full and the error names no path, stdout is being written to that disk; any
        # other error without a path may concern a device.
        is_full = isinstance(error, OSError) and _REFUSED.get(error.errno) == _FREE_SPACE
        if isinstance(error, OSError) and error.errno in _REFUSED and (error.filename or is_full):
            if error.filename is None:
                discard_output(sys.stdout)
            place = str(error.filename or "the result")[:_LONGEST_PLACE]
            advice = _REFUSED[error.errno]
            what = "written" if is_full else "used"
            sentence = f"{place} cannot be {what}: {error.strerror}: {advice}"
            _leave(sentence, InvalidValue.exit_code, as_json)
        _leave(
            f"unexpected {type(error).__name__}: {error} (PERCHCTL_DEBUG=1 shows where; "
            "please report it)",
            PerchError.exit_code,
            as_json,
        )


def _value_problem(error: typer.BadParameter) -> str:
    """Return the sentence about an option's invalid value, from the first error of the library that
    typer uses to convert values."""
    from perchctl.plain_yaml import clip_text

    param: Any = error.param
    first: dict[str, Any] = next(iter(getattr(error.__cause__, "errors", list)()), {})
    name, low, high = "/".join(param.opts), param.min, param.max
    _, is_choice, allowed = error.message.partition(" is not one of ")
    if is_choice:
        allowed = allowed.replace("'", "").removesuffix(".")
    else:
        is_whole = first.get("type", "").startswith("int_") or isinstance(low, int)
        kind = "whole numbers" if is_whole else "numbers"
        above = "" if low is None else f" of {low:g} or more"
        allowed = kind + (above if high is None else f" from {low:g} to {high:g}")
    if "input" not in first:
        return f"{name}: {error.message}"
    return f"{name}: found {clip_text(repr(first['input']))}; allowed are {allowed}"


def _leave(sentence: str, code: int, as_json: bool) -> NoReturn:
    say(sentence)
    if as_json:
        _print_failure(sentence, code)
    raise typer.Exit(code) from None


def _print_failure(sentence: str, code: int) -> None:
    try:
        print(failure_record(sentence, code), flush=True)
    except OSError:
        discard_output(sys.stdout)


@contextlib.contextmanager
def _notes() -> Iterator[None]:
    printed: set[str] = set()

    with warnings.catch_warnings():
        warnings.simplefilter("always", Note)
        show_others = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
            if not issubclass(category, Note):
                show_others(message, category, *place, **more)
            elif str(message) not in printed:
                printed.add(str(message))
                say(str(message))

        warnings.showwarning = show
        yield


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"perchctl {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _top(
    context: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", "-V", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Hang a Crazyflie from the ceiling, guided by an upward-facing camera and a printed target."""
    if context.invoked_subcommand is None:
        print(context.get_help())
