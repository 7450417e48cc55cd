"""Send the vehicle its external position, or explain why it is not sent.

The vehicle's estimator treats each position as current, even if it is late or a duplicate.
Therefore no position is repeated or queued, and positions that the validator rejects are not sent.
The age of the position then grows, which makes the planner hold or land (fault 10).
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Protocol

import numpy as np

from perchctl.errors import InvalidValue, no_motion_capture
from perchctl.geometry import (
    Array,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
)
from perchctl.profile import PositioningConfig
from perchctl.vehicle import ExternalPosition, SendPosition

Quaternion = tuple[float, float, float, float]  # w, x, y, z


@dataclass(frozen=True)
class BodyPose:
    """A rigid body's pose in the motion-capture system's world: the position of its origin, m, and
    the rotation from its axes to the world's, as reported by the system, before the profile's
    offsets are applied."""

    position_m: tuple[float, float, float]
    quaternion: Quaternion


@dataclass(frozen=True)
class CaptureFrame:
    """A frame that arrived at `t_s` on the loop's clock; it does not contain occluded bodies."""

    t_s: float
    bodies: Mapping[str, BodyPose] = field(default_factory=dict)


class CaptureSource(Protocol):
    """A motion-capture system, real or simulated. None of its methods may block. The class of your
    own source is called with the clock and the profile's section `positioning`. It may have an
    additional method, `error`, which returns the problem as a `perchctl.errors.PerchError`;
    `perchctl check` then shows the error's advice."""

    def poll(self, now_s: float) -> CaptureFrame | None:
        """Return the newest frame that has arrived by `now_s`; None if no frame is new."""

    def problem(self, now_s: float) -> str | None:
        """Return None while the system works; otherwise one sentence with the cause."""

    def close(self) -> None:
        """Release the source."""


QUIET_S = 0.1
"""Time without a position after which the status explains it, s; at least two periods."""
FEED_HANG_S = 0.2
"""Time without a poll after which the feed counts as blocked, s. Polls come every 10 ms, or once
per tick in a simulated flight."""
RATE_OVER_S = 1.0
"""Time over which the rate of sent positions is computed, s."""
END_TIMEOUT_S = 1.0
"""Longest wait for the thread to end, s."""
UNSEEN = "the target is not seen"
STOPPED = "the positions contradict the accelerometer and are no longer sent"
BUSY = "the link is busy, and positions are not queued"


@dataclass(frozen=True)
class FeedStatus:
    """The state of a position feed, which the flight loop reads in each tick.

    `age_s`: time since the exposure of the newest position that was sent; infinite before the first
    one.
    `problem`: None while positions are sent, otherwise one sentence with the cause. `sent`: number
    of positions sent so far; `rate_hz`: their rate in the last second. `pose`: the newest position
    sent. `measured`: the same position with its attitude, even if only the position is sent.
    `beside_m`: distance of the newest sighting from the estimate if that is too large to be
    accepted, else 0.
    """

    age_s: float = math.inf
    problem: str | None = None
    sent: int = 0
    pose: ExternalPosition | None = None
    rate_hz: float = 0.0
    measured: ExternalPosition | None = None
    beside_m: float = 0.0


class SendingRate:
    """Limits the rate at which positions are sent, and counts them."""

    def __init__(self, rate_hz: float) -> None:
        self.period_s = 1.0 / rate_hz
        self.count = 0
        self._due_s = -math.inf
        self._times_s: deque[float] = deque()  # times within the last `RATE_OVER_S`, and the newest

    def is_due(self, now_s: float) -> bool:
        return now_s >= self._due_s - 1e-6

    def note_sent(self, now_s: float) -> None:
        """Record that a position was sent. A late position does not delay later ones, and is not
        followed by a burst."""
        self._due_s = max(self._due_s + self.period_s, now_s)
        self.count += 1
        self._times_s.append(now_s)
        while now_s - self._times_s[0] > RATE_OVER_S:
            self._times_s.popleft()

    def silent_s(self, now_s: float) -> float:
        """Return the seconds since the newest position was sent; infinite before the first."""
        return now_s - self._times_s[-1] if self._times_s else math.inf

    def sent_hz(self, now_s: float) -> float:
        """Return the rate of positions in the last second, Hz."""
        return sum(now_s - t_s < RATE_OVER_S for t_s in self._times_s) / RATE_OVER_S


class PositionFeed:
    """Send positions from a motion-capture system to the vehicle.

    `poll_and_send` is called every `PERIOD_S`: by a thread from `start` until `close`, or in
    lockstep. `status` may be called from any thread.
    """

    PERIOD_S = 0.01

    def __init__(
        self, source: CaptureSource, send: SendPosition, config: PositioningConfig
    ) -> None:
        self._source, self._send, self._config = source, send, config
        self._judge = PoseValidator(config)
        self._rate = SendingRate(config.rate_hz)
        self._quiet_s = max(QUIET_S, 2.0 * self._rate.period_s)
        self._lock = threading.Lock()
        self._turned_s: float | None = None
        self._framed_s = -math.inf
        self._exposed_s = -math.inf
        self._placed: VehiclePose | None = None
        self._pose: ExternalPosition | None = None
        self._problem: str | None = None
        self._stopped = False
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()

    @staticmethod
    def check_config(config: PositioningConfig) -> None:
        """Raise InvalidValue if the host is missing, and UsageError if the library is not
        installed. Opens nothing."""
        if ":" in config.system:
            return  # your own source checks its configuration itself
        if not config.host.strip():
            raise InvalidValue(
                "positioning.host, the computer that runs the motion-capture system, is missing: "
                "write it in the profile, as in positioning: {by: mocap, system: vicon, host: "
                "192.168.1.2, body: crazyflie}; system is vicon, optitrack, qualisys or vrpn, "
                "and body is the name of the vehicle's rigid body"
            )
        if find_spec("motioncapture") is None:
            raise no_motion_capture()

    def start(self, clock: Callable[[], float]) -> None:
        """Start a thread that calls `poll_and_send`. `clock` is the flight loop's. If a call blocks
        in the link's library, `status` reports it."""

        def run() -> None:
            due_s = clock()
            while not self._closed.is_set():
                self.poll_and_send(clock())
                due_s = max(due_s + self.PERIOD_S, clock() - self.PERIOD_S)
                self._closed.wait(max(0.0, due_s - clock()))

        self._thread = threading.Thread(target=run, name="perchctl-positions", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, so that no more positions are sent. Waits for at most `END_TIMEOUT_S`."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join(END_TIMEOUT_S)

    def stop(self) -> None:
        """Stop sending permanently, because the positions contradict the vehicle's own sensors."""
        self._stopped = True

    def poll_and_send(self, now_s: float) -> None:
        """Poll the source, and send its position if it is plausible and due.

        Raises no exceptions: after a failure, `status` shows the growing age and the cause.
        """
        try:
            problem = STOPPED if self._stopped else self._one(now_s)
        except Exception as error:  # errors from source or link; the growing age ends the flight
            problem = f"the position cannot be sent: {type(error).__name__}: {error}"
        with self._lock:
            self._turned_s, self._problem = now_s, problem

    def sent_pose(self) -> VehiclePose | None:
        """Return the newest pose that was sent, even if only its position was sent; None before the
        first one."""
        return self._placed

    def status(self, now_s: float) -> FeedStatus:
        with self._lock:
            quiet = self._rate.silent_s(now_s) > self._quiet_s
            return FeedStatus(
                age_s=now_s - self._exposed_s,
                problem=self._why(now_s) if quiet else None,
                sent=self._rate.count,
                pose=self._pose,
                rate_hz=self._rate.sent_hz(now_s),
                measured=None if self._placed is None else self._placed.to_external(attitude=True),
            )

    def _one(self, now_s: float) -> str | None:
        frame = self._source.poll(now_s)
        trouble = self._source.problem(now_s)
        if frame is None:
            silent = now_s - self._framed_s > QUIET_S
            return trouble or (None if silent else self._judge.problem)
        self._framed_s = now_s
        placed = self._judge.validate(frame, now_s)
        if placed is None or not self._rate.is_due(now_s):
            return trouble or self._judge.problem
        place = placed.to_external(attitude=self._config.send == "pose")
        if self._send(place) is False:
            return BUSY
        with self._lock:
            self._placed, self._exposed_s, self._pose = placed, placed.t_s, place
            self._rate.note_sent(now_s)
        return None

    def _why(self, now_s: float) -> str:
        who = self._config.label
        if self._turned_s is not None and now_s - self._turned_s > FEED_HANG_S:
            return f"no position from {who} has been passed on for {now_s - self._turned_s:.1f} s"
        if self._problem is not None:
            return self._problem
        for_s = "yet" if self._framed_s < 0.0 else f"for {now_s - self._framed_s:.1f} s"
        return f"no frame has arrived from {who} {for_s}"


# --- Validate motion-capture frames, and compute the vehicle's pose from them ---
# Faults of motion capture look like valid data: a hidden body keeps its last pose, two bodies swap
# names, a symmetric body flips, a pose arrives late (faults 10 and 11). Each of these poses is
# rejected with one sentence that names the cause.


STALE_FRAME_S = 0.05
"""Time after its arrival at which a frame is too old, s. A vehicle that climbs at 0.5 m/s moves by
25 mm in this time, five times the assumed error of motion capture."""
UNIT_WITHIN = 0.01
"""Tolerance of a quaternion's length; single precision is accurate to 1e-6."""
NOISE_M, NOISE_RAD = 0.05, math.radians(20.0)
"""Largest change of a pose between two frames that measurement noise may cause without any
motion."""
FASTEST_FALL_MPS = 5.0
"""Largest plausible speed just after an accepted pose, m/s: the speed after a fall from 1.3 m.
Smaller: the positions of a falling vehicle are rejected."""
FASTEST_TIP_RADPS = 10.0
"""Largest plausible rotation rate just after an accepted pose, rad/s: the rate of a vehicle that is
tipping over."""
AT_FASTEST_S = 0.02
"""Time after an accepted pose from which `HELD_MPS` and `HELD_RADPS` apply instead, s. Larger: a
pose that jumped is accepted."""
HELD_MPS, HELD_RADPS = 0.5, 1.0
"""Largest plausible speed, m/s, and rotation rate, rad/s, more than `AT_FASTEST_S` after an
accepted pose: without positions, the vehicle holds its position and drifts."""


@dataclass(frozen=True, eq=False)
class VehiclePose:
    """The vehicle's position (3,) and rotation (3, 3) in the motion-capture system's world at
    `t_s`."""

    t_s: float
    position_m: Array
    R: Array

    @classmethod
    def of(cls, pose: BodyPose, config: PositioningConfig, t_s: float = 0.0) -> VehiclePose:
        """Return the vehicle's pose, computed from the rigid body's pose and the profile's offset:
        ``T_world_body = T_world_rigid @ inv(T_body_rigid)``."""
        roll, pitch, yaw = (math.radians(angle) for angle in config.body_rpy_deg)
        length = math.sqrt(sum(part * part for part in pose.quaternion))
        w, x, y, z = (part / length for part in pose.quaternion)
        R = rotation_from_quaternion((w, x, y, z)) @ rotation_from_rpy(roll, pitch, yaw).T
        return cls(t_s, np.asarray(pose.position_m) - R @ np.asarray(config.body_position_m), R)

    def to_external(self, *, attitude: bool) -> ExternalPosition:
        x, y, z = (float(part) for part in self.position_m)
        return ExternalPosition((x, y, z), quaternion_from_rotation(self.R) if attitude else None)


class PoseValidator:
    """Check the pose in each frame for plausibility; keep the last accepted and last rejected
    pose."""

    def __init__(self, config: PositioningConfig) -> None:
        self._config = config
        self._who = f"the rigid body {config.body!r} of the {config.label}"
        self._arrived_s = -math.inf
        self._newest: BodyPose | None = None
        self._believed: VehiclePose | None = None
        self._stranger: VehiclePose | None = None
        self.problem: str | None = None
        """Why the newest frame with a new pose was rejected; None if it was accepted."""

    def validate(self, frame: CaptureFrame, now_s: float) -> VehiclePose | None:
        """Return the vehicle's pose at the frame's exposure; None if the frame is not new, or if
        the pose must not be sent, for the reason in `problem`."""
        arrived_s = min(frame.t_s, now_s)  # a frame cannot arrive in the future
        if not math.isfinite(arrived_s) or arrived_s <= self._arrived_s:
            return None
        self._arrived_s = arrived_s
        pose = frame.bodies.get(self._config.body)
        if pose is None:
            others = ", ".join(sorted(frame.bodies)) or "none"
            who, label = self._config.body, self._config.label
            self.problem = f"{label} does not see the rigid body {who!r}; it sees {others}"
            return None
        if now_s - arrived_s > STALE_FRAME_S:
            self.problem = f"the pose of {self._who} was {now_s - arrived_s:.3f} s old on arrival"
            return None
        if not _is_pose(pose):
            self.problem = f"{self._who} has an invalid pose: {pose}"
            return None
        if pose == self._newest:
            # Measurement noise never repeats all seven numbers. A filter or a duplicated frame may
            # repeat them for a frame or two, which does no harm.
            if self._stranger is None:
                self.problem = (
                    f"{self._who} is frozen: the body may be hidden, or the capture paused"
                )
            return None
        self._newest = pose
        return self._followed(
            VehiclePose.of(pose, self._config, arrived_s - self._config.latency_s), now_s
        )

    def _followed(self, placed: VehiclePose, now_s: float) -> VehiclePose | None:
        """Return the pose; None, with a `problem`, if no vehicle could have moved there in the time
        since the last accepted pose.

        Waiting does not make a jump plausible: poses near a rejected one are rejected too, until
        the body is seen again near its last accepted pose. Meanwhile the age of the position grows
        and ends the flight.
        """
        last, stranger = self._believed, self._stranger
        if last is not None:
            jumps, way_m = _jumps(last, placed), _way_m(last, placed)
            if stranger is not None and not _jumps(stranger, placed):
                jumps = jumps or _way_m(stranger, placed) <= way_m
            if jumps:
                self._stranger = placed
                self.problem = (
                    f"{self._who} jumped by {way_m:.2f} m and "
                    f"{math.degrees(_turn_rad(last, placed)):.0f} deg: another body may have been "
                    "mistaken for it; its poses are rejected until it is seen near its last "
                    "accepted pose"
                )
                return None
        self._believed, self._stranger, self.problem = placed, None, None
        return placed


def _is_pose(pose: BodyPose) -> bool:
    if not all(math.isfinite(part) for part in (*pose.position_m, *pose.quaternion)):
        return False
    return abs(math.sqrt(sum(part * part for part in pose.quaternion)) - 1.0) <= UNIT_WITHIN


def _jumps(a: VehiclePose, b: VehiclePose) -> bool:
    dt_s = b.t_s - a.t_s
    first_s = min(dt_s, AT_FASTEST_S)
    far_m = NOISE_M + FASTEST_FALL_MPS * first_s + HELD_MPS * (dt_s - first_s)
    far_rad = NOISE_RAD + FASTEST_TIP_RADPS * first_s + HELD_RADPS * (dt_s - first_s)
    return _way_m(a, b) > far_m or _turn_rad(a, b) > far_rad


def _way_m(a: VehiclePose, b: VehiclePose) -> float:
    return float(np.linalg.norm(b.position_m - a.position_m))


def _turn_rad(a: VehiclePose, b: VehiclePose) -> float:
    return math.acos(max(-1.0, min(1.0, (float(np.trace(a.R.T @ b.R)) - 1.0) / 2.0)))
