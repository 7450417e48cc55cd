"""Prepare the options for each vehicle's process and, before any process starts, refuse a flight
that is not possible."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from perchctl.check import warnings_before_flight
from perchctl.errors import InvalidValue, PerchError
from perchctl.fleet.fleet import vehicle_seed
from perchctl.fleet.plan import FleetPlan
from perchctl.fleet.schedule import flown_profile
from perchctl.flight import FlyOptions, check_options
from perchctl.link import RadioHub


def make_folder(parent: Path, plan: FleetPlan, started: datetime) -> Path:
    """Return the path of a new folder for one fleet flight: ``fleet_<UTC
    yyyymmdd_hhmmss>_<fleet>``. The folder is created with the first log."""
    stem = f"fleet_{started.astimezone(UTC):%Y%m%d_%H%M%S}_{plan.fleet.name}"
    path, number = parent / stem, 1
    while path.exists():
        number += 1
        path = parent / f"{stem}_{number}"
    return path


IDLE_PER_S = 10
"""Packets per second for a vehicle whose flight has ended, the lowest limit that a hub allows.
Larger: less radio time is left for the vehicles that are still flying. A smaller limit is not
possible."""


class Radios:
    """The radio hubs for the dongles that several vehicles share, keyed by dongle.

    The vehicles' own processes detect by themselves that their hub or dongle has failed; `problems`
    is for display.
    """

    def __init__(self, hubs: Mapping[str, RadioHub]) -> None:
        self._hubs = hubs

    def route(self, options: Mapping[str, FlyOptions]) -> dict[str, FlyOptions]:
        """Return the options for each flight, changed to use a hub if there is one. `uri` remains
        the vehicle's own URI, which identifies its log, its lock and its lift comparison with the
        motion-capture system."""
        ways = {uri: way for hub in self._hubs.values() for uri, way in hub.uris.items()}
        return {name: replace(each, link_uri=ways.get(each.uri)) for name, each in options.items()}

    def slow_down(self, uri: str) -> None:
        """Once a vehicle's flight has ended, give its radio time to the vehicles that are still
        flying."""
        for hub in self._hubs.values():
            if uri in hub.uris:
                hub.limit(uri, IDLE_PER_S)

    def problems(self) -> dict[str, str]:
        """Return the reasons why dongles have failed, keyed by dongle. Never waits."""
        found = {}
        for dongle, hub in self._hubs.items():
            reported = (report.problem for report in hub.reports.values())
            problem = hub.update() or next(filter(None, reported), None)
            if problem is not None:
                found[dongle] = problem
        return found


@contextlib.contextmanager
def open_radios(plan: FleetPlan) -> Iterator[Radios]:
    """Open a radio hub for each dongle that several vehicles share, until the block ends. A vehicle
    alone on its dongle needs none.

    Raises the errors of `RadioHub`, with the dongle's name. If an error is raised, no packet was
    sent to any vehicle.
    """
    with contextlib.ExitStack() as stack:
        hubs = {}
        for load in plan.dongles:
            if len(load.vehicles) > 1:
                uris = [plan.fleet.vehicle(name).uri for name in load.vehicles]
                with naming(f"dongle {load.dongle}"):
                    hubs[load.dongle] = stack.enter_context(RadioHub(uris))
        yield Radios(hubs)


def flight_options(
    plan: FleetPlan, folder: Path, seed: int, record: bool | None
) -> dict[str, FlyOptions]:
    """Return the options for each vehicle's flight, with its corridor as a safety row (a row in the
    transition table), after the same checks as in `perchctl fly`. Raises the errors of
    `check_options`, with the vehicle's name.

    `record`: keep the images; None: keep those of real vehicles only.
    """
    options = {}
    for number, vehicle in enumerate(plan.fleet.vehicles):
        flown = vehicle.as_flown
        each = FlyOptions(
            profile=flown_profile(vehicle, flown),
            profile_path=plan.fleet.path or Path(vehicle.name),
            uri=vehicle.uri,
            source=flown.source,
            seed=vehicle_seed(seed, number),
            log_dir=folder,
            record=not flown.simulated if record is None else record,
            sim_target_xy_m=flown.to_estimate(flown.target_m) if flown.simulated else None,
        )
        with naming(vehicle.name):
            check_options(each)
            if each.profile.planner.hover is not None:
                raise InvalidValue("planner.hover is set, but a fleet perches: remove it")
        options[vehicle.name] = each
    return options


def warnings_before_fleet(options: Mapping[str, FlyOptions]) -> list[str]:
    """The warnings from the offline checks, each with the names of the vehicles that it concerns.
    Raises, with the vehicle's name, the errors of `warnings_before_flight`, and an error if the
    lift comparison with the motion-capture system is missing."""
    names: dict[str, list[str]] = {}
    for name, each in options.items():
        with naming(name):
            # The flight's folder does not exist yet, so the folder that will contain it is checked.
            found = warnings_before_flight(replace(each, log_dir=each.log_dir.parent))
            each.require_lift_check()
        for warning in found:
            names.setdefault(warning, []).append(name)
    return [f"{', '.join(who)}: {warning}" for warning, who in names.items()]


@contextlib.contextmanager
def naming(name: str) -> Iterator[None]:
    """Prefix each error raised in the block with the name of the vehicle or dongle."""
    try:
        yield
    except PerchError as error:
        raise type(error)(f"{name}: {error}") from None
