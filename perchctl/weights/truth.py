"""Where a collected position's actual pose comes from: a person, or motion capture.

The actual pose is what the pipeline measures: the target relative to the gear's tip in
the level frame, (x, y, z, yaw).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perchctl.errors import ConnectionFailed, InvalidValue, NotFound, PerchError
from perchctl.geometry import Array, rot_z, rotation_from_rpy, rpy_from_rotation, wrap_rad
from perchctl.positioning import BodyPose, CaptureFrame, Placed
from perchctl.profile import PositioningConfig
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


class TypedTruth:
    """A person with a ruler: centimetres and degrees, as in the paper's tables."""

    repeatable = False

    def actual(self, ask: Ask) -> Actual:
        """Errors: InvalidValue for an answer that is no pose."""
        text = ask("actual pose of the target from the gear, x y z [cm] and yaw [deg]: ")
        try:
            x, y, z, yaw = (float(cell) for cell in text.replace(",", " ").split())
        except ValueError:
            x = y = z = yaw = math.nan
        if not math.isfinite(x + y + z + yaw):
            raise InvalidValue(
                f"{text.strip()!r} is not a pose: four numbers are needed, x y z and yaw"
            )
        return Actual(np.array([0.01 * x, 0.01 * y, 0.01 * z, wrap_rad(math.radians(yaw))]))

    def close(self) -> None:
        return None


class CapturedFrames(Protocol):
    """The part of a motion capture that is needed here."""

    def frames(self) -> list[CaptureFrame]: ...

    def problem(self, now_s: float) -> str | None: ...

    def close(self) -> None: ...


class MocapTruth:
    """Motion capture, by the reader that flights have.

    Args:
        config: names the capture and the vehicle's rigid body, and how that lies in body axes.
        target: rigid body of the target; its x axis is the heading.
    """

    repeatable = True

    def __init__(
        self,
        capture: CapturedFrames,
        config: PositioningConfig,
        target: str,
        gear_body_m: Array,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._capture, self._config, self._target = capture, config, target
        self._gear, self._now, self._wait = gear_body_m, now, wait

    def actual(self, ask: Ask) -> Actual:
        """Errors: ConnectionFailed, NotFound."""
        self._capture.frames()  # older ones do not count
        poses: dict[str, list[BodyPose]] = {self._config.body: [], self._target: []}
        seen: set[str] = set()
        until_s = self._now() + WITHIN_S
        while missing := [name for name, found in poses.items() if len(found) < SAMPLES]:
            frames = self._capture.frames()
            for frame in frames:
                seen |= set(frame.bodies)
                for name in poses.keys() & frame.bodies.keys():
                    poses[name].append(frame.bodies[name])
            if self._now() > until_s:
                raise self._unseen(missing[0], seen)
            if not frames:
                self._wait(0.01)
        for name, found in poses.items():
            if len(set(found)) == 1:
                raise NotFound(
                    f"{self._config.label} has {name!r} frozen: {SAMPLES} times the same numbers, "
                    f"and a measured pose has noise"
                )
        target_m, (_, _, target_yaw) = _median(poses[self._target], PositioningConfig())
        body_m, (roll, pitch, yaw) = _median(poses[self._config.body], self._config)
        level = rot_z(-yaw) @ (target_m - body_m)
        e_m = level - rotation_from_rpy(roll, pitch, 0.0) @ self._gear
        attitude = Attitude(0.0, roll, pitch, yaw, (body_m[0], body_m[1], body_m[2]))
        return Actual(np.array([*e_m, wrap_rad(target_yaw - yaw)]), attitude)

    def close(self) -> None:
        """Ends the capture."""
        self._capture.close()

    def _unseen(self, missing: str, seen: set[str]) -> PerchError:
        problem = self._capture.problem(self._now())
        if problem is not None:
            return ConnectionFailed(problem)
        return NotFound(
            f"{self._config.label} does not see the rigid body {missing!r}; it sees "
            f"{', '.join(sorted(seen)) or 'none'}"
        )


def _median(
    poses: list[BodyPose], mounted: PositioningConfig
) -> tuple[Array, tuple[float, float, float]]:
    """Position (3,) m and roll, pitch, yaw of the body's axes in the world."""
    placed = [Placed.of(pose, mounted) for pose in poses]
    rpy = np.unwrap([rpy_from_rotation(each.R) for each in placed], axis=0)
    roll, pitch, yaw = (float(angle) for angle in np.median(rpy, axis=0))
    return np.median([each.position_m for each in placed], axis=0), (roll, pitch, wrap_rad(yaw))
