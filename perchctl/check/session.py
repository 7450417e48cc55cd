"""The complete check of vehicle, camera, computer and profile, which yields each row as soon as it
is known."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from datetime import datetime

from perchctl.calibration import profile_camera
from perchctl.camera import FrameSource, open_camera, parse_source, without_password
from perchctl.check import camera, capture, vehicle
from perchctl.check.profile import offline_rows
from perchctl.check.rehearsal import REHEARSED_S, Rehearsal, TakeTelemetry, rehearse
from perchctl.check.row import Finding, Row, Verdict, evaluate_row, passed, skipped, skipped_rows
from perchctl.errors import ConnectionFailed, PerchError, UsageError
from perchctl.flight import FlyOptions, WallClock, check_options, start_simulated_vehicle
from perchctl.link import ProbeLink, check_uri, find_uris_and_problem
from perchctl.positioning import CaptureSource, open_capture
from perchctl.profile import PositioningConfig, Profile
from perchctl.vehicle import DISARM_IT
from perchctl.vision import CameraModel, Pipeline, make_pipeline


@dataclass(frozen=True)
class CheckScope:
    """Extent of a check: whether the vehicle is lifted by hand, and the duration of each part.

    `announce` is called with a sentence about each step; `open_capture` connects to a
    motion-capture system.
    """

    with_lift: bool = False
    listen_s: float = vehicle.LISTEN_S
    rehearse_s: float = REHEARSED_S
    lift_s: float = vehicle.LIFT_S
    announce: Callable[[str], None] = lambda text: None
    open_capture: Callable[[PositioningConfig], CaptureSource] = open_capture
    capture_s: float = capture.CAPTURE_S


def scan_rows(uri: str | None) -> list[Row]:
    """Return the rows for `--scan`: the vehicles that answer at the default address and at `uri`
    (if not None). Errors: InvalidValue."""
    if uri is not None:
        check_uri(uri)
    return vehicle.radio_scan_rows(*find_uris_and_problem(uri or ""))


def check(options: FlyOptions, scope: CheckScope) -> Iterator[Row]:
    """Run all checks and yield each row as soon as it is known. Errors, before anything is opened:
    InvalidValue, NotFound (files of the profile), UsageError (a library that does not load)."""
    check_options(options)
    if options.has_own_link:
        raise UsageError(
            "perchctl check talks to the vehicle through cflib, not through your own link "
            f"{options.uri}: name a vehicle with --uri"
        )
    calibrated = profile_camera(options.profile.camera)
    pipeline = make_pipeline(options.profile, calibrated)
    with contextlib.ExitStack() as stack:
        uri, spec, profile = start_if_simulated(options, calibrated, scope, stack)
        mocap = open_room(profile, scope, stack)
        probe = ProbeLink(options.uri, profile.link, time.monotonic, link_uri=uri)
        stack.callback(probe.close)
        session = VehicleChecks(probe, options.uri, profile, mocap, scope)
        take = yield from session.rows()
        shown = without_password(options.source)
        scope.announce(f"opening the camera {shown}")
        rehearsal: Rehearsal | None = None
        try:
            size_px, asked = calibrated.size_px, options.profile.camera
            source = open_camera(spec, time.monotonic, asked, size_px=size_px)
            scheme = parse_source(options.source).scheme
        except PerchError as error:
            yield from camera.failed_camera_rows(error, options.source, options.profile)
        else:
            stack.callback(source.close)
            yield Row("camera", *passed(f"{shown} delivers pictures"))
            rehearsal = yield from _camera_rows(
                take, source, pipeline, options.profile, scope, scheme
            )
    yield evaluate_row("loop", camera.loop_finding, rehearsal, options.profile)
    yield from offline_rows(options)


def start_if_simulated(
    options: FlyOptions, calibrated: CameraModel, scope: CheckScope, stack: contextlib.ExitStack
) -> tuple[str, str, Profile]:
    """Return the URI, camera source and profile to connect with: those in the options, or those of
    a simulated vehicle, which is started here and runs until `stack` closes."""
    uri, spec, profile = options.uri, options.source, options.profile
    if options.simulated:
        scope.announce("starting the simulated vehicle")
        simulated = stack.enter_context(start_simulated_vehicle(options, calibrated))
        uri = simulated.uri
        spec = simulated.stream_url if spec.startswith("sim:") else spec
        if simulated.capture is not None:
            system, host = simulated.capture
            config = profile.positioning.model_copy(update={"system": system, "host": host})
            profile = profile.model_copy(update={"positioning": config})
    return uri, spec, profile


MocapOrError = CaptureSource | PerchError | None
"""An open connection to the motion-capture system, or the error that prevented opening it; None if
the profile uses no motion capture."""


def open_room(profile: Profile, scope: CheckScope, stack: contextlib.ExitStack) -> MocapOrError:
    config = profile.positioning
    if not config.source.is_mocap:
        return None
    scope.announce(f"connecting to {config.label}")
    try:
        opened = scope.open_capture(config)
    except UsageError:
        raise  # a library that cannot be loaded is an error, as in `fly`
    except PerchError as error:
        return error
    stack.callback(opened.close)
    return opened


@dataclass(frozen=True)
class VehicleChecks:
    """Checks of a vehicle and of its motion-capture system, if any.

    `uri`: the given address; `probe` may open a simulated vehicle's address instead.
    """

    probe: ProbeLink
    uri: str
    profile: Profile
    mocap: MocapOrError
    scope: CheckScope

    def rows(self) -> Generator[Row, None, TakeTelemetry]:
        """Yield the rows; return the function that takes new telemetry (None if no vehicle
        answers)."""
        self.scope.announce(f"connecting to {self.uri}")
        try:
            self.probe.connect()
        except ConnectionFailed as error:
            yield vehicle.unanswered_row(error, self.uri)
            yield from skipped_rows(
                [*vehicle.VEHICLE, vehicle.LIFTED], "the vehicle does not answer"
            )
            yield from self._room_rows(list)
            yield from self._compared_rows()
            return list
        yield Row("address", *passed(f"{self.uri} answers"))
        self.scope.announce(f"listening to the vehicle for {self.scope.listen_s:g} s")
        seen = vehicle.query_vehicle(self.probe, self.uri, self.scope.listen_s)
        for name, judge in vehicle.VEHICLE.items():
            yield evaluate_row(name, judge, seen, self.profile)
        yield from self._room_rows(self.probe.telemetry)
        yield from self._lift_rows(is_armed=seen.is_armed)
        return self.probe.telemetry

    def _room_rows(self, take: TakeTelemetry) -> list[Row]:
        """The rows about the motion-capture system; none if decks measure the position."""
        config = self.profile.positioning
        if self.mocap is None:
            return []
        if isinstance(self.mocap, PerchError):
            return capture.failed_capture_rows(self.mocap, config)
        seconds = self.scope.capture_s
        self.scope.announce(f"listening to {config.label} for {seconds:g} s")
        seen = capture.collect_samples(take, self.mocap, time.monotonic, time.sleep, seconds)
        return capture.mocap_rows_at_rest(seen, self.profile)

    def _compared_rows(self) -> list[Row]:
        simulated = self.uri.startswith("sim://")
        return capture.comparison_rows(
            self.profile.positioning, self.uri, datetime.now().astimezone(), simulated=simulated
        )

    def _lift_rows(self, *, is_armed: bool) -> Iterator[Row]:
        compared = self._compared_rows()
        if self.scope.with_lift and is_armed:
            yield from skipped_rows([vehicle.LIFTED], "it is armed", DISARM_IT)
        elif self.scope.with_lift:
            lifted = self._lift_finding()
            yield Row(vehicle.LIFTED, *lifted)
            if compared:
                config = self.profile.positioning
                compared = [
                    capture.save_comparison_row(
                        lifted, config, self.uri, datetime.now().astimezone()
                    )
                ]
        else:
            advice = "add --lift, and lift the vehicle by hand when asked to"
            yield from skipped_rows([vehicle.LIFTED], "not requested", advice)
        yield from compared

    def _lift_finding(self) -> Finding:
        config, mocap, within_s = self.profile.positioning, self.mocap, self.scope.lift_s
        if config.source.is_target:
            return skipped("the vehicle gets its position from the target, and only in flight")
        if mocap is None:
            self.scope.announce(f"now, within {within_s:g} s: {vehicle.HOW_TO_LIFT}")
            wait = vehicle.counting_down(within_s, self.scope.announce, time.monotonic, time.sleep)
            return vehicle.lift_finding(vehicle.record_lift(self.probe, wait, within_s))
        if isinstance(mocap, PerchError):
            return skipped(f"no {config.label}")
        self.scope.announce(f"now, within {within_s:g} s: {capture.HOW_TO_TURN}")
        take = self.probe.telemetry
        wait = vehicle.counting_down(within_s, self.scope.announce, time.monotonic, time.sleep)
        seen = capture.collect_samples(take, mocap, time.monotonic, wait, within_s)
        return capture.comparison_finding(
            capture.pair_motion(seen.telemetry, seen.body_poses(config)), config
        )


def _camera_rows(
    take: TakeTelemetry,
    source: FrameSource,
    pipeline: Pipeline,
    profile: Profile,
    scope: CheckScope,
    scheme: str,
) -> Generator[Row, None, Rehearsal | None]:
    """Yield the rows; return the rehearsal, or None if none was possible."""
    size = camera.size_finding(source.size_px, pipeline.camera.size_px)
    yield Row("size", *size)
    if size.verdict is not Verdict.PASS:
        why = "pictures of another size cannot be checked"
        yield from skipped_rows(camera.picture_row_names(profile), why)
        return None
    scope.announce(f"rehearsing with live pictures for {scope.rehearse_s:g} s")
    done = rehearse(take, source, pipeline, profile, WallClock(), scope.rehearse_s)
    done.scheme = scheme
    yield from camera.picture_rows(done, profile, pipeline.camera)
    return done
