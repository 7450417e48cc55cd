"""The inputs of one tick of the loop: telemetry, at most one frame, and the values computed from
them.

A turn is any iteration of the loop; a tick is a turn whose command is sent.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import numpy as np

from perchctl.camera import VERDICT_TEXTS, FrameSource, check_size, mirrored_problem
from perchctl.mission import (
    ExternalPositionStatus,
    FrameRecord,
    Observation,
    PlannerState,
    TickInputs,
    TickRecord,
    UnfilteredPose,
)
from perchctl.perception import (
    History,
    Perception,
    add_samples,
    attitude_at,
)
from perchctl.positioning import FeedStatus, TargetFeed
from perchctl.profile import Profile
from perchctl.values import replace
from perchctl.vehicle import Command, SendPosition, Telemetry
from perchctl.vision import (
    Frame,
    MarkerPose,
    Pipeline,
    PipelineOutput,
    TargetEstimate,
)

DOUBTFUL_KINDS = ("dark", "uniform")
"""Kinds of doubtful images that are searched anyway. A target may still be visible in a dark image,
and a bare ceiling looks like an empty screen."""
HEARD_S = 0.15  # extrapolating a detection with an older estimate would make the vehicle oscillate


class TelemetrySource(Protocol):
    """The part of a `perchctl.link.Link` that `FlightInputs` reads."""

    def telemetry(self) -> list[Telemetry]: ...


@dataclass(eq=False)
class FlightInputs:
    """Builds the planner's observation from telemetry and at most one frame per tick."""

    SENSED_FIELDS: ClassVar = (
        "telemetry",
        "target",
        "has_new_frame",
        "last_good_frame_age_s",
        "camera_problem",
        "battery_reading_age_s",
        "has_estimated_position_jumped",
        "heading_jump_rad",
        "successive_marker_conflict_frames",
        "camera_latency_above_profile_s",
        "camera_latency_sigma_s",
        "target_refusal_reason",
        "imu",
        "visual_inertial_motion",
        "camera_imu_mismatch",
    )
    """The fields of an `Observation` that this module fills in. The loop fills in the others."""

    link: TelemetrySource
    source: FrameSource
    pipeline: Pipeline
    profile: Profile
    send: SendPosition = lambda place: True
    is_logged: bool = False  # if True, the log also stores checksums of the images
    # Called with each frame in the form in which the source delivered it.
    on_frame: Callable[[Frame], None] = lambda frame: None
    perception: Perception = field(init=False)
    # Sends the vehicle's positions if the target is its positioning system.
    target_positioning: TargetPositioning | None = field(init=False, default=None)
    sends_sights: bool = True
    output: PipelineOutput | None = None  # output for this tick's frame, if it was searched
    taken: TickInputs = field(default_factory=TickInputs)  # what was received in this tick
    is_blind: bool = False
    repeated: bool = False  # this tick's frame is identical to the previous one
    last_good_frame_s: float = -math.inf
    camera_problem: str | None = None
    # If the camera's problem is a bad image, its kind according to `FrameHealth`; otherwise None.
    problem_kind: str | None = None
    frames: int = 0
    _frame_kind: str = "ok"  # kind of the newest frame, according to `FrameHealth`
    _note: str | None = None

    def __post_init__(self) -> None:
        self.perception = Perception(self.pipeline, self.profile)
        if self.profile.positioning.source.is_target:
            self.target_positioning = TargetPositioning(self.send, self.pipeline, self.profile)

    @property
    def history(self) -> History:
        return self.perception.history

    def poll_inputs(
        self,
        now_s: float,
        *,
        search: bool = True,
        sends_sights: bool = True,
        drops_sightings: bool = False,
    ) -> None:
        """Read telemetry and at most one frame.

        Args:
            search: search the frame for the target; otherwise the frame only shows that the camera
                works.
            sends_sights: send the positions measured from the target if it is the positioning
                system; False once the vehicle is descending without them.
            drops_sightings: discard the detections from which the vehicle's motion is estimated.
        """
        self.sends_sights = sends_sights
        perception, positioning = self.perception, self._positioning
        if drops_sightings:
            perception.drop_sightings()
        samples = self.link.telemetry()
        perception.history = add_samples(self.history, samples, self.profile.safety)
        if positioning is not None:
            positioning.begin_tick(self.history, now_s, in_contact=not search)
        self.output, self.is_blind, self.repeated = None, not search, False
        frame = self.source.poll(now_s)
        problem = self.source.problem(now_s)
        seen: FrameRecord | None = None
        if frame is not None:
            self.on_frame(frame)
            times_s = frame.t_s, frame.t_arrival_s
            seen = FrameRecord(frame.index, *times_s, frame.picture_kind, frame.is_repeated)
        self.taken = TickInputs(
            tuple(samples),
            frame=seen,
            camera_problem=problem,
            has_camera_source_ended=self.source.finished,
            is_camera_source_live=self.source.live,
            is_detection_requested=search,
            sends_sightings_as_position=sends_sights,
            has_discarded_sightings=drops_sightings,
        )
        if frame is None:
            if problem is None and self.source.finished:
                problem = self.ended_text(self.source.describe())
            if problem is not None:
                self.camera_problem, self.problem_kind = problem, None
            return
        # the source itself has another image size; a later image of another size is just corrupted
        if self.frames == 0:
            check_size(self.source.size_px, self.pipeline.camera, self.source.describe())
        self._frame_kind = "ok"
        rejection = problem or self._rejection(frame, now_s)
        self.repeated = self._frame_kind == "repeated"
        is_doubtful = self._frame_kind in DOUBTFUL_KINDS
        if rejection is not None:
            if not self.repeated:  # a repeated frame changes nothing, not even the camera's problem
                self.camera_problem = rejection
                is_unusable = self._frame_kind != "ok" and not is_doubtful
                self.problem_kind = self._frame_kind if is_unusable else None
            return
        self.last_good_frame_s = now_s
        self.frames += 1
        if search:
            for _, self.output in perception.process_fields(frame):
                if positioning is not None and self._is_heard(now_s):
                    positioning.add_pose(
                        perception.state.marker_poses.most_certain_pose, self.history, now_s
                    )
        self.camera_problem = self._note
        self.problem_kind = self._frame_kind if is_doubtful else None
        if perception.is_mirrored:
            self.camera_problem = mirrored_problem(self.profile.camera).sentence
            self.problem_kind = "mirrored"

    @staticmethod
    def ended_text(name: str) -> str:
        """Return the camera's problem after the recording `name` has ended."""
        return f"{name} has ended"

    @property
    def _positioning(self) -> TargetPositioning | None:
        return self.target_positioning if self.sends_sights else None

    def _is_heard(self, now_s: float) -> bool:
        newest = self.history.newest
        return newest is not None and now_s - newest.t_s + newest.behind_s <= HEARD_S

    def picture_problem(self, now_s: float) -> str | None:
        """Return why there is currently no good image; None if there is one. Possible reasons: no
        image has arrived, the newest image could not be used as a measurement, or the last good
        image is older than `safety.camera_hold_s`. An image that is only dark or empty counts as
        good."""
        age_s = now_s - self.last_good_frame_s
        if self.frames == 0:
            return self.camera_problem or "none has arrived"
        if not age_s <= self.profile.safety.camera_hold_s:
            return self.camera_problem or f"none for {age_s:.1f} s"
        return None if self.camera_problem == self._note else self.camera_problem

    def telemetry_age_s(self, now_s: float) -> float:
        """The age of the oldest value in the newest telemetry. A value that stays the same while
        others change is considered as old as the first sample that contained it. Infinite before
        the first telemetry."""
        newest, imu = self.history.newest, self.history.imu
        if newest is None:
            return math.inf
        return (
            now_s
            - newest.t_s
            + max(newest.behind_s, imu.only_attitude_frozen_for_s, imu.only_position_frozen_for_s)
        )

    def catch_up(self, began_s: float, now_s: float) -> None:
        """Process the telemetry that arrived while the camera or the vision code hung, in the tick
        that began at `began_s`."""
        late = self.link.telemetry()
        self.perception.history = add_samples(self.history, late, self.profile.safety, late=True)
        self.taken = replace(self.taken, late_samples=tuple(late))
        if self.last_good_frame_s == began_s:
            # this tick received an image, so the camera has not failed
            self.last_good_frame_s = now_s

    def observation(self, now_s: float) -> Observation:
        """The observation with the fields of `SENSED_FIELDS`; the loop adds the others."""
        perception, newest = self.perception, self.history.newest
        assert newest is not None
        return Observation(
            t_s=now_s,
            telemetry=newest,
            target=self.target(now_s),
            has_new_frame=self.output is not None,
            last_good_frame_age_s=now_s - self.last_good_frame_s,
            camera_problem=self.camera_problem,
            battery_reading_age_s=self.history.battery_age_s(now_s),
            has_estimated_position_jumped=self.history.jumped,
            heading_jump_rad=self.history.turned_rad,
            successive_marker_conflict_frames=perception.state.successive_frames_with_contradicting_markers,
            camera_latency_above_profile_s=perception.calibration.applied_delay_s,
            camera_latency_sigma_s=perception.latency_sigma_s,
            target_refusal_reason=perception.refused,
            imu=self.history.imu,
            visual_inertial_motion=perception.motion.motion,
            camera_imu_mismatch=perception.motion.mismatch,
        )

    @property
    def poses(self) -> dict[str, UnfilteredPose]:
        """The unfiltered poses from this tick's image: those of the `large` and `small` marker, and
        the `joint` pose of both."""
        poses = {} if self.output is None else self.output.poses
        return {name: UnfilteredPose(p.t_s, p.e_m, p.e_yaw_rad) for name, p in poses.items()}

    def target(self, now_s: float) -> TargetEstimate | None:
        """The estimate of the target at `now_s`; None until the target has been seen. `tracked` is
        False while no good frames arrive or frames are not searched, because the filter limits its
        prediction by the number of frames."""
        target = self.perception.target(now_s)
        if self._positioning is not None:  # otherwise, estimate and target would drift together
            target = self._positioning.with_fixed_target(target, self.history)
        stale = now_s - self.last_good_frame_s > self.profile.safety.camera_hold_s
        if target is not None and (self.is_blind or stale):
            return replace(target, tracked=False)
        return target

    def _rejection(self, frame: Frame, now_s: float) -> str | None:
        """Return why this frame cannot be used as a measurement: the frame has the wrong size, is
        frozen, is not a valid image, or is too old."""
        height, width = frame.image.shape[:2]
        if (width, height) != (size_px := self.pipeline.camera.size_px):
            return (
                f"the picture is {width}x{height} px, but the calibration was made at "
                f"{size_px[0]}x{size_px[1]} px"
            )
        live = self.source.live
        kind = self.perception.health.assess(frame, live)
        if self.is_logged and self.taken.frame is not None:
            seen = replace(
                self.taken.frame, checksum=zlib.crc32(np.ascontiguousarray(frame.image).data)
            )
            self.taken = replace(self.taken, frame=seen)
        self._frame_kind = kind
        self._note = VERDICT_TEXTS[kind] if kind in DOUBTFUL_KINDS else None
        if kind != "ok" and self._note is None:
            return VERDICT_TEXTS[kind]
        t_s = self.perception.exposure_s(frame)
        age_s = now_s - t_s
        if live and not age_s >= -PICTURE_AHEAD_S:
            return f"the picture's time of exposure, {t_s:.3f} s, is in the future"
        is_late = live and age_s > self.profile.safety.max_frame_age_s
        return f"the picture is {age_s:.1f} s old" if is_late else None


# --- The target as positioning system, tick by tick ---
# While the vehicle is standing on the floor, pressing against the ceiling or hanging, its position
# is known more precisely than any image could show it, so the known position is sent instead. The
# known position is sent only until the first sample in which the accelerometer no longer shows that
# something supports the vehicle. Otherwise a falling vehicle would receive the position of a
# hanging one, and its estimate would agree.


SUPPORTED_FOR_S = 0.1
SUPPORTED_SAMPLE_G = 0.25
"""Largest deviation from 1 g of a single accelerometer sample of a supported vehicle, g. Running
motors cause a spread of 0.04 g. Smaller: the vibration of the motors counts as a fall. Larger: the
beginning of a fall counts as support."""
SUPPORTED_MEAN_G = 0.06
"""Largest deviation from 1 g of the mean over `SUPPORTED_FOR_S`, g. Running motors cause a spread
of 0.013 g."""
# an accelerometer bias cannot make the estimate sink faster while the known position is sent
SUPPORTED_SINK_MPS = -0.15
FROZEN_ATTITUDE_S = 0.06
"""Age above which an unchanged attitude no longer counts as the attitude at the exposure, s. An
error of 0.1 rad displaces a vehicle 1.2 m below the target by 12 cm."""
PICTURE_AHEAD_S = 0.1
"""Largest time by which an image may be ahead of the loop's clock, s. If an image is further ahead,
its time stamp comes from another clock."""


class TargetPositioning:
    """Measures the vehicle's position from the target and sends it, in a flight that uses the
    target as its positioning system."""

    def __init__(self, send: SendPosition, pipeline: Pipeline, profile: Profile) -> None:
        self.feed = TargetFeed(send, profile, pipeline.pose_setup)
        self._touches = False

    def begin_tick(self, history: History, now_s: float, *, in_contact: bool) -> None:
        """Begin a tick: if the vehicle's position is known without an image because something
        supports the vehicle, send that position."""
        newest = history.newest
        self._touches = in_contact
        if newest is None or not is_supported(history, now_s):
            return
        touching_m = self.feed.contact_position(newest.yaw_rad)
        if touching_m is None:
            self.feed.send_origin(now_s)
        elif in_contact:
            self.feed.send_known(touching_m, now_s)

    def add_pose(self, pose: MarkerPose | None, history: History, now_s: float) -> None:
        """Send the position computed from `pose`, if any, unless the vehicle is in contact with the
        ceiling."""
        if (
            pose is None
            or self._touches
            or history.imu.only_attitude_frozen_for_s > FROZEN_ATTITUDE_S
        ):
            return
        then, now = attitude_at(history, pose.t_s), attitude_at(history, now_s)
        if then is not None and now is not None:
            self.feed.add_pose(pose, then, now, now_s, at_rest=is_supported(history, now_s))

    def with_fixed_target(
        self, target: TargetEstimate | None, history: History
    ) -> TargetEstimate | None:
        """Return `target` moved to the target's known position; unchanged while that is unknown."""
        newest = history.newest
        now = None if newest is None else attitude_at(history, newest.t_s)
        return target if target is None or now is None else self.feed.with_fixed_target(target, now)


def is_supported(history: History, now_s: float) -> bool:
    """True if fresh samples show that something has supported the weight for `SUPPORTED_FOR_S`."""
    newest = history.newest
    if newest is None or now_s - newest.t_s + newest.behind_s > SUPPORTED_FOR_S:
        return False
    lately = _newest_samples(history, SUPPORTED_FOR_S)
    mean_g = sum(s.acc_z_g for s in lately) / len(lately)
    return abs(mean_g - 1.0) <= SUPPORTED_MEAN_G and all(
        abs(s.acc_z_g - 1.0) <= SUPPORTED_SAMPLE_G and s.velocity_mps[2] > SUPPORTED_SINK_MPS
        for s in lately
    )


def _newest_samples(history: History, within_s: float) -> list[Telemetry]:
    """The samples that are at most `within_s` older than the newest one, oldest first. The search
    starts at the newest sample, because the history is much longer than `within_s`."""
    newest_s = history.samples[-1].t_s
    found: list[Telemetry] = []
    for sample in reversed(history.samples):
        if newest_s - sample.t_s > within_s:
            break
        found.append(sample)
    found.reverse()  # oldest first, because a sum of floats depends on the order
    return found


# --- A record of each loop turn, for the log ---


Decision = tuple[PlannerState, Command, FeedStatus | None]


class TurnReporter:
    """Counts the loop's turns, and calls `report` with the record of each."""

    def __init__(self, report: Callable[[TickRecord], None]) -> None:
        self._report = report
        self._count = 0
        self._began_s = 0.0
        self._open: tuple[Observation, Decision | None] | None = None  # observed, not yet reported

    def begin_turn(self, now_s: float) -> None:
        self._began_s = now_s

    def report_waiting_turn(
        self, inputs: FlightInputs, now_s: float, feed: FeedStatus | None
    ) -> None:
        turn = TickRecord(
            number=self._counted(),
            role="waiting",
            began_s=now_s,
            t_s=now_s,
            inputs=inputs.taken,
            unfiltered_pose_by_marker=inputs.poses,
            external_positions=external_positions(feed),
        )
        self._report(turn)

    def note_observation(self, obs: Observation) -> None:
        self._open = obs, None

    def note_decision(
        self, obs: Observation, state: PlannerState, command: Command, feed: FeedStatus | None
    ) -> None:
        """Record the planner's decision, so that a later error in the turn is not attributed to the
        planner."""
        self._open = obs, (state, command, feed)

    def report_discarded_turn(
        self, inputs: FlightInputs, obs: Observation, state: PlannerState, command: Command
    ) -> None:
        """Report a turn whose command is discarded because the next turn makes a new decision."""
        self._report(replace(self.flown_turn(inputs, obs, state, command, None), role="redone"))

    def report_failure(self, inputs: FlightInputs, error: BaseException) -> None:
        """Report the turn in which an error ended the flight, with its observation and its
        decision: its command may already have been sent."""
        if self._open is None:
            return
        obs, decision = self._open
        if decision is not None:
            self._report(self.flown_turn(inputs, obs, *decision))
        elif isinstance(error, Exception):  # otherwise, the planner was only interrupted
            self._open = None
            turn = TickRecord(
                number=self._counted(),
                role="failed",
                began_s=self._began_s,
                t_s=obs.t_s,
                inputs=inputs.taken,
                unfiltered_pose_by_marker=inputs.poses,
                observation=obs,
                planner_exception_name=type(error).__name__,
            )
            self._report(turn)

    def flown_turn(
        self,
        inputs: FlightInputs,
        obs: Observation,
        state: PlannerState,
        command: Command,
        feed: FeedStatus | None,
    ) -> TickRecord:
        """The record of a turn whose command was sent."""
        self._open = None
        return TickRecord(
            number=self._counted(),
            role="flown",
            began_s=self._began_s,
            t_s=obs.t_s,
            inputs=inputs.taken,
            unfiltered_pose_by_marker=inputs.poses,
            observation=obs,
            command=command,
            phase=state.phase,
            transition_name=state.transition_name,
            is_holding_position=bool(state.hold_reason),
            failed_attempts=state.failed_attempts,
            external_positions=external_positions(feed),
            outcome=state.outcome,
            reason=state.transition_reason,
        )

    def _counted(self) -> int:
        self._count += 1
        return self._count - 1


def external_positions(status: FeedStatus | None) -> ExternalPositionStatus | None:
    """Convert a feed's status to its form in the log; None stays None."""
    if status is None:
        return None
    return ExternalPositionStatus(
        status.age_s, status.problem, status.sent, status.rate_hz, status.pose
    )
