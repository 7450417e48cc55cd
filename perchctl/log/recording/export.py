"""An MCAP file of a flight log, with the pictures of its recording where that lies beside it."""

from __future__ import annotations

import contextlib
import heapq
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from perchctl.calibration import profile_camera
from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.files import PartFile, cannot_be_written, check_output, check_place, write_files
from perchctl.log.read import FlightLog
from perchctl.log.recording.container import DiskStream
from perchctl.log.recording.layout import layout
from perchctl.log.recording.messages import FRAME, IMAGE
from perchctl.log.recording.place import LAYOUT_SUFFIX, SUFFIX, recording_path
from perchctl.log.recording.walk import Walked, walk
from perchctl.log.recording.writing import Writing
from perchctl.log.sent import sent_values
from perchctl.log.setup import flown_camera, flown_profile
from perchctl.profile import Profile
from perchctl.vision import CameraModel

Kind = Literal["event", "sent", "tick", "frame"]


@dataclass(frozen=True)
class Exported:
    """What was written: the file, the layout beside it, how many pictures are in it, and what
    is missing, a sentence each."""

    path: Path
    layout: Path
    pictures: int
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Frame:
    """A frame of the recording; `picture` as it lies there, with its format."""

    told: dict[str, Any]
    picture: tuple[bytes, str] | None


def exported(log: FlightLog, out_path: Path, overwrite: bool) -> Exported:
    """As `perchctl.log.recording.export_mcap`."""
    check_output(out_path, (SUFFIX,), overwrite)
    layout_path = out_path.with_suffix(LAYOUT_SUFFIX)
    check_place(layout_path, overwrite)
    notes: list[str] = []
    profile, camera = _setup(log, notes)
    part = PartFile(out_path)
    try:
        writing = Writing(DiskStream(part.part), log.header, profile, camera)
        for _, kind, what in heapq.merge(_told(log), _frames(log, notes), key=lambda each: each[0]):
            if kind == "tick":
                writing.tick(what)
            elif kind == "event":
                writing.event(what)
            elif kind == "sent":
                writing.sent(what)
            else:
                writing.frame(what.told, what.picture)
        writing.finish()
        part.keep()
    except OSError as error:
        raise cannot_be_written(out_path, error) from None
    finally:
        part.drop()
    write_files({layout_path: json.dumps(layout(), indent=1).encode()})
    return Exported(out_path, layout_path, writing.pictures, tuple(notes))


def _setup(log: FlightLog, notes: list[str]) -> tuple[Profile | None, CameraModel | None]:
    """The profile and the calibration that were flown, as far as they are known."""
    try:
        profile = flown_profile(log.header)
    except InvalidValue as error:
        notes.append(f"without the camera's mounting, the vehicle and the target: {error}")
        return None, None
    with contextlib.suppress(PerchError):
        return profile, flown_camera(log.header) or profile_camera(profile.camera)
    notes.append(
        f"without the camera's calibration: the log does not hold it, and "
        f"{profile.camera.calibration} is not here"
    )
    return profile, None


def _told(log: FlightLog) -> Iterator[tuple[float, Kind, Any]]:
    """Events, what was sent in the loop's place and ticks by time; an event comes before the tick
    in which it was."""
    events = ((float(event["t_s"]), "event", event) for event in log.events)
    ticks = ((float(tick["t_s"]), "tick", tick) for tick in log.records)
    by_time = sorted(log.sent, key=lambda each: each.t_s)
    sent = ((each.t_s, "sent", sent_values(each)) for each in by_time)
    yield from heapq.merge(events, sent, ticks, key=lambda each: each[0])  # type: ignore[misc]


def _frames(log: FlightLog, notes: list[str]) -> Iterator[tuple[float, Kind, _Frame]]:
    """The recording's, in its order; none where there is no recording."""
    image: Walked | None = None
    try:
        for each in walk(recording_path(log.path), (IMAGE, FRAME)):
            if each.topic == IMAGE:
                image = each
                continue
            told = json.loads(each.data)
            picture = None
            if image is not None and image.sequence == each.sequence:
                message = CompressedImage.FromString(image.data)
                picture = (message.data, message.format)
            image = None
            yield float(told["t_arrival_s"]), "frame", _Frame(told, picture)
    except NotFound:
        notes.append("without pictures: the flight was not recorded, or that file is not here")
    except InvalidValue as error:
        notes.append(f"without pictures: {error}")
