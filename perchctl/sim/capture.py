"""A simulated motion-capture system: its settings and faults, what its cameras see of the simulated
vehicle, the delay of its frames, and its server on loopback."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from perchctl.geometry import (
    Array,
    quaternion_from_rotation,
    rot_z,
    rotation_from_quaternion,
    rotation_from_rpy,
)
from perchctl.positioning import BodyPose, CaptureFrame
from perchctl.profile import Profile
from perchctl.sim.scenario import draw_scenario

if TYPE_CHECKING:
    from perchctl.sim.world import World

_CAPTURE_STREAM = 13
_JITTER_LIMIT_SIGMAS = 3.0
TRUE_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class CaptureFault:
    """A temporary fault of the motion-capture system. With the defaults, there is no fault.

    Attributes:
        occluded: the vehicle's body is hidden from the cameras.
        frozen: all bodies are reported with exactly the pose in which they were last seen.
        gone: no frame is sent.
        swapped: the vehicle's body has swapped names with another body: the one called
            `swapped_with`, or the first other one if that is None.
        scale: factor on all positions; 1000 corresponds to millimetres.
        mirrored: the sign of y is inverted, as by a program with left-handed axes.
        axes: rows (3, 3) of the rotation from the world's axes to the system's.
        late_s: delay in addition to `CaptureSettings.delay_s`.
    """

    occluded: bool = False
    frozen: bool = False
    gone: bool = False
    swapped: bool = False
    swapped_with: str | None = None
    scale: float = 1.0
    mirrored: bool = False
    axes: tuple[tuple[float, ...], ...] = TRUE_AXES
    late_s: float = 0.0


@dataclass(frozen=True)
class CaptureSettings:
    """A simulated motion-capture system and its faults; SI units.

    Attributes:
        body: name of the vehicle's rigid body; `body_*`: its pose in body axes.
        others: (name, position m) of each other rigid body. These bodies do not move unless
            `SimCapture.others_m` is changed.
        rate_hz: frame rate of the system's cameras.
        delay_s, jitter_s: from an exposure to the frame's arrival, mean and one sigma.
        position_noise_m, attitude_noise_rad: one sigma, each axis.
        heading_rad, origin_m: pose of the simulator's world in the system's world.
        faults: (start s, end s, fault), on the simulation's clock.
    """

    body: str = "crazyflie"
    body_rpy_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    body_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    others: tuple[tuple[str, tuple[float, float, float]], ...] = (("wand", (1.2, -0.9, 0.05)),)
    rate_hz: float = 120.0
    delay_s: float = 0.01
    jitter_s: float = 0.0005
    position_noise_m: float = 0.001
    attitude_noise_rad: float = 0.005
    heading_rad: float = 0.0
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    faults: tuple[tuple[float, float, CaptureFault], ...] = ()
    seed: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all rigid bodies, the vehicle's first."""
        return (self.body, *(name for name, _ in self.others))


def draw_capture(profile: Profile, seed: int) -> CaptureSettings | None:
    """Return the motion-capture system for the seed's flight; None if the profile uses no motion
    capture."""
    config, sim = profile.positioning, profile.simulation
    if not config.source.is_mocap:
        return None
    roll, pitch, yaw = (math.radians(angle) for angle in config.body_rpy_deg)
    holes = draw_scenario(profile, seed).capture_holes_s
    hidden = CaptureFault(occluded=True)
    return CaptureSettings(
        body=config.body,
        body_rpy_rad=(roll, pitch, yaw),
        body_position_m=config.body_position_m,
        delay_s=sim.capture_delay_s,
        position_noise_m=sim.capture_noise_m,
        faults=tuple((begin_s, begin_s + length_s, hidden) for begin_s, length_s in holes),
        seed=seed,
    )


class SimCapture:
    """Motion capture with exposures at `rate_hz`. The same settings and flight give the same
    frames.

    This object is the `CaptureSource` of a flight in lockstep.

    Each exposure draws the same random numbers with or without a fault, so a fault changes no frame
    outside its time. Frames never overtake each other.
    """

    SYSTEM = "optitrack"
    """The system's name, as `motioncapture` calls it."""

    def __init__(self, settings: CaptureSettings) -> None:
        self.settings = settings
        self._rng = np.random.default_rng([settings.seed, _CAPTURE_STREAM])
        self._faults = list(settings.faults)
        self.others_m = [position_m for _, position_m in settings.others]  # their current positions
        self._R_body_rigid = rotation_from_rpy(*settings.body_rpy_rad)
        self._R_capture_world = rot_z(settings.heading_rad)
        self._due_s = float(self._rng.random()) / settings.rate_hz
        self._t_s = 0.0
        self._arrival_s = -math.inf
        self._before: dict[str, BodyPose] = {}
        self._under_way: deque[CaptureFrame] = deque()

    def begin_fault(self, fault: CaptureFault, for_s: float = math.inf) -> None:
        """Start a fault now that lasts for `for_s` of simulated time."""
        self._faults.append((self._t_s, self._t_s + for_s, fault))

    def end_faults(self) -> None:
        self._faults.clear()

    def advance(self, world: World) -> None:
        """Capture a frame of `world` if an exposure is due. Called in each control period."""
        self._t_s = t_s = world.t_s
        if t_s < self._due_s - 1e-9:
            return
        settings = self.settings
        self._due_s += 1.0 / settings.rate_hz
        noise = self._rng.standard_normal((len(settings.names), 6))
        jitter = float(np.clip(self._rng.normal(), -_JITTER_LIMIT_SIGMAS, _JITTER_LIMIT_SIGMAS))
        faults = [fault for since_s, to_s, fault in self._faults if since_s <= t_s < to_s]
        if not (self._before and any(fault.frozen for fault in faults)):
            self._before = self._bodies(world, noise, faults)
        if any(fault.gone for fault in faults):
            return
        arrival_s = t_s + max(0.0, settings.delay_s + jitter * settings.jitter_s)
        self._arrival_s = max(arrival_s + sum(f.late_s for f in faults), self._arrival_s)
        bodies = dict(self._before)
        if any(fault.occluded for fault in faults):
            del bodies[settings.body]
        self._under_way.append(CaptureFrame(self._arrival_s, bodies))

    def take(self) -> list[CaptureFrame]:
        """Return the frames that arrived by the time of the last `advance`, oldest first, each
        once."""
        arrived = []
        while self._under_way and self._under_way[0].t_s <= self._t_s + 1e-9:
            arrived.append(self._under_way.popleft())
        return arrived

    def poll(self, now_s: float) -> CaptureFrame | None:
        """Return the newest frame that has arrived since the last call, or None."""
        arrived = self.take()
        return arrived[-1] if arrived else None

    def problem(self, now_s: float) -> str | None:
        """Return None: this connection never has a problem."""
        return None

    def close(self) -> None:
        """Do nothing."""

    def _bodies(
        self, world: World, noise: Array, faults: list[CaptureFault]
    ) -> dict[str, BodyPose]:
        settings = self.settings
        R = rotation_from_quaternion(world.quaternion)
        place = np.array((world.x_m, world.y_m, world.z_m)) + R @ settings.body_position_m
        poses = [(place, R @ self._R_body_rigid)]
        poses += [(np.asarray(position_m), np.eye(3)) for position_m in self.others_m]
        seen = [
            self._pose(place, R, white, faults)
            for (place, R), white in zip(poses, noise, strict=True)
        ]
        names = list(settings.names)
        swap = next((fault for fault in reversed(faults) if fault.swapped), None)
        if swap is not None:
            other = 1 if swap.swapped_with is None else names.index(swap.swapped_with)
            names[0], names[other] = names[other], names[0]
        return dict(zip(names, seen, strict=True))

    def _pose(self, place: Array, R: Array, noise: Array, faults: list[CaptureFault]) -> BodyPose:
        settings = self.settings
        place = self._R_capture_world @ place + settings.origin_m
        place = place + settings.position_noise_m * noise[:3]
        a, b, c = (float(v) for v in settings.attitude_noise_rad * noise[3:])
        R = self._R_capture_world @ R @ rotation_from_rpy(a, b, c)
        turn, scale = np.eye(3), 1.0
        for fault in faults:
            turn, scale = np.array(fault.axes) @ turn, scale * fault.scale
        # A motion-capture system defines a body's axes parallel to its own, so a level body has the
        # identity attitude.
        x, y, z = (scale * float(v) for v in turn @ place)
        if any(fault.mirrored for fault in faults):
            y = -y
        return BodyPose((x, y, z), quaternion_from_rotation(turn @ R @ turn.T))


# --- The server on loopback ---
# It speaks NatNet 3.1, as OptiTrack's server does, so `motioncapture` can read it. Only the rigid
# bodies of a frame are filled in; a client skips the empty lists.


CONNECT, SERVER_INFO, ASK_MODELS, MODELS, FRAME_OF_DATA = 0, 1, 4, 5, 7
_HOST = "127.0.0.1"
_VERSION = bytes((3, 1, 0, 0))
_NAME_BYTES = 256
_TICKS_HZ = 1_000_000
_RIGID_BODY, _NO_PARENT = 1, -1
_EMPTY = struct.pack("<i", 0)
_UNSEEN = BodyPose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))


class MotionCaptureServer:
    """Serves NatNet requests in a thread; `publish` sends a frame to the newest client at once."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = tuple(names)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((_HOST, 0))
        self.host = f"{_HOST}:{self._socket.getsockname()[1]}"
        self._client: tuple[str, int] | None = None
        self._count = 0
        threading.Thread(target=self._answer, name="capture-server", daemon=True).start()

    def publish(self, frame: CaptureFrame) -> None:
        """Send a frame to the client, if any has asked; UDP may lose the frame."""
        self._count += 1
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(frame_message(self._count, self._names, frame), self._client)

    def _answer(self) -> None:
        while True:
            with contextlib.suppress(OSError):  # error from a client that has disconnected
                request, address = self._socket.recvfrom(2048)
                kind = int.from_bytes(request[:2], "little") if len(request) >= 4 else None
                if kind == CONNECT:
                    self._client = address[0], _free_port()
                    self._socket.sendto(_server_info(self._client[1]), address)
                elif kind == ASK_MODELS:
                    self._socket.sendto(_models(self._names), address)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
        return port


def _message(kind: int, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack("<HH", kind, len(body)) + body


def _server_info(data_port: int) -> bytes:
    name = b"perchctl".ljust(_NAME_BYTES, b"\0")
    where = struct.pack("<QH?4B", _TICKS_HZ, data_port, False, 0, 0, 0, 0)
    return _message(SERVER_INFO, name, _VERSION, _VERSION, where)


def _models(names: Sequence[str]) -> bytes:
    parts = [struct.pack("<i", len(names))]
    for number, name in enumerate(names, 1):
        parts += [struct.pack("<i", _RIGID_BODY), name.encode() + b"\0"]
        parts += [struct.pack("<ii3f", number, _NO_PARENT, 0.0, 0.0, 0.0), _EMPTY]  # no markers
    return _message(MODELS, *parts)


def frame_message(number: int, names: Sequence[str], frame: CaptureFrame) -> bytes:
    """Return the NatNet message for a frame. Bodies in `names` that are missing in the frame are
    marked as untracked."""
    parts = [struct.pack("<i", number), _EMPTY, _EMPTY]  # marker sets, other markers
    parts.append(struct.pack("<i", len(names)))
    for index, name in enumerate(names, 1):
        pose = frame.bodies.get(name, _UNSEEN)
        w, x, y, z = pose.quaternion
        tracked = name in frame.bodies
        parts.append(struct.pack("<i3f4ffh", index, *pose.position_m, x, y, z, w, 0.0, tracked))
    parts += [_EMPTY] * 4  # skeletons, labelled markers, force plates, devices
    ticks = round(frame.t_s * _TICKS_HZ)
    parts.append(struct.pack("<IId3Qh", 0, 0, frame.t_s, ticks, ticks, ticks, 0) + _EMPTY)
    return _message(FRAME_OF_DATA, *parts)
