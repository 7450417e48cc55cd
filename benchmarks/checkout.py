"""Any checkout's perchctl, measuring pictures that this one has rendered.

An older perchctl has no renderer for what a newer one can see through, so pictures and the
pipeline that looks at them live in two processes: `Checkout` sends pictures to a child in which
`perchctl` is the other checkout's. The child needs of it `Profile`, `make_camera_only_profile`,
`make_pipeline`, `step` and, where there is one, `pictures`; keys of the profile that it does not
know are left out.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]
Camera = tuple[tuple[int, int], Any, Any]
"""Size, K and distortion: plain values, as they pass between the two."""


@dataclass(frozen=True)
class Stream:
    """Frames (t_s, picture) of one camera, for a fresh pipeline of a profile with `keys`:
    section -> key -> value."""

    frames: list[tuple[float, Picture]]
    keys: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True)
class Seen:
    """What the last picture of a stream gave: its time, the markers, and the surest pose's
    (x, y, z, yaw) in the camera with its covariance; None without a pose."""

    t_s: float
    markers: tuple[str, ...]
    e: Any | None
    cov: Any | None


class Checkout:
    """A child with that checkout's perchctl (this one's if None); ends with the `with`."""

    def __init__(self, root: Path | None, camera: Camera) -> None:
        self.root = (root or Path(__file__).resolve().parents[1]).resolve()
        self._child = subprocess.Popen(
            [sys.executable, __file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"PYTHONPATH": str(self.root)},
        )
        self._send(camera)
        where = Path(self._receive())
        if self.root not in where.parents:
            raise SystemExit(f"{self.root}: no checkout of perchctl there (found {where})")

    def __enter__(self) -> Checkout:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._child.stdin is not None
        self._child.stdin.close()
        self._child.wait()

    def look(self, stream: Stream) -> Seen:
        # Only plain values: the child's classes are those of its own `__main__`.
        self._send((stream.frames, stream.keys))
        return Seen(*self._receive())

    def _send(self, value: Any) -> None:
        assert self._child.stdin is not None
        pickle.dump(value, self._child.stdin)
        self._child.stdin.flush()

    def _receive(self) -> Any:
        assert self._child.stdout is not None
        return pickle.load(self._child.stdout)


# --- the child ---------------------------------------------------------------------


def _pipeline(keys: dict[str, dict[str, Any]], camera: Any) -> Any:
    from perchctl.profile import Profile
    from perchctl.vision import make_camera_only_profile, make_pipeline

    sections = {}
    for name, values in keys.items():
        known = type(getattr(Profile(), name)).model_fields
        sections[name] = {key: value for key, value in values.items() if key in known}
    profile = Profile.model_validate(sections)
    bare = make_camera_only_profile(profile).model_copy(update={"pose": profile.pose})
    return make_pipeline(bare, camera)


def _seen(frames: list[tuple[float, Picture]], pipeline: Any) -> tuple[Any, ...]:
    from perchctl.vision import Frame, PipelineState
    from perchctl.vision import pipeline as room

    state, output, t_s = PipelineState(), None, 0.0
    # Older ones keep what they know of the fields beside the state.
    fields = room.FieldState() if hasattr(room, "FieldState") else None
    deinterlace = getattr(room, "deinterlace", None) or room.pictures  # its former name
    for index, (at_s, image) in enumerate(frames):
        parts = (Frame(index, at_s, image),)
        if fields is None:
            state, parts = deinterlace(state, parts[0], pipeline)
        else:
            fields, parts = deinterlace(fields, parts[0], pipeline)
        for part in parts:
            state, output = room.step(state, part, None, pipeline)
            t_s = part.t_s
    assert output is not None
    found = output.detections
    markers = tuple(name for name in ("large", "small") if getattr(found, name) is not None)
    pose = next((output.poses[n] for n in ("joint", "large", "small") if n in output.poses), None)
    if pose is None:
        return t_s, markers, None, None
    cov = getattr(pose, "level_frame_xyz_yaw_cov", None)
    cov = pose.xyz_yaw_cov if cov is None else cov  # its former name
    return t_s, markers, np.append(pose.e_m, pose.e_yaw_rad), cov


def _serve() -> None:
    import cv2

    import perchctl
    from perchctl.vision import CameraModel

    cv2.setNumThreads(1)
    requests, answers = sys.stdin.buffer, sys.stdout.buffer
    camera = CameraModel(*pickle.load(requests))
    pickle.dump(str(perchctl.__file__), answers)
    answers.flush()
    pipelines: dict[str, Any] = {}
    while True:
        try:
            frames, keys = pickle.load(requests)
        except EOFError:
            return
        name = repr(keys)
        if name not in pipelines:
            pipelines[name] = _pipeline(keys, camera)
        pickle.dump(_seen(frames, pipelines[name]), answers)
        answers.flush()


if __name__ == "__main__":
    _serve()
