"""A frame source around the simulated camera's that spoils its pictures."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import cv2
import numpy as np

from perchctl.camera import FrameSource
from perchctl.faults.effects import CameraFault
from perchctl.vision import Frame

SNOW_STREAM = 512
SNOW_SIGMA = 60.0
DARK_GAIN = 0.06
SHEET_SIGMA = 6.0
"""The camera's own noise."""
LOST = 0.2


class FaultyCamera:
    """The inner source's frames until a fault begins; after its time again."""

    finished = False

    def __init__(self, inner: FrameSource, seed: int) -> None:
        self._inner = inner
        self._rng = np.random.default_rng([seed, SNOW_STREAM])
        self._fault: CameraFault | None = None
        self._begin_s = 0.0
        self._last: Frame | None = None
        self._queue: deque[Frame] = deque()
        self._overtaken: Frame | None = None
        self.late_s = 0.0  # until a fault begins, and known to the profile

    def begin(self, fault: CameraFault, now_s: float) -> None:
        self._fault, self._begin_s = fault, now_s
        self.late_s = 0.0
        self._queue.clear()

    @property
    def live(self) -> bool:
        return self._inner.live

    @property
    def size_px(self) -> tuple[int, int] | None:
        return self._inner.size_px

    def poll(self, now_s: float) -> Frame | None:
        frame = self._inner.poll(now_s)
        if self.late_s:
            frame = self._late(frame, self.late_s, now_s)
        fault = self._fault
        if fault is None or not self._begin_s <= now_s < self._begin_s + fault.for_s:
            self._last = frame or self._last
            return frame
        return self._spoilt(fault, frame, now_s)

    def problem(self, now_s: float) -> str | None:
        return self._inner.problem(now_s)

    def describe(self) -> str:
        return self._inner.describe()

    def close(self) -> None:
        self._inner.close()

    def _spoilt(self, fault: CameraFault, frame: Frame | None, now_s: float) -> Frame | None:
        if fault.kind == "late":
            return self._late(frame, fault.late_s, now_s)
        if fault.kind == "out-of-order":
            return self._swapped(frame)
        if frame is None or fault.kind == "silent":
            return None
        if fault.kind == "lossy" and self._rng.random() < LOST:
            return None
        match fault.kind:
            case "frozen":
                return replace(frame, image=(self._last or frame).image, encoded=None)
            case "snow":
                noise = self._rng.normal(120.0, SNOW_SIGMA, frame.image.shape)
                return replace(frame, image=np.clip(noise, 0, 255).astype(np.uint8), encoded=None)
            case "covered":  # by a sheet of the ceiling's grey, under the target
                sheet = self._rng.normal(frame.image.mean(), SHEET_SIGMA, frame.image.shape)
                return replace(frame, image=np.clip(sheet, 0, 255).astype(np.uint8), encoded=None)
            case "dark":
                dark = cv2.convertScaleAbs(frame.image, alpha=DARK_GAIN)
                return replace(frame, image=np.asarray(dark, np.uint8), encoded=None)
            case "mirrored":
                return replace(
                    frame, image=np.ascontiguousarray(frame.image[:, ::-1]), encoded=None
                )
        return frame

    def _late(self, frame: Frame | None, late_s: float, now_s: float) -> Frame | None:
        """Queued on its way: it looks as if it had just been taken."""
        if frame is not None:
            self._queue.append(frame)
        old = None
        while self._queue and self._queue[0].t_arrival_s + late_s <= now_s:
            old = self._queue.popleft()
        if old is None:
            return None
        return replace(old, t_s=old.t_s + late_s, t_arrival_s=old.t_arrival_s + late_s)

    def _swapped(self, frame: Frame | None) -> Frame | None:
        """Two at a time, the newer one first."""
        if self._overtaken is not None:
            older, self._overtaken = self._overtaken, None
            if frame is not None:
                self._queue.append(frame)
            return older
        if frame is None:
            return None
        if not self._queue:
            self._queue.append(frame)
            return None
        self._overtaken = self._queue.popleft()
        return frame
