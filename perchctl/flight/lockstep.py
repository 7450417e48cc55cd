"""Fly a complete flight in lockstep: the flight loop runs on simulated time, and the same seed
gives exactly the same flight."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from perchctl.calibration import profile_camera
from perchctl.camera import FrameSource, NewestSlot, WrappedSource, unmirror_frame
from perchctl.errors import ConnectionFailed, Note
from perchctl.flight.loop import FlightParts, fly
from perchctl.link import MockLink, Radio
from perchctl.mission import (
    FlightReport,
    OperatorRequest,
    Phase,
    Tick,
    Transition,
    Watcher,
    add_rows,
    load_table,
)
from perchctl.positioning import PositionFeed, VehiclePose
from perchctl.profile import Profile
from perchctl.record import FlightSummary, LogWatcher
from perchctl.sim import (
    CaptureSettings,
    Scenario,
    SimulatedVehicle,
    draw_capture,
    draw_scenario,
)
from perchctl.values import replace
from perchctl.vehicle import LOCKED
from perchctl.vision import Frame, StepFunction, make_pipeline

MAY_TOUCH_THE_FLOOR = (Phase.APPROACH, Phase.LANDING, Phase.LANDED, Phase.ABORTED)
_QUEUED = 2  # number of images that may wait for the loop; a newer one replaces the oldest
HARD_LANDING_MPS = 1.0  # hitting the floor faster than this is a fall, regardless of the log
FIRST_FRAME_S = 1.0


class LockstepClock:
    """The simulated vehicle's time; waiting advances the simulation."""

    def __init__(self, link: MockLink) -> None:
        self._link = link

    def now(self) -> float:
        return self._link.now_s

    def wait_until(self, t_s: float) -> None:
        if t_s > self._link.now_s:
            self._link.advance_to(t_s)


class LockstepSource:
    """The frames delivered by the simulated camera; as with a live camera, only the newest is
    returned."""

    live = True
    finished = False

    def __init__(self, vehicle: SimulatedVehicle, latency_s: float) -> None:
        assert vehicle.camera is not None
        self._camera = vehicle.camera
        self._latency_s = latency_s
        self._slot = NewestSlot()
        self._count = 0

    def poll(self, now_s: float) -> Frame | None:
        for each in self._camera.take_newest(_QUEUED):
            self._slot.put(each.image, each.t_arrival_s - self._latency_s, each.t_arrival_s)
        frame = self._slot.take()
        if frame is None:
            return None
        self._count += not frame.is_repeated
        return replace(frame, index=self._count - 1)

    def problem(self, now_s: float) -> str | None:
        return None

    @property
    def size_px(self) -> tuple[int, int] | None:
        return self._camera.renderer.camera.size_px

    def describe(self) -> str:
        return "sim:"

    def close(self) -> None:
        return None


def lockstep_source(vehicle: SimulatedVehicle, profile: Profile) -> FrameSource:
    """The frame source for the simulated camera; mirrored frames are flipped back."""
    source = LockstepSource(vehicle, profile.camera.start_latency_s)
    return WrappedSource(source, unmirror_frame) if profile.camera.mirrored else source


class TruthWatcher(Watcher):
    """Detects falls in the simulator's true state, to which the flight has no access."""

    def __init__(self, vehicle: SimulatedVehicle) -> None:
        self._vehicle = vehicle
        self._sink_mps = 0.0
        self._was_down = True
        self.fell = False
        self.touchdown_mps = 0.0

    def tick(self, tick: Tick) -> None:
        world = self._vehicle.world
        on_purpose = tick.state.phase in MAY_TOUCH_THE_FLOOR
        _, is_down = world.push_n_and_on_floor()
        if is_down and (not on_purpose or self._sink_mps > HARD_LANDING_MPS):
            self.fell = True
        if is_down and not self._was_down:
            self.touchdown_mps = max(self.touchdown_mps, self._sink_mps)
        self._was_down = is_down
        self._sink_mps = -world.vz_mps

    def position_and_miss(self) -> tuple[tuple[float, float, float], float]:
        world = self._vehicle.world
        return (world.x_m, world.y_m, world.z_m), world.gear_miss_m()


@dataclass(frozen=True)
class LockstepFlight:
    """A finished flight, with the vehicle's true final state.

    `miss_m`: horizontal distance from the gear to the target's centre. `hanging`: the vehicle is
    hanging from the magnet. `locked`: the firmware's supervisor has locked the vehicle.
    """

    report: FlightReport
    miss_m: float
    hanging: bool
    fell: bool
    locked: bool
    touchdown_mps: float
    scenario: Scenario

    @property
    def perched_miss_m(self) -> float | None:
        """The gear's distance from the target's centre, m; None if the vehicle is not perched."""
        return self.miss_m if self.report.phase is Phase.PERCHED and self.hanging else None

    @property
    def final_phase(self) -> Phase:
        """The phase in which the flight ended; ABORTED if the vehicle fell."""
        return Phase.ABORTED if self.fell else self.report.phase

    def close_log(self, log: LogWatcher) -> FlightSummary | None:
        """Write the summary of the flight, close its log, and return the summary."""
        return log.close(self.report, self.perched_miss_m, self.fell)


def fly_lockstep(
    profile: Profile,
    seed: int = 0,
    log: LogWatcher | Path | str | None = None,
    *,
    scenario: Scenario | None = None,
    capture: CaptureSettings | None = None,
    operator: Callable[[], OperatorRequest] = lambda: OperatorRequest.NONE,
    watchers: tuple[Watcher, ...] = (),
    rows: Sequence[Transition] = (),
    camera: Callable[[FrameSource], FrameSource] = lambda source: source,
    perception: StepFunction | None = None,
) -> LockstepFlight:
    """Fly the profile's scenario with one seed to the end, faster than real time.

    Args:
        log: the log file, or a watcher, which is closed only if the flight raises an exception.
        scenario, capture: used instead of those drawn from the seed.
        operator: the operator's command.
        watchers: further watchers of the flight. A watcher that raises an exception is detached,
            with a `Note` as a warning after the flight.
        rows: your own transitions, in addition to those of the profile.
        camera: function that is called with the simulated camera, and returns the frame source to
            fly with.
        perception: your own estimator, called with the same arguments instead of `perchctl.step`.
            The planner flies to the `target` in the state that it returns.

    Errors: NotFound, InvalidValue (calibration, log file, rows).
    """
    table = add_rows(rows, load_table(profile.planner.rows))
    scenario = draw_scenario(profile, seed) if scenario is None else scenario
    opened: LogWatcher | None = None
    if isinstance(log, (Path, str)):
        log = opened = LogWatcher.open_lockstep(Path(log), profile, scenario.seed)
    model = profile_camera(profile.camera)
    capture = capture or draw_capture(profile, scenario.seed)
    vehicle = SimulatedVehicle(scenario, model, profile.target, capture)
    link = MockLink(vehicle, profile.link.telemetry_period_s, Radio(scenario.radio_bursts()))
    positions = lockstep_feed(link, profile)
    source = camera(lockstep_source(vehicle, profile))
    truth = TruthWatcher(vehicle)
    if log is not None:
        log.truth = truth.position_and_miss
        watchers = (*watchers, log)
    parts = FlightParts(
        link,
        source,
        LockstepClock(link),
        profile,
        replace(make_pipeline(profile, model), custom_step=perception),
        watchers,
        operator,
        positions,
        tuple if log is None else log.remarks,
        table,
        judges=(truth,),
        simulated=True,
    )
    try:
        link.connect()
        report = fly(parts)
    except BaseException as error:
        if log is not None:
            log.abandon(str(error) or type(error).__name__)
        for sentence in getattr(error, "__notes__", ()):
            warnings.warn(sentence, Note, stacklevel=2)
        raise
    vehicle.watched = False
    link.close()
    link.advance_to(link.now_s + 1.0)
    hanging = vehicle.world.magnet_engaged
    flight = LockstepFlight(
        report=report,
        miss_m=vehicle.world.gear_miss_m(),
        hanging=hanging,
        fell=truth.fell or (report.phase is Phase.PERCHED and not hanging),
        locked=bool(vehicle.firmware.supervisor_info & LOCKED),
        touchdown_mps=truth.touchdown_mps,
        scenario=scenario,
    )
    if opened is not None:
        flight.close_log(opened)
    for sentence in report.detached_watcher_messages:
        warnings.warn(sentence, Note, stacklevel=2)
    return flight


# --- External positions in lockstep: simulated motion capture through the same feed ---


def lockstep_feed(link: MockLink, profile: Profile) -> PositionFeed | None:
    """A feed of positions from the simulated motion-capture system, on the link's clock; None
    without such a system.

    Advances the simulation until the system sees the vehicle, and starts the state estimate at that
    position. Raises ConnectionFailed if the vehicle is not seen.
    """
    capture, config = link.vehicle.capture, profile.positioning
    if config.source.is_target:
        origin_m = np.array([0.0, 0.0, profile.safety.ground_z_m])
        link.settle_estimator(config, VehiclePose(link.now_s, origin_m, np.eye(3)))
        return None
    if capture is None or not config.source.is_mocap:
        return None
    config = config.model_copy(update={"system": capture.SYSTEM, "host": "sim"})
    feed = PositionFeed(capture, link.send_external, config)
    link.call_every(PositionFeed.PERIOD_S, feed.poll_and_send)
    end_s = link.now_s + FIRST_FRAME_S
    while (place := feed.sent_pose()) is None:
        if link.now_s >= end_s:
            why = feed.status(link.now_s).problem or f"nothing arrives from {config.label}"
            raise ConnectionFailed(f"no position within {FIRST_FRAME_S:g} s: {why}")
        link.advance_to(link.now_s + PositionFeed.PERIOD_S)
    link.settle_estimator(config, place)
    return feed
