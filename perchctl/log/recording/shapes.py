"""The recording's own messages, for which Foxglove has no schema: JSON, and what is in it."""

from __future__ import annotations

from typing import Any

from perchctl.log.fields import FIELDS
from perchctl.log.recording.messages import FRAME, SENT, TICK

_TEXTS = ("phase", "stage", "reason", "hold", "pos_note", "lock_note", "cmd")
_FLAGS = ("measured", "tracked")
_LISTS = ("large_px", "small_px")
LOOP_TIMES = ("t_s", "frame_t_s")
"""Of a tick's record: in the recording they count from the first flown turn."""

FRAME_FIELDS = {
    "number": ("integer", "number of the frame, as the message's sequence number and the log's"),
    "t_s": ("number", "exposure on the loop's clock, as the source gave it"),
    "t_arrival_s": ("number", "arrival on the loop's clock"),
    "repeated": ("boolean", "the source gave out the picture before once more: it is not kept"),
    "crc32": ("integer", "of the grey pixels that the pipeline saw"),
}


def _tick_property(key: str, meaning: str) -> dict[str, Any]:
    if key in _TEXTS:
        return {"type": "string", "description": meaning}
    if key in _FLAGS:
        return {"type": "boolean", "description": meaning}
    if key in _LISTS:
        return {"type": "array", "items": {"type": "number"}, "description": meaning}
    return {"type": "number", "description": meaning}


def _commands(key: str) -> bool:
    return key == "cmd" or key.startswith("cmd_")


SCHEMAS: dict[str, tuple[str, dict[str, Any]]] = {
    TICK: (
        "perchctl.Tick",
        {
            "type": "object",
            "title": "One turn of the flight loop, as the flight log has it",
            "properties": {key: _tick_property(key, text) for key, text in FIELDS.items()},
        },
    ),
    SENT: (
        "perchctl.Sent",
        {
            "type": "object",
            "title": "What was sent to the vehicle in the flight loop's place",
            "properties": {
                "t_s": _tick_property("t_s", FIELDS["t_s"]),
                "by": {"type": "string", "description": "watchdog, rescue, reconnect or farewell"},
                **{key: _tick_property(key, FIELDS[key]) for key in FIELDS if _commands(key)},
            },
        },
    ),
    FRAME: (
        "perchctl.Frame",
        {
            "type": "object",
            "title": "A frame that the camera gave",
            "properties": {
                key: {"type": kind, "description": text}
                for key, (kind, text) in FRAME_FIELDS.items()
            },
        },
    ),
}
"""By topic: name and JSON schema."""
