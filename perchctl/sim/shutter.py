"""When each row of a frame is exposed and in what light, and how two fields make one; pure.

A rolling shutter exposes its rows one after the other within the read-out time; an
interlaced camera takes two pictures a frame, half the frame's period apart, each with its
own rows. `SimCamera` turns a frame's middle moment into `Shot`s, the renderer into pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from perchctl.geometry import Array
from perchctl.sim.scenario import Scenario
from perchctl.sim.surfaces import Picture

LIGHT_STREAM = 412

POSES_PER_EXPOSURE = 3
READOUT_MOMENTS = 5
"""Between them the camera's motion counts as straight: 5 ms for a read-out of 20 ms."""
FLICKER_HZ = 100.0  # of lamps on a 50 Hz mains
PUMPING_HZ = (0.4, 2.0)
"""From and to which the automatic exposure may hunt."""


@dataclass(frozen=True, eq=False)
class Shot:
    """One field, or a whole frame.

    Attributes:
        rows: camera poses T_world_cam (4, 4) over the exposure, at equal steps from its
            beginning to its end; of rows at equal distances from the first to the last.
            A single entry: all rows at once.
        light: factor of each row's brightness (height,); None for an even 1.
    """

    rows: tuple[tuple[Array, ...], ...]
    light: Array | None = None

    @property
    def middle(self) -> tuple[Array, ...]:
        """The middle row's exposure."""
        return self.rows[len(self.rows) // 2]


class Shutter:
    """The scenario's shutter; same seed, same light."""

    def __init__(self, scenario: Scenario) -> None:
        self._s = scenario
        exposure_s = max(scenario.camera_exposure_s, 0.0)
        self._half_exposure_s = exposure_s / 2.0
        self._steps_s = (0.0,)  # of one row's exposure, from its middle
        if self._half_exposure_s:
            ends_s = -self._half_exposure_s, self._half_exposure_s
            self._steps_s = tuple(np.linspace(*ends_s, POSES_PER_EXPOSURE).tolist())
        self._apart_s = 0.0
        if scenario.camera_fields != "progressive":
            self._apart_s = 0.5 / scenario.camera_rate_hz
        self.half_s = self._half_exposure_s + scenario.camera_readout_s / 2.0 + self._apart_s / 2.0
        """Half the time from the first light on the frame to the last."""
        rng = np.random.default_rng([scenario.seed, LIGHT_STREAM])
        self._lamp_phase, self._hunt_phase = rng.uniform(0.0, 2.0 * math.pi, size=2)
        self._hunt_hz = float(rng.uniform(*PUMPING_HZ))
        # An exposure averages over the lamp's swing.
        self._flicker = scenario.camera_flicker * float(np.sinc(FLICKER_HZ * exposure_s))

    @property
    def plain(self) -> bool:
        """All rows at once in an even light."""
        s = self._s
        return not (self._apart_s or s.camera_readout_s or s.camera_flicker or s.camera_pumping)

    def shots(
        self, middle_s: float, T_world_cam_at: Callable[[float], Array], height: int
    ) -> list[Shot]:
        """The frame's pictures in their order of time: two fields, or one."""
        if not self._apart_s:
            return [self._shot(middle_s, T_world_cam_at, height)]
        half_s = self._apart_s / 2.0
        return [self._shot(middle_s + d, T_world_cam_at, height) for d in (-half_s, half_s)]

    def exposure_times(self, middle_s: float) -> list[float]:
        """Moments of one row's exposure."""
        return [middle_s + step_s for step_s in self._steps_s]

    def _shot(self, middle_s: float, T_world_cam_at: Callable[[float], Array], height: int) -> Shot:
        readout_s = self._s.camera_readout_s
        moments = [middle_s]
        if readout_s:
            delays = np.linspace(-readout_s / 2.0, readout_s / 2.0, READOUT_MOMENTS)
            moments = [middle_s + float(d) for d in delays]
        rows = tuple(tuple(T_world_cam_at(t) for t in self.exposure_times(m)) for m in moments)
        row_times = middle_s + readout_s * (np.arange(height) / (height - 1) - 0.5)
        return Shot(rows, self._light(row_times))

    def _light(self, t_s: Array) -> Array | None:
        s = self._s
        if not (s.camera_flicker or s.camera_pumping):
            return None
        lamp = np.cos(2.0 * math.pi * FLICKER_HZ * t_s + self._lamp_phase)
        hunt = np.sin(2.0 * math.pi * self._hunt_hz * t_s + self._hunt_phase)
        return np.asarray((1.0 + self._flicker * lamp) * (1.0 + s.camera_pumping * hunt))


def woven(pictures: Sequence[Picture], top_first: bool) -> Picture:
    """The frame of two fields in their order of time; a single picture is the frame."""
    if len(pictures) == 1:
        return pictures[0]
    top, bottom = pictures if top_first else (pictures[1], pictures[0])
    frame = top.copy()
    frame[1::2] = bottom[1::2]
    return frame


def blended(frame: Picture) -> Picture:
    """What a converter makes of a woven frame that averages its fields: each row with the
    mean of its neighbours, which are of the other field."""
    rows = np.pad(frame, ((1, 1), (0, 0)), mode="edge").astype(np.uint16)
    return np.asarray((rows[:-2] + 2 * rows[1:-1] + rows[2:] + 2) // 4, np.uint8)
