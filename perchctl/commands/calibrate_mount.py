"""The work behind `perchctl calibrate --mount`: recordings in; numbers, a report and a profile
out. Nothing arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from perchctl.calibration import (
    MountingPart,
    MountingRecording,
    MountingReport,
    keys_text,
    mounting_lines,
    mounting_record,
    pose_basis,
    read_recordings,
    solve_carry,
    solve_pivot,
)
from perchctl.commands.calibrate_mount_request import MountOptions, MountRequest, resolve
from perchctl.commands.interrupt import drawn
from perchctl.commands.output import print_record, say, tell
from perchctl.commands.page import page_port
from perchctl.commands.progress import count_bar
from perchctl.errors import InvalidValue, NotFound, PerchError, no_simulator
from perchctl.files import write_files
from perchctl.profile import load_profile, write_profile_values

DEFAULT_SEED = 0


def measure_mount(
    request: MountRequest,
    output: Path | None,
    force: bool,
    as_json: bool,
    view: bool,
    view_port: int,
) -> int:
    """Measure, report, and write where asked; returns the exit code.

    Errors: UsageError, NotFound, InvalidValue (too little motion, ...), ConnectionFailed,
    TimedOut, Interrupted, SafetyAbort.
    """
    port = page_port(view, view_port)
    options = resolve(request, output, force, port is not None)
    recordings, true = _recordings(options, port)
    comparison = solved(options, recordings)
    for line in mounting_lines(comparison):
        tell(line)
    if true is not None:
        tell(_truth_line(true))
    written, aside, problem = None, None, None
    if options.into is not None:
        try:
            _check_unchanged(options)
            aside = write_profile_values(options.into, comparison.profile_values())
            written = options.into
            say(f"wrote these into {written}; as it was before it is {aside}")
        except (InvalidValue, NotFound) as error:  # the numbers stand
            problem = error
            say(str(error))
    elif not request.truth:
        say("--write puts these numbers into the profile")
    picture = drawn(lambda: _draw(comparison, options.report))
    if picture is not None:
        say(f"drew {picture}")
    code = 0 if problem is None else problem.exit_code
    if not as_json:
        print(keys_text(comparison))
        return code
    record = mounting_record(comparison) | ({} if true is None else {"true": true})
    record |= {
        "recordings": [str(path) for path in _logs(options)],
        "report": picture and str(picture),
        "profile": written and str(written),
        "profile_before": aside and str(aside),
    }
    print_record(record | ({} if problem is None else {"error": str(problem), "exit_code": code}))
    return code


def solved(options: MountOptions, recordings: Sequence[MountingRecording]) -> MountingReport:
    """Of each part there is. Errors: InvalidValue."""
    by_part = {recording.part: recording for recording in recordings}
    carry, pivot = by_part.get("carry"), by_part.get("pivot")
    carried, pivoted = None, None
    try:
        carried = None if carry is None else solve_carry(carry)
        if pivot is not None:
            pivoted = solve_pivot(pivot, options.profile.target.size_sigma)
    except InvalidValue as error:
        if len(by_part) < 2:
            raise
        other = "pivot" if carried is None else "carry"
        raise InvalidValue(f"{error} (--part {other} takes the {other} alone)") from None
    return MountingReport(options.profile, carried, pivoted)


def _recordings(
    options: MountOptions, port: int | None
) -> tuple[Sequence[MountingRecording], Mapping[str, Any] | None]:
    """And in the simulator what is true."""
    if options.request.truth is not None:
        return _simulated(options)
    if options.request.logs:
        read = read_parts(options.request.logs, options.request.part)
        _check_seen_by(read, options)
        return read, None
    from perchctl.commands.calibrate_mount_live import LiveSetup, recorded

    setup = LiveSetup(
        options.profile,
        options.camera,
        options.source,
        options.uri,
        options.parts,
        options.log,
        options.again,
        port,
    )
    return recorded(setup), None


def _check_seen_by(recordings: Sequence[MountingRecording], options: MountOptions) -> None:
    """Whether the poses rest on the sizes and the lens that the profile has now."""
    now = pose_basis(options.profile, options.camera)
    for recording in recordings:
        if not recording.seen_by:
            say(f"the {recording.part} does not say by which sizes and lens it was seen: unchecked")
        elif recording.seen_by != now:
            raise InvalidValue(
                f"the {recording.part} was seen by {recording.seen_by}; the profile has {now}: "
                f"record it anew, or name the profile that it was recorded with"
            )


def read_parts(logs: Sequence[Path], part: str | None) -> list[MountingRecording]:
    """Each part once, or the one that is asked for. Errors: NotFound, InvalidValue."""
    named = [(path, recording) for path in logs for recording in read_recordings(path)]
    places: dict[MountingPart, Path] = {}
    for path, recording in named:
        if part not in (None, "both", recording.part):
            continue
        if recording.part in places:
            raise InvalidValue(
                f"{path}: the {recording.part} is in {places[recording.part]} already: name one "
                f"recording of each part"
            )
        places[recording.part] = path
    wanted = ("carry", "pivot") if part == "both" else () if part is None else (part,)
    for name in wanted:
        if name not in places:
            held = " and ".join(dict.fromkeys(recording.part for _, recording in named))
            raise InvalidValue(
                f"{', '.join(map(str, logs))} holds no {name}, but a {held}: leave --part out, or "
                f"name the other recording too"
            )
    return [recording for _, recording in named if recording.part in places]


def _simulated(options: MountOptions) -> tuple[Sequence[MountingRecording], Mapping[str, Any]]:
    try:
        from perchctl.sim import draw_hand, record_hand
    except ImportError as error:
        raise no_simulator(error.name) from None
    seed = DEFAULT_SEED if options.request.seed is None else options.request.seed
    profile, recordings = options.profile, []
    hands = [draw_hand(profile, part, seed) for part in options.parts]
    rate_hz = profile.simulation.camera_rate_hz
    with count_bar("pictures", round(rate_hz * sum(hand.seconds for hand in hands))) as advance:
        for hand in hands:
            recordings.append(record_hand(hand, profile, options.camera, told=advance))
    hand = hands[0]  # of one seed both parts have the same vehicle
    true = {"rpy_deg": hand.rpy_deg, "latency_s": hand.latency_s, "gear_cam_m": hand.gear_cam_m}
    return recordings, {key: np.asarray(value).tolist() for key, value in true.items()}


def _truth_line(true: Mapping[str, Any]) -> str:
    turn = " ".join(f"{angle:.2f}" for angle in true["rpy_deg"])
    tip = " ".join(f"{1e3 * part:.2f}" for part in true["gear_cam_m"])
    return f"true in the simulator: {turn} deg; {1e3 * true['latency_s']:.1f} ms; {tip} mm"


def _check_unchanged(options: MountOptions) -> None:
    """Whether the profile still says what the numbers rest on: a gear by one turn of the camera
    is wrong beside another, and a recording takes minutes. Errors: NotFound, InvalidValue."""
    now, then = load_profile(options.name, with_weights=False), options.profile
    rests_on = [(p.camera.mount, p.camera.latency_s, p.vehicle) for p in (now, then)]
    if rests_on[0] != rests_on[1]:
        raise InvalidValue(
            f"{options.into} was changed meanwhile, and nothing is written: these numbers rest on "
            f"what it said before; measure again: {options.once_more}"
        )


def _logs(options: MountOptions) -> tuple[Path, ...]:
    if options.request.truth is not None:
        return ()
    return options.request.logs or ((options.log,) if options.log.exists() else ())


def _draw(comparison: MountingReport, picture: Path) -> Path | None:
    from perchctl.calibration import draw_mounting

    try:
        write_files({picture: draw_mounting(comparison)})
    except PerchError as error:  # a full disk: the result stands
        say(str(error))
        return None
    return picture
