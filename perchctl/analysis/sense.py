"""Replay the perception of a flight: process the recorded telemetry and images with the same code
as the flight loop.

On one thread, the same images, samples and times must give bit-identical poses. A turn is one
iteration of the flight loop.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perchctl.errors import InvalidValue, NotFound
from perchctl.flight import FlightInputs
from perchctl.mission import FrameRecord, Observation, TickInputs, TickRecord, UnfilteredPose
from perchctl.opencv_threads import one_thread
from perchctl.profile import Profile
from perchctl.vehicle import Telemetry
from perchctl.vision import Frame, Pipeline

Picture = tuple[int, float, NDArray[np.uint8]]
"""A frame's number, its time from the source, and the image that was searched."""


class PictureMissing(Exception):
    """Raised if an image that the replay needs is missing (the message says why) or, with
    `is_different`, is not the one that the flight processed."""

    is_different = False


class _PictureIsAnother(PictureMissing):
    is_different = True


@dataclass(frozen=True, eq=False)
class ReplayedInputs:
    """The replayed inputs of a turn: the markers' `poses` by name, and the recorded `observation`
    with the replayed perception in it (None for a turn without an observation)."""

    turn: TickRecord
    poses: dict[str, UnfilteredPose]
    observation: Observation | None


class _Given:
    """Stand-in for the link and the frame source, which returns the recorded data turn by turn."""

    def __init__(
        self, pictures: Iterable[Picture], size_px: tuple[int, int], delay_s: float
    ) -> None:
        self.size_px: tuple[int, int] | None = size_px
        self._later_s = delay_s
        self._pictures = _readable(pictures)
        self._name: str | None = None  # name of the flown source, set when the source ends
        self._shown: tuple[int | None, NDArray[np.uint8]] | None = None
        self._taken = TickInputs()
        self._samples: list[tuple[Telemetry, ...]] = []

    def turn(self, turn: TickRecord) -> None:
        taken, obs = turn.inputs, turn.observation
        self._taken, self._samples = taken, [taken.samples, taken.late_samples]
        if self._name is None and obs is not None and taken.has_camera_source_ended:
            self._name = _ended_name(taken, obs)

    # --- The interface of a link ---

    def telemetry(self) -> list[Telemetry]:
        return list(self._samples.pop(0))

    # --- The interface of a frame source ---

    @property
    def live(self) -> bool:
        return self._taken.is_camera_source_live

    @property
    def finished(self) -> bool:
        return self._taken.has_camera_source_ended

    def poll(self, now_s: float) -> Frame | None:
        seen = self._taken.frame
        if seen is None:
            return None
        image = self._picture_of(seen)
        t_s = seen.t_s + self._later_s if self._taken.is_camera_source_live else seen.t_s
        return Frame(seen.index, t_s, image, seen.t_arrival_s, seen.picture_kind, seen.is_repeated)

    def problem(self, now_s: float) -> str | None:
        return self._taken.camera_problem

    def describe(self) -> str:
        return self._name or "the recording"

    def close(self) -> None:
        return None

    def _picture_of(self, seen: FrameRecord) -> NDArray[np.uint8]:
        if self._taken.camera_problem is not None:  # no image was processed in this turn
            return np.zeros((1, 1), np.uint8)
        image = self._repeated_picture(seen) if seen.is_repeated else self._recorded(seen)
        self._shown = (seen.checksum, image)
        return image

    def _repeated_picture(self, seen: FrameRecord) -> NDArray[np.uint8]:
        if self._shown is None:
            raise PictureMissing(f"the picture that frame {seen.index} repeats was not recorded")
        checksum, image = self._shown
        if seen.checksum != checksum:
            image = image.copy()
            image.flat[0] ^= 1
        return image

    def _recorded(self, seen: FrameRecord) -> NDArray[np.uint8]:
        for index, t_s, image in self._pictures:
            if (index, t_s) == (seen.index, seen.t_s):
                if seen.checksum not in (None, zlib.crc32(image.tobytes())):
                    raise _PictureIsAnother(
                        f"the recorded picture of frame {seen.index} differs from the one that the "
                        "flight used"
                    )
                return image
            if index > seen.index:
                break
            # An image with a smaller index belongs to a frame that no turn used, and is skipped.
        raise PictureMissing(f"the picture of frame {seen.index} was not recorded")


def replay_inputs(
    turns: Iterable[TickRecord],
    profile: Profile,
    pipeline: Pipeline,
    pictures: Iterable[Picture],
    delay_s: float = 0.0,
) -> Iterator[ReplayedInputs]:
    """Replay perception turn by turn, starting before take-off. `delay_s` is added to the exposure
    times of a live source.

    Raises PictureMissing at the first image that is missing, differs or cannot be read, because the
    pipeline's state would differ from the flight's from then on.
    """
    given = _Given(pictures, pipeline.camera.size_px, delay_s)
    inputs = FlightInputs(given, given, pipeline, profile, is_logged=True)
    with one_thread():
        for turn in turns:
            given.turn(turn)
            taken = turn.inputs
            inputs.poll_inputs(
                turn.began_s,
                search=taken.is_detection_requested,
                sends_sights=taken.sends_sightings_as_position,
                drops_sightings=taken.has_discarded_sightings,
            )
            if turn.t_s != turn.began_s:
                inputs.catch_up(turn.began_s, turn.t_s)
            yield ReplayedInputs(turn, inputs.poses, _observed(turn, inputs))


def _ended_name(taken: TickInputs, obs: Observation) -> str | None:
    """Return the name of the flown frame source, taken from the camera problem that was reported
    when a recorded source ended, because nothing else in the log contains it. Return None if the
    problem was a different one; the replayed problem then differs from the log."""
    told = obs.camera_problem
    if told is None or taken.frame is not None or taken.camera_problem is not None:
        return None
    name = told.removesuffix(FlightInputs.ended_text(""))
    return name if told == FlightInputs.ended_text(name) else None


def _readable(pictures: Iterable[Picture]) -> Iterator[Picture]:
    """Yield the images. The sequence ends at an unreadable image without raising an error, so that
    the planner can still be replayed."""
    try:
        yield from pictures
    except (InvalidValue, NotFound) as error:
        raise PictureMissing(str(error)) from error


def _observed(turn: TickRecord, inputs: FlightInputs) -> Observation | None:
    if turn.observation is None or inputs.history.newest is None:
        return None
    seen = inputs.observation(turn.t_s)
    return replace(
        turn.observation, **{name: getattr(seen, name) for name in FlightInputs.SENSED_FIELDS}
    )
