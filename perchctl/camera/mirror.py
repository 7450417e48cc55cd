"""A source whose pictures arrive mirrored, turned right again (`camera.mirrored`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.camera.source import FrameSource
from perchctl.vision.types import Frame


class UnmirroredSource:
    """Flips each picture left to right; everything else is the source's own."""

    def __init__(self, source: FrameSource) -> None:
        self._source = source

    @property
    def live(self) -> bool:
        return self._source.live

    @property
    def finished(self) -> bool:
        return self._source.finished

    @property
    def size_px(self) -> tuple[int, int] | None:
        return self._source.size_px

    def newest(self, now_s: float) -> Frame | None:
        frame = self._source.newest(now_s)
        if frame is None:
            return None
        return replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]))

    def problem(self, now_s: float) -> str | None:
        return self._source.problem(now_s)

    def describe(self) -> str:
        return f"{self._source.describe()}, mirrored"

    def close(self) -> None:
        self._source.close()
