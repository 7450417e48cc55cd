"""Estimate the target from the frames of one stream and the vehicle's telemetry.

A `Perception` is used in flight, for tracking, for measuring the mounting, and for replays. It
decides whether a frame can be used as a measurement, separates the fields of an interlaced frame,
runs each image through the pipeline of `perchctl.vision`, and remembers what later frames need.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from perchctl.camera import FrameHealth
from perchctl.perception.history import History, attitude_at
from perchctl.perception.online_calibration import (
    OnlineCalibration,
    apply_latency,
    solve_consistency,
    update_calibration,
)
from perchctl.perception.visual_inertial import (
    MeasuredLatency,
    VisualInertialWindow,
    drop_sightings,
    estimate_motion,
)
from perchctl.profile import USED_LATENCY_S, Profile
from perchctl.values import replace
from perchctl.vision import (
    CameraCalibrationErrors,
    Frame,
    Pipeline,
    PipelineOutput,
    PipelineState,
    TargetEstimate,
    VehicleState,
    deinterlace,
    estimate,
    step,
)

MIRRORED_FRAMES = 5
"""Number of successive frames with a mirrored target after which the camera image counts as
mirrored."""


@dataclass(eq=False)
class Perception:
    """Estimates the target from the frames of one stream, and stores everything that it remembers
    between frames.

    Attributes:
        stills: True if each frame is searched thoroughly and independently of other frames.
        history: the vehicle's telemetry; empty if there is no vehicle.
        attitude: function that returns the vehicle's attitude at a given time; used instead of the
            history.
        state: the pipeline's memory.
        calibration, motion: estimates from images and telemetry: of the camera's latency and
            mounting, and of the vehicle's motion.
        refused: why a target was rejected as belonging to another vehicle; None if none was.
        health: decides whether a frame can be used as a measurement.
    """

    pipeline: Pipeline
    profile: Profile = field(default_factory=Profile)
    stills: bool = False
    history: History = field(default_factory=History)
    state: PipelineState = field(default_factory=PipelineState)
    calibration: OnlineCalibration = field(default_factory=OnlineCalibration)
    motion: VisualInertialWindow = field(default_factory=VisualInertialWindow)
    refused: str | None = None
    health: FrameHealth = field(default_factory=FrameHealth)
    attitude: Callable[[float], VehicleState | None] | None = None
    _mirrored: int = 0  # number of successive frames that show the target's mirror image

    def exposure_s(self, frame: Frame) -> float:
        """Return the best estimate of a frame's exposure time, s, on the loop's clock.

        The source sets the time of a frame to its arrival time minus the profile's latency. The
        additional latency measured in flight is subtracted here and nowhere else.
        """
        return frame.t_s - self.calibration.applied_delay_s

    def process_fields(self, frame: Frame) -> Iterator[tuple[Frame, PipelineOutput]]:
        """Yield each field of an interlaced frame, or the whole frame, with its exposure time,
        together with the pipeline's output. `frame` is the frame as received from its source."""
        used_s = self.calibration.applied_delay_s
        frame = replace(frame, t_s=self.exposure_s(frame)) if used_s else frame
        if self.stills:
            found: tuple[Frame, ...] = (frame,)
            self.state = PipelineState()
        else:
            self.state, found = deinterlace(self.state, frame, self.pipeline)
        for picture in found:
            at = picture.t_s
            attitude = self.attitude(at) if self.attitude else attitude_at(self.history, at)
            run = self.pipeline.custom_step or step
            self.state, output = run(self.state, picture, attitude, self.pipeline)
            if output.detections.is_mirrored_marker_seen:
                self._mirrored += 1
            elif output.detections.markers:
                self._mirrored = 0
            if output.is_other_vehicles_target_seen:
                self.refused = output.target_lock_message
            self._calibrate(output, used_s)
            yield picture, output

    @property
    def is_mirrored(self) -> bool:
        """True if the newest frames have shown only the target's mirror image."""
        return self._mirrored >= MIRRORED_FRAMES

    def target(self, t_s: float) -> TargetEstimate | None:
        """Return the target estimate at the current time `t_s`, for the vehicle's newest attitude;
        None before the first sighting."""
        newest = self.history.newest
        attitude = None if newest is None else attitude_at(self.history, newest.t_s)
        return estimate(self.state, t_s, attitude, self.pipeline)

    @property
    def latency_sigma_s(self) -> float:
        """Standard deviation of the latency in use, s; 0 for a latency set in the profile."""
        return 0.0 if self._measured_latency is None else self.calibration.delay_sigma_s

    def camera_errors(self) -> CameraCalibrationErrors | None:
        """Return the errors of latency and mounting from all images so far; None if there are too
        few."""
        return solve_consistency(self.calibration.sums, self._attitude_sigma_rad)

    def drop_sightings(self) -> None:
        """Discard the sightings from which the vehicle's motion is estimated."""
        self.motion = drop_sightings(self.motion)

    def _calibrate(self, output: PipelineOutput, used_s: float) -> None:
        # Use the source's time stamp: a latency correction in progress must not change it.
        pose, t_s = self.state.marker_poses.most_certain_pose, output.detections.t_s + used_s
        if pose is None:
            return
        measured = self._measured_latency
        if pose.t_s == output.detections.t_s:
            T_body_cam, history = self.pipeline.pose_setup.T_body_cam, self.history
            x_m, y_m, z_m = (T_body_cam[:3, :3] @ pose.tvec_m + T_body_cam[:3, 3]).tolist()
            self.motion = estimate_motion(
                self.motion,
                t_s,
                (x_m, y_m, z_m),
                history.samples,
                history.imu.accelerometer_offset_g,
                measured,
            )
        if output.target is not None and output.target.is_measured_in_newest_frame:
            self.calibration = update_calibration(
                self.calibration,
                t_s,
                pose,
                self.history,
                self.pipeline.pose_setup,
                self._attitude_sigma_rad,
            )
        if measured is not None:
            start_s = self.profile.camera.start_latency_s
            self.calibration = apply_latency(
                self.calibration, t_s, start_s, self.motion.correction_s
            )

    @property
    def _measured_latency(self) -> MeasuredLatency | None:
        """The latency in use if it is measured in flight; otherwise None."""
        camera, (least_s, most_s) = self.profile.camera, USED_LATENCY_S
        if camera.latency_s != "measured":
            return None
        start_s = camera.start_latency_s
        in_use_s = self.calibration.applied_delay_s
        return MeasuredLatency(in_use_s, least_s - start_s, most_s - start_s)

    @property
    def _attitude_sigma_rad(self) -> float:
        return math.radians(self.profile.kalman.attitude_sigma_deg)
