"""An MCAP file of a flight log, with the pictures of its recording where that lies beside it."""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from perchctl.calibration import profile_camera
from perchctl.errors import InvalidValue, NotFound, PerchError
from perchctl.files import cannot_be_written, check_output, check_place, whole_file, write_files
from perchctl.profile import Profile
from perchctl.record.disk import DiskFile
from perchctl.record.read import FlightLog, read_log
from perchctl.record.recorded import recorded_frames
from perchctl.record.recording_file import RecordingFile
from perchctl.record.write import LAYOUT_SUFFIX, RECORDING_SUFFIX, recording_path
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


def export_mcap(
    log: FlightLog | Path | str, out_path: Path | str, overwrite: bool = False
) -> Exported:
    """Write a flight log as an MCAP file, with the pictures of the recording that lies beside it,
    and beside the file a layout for Foxglove: space, picture, phases, errors, battery, events.

    Args:
        log: its path, or one that is read already.
        overwrite: what is there already may be replaced, the recording itself among it.

    Errors: those of `perchctl.record.read.read_log`; InvalidValue for a place that cannot be
    written to.
    """
    log, out_path = log if isinstance(log, FlightLog) else read_log(log), Path(out_path)
    check_output(out_path, (RECORDING_SUFFIX,), overwrite)
    layout_path = out_path.with_suffix(LAYOUT_SUFFIX)
    check_place(layout_path, overwrite)
    notes: list[str] = []
    profile, camera = _setup(log, notes)
    try:
        with whole_file(out_path) as part:
            file = RecordingFile(DiskFile.new(part), log.header, profile, camera)
            for _, kind, what in heapq.merge(_records(log), _frames(log, notes), key=_time_of):
                match kind:
                    case "tick":
                        file.tick(what)
                    case "event":
                        file.event(what)
                    case "sent":
                        file.sent(what)
                    case "frame":
                        file.frame(*what)
            file.finish()
    except OSError as error:
        raise cannot_be_written(out_path, error) from None
    write_files({layout_path: files("perchctl.record").joinpath("foxglove.json").read_bytes()})
    return Exported(out_path, layout_path, file.pictures, tuple(notes))


def _setup(log: FlightLog, notes: list[str]) -> tuple[Profile | None, CameraModel | None]:
    """The profile and the calibration that were flown, as far as they are known."""
    try:
        profile = log.flown_profile
    except InvalidValue as error:
        notes.append(f"without the camera's mounting, the vehicle and the target: {error}")
        return None, None
    with contextlib.suppress(PerchError):
        return profile, log.flown_camera or profile_camera(profile.camera)
    notes.append(
        f"without the camera's calibration: the log does not hold it, and "
        f"{profile.camera.calibration} is not here"
    )
    return profile, None


def _records(log: FlightLog) -> Iterator[tuple[float, Kind, Any]]:
    """Events, what was sent in the loop's place and ticks by time; an event comes before the tick
    in which it was."""
    found: list[tuple[float, Kind, Any]] = [
        *((float(event["t_s"]), "event", event) for event in log.events),
        *((sent["t_s"], "sent", sent) for sent in log.sent_values),
        *((float(tick["t_s"]), "tick", tick) for tick in log.records),
    ]
    return iter(sorted(found, key=_time_of))


def _frames(log: FlightLog, notes: list[str]) -> Iterator[tuple[float, Kind, Any]]:
    """The recording's, in its order; none where there is no recording."""
    try:
        for frame, message in recorded_frames(recording_path(log.path)):
            picture = None if message is None else (message.data, message.format)
            yield float(frame["t_arrival_s"]), "frame", (frame, picture)
    except NotFound:
        notes.append("without pictures: the flight was not recorded, or that file is not here")
    except InvalidValue as error:
        notes.append(f"without pictures: {error}")


def _time_of(timed: tuple[float, Kind, Any]) -> float:
    return timed[0]
