"""What a motion-capture system delivers, and from whom it is taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

Quaternion = tuple[float, float, float, float]  # w, x, y, z


@dataclass(frozen=True)
class BodyPose:
    """A rigid body in the capture's world: its origin, and the turn from its axes to the
    world's. SI; as the system says it, before the profile's turn and offset."""

    position_m: tuple[float, float, float]
    quaternion: Quaternion


@dataclass(frozen=True)
class CaptureFrame:
    """`t_s`: its arrival, on the loop's clock. A body that is occluded is not in it."""

    t_s: float
    bodies: Mapping[str, BodyPose] = field(default_factory=dict)


class CaptureSource(Protocol):
    """A motion-capture system, real or simulated; nothing in it blocks."""

    def poll(self, now_s: float) -> CaptureFrame | None:
        """The newest frame that has arrived by `now_s`, None if none since the last call."""

    def problem(self, now_s: float) -> str | None:
        """None while it works; otherwise one sentence with the cause."""

    def close(self) -> None: ...
