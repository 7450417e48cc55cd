"""A stream's pictures through the pipeline, as far as the mounting is measured by them."""

from __future__ import annotations

from perchctl.calibration.mounting.recording import SeenPose
from perchctl.calibration.mounting.seen import best_pose, camera_only_profile, is_seen_mirrored
from perchctl.camera import HealthState, assess_frame
from perchctl.geometry import Array
from perchctl.profile import Profile
from perchctl.vision import (
    MARKERS,
    CameraModel,
    FieldState,
    Frame,
    PipelineOutput,
    PipelineState,
    make_pipeline,
    pictures,
    step,
)


class Eye:
    """Frame in, poses out; remembers what the pipeline must.

    `mirrored` counts the pictures in which a target was seen mirrored only. `outlines` are
    those of the newest picture, a marker's name and corners (4, 2) px; `trouble` is what keeps
    it from being searched.
    """

    def __init__(self, profile: Profile, camera: CameraModel, live: bool) -> None:
        self._pipeline = make_pipeline(camera_only_profile(profile), camera)
        self._live = live
        self._state = PipelineState()
        self._fields = FieldState()
        self._health = HealthState()
        self.mirrored = 0
        self.outlines: tuple[tuple[str, Array], ...] = ()
        self.trouble = ""

    def look(self, frame: Frame) -> list[SeenPose]:
        """The target's pose in a frame, in each of its two fields where it has such."""
        self._health, judged = assess_frame(self._health, frame, self._live)
        if judged.kind == "repeated":
            return []
        self.outlines, self.trouble = (), ""
        if not judged.usable:
            self.trouble = judged.text
            if judged.kind in ("frozen", "snow"):
                return []
        self._fields, found = pictures(self._fields, frame, self._pipeline)
        seen = []
        for picture in found:
            self._state, output = step(self._state, picture, None, self._pipeline)
            self._remember(output)
            pose = best_pose(output, picture.t_s)
            if pose is not None:
                seen.append(pose)
        return seen

    def _remember(self, output: PipelineOutput) -> None:
        self.mirrored += is_seen_mirrored(output)
        found = ((name, output.detections.get(name)) for name in MARKERS)
        self.outlines = tuple((name, d.corners_px) for name, d in found if d is not None)
