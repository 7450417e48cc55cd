"""`perchctl calibrate mount`: measure the camera's mounting and latency and the position of the
gear's tip, with the vehicle held by hand.

perchctl only reads from the vehicle. It sends no packet that arms it, sets a parameter or makes it
fly.
"""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import typer

# Import packages, not names: their contents load on first use, so the command starts at once.
from perchctl import calibration as calibrations
from perchctl import camera as cameras
from perchctl import display as displays
from perchctl import link as links
from perchctl import profile as profiles
from perchctl import vision as visions
from perchctl.commands.command_line import (
    JsonOption,
    ProfileOption,
    SourceOption,
    UriOption,
    ViewOption,
)
from perchctl.commands.interrupt import Stopper, ignore_signals
from perchctl.commands.output import (
    NO,
    add_problem,
    ask,
    print_lines,
    print_result,
    say,
    say_on_terminal,
)
from perchctl.errors import (
    Interrupted,
    InvalidValue,
    NotFound,
    PerchError,
    SafetyAbort,
    UsageError,
)
from perchctl.files import check_writable

FOLDER = Path("calib")
Part = Literal["carry", "pivot"]
Sensors: TypeAlias = (
    "tuple[Callable[[], list[calibrations.AttitudeSample]], Callable[[float], str | None]]"
)
"""What a recording reads from the vehicle: its new samples, and its problem at a given time."""
HOW: dict[Part, str] = {
    "carry": "carry: hold the vehicle under the target (or the target in front of its "
    "camera); turn it about every axis and move it around, keeping the target in "
    "view",
    "pivot": "pivot: rest the tip of the gear on a point that does not move; tilt the "
    "vehicle around it in every direction, keeping the target in view",
}
_SIMULATED = "is simulated, so you cannot move it by hand: name a real one"


def mount(
    profile: ProfileOption,
    uri: UriOption = None,
    source: SourceOption = None,
    part: Annotated[
        Part | None,
        typer.Option(
            "--part",
            help="Do only the carry (rotation and latency), or only the pivot (gear tip, by the "
            "camera alone).",
        ),
    ] = None,
    logs: Annotated[
        list[Path] | None,
        typer.Option("--from", help="Evaluate this recording of an earlier run. Repeatable."),
    ] = None,
    write: Annotated[
        bool,
        typer.Option(
            "--write", help="Write the results to the profile, and keep the old file as a backup."
        ),
    ] = False,
    view: ViewOption = False,
    as_json: JsonOption = False,
) -> int:
    """Measure the camera's rotation and latency, and the position of the gear's tip.

    Turn the vehicle in your hand with the target in view (carry), then tilt it around the tip of
    its gear (pivot). The motors are off, and perchctl never arms the vehicle.
    """
    say_on_terminal(f"reading profile {profile}")
    vehicle = profiles.load_profile(profile)
    into = profiles.writable_profile(profile) if write else None
    camera = calibrations.profile_camera(vehicle.camera)
    recordings: Sequence[calibrations.MountingRecording]
    if logs:
        recordings = _read_parts(logs, part)
    else:
        parts: tuple[Part, ...] = ("carry", "pivot") if part is None else (part,)
        frames, link_uri = _live_sources(source, uri, vehicle, parts)
        log = _free_place(profiles.find_profile(profile).stem)
        recordings = _record_live(vehicle, camera, frames, link_uri, parts, log, view)
        logs = [log] if log.exists() else []
    measured = calibrations.solve_mounting(vehicle, recordings)
    for line in measured.lines():
        print_lines(line)
    problem: PerchError | None = None
    if not logs:
        problem = InvalidValue("the recording was not kept")  # the reason has already been printed
    written, before = None, None
    if into is not None:
        try:
            _check_unchanged(profile, vehicle)
            before = profiles.write_profile_values(into, measured.new_profile_values())
            written = into
            say(f"wrote these numbers to {written}; the old version is in {before}")
        except (InvalidValue, NotFound) as error:  # the results are still valid
            problem = error
            say(str(error))
    else:
        say("add --write to write these numbers to the profile")
    record = measured.record() | {
        "recordings": [str(path) for path in logs],
        "profile": written and str(written),
        "profile_before": before and str(before),
    }
    print_result(add_problem(record, problem) if as_json else measured.keys_text())
    return 0 if problem is None else problem.exit_code


# --- Checks before anything is recorded ---


def _live_sources(
    source: str | None, uri: str | None, profile: profiles.Profile, parts: tuple[Part, ...]
) -> tuple[str, str | None]:
    """Return the camera, and the vehicle if the carry needs it."""
    given = profile.camera.source if source is None else source
    if given.startswith("sim:"):
        raise UsageError(
            f"camera {given} {_SIMULATED} with --source (camera:N, http://..., aideck://HOST)"
        )
    name = cameras.parse_source(given)
    if "carry" not in parts:
        return name.spec, None
    if not name.live:
        raise UsageError(
            f"{name} is a recording and does not share the vehicle's clock: --part carry "
            "needs a live camera; --part pivot needs no vehicle"
        )
    link_uri = profile.link.uri if uri is None else uri
    if links.check_uri(link_uri) == "sim":
        raise UsageError(f"vehicle {link_uri} {_SIMULATED} with -u; --part pivot needs none")
    return name.spec, link_uri


def _free_place(name: str) -> Path:
    """Return the next unused path for a live recording, after checking that it can be written."""
    stems = (f"mounting_{name}{'' if n == 1 else f'_{n}'}" for n in itertools.count(1))
    place = next(p for stem in stems if not (p := FOLDER / f"{stem}.jsonl").exists())
    check_writable(place, force=False)
    return place


# --- recordings of files ---


def _read_parts(logs: Sequence[Path], part: str | None) -> list[calibrations.MountingRecording]:
    """Return the last recording of `part` or, if that is None, of each part. Errors: NotFound,
    InvalidValue."""
    held = [recording for path in logs for recording in calibrations.MountingRecording.read(path)]
    found = {each.part: each for each in held if part in (None, each.part)}
    if not found:
        parts = " and ".join(dict.fromkeys(recording.part for recording in held))
        raise InvalidValue(
            f"{', '.join(map(str, logs))} contains no {part}, only {parts}: leave out --part, "
            "or name the other recording too"
        )
    return list(found.values())


def _check_unchanged(name: str, then: profiles.Profile) -> None:
    """Raise InvalidValue if any value that the results depend on has changed in the profile, and
    NotFound if the profile is gone."""
    now = profiles.load_profile(name)
    if (now.camera, now.vehicle) != (then.camera, then.vehicle):
        raise InvalidValue(
            f"{profiles.find_profile(name)} has changed since it was read, so nothing was written: "
            "these numbers depend on its old values; evaluate the recording again with "
            "--from"
        )


# --- a live recording ---


def _record_live(
    profile: profiles.Profile,
    camera: visions.CameraModel,
    source: str,
    uri: str | None,
    parts: Sequence[Part],
    log: Path,
    view: bool,
) -> list[calibrations.MountingRecording]:
    """Record the parts live, and also to a file. The recorded data is kept even if recording ends
    early.

    Args:
        uri: the vehicle's URI; None to connect to no vehicle. view: serve the live page.

    Raises:
        Interrupted: the user pressed Ctrl-C. SafetyAbort: the motors are turning.
        The errors of `open_camera`, `AttitudeLink.connect` and `record_mounting`.
    """
    from perchctl.commands.progress import guidance_display

    recordings: list[calibrations.MountingRecording] = []
    with contextlib.ExitStack() as stack:
        # No latency is subtracted from the images' times, because this measurement determines the
        # latency.
        frames = cameras.open_camera(
            source, time.monotonic, profile.camera, size_px=camera.size_px, latency_s=0.0
        )
        stack.callback(frames.close)
        cameras.check_size(frames.size_px, camera, frames.describe())
        sensors: Sensors = (list, lambda now_s: None)
        if uri is not None:
            sensors = stack.enter_context(_vehicle(uri, profile))
        page = stack.enter_context(
            displays.live_page(camera, "perchctl calibrate mount", view, say)
        )
        stack.callback(_keep, recordings, log)
        for part in parts:
            say(HOW[part])
            if sys.stdin.isatty():  # during this question, Ctrl-C ends the command at once
                with contextlib.suppress(EOFError):  # Ctrl-D continues, as Enter does
                    if ask("press Enter when it is in place:").strip().lower() in NO:
                        raise UsageError("not confirmed: nothing was measured")
            recording = calibrations.MountingRecording(part)
            recordings.append(recording)
            reader = calibrations.PoseReader(profile, camera, frames.live)
            if frames.live:
                frames.poll(time.monotonic())  # discard an earlier frame
            with Stopper().as_handler() as stop, guidance_display(page) as show:
                stopped = stop.requested.is_set
                calibrations.record_mounting(
                    recording,
                    frames,
                    reader,
                    show,
                    *sensors,
                    clock=time.monotonic,
                    stopped=stopped,
                )
            if stopped():
                raise Interrupted("Ctrl-C: nothing was measured")
    return recordings


@contextlib.contextmanager
def _vehicle(uri: str, profile: profiles.Profile) -> Iterator[Sensors]:
    """Connect to the vehicle, and yield two functions that return its samples and its problem.
    Raises SafetyAbort if its motors are turning or may start to turn."""
    link = links.AttitudeLink(uri, profile.link, time.monotonic)
    say(f"connecting to {uri} (read-only)")
    link.connect()

    def problem(now_s: float) -> str | None:
        if link.motors_running:
            raise SafetyAbort(
                f"{uri} is armed, or its motors turned within the last 2 s: do not "
                "move it by hand in this state; switch it off and on again"
            )
        return link.problem(now_s)

    with contextlib.closing(link):
        problem(time.monotonic())
        yield link.samples, problem


def _keep(recordings: Sequence[calibrations.MountingRecording], log: Path) -> None:
    """Write the recording. Never raises an exception, because the results must still be printed."""
    held = [recording for recording in recordings if recording.attitudes or recording.poses]
    if not held:
        return
    try:
        with ignore_signals():
            calibrations.MountingRecording.write(log, held)
    except InvalidValue as error:
        say(f"the recording was not kept: {error}")
        return
    say(f"kept the recording {log}; to evaluate it again, use --from {log}")
