"""What the cameras of a motion-capture room see of the simulated vehicle, and when it arrives."""

from __future__ import annotations

import math
from collections import deque
from typing import Protocol

import numpy as np

from perchctl.geometry import (
    Array,
    quaternion_from_rotation,
    rot_z,
    rotation_from_quaternion,
    rotation_from_rpy,
)
from perchctl.positioning import BodyPose, CaptureFrame
from perchctl.sim.capture.settings import CaptureFault, CaptureSettings, OtherBody, axes_matrix

_STREAM = 13
_JITTER_LIMIT_SIGMAS = 3.0


class Seen(Protocol):
    """The part of the world that cameras see."""

    x_m: float
    y_m: float
    z_m: float
    quaternion: tuple[float, float, float, float]

    @property
    def t_s(self) -> float: ...


class SimCapture:
    """Exposes at `rate_hz`; same settings and flight, same frames.

    Each exposure draws the same random numbers whatever is wrong, so a fault changes no frame
    outside its time. Frames never overtake each other.
    """

    def __init__(self, settings: CaptureSettings) -> None:
        self.settings = settings
        self._rng = np.random.default_rng([settings.seed, _STREAM])
        self._faults = list(settings.faults)
        self._R_body_rigid = rotation_from_rpy(*settings.body_rpy_rad)
        self._p_body_rigid = np.asarray(settings.body_position_m)
        self._R_capture_world = rot_z(settings.heading_rad)
        self._origin_m = np.asarray(settings.origin_m)
        self._due_s = float(self._rng.random()) / settings.rate_hz
        self._t_s = 0.0
        self._arrival_s = -math.inf
        self._delivered_s = -math.inf
        self._before: dict[str, BodyPose] = {}
        self._under_way: deque[CaptureFrame] = deque()

    def lay(self, fault: CaptureFault, for_s: float = math.inf) -> None:
        """From now on, for so long."""
        self._faults.append((self._t_s, self._t_s + for_s, fault))

    def heal(self) -> None:
        """Nothing is wrong any more."""
        self._faults.clear()

    def advance(self, world: Seen) -> None:
        """Called each control period: exposes if it is time to."""
        self._t_s = t_s = world.t_s
        if t_s < self._due_s - 1e-9:
            return
        self._due_s += 1.0 / self.settings.rate_hz
        noise = self._rng.standard_normal((len(self.settings.names), 6))
        jitter = float(np.clip(self._rng.normal(), -_JITTER_LIMIT_SIGMAS, _JITTER_LIMIT_SIGMAS))
        faults = [fault for since_s, to_s, fault in self._faults if since_s <= t_s < to_s]
        bodies = self._bodies(world, noise, faults)
        least_s = 1.0 / min([math.inf, *(fault.rate_hz for fault in faults)])
        if any(fault.gone for fault in faults) or t_s - self._delivered_s < least_s - 1e-9:
            return
        self._delivered_s = t_s
        delay_s = self.settings.delay_s + jitter * self.settings.jitter_s
        arrival_s = t_s + max(0.0, delay_s) + sum(fault.late_s for fault in faults)
        self._arrival_s = max(arrival_s, self._arrival_s)
        if any(fault.occluded for fault in faults):
            bodies = {n: pose for n, pose in bodies.items() if n != self.settings.body}
        self._under_way.append(CaptureFrame(self._arrival_s, bodies))

    def take(self) -> list[CaptureFrame]:
        """The frames that arrived by the time of the last `advance`, oldest first, once."""
        arrived = []
        while self._under_way and self._under_way[0].t_s <= self._t_s + 1e-9:
            arrived.append(self._under_way.popleft())
        return arrived

    def _bodies(self, world: Seen, noise: Array, faults: list[CaptureFault]) -> dict[str, BodyPose]:
        """By the name under which the capture has them."""
        if self._before and any(fault.frozen for fault in faults):
            return self._before
        settings = self.settings
        R = rotation_from_quaternion(world.quaternion)
        place = np.array((world.x_m, world.y_m, world.z_m)) + R @ self._p_body_rigid
        seen = [self._pose(place, R @ self._R_body_rigid, noise[0], faults)]
        seen += [
            self._pose(_place(other, world.t_s), np.eye(3), white, faults)
            for other, white in zip(settings.others, noise[1:], strict=True)
        ]
        names = list(settings.names)
        if any(fault.swapped for fault in faults) and len(names) > 1:
            names[:2] = names[1], names[0]
        self._before = dict(zip(names, seen, strict=True))
        return self._before

    def _pose(self, place: Array, R: Array, noise: Array, faults: list[CaptureFault]) -> BodyPose:
        settings = self.settings
        place = self._R_capture_world @ place + self._origin_m
        place = place + settings.position_noise_m * noise[:3]
        a, b, c = (float(v) for v in settings.attitude_noise_rad * noise[3:])
        R = self._R_capture_world @ R @ rotation_from_rpy(a, b, c)
        axes, scale = settings.axes, 1.0
        for fault in faults:
            axes, scale = fault.axes or axes, scale * fault.scale
        turn = axes_matrix(axes)
        # A system defines a body's axes along its own: a level body's attitude is none at all.
        x, y, z = (scale * float(v) for v in turn @ place)
        if any(fault.mirrored for fault in faults):
            y = -y
        return BodyPose((x, y, z), quaternion_from_rotation(turn @ R @ turn.T))


def _place(other: OtherBody, t_s: float) -> Array:
    phase = math.sin(2.0 * math.pi * t_s / other.period_s)
    return np.asarray(other.position_m) + phase * np.asarray(other.swing_m)


class LockstepCapture:
    """The `CaptureSource` of a flight in lockstep: the newest frame wins."""

    def __init__(self, capture: SimCapture) -> None:
        self._capture = capture

    def poll(self, now_s: float) -> CaptureFrame | None:
        arrived = self._capture.take()
        return arrived[-1] if arrived else None

    def problem(self, now_s: float) -> str | None:
        return None

    def close(self) -> None:
        return None
