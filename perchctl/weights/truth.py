"""Where a collected position's actual pose comes from: a person, motion capture, or the
vehicle's state estimate.

The actual pose is what the pipeline measures: the target relative to the gear's tip in
the level frame, (x, y, z, yaw).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np

from perchctl.errors import (
    ConnectionFailed,
    InvalidValue,
    NotFound,
    PerchError,
    TimedOut,
    no_motion_capture,
)
from perchctl.geometry import Array, rot_z, rotation_from_rpy, rpy_from_rotation, wrap_rad
from perchctl.positioning import BodyPose, CaptureFrame, Placed, open_capture
from perchctl.profile import PositioningConfig
from perchctl.vehicle import Telemetry
from perchctl.vision import Attitude

SAMPLES = 30
WITHIN_S = 5.0
MOVED_M, MOVED_RAD = 0.003, math.radians(1.0)
"""A body that moved farther than this while its frames were taken was not held still."""

Ask = Callable[[str], str]


@dataclass(frozen=True, eq=False)
class Actual:
    """The pose (4,), and the attitude of the vehicle, None where it stands level."""

    pose: Array
    attitude: Attitude | None = None


class Truth(Protocol):
    def actual(self, ask: Ask) -> Actual:
        """The pose now; may ask the person. Errors: InvalidValue for an answer that is none."""

    def close(self) -> None: ...

    @property
    def repeatable(self) -> bool:
        """Whether a second reading shows that the body moved."""


def relative(
    position_m: Array, rpy_rad: tuple[float, float, float], target: Array, gear_body_m: Array
) -> Actual:
    """The target (x, y, z, yaw in the world) relative to the gear of a body in the world."""
    roll, pitch, yaw = rpy_rad
    level = rot_z(-yaw) @ (target[:3] - position_m)
    e_m = level - rotation_from_rpy(roll, pitch, 0.0) @ gear_body_m
    attitude = Attitude(0.0, roll, pitch, yaw, (position_m[0], position_m[1], position_m[2]))
    return Actual(np.array([*e_m, wrap_rad(float(target[3]) - yaw)]), attitude)


def four_numbers(text: str, scale: tuple[float, float]) -> Array:
    """``x y z yaw`` as typed; lengths times scale[0], the angle times scale[1].

    Errors: InvalidValue."""
    cells = text.replace(",", " ").split()
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != 4 or not all(math.isfinite(v) for v in values):
        raise InvalidValue(
            f"{text.strip()!r} is not a pose: four numbers are needed, x y z and yaw"
        )
    return np.array([*(v * scale[0] for v in values[:3]), wrap_rad(values[3] * scale[1])])


class TypedTruth:
    """A person with a ruler: centimetres and degrees, as in the paper's tables."""

    repeatable = False

    def actual(self, ask: Ask) -> Actual:
        text = ask("actual pose of the target from the gear, x y z [cm] and yaw [deg]: ")
        return Actual(four_numbers(text, (0.01, math.pi / 180.0)))

    def close(self) -> None:
        return None


class Frames(Protocol):
    """The part of `perchctl.positioning.CaptureSource` that is needed here."""

    def frames(self) -> list[CaptureFrame]: ...

    def problem(self, now_s: float) -> str | None: ...

    def close(self) -> None: ...


class MocapTruth:
    """Motion capture, by the reader that flights have.

    Args:
        system: of `capture`, for sentences: ``TYPE:HOST``, as in ``vicon:192.168.1.2``.
        body: rigid body of the vehicle.
        target: that of the target (its x axis is the heading), or the pose itself, (4,).
        mounted: how the vehicle's rigid body lies in its body axes; as they are, by default.
    """

    repeatable = True

    def __init__(
        self,
        capture: Frames,
        system: str,
        body: str,
        target: str | Array,
        gear_body_m: Array,
        mounted: PositioningConfig | None = None,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._capture, self._system = capture, system
        self._body, self._target, self._gear = body, target, gear_body_m
        self._mounted = mounted or _AS_IT_IS
        self._clock, self._wait = now, wait

    @classmethod
    def open(
        cls, system: str, body: str, target: str | Array, gear_body_m: Array,
        mounted: PositioningConfig | None = None,
    ) -> MocapTruth:  # fmt: skip
        """Connect to the motion capture. Errors: InvalidValue, UsageError, ConnectionFailed."""
        capture = open_named(system, body, "--truth mocap")
        return cls(capture, system, body, target, gear_body_m, mounted)

    def actual(self, ask: Ask) -> Actual:
        """Errors: ConnectionFailed, NotFound."""
        self._capture.frames()  # those of before are gone
        poses: dict[str, list[BodyPose]] = {}
        wanted = [self._body] + ([self._target] if isinstance(self._target, str) else [])
        seen: set[str] = set()
        until_s = self._clock() + WITHIN_S
        while min(len(poses.get(name, [])) for name in wanted) < SAMPLES:
            frames = self._capture.frames()
            for frame in frames:
                seen |= set(frame.bodies)
                for name in wanted:
                    if name in frame.bodies:
                        poses.setdefault(name, []).append(frame.bodies[name])
            if self._clock() > until_s:
                missing = next(name for name in wanted if len(poses.get(name, [])) < SAMPLES)
                raise self._unseen(missing, seen)
            if not frames:
                self._wait(0.01)
        for name in wanted:
            if len(set(poses[name])) == 1:
                raise NotFound(
                    f"motion capture at {self._system} has {name!r} frozen: {SAMPLES} times the "
                    f"same numbers, and a measured pose has noise"
                )
        position, rpy = _median([_measured(pose, self._mounted) for pose in poses[self._body]])
        target = self._target
        if isinstance(target, str):
            place, turned = _median([_measured(pose, _AS_IT_IS) for pose in poses[target]])
            target = np.array([*place, turned[2]])
        return relative(position, rpy, target, self._gear)

    def close(self) -> None:
        self._capture.close()

    def _unseen(self, missing: str, seen: set[str]) -> PerchError:
        problem = self._capture.problem(self._clock())
        if problem is not None:
            return ConnectionFailed(problem)
        return NotFound(
            f"motion capture at {self._system} does not see the rigid body {missing!r}; "
            f"it sees {', '.join(sorted(seen)) or 'none'}"
        )


_AS_IT_IS = PositioningConfig()


def open_named(system: str, body: str, needed_by: str, timeout_s: float = 10.0) -> Frames:
    """`system`: ``TYPE:HOST``, as in ``vicon:192.168.1.2``. Errors: those of `open_capture`."""
    kind, _, host = system.partition(":")
    if find_spec("motioncapture") is None:
        raise no_motion_capture(needed_by)
    # Unchecked, since `check_reachable` has the sentence for a kind that is none.
    named: dict[str, Any] = {"by": "mocap", "system": kind, "host": host, "body": body}
    return open_capture(PositioningConfig.model_construct(connect_timeout_s=timeout_s, **named))


def _measured(
    pose: BodyPose, mounted: PositioningConfig
) -> tuple[Array, tuple[float, float, float]]:
    placed = Placed.of(pose, mounted)
    return placed.position_m, rpy_from_rotation(placed.R)


def _median(
    samples: list[tuple[Array, tuple[float, float, float]]],
) -> tuple[Array, tuple[float, float, float]]:
    position = np.median(np.array([p for p, _ in samples]), axis=0)
    angles = np.unwrap(np.array([a for _, a in samples]), axis=0)
    roll, pitch, yaw = (float(a) for a in np.median(angles, axis=0))
    return position, (roll, pitch, wrap_rad(yaw))


class EstimateTruth:
    """The vehicle's own state estimate; `telemetry` gives what arrived since the last call.

    Where the target is in the world of that estimate is given, or measured once by holding
    the gear's tip to the target's centre, nose along the target's x axis.
    """

    repeatable = True

    def __init__(
        self,
        telemetry: Callable[[], list[Telemetry]],
        target: Array | None,
        gear_body_m: Array,
        close: Callable[[], None] = lambda: None,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._telemetry, self._target, self._gear = telemetry, target, gear_body_m
        self._close, self._wait = close, wait

    def actual(self, ask: Ask) -> Actual:
        if self._target is None:
            ask(
                "hold the gear's tip to the target's centre, nose along the target's x axis, "
                "then press Enter: "
            )
            position, rpy = self._now()
            tip = position + rotation_from_rpy(*rpy) @ self._gear
            self._target = np.array([*tip, rpy[2]])
            ask("the target's place is measured; now put the vehicle in place and press Enter: ")
        position, rpy = self._now()
        return relative(position, rpy, self._target, self._gear)

    def _now(self) -> tuple[Array, tuple[float, float, float]]:
        self._telemetry()
        samples: list[Telemetry] = []
        waited_s = 0.0
        while len(samples) < SAMPLES:
            if waited_s >= WITHIN_S:
                raise TimedOut(f"the vehicle sends no state estimate (waited {WITHIN_S:g} s)")
            self._wait(0.02)
            waited_s += 0.02
            samples += self._telemetry()
        return _median(
            [(np.asarray(s.position_m), (s.roll_rad, s.pitch_rad, s.yaw_rad)) for s in samples]
        )

    def close(self) -> None:
        self._close()


def moved(before: Actual, after: Actual) -> str | None:
    """One sentence if the body moved in between."""
    way_m = float(np.linalg.norm(after.pose[:3] - before.pose[:3]))
    turn_rad = abs(wrap_rad(float(after.pose[3] - before.pose[3])))
    if way_m <= MOVED_M and turn_rad <= MOVED_RAD:
        return None
    return (
        f"shaken: the vehicle moved by {way_m * 1e3:.1f} mm and {math.degrees(turn_rad):.1f} deg "
        f"while the frames were taken; hold still"
    )
