"""A source whose pictures arrive mirrored, turned right again (`camera.mirrored`); what to do
about a target that is seen mirrored all the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from perchctl.camera.source import FrameSource, WrappedSource
from perchctl.profile import CameraConfig
from perchctl.vision import Frame

MIRRORED_TEXT = "the picture is mirrored"


def mirrored_note(config: CameraConfig) -> str:
    """`MIRRORED_TEXT`, a colon, and what to do about it with this profile."""
    if config.mirrored:
        advice = "the camera does not mirror, so take camera.mirrored out of the profile"
        return f"{MIRRORED_TEXT}: {advice}"
    return f"{MIRRORED_TEXT}: switch that off in the camera, or set camera.mirrored in the profile"


def unmirror_frame(frame: Frame) -> Frame:
    """The frame flipped left to right; it is no longer the JPEG that came."""
    return replace(frame, image=np.ascontiguousarray(frame.image[:, ::-1]), encoded=None)


def mirrored_as_profiled(source: FrameSource, config: CameraConfig) -> FrameSource:
    """The source, with each picture turned right if `camera.mirrored` is set."""
    return UnmirroredSource(source) if config.mirrored else source


class UnmirroredSource(WrappedSource):
    """Flips each picture left to right."""

    def poll(self, now_s: float) -> Frame | None:
        frame = super().poll(now_s)
        return None if frame is None else unmirror_frame(frame)

    def describe(self) -> str:
        return f"{super().describe()}, mirrored"
