"""A simulated vehicle in a hand: carried about under the target, and turned about its gear's tip.

How its camera is mounted, how late the pictures are and what its sensors have wrong is drawn from
the seed. The pictures come from the renderer by the simulated camera, with its blur, noise, losses
and jitter; the attitude with its errors at the rate of the log blocks. Nothing flies.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from perchctl.calibration import AttitudeSample, MountingRecording, PoseReader
from perchctl.camera import unmirror_frame
from perchctl.geometry import Array, invert_T, make_T, rotation_from_rpy, rpy_from_rotation
from perchctl.profile import Profile
from perchctl.sim.camera import DeliveredFrame, SimCamera
from perchctl.sim.renderer import Renderer
from perchctl.sim.scenario import Scenario, draw_scenario
from perchctl.vision import CameraModel, Frame

Part = Literal["carry", "pivot"]
HAND_STREAM = 430
SECONDS: dict[Part, float] = {"carry": 30.0, "pivot": 20.0}
LATENCY_S = (0.02, 0.15)
MOVED_M, MOVED_UP_M = 0.06, (-0.02, 0.01)
MOUNT_TILT_DEG, TARGET_TILT_DEG = 5.0, 5.0
ATTITUDE_NOISE_DEG, ATTITUDE_BIAS_DEG, ATTITUDE_MEMORY_S = 0.3, 0.5, 1.0
TELEMETRY_S, LOST_TELEMETRY = 0.01, 0.01
# Bosch BMI088: 0.014 dps per root hertz behind the firmware's filter of 80 Hz; what is left of its
# zero-rate offset after a start at rest; its sensitivity, to 1 %; its 16 bits over +-2000 dps.
GYRO_NOISE_DPS, GYRO_BIAS_DPS, GYRO_STEP_DPS = 0.14, 0.5, 2000.0 / 32768.0
GYRO_SCALE_SIGMA = 0.005
FAR_M, SWAY, SWAY_HZ = 0.37, (0.14, 0.14, 0.12), (0.05, 0.3)
WANDER_M, WANDER_HZ = (7e-5, 7e-5, 7e-5), (0.1, 1.0)
BOLT_M, BOLT_PER_ASIDE = (0.03, 0.06), 0.4
"""How high over the sheet the tip stands, and by how much of the camera's way aside more."""
_RATE_STEP_S = 1e-4


@dataclass(frozen=True, eq=False)
class Waves:
    """Smooth random motion: sums of sines, amplitude (k, n), rate_hz (k, n), phase (k, n)."""

    amplitude: Array
    rate_hz: Array
    phase: Array

    def __call__(self, t_s: Array) -> Array:
        """Return the motion (m, k) at times (m,)."""
        angle = 2.0 * math.pi * self.rate_hz * np.asarray(t_s)[:, None, None] + self.phase
        return np.asarray((self.amplitude * np.sin(angle)).sum(axis=2))


@dataclass(frozen=True, eq=False)
class Hand:
    """All that is true of one recording.

    Attributes:
        scenario: of the camera: its true place `T_body_cam_true`, latency, noise and losses.
        R_world_target: in the world of the vehicle's estimate.
        seconds: how long the part lasts.
        size_error: share by which the print is larger than it should be.
        heading_rad: of the camera in the target's frame, about which it turns.
        turns: tilts about the camera's x and y, and the heading.
        sway: in a carry where the target is, right and down of the view (rad), and how much
            farther than `FAR_M`; in a pivot how the tip wanders on its point (m).
        point_target_m: where the tip stands in a pivot, target axes.
        slips_m, slips_at_s: the tip jumps by so much at that time.
    """

    seed: int
    part: Part
    scenario: Scenario
    R_world_target: Array
    seconds: float
    size_error: float
    gyro_bias_radps: Array
    gyro_scale: Array
    attitude_bias_rad: Array
    heading_rad: float
    turns: Waves
    sway: Waves
    point_target_m: Array
    slips_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    slips_at_s: float = math.inf

    @property
    def T_body_cam(self) -> Array:
        return np.array(self.scenario.T_body_cam_true)

    @property
    def rpy_deg(self) -> tuple[float, float, float]:
        x, y, z = np.degrees(rpy_from_rotation(self.T_body_cam[:3, :3]))
        return float(x), float(y), float(z)

    @property
    def latency_s(self) -> float:
        return self.scenario.camera_latency_s

    @property
    def gear_cam_m(self) -> Array:
        T = self.T_body_cam
        return np.asarray(T[:3, :3].T @ (np.array(self.scenario.gear_body_m) - T[:3, 3]))


def draw_hand(profile: Profile, part: Part, seed: int, seconds: float | None = None) -> Hand:
    """Return the hand of that seed; both parts of one seed have the same vehicle."""
    rng = np.random.default_rng([seed, HAND_STREAM])
    yaw, *tilt = np.radians(rng.uniform(-1.0, 1.0, 3) * (180.0, MOUNT_TILT_DEG, MOUNT_TILT_DEG))
    way, far = rng.uniform(-math.pi, math.pi), MOVED_M * math.sqrt(rng.uniform())
    up = rng.uniform(*MOVED_UP_M)
    flat = math.sqrt(max(far**2 - up**2, 0.0))
    moved = np.array([flat * math.cos(way), flat * math.sin(way), up])
    T_body_cam = make_T(
        rotation_from_rpy(tilt[0], tilt[1], yaw), np.array(profile.camera.mount.position_m) + moved
    )
    latency_s = float(rng.uniform(*LATENCY_S))
    size_error = profile.target.size_sigma * float(rng.normal())
    lean = np.radians(rng.uniform(-1.0, 1.0, 3) * (TARGET_TILT_DEG, TARGET_TILT_DEG, 180.0))
    bias_way = rng.uniform(-math.pi, math.pi)
    bias = math.radians(ATTITUDE_BIAS_DEG) * np.array([math.cos(bias_way), math.sin(bias_way), 0.0])
    gyro_bias = np.radians(rng.uniform(-1.0, 1.0, 3) * GYRO_BIAS_DPS)
    gyro_scale = GYRO_SCALE_SIGMA * rng.normal(size=3)
    scenario = replace(
        draw_scenario(profile, seed),
        T_body_cam_true=tuple(tuple(float(v) for v in row) for row in T_body_cam),
        camera_latency_s=latency_s,
        no_target=False,
    )
    rng = np.random.default_rng([seed, HAND_STREAM, ("carry", "pivot").index(part)])
    hand = Hand(
        seed=seed,
        part=part,
        scenario=scenario,
        R_world_target=rotation_from_rpy(*(float(v) for v in lean)),
        seconds=SECONDS[part] if seconds is None else seconds,
        size_error=size_error,
        gyro_bias_radps=gyro_bias,
        gyro_scale=gyro_scale,
        attitude_bias_rad=bias,
        heading_rad=float(rng.uniform(-math.pi, math.pi)),
        turns=_turns(rng, part),
        sway=_waves(rng, *((SWAY, SWAY_HZ) if part == "carry" else (WANDER_M, WANDER_HZ))),
        point_target_m=np.zeros(3),
    )
    level = _rot_z(np.array([hand.heading_rad]))[0]
    point = level @ (hand.gear_cam_m * (1.0, 1.0, 0.0))
    # The tip on a bolt, so that the level camera looks at the target's middle.
    # It is higher for a camera that is farther aside, which would touch the sheet else.
    high_m = rng.uniform(*BOLT_M) + BOLT_PER_ASIDE * float(np.linalg.norm(point))
    return replace(hand, point_target_m=point - (0.0, 0.0, high_m))


def _turns(rng: np.random.Generator, part: Part) -> Waves:
    """Return tilts about the camera's x and y, and its heading, in rad."""
    slow_deg, round_deg, quick_deg = (27.0, 200.0, 6.0) if part == "carry" else (25.0, 40.0, 2.0)
    slow = _waves(rng, np.radians([slow_deg, slow_deg, 0.0]), (0.12, 0.3))
    # One of the two sines goes round, so that it is tilted to all sides.
    for values in (slow.amplitude, slow.rate_hz, slow.phase):
        values[1, 0] = values[0, 0]
    slow.phase[1, 0] += 0.5 * math.pi
    return _together(
        slow,
        _waves(rng, np.radians([0.0, 0.0, round_deg]), (0.03, 0.08)),
        _waves(rng, np.radians([quick_deg, quick_deg, 2.0 * quick_deg]), (0.4, 1.0)),
        _waves(rng, np.radians([0.1, 0.1, 0.1]), (4.0, 8.0)),  # tremor
    )


def _waves(
    rng: np.random.Generator, amplitude: Sequence[float] | Array, rate_hz: tuple[float, float]
) -> Waves:
    """Return two sines a channel, which together reach its amplitude, at rates so different
    that they do not cancel for long."""
    size = np.array(amplitude)[:, None]
    share = rng.uniform(0.4, 0.6, (len(size), 1))
    low, high = rate_hz
    apart = (high - low) / 3.0
    slower, faster = rng.uniform(0.0, apart, (2, len(size)))
    return Waves(
        amplitude=np.hstack([size * share, size * (1.0 - share)]),
        rate_hz=np.stack([low + slower, high - faster], axis=1),
        phase=rng.uniform(-math.pi, math.pi, (len(size), 2)),
    )


def _together(*waves: Waves) -> Waves:
    return Waves(
        *(
            np.hstack([getattr(w, name) for w in waves])
            for name in ("amplitude", "rate_hz", "phase")
        )
    )


def _rot_z(angles: Array) -> Array:
    return np.asarray(Rotation.from_euler("z", angles[:, None]).as_matrix())


# --- the true motion ---------------------------------------------------------------------


def R_target_cam(hand: Hand, t_s: Array) -> Array:
    """Return the camera's turn at times (n,), (n, 3, 3)."""
    turns = hand.turns(t_s)
    return np.asarray(
        _rot_z(hand.heading_rad + turns[:, 2])
        @ Rotation.from_rotvec(turns * (1.0, 1.0, 0.0)).as_matrix()
    )


def cam_target_m(hand: Hand, t_s: Array) -> Array:
    """Return the camera's place in the target's frame at times (n,), (n, 3)."""
    R = R_target_cam(hand, t_s)
    if hand.part == "pivot":
        slipped = (np.asarray(t_s) >= hand.slips_at_s)[:, None] * hand.slips_m
        return np.asarray(
            hand.point_target_m + slipped + hand.sway(t_s)[:, :3] - R @ hand.gear_cam_m
        )
    x, y, far = hand.sway(t_s).T
    sight = np.stack([np.tan(x), np.tan(y), np.ones_like(x)], axis=1)
    sight *= ((FAR_M + far) / np.linalg.norm(sight, axis=1))[:, None]
    return np.asarray(-np.einsum("nij,nj->ni", R, sight))


def T_target_cam_at(hand: Hand, t_s: float) -> Array:
    now = np.array([t_s])
    return make_T(R_target_cam(hand, now)[0], cam_target_m(hand, now)[0])


# --- what the sensors make of it ---------------------------------------------------------


def attitudes(hand: Hand, errors: bool = True) -> list[AttitudeSample]:
    """Return the vehicle's samples without those that the radio loses; or, without `errors`, the
    truth."""
    rng = np.random.default_rng([hand.seed, HAND_STREAM, 2, ("carry", "pivot").index(hand.part)])
    t_s = np.arange(0.0, hand.seconds + 0.3, TELEMETRY_S)
    R_cam_body = hand.T_body_cam[:3, :3].T

    def R_world_body(at_s: Array) -> Array:
        return np.asarray(hand.R_world_target @ R_target_cam(hand, at_s) @ R_cam_body)

    now = R_world_body(t_s)
    h = _RATE_STEP_S
    before, after = R_world_body(t_s - h), R_world_body(t_s + h)
    rate = Rotation.from_matrix(before.transpose(0, 2, 1) @ after).as_rotvec() / (2.0 * h)
    rpy = np.array([rpy_from_rotation(R) for R in now])
    kept = np.ones(len(t_s), bool)
    if errors:
        noise = rng.normal(size=rate.shape) * math.radians(GYRO_NOISE_DPS)
        step = math.radians(GYRO_STEP_DPS)
        measured = rate / (1.0 + hand.gyro_scale) + hand.gyro_bias_radps + noise
        rate = np.round(measured / step) * step
        slow = math.radians(ATTITUDE_NOISE_DEG) * _slow_noise(rng, len(t_s), ATTITUDE_MEMORY_S)
        rpy = rpy + hand.attitude_bias_rad + slow
        kept = rng.random(len(t_s)) >= LOST_TELEMETRY
    rpy = (rpy + math.pi) % (2.0 * math.pi) - math.pi
    return [
        AttitudeSample(
            t_s=float(t_s[k]),
            roll_rad=float(rpy[k, 0]),
            pitch_rad=float(rpy[k, 1]),
            yaw_rad=float(rpy[k, 2]),
            gyro_radps=rate[k],
        )
        for k in np.flatnonzero(kept)
    ]


def _slow_noise(rng: np.random.Generator, n: int, memory_s: float) -> Array:
    """Return noise (n, 3) of unit spread that forgets itself in `memory_s`."""
    keep = math.exp(-TELEMETRY_S / memory_s)
    kicks = rng.normal(size=(n, 3)) * math.sqrt(1.0 - keep * keep)
    out = np.empty((n, 3))
    out[0] = rng.normal(size=3)
    for k in range(1, n):
        out[k] = keep * out[k - 1] + kicks[k]
    return out


def pictures(hand: Hand, profile: Profile, camera: CameraModel) -> Iterator[DeliveredFrame]:
    """Return the camera's frames in the order of their arrival, rendered as they are asked for."""
    renderer = Renderer(hand.scenario, camera, profile.target, hand.seed)
    source = SimCamera(hand.scenario, renderer)
    T_room_target = renderer.T_world_target
    T_cam_body = invert_T(hand.T_body_cam)

    def T_room_body(t_s: float) -> Array:
        T_target_cam = T_target_cam_at(hand, t_s)
        # A larger print from farther away is the same picture.
        T_target_cam[:3, 3] /= 1.0 + hand.size_error
        return np.asarray(T_room_target @ T_target_cam @ T_cam_body)

    period_s = 1.0 / hand.scenario.camera_rate_hz
    for k in range(1, math.ceil((hand.seconds + 0.3) / period_s)):
        source.advance(k * period_s, T_room_body)
        yield from source.take()


def record_hand(hand: Hand, profile: Profile, camera: CameraModel) -> MountingRecording:
    """Record the whole part, through renderer and pipeline."""
    reader = PoseReader(profile, camera, live=False)
    poses = []
    for frame in pictures(hand, profile, camera):
        picture = Frame(frame.index, frame.t_arrival_s, frame.image, frame.t_arrival_s, "whole")
        if profile.camera.mirrored:
            picture = unmirror_frame(picture)
        poses += reader.read_poses(picture)
    return MountingRecording(hand.part, attitudes(hand), poses, reader.mirrored)
