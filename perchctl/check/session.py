"""The whole check, row by row as they come: vehicle, camera, computer, profile."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

from perchctl.calibration import profile_camera
from perchctl.camera import FrameSource, find_cameras, open_camera, without_password
from perchctl.check import (
    camera,
    capture,
    compared,
    computer,
    gone,
    hand,
    health,
    lift,
    link,
    scan,
    sight,
)
from perchctl.check.lift import WITHIN_S as LIFT_S
from perchctl.check.profile import quick_rows
from perchctl.check.rehearsal import REHEARSED_S, Listened, Rehearsal, Silent, rehearse
from perchctl.check.row import Row, failed, passed, skipped
from perchctl.errors import ConnectionFailed, PerchError, UsageError
from perchctl.flight import (
    FlyOptions,
    WallClock,
    capture_for_vehicle,
    check_options,
    simulated_vehicle,
    wall_date,
)
from perchctl.link import ProbeLink, ScanResult, address_of, check_uri
from perchctl.link import find_vehicles as scan_for
from perchctl.positioning import CaptureSource, open_capture
from perchctl.profile import PositioningConfig, Profile
from perchctl.vehicle import Telemetry
from perchctl.vision import Pipeline, make_pipeline

NO_VEHICLE = "the vehicle does not answer"
AFTERWARDS = "the motor test ends by itself within 15 s: keep clear of the propellers"


@dataclass(frozen=True)
class CheckScope:
    """What is looked at beyond what can be seen at rest, and for how long, s.

    `may_turn_motors` asks for leave when the moment has come; None: no motor is turned. `tell`
    says what goes on. `other_vehicles` looks for those that answer, `open_capture` opens a motion
    capture.
    """

    may_turn_motors: Callable[[], bool] | None = None
    lift: bool = False
    listen_s: float = link.LISTEN_S
    rehearse_s: float = REHEARSED_S
    lift_s: float = LIFT_S
    health_s: float | None = None
    tell: Callable[[str], None] = lambda text: None
    open_capture: Callable[[PositioningConfig], CaptureSource] = open_capture
    capture_s: float = capture.LISTEN_S
    other_vehicles: Callable[[str], ScanResult] = lambda uri: scan_for([address_of(uri)])


def check(options: FlyOptions, wanted: CheckScope) -> Iterator[Row]:
    """Rows as they are found. Errors, before anything is opened: InvalidValue, NotFound (the
    profile's files), UsageError (a library that is missing, or does not load)."""
    check_options(options)
    profile = options.profile
    calibrated = profile_camera(profile.camera)
    pipeline = make_pipeline(profile, calibrated)
    rehearsal: Rehearsal | None = None
    with contextlib.ExitStack() as stack:
        uri, spec = options.uri, options.source
        if options.simulated:
            wanted.tell("starting the simulated vehicle")
            simulated = stack.enter_context(simulated_vehicle(options, calibrated))
            uri = simulated.uri
            spec = simulated.stream_url if spec.startswith("sim:") else spec
            profile = _with_capture_at(profile, simulated.capture)
        room = _opened_capture(profile.positioning, wanted, stack)
        probe = ProbeLink(uri, profile.link, time.monotonic)
        stack.callback(probe.close)
        heard: Listened = Silent()
        wanted.tell(f"connecting to {options.uri}")
        try:
            probe.connect()
        except ConnectionFailed as error:
            yield from _no_vehicle(options, error, wanted)
            yield from _room(room, lambda: [], profile, wanted)
            yield from _compared(options.uri, profile)
        else:
            heard = probe
            yield passed("address", f"{options.uri} answers")
            yield from _vehicle(probe, options.uri, profile, room, wanted)
        shown, remarks = without_password(options.source), list[str]()
        wanted.tell(f"opening the camera {shown}")
        try:
            source = _source(spec, options, stack, remarks)
        except PerchError as error:
            yield from camera.refused(error, list(map(str, find_cameras())))
            yield from sight.unseen("no picture comes", profile)
        else:
            yield camera.opened_row(shown, list(map(str, find_cameras())), remarks)
            rehearsal = yield from _camera(heard, source, pipeline, options, wanted)
    yield computer.loop_row(rehearsal, profile)
    yield computer.log_folder_row(options.log_dir)
    yield from quick_rows(options)


def scan_rows(uri: str | None) -> list[Row]:
    """`--scan`: what answers, at the usual address and at that of `uri`. Errors: InvalidValue."""
    if uri is not None:
        check_uri(uri)
    return scan.rows(scan_for([address_of(uri or "")]))


def _no_vehicle(options: FlyOptions, error: ConnectionFailed, wanted: CheckScope) -> Iterator[Row]:
    found, _, help_text = str(error).partition("\n")
    advice = help_text
    if not help_text:
        wanted.tell("nothing answers there: looking who else does")
        advice = scan.others(options.uri, wanted.other_vehicles(options.uri))
    yield failed("address", found, advice)
    for name in (*link.NAMES, lift.NAME, *health.NAMES):
        yield skipped(name, NO_VEHICLE)


Room = CaptureSource | str | None
"""An open motion capture, or why it could not be opened; None where decks do it."""


def _with_capture_at(profile: Profile, simulated: tuple[str, str] | None) -> Profile:
    positioning = capture_for_vehicle(profile.positioning, simulated)
    return profile.model_copy(update={"positioning": positioning})


def _opened_capture(
    config: PositioningConfig, wanted: CheckScope, stack: contextlib.ExitStack
) -> Room:
    if config.by != "mocap":
        return None
    wanted.tell(f"connecting to {config.label}")
    try:
        opened = wanted.open_capture(config)
    except UsageError:
        raise  # a library that does not load is the computer's fault, here as in `fly`
    except PerchError as error:
        return str(error)
    stack.callback(opened.close)
    return opened


def _room(
    room: Room, heard: Callable[[], list[Telemetry]], profile: Profile, wanted: CheckScope
) -> Iterator[Row]:
    """The rows of the motion capture; none with decks."""
    if room is None:
        return
    if isinstance(room, str):
        yield from capture.refused(room, profile.positioning)
        return
    wanted.tell(f"listening to {profile.positioning.label} for {wanted.capture_s:g} s")
    seen = capture.listen(heard, room, time.monotonic, time.sleep, wanted.capture_s)
    yield from capture.rows(seen, profile)


def _lifted(probe: ProbeLink, room: Room, profile: Profile, wanted: CheckScope) -> Row:
    """By its own position, or by a motion capture against its attitude."""
    if profile.positioning.by == "target":
        return skipped(lift.NAME, "only in flight it is told its position, by the target")
    if room is None:
        wanted.tell(f"now, within {wanted.lift_s:g} s: {lift.HOW}")
        return lift.row(lift.lift_of(lift.watch(probe, time.sleep, wanted.lift_s)))
    if isinstance(room, str):
        return skipped(lift.NAME, f"no {profile.positioning.label}")
    config = profile.positioning
    wanted.tell(f"now, within {wanted.lift_s:g} s: {hand.HOW}")

    def enough(so_far: capture.Listened) -> bool:
        moved = hand.paired(so_far.telemetry, so_far.places(config))
        return moved is not None and hand.is_enough(moved)

    seen = capture.listen(probe.telemetry, room, time.monotonic, time.sleep, wanted.lift_s, enough)
    return hand.row(hand.paired(seen.telemetry, seen.places(config)), config)


def _compared(uri: str, profile: Profile) -> list[Row]:
    return compared.comparison_rows(
        profile.positioning, uri, wall_date(), simulated=uri.startswith("sim://")
    )


def _vehicle(
    probe: ProbeLink, uri: str, profile: Profile, room: Room, wanted: CheckScope
) -> Iterator[Row]:
    wanted.tell(f"listening to the vehicle for {wanted.listen_s:g} s")
    seen = link.look(probe, uri, wanted.listen_s)
    if lost := probe.lost():
        yield failed("packets", f"the link was lost: {lost}", "see address; restart the vehicle")
        for name in (*link.NAMES[1:], lift.NAME, *health.NAMES):
            yield skipped(name, NO_VEHICLE)
        yield from _compared(uri, profile)
        return
    yield from link.rows(seen, profile)
    yield from _room(room, probe.telemetry, profile, wanted)
    yield from _with_a_hand(probe, uri, room, profile, wanted)
    yield from gone.rows(probe)


def _with_a_hand(
    probe: ProbeLink, uri: str, room: Room, profile: Profile, wanted: CheckScope
) -> Iterator[Row]:
    """What somebody has to lift it for, or to keep clear of; it may end with a dead vehicle."""
    if wanted.lift:
        lifted = _lifted(probe, room, profile, wanted)
        yield lifted
        rows = _compared(uri, profile)
        yield from [compared.kept(lifted, profile.positioning, uri, wall_date())] if rows else []
    else:
        yield lift.unasked()
        yield from _compared(uri, profile)
    if wanted.may_turn_motors is None:
        yield from health.unasked()
        return
    if why := health.hindrance(probe.newest(), probe.age_s(), profile):
        yield from health.unasked(f"not begun: {why}")
    elif not wanted.may_turn_motors():
        yield from health.unasked("not confirmed")
    else:
        wanted.tell("turning each propeller for a moment: keep clear")
        try:
            yield from health.run(probe, profile, time.sleep, wanted.health_s)
        except KeyboardInterrupt:
            wanted.tell(AFTERWARDS)
            raise


def _source(
    spec: str, options: FlyOptions, stack: contextlib.ExitStack, remarks: list[str]
) -> FrameSource:
    config = options.profile.camera
    size_px = profile_camera(config).size_px
    source = open_camera(spec, time.monotonic, config, size_px=size_px, tell=remarks.append)
    stack.callback(source.close)
    return source


def _camera(
    heard: Listened,
    source: FrameSource,
    pipeline: Pipeline,
    options: FlyOptions,
    wanted: CheckScope,
) -> Generator[Row, None, Rehearsal | None]:
    """Yields the rows; returns the rehearsal, None where there could be none."""
    size = camera.size_row(source.size_px, pipeline.camera.size_px)
    if size.verdict != "pass":
        why = "pictures of another size cannot be looked at"
        yield from camera.unseen(why, size)
        yield from sight.unseen(why, options.profile)
        return None
    yield size
    wanted.tell(f"rehearsing on live pictures for {wanted.rehearse_s:g} s")
    profile = options.profile
    done = rehearse(heard, source, pipeline, profile, WallClock(), wanted.rehearse_s)
    optical = camera.optical_of(done, pipeline)
    design = camera.design_of(done, optical, pipeline, profile)
    yield from camera.rows(done, optical, design, profile)
    measured = optical.blur is not None
    yield from sight.rows(done, design, measured, profile, pipeline.camera)
    return done
