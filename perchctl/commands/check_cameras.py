"""`perchctl check --cameras`: what this computer's cameras are called, and what they can."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

from perchctl.camera import CameraControl, ConnectedCamera, find_cameras
from perchctl.errors import NotFound

NONE = "this computer has no camera: plug in the receiver or camera (Linux lists /dev/videoN)"


def list_cameras(as_json: bool, known: Sequence[ConnectedCamera] | None = None) -> int:
    """Print them; returns the exit code. Nothing is set, and no picture taken. `known` takes the
    place of this computer's. Errors: NotFound where there are none."""
    known = find_cameras(asked=True) if known is None else known
    if not known:
        raise NotFound(NONE)
    if as_json:
        print(json.dumps([camera_record(camera) for camera in known]))
    else:
        print("\n".join(line for camera in known for line in camera_lines(camera)))
    return 0


def camera_record(camera: ConnectedCamera) -> dict[str, Any]:
    """For JSON."""
    return {
        "source": camera.source,
        "name": camera.name,
        "path": f"/dev/video{camera.number}",
        "stable_path": camera.stable_path or None,
        "modes": [
            {"format": m.format, "size_px": m.size_px, "rates_hz": m.rates_hz} for m in camera.modes
        ],
        "controls": [_control_record(*each) for each in camera.controls],
        "problem": camera.problem or None,
    }


def _control_record(control: CameraControl, value: int | None) -> dict[str, Any]:
    record: dict[str, Any] = {
        "name": control.name, "kind": control.kind, "value": value, "default": control.default,
        "min": control.low, "max": control.high, "step": control.step,
        "inactive": control.inactive,
    }  # fmt: skip
    if control.menu:
        record["menu"] = {str(index): text for index, text in control.menu}
    return record


def camera_lines(camera: ConnectedCamera) -> list[str]:
    """For people."""
    lines = [f"{camera.source}  {camera.name or '(no name)'}"]
    if camera.stable_path:
        lines.append(f"  {camera.stable_path}")
    if camera.problem:
        lines.append(f"  {camera.problem}; close other programs that use it, or get the right to")
    for mode in camera.modes:
        size = "any size" if mode.size_px is None else "{}x{}".format(*mode.size_px)
        rates = f" at {', '.join(f'{hz:g}' for hz in mode.rates_hz)} Hz" if mode.rates_hz else ""
        lines.append(f"  {mode.format:<5}{size}{rates}")
    for control, value in camera.controls:
        now = "?" if value is None else str(value)
        held = ", held by an automatic one" if control.inactive else ""
        lines.append(f"  {control.name} = {now}  ({_allowed(control)}{held})")
    return lines


def _allowed(control: CameraControl) -> str:
    if control.menu:
        return ", ".join(f"{index}: {text}" for index, text in control.menu)
    if control.kind == "boolean":
        return "0 or 1"
    step = f" in steps of {control.step}" if control.step > 1 else ""
    return f"{control.low} to {control.high}{step}"
