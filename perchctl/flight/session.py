"""One flight in real time, from options to report: open link, camera and log, fly, and close
them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

from perchctl.calibration import profile_camera
from perchctl.camera import open_camera, parse_source
from perchctl.errors import (
    ConnectionFailed,
    InvalidValue,
    SafetyAbort,
    TimedOut,
    UsageError,
    no_motion_capture,
    no_simulator,
)
from perchctl.extensions import load_extension, make_extension
from perchctl.flight.clock import Clock, SimulatedClock, WallClock
from perchctl.flight.loop import FlightParts, fly
from perchctl.flight.operator import OperatorSwitch
from perchctl.link import (
    CflibLink,
    GuardedLink,
    VehicleLink,
    check_uri,
    is_own_uri,
    vehicle_uri,
)
from perchctl.mission import FlightReport, Transition, Watcher, add_rows, load_table
from perchctl.positioning import PositionFeed, load_comparison, open_capture
from perchctl.profile import PositioningConfig, Profile
from perchctl.vision import CameraModel, make_pipeline

if TYPE_CHECKING:
    from perchctl.sim import SimProcess


@dataclass(frozen=True)
class FlyOptions:
    """The options for one flight, from the command line or, if not given there, from the
    profile."""

    profile: Profile
    profile_path: Path
    uri: str
    source: str
    # a seed with an uneventful flight, because this is a newcomer's first flight
    seed: int = 11
    log_dir: Path = Path("perchctl-logs")
    record: bool = False
    sim_target_xy_m: tuple[float, float] | None = None
    """Position of a simulated target relative to the vehicle; None: drawn from the seed."""
    link_uri: str | None = None
    """URI that the link opens instead of `uri`, for a vehicle behind a radio hub."""
    serve_pictures: bool = False
    """True for a vehicle in a fleet whose process serves its images for the fleet's page."""

    @property
    def simulated(self) -> bool:
        """True if the URI is that of the simulated vehicle."""
        return self.uri.startswith("sim://")

    @property
    def has_own_link(self) -> bool:
        """True if the URI names your own link, such as ``my_module:MyLink``."""
        return is_own_uri(self.uri)

    def require_lift_check(self) -> None:
        require_lift_check(self.profile.positioning, self.uri, simulated=self.simulated)


def check_options(options: FlyOptions) -> None:
    """Check the options before anything is opened. Errors: InvalidValue, UsageError."""
    load_table(options.profile.planner.rows)
    if not options.has_own_link:
        check_uri(options.uri)
    elif load_extension(options.uri, "link.uri") and not options.profile.positioning.source.is_deck:
        raise UsageError(
            f"your own link {options.uri} cannot send positions: set positioning: deck, not "
            f"{options.profile.positioning.by}"
        )
    if options.profile.positioning.source.is_mocap and not options.simulated:
        PositionFeed.check_config(options.profile.positioning)
    elif options.profile.positioning.source.is_mocap and find_spec("motioncapture") is None:
        # a simulated motion-capture system also needs this library, but not `positioning.host`
        raise no_motion_capture()
    source = parse_source(options.source)
    if source.is_own:
        load_extension(options.source, "camera.source")
    if source.scheme == "sim" and not options.simulated:
        raise UsageError(
            f"source {source} belongs to the simulated vehicle, but the URI is "
            f"{options.uri}; name the camera with --source (camera:N, http://..., aideck://HOST)"
        )
    if not source.live and not options.simulated:
        raise UsageError(
            f"source {source} is a recording, but {options.uri} is a real vehicle: fly "
            "sim://, or name a camera with --source"
        )
    if options.seed < 0:
        raise InvalidValue(f"seed {options.seed} is negative; use 0 or more")


def fly_session(
    options: FlyOptions,
    watchers: tuple[Watcher, ...] = (),
    switch: OperatorSwitch | None = None,
    begin_turn: Callable[[], None] = lambda: None,
    remarks: Callable[[], Sequence[str]] = tuple,
    before_arming: Callable[[], None] | None = None,
    rows: Sequence[Transition] = (),
    may_take_off: Callable[[str], bool] = lambda waiting: True,
    climb_withheld: Callable[[], str | None] = lambda: None,
) -> tuple[FlightReport, float | None]:
    """Fly once, in real time through cflib. Raises any error of `perchctl.errors`.

    Returns the report and, if a simulator can measure it, the gear's distance from the target's
    centre, m.

    `switch` carries the operator's commands. `begin_turn`, `remarks`, `may_take_off`, and
    `climb_withheld`: as in `FlightParts`. `before_arming` is called once vehicle and camera have
    answered. If `before_arming` raises an exception, the session ends on the ground. `rows` are
    added to the profile's transition table.
    """
    options.require_lift_check()
    profile, switch = options.profile, switch or OperatorSwitch()
    camera = profile_camera(profile.camera)
    pipeline = make_pipeline(profile, camera)
    table = add_rows(rows, load_table(profile.planner.rows))
    with contextlib.ExitStack() as stack:
        uri, spec, simulated = options.link_uri or options.uri, options.source, None
        clock: WallClock | SimulatedClock = WallClock()
        if options.simulated:
            simulated = stack.enter_context(start_simulated_vehicle(options, camera))
            clock = SimulatedClock(simulated.shared_time)
            uri = simulated.uri
            spec = simulated.stream_url if spec.startswith("sim:") else spec
        source = open_camera(spec, clock.now, profile.camera, size_px=camera.size_px)
        stack.callback(source.close)
        if not (options.simulated or source.live):
            raise UsageError(f"{source.describe()} is not a live camera: a real vehicle needs one")
        positioning = profile.positioning
        if simulated is not None and simulated.capture is not None:
            system, host = simulated.capture
            positioning = positioning.model_copy(update={"system": system, "host": host})
        link: CflibLink | GuardedLink
        if options.has_own_link:
            own = make_extension(uri, "link.uri", VehicleLink, clock.now, profile.link)
            link = GuardedLink(own, clock.now)
        else:
            link = CflibLink(
                options.uri, profile.link, clock.now, positioning=positioning, link_uri=uri
            )
        try:
            link.connect()
            if before_arming is not None:
                before_arming()
            positions = None
            if isinstance(link, CflibLink):
                positions = start_position_feed(
                    stack, link, positioning, clock, profile.safety.ground_z_m
                )
            switch.listening = True
            parts = FlightParts(
                link,
                source,
                clock,
                profile,
                pipeline,
                watchers,
                switch.read,
                positions,
                lambda: [*remarks(), *link.new_notes()],
                table,
                begin_turn=begin_turn,
                may_take_off=may_take_off,
                climb_withheld=climb_withheld,
                simulated=options.simulated,
            )
            with contextlib.ExitStack() as waiting:
                if isinstance(clock, SimulatedClock):
                    waiting.enter_context(clock.waiting_for_loop())
                report = fly(parts)
        finally:
            # Ctrl-C must not interrupt the closing of the link
            switch.listening = switch.closing = True
            link.close()
        return report, _true_miss_m(simulated)


def _true_miss_m(simulated: SimProcess | None) -> float | None:
    if simulated is None:
        return None
    with contextlib.suppress(ConnectionFailed, TimedOut):
        return float(simulated.truth()["gear_miss_m"])
    return None


def start_simulated_vehicle(options: FlyOptions, camera: CameraModel) -> SimProcess:
    """Start the simulated vehicle with its camera's stream. Raises UsageError if the simulator is
    not installed."""
    if find_spec("mujoco") is None:
        raise no_simulator()
    from perchctl.sim import SimProcess, draw_capture, draw_scenario

    scenario = draw_scenario(options.profile, options.seed)
    if options.sim_target_xy_m is not None:
        scenario = replace(scenario, target_xy_m=options.sim_target_xy_m)
    return SimProcess.start(
        scenario,
        camera=camera,
        target=options.profile.target,
        capture=draw_capture(options.profile, options.seed),
    )


# --- External positions for one flight in real time: motion capture and position feed ---


def require_lift_check(config: PositioningConfig, uri: str, *, simulated: bool) -> None:
    """Raise SafetyAbort unless this vehicle was recently lifted by hand and compared with the
    motion-capture system (`perchctl check --lift`), because swapped axes cannot be detected at
    rest. A simulated vehicle always passes."""
    if not config.source.is_mocap or simulated:
        return
    objected = load_comparison(config, vehicle_uri(uri)).objection_and_advice(
        datetime.now().astimezone()
    )
    if objected is not None:
        raise SafetyAbort(": ".join(objected))


def start_position_feed(
    stack: contextlib.ExitStack,
    link: CflibLink,
    config: PositioningConfig,
    clock: Clock,
    ground_z_m: float = 0.0,
) -> PositionFeed | None:
    """Settle the state estimate, then send positions from motion capture to the vehicle until
    `stack` closes. `stack` must close after the link, because a landing vehicle needs the
    positions. Returns None if the profile uses no motion capture.

    Raises the errors of `CflibLink.settle_estimator`, InvalidValue, UsageError and
    ConnectionFailed."""
    if config.source.is_target:
        link.settle_estimator(None, ground_z_m)
    if not config.source.is_mocap:
        return None
    capture = open_capture(config, clock.now)
    stack.callback(capture.close)
    feed = PositionFeed(capture, link.send_external, config)
    stack.callback(feed.close)
    feed.start(clock.now)
    link.settle_estimator(feed)
    return feed
