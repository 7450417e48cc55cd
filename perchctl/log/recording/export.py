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
from perchctl.log.place import LAYOUT_SUFFIX, SUFFIX, recording_path
from perchctl.log.read import FlightLog
from perchctl.log.recording import messages as m
from perchctl.log.recording.container import DiskStream
from perchctl.log.recording.messages import FRAME, IMAGE
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


# --- A layout for Foxglove that shows a flight: space, picture, phases, errors, battery, events


_SPACE, _PICTURE, _EVENTS = "3D!space", "Image!picture", "RosOut!events"
_PHASES, _ERROR, _HEIGHT = "StateTransitions!phases", "Plot!error", "Plot!height"
_BATTERY = "Plot!battery"
_COLOURS = ("#d62728", "#2ca02c", "#1f77b4")

Part = str | dict[str, Any]


def layout() -> dict[str, Any]:
    """As Foxglove exports and imports them: the panels' settings, and how they divide the
    window. It is the same for every flight."""
    told = _column(_PHASES, _column(_ERROR, _column(_HEIGHT, _BATTERY, 60), 40), 15)
    return {
        "configById": {
            _SPACE: _space(),
            _PICTURE: _picture(),
            _PHASES: {
                "paths": [{"value": f"{m.TICK}.phase", "timestampMethod": "receiveTime"}],
                "isSynced": True,
            },
            _ERROR: _plot("the target against the gear, m", "ex_m", "ey_m", "ez_m"),
            _HEIGHT: _plot("height, where it is sent, and the target, m", "z_m", "cmd_z_m", "tz_m"),
            _BATTERY: _plot("battery, V", "battery_v"),
            _EVENTS: {"topicToRender": m.LOG, "minLogLevel": 1, "searchTerms": []},
        },
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _row(_column(_row(_SPACE, _PICTURE, 55), _EVENTS, 75), told, 62),
    }


def _space() -> dict[str, Any]:
    shown = {"visible": True}
    return {
        "followMode": "follow-none",
        "followTf": m.WORLD,
        "cameraState": {
            "perspective": True,
            "distance": 4.0,
            "phi": 65.0,
            "thetaOffset": 35.0,
            "target": [0.0, 0.0, 0.0],
            "targetOffset": [0.0, 0.0, 1.0],
            "targetOrientation": [0.0, 0.0, 0.0, 1.0],
            "fovy": 45,
            "near": 0.01,
            "far": 100,
        },
        "scene": {"transforms": {"showLabel": True, "axisScale": 0.2, "labelSize": 0.1}},
        "layers": {
            "grid": {
                "visible": True,
                "layerId": "foxglove.Grid",
                "instanceId": "grid",
                "label": "floor",
                "size": 6,
                "divisions": 12,
                "frameId": m.WORLD,
            }
        },
        "topics": {
            m.SCENE: shown,
            m.PATH: {**shown, "type": "line", "lineWidth": 0.01},
            m.TARGET_POSE: {**shown, "type": "axis", "axisScale": 0.1},
            m.SETPOINT: {**shown, "type": "axis", "axisScale": 0.1},
            m.CALIBRATION: {**shown, "distance": 0.3},
        },
    }


def _picture() -> dict[str, Any]:
    return {
        "imageMode": {
            "imageTopic": m.IMAGE,
            "calibrationTopic": m.CALIBRATION,
            "annotations": {m.CORNERS: {"visible": True}},
        },
        "topics": {m.SCENE: {"visible": False}},
    }


def _plot(title: str, *keys: str) -> dict[str, Any]:
    return {
        "title": title,
        "paths": [
            {
                "value": f"{m.TICK}.{key}",
                "label": key,
                "color": colour,
                "enabled": True,
                "timestampMethod": "receiveTime",
            }
            for key, colour in zip(keys, _COLOURS, strict=False)
        ],
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
    }


def _row(first: Part, second: Part, percentage: float) -> dict[str, Any]:
    return _split("row", first, second, percentage)


def _column(first: Part, second: Part, percentage: float) -> dict[str, Any]:
    return _split("column", first, second, percentage)


def _split(direction: str, first: Part, second: Part, percentage: float) -> dict[str, Any]:
    return {
        "direction": direction,
        "first": first,
        "second": second,
        "splitPercentage": percentage,
    }
