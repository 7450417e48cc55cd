"""Convert lists of Crazyflies from other programs to fleet files.

Two formats are read: Crazyswarm2's ``crazyflies.yaml`` (IMRCLab/crazyswarm2, crazyflie/config), and
the swarm files of Bitcraze's cfcli and Swarmkeeper (bitcraze/cfcli, docs/swarm.md). Neither format
contains targets or cameras, and cfcli's format contains no positions. `missing` says what you have
to add to each vehicle before perchctl accepts the file; `missing_defaults` says what to add to the
defaults before the fleet can fly.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.plain_yaml import clip_text, value_text
from perchctl.profile import read_yaml, yaml_scalar

_CAPTURE = (
    "# Name your motion-capture system and its host in defaults. Each vehicle needs its own",
    "# rigid body there: Crazyswarm2 also works with single markers, but perchctl does not.",
)
_A_URI = "radio://0/80/2M/E7E7E7E7E7"


@dataclass(frozen=True, kw_only=True)
class ConvertedVehicle:
    """A vehicle in another program's list: its name, its URI, and anything else that the list says
    about it."""

    name: str
    uri: str
    home_m: tuple[float, float] | None = None
    body: str | None = None


@dataclass(frozen=True, kw_only=True)
class ConvertedFleet:
    """A list of vehicles from another program. `skipped`: the vehicles that are disabled in the
    list. `in_room_axes`: True if, according to the list, a Lighthouse measures the positions."""

    name: str
    vehicles: tuple[ConvertedVehicle, ...]
    skipped: tuple[str, ...] = ()
    in_room_axes: bool = False

    @property
    def is_captured(self) -> bool:
        """True if a motion-capture system measures the positions."""
        return any(vehicle.body is not None for vehicle in self.vehicles)

    @property
    def missing_defaults(self) -> tuple[str, ...]:
        """Return the keys that the fleet's defaults need but the list does not contain."""
        return ("positioning.system", "positioning.host") if self.is_captured else ()

    @property
    def missing(self) -> tuple[str, ...]:
        """Return the keys that each vehicle needs but the list does not contain."""
        homes = any(vehicle.home_m is None for vehicle in self.vehicles)
        return (*(("home_m",) if homes else ()), "target_m", "source")

    def text(self) -> str:
        """Return the text of the fleet file."""
        mocap = self.is_captured
        frame = ", frame: room" if self.in_room_axes and not mocap else ""
        positioning = ", positioning: {by: mocap}" if mocap else ""
        lines = [
            "# Made by perchctl fleet convert. Add the missing keys to each vehicle:",
            f"# {', '.join(self.missing)}; then run perchctl fleet check on this file.",
            *(_CAPTURE if mocap else ()),
            f"name: {yaml_scalar(self.name)}",
            f"defaults: {{profile: crazyflie{frame}{positioning}}}",
            "order: one-at-a-time",
            "on_failure: continue",
            "vehicles:",
        ]
        for vehicle in self.vehicles:
            body = f", body: {yaml_scalar(vehicle.body)}" if vehicle.body is not None else ""
            home = f", home_m: {list(vehicle.home_m)}" if vehicle.home_m is not None else ""
            lines.append(
                f"  - {{name: {yaml_scalar(vehicle.name)}, uri: {json.dumps(vehicle.uri)}{body}"
                f"{home}}}"
            )
        return "\n".join([*lines, ""])


def convert_fleet(path: Path) -> ConvertedFleet:
    """Read the vehicles in a file of Crazyswarm2, cfcli or Swarmkeeper.

    Errors: NotFound, InvalidValue.
    """
    values = read_yaml(path, "a fleet file")
    robots, units = values.get("robots"), values.get("units")
    if isinstance(robots, dict):
        found = _from_crazyswarm2(path, robots, values.get("robot_types"))
    elif isinstance(units, list):
        found = _from_cfcli(path, units, values)
    else:
        raise InvalidValue(
            f"{path}: has neither robots, like Crazyswarm2's crazyflies.yaml, nor a list of "
            f"units, like a swarm file from cfcli or Swarmkeeper"
        )
    if not found.vehicles:
        raise InvalidValue(f"{path}: no vehicle in this file is switched on")
    names = [vehicle.name.lower() for vehicle in found.vehicles]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise InvalidValue(f"{path}: two vehicles would be called {twice}: rename one")
    return found


def _from_crazyswarm2(path: Path, robots: Mapping[Any, Any], types: Any) -> ConvertedFleet:
    vehicles, skipped = list[ConvertedVehicle](), list[str]()
    for name, robot in robots.items():
        where = f"{path}: robots.{clip_text(str(name))}"
        entry = _mapping(where, robot)
        if entry.get("enabled") is not True:
            skipped.append(str(name))
            continue
        type_name = entry.get("type")
        is_named = isinstance(types, dict) and isinstance(type_name, str | int)
        kind = types.get(type_name) if is_named else None
        capture = kind.get("motion_capture") if isinstance(kind, dict) else None
        # `enabled` up to version 2 of the file, `tracking` from version 3 on.
        tracked = isinstance(capture, dict) and (
            capture.get("enabled") is True or capture.get("tracking") is not None
        )
        vehicles.append(
            ConvertedVehicle(
                name=_file_name(str(name)),
                uri=_uri(where, entry),
                home_m=_place(f"{where}.initial_position", entry.get("initial_position")),
                body=str(name) if tracked else None,  # Crazyswarm2 uses the same name for the body
            )
        )
    return ConvertedFleet(name=path.stem, vehicles=tuple(vehicles), skipped=tuple(skipped))


def _from_cfcli(path: Path, units: Sequence[Any], values: Mapping[str, Any]) -> ConvertedFleet:
    vehicles = []
    for number, unit in enumerate(units, 1):
        where = f"{path}: units, number {number}"
        entry = _mapping(where, unit)
        if entry.get("name") is not None:
            where += f" ({clip_text(str(entry['name']))})"
        vehicles.append(
            ConvertedVehicle(
                name=_file_name(_text(entry.get("name"), f"CF-{number:02d}")),
                uri=_uri(where, entry),
            )
        )
    return ConvertedFleet(
        name=_text(values.get("name"), path.stem),
        vehicles=tuple(vehicles),
        in_room_axes=values.get("lighthouse") is not None,
    )


def _mapping(where: str, value: Any) -> Mapping[str, Any]:
    if not isinstance(value, dict):
        raise InvalidValue(f"{where}: must have keys and values, found {value_text(value)}")
    return value


def _uri(where: str, entry: Mapping[str, Any]) -> str:
    uri = entry.get("uri")
    if uri is None:
        raise InvalidValue(f"{where}: uri: is missing; add the vehicle's URI, as in {_A_URI}")
    if not isinstance(uri, str):
        raise InvalidValue(f"{where}: uri: must be text, as in {_A_URI}, found {value_text(uri)}")
    return uri


def _place(where: str, value: Any) -> tuple[float, float] | None:
    """Return x and y of a position x, y, z; None if no position is given."""
    if value is None:
        return None
    numbers = value if isinstance(value, list) else []
    if len(numbers) < 2 or not all(_is_number(number) for number in numbers[:2]):
        raise InvalidValue(f"{where}: must be x, y and z in metres, found {value_text(value)}")
    return float(numbers[0]), float(numbers[1])


def _is_number(value: Any) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # raised for an integer that is too large for a float
        return False


def _text(value: Any, default: str) -> str:
    return default if value is None else str(value)


def _file_name(name: str) -> str:
    """Convert the name to a form that a fleet file allows."""
    fit = re.sub(r"[^A-Za-z0-9_.-]+", "-", name).strip("-_.")[:32]
    return fit or "vehicle"
