"""Latency and mounting as a flight showed them, also where its log has no end."""

from __future__ import annotations

from pydantic import ValidationError

from perchctl.log import FlightLog, summarise_flight
from perchctl.mission import Findings, flight_findings
from perchctl.profile import CameraConfig
from perchctl.vision import Consistency

WORKED_OUT = (
    "delay_s",
    "delay_sigma_s",
    *(f"turn_{axis}{part}_rad" for axis in "xyz" for part in ("", "_sigma")),
)


def findings_in(log: FlightLog) -> Findings | None:
    """The summary's; else what the last ticks had worked out. None where neither is there."""
    if log.summary is not None:
        return summarise_flight(log).findings
    newest = next(
        (r for r in reversed(log.records) if all(r.get(k) is not None for k in WORKED_OUT)), None
    )
    profile = log.header.get("profile")
    if newest is None or not isinstance(profile, dict):
        return None
    try:
        camera = CameraConfig.model_validate(profile.get("camera"))
    except ValidationError:  # of an older perchctl
        return None
    seen = Consistency(
        delay_s=newest["delay_s"],
        delay_sigma_s=newest["delay_sigma_s"],
        turn_rad=tuple(newest[f"turn_{axis}_rad"] for axis in "xyz"),
        turn_sigma_rad=tuple(newest[f"turn_{axis}_sigma_rad"] for axis in "xyz"),
    )
    return flight_findings(seen, camera)
