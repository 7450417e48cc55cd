"""The folder of a fleet's flight, read again: ``fleet.json`` and the logs that it names."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perchctl.errors import InvalidValue
from perchctl.fleet.outcome import RECORD_NAME, vehicle_line


@dataclass(frozen=True, kw_only=True)
class FleetFolder:
    """A fleet's flight, as its record has it.

    Attributes:
        logs: the logs that exist, by the vehicle's name, in the order of the record.
        lines: how each vehicle ended, by its name; also of those without a log.
    """

    record: dict[str, Any]
    logs: dict[str, Path]
    lines: dict[str, str]


def read_fleet_folder(folder: Path) -> FleetFolder | None:
    """The fleet's flight in this folder; None without a ``fleet.json``.

    Raises InvalidValue if that is no record of a fleet.
    """
    path = folder / RECORD_NAME
    if not path.is_file():
        return None
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        logs, lines = {}, {}
        for vehicle in record["vehicles"]:
            name = str(vehicle["name"])
            lines[name] = vehicle_line(
                name, vehicle["hangs"], vehicle["outcome"], vehicle["miss_m"], vehicle["reason"]
            )
            # Its name only: a folder may have been moved.
            log = None if vehicle["log"] is None else folder / Path(vehicle["log"]).name
            if log is not None and log.is_file():
                logs[name] = log
    except (OSError, ValueError, TypeError, LookupError) as error:
        why = f"{type(error).__name__}: {error}"
        raise InvalidValue(f"{path} is not the record of a fleet's flight ({why})") from None
    return FleetFolder(record=record, logs=logs, lines=lines)
