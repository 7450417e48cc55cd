"""`perchctl calibrate mount`: how the camera is mounted, how late it is, and where the gear's tip
is, measured with the vehicle in a hand.

The vehicle is read and nothing else: no packet that arms, sets or flies goes out.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer

from perchctl.calibration import (
    Eye,
    MountingPart,
    MountingRecording,
    MountingReport,
    MountingTape,
    VehicleSensors,
    capture,
    pose_basis,
    profile_camera,
    read_recordings,
    solve_carry,
    solve_pivot,
    write_recordings,
)
from perchctl.camera import (
    FrameSource,
    check_size,
    open_camera,
    parse_source,
    without_password,
)
from perchctl.commands.command_line import (
    ForceOption,
    JsonOption,
    ViewOption,
    ViewPortOption,
    reporting,
)
from perchctl.commands.guide import guide, page_port
from perchctl.commands.interrupt import Stopper, unheeded
from perchctl.commands.output import print_record, say, tell
from perchctl.commands.progress import count_bar
from perchctl.display import LivePage, live_page
from perchctl.errors import (
    Interrupted,
    InvalidValue,
    NotFound,
    SafetyAbort,
    UsageError,
    no_simulator,
)
from perchctl.files import check_output
from perchctl.link import MotionLink, check_uri
from perchctl.profile import (
    Profile,
    find_profile,
    load_profile,
    writable_profile,
    write_profile_values,
)
from perchctl.vision import CameraModel

FOLDER = Path("calib")
HOW: dict[MountingPart, str] = {
    "carry": "carry: hold the vehicle under the target (or the target before its camera); turn it "
    "about all its axes and move it, the target in view",
    "pivot": "pivot: stand the tip of the gear on one point that does not move, the target in "
    "view; tilt the vehicle around it in all directions",
}
_SIMULATED = (
    "stands on the simulator's floor, where no hand moves it: add --truth sim, or name a real one"
)


@reporting
def mount(
    profile: Annotated[
        str | None,
        typer.Option("--profile", "-p", help="The vehicle's profile."),
    ] = None,
    uri: Annotated[
        str | None,
        typer.Option(
            "--uri", "-u", help="Vehicle, only read from. Default: CFLIB_URI, the profile's."
        ),
    ] = None,
    source: Annotated[
        str | None,
        typer.Option("--source", help="Its camera; else the profile's."),
    ] = None,
    part: Annotated[
        Literal["carry", "pivot"] | None,
        typer.Option(
            "--part",
            help="Only the carry (turn and latency), or only the pivot (the gear's tip, by the "
            "camera alone).",
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Measure from this recording of an earlier run."),
    ] = None,
    write: Annotated[
        bool,
        typer.Option(
            "--write", help="Put the numbers into the profile; the old file is kept beside it."
        ),
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="The recording of a live run, .jsonl."),
    ] = None,
    force: ForceOption = False,
    view: ViewOption = False,
    view_port: ViewPortOption = 0,
    as_json: JsonOption = False,
    truth: Annotated[
        Literal["sim"] | None,
        typer.Option("--truth", help="A simulated vehicle in a simulated hand."),
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", min=0, help="Of --truth sim.")] = None,
) -> int:
    """Measure how the camera is mounted, how late it is, and where the gear's tip is.

    The vehicle is turned in the hand in view of the target (carry), then tilted around the tip of
    its gear (pivot). Its motors are off, and nothing arms.
    """
    port = page_port(view, view_port)
    _check_together(uri, source, logs, output, truth, seed, port)
    if profile is None and truth is None:
        raise UsageError("name a profile (-p): what is measured is compared with what it says")
    name = profile or "sim"
    vehicle = load_profile(name)
    into = writable_profile(name) if write else None
    if truth and write and not _is_simulated(vehicle):
        raise UsageError(
            f"--truth sim measures a simulated vehicle, and {name} flies {vehicle.link.uri} with "
            f"{without_password(vehicle.camera.source)}: leave --write out"
        )
    parts: tuple[MountingPart, ...] = ("carry", "pivot") if part is None else (part,)
    camera = profile_camera(vehicle.camera)
    true = None
    recordings: Sequence[MountingRecording]
    again = ["perchctl", "calibrate", "mount", "-p", name]
    only = [] if part is None else ["--part", part]
    if truth:
        again += ["--truth", "sim", "--seed", str(seed or 0), *only]
        recordings, true = _simulated(vehicle, camera, parts, seed or 0)
    elif logs:
        again += [*(word for path in logs for word in ("--from", str(path))), *only]
        recordings = _read_parts(logs, part)
        _check_seen_by(recordings, pose_basis(vehicle, camera))
    else:
        frames, link_uri = _live_sources(source, uri, vehicle, parts)
        log = _recording_place(output, find_profile(name).stem, force)
        again += ["--from", str(log)]
        recordings = _recorded(
            vehicle, camera, frames, link_uri, parts, log, shlex.join(again), port
        )
        logs = [log] if log.exists() else []
        again += only
    measured = solved(vehicle, recordings)
    for line in measured.lines():
        tell(line)
    if true is not None:
        tell(_truth_line(true))
    written, before, problem = None, None, None
    if into is not None:
        try:
            _check_unchanged(name, vehicle, shlex.join([*again, "--write"]))
            before = write_profile_values(into, measured.profile_values())
            written = into
            say(f"wrote these into {written}; as it was before it is {before}")
        except (InvalidValue, NotFound) as error:  # the numbers stand
            problem = error
            say(str(error))
    elif not truth:
        say("--write puts these numbers into the profile")
    code = 0 if problem is None else problem.exit_code
    if not as_json:
        print(measured.keys_text())
        return code
    record = measured.record() | ({} if true is None else {"true": true})
    record |= {
        "recordings": [str(path) for path in logs or []],
        "profile": written and str(written),
        "profile_before": before and str(before),
    }
    print_record(record | ({} if problem is None else {"error": str(problem), "exit_code": code}))
    return code


# -- what is refused at once ----------------------------------------------------


def _check_together(
    uri: str | None,
    source: str | None,
    logs: Sequence[Path] | None,
    output: Path | None,
    truth: str | None,
    seed: int | None,
    port: int | None,
) -> None:
    """Raises UsageError for what a recording or the simulator does not take."""
    if seed is not None and truth is None:
        raise UsageError("--seed is the simulator's: add --truth sim")
    other = "--truth sim" if truth else "--from" if logs else None
    if other is None:
        return
    live = {"--uri": uri, "--source": source, "--view": port, "--output": output}
    for option, value in (live | {"--from": truth and logs}).items():
        if value is not None:
            raise UsageError(f"{other} takes no camera, no vehicle, no page: leave {option} out")


def _is_simulated(profile: Profile) -> bool:
    """True if neither vehicle nor camera is a real one."""
    return check_uri(profile.link.uri) == "sim" and profile.camera.source.startswith("sim:")


def _live_sources(
    source: str | None, uri: str | None, profile: Profile, parts: tuple[MountingPart, ...]
) -> tuple[str, str | None]:
    """The camera, and the vehicle where the carry needs it (or it was named)."""
    given = profile.camera.source if source is None else source
    if given.startswith("sim:"):
        raise UsageError(
            f"camera {given} {_SIMULATED} with --source (camera:N, http://..., aideck://HOST)"
        )
    name = parse_source(given, files=True)
    if "carry" not in parts and uri is None:
        return name.spec, None
    if not name.live:
        raise UsageError(
            f"{name} is a recording, and has not the vehicle's clock: the "
            f"carry needs a live camera; --part pivot needs no vehicle"
        )
    link_uri = uri if uri is not None else os.environ.get("CFLIB_URI", profile.link.uri)
    if check_uri(link_uri) == "sim":
        raise UsageError(f"vehicle {link_uri} {_SIMULATED} with -u; --part pivot needs none")
    return name.spec, link_uri


def _recording_place(output: Path | None, name: str, force: bool) -> Path:
    """Where a live recording goes: `output`, or the next name that is free, so that nothing is
    measured in vain."""
    if output is None:
        stems = (f"mounting_{name}{'' if n == 1 else f'_{n}'}" for n in itertools.count(1))
        output = next(p for stem in stems if not (p := FOLDER / f"{stem}.jsonl").exists())
    check_output(output, (".jsonl",), force, "the recording's format")
    return output


# -- recordings of files and of the simulator -------------------------------------


def _read_parts(logs: Sequence[Path], part: str | None) -> list[MountingRecording]:
    """Each part once, or the one that is asked for. Errors: NotFound, InvalidValue."""
    named = [(path, recording) for path in logs for recording in read_recordings(path)]
    places: dict[MountingPart, Path] = {}
    for path, recording in named:
        if part not in (None, recording.part):
            continue
        if recording.part in places:
            raise InvalidValue(
                f"{path}: the {recording.part} is in {places[recording.part]} already: name one "
                f"recording of each part"
            )
        places[recording.part] = path
    if not places:
        held = " and ".join(dict.fromkeys(recording.part for _, recording in named))
        raise InvalidValue(
            f"{', '.join(map(str, logs))} holds no {part}, but a {held}: leave --part out, or "
            f"name the other recording too"
        )
    return [recording for _, recording in named if recording.part in places]


def _check_seen_by(recordings: Sequence[MountingRecording], now: str) -> None:
    """Raises InvalidValue if the poses rest on other sizes or another lens than the profile's."""
    for recording in recordings:
        if not recording.seen_by:
            say(f"the {recording.part} does not say by which sizes and lens it was seen: unchecked")
        elif recording.seen_by != now:
            raise InvalidValue(
                f"the {recording.part} was seen by {recording.seen_by}; the profile has {now}: "
                f"record it anew, or name the profile that it was recorded with"
            )


def _simulated(
    profile: Profile, camera: CameraModel, parts: Sequence[MountingPart], seed: int
) -> tuple[Sequence[MountingRecording], Mapping[str, Any]]:
    """Recordings of the simulator, and the truth."""
    try:
        from perchctl.sim import draw_hand, record_hand
    except ImportError as error:
        raise no_simulator(error.name) from None
    hands = [draw_hand(profile, part, seed) for part in parts]
    count = round(profile.simulation.camera_rate_hz * sum(hand.seconds for hand in hands))
    with count_bar("pictures", count) as advance:
        recordings = [record_hand(hand, profile, camera, told=advance) for hand in hands]
    hand = hands[0]  # of one seed both parts have the same vehicle
    true = {"rpy_deg": hand.rpy_deg, "latency_s": hand.latency_s, "gear_cam_m": hand.gear_cam_m}
    return recordings, {key: np.asarray(value).tolist() for key, value in true.items()}


def _truth_line(true: Mapping[str, Any]) -> str:
    turn = " ".join(f"{angle:.2f}" for angle in true["rpy_deg"])
    tip = " ".join(f"{1e3 * part:.2f}" for part in true["gear_cam_m"])
    return f"true in the simulator: {turn} deg; {1e3 * true['latency_s']:.1f} ms; {tip} mm"


# -- a live recording -------------------------------------------------------------


def _recorded(
    profile: Profile,
    camera: CameraModel,
    source: str,
    uri: str | None,
    parts: Sequence[MountingPart],
    log: Path,
    again: str,
    port: int | None,
) -> tuple[MountingRecording, ...]:
    """A live recording of the parts, and its file. What was recorded is kept, however it ends.

    Args:
        uri: None: no vehicle is asked. port: None: no page.
        again: the command line that measures from the file.

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
        frames = open_camera(source, now, profile.camera, size_px=camera.size_px, latency_s=0.0)
        stack.callback(frames.close)
        check_size(frames.size_px, camera, frames.describe())
        sensors = VehicleSensors()
        if uri is not None:
            sensors = stack.enter_context(_vehicle(uri, profile, now))
        page = stack.enter_context(live_page(camera, "perchctl calibrate mount", port, say))
        stack.callback(_keep, tapes, log, again)
        for part in parts:
            _await_person(part)
            tapes.append(MountingTape(part, pose_basis(profile, camera)))
            eye = Eye(profile, camera, frames.live)
            _record(tapes[-1], frames, eye, sensors, page, now)
    return tuple(tape.recording() for tape in tapes)


@contextlib.contextmanager
def _vehicle(uri: str, profile: Profile, now: Callable[[], float]) -> Iterator[VehicleSensors]:
    """A connected vehicle's samples and problems. Raises SafetyAbort if its motors turn."""
    link = MotionLink(uri, profile.link, now)
    say(f"connecting to {uri}, to read from it and nothing else")
    link.connect()

    def problem(now_s: float) -> str | None:
        if link.motors_run:
            raise SafetyAbort(
                f"the motors of {uri} turn, or did 2 s ago: nothing is measured by hand "
                f"with them on; switch it off and on"
            )
        return link.problem(now_s)

    with contextlib.closing(link):
        problem(now())
        yield VehicleSensors(link.samples, problem)


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
    with Stopper().installed() as stop, guide(page) as show:
        capture(tape, source, eye, sensors, show, now, stopped=stop.requested.is_set)
    if stop.requested.is_set():
        raise Interrupted("Ctrl-C: nothing was measured")


def _keep(tapes: Sequence[MountingTape], log: Path, again: str) -> None:
    """Never raises: where the recording cannot be kept, it is measured from all the same."""
    if not any(tapes):
        return
    try:
        with unheeded():
            write_recordings(log, [tape.recording() for tape in tapes if tape])
    except InvalidValue as error:
        say(f"the recording is not kept: {error}")
        return
    say(f"kept the recording: {log}; to measure from it again: {again}")


# -- the result -------------------------------------------------------------------


def solved(profile: Profile, recordings: Sequence[MountingRecording]) -> MountingReport:
    """The measured mounting, of each part there is. Errors: InvalidValue."""
    by_part = {recording.part: recording for recording in recordings}
    carry, pivot = by_part.get("carry"), by_part.get("pivot")
    carried, pivoted = None, None
    try:
        carried = None if carry is None else solve_carry(carry)
        if pivot is not None:
            pivoted = solve_pivot(pivot, profile.target.size_sigma)
    except InvalidValue as error:
        if len(by_part) < 2:
            raise
        other = "pivot" if carried is None else "carry"
        raise InvalidValue(f"{error} (--part {other} takes the {other} alone)") from None
    return MountingReport(profile, carried, pivoted)


def _check_unchanged(name: str, then: Profile, again: str) -> None:
    """Raises InvalidValue if the profile no longer says what the numbers rest on: a gear by one
    turn of the camera is wrong beside another, and a recording takes minutes; NotFound."""
    now = load_profile(name, with_weights=False)
    rests_on = [(p.camera.mount, p.camera.latency_s, p.vehicle) for p in (now, then)]
    if rests_on[0] != rests_on[1]:
        raise InvalidValue(
            f"{find_profile(name)} was changed meanwhile, and nothing is written: these numbers "
            f"rest on what it said before; measure again: {again}"
        )
