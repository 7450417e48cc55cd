"""What a turn of the loop takes in: telemetry, at most one frame, and what follows from them."""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass, field
from typing import Protocol

from perchctl.camera import (
    VERDICT_TEXTS,
    FrameSource,
    HealthState,
    assess_frame,
    check_size,
    mirrored_note,
)
from perchctl.flight.history import (
    History,
    add_late_samples,
    add_samples,
    attitude_at,
    attitude_of,
    battery_age_s,
    velocity_at,
)
from perchctl.geometry import finite
from perchctl.mission import (
    FrameSeen,
    Observation,
    PoseSeen,
    TurnInputs,
    VisualInertialWindow,
    estimate_motion,
)
from perchctl.positioning import FeedStatus, SightFeed
from perchctl.profile import USED_LATENCY_S, CameraConfig, Profile, SafetyConfig
from perchctl.values import replace
from perchctl.vehicle import SendPosition, Telemetry
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
    MeasuredMarkers,
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

# --- What the flight notices of its camera's latency and mounting, picture by picture ----------
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
class Noticed:
    """`newest` is what `sums` said at `solved_s`, and `used_s` what is taken off the pictures'
    times beyond the profile's latency, since the picture of `seen_s`."""

    sums: ConsistencySums = field(default_factory=ConsistencySums)
    newest: Consistency | None = None
    solved_s: float = -math.inf
    used_s: float = 0.0
    seen_s: float = -math.inf


def noticed(
    old: Noticed,
    t_s: float,
    pose: MarkerPose,
    history: History,
    setup: PoseSetup,
    camera: CameraConfig,
    attitude_sigma_rad: float,
) -> Noticed:
    """With one more picture of the target. `t_s`: its arrival less the profile's latency."""
    new = _learned(old, t_s, pose, history, setup, attitude_sigma_rad)
    if camera.latency_s != "measured":
        return new
    return replace(new, seen_s=t_s, used_s=_slewed(new, camera, t_s - old.seen_s))


def _learned(
    old: Noticed,
    t_s: float,
    pose: MarkerPose,
    history: History,
    setup: PoseSetup,
    attitude_sigma_rad: float,
) -> Noticed:
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


def _slewed(new: Noticed, camera: CameraConfig, dt_s: float) -> float:
    """What is used, one picture on: towards what is measured, or as it was where that is
    unsure."""
    if new.newest is None or not new.newest.delay_sigma_s <= USED_SIGMA_S:
        return new.used_s
    (least_s, most_s), start_s = USED_LATENCY_S, camera.start_latency_s
    goal_s = max(least_s, min(most_s, start_s + new.newest.delay_s)) - start_s
    step_s = SLEW * max(0.0, min(dt_s, LONGEST_STEP_S))
    return new.used_s + max(-step_s, min(step_s, goal_s - new.used_s))


# --- What a turn of the loop takes in: telemetry, at most one frame, and what follows from them ---


MIRRORED_FRAMES = 5
REMARK_PICTURES = 3
HEARD_S = 0.15
"""A sight that is carried on by an older estimate swings the vehicle that flies by it."""
ENDED_TEXT = " has ended"
SENSED = (
    "telemetry", "target", "new_frame", "camera_age_s", "camera_problem", "battery_age_s",
    "jumped", "turned_rad", "disagreeing_frames", "delay_s", "target_refused", "imu",
    "felt", "mismatch",
)  # fmt: skip
"""The fields of an `Observation` that come from here; the others are the loop's."""


class GivesTelemetry(Protocol):
    """What the senses need of a `perchctl.link.protocol.Link`."""

    def telemetry(self) -> list[Telemetry]: ...


@dataclass(eq=False)
class Senses:
    """The loop's working memory of what it sees.

    `output` is what this turn's frame gave, None where there was none to look at; `repeated`: it
    was the one before once more. `sights`: where the target is the vehicle's positioning system,
    what hands its places to `send`; else None.
    """

    link: GivesTelemetry
    source: FrameSource
    pipeline: Pipeline
    profile: Profile
    history: History = field(default_factory=History)
    state: PipelineState = field(default_factory=PipelineState)
    output: PipelineOutput | None = None
    taken: TurnInputs = field(default_factory=TurnInputs)  # in this turn
    blind: bool = False
    repeated: bool = False
    last_good_frame_s: float = -math.inf
    camera_problem: str | None = None
    frames: int = 0
    ground_z_m: float = 0.0  # of the estimate, where the flight begins
    noticed: Noticed = field(default_factory=Noticed)
    felt: VisualInertialWindow = field(default_factory=VisualInertialWindow)
    send: SendPosition = lambda place: True
    recorded: bool = False  # the turns are: with the pictures' checksums and the present's spread
    sights: Sights | None = field(init=False, default=None)
    sends_sights: bool = True  # until the way down goes on without them
    refused: str | None = None  # the last target that was another vehicle's, and why
    _health: HealthState = field(default_factory=HealthState)
    _note: str | None = None
    _mirrored: int = 0
    _fields: FieldState = field(default_factory=FieldState)
    _shown: dict[str, int] = field(default_factory=dict)
    _remarks: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.profile.positioning.by == "target":
            self.sights = Sights(self.send, self.pipeline, self.profile)

    def take_in(self, now_s: float, *, look: bool = True) -> None:
        """Telemetry and at most one frame. Without `look`, at the ceiling, the frame only counts
        as a sign of the camera's life."""
        samples = self.link.telemetry()
        self.history = add_samples(self.history, samples, self.profile.safety)
        if self.sights is not None and self.sends_sights:
            self.sights.begin(self.history, now_s, touches=not look)
        self.output, self.blind, self.repeated = None, not look, False
        frame = self.source.poll(now_s)
        problem = self.source.problem(now_s)
        self.taken = TurnInputs(
            tuple(samples), frame=_seen(frame), problem=problem, ended=self.source.finished,
            live=self.source.live, look=look,
        )  # fmt: skip
        used_s = self.noticed.used_s
        if frame is not None and used_s:
            frame = replace(frame, t_s=frame.t_s - used_s)
        if frame is None:
            if problem is None and self.source.finished:
                problem = f"{self.source.describe()}{ENDED_TEXT}"
            if problem is not None:
                self.camera_problem = problem
            return
        if self.frames == 0:
            check_size(self.source.size_px, self.pipeline.camera, self.source.describe())
        rejection = problem or self._rejection(frame, now_s)
        self.repeated = rejection == VERDICT_TEXTS["repeated"]
        if rejection is not None:
            if not self.repeated:  # which says nothing new, of the camera's troubles neither
                self.camera_problem = rejection
            return
        self.last_good_frame_s = now_s
        self.frames += 1
        if look:
            self._fields, found = pictures(self._fields, frame, self.pipeline)
            for picture in found:
                attitude = attitude_at(self.history, picture.t_s)
                self.state, self.output = step(self.state, picture, attitude, self.pipeline)
                self._mirrored = _mirrored_frames(self._mirrored, self.output.detections)
                self._remark(self.output)
                self._notice(self.output, used_s)
                if self.sights is not None and self.sends_sights and self._is_heard(now_s):
                    self.sights.see(self.state.measured, self.history, now_s)
        mirrored = self._mirrored >= MIRRORED_FRAMES
        self.camera_problem = mirrored_note(self.profile.camera) if mirrored else self._note

    def _is_heard(self, now_s: float) -> bool:
        """Whether the telemetry is new enough to carry a sight on to the present."""
        newest = self.history.newest
        return newest is not None and now_s - newest.t_s + newest.behind_s <= HEARD_S

    def present(self, began_s: float, now_s: float) -> None:
        """What has arrived while camera or vision hung, since the turn of `began_s`."""
        late = self.link.telemetry()
        self.history = add_late_samples(self.history, late, self.profile.safety)
        self.taken = replace(self.taken, late=tuple(late))
        if self.last_good_frame_s == began_s:
            self.last_good_frame_s = now_s  # the picture came: it is not the camera that is gone

    def observation(self, now_s: float) -> Observation:
        """The part of it that is seen: the fields of `SENSED`."""
        newest = self.history.newest
        assert newest is not None
        return Observation(
            t_s=now_s,
            telemetry=newest,
            target=self.target(now_s),
            new_frame=self.output is not None,
            camera_age_s=now_s - self.last_good_frame_s,
            camera_problem=self.camera_problem,
            battery_age_s=battery_age_s(self.history, now_s),
            jumped=self.history.jumped,
            turned_rad=self.history.turned_rad,
            disagreeing_frames=self.state.disagreeing_frames,
            delay_s=self.noticed.used_s,
            target_refused=self.refused,
            imu=self.history.imu,
            felt=self.felt.motion,
            mismatch=self.felt.mismatch,
        )

    @property
    def poses(self) -> dict[str, PoseSeen]:
        """The unfiltered ones of this turn's picture."""
        poses = {} if self.output is None else self.output.poses
        return {name: PoseSeen(p.t_s, p.e_m, p.e_yaw_rad) for name, p in poses.items()}

    def _notice(self, output: PipelineOutput, used_s: float) -> None:
        """Latency and mounting, from a picture whose pose was taken for the target's."""
        pose = surest_pose(self.state.measured)
        if pose is not None and pose.t_s == output.detections.t_s:
            T_body_cam = self.pipeline.pose.T_body_cam
            x_m, y_m, z_m = (T_body_cam[:3, :3] @ pose.tvec_m + T_body_cam[:3, 3]).tolist()
            history = self.history
            self.felt = estimate_motion(
                self.felt, pose.t_s, (x_m, y_m, z_m), history.samples, history.imu.offset_g
            )
        if pose is None or output.target is None or not output.target.measured:
            return
        self.noticed = noticed(
            self.noticed,
            output.detections.t_s + used_s,
            pose,
            self.history,
            self.pipeline.pose,
            self.profile.camera,
            self._attitude_sigma_rad,
        )

    def noticed_at_last(self) -> Consistency | None:
        """Of the whole flight; None of one that saw too little."""
        return solve_consistency(self.noticed.sums, self._attitude_sigma_rad)

    @property
    def _attitude_sigma_rad(self) -> float:
        return math.radians(self.profile.kalman.attitude_sigma_deg)

    def take_remarks(self) -> list[str]:
        """What is new about the pictures since the last call."""
        new, self._remarks = self._remarks, []
        return new

    def _remark(self, output: PipelineOutput) -> None:
        """Each is made once a flight, when three pictures in a row have shown it."""
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

    def target(self, now_s: float) -> TargetEstimate | None:
        """The estimate at the present. The filter coasts by frames: while none are looked
        at, its target is a remembered place."""
        newest = self.history.newest
        attitude = None if newest is None else attitude_of(newest)
        target = estimate(self.state, now_s, attitude, self.pipeline, spread=self.recorded)
        if self.sights is not None and self.sends_sights:  # else the estimate runs away
            target = self.sights.steered(target, self.history)
        stale = now_s - self.last_good_frame_s > self.profile.safety.camera_hold_s
        if target is not None and (self.blind or stale):
            return replace(target, tracked=False)
        return target

    def _rejection(self, frame: Frame, now_s: float) -> str | None:
        """Why this frame is no measurement: of another size, frozen, no picture at all, or too
        old."""
        height, width = frame.image.shape[:2]
        if (width, height) != (size_px := self.pipeline.camera.size_px):
            return f"the picture has {width}x{height} px, the calibration {size_px[0]}x{size_px[1]}"
        live = self.source.live
        self._health, verdict = assess_frame(self._health, frame, live)
        if self.recorded and self.taken.frame is not None:
            seen = replace(self.taken.frame, checksum=zlib.crc32(frame.image.tobytes()))
            self.taken = replace(self.taken, frame=seen)
        # A dark target may still be seen, and a bare ceiling looks like an empty screen:
        # such pictures are searched all the same, but the user is shown why.
        self._note = verdict.text if verdict.kind in ("dark", "uniform") else None
        if not verdict.usable and self._note is None:
            return verdict.text
        return lateness_text(now_s - frame.t_s, self.profile.safety) if live else None


def lateness_text(age_s: float, safety: SafetyConfig) -> str | None:
    """Why a live picture of this age is no measurement."""
    return f"the picture is {age_s:.1f} s late" if age_s > safety.max_frame_age_s else None


def _seen(frame: Frame | None) -> FrameSeen | None:
    if frame is None:
        return None
    return FrameSeen(frame.index, frame.t_s, frame.t_arrival_s, frame.fields, frame.repeated)


def _mirrored_frames(before: int, found: Detections) -> int:
    """How many frames have shown the target's mirror image, since one showed the target."""
    if found.mirrored:
        return before + 1
    return 0 if found.large is not None or found.small is not None else before


# --- The target as positioning system, turn by turn --------------------------------------------
# Standing, pressed or hanging, the place is known better than by any picture, and is sent in its
# stead; only while the accelerometer says that something carries the vehicle. What falls while it
# is told that it hangs would look as if it hung, so the first sample that says otherwise ends that.


CARRIED_FOR_S = 0.1
CARRIED_G, CARRIED_MEAN_G = 0.25, 0.06
"""An accelerometer at rest reads one g; with turning motors it scatters by 0.04, the mean of ten by
0.013."""
SINKING_MPS = -0.15
"""No such speed comes of a bias while the place is sent."""
FROZEN_S = 0.06
"""An attitude that reads the very same for so long is not the one at the picture's exposure, and
0.1 rad of it places a vehicle 1.2 m under the target 12 cm aside."""


class Sights:
    """Of one flight. `status` goes to the planner as that of a motion capture does."""

    def __init__(self, send: SendPosition, pipeline: Pipeline, profile: Profile) -> None:
        self.feed = SightFeed(send, profile, pipeline.pose)
        self._touches = False

    def status(self, now_s: float) -> FeedStatus:
        return self.feed.status(now_s)

    def begin(self, history: History, now_s: float, *, touches: bool) -> None:
        """A turn, before its picture. `touches`: contact was proven, and nothing has shown since
        that it ended."""
        newest = history.newest
        self._touches = touches
        if newest is None or not is_carried(history, now_s):
            return
        touching_m = self.feed.touching(newest.yaw_rad)
        if touching_m is None:
            self.feed.stand(now_s)
        elif touches:
            self.feed.known(touching_m, now_s)

    def see(self, measured: MeasuredMarkers, history: History, now_s: float) -> None:
        """A picture. What is pressed or hangs needs none, and the last ones were of before."""
        pose = surest_pose(measured)
        if pose is None or self._touches or history.imu.attitude_age_s > FROZEN_S:
            return
        then, now = attitude_at(history, pose.t_s), attitude_at(history, now_s)
        if then is not None and now is not None:
            self.feed.see(pose, then, now, now_s, at_rest=is_carried(history, now_s))

    def steered(self, target: TargetEstimate | None, history: History) -> TargetEstimate | None:
        """The target where it stands; as it is seen until its place is known."""
        newest = history.newest
        if target is None or newest is None:
            return target
        return self.feed.steered(target, attitude_of(newest))


def is_carried(history: History, now_s: float) -> bool:
    """Whether something has carried the vehicle for the last moments, by fresh samples."""
    newest = history.newest
    if newest is None or now_s - newest.t_s + newest.behind_s > CARRIED_FOR_S:
        return False
    lately = [s for s in history.samples if newest.t_s - s.t_s <= CARRIED_FOR_S]
    mean_g = sum(s.acc_z_g for s in lately) / len(lately)
    return abs(mean_g - 1.0) <= CARRIED_MEAN_G and all(
        abs(s.acc_z_g - 1.0) <= CARRIED_G and s.velocity_mps[2] > SINKING_MPS for s in lately
    )
