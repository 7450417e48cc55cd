"""`perchctl check`: check everything that can be checked on the ground, and print a table or
JSON."""

from __future__ import annotations

import itertools
import json
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from typing import Annotated

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import camera as cameras
from perchctl import check as checks
from perchctl.commands.command_line import (
    JsonOption,
    ProfileOption,
    SourceOption,
    UriOption,
    command,
    new_app,
)
from perchctl.commands.fly import resolve_options
from perchctl.commands.interrupt import ignore_signals, interruptible
from perchctl.commands.output import say, say_on_terminal
from perchctl.errors import (
    ConnectionFailed,
    Interrupted,
    NotFound,
    PerchError,
    SafetyAbort,
)

CHECK_COLUMNS = 80
NAME_WIDTH = 17
SHOWN = {
    checks.Verdict.PASS: "pass",
    checks.Verdict.WARN: "warn",
    checks.Verdict.FAIL: "FAIL",
    checks.Verdict.SKIPPED: "skip",
}
EXIT_CODE_OF = {"address": ConnectionFailed.exit_code, "camera": NotFound.exit_code}
"""Exit codes by the name of the failing row; any other failing row has the exit code of
`SafetyAbort`."""

app = new_app()


@command(
    app,
    "perchctl check -p my_vehicle.yaml",
    "perchctl check -p my_vehicle.yaml --lift",
    "perchctl check --scan",
)
def check(
    profile: ProfileOption = "sim",
    uri: UriOption = None,
    source: SourceOption = None,
    scan: Annotated[
        bool,
        typer.Option(
            "--scan", help="Only list the vehicles that answer, on any channel and data rate."
        ),
    ] = False,
    cameras: Annotated[
        bool,
        typer.Option(
            "--cameras",
            help="Only list this computer's cameras, with number, name and path.",
        ),
    ] = False,
    lift: Annotated[
        bool,
        typer.Option(
            "--lift", help="Also check the estimated position while you lift the vehicle by hand."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> int:
    """Check vehicle, camera, computer and profile on the ground, and report what is not fit to fly.

    Each check passes, warns, fails, or is skipped if perchctl cannot evaluate it. perchctl does
    not arm the vehicle, and the motors stay off. The exit code is 0 if no check fails, 10 if the
    vehicle does not answer, 20 if the camera delivers no image, and 52 if any other check fails.
    """
    if cameras:
        say_on_terminal("listing the cameras")
        return print_rows(camera_rows(), as_json)
    if scan:
        say("scanning all channels and rates")
        return print_rows(checks.scan_rows(uri), as_json)
    say_on_terminal(f"reading profile {profile}")
    options = resolve_options(profile, uri, source)
    scope = checks.CheckScope(with_lift=lift, announce=say)
    return print_rows(checks.check(options, scope), as_json)


def print_rows(rows: Iterable[checks.Row], as_json: bool) -> int:
    """Print each row as soon as it is known, so that none is lost on Ctrl-C or an error, and return
    the exit code."""
    found: list[checks.Row] = []
    interrupted = False
    try:
        with interruptible():
            for row in rows:
                found.append(row)
    except KeyboardInterrupt:
        interrupted = True
    except PerchError:
        if found and not as_json:
            print(format_rows(found, finished=False))
        raise
    with ignore_signals():
        if as_json:
            print(json.dumps([asdict(row) for row in found]))
        elif found:
            print(format_rows(found, finished=not interrupted))
    if interrupted:
        say("stopped by Ctrl-C: these are the checks made so far")
        return Interrupted.exit_code
    return exit_code(found)


def exit_code(rows: Sequence[checks.Row]) -> int:
    """Return the exit code for the first failing row; 0 if no row fails."""
    for row in rows:
        if row.verdict is checks.Verdict.FAIL:
            return EXIT_CODE_OF.get(row.name, SafetyAbort.exit_code)
    return 0


def format_rows(rows: Sequence[checks.Row], finished: bool = True) -> str:
    """Return the rows as text of 80 columns: verdict, name and finding, with the advice below. If
    the check did not finish, the summary does not say that all is well."""
    lines = [line for row in _folded(rows) for line in _lines(row)]
    counts = {v: sum(row.verdict is v for row in rows) for v in checks.Verdict}
    counted = ", ".join(f"{n} {SHOWN[v]}" for v, n in counts.items() if n)
    failing = [row.name for row in rows if row.verdict is checks.Verdict.FAIL]
    ends = [f"not fit to fly: {', '.join(failing)}"] if failing else []
    if not finished:
        ends.append("not finished: the other checks were not run")
    return "\n".join([*lines, f"{counted}: {'; '.join(ends) or 'no check failed'}"])


def _folded(rows: Sequence[checks.Row]) -> Iterator[checks.Row]:
    """Yield the rows, with successive rows that were skipped for the same reason combined into
    one."""
    for (verdict, found, advice), same in itertools.groupby(
        rows, key=lambda row: (row.verdict, row.found, row.advice)
    ):
        group = list(same)
        if verdict is checks.Verdict.SKIPPED and len(group) > 1:
            yield checks.Row(f"{len(group)} checks", verdict, found, advice)
        else:
            yield from group


def _lines(row: checks.Row) -> list[str]:
    head = f"{SHOWN[row.verdict]}  {row.name:<{NAME_WIDTH}}"
    margin = " " * len(head)
    lines = _wrapped(row.found, head, margin) or [head.rstrip()]
    if "\n" in row.advice:  # lines that the user may copy are not wrapped
        return lines + [f"  {line}" for line in row.advice.splitlines()]
    return lines + _wrapped(row.advice, f"{margin}-> ", f"{margin}   ")


def _wrapped(text: str, first: str, others: str) -> list[str]:
    return textwrap.wrap(
        text,
        CHECK_COLUMNS,
        initial_indent=first,
        subsequent_indent=others,
        break_long_words=False,
        break_on_hyphens=False,
    )


# --- `perchctl check --cameras`: the names of this computer's cameras ---


def camera_rows() -> Iterator[checks.Row]:
    """Yield a row for each camera, without changing its settings or taking images. Errors: NotFound
    if there is no camera."""
    for camera in cameras.find_cameras():
        source = f"camera:{camera.number}"
        found = ", ".join(part for part in (camera.name, camera.stable_path) if part)
        if camera.problem:
            advice = "get permission to open it, for example by joining the group video"
            yield checks.Row(source, checks.Verdict.WARN, f"{found}: {camera.problem}", advice)
        else:
            yield checks.Row(source, checks.Verdict.PASS, found)
