"""A layout for Foxglove that shows a flight: space, picture, phases, errors, battery, events."""

from __future__ import annotations

from typing import Any

from perchctl.log.recording import messages as m

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
