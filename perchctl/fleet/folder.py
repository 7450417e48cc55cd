"""Read the folder of a fleet's flight: ``fleet.json`` and the logs that it names."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from perchctl.corridor import Point
from perchctl.errors import InvalidValue
from perchctl.fleet.outcome import RECORD_NAME, vehicle_line
from perchctl.record import path_beside, read_log, recorded_pictures, wrap_log_errors

if TYPE_CHECKING:
    from perchctl.analysis import FilmedVehicle, FlightAnalysis


@dataclass(frozen=True, kw_only=True)
class FleetFolder:
    """A fleet's flight, as recorded in ``fleet.json``.

    Attributes:
        logs: the logs that exist, keyed by vehicle name, in the order of ``fleet.json``.
        lines: how each vehicle's flight ended, keyed by vehicle name, including vehicles without a
            log.
    """

    record: dict[str, Any]
    logs: dict[str, Path]
    lines: dict[str, str]

    def filmed(self) -> list[FilmedVehicle]:
        """Return each vehicle that has a log, for `perchctl.analysis.write_fleet_film`. Raises the
        errors of reading a log, and InvalidValue if ``fleet.json`` does not contain the plan."""
        from perchctl.analysis import FlightAnalysis

        flights = {}
        for name, log in self.logs.items():
            with wrap_log_errors(log):
                flights[name] = FlightAnalysis(read_log(log))
        try:
            plans = {str(plan["name"]): plan for plan in self.record["plan"]["vehicles"]}
            ends = {str(end["name"]): end for end in self.record["vehicles"]}
            return [_filmed(name, each, plans[name], ends[name]) for name, each in flights.items()]
        except (TypeError, ValueError, LookupError, AttributeError) as error:
            why = f"{type(error).__name__}: {error}"
            raise InvalidValue(
                f"{RECORD_NAME} does not record where each vehicle flew ({why}): make the film "
                "from a single log instead"
            ) from None


def _filmed(
    name: str, flight: FlightAnalysis, plan: Mapping[str, Any], end: Mapping[str, Any]
) -> FilmedVehicle:
    from perchctl.analysis import FilmedVehicle  # loads matplotlib, which a report does not need

    log = Path(flight.log.path)
    pace = (end.get("pace") or {}).get("ratio") or 1.0
    lasts_s = flight.log.end_s / pace
    # A simulated vehicle's estimate has its origin where the vehicle starts, even with motion
    # capture.
    is_simulated = str(plan["uri"]).startswith("sim://")
    return FilmedVehicle(
        name=name,
        flight=flight,
        pictures=recorded_pictures(log) if path_beside(log, ".mcap").is_file() else None,
        begin_s=(end.get("ended_s") or lasts_s) - lasts_s,
        pace=pace,
        home_m=_point(plan["home_m"]),
        target_m=_point(plan["target_m"]),
        radius_m=float(plan["radius_m"]),
        heading_rad=math.radians(plan["heading_deg"]),
        in_room=plan["frame"] == "room" and not is_simulated,
    )


def _point(values: Sequence[float]) -> Point:
    x_m, y_m = values
    return float(x_m), float(y_m)


def read_fleet_folder(folder: Path) -> FleetFolder | None:
    """Return the fleet's flight in this folder; None if there is no ``fleet.json``.

    Raises InvalidValue if that file is not the record of a fleet's flight.
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
            # Use only the file name, because the folder may have been moved.
            log = None if vehicle["log"] is None else folder / Path(vehicle["log"]).name
            if log is not None and log.is_file():
                logs[name] = log
    except (OSError, ValueError, TypeError, LookupError) as error:
        why = f"{type(error).__name__}: {error}"
        raise InvalidValue(f"{path} is not the record of a fleet's flight ({why})") from None
    return FleetFolder(record=record, logs=logs, lines=lines)
