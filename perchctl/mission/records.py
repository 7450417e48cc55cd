"""The records of a flight: its events, and each tick of the loop, complete and exact.

From the `TickRecord` records, the decisions of a flight can be replayed (`perchctl.analysis`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Literal, Protocol

from perchctl.geometry import Array
from perchctl.mission.belief.belief import GearToTargetDistance
from perchctl.mission.belief.quality import position_loss_text
from perchctl.mission.observation import Observation
from perchctl.mission.phase import Outcome, Phase, Severity, VehicleDiagnosis
from perchctl.mission.rest import RestState
from perchctl.mission.state import PlannerState
from perchctl.profile import Profile
from perchctl.vehicle import Command, ExternalPosition, Telemetry, is_battery_reading
from perchctl.vision import CameraCalibrationErrors, PictureKind, PipelineOutput, TargetEstimate

TickRole = Literal["waiting", "redone", "flown", "failed"]


class EventKind(Enum):
    """The kind of an `Event`: the mission entered a phase (`PHASE`), paused in its phase
    (`HOLD`), or there is something else to note, such as a missing battery reading (`NOTE`)."""

    PHASE = "phase"  # the mission entered a phase
    HOLD = "hold"  # the vehicle is holding its position
    NOTE = "note"  # other noteworthy information


@dataclass(frozen=True)
class Event:
    """An event of the flight, for its log and the displays: a time on the loop's clock, a kind, and
    a reason in words. An example is the transition from ASCEND to RECOVER.

    Attributes:
        phase: the phase that was entered or, for events other than `PHASE`, the present phase; None
            if it is not known.
        transition_name: name of the row of the transition table that caused the event; empty if
            none did.
        severity: severity of the flight after that transition; `HOLD` for a pause.
        simulated_fault: fault of the simulated scenario that caused the event; empty if none did.
        rest_state: rest state of the vehicle that a rescue found; None in all other events.
        diagnosis: the transition's diagnosis of the vehicle.
    """

    t_s: float
    kind: EventKind
    reason: str  # a sentence without its full stop
    phase: Phase | None = None  # phase that was entered, or the current one
    transition_name: str = ""  # transition of the table; empty at the start and if there was none
    severity: Severity = Severity.CONTINUE
    simulated_fault: str = ""  # fault of the simulated scenario that caused it
    rest_state: RestState | None = None  # rest state found by a rescue; None in all other events
    diagnosis: VehicleDiagnosis = VehicleDiagnosis.NONE  # diagnosis of the transition

    @classmethod
    def make_rescue_note(
        cls, t_s: float, error: BaseException, rest_state: RestState, rest_text: str
    ) -> Event:
        """Return the event that the rescue writes: the emergency landing after an exception in the
        loop. `error` is that exception, `rest_state` the vehicle's rest state, and `rest_text` the
        same state in words."""
        reason = f"{type(error).__name__} in flight: {rest_text}"
        return cls(t_s, EventKind.NOTE, reason, rest_state=rest_state)

    @classmethod
    def list_events_of_tick(
        cls,
        previous_state: PlannerState | None,
        state: PlannerState,
        obs: Observation,
        profile: Profile,
    ) -> list[Event]:
        """Return the events of one tick: a phase was entered, a pause began, or positions were
        lost; in the first tick, the initial phase and a missing battery reading. `previous_state`
        is the planner's state before the tick, None in the first tick."""
        events: list[Event] = []
        if previous_state is None:
            previous_state = PlannerState.initial_on_ground(obs, profile)
            events.append(
                cls(
                    obs.t_s, EventKind.PHASE, previous_state.transition_reason, previous_state.phase
                )
            )
            if not is_battery_reading(obs.telemetry.battery_v):
                grace_s = profile.safety.battery_stale_s
                text = f"no battery reading: landing within {grace_s:.0f} s"
                events.append(cls(obs.t_s, EventKind.NOTE, text, previous_state.phase))
        if state.phase is not previous_state.phase:
            entered = (
                EventKind.PHASE,
                state.transition_reason,
                state.phase,
                state.transition_name,
                state.severity,
            )
            events.append(cls(obs.t_s, *entered, diagnosis=state.entry.diagnosis))
        elif state.pause_reason and not previous_state.pause_reason:
            held = EventKind.HOLD, state.pause_reason, state.phase
            events.append(cls(obs.t_s, *held, severity=Severity.HOLD))
        elif (
            state.belief.position_last_stale_at_s == obs.t_s
            and previous_state.belief.position_last_stale_at_s != previous_state.t_s
            and not state.hold_reason
        ):
            text = position_loss_text(state.belief.with_observation(obs, profile))
            events.append(cls(obs.t_s, EventKind.NOTE, text, state.phase))
        return events


@dataclass(frozen=True)
class SentCommand:
    """A command that was handed to the link outside the loop's ticks, at `t_s` on the loop's clock.
    Whether it arrived is unknown.

    `sender` is ``watchdog`` while the loop does not respond, including for the operator's stop;
    ``rescue`` after an error; ``reconnect`` for a command repeated after a lost link; ``preflight``
    for arming a vehicle that does not arm itself; ``farewell`` for disarming it, and for the zero
    setpoint that closes the link.
    """

    t_s: float
    sender: str
    command: Command


@dataclass(frozen=True)
class ExternalPositionStatus:
    """The external positions sent to the vehicle: their number so far, their rate in the last
    second, Hz, the newest one (None before the first), the time since its exposure, s, and the
    problem because of which none is sent now (None while they are sent)."""

    newest_position_age_s: float  # age of the newest position
    problem: str | None  # why none is sent now
    sent_count: int
    rate_hz: float
    newest_position: ExternalPosition | None  # newest position


@dataclass(frozen=True)
class FrameRecord:
    """A `perchctl.vision.Frame` from the camera, without its picture: index, times of exposure
    (`t_s`) and arrival on the loop's clock, the kind of picture (whole, interlaced, or one of its
    two fields), whether the frame repeats the previous picture, and a checksum of the picture (None
    if it was not searched or not recorded)."""

    index: int
    t_s: float
    t_arrival_s: float
    picture_kind: PictureKind | None = None
    is_repeated: bool = False
    # checksum of the picture; None if the picture was not searched or not recorded
    checksum: int | None = None


@dataclass(frozen=True)
class TickInputs:
    """The inputs of one tick, from link and camera.

    Attributes:
        samples: telemetry samples in the order of arrival.
        late_samples: samples that arrived while camera or vision blocked the tick.
        frame: the new frame; None if none arrived.
        camera_problem, has_camera_source_ended, is_camera_source_live: as reported by the camera
            source; a recording ends and is not live.
        is_detection_requested: the frame was meant to be searched for markers.
        sends_sightings_as_position: sightings are sent to the vehicle as external positions.
        has_discarded_sightings: earlier sightings were discarded because positions had diverged.
    """

    samples: tuple[Telemetry, ...] = ()  # in the order of arrival
    late_samples: tuple[Telemetry, ...] = ()  # arrived while camera or vision blocked the loop
    frame: FrameRecord | None = None
    # the next three are reported by the camera source
    camera_problem: str | None = None
    has_camera_source_ended: bool = False
    is_camera_source_live: bool = True
    is_detection_requested: bool = True  # the frame was meant to be searched for markers
    sends_sightings_as_position: bool = True  # sightings are the vehicle's external position
    # earlier sightings were discarded because positions had diverged
    has_discarded_sightings: bool = False


@dataclass(frozen=True, eq=False)
class UnfilteredPose:
    """The pose of the target in one picture, without a filter: exposure time, vector (3,) from the
    gear to the target in the level frame (ahead, left, up), m, and the target's heading relative to
    the vehicle's, rad, positive counter-clockwise from above."""

    t_s: float
    gear_to_target_level_m: Array
    vehicle_to_target_yaw_rad: float


@dataclass(frozen=True, eq=False, kw_only=True)
class TickRecord:
    """One tick of the loop, complete and exact: its inputs and its decision. A log stores it as a
    record of kind ``turn``.

    `began_s` is the time on the loop's clock at which the tick began, and `t_s` that of its
    decision, which is later if camera or vision blocked the loop. `role` is one of

    - ``waiting``: before take-off;
    - ``flown``: the command was sent;
    - ``redone``: the loop had been blocked unnoticed, so the decision was discarded, and made again
      in the next tick;
    - ``failed``: the planner raised an exception.

    The fields `phase` to `reason` show the planner's state after its decision. `observation` and
    `command` are None while waiting; `command` is also None in a failed tick.
    """

    number: int  # counts from 0; a gap is a missing tick
    role: TickRole
    began_s: float
    t_s: float  # time of the decision; later than `began_s` if the loop was blocked
    inputs: TickInputs
    # by the name of the marker, or ``joint`` for a pose from both
    unfiltered_pose_by_marker: dict[str, UnfilteredPose] = field(default_factory=dict)
    observation: Observation | None = None  # None while waiting
    command: Command | None = None  # None while waiting, and for a failed tick
    phase: Phase | None = None
    transition_name: str = ""
    is_holding_position: bool = False
    failed_attempts: int = 0
    external_positions: ExternalPositionStatus | None = None
    outcome: Outcome | None = None
    reason: str | None = None  # None in logs before version 4, which also lack the outcome
    planner_exception_name: str | None = None  # name of the planner's exception


@dataclass(frozen=True, eq=False, kw_only=True)
class Tick:
    """A flown tick with the planner's whole state and the pipeline's output; the log keeps only
    parts of both.

    `output` is None if no new frame was searched. `camera_errors` holds the errors of latency and
    mounting if they were estimated in this tick.
    """

    record: TickRecord
    state: PlannerState
    output: PipelineOutput | None = None
    camera_errors: CameraCalibrationErrors | None = None

    @property
    def observation(self) -> Observation:
        assert self.record.observation is not None, "every tick in flight has an observation"
        return self.record.observation

    @property
    def command(self) -> Command:
        assert self.record.command is not None, "every tick in flight has a command"
        return self.record.command

    @property
    def t_s(self) -> float:
        return self.observation.t_s

    @property
    def telemetry(self) -> Telemetry:
        return self.observation.telemetry

    @property
    def target(self) -> TargetEstimate | None:
        """The target estimate that the planner used; None before the first sighting."""
        return self.observation.target

    @property
    def gear_to_target_at_contact(self) -> GearToTargetDistance | None:
        """Lateral distance between gear and target at the proven contact, with its standard
        deviation; None in all phases except COMPLETE and PERCHED."""
        is_at_target = self.state.phase in (Phase.COMPLETE, Phase.PERCHED)
        return self.state.belief.gear_to_target_at_last_contact if is_at_target else None

    @property
    def target_to_show(self) -> TargetEstimate | None:
        """The target estimate, for displays; None before the first sighting. In COMPLETE and the
        final phases, it is None while the target is not tracked, because the estimate of a target
        that the camera cannot see drifts; in all other phases, it is shown even while the target is
        not tracked. It is also None once `gear_to_target_at_contact` is recorded, which displays
        show instead."""
        target, phase = self.target, self.state.phase
        is_shown_unseen = phase.is_before_contact or phase is Phase.LANDING
        is_shown = target is not None and (target.tracked or is_shown_unseen)
        return target if is_shown and self.gear_to_target_at_contact is None else None

    @property
    def gear_to_target_lateral_and_up_m(self) -> tuple[float, float] | None:
        """For displays: the lateral distance between gear and target, m, at least 0, and the height
        of the target above the gear, m, positive up. In COMPLETE and PERCHED, these are the
        distances at the proven contact, with a height of 0. None if the distance at the contact is
        unknown, or if there is no estimate that may be shown (`target_to_show`)."""
        contact, target = self.gear_to_target_at_contact, self.target_to_show
        if contact is not None and math.isfinite(contact.sigma_m):
            return contact.distance_xy_m, 0.0
        return None if target is None else (math.hypot(*target.e_m[:2]), float(target.e_m[2]))

    @property
    def tick_start_delay_s(self) -> float:
        return self.observation.tick_start_delay_s

    @property
    def last_good_frame_age_s(self) -> float:
        return self.observation.last_good_frame_age_s

    @property
    def telemetry_age_s(self) -> float:
        """Age of the oldest part of the newest telemetry, s."""
        return self.t_s - self.telemetry.t_s + self.telemetry.behind_s

    @property
    def camera_latency_above_profile_s(self) -> float:
        """Latency, s, that is subtracted from the frames' arrival times in addition to the
        profile's latency. It is estimated in flight, and 0 unless `camera.latency_s` is
        ``measured``."""
        return self.observation.camera_latency_above_profile_s

    @property
    def external_positions(self) -> ExternalPositionStatus | None:
        """Number, rate and age of the external positions sent to the vehicle; None if it is
        positioned by one of its own decks, so that none are sent."""
        return self.record.external_positions


class Watcher(Protocol):
    """Receiver of ticks and events: flight log, panel or live page. A watcher that raises an
    exception is detached, and the flight continues without it; the watcher's attribute `name`
    appears in the message."""

    def tick(self, tick: Tick) -> None:
        """Handle a flown tick."""
        return

    def event(self, event: Event) -> None:
        """Handle an event of the flight."""
        return

    @property
    def problem(self) -> str | None:
        """Why the watcher lost records; None if it has lost none."""
        return None
