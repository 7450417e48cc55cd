"""The whole plan of a fleet's flight, made and checked before anything connects or arms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from perchctl.corridor import Corridor
from perchctl.fleet.fleet import Fleet
from perchctl.fleet.radio import DongleLoad, budget_radio
from perchctl.fleet.schedule import (
    OBSTACLE_M,
    SEPARATION_M,
    START_SEPARATION_M,
    Schedule,
    make_schedule,
    vehicle_corridor,
)


@dataclass(frozen=True, kw_only=True)
class FleetPlan:
    """The plan for a fleet that can be flown: `fleet` with telemetry periods that its dongles can
    carry, the corridor of each vehicle in room axes, and the schedule.

    Attributes:
        separation_m: minimum distance between the edges of two corridors that are flown at the same
            time.
    """

    fleet: Fleet
    corridors: Mapping[str, Corridor]
    schedule: Schedule
    dongles: tuple[DongleLoad, ...]
    separation_m: float

    def record(self) -> dict[str, Any]:
        """The plan in JSON types."""
        vehicles = []
        for vehicle in self.fleet.vehicles:
            corridor = self.corridors[vehicle.name]
            vehicles.append(
                {
                    "name": vehicle.name,
                    "uri": vehicle.uri,
                    "source": vehicle.source,
                    "frame": vehicle.frame,
                    "home_m": list(vehicle.home_m),
                    "target_m": list(vehicle.target_m),
                    "target_from": vehicle.target_from or vehicle.name,
                    "heading_deg": vehicle.heading_deg,
                    "radius_m": round(corridor.radius_m, 3),
                    "way_top_m": corridor.way_top_m,
                    "target_top_m": corridor.target_top_m,
                    "telemetry_period_s": vehicle.profile.link.telemetry_period_s,
                    "group": self.group_number(vehicle.name),
                }
            )
        schedule = self.schedule
        return {
            "fleet": self.fleet.name,
            "order": self.fleet.order,
            "on_failure": self.fleet.on_failure,
            "separation_m": self.separation_m,
            "start_separation_m": START_SEPARATION_M,
            "obstacle_m": OBSTACLE_M,
            "vehicles": vehicles,
            "groups": [list(group) for group in schedule.groups],
            "conflicts": [
                {"vehicles": [c.first, c.second], "why": c.why} for c in schedule.conflicts
            ],
            "precedences": [
                {"first": p.first, "then": p.then, "why": p.why} for p in schedule.precedences
            ],
            "dongles": [
                {
                    "dongle": load.dongle,
                    "channel": load.channel,
                    "vehicles": list(load.vehicles),
                    "carries_per_s": round(load.carries_per_s, 1),
                    "needs_per_s": round(load.needs_per_s, 1),
                }
                for load in self.dongles
            ],
        }

    @property
    def reassigned(self) -> tuple[str, ...]:
        """A sentence for each vehicle that ``assign: nearest`` has given another target than the
        file."""
        return tuple(
            f"{v.name} flies to the target of {v.target_from}, {v.target_m[0]:g} {v.target_m[1]:g}"
            for v in self.fleet.vehicles
            if v.target_from
        )

    def group_number(self, name: str) -> int:
        """The number of the group in which the vehicle flies, from 1."""
        return next(n for n, group in enumerate(self.schedule.groups, 1) if name in group)


def make_plan(fleet: Fleet) -> FleetPlan:
    """Return the plan for a fleet's flight. If the fleet cannot be flown, raise InvalidValue with
    one sentence that names the vehicles or the dongle."""
    budgeted, dongles = budget_radio(fleet)
    return FleetPlan(
        fleet=budgeted,
        corridors={vehicle.name: vehicle_corridor(vehicle) for vehicle in budgeted.vehicles},
        schedule=make_schedule(budgeted),
        dongles=dongles,
        separation_m=SEPARATION_M if fleet.separation_m is None else fleet.separation_m,
    )
