"""The work behind `perchctl check`: options in, a table or JSON and an exit code out."""

from __future__ import annotations

import json
import sys
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from perchctl.camera import CameraControl, ConnectedCamera, find_cameras
from perchctl.check import CheckScope, Row, Verdict, check, scan_rows
from perchctl.commands.fly import resolve
from perchctl.commands.interrupt import interruptible, unheeded
from perchctl.commands.output import confirmed, say
from perchctl.errors import (
    ConnectionFailed,
    Interrupted,
    NotFound,
    PerchError,
    SafetyAbort,
    UsageError,
)

WIDTH = 80
NAME_WIDTH = 17
SHOWN = {Verdict.PASS: "pass", Verdict.WARN: "warn", Verdict.FAIL: "FAIL", Verdict.SKIPPED: "skip"}
EXIT_CODE_OF = {"address": ConnectionFailed.exit_code, "camera": NotFound.exit_code}
"""Of a failing row; `SafetyAbort`'s of all others."""


@dataclass(frozen=True)
class CheckRequest:
    """The command line as it was given; None is not given."""

    profile: str = "sim"
    uri: str | None = None
    source: str | None = None
    seed: int | None = None
    log_dir: Path | None = None
    scan: bool = False
    cameras: bool = False
    lift: bool = False
    prop_test: bool = False
    yes: bool = False
    as_json: bool = False


def run(request: CheckRequest, wanted: CheckScope | None = None) -> int:
    """Look, print what was found, also so far as Ctrl-C let it come; returns the exit code.

    `wanted` takes the place of what the request wants. Errors: those of the request and of the
    profile's files.
    """
    _refuse_ignored(request)
    if request.cameras:
        return list_cameras(request.as_json)
    if request.prop_test and not request.yes and not sys.stdin.isatty():
        raise UsageError("--prop-test turns the motors, and there is nobody to ask: add --yes")
    rows: list[Row] = []
    interrupted = False
    try:
        with interruptible():
            for row in _rows(request, wanted or _wanted(request)):
                rows.append(row)
    except KeyboardInterrupt:
        interrupted = True
    except PerchError:
        if rows and not request.as_json:
            print(table(rows, finished=False))
        raise
    with unheeded():
        if request.as_json:
            print(json.dumps([asdict(row) for row in rows]))
        elif rows:
            print(table(rows, finished=not interrupted))
    if interrupted:
        say("Ctrl-C: this is what was found until then")
        return Interrupted.exit_code
    return exit_code(rows)


def _refuse_ignored(request: CheckRequest) -> None:
    """Raises UsageError for options that would say nothing."""
    if request.yes and not request.prop_test:
        raise UsageError("--yes answers --prop-test: add that, or leave --yes out")
    others = (request.source, request.seed, request.log_dir, request.lift, request.prop_test)
    if request.scan and any(other not in (None, False) for other in others):
        raise UsageError("--scan only shows which vehicles answer: give it -u and --json at most")
    beside = (*others, request.scan, request.uri)
    if request.cameras and any(other not in (None, False) for other in beside):
        raise UsageError("--cameras only lists this computer's cameras: give it --json at most")


def _rows(request: CheckRequest, wanted: CheckScope) -> Iterator[Row]:
    if request.scan:
        say("scanning all channels and rates")
        yield from scan_rows(request.uri)
        return
    options = resolve(
        request.profile, request.uri, request.source, seed=request.seed, log_dir=request.log_dir
    )
    yield from check(options, wanted)


def _wanted(request: CheckRequest) -> CheckScope:
    may_turn = (lambda: request.yes or _confirmed()) if request.prop_test else None
    return CheckScope(may_turn_motors=may_turn, lift=request.lift, tell=say)


def _confirmed() -> bool:
    return confirmed("About to turn each propeller. Is it free, the vehicle held by nobody?")


def exit_code(rows: Sequence[Row]) -> int:
    """Of the first failing row; 0 when nothing fails."""
    for row in rows:
        if row.verdict is Verdict.FAIL:
            return EXIT_CODE_OF.get(row.name, SafetyAbort.exit_code)
    return 0


def table(rows: Sequence[Row], finished: bool = True) -> str:
    """At 80 columns: verdict, name, what was found, and below it what to do.

    Rows that were skipped for one and the same reason share a line.
    """
    lines: list[str] = []
    skipped: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row.verdict is Verdict.SKIPPED:
            skipped.setdefault((row.found, row.advice), []).append(row.name)
        else:
            lines += _lines(SHOWN[row.verdict], row.name, row.found, row.advice)
    for (why, advice), names in skipped.items():
        if len(names) == 1:
            lines += _lines(SHOWN[Verdict.SKIPPED], names[0], why, advice)
        else:
            lines += _lines(SHOWN[Verdict.SKIPPED], "", f"{', '.join(names)}: {why}", advice)
    return "\n".join([*lines, summary(rows, finished)])


def _lines(verdict: str, name: str, found: str, advice: str) -> list[str]:
    head = f"{verdict}  {name:<{NAME_WIDTH}}"
    room = WIDTH - len(head)
    text = textwrap.wrap(found, room, break_on_hyphens=False) or [""]
    lines = [head + text[0]] + [" " * len(head) + more for more in text[1:]]
    for part in advice.splitlines():
        wrapped = textwrap.wrap(part, room - 3, break_on_hyphens=False) or [""]
        if len(advice.splitlines()) > 1:
            wrapped = [part]  # lines to be copied stay as they are
        lines += (
            [
                " " * len(head) + ("-> " if n == 0 else "   ") + more
                for n, more in enumerate(wrapped)
            ]
            if len(advice.splitlines()) == 1
            else [f"  {more}" for more in wrapped]
        )
    return [line.rstrip() for line in lines]


def summary(rows: Sequence[Row], finished: bool = True) -> str:
    """The last line. Of a check that did not come to its end nothing good is said."""
    counts = {v: sum(row.verdict is v for row in rows) for v in Verdict}
    told = ", ".join(f"{n} {SHOWN[v]}" for v, n in counts.items() if n)
    failing = [row.name for row in rows if row.verdict is Verdict.FAIL]
    ends = [f"not fit to fly: {', '.join(failing)}"] if failing else []
    if not finished:
        ends.append("not finished, the rest is not known")
    return f"{told}: {'; '.join(ends) or 'nothing fails'}"


# --- `perchctl check --cameras`: what this computer's cameras are called, and what they can ----


NONE = "this computer has no camera: plug in the receiver or camera (Linux lists /dev/videoN)"


def list_cameras(as_json: bool, known: Sequence[ConnectedCamera] | None = None) -> int:
    """Print them; returns the exit code. Nothing is set, and no picture taken. `known` takes the
    place of this computer's. Errors: NotFound where there are none."""
    known = find_cameras(asked=True) if known is None else known
    if not known:
        raise NotFound(NONE)
    if as_json:
        print(json.dumps([camera_record(camera) for camera in known]))
    else:
        print("\n".join(line for camera in known for line in camera_lines(camera)))
    return 0


def camera_record(camera: ConnectedCamera) -> dict[str, Any]:
    """For JSON."""
    return {
        "source": camera.source,
        "name": camera.name,
        "path": f"/dev/video{camera.number}",
        "stable_path": camera.stable_path or None,
        "modes": [
            {"format": m.format, "size_px": m.size_px, "rates_hz": m.rates_hz} for m in camera.modes
        ],
        "controls": [_control_record(*each) for each in camera.controls],
        "problem": camera.problem or None,
    }


def _control_record(control: CameraControl, value: int | None) -> dict[str, Any]:
    record: dict[str, Any] = {
        "name": control.name, "kind": control.kind, "value": value, "default": control.default,
        "min": control.low, "max": control.high, "step": control.step,
        "inactive": control.inactive,
    }  # fmt: skip
    if control.menu:
        record["menu"] = {str(index): text for index, text in control.menu}
    return record


def camera_lines(camera: ConnectedCamera) -> list[str]:
    """For people."""
    lines = [f"{camera.source}  {camera.name or '(no name)'}"]
    if camera.stable_path:
        lines.append(f"  {camera.stable_path}")
    if camera.problem:
        lines.append(f"  {camera.problem}; close other programs that use it, or get the right to")
    for mode in camera.modes:
        size = "any size" if mode.size_px is None else "{}x{}".format(*mode.size_px)
        rates = f" at {', '.join(f'{hz:g}' for hz in mode.rates_hz)} Hz" if mode.rates_hz else ""
        lines.append(f"  {mode.format:<5}{size}{rates}")
    for control, value in camera.controls:
        now = "?" if value is None else str(value)
        held = ", held by an automatic one" if control.inactive else ""
        lines.append(f"  {control.name} = {now}  ({_allowed(control)}{held})")
    return lines


def _allowed(control: CameraControl) -> str:
    if control.menu:
        return ", ".join(f"{index}: {text}" for index, text in control.menu)
    if control.kind == "boolean":
        return "0 or 1"
    step = f" in steps of {control.step}" if control.step > 1 else ""
    return f"{control.low} to {control.high}{step}"
