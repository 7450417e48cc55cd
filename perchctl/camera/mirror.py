"""A source whose pictures arrive mirrored, turned right again (`camera.mirrored`); what to do
about a target that is seen mirrored all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.camera.source import FrameSource, SourceAround
from perchctl.profile import CameraConfig
from perchctl.vision.types import Frame

MIRRORED = "the picture is mirrored"


def mirrored_note(config: CameraConfig) -> str:
    """`MIRRORED`, a colon, and what to do about it with this profile."""
    if config.mirrored:
        return f"{MIRRORED}: the camera does not mirror, so take camera.mirrored out of the profile"
    return f"{MIRRORED}: switch that off in the camera, or set camera.mirrored in the profile"


def unmirrored(frame: Frame) -> Frame:
    """The frame flipped left to right; it is no longer the JPEG that came."""
    return replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), encoded=None)


def as_profiled(source: FrameSource, config: CameraConfig) -> FrameSource:
    """The source, with each picture turned right if `camera.mirrored` is set."""
    return UnmirroredSource(source) if config.mirrored else source


class UnmirroredSource(SourceAround):
    """Flips each picture left to right."""

    def poll(self, now_s: float) -> Frame | None:
        frame = super().poll(now_s)
        return None if frame is None else unmirrored(frame)

    def describe(self) -> str:
        return f"{super().describe()}, mirrored"
