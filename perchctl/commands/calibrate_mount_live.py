"""The recording of `perchctl calibrate --mount`: a camera, a vehicle in a hand, and a page.

The vehicle is read and nothing else: no packet that arms, sets or flies goes out.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from perchctl.calibration import (
    LEAST_S,
    Eye,
    Moment,
    MountingPart,
    MountingRecording,
    MountingTape,
    VehicleSensors,
    capture,
    pose_basis,
    write_recordings,
)
from perchctl.camera import FrameSource, check_size, open_camera
from perchctl.commands.interrupt import Stopper, unheeded
from perchctl.commands.output import say
from perchctl.commands.page import live_page
from perchctl.display import LivePage, Sketch
from perchctl.errors import Interrupted, InvalidValue, SafetyAbort
from perchctl.link import MotionLink
from perchctl.profile import Profile
from perchctl.vision import CameraModel

HOW: dict[MountingPart, str] = {
    "carry": "carry: hold the vehicle under the target (or the target before its camera); turn it "
    "about all its axes and move it, the target in view",
    "pivot": "pivot: stand the tip of the gear on one point that does not move, the target in "
    "view; tilt the vehicle around it in all directions",
}
_REFRESH_HZ = 8
_BAR_WIDTH = 30


@dataclass(frozen=True)
class LiveSetup:
    """What is recorded, and from where. `uri` None: no vehicle is asked; `port` None: no page."""

    profile: Profile
    camera: CameraModel
    source: str
    uri: str | None
    parts: tuple[MountingPart, ...]
    log: Path
    again: str
    """The command line that measures from the recording."""
    port: int | None = None


def recorded(setup: LiveSetup) -> tuple[MountingRecording, ...]:
    """Both parts, or the one that is asked for, and their file.

    What was recorded is kept, however it ends.

    Raises:
        Interrupted: Ctrl-C. SafetyAbort: the motors turn.
        Those of `open_camera`, `MotionLink.connect` and `capture`.
    """
    start_s = time.monotonic()

    def now() -> float:
        return time.monotonic() - start_s

    tapes: list[MountingTape] = []
    with contextlib.ExitStack() as stack:
        # Its pictures keep the camera's own time: what is taken off it is what is measured.
        config, size_px = setup.profile.camera, setup.camera.size_px
        source = open_camera(setup.source, now, config, size_px=size_px, latency_s=0.0)
        stack.callback(source.close)
        check_size(source.size_px, setup.camera, source.describe())
        sensors = _vehicle(setup, now, stack)
        page = stack.enter_context(
            live_page(setup.camera, "perchctl calibrate --mount", setup.port)
        )
        stack.callback(_keep, tapes, setup)
        for part in setup.parts:
            _await_person(part)
            tapes.append(MountingTape(part, pose_basis(setup.profile, setup.camera)))
            eye = Eye(setup.profile, setup.camera, source.live)
            _record(tapes[-1], source, eye, sensors, page, now)
    return tuple(tape.recording() for tape in tapes)


def _vehicle(
    setup: LiveSetup, now: Callable[[], float], stack: contextlib.ExitStack
) -> VehicleSensors:
    if setup.uri is None:
        return VehicleSensors()
    link = MotionLink(setup.uri, setup.profile.link, now)
    say(f"connecting to {setup.uri}, to read from it and nothing else")
    link.connect()
    stack.callback(link.close)

    def problem(now_s: float) -> str | None:
        if link.motors_run:
            raise SafetyAbort(
                f"the motors of {setup.uri} turn, or did 2 s ago: nothing is measured by hand "
                f"with them on; switch it off and on"
            )
        return link.problem(now_s)

    problem(now())
    return VehicleSensors(link.samples, problem)


def _await_person(part: MountingPart) -> None:
    """Until Enter, where somebody can press it. Ctrl-C ends at once here."""
    say(HOW[part])
    if not sys.stdin.isatty():
        return
    print("press Enter when it is held so: ", end="", file=sys.stderr, flush=True)
    sys.stdin.readline()


def _record(
    tape: MountingTape,
    source: FrameSource,
    eye: Eye,
    sensors: VehicleSensors,
    page: LivePage | None,
    now: Callable[[], float],
) -> None:
    """One part. Raises Interrupted, and what `capture` does."""
    if source.live:
        source.poll(now())  # from before
    with Stopper().installed() as stop, guide() as tell:

        def show(moment: Moment) -> None:
            tell(moment)
            if page is not None:
                page.show(
                    moment.index, Sketch(moment.image, moment.outlines, None, (moment.advice,))
                )
                page.tell(lambda: page_state(moment))

        capture(tape, source, eye, sensors, show, now, stopped=stop.requested.is_set)
    if stop.requested.is_set():
        raise Interrupted("Ctrl-C: nothing was measured")


def _keep(tapes: Sequence[MountingTape], setup: LiveSetup) -> None:
    """Never raises: where the recording cannot be kept, it is measured from all the same."""
    if not any(tapes):
        return
    try:
        with unheeded():
            write_recordings(setup.log, [tape.recording() for tape in tapes if tape])
    except InvalidValue as error:
        say(f"the recording is not kept: {error}")
        return
    say(f"kept the recording: {setup.log}; to measure from it again: {setup.again}")


# -- what the person sees ------------------------------------------------------


@contextlib.contextmanager
def guide(stream: TextIO | None = None) -> Iterator[Callable[[Moment], None]]:
    """Yields the function to call with each frame's moment. A pipe gets one line whenever the
    advice changes."""
    console = Console(file=stream or sys.stderr)
    if not console.is_terminal:
        last = [""]

        def line(moment: Moment) -> None:
            if moment.advice != last[0]:
                last[0] = moment.advice
                console.print(
                    f"perchctl: {moment.part}, {moment.seconds:.0f} s: {moment.advice}",
                    markup=False, highlight=False, soft_wrap=True,
                )  # fmt: skip

        yield line
        return
    with Live(console=console, refresh_per_second=_REFRESH_HZ, redirect_stdout=False) as live:
        yield lambda moment: live.update(_table(moment))


def _rows(moment: Moment) -> list[tuple[str, str, float | None]]:
    """Name, text, and a share 0..1 for a bar."""
    least_s = LEAST_S[moment.part]
    time_share = min(moment.seconds / least_s, 1.0)
    return [
        (moment.part, f"{moment.seconds:.0f} s of {least_s:.0f}", time_share),
        ("target", f"{100 * moment.share:.0f} %", moment.share),
        ("pictures", str(moment.poses), None),
        ("missing", next(iter(moment.missing), "nothing"), None),
        *(("", motion, None) for motion in moment.missing[1:]),
    ]


def _table(moment: Moment) -> Table:
    table = Table.grid(padding=(0, 1))
    for name, text, share in _rows(moment):
        if share is None:
            table.add_row(name, Text(text), "")
            continue
        full = round(_BAR_WIDTH * share)
        colour = "green" if share >= 1.0 else "yellow"
        bar = Text("#" * full, style=colour) + Text("." * (_BAR_WIDTH - full), style="dim")
        table.add_row(name, bar, text)
    table.add_row("", Text(moment.advice, style="bold"), "")
    return table


def page_state(moment: Moment) -> dict[str, Any]:
    rows: list[list[str | float]] = [
        [name, text] if share is None else [name, text, share]
        for name, text, share in _rows(moment)
    ]
    return {"rows": rows, "phase": moment.advice}
