"""A source whose pictures arrive mirrored, turned right again (`camera.mirrored`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.camera.source import SourceAround
from perchctl.vision.types import Frame

MIRRORED = (
    "the picture is mirrored: switch that off in the camera, or set camera.mirrored in the profile"
)


class UnmirroredSource(SourceAround):
    """Flips each picture left to right."""

    def poll(self, now_s: float) -> Frame | None:
        frame = super().poll(now_s)
        if frame is None:
            return None
        return replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), encoded=None)

    def describe(self) -> str:
        return f"{super().describe()}, mirrored"
