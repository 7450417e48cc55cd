"""Which of a capture's frames may be believed, and where the vehicle's body is in them.

Motion capture fails in ways that look like data: a body that is hidden keeps its last pose,
two bodies swap their names, a symmetric one flips, a pose arrives late (faults 10 and 11).
Each is refused here, with one sentence that names it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from perchctl.errors import distinct_figures
from perchctl.geometry import (
    Array,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_rpy,
)
from perchctl.positioning.types import BodyPose, CaptureFrame
from perchctl.profile import PositioningConfig
from perchctl.vehicle import ExternalPosition

STALE_S = 0.05
"""A frame that waited longer after its arrival is for another moment: a vehicle that climbs at
0.5 m/s is 25 mm from there, five times what the capture is trusted for."""
UNIT_WITHIN = 0.01
"""Of a quaternion's length; single precision keeps 1e-6."""
NOISE_M, NOISE_RAD = 0.05, math.radians(20.0)
"""What a pose may move between two frames without the body having moved."""
FASTEST_MPS, FASTEST_RADPS, AT_FASTEST_S = 5.0, 10.0, 0.02
"""A vehicle that falls 1.3 m, or is pushed over, for the first moment."""
HELD_MPS, HELD_RADPS = 0.5, 1.0
"""After that moment: without a position it is held where it is, and drifts."""
SEEN_S = 1.0
"""Names of other bodies that a sentence mentions are not older."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A body of the vehicle's axes in the capture's world: (3,) and (3, 3), at `t_s`."""

    t_s: float
    position_m: Array
    R: Array

    @classmethod
    def of(cls, pose: BodyPose, config: PositioningConfig, t_s: float = 0.0) -> Placed:
        """Of the vehicle's body, from the rigid body's axes as the capture system has defined
        them: ``T_world_body = T_world_rigid @ inv(T_body_rigid)``."""
        roll, pitch, yaw = (math.radians(angle) for angle in config.body_rpy_deg)
        length = math.sqrt(sum(part * part for part in pose.quaternion))
        w, x, y, z = (part / length for part in pose.quaternion)
        R = rotation_from_quaternion((w, x, y, z)) @ rotation_from_rpy(roll, pitch, yaw).T
        return cls(t_s, np.asarray(pose.position_m) - R @ np.asarray(config.body_position_m), R)

    def external(self, *, pose: bool) -> ExternalPosition:
        x, y, z = (float(part) for part in self.position_m)
        return ExternalPosition((x, y, z), quaternion_from_rotation(self.R) if pose else None)


class Judge:
    """Asked about each frame in turn; keeps the last pose that was believed, and the one that
    was not."""

    def __init__(self, config: PositioningConfig) -> None:
        self._config = config
        self._who = f"the rigid body {config.body!r} of the {config.label}"
        self._arrived_s = -math.inf
        self._newest: BodyPose | None = None
        self._believed: Placed | None = None
        self._stranger: Placed | None = None
        self._seen: dict[str, float] = {}
        self.problem: str | None = None
        """Why the newest frame with news was not believed; None if it was."""

    def judge(self, frame: CaptureFrame, now_s: float) -> Placed | None:
        """The vehicle's place if the frame has one that may be sent, its time that of the
        exposure; otherwise `problem` says why, or there was no news in it."""
        arrived_s = min(frame.t_s, now_s)  # nothing arrives later than now
        if not math.isfinite(arrived_s) or arrived_s <= self._arrived_s:
            return None
        self._arrived_s = arrived_s
        self._seen |= dict.fromkeys(frame.bodies, now_s)
        pose = frame.bodies.get(self._config.body)
        if pose is None:
            self.problem = self._missing(now_s)
            return None
        if now_s - arrived_s > STALE_S:
            age, allowed = distinct_figures(now_s - arrived_s, STALE_S, 2)
            self.problem = (
                f"{self._who} is {age} s old when it is read; at most {allowed} s may pass"
            )
            return None
        if not _is_pose(pose):
            self.problem = (
                f"{self._who} has a pose that is none: position {_numbers(pose.position_m)}, "
                f"quaternion {_numbers(pose.quaternion)}"
            )
            return None
        if pose == self._newest:
            # Measured noise never repeats all seven numbers; a filter or a doubled frame may,
            # for a frame or two, and then nothing is lost. So a repetition is no news, and
            # `Placed.t_s` stays that of its first frame.
            self.problem = self._frozen() if self._stranger is None else self.problem
            return None
        self._newest = pose
        return self._followed(
            Placed.of(pose, self._config, arrived_s - self._config.latency_s), now_s
        )

    def _followed(self, placed: Placed, now_s: float) -> Placed | None:
        """Refused where no vehicle can be so soon.

        A jump that stays is not taken for true by and by, though a vehicle could have got
        there in the meantime: what goes on from a refused pose is refused, until the body is
        seen again where it was left. On the way there the age grows, and the flight ends by it.
        """
        last, stranger = self._believed, self._stranger
        if last is not None:
            jump = _jump(last, placed)
            if stranger is not None and _jump(stranger, placed) is None:
                nearer = _way_m(stranger, placed) <= _way_m(last, placed)
                jump = jump or (_way(last, placed) if nearer else None)
            if jump is not None:
                self._stranger = placed
                self.problem = (
                    f"{self._who} jumped by {jump}: perhaps another body is taken for it; it is "
                    f"not believed until it is seen where it was, or perchctl starts again"
                )
                return None
        self._believed, self._stranger, self.problem = placed, None, None
        return placed

    def _missing(self, now_s: float) -> str:
        others = sorted(name for name, t_s in self._seen.items() if now_s - t_s <= SEEN_S)
        others = [name for name in others if name != self._config.body]
        return (
            f"{self._config.label} does not see the rigid body {self._config.body!r}; "
            f"it sees {', '.join(others) or 'none'}"
        )

    def _frozen(self) -> str:
        return (
            f"{self._who} is frozen: all of its numbers repeat, and a measured pose has noise; "
            f"is it hidden, or the capture paused?"
        )


def _is_pose(pose: BodyPose) -> bool:
    if not all(math.isfinite(part) for part in (*pose.position_m, *pose.quaternion)):
        return False
    return abs(math.sqrt(sum(part * part for part in pose.quaternion)) - 1.0) <= UNIT_WITHIN


def _jump(a: Placed, b: Placed) -> str | None:
    """What is too far from `a` to `b`, None if a vehicle can have gone so."""
    dt_s = b.t_s - a.t_s
    first_s = min(dt_s, AT_FASTEST_S)
    far_m = NOISE_M + FASTEST_MPS * first_s + HELD_MPS * (dt_s - first_s)
    far_rad = NOISE_RAD + FASTEST_RADPS * first_s + HELD_RADPS * (dt_s - first_s)
    return _way(a, b) if _way_m(a, b) > far_m or _turn_rad(a, b) > far_rad else None


def _way(a: Placed, b: Placed) -> str:
    return (
        f"{_way_m(a, b):.2f} m and {math.degrees(_turn_rad(a, b)):.0f} deg in "
        f"{(b.t_s - a.t_s) * 1e3:.0f} ms"
    )


def _way_m(a: Placed, b: Placed) -> float:
    return float(np.linalg.norm(b.position_m - a.position_m))


def _turn_rad(a: Placed, b: Placed) -> float:
    return math.acos(max(-1.0, min(1.0, (float(np.trace(a.R.T @ b.R)) - 1.0) / 2.0)))


def _numbers(values: tuple[float, ...]) -> str:
    return " ".join(f"{value:g}" for value in values)
