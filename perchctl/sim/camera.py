"""The simulated camera: it determines when frames are exposed, which are lost, and when the others
arrive."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from perchctl.geometry import Array
from perchctl.sim.optics import Picture
from perchctl.sim.renderer import Exposure, Renderer
from perchctl.sim.scenario import Scenario

SCHEDULE_STREAM = 411
"""Number of the random stream for the frame schedule."""
LIGHT_STREAM = 412
"""Number of the random stream for the light and the receiver."""

JITTER_LIMIT_SIGMAS = 2.5


PoseAt = Callable[[float], Array]
"""Function that returns the pose (4, 4) of the body or of the camera in the world at a given time,
s."""


@dataclass(frozen=True, eq=False)
class DeliveredFrame:
    """A frame that has arrived; `t_exposure_s` is the middle of its exposure or, if it is
    interlaced, the time midway between its two fields."""

    t_arrival_s: float
    t_exposure_s: float
    image: Picture
    index: int  # index of the exposure: gaps are lost frames


class SimCamera:
    """A camera that exposes at `camera_rate_hz` with a random phase. The same seed gives the same
    bytes.

    Each exposure draws the same random numbers whether or not it is lost, and a
    frame's noise depends on its index, so neither faults nor the steps of
    `advance` change any other frame.

    - lost: with `camera_drop_rate`, and `camera_burst` = (start, n): the n
      exposures from start on; these are not rendered;
    - late: a frame arrives after `camera_latency_s` plus normal jitter (sigma `camera_jitter_s`,
      clipped to +-2.5 sigma), but never before the end of its exposure or before an earlier frame;
    - frozen: exposures from `camera_freeze_at_s` on repeat the last image before that time.
    """

    def __init__(self, scenario: Scenario, renderer: Renderer) -> None:
        self.scenario = scenario
        self.renderer = renderer
        self._T_body_cam = np.array(scenario.T_body_cam_true, np.float64)
        self._rng = np.random.default_rng([scenario.seed, SCHEDULE_STREAM])
        self._shutter = Shutter(scenario)
        self._half_s = self._shutter.half_frame_s
        self._first_s = self._half_s + float(self._rng.random()) / scenario.camera_rate_hz
        self._index = 0
        self._burst_left = scenario.camera_burst[1] if scenario.camera_burst else 0
        self._last_arrival_s = -np.inf
        self._last: Picture | None = None
        self._t_s = -np.inf
        self._under_way: deque[DeliveredFrame] = deque()
        rng = np.random.default_rng([scenario.seed, LIGHT_STREAM])
        self._first_output_s = float(rng.random()) / (scenario.camera_receiver_hz or 1.0)
        self._outputs = 0
        self._newest: DeliveredFrame | None = None  # an image that the receiver repeats

    def advance(self, t_s: float, pose_at: PoseAt) -> None:
        """Make all exposures that end at or before `t_s`.

        `pose_at`, the body's pose, is called with times within the exposures that ended since the
        last call.
        """
        self._t_s = t_s
        while True:
            middle_s = self._first_s + self._index / self.scenario.camera_rate_hz
            if middle_s + self._half_s > t_s + 1e-9:
                return
            self._expose(middle_s, pose_at)
            self._index += 1

    def take(self) -> list[DeliveredFrame]:
        """Return the frames that arrived by the time of the last `advance`, oldest first, each
        once."""
        arrived = []
        while self._under_way and self._under_way[0].t_arrival_s <= self._t_s:
            arrived.append(self._under_way.popleft())
        rate_hz = self.scenario.camera_receiver_hz
        if rate_hz is None:
            return arrived
        given_out = []
        while self._outputs <= math.floor((self._t_s - self._first_output_s) * rate_hz):
            at_s = self._first_output_s + self._outputs / rate_hz
            while arrived and arrived[0].t_arrival_s <= at_s:
                self._newest = arrived.pop(0)
            if self._newest is not None:
                given_out.append(replace(self._newest, t_arrival_s=at_s))
            self._outputs += 1
        if arrived:
            self._newest = arrived[-1]
        return given_out

    def take_newest(self, count: int) -> list[DeliveredFrame]:
        """Remove the arrived frames, but return only the newest `count` exposures. If a receiver
        repeats an exposure, its first and its last copy are returned."""
        frames = self.take()
        last = sorted({frame.index for frame in frames})[-count:]
        ends = [[frame for frame in frames if frame.index == index] for index in last]
        return [frame for same in ends for frame in same[:: max(1, len(same) - 1)]]

    def _expose(self, middle_s: float, pose_at: PoseAt) -> None:
        s = self.scenario
        dropped = float(self._rng.random()) < s.camera_drop_rate
        jitter = max(-JITTER_LIMIT_SIGMAS, min(JITTER_LIMIT_SIGMAS, float(self._rng.normal())))
        if s.camera_burst is not None and middle_s >= s.camera_burst[0] and self._burst_left > 0:
            self._burst_left -= 1
            dropped = True
        delay_s = max(s.camera_latency_s + jitter * s.camera_jitter_s, self._half_s)
        arrival_s = max(middle_s + delay_s, self._last_arrival_s)
        if dropped:
            return
        self._last_arrival_s = arrival_s
        frozen = s.camera_freeze_at_s is not None and middle_s >= s.camera_freeze_at_s
        if self._last is None or not frozen:

            def T_world_cam_at(t_s: float) -> Array:
                return np.asarray(pose_at(t_s) @ self._T_body_cam)

            height = self.renderer.camera.size_px[1]
            shots = self._shutter.shots(middle_s, T_world_cam_at, height)
            self._last = self.renderer.expose(shots, frame_index=self._index)
            if s.camera_mirrored:
                self._last = np.ascontiguousarray(self._last[:, ::-1])
        self._under_way.append(DeliveredFrame(arrival_s, middle_s, self._last, self._index))


# --- When each row of a frame is exposed and in what light ---
# A rolling shutter exposes its rows one after another within the read-out time. An interlaced
# camera takes two images per frame, half a period apart, each with its own rows.


POSES_PER_EXPOSURE = 3
READOUT_MOMENTS = 5
"""Number of moments in a read-out between which the camera's motion is assumed to be linear; they
are 5 ms apart for a read-out of 20 ms."""
FLICKER_HZ = 100.0  # flicker of lamps on 50 Hz mains
PUMPING_HZ = (0.4, 2.0)
"""Range of rates at which the automatic exposure may oscillate, Hz."""


class Shutter:
    """Times, camera poses and brightness of a frame's rows; the same seed gives the same light.

    `half_frame_s`: half the time from the first light on the frame to the last.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._s = scenario
        half_exposure_s = max(scenario.camera_exposure_s, 0.0) / 2.0
        self._steps_s = (0.0,)  # times within one row's exposure, from its middle
        if half_exposure_s:
            steps_s = np.linspace(-half_exposure_s, half_exposure_s, POSES_PER_EXPOSURE)
            self._steps_s = tuple(steps_s.tolist())
        self._apart_s = 0.0
        if scenario.camera_fields != "progressive":
            self._apart_s = 0.5 / scenario.camera_rate_hz
        self.half_frame_s = half_exposure_s + scenario.camera_readout_s / 2.0 + self._apart_s / 2.0
        rng = np.random.default_rng([scenario.seed, LIGHT_STREAM])
        self._lamp_phase, self._hunt_phase = rng.uniform(0.0, 2.0 * math.pi, size=2)
        self._hunt_hz = float(rng.uniform(*PUMPING_HZ))
        # An exposure averages over the lamp's flicker.
        swing = float(np.sinc(FLICKER_HZ * 2.0 * half_exposure_s))
        self._flicker = scenario.camera_flicker * swing

    def shots(self, middle_s: float, T_world_cam_at: PoseAt, height: int) -> list[Exposure]:
        """Return the exposures of a frame `height` px high in time order: two fields, or one
        frame."""
        half_s = self._apart_s / 2.0
        moments = (middle_s - half_s, middle_s + half_s) if half_s else (middle_s,)
        return [self._shot(moment_s, T_world_cam_at, height) for moment_s in moments]

    def _shot(self, middle_s: float, T_world_cam_at: PoseAt, height: int) -> Exposure:
        readout_s = self._s.camera_readout_s
        delays_s = [0.0]
        if readout_s:
            delays_s = np.linspace(-readout_s / 2.0, readout_s / 2.0, READOUT_MOMENTS).tolist()
        rows = tuple(
            tuple(T_world_cam_at(middle_s + delay_s + step_s) for step_s in self._steps_s)
            for delay_s in delays_s
        )
        row_times = middle_s + readout_s * (np.arange(height) / (height - 1) - 0.5)
        return Exposure(rows, self._light(row_times))

    def _light(self, t_s: Array) -> Array | None:
        s = self._s
        if not (s.camera_flicker or s.camera_pumping):
            return None
        lamp = np.cos(2.0 * math.pi * FLICKER_HZ * t_s + self._lamp_phase)
        hunt = np.sin(2.0 * math.pi * self._hunt_hz * t_s + self._hunt_phase)
        return np.asarray((1.0 + self._flicker * lamp) * (1.0 + s.camera_pumping * hunt))
