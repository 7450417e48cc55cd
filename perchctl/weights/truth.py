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
from typing import Any, Protocol

import numpy as np

from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, PerchError, TimedOut
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
Sample = tuple[Any, tuple[float, float, float]]
"""A body in the world: position (3,), m, and roll, pitch, yaw, rad."""


@dataclass(frozen=True, eq=False)
class Actual:
    """The pose (4,), and the attitude of the vehicle, None where it stands level."""

    pose: Array
    attitude: Attitude | None = None


class Truth(Protocol):
    """A source of actual poses."""

    def actual(self, ask: Ask) -> Actual:
        """The pose now; may ask the person. Errors: InvalidValue for an answer that is none."""

    def close(self) -> None: ...

    @property
    def repeatable(self) -> bool:
        """Whether a second reading shows that the body moved."""


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


def four_numbers(text: str, length_m: float = 1.0) -> Array:
    """``x y z yaw`` as typed: lengths in units of `length_m`, the angle in degrees.

    Errors: InvalidValue."""
    try:
        x, y, z, yaw = (float(cell) for cell in text.replace(",", " ").split())
    except ValueError:
        x = y = z = yaw = math.nan
    if not math.isfinite(x + y + z + yaw):
        raise InvalidValue(
            f"{text.strip()!r} is not a pose: four numbers are needed, x y z and yaw"
        )
    return np.array([x * length_m, y * length_m, z * length_m, wrap_rad(math.radians(yaw))])


def _median(samples: list[Sample]) -> Sample:
    position = np.median(np.array([p for p, _ in samples]), axis=0)
    angles = np.unwrap(np.array([a for _, a in samples]), axis=0)
    roll, pitch, yaw = (float(a) for a in np.median(angles, axis=0))
    return position, (roll, pitch, wrap_rad(yaw))


def _relative(body: Sample, target: Array, gear_body_m: Array) -> Actual:
    """The target (x, y, z, yaw in the world) relative to the gear of a body in the world."""
    position_m, (roll, pitch, yaw) = body
    level = rot_z(-yaw) @ (target[:3] - position_m)
    e_m = level - rotation_from_rpy(roll, pitch, 0.0) @ gear_body_m
    attitude = Attitude(0.0, roll, pitch, yaw, (position_m[0], position_m[1], position_m[2]))
    return Actual(np.array([*e_m, wrap_rad(float(target[3]) - yaw)]), attitude)


class TypedTruth:
    """A person with a ruler: centimetres and degrees, as in the paper's tables."""

    repeatable = False

    def actual(self, ask: Ask) -> Actual:
        text = ask("actual pose of the target from the gear, x y z [cm] and yaw [deg]: ")
        return Actual(four_numbers(text, 0.01))

    def close(self) -> None:
        return None


class CapturedFrames(Protocol):
    """The part of a motion capture that is needed here."""

    def frames(self) -> list[CaptureFrame]: ...

    def problem(self, now_s: float) -> str | None: ...

    def close(self) -> None: ...


def open_named(system: str, body: str) -> CapturedFrames:
    """`system`: ``TYPE:HOST``, as in ``vicon:192.168.1.2``. Errors: those of `open_capture`."""
    kind, _, host = system.partition(":")
    # Unchecked, since `open_capture` has the sentence for a kind that is none.
    named: dict[str, Any] = {"by": "mocap", "system": kind, "host": host, "body": body}
    return open_capture(PositioningConfig.model_construct(connect_timeout_s=10.0, **named))


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
        capture: CapturedFrames,
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
        self._mounted = mounted or PositioningConfig()
        self._now, self._wait = now, wait

    def actual(self, ask: Ask) -> Actual:
        """Errors: ConnectionFailed, NotFound."""
        self._capture.frames()  # older ones do not count
        target = self._target
        named = [self._body] + ([target] if isinstance(target, str) else [])
        poses: dict[str, list[BodyPose]] = {name: [] for name in named}
        seen: set[str] = set()
        until_s = self._now() + WITHIN_S
        while missing := [name for name in named if len(poses[name]) < SAMPLES]:
            frames = self._capture.frames()
            for frame in frames:
                seen |= set(frame.bodies)
                for name in named:
                    if name in frame.bodies:
                        poses[name].append(frame.bodies[name])
            if self._now() > until_s:
                raise self._unseen(missing[0], seen)
            if not frames:
                self._wait(0.01)
        for name in named:
            if len(set(poses[name])) == 1:
                raise NotFound(
                    f"motion capture at {self._system} has {name!r} frozen: {SAMPLES} times the "
                    f"same numbers, and a measured pose has noise"
                )
        if isinstance(target, str):
            place, turned = _captured(poses[target], PositioningConfig())
            target = np.array([*place, turned[2]])
        return _relative(_captured(poses[self._body], self._mounted), target, self._gear)

    def close(self) -> None:
        self._capture.close()

    def _unseen(self, missing: str, seen: set[str]) -> PerchError:
        problem = self._capture.problem(self._now())
        if problem is not None:
            return ConnectionFailed(problem)
        return NotFound(
            f"motion capture at {self._system} does not see the rigid body {missing!r}; "
            f"it sees {', '.join(sorted(seen)) or 'none'}"
        )


def _captured(poses: list[BodyPose], mounted: PositioningConfig) -> Sample:
    placed = [Placed.of(pose, mounted) for pose in poses]
    return _median([(each.position_m, rpy_from_rotation(each.R)) for each in placed])


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
        self.close, self._wait = close, wait

    def actual(self, ask: Ask) -> Actual:
        """Errors: TimedOut."""
        if self._target is None:
            ask(
                "hold the gear's tip to the target's centre, nose along the target's x axis, "
                "then press Enter: "
            )
            position, rpy = self._body()
            tip = position + rotation_from_rpy(*rpy) @ self._gear
            self._target = np.array([*tip, rpy[2]])
            ask("the target's place is measured; now put the vehicle in place and press Enter: ")
        return _relative(self._body(), self._target, self._gear)

    def _body(self) -> Sample:
        self._telemetry()  # older samples do not count
        samples: list[Telemetry] = []
        waited_s = 0.0
        while len(samples) < SAMPLES:
            if waited_s >= WITHIN_S:
                raise TimedOut(f"the vehicle sends no state estimate (waited {WITHIN_S:g} s)")
            self._wait(0.02)
            waited_s += 0.02
            samples += self._telemetry()
        return _median([(s.position_m, (s.roll_rad, s.pitch_rad, s.yaw_rad)) for s in samples])
