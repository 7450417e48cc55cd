"""From the frames of one stream, and the vehicle's telemetry, to the target.

Flying, tracking, measuring the mounting and replaying all look through a `Perception`. It judges
whether a frame can be a measurement, separates the fields of an interlaced one, runs each picture
through the pipeline of `perchctl.vision` and keeps the memory that this needs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from perchctl.camera import HealthState, HealthVerdict, assess_frame
from perchctl.geometry import finite
from perchctl.perception.history import History, attitude_at, attitude_of, velocity_at
from perchctl.perception.visual_inertial import (
    VisualInertialWindow,
    drop_sights,
    estimate_motion,
)
from perchctl.profile import USED_LATENCY_S, CameraConfig, Profile
from perchctl.values import replace
from perchctl.vision import (
    ATTITUDE_STEP_S,
    BLENDED,
    INTERLACED,
    LEAST_CONSISTENCY_RANGE_M,
    OTHER_TARGET_TEXT,
    Consistency,
    ConsistencySums,
    Detections,
    FieldState,
    Frame,
    MarkerPose,
    Pipeline,
    PipelineOutput,
    PipelineState,
    PoseSetup,
    TargetEstimate,
    add_moment,
    consistency_moment,
    estimate,
    pictures,
    solve_consistency,
    step,
    surest_pose,
)

MIRRORED_FRAMES = 5
REMARK_PICTURES = 3


@dataclass(eq=False)
class Perception:
    """The session that turns one stream's frames into the target's place.

    Attributes:
        stills: each frame is searched for itself, thoroughly, and nothing is remembered.
        history: the vehicle's telemetry; empty where there is no vehicle.
        state: the pipeline's memory.
        calibration, motion: what pictures and telemetry tell of latency and mounting, and of the
            vehicle's motion sideways.
        refused: why the last target was another vehicle's; None: none was.
    """

    pipeline: Pipeline
    profile: Profile = field(default_factory=Profile)
    stills: bool = False
    history: History = field(default_factory=History)
    state: PipelineState = field(default_factory=PipelineState)
    calibration: OnlineCalibration = field(default_factory=lambda: OnlineCalibration())
    motion: VisualInertialWindow = field(default_factory=VisualInertialWindow)
    refused: str | None = None
    _health: HealthState = field(default_factory=HealthState)
    _fields: FieldState = field(default_factory=FieldState)
    _mirrored: int = 0
    _shown: dict[str, int] = field(default_factory=dict)
    _remarks: list[str] = field(default_factory=list)

    def assess(self, frame: Frame, live: bool) -> HealthVerdict:
        """Judge whether a frame can be a measurement at all; called once for each frame, in order.
        Of a `live` source, a frame that repeats the one before is an old one."""
        self._health, verdict = assess_frame(self._health, frame, live)
        return verdict

    def look(self, frame: Frame, later_s: float = 0.0) -> Iterator[tuple[Frame, PipelineOutput]]:
        """Yield each picture of the frame with what the pipeline finds in it: one picture, or the
        two fields of an interlaced one, in their order of time. `later_s` is the latency, measured
        by `calibration`, by which the frame's time was set back."""
        if self.stills:
            found: tuple[Frame, ...] = (frame,)
            self.state = PipelineState()
        else:
            self._fields, found = pictures(self._fields, frame, self.pipeline)
        for picture in found:
            attitude = attitude_at(self.history, picture.t_s)
            self.state, output = step(self.state, picture, attitude, self.pipeline)
            self._mirrored = _mirrored_frames(self._mirrored, output.detections)
            self._remark(output)
            self._calibrate(output, later_s)
            yield picture, output

    @property
    def is_mirrored(self) -> bool:
        """True if the newest frames have shown only the target's mirror image."""
        return self._mirrored >= MIRRORED_FRAMES

    def target(self, t_s: float, spread: bool = True) -> TargetEstimate | None:
        """The target at the present, for the vehicle's newest attitude; None while none was seen.
        Without `spread` its standard deviations are those of the newest frame."""
        newest = self.history.newest
        attitude = None if newest is None else attitude_of(newest)
        return estimate(self.state, t_s, attitude, self.pipeline, spread=spread)

    def consistency(self) -> Consistency | None:
        """Latency and mounting by all pictures so far; None if there were too few."""
        return solve_consistency(self.calibration.sums, self._attitude_sigma_rad)

    def drop_sights(self) -> None:
        """Forget the sights by which the vehicle's motion is judged, since wrong positions have
        turned its attitude."""
        self.motion = drop_sights(self.motion)

    def take_remarks(self) -> list[str]:
        """Return the remarks about the pictures that are new since the last call."""
        new, self._remarks = self._remarks, []
        return new

    def _calibrate(self, output: PipelineOutput, later_s: float) -> None:
        """Update the estimates of motion, latency and mounting with a picture of the target."""
        pose = surest_pose(self.state.measured)
        if pose is not None and pose.t_s == output.detections.t_s:
            T_body_cam, history = self.pipeline.pose.T_body_cam, self.history
            x_m, y_m, z_m = (T_body_cam[:3, :3] @ pose.tvec_m + T_body_cam[:3, 3]).tolist()
            self.motion = estimate_motion(
                self.motion, pose.t_s, (x_m, y_m, z_m), history.samples, history.imu.offset_g
            )
        if pose is None or output.target is None or not output.target.measured:
            return
        self.calibration = update_calibration(
            self.calibration, output.detections.t_s + later_s, pose, self.history,
            self.pipeline.pose, self.profile.camera, self._attitude_sigma_rad,
        )  # fmt: skip

    @property
    def _attitude_sigma_rad(self) -> float:
        return math.radians(self.profile.kalman.attitude_sigma_deg)

    def _remark(self, output: PipelineOutput) -> None:
        """Make each remark once a stream, when three pictures in a row have shown its reason."""
        if output.refused:
            self.refused = output.lock_note
        for text, shown in (
            (INTERLACED, output.fields != "whole"),
            (BLENDED, output.detections.ghost_px > 0.0),
            (OTHER_TARGET_TEXT, output.refused),
        ):
            before = self._shown.get(text, 0)
            if before < REMARK_PICTURES:
                self._shown[text] = before + 1 if shown else 0
                if self._shown[text] == REMARK_PICTURES:
                    self._remarks.append(text)


def _mirrored_frames(before: int, found: Detections) -> int:
    """Count the frames that have shown the target's mirror image since one showed the target."""
    if found.mirrored:
        return before + 1
    return 0 if found.large is not None or found.small is not None else before


# --- Latency and mounting, estimated picture by picture ----------------------------------------
# With `camera.latency_s: measured` the latency is used, too: taken off the pictures' times, once
# it is sure, slowly, and within bounds. What is estimated rests on the pictures' times before
# that, so that its use does not feed back.


SOLVE_EVERY_S = 1.0
LIKELY_S = 0.02
"""A delay whose sigma is smaller is where the next pictures' factors are taken."""
USED_SIGMA_S = 0.008
"""A delay that is less sure is not used: of its 95 % interval, half is 16 ms, and 30 ms make an
alignment swing."""
SLEW = 0.02
"""Seconds a second: at 0.4 m/s the target's place moves by 8 mm/s, as a drift does."""
LONGEST_STEP_S = 0.1


@dataclass(frozen=True, eq=False)
class OnlineCalibration:
    """Estimate of the camera's latency and mounting from pictures and telemetry.

    `newest` is the solution of `sums` at `solved_s`; `used_s` is subtracted from the pictures'
    times beyond the profile's latency, since the picture of `seen_s`.
    """

    sums: ConsistencySums = field(default_factory=ConsistencySums)
    newest: Consistency | None = None
    solved_s: float = -math.inf
    used_s: float = 0.0
    seen_s: float = -math.inf


def update_calibration(
    old: OnlineCalibration,
    t_s: float,
    pose: MarkerPose,
    history: History,
    setup: PoseSetup,
    camera: CameraConfig,
    attitude_sigma_rad: float,
) -> OnlineCalibration:
    """The estimate with one more picture of the target. `t_s`: its arrival less the profile's
    latency."""
    new = _learned(old, t_s, pose, history, setup, attitude_sigma_rad)
    if camera.latency_s != "measured":
        return new
    return replace(new, seen_s=t_s, used_s=_slewed(new, camera, t_s - old.seen_s))


def _learned(
    old: OnlineCalibration,
    t_s: float,
    pose: MarkerPose,
    history: History,
    setup: PoseSetup,
    attitude_sigma_rad: float,
) -> OnlineCalibration:
    if (
        pose.cov is None
        or not finite(pose.cov)
        or float(pose.tvec_m[2]) < LEAST_CONSISTENCY_RANGE_M
    ):
        return old
    likely = old.newest is not None and old.newest.delay_sigma_s < LIKELY_S
    delay_s = old.newest.delay_s if old.newest is not None and likely else 0.0
    delay_s = max(-USED_LATENCY_S[1], min(USED_LATENCY_S[1], delay_s))
    before = attitude_at(history, t_s - delay_s - ATTITUDE_STEP_S)
    after = attitude_at(history, t_s - delay_s + ATTITUDE_STEP_S)
    if before is None or after is None:
        return old
    velocity_mps = velocity_at(history, t_s - delay_s)
    moment = consistency_moment(t_s, pose, before, after, velocity_mps, delay_s, setup)
    new = replace(old, sums=add_moment(old.sums, moment))
    if t_s - old.solved_s >= SOLVE_EVERY_S:
        newest = solve_consistency(new.sums, attitude_sigma_rad)
        new = replace(new, newest=newest, solved_s=t_s)
    return new


def _slewed(new: OnlineCalibration, camera: CameraConfig, dt_s: float) -> float:
    """The latency that is used one picture later, in s beyond the profile's: nearer to what is
    measured, or unchanged while that is unsure."""
    if new.newest is None or not new.newest.delay_sigma_s <= USED_SIGMA_S:
        return new.used_s
    (least_s, most_s), start_s = USED_LATENCY_S, camera.start_latency_s
    goal_s = max(least_s, min(most_s, start_s + new.newest.delay_s)) - start_s
    step_s = SLEW * max(0.0, min(dt_s, LONGEST_STEP_S))
    return new.used_s + max(-step_s, min(step_s, goal_s - new.used_s))
