"""Keys that profiles and logs of earlier versions hold: read under their present names."""

from __future__ import annotations

import copy
from typing import Any

from pydantic import BaseModel

RENAMED: dict[str, str] = {
    "camera.T_body_cam": "mount",
    "planner.trim_per_s": "integral_per_s",
    "planner.trim_limit_m": "integral_limit_m",
}
"""Dotted path -> the key's present name, in the same section."""
UNUSED: tuple[str, ...] = (
    "merge.z1_m",
    "planner.recover.speed_mps",
    "planner.takeoff_duration_s",
    "simulation.bare_floor_aside_m",
    "simulation.bare_floor_m",
    "simulation.draught_towards_deg",
    "simulation.drift_xyz_mps",
    "simulation.estimate_tilt_bias_xy_deg",
    "simulation.gloss",
    "simulation.gust_every_s",
    "simulation.gust_mps",
    "simulation.lamp_aside_m",
    "simulation.lamp_z_m",
    "simulation.mount_error_rpy_deg",
    "simulation.mount_error_xyz_m",
    "simulation.target_tilt_towards_deg",
    "simulation.target_xy_m",
)
"""Nothing depends on them any more: left out."""
WORLD = "simulation.set"
"""It named the profile `rough` or `extreme` for the keys that were not written."""


def with_present_keys(
    values: dict[str, Any], model: type[BaseModel]
) -> tuple[dict[str, Any], list[str], list[str]]:
    """The values of a profile under their present keys; a note for each old one; and a sentence
    for each whose value would be lost.

    A key that has become a constant of its section (a class variable of `model`, or of a model
    within it) is left out. It is lost where it has another value than the constant.

    Raises ValueError where a key stands under both of its names.
    """
    notes: list[str] = []
    result = copy.deepcopy(values)
    for dotted, new in RENAMED.items():
        section, old = _section_of(result, dotted)
        if section is None or old not in section:
            continue
        if new in section:
            raise ValueError(f"{dotted} is the old name of {new}, which is given too: keep one")
        section[new] = section.pop(old)
        notes.append(f"{dotted} was read as {new}, its present name: rename it")
    for dotted in UNUSED:
        section, old = _section_of(result, dotted)
        if section is not None and section.pop(old, None) is not None:
            notes.append(f"{dotted} is no longer used: remove it")
    lost: list[str] = []
    section, old = _section_of(result, WORLD)
    world = None if section is None else section.pop(old, None)
    if world == "nominal":
        notes.append(f"{WORLD} is no longer used: remove it")
    elif world is not None:
        lost.append(f"{WORLD} is no longer a key: remove it, and extend the profile {world}")
    for dotted, value, constant in _without_constants(result, model):
        now = f"{dotted} is no longer a key: it is {constant} for every profile"
        if _plain(value) == _plain(constant):
            notes.append(f"{now}; remove it")
        else:
            lost.append(f"{now}, and {value} here; remove it")
    return result, notes, lost


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _without_constants(
    values: dict[str, Any], model: type[BaseModel], path: str = ""
) -> list[tuple[str, Any, Any]]:
    """Removes the keys that are constants from the values; returns each with its value and the
    constant."""
    removed: list[tuple[str, Any, Any]] = []
    for key in list(values):
        field, value = model.model_fields.get(key), values[key]
        kind = field.annotation if field is not None else None
        if key in model.__class_vars__:
            removed.append((f"{path}{key}", values.pop(key), getattr(model, key)))
        elif isinstance(value, dict) and isinstance(kind, type) and issubclass(kind, BaseModel):
            removed += _without_constants(value, kind, f"{path}{key}.")
    return removed


def _section_of(values: dict[str, Any], dotted: str) -> tuple[dict[str, Any] | None, str]:
    *names, key = dotted.split(".")
    section: Any = values
    for name in names:
        section = section.get(name) if isinstance(section, dict) else None
    return (section if isinstance(section, dict) else None), key
