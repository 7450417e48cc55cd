"""Who may take off, who lands, and why: the parent's whole judgement, as pure functions.

    nothing is permitted until all are ready at the same time and the operator has confirmed
    groups fly in the order of the schedule, each once all of the group before have ended
    whoever has ended in another's corridor, or nobody knows where, keeps it on the floor
    a failure before the first take-off ends all; later it ends all with ``on_failure: land-all``

The vehicles' places are those of the plan. Only one that measures its position in the room's axes
is believed to stand at its home again after a flight.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from perchctl.fleet.fleet import FleetVehicle
from perchctl.fleet.messages import Order, Result, Stage, Status
from perchctl.fleet.plan import FleetPlan
from perchctl.fleet.schedule import OBSTACLE_M
from perchctl.mission import Operator

FRESH_S = 1.0
"""A vehicle whose process has sent nothing for so long is not ready. Longer, and one that hangs
counts as ready; shorter, and a busy computer puts off the start."""


@dataclass(frozen=True, kw_only=True)
class VehicleView:
    """What the parent knows of one vehicle.

    Attributes:
        status: its newest one; None before the first.
        silent_s: since its last message.
        result: how it ended; None until then.
    """

    name: str
    status: Status | None = None
    silent_s: float = 0.0
    result: Result | None = None

    @property
    def stage(self) -> Stage:
        return Stage.STARTING if self.status is None else self.status.stage

    @property
    def is_ready(self) -> bool:
        """True if nothing but permission keeps it on the floor."""
        return self.result is None and self.stage is Stage.READY and self.silent_s < FRESH_S


@dataclass(frozen=True, kw_only=True)
class Decision:
    """An order for each vehicle, and the reason for each order that the operator did not give."""

    orders: Mapping[str, Order]
    reasons: Mapping[str, str]


def are_all_ready(views: Sequence[VehicleView]) -> bool:
    """True if all are ready now."""
    return all(view.is_ready for view in views)


def decide(
    plan: FleetPlan,
    views: Sequence[VehicleView],
    *,
    started: bool,
    word: Operator = Operator.NONE,
    landed: Collection[str] = (),
) -> Decision:
    """The orders of this moment.

    Args:
        started: all were ready, and the operator has confirmed; never taken back.
        word: the operator's, for all.
        landed: vehicles that the operator lands one by one.
    """
    ended = {view.name: view.result for view in views if view.result is not None}
    failed = next((name for name, result in ended.items() if result.exit_code != 0), None)
    group = next((g for g in plan.schedule.groups if not ended.keys() >= set(g)), ())
    orders, reasons = {}, {}
    for view in views:
        name, own = view.name, word
        if own is Operator.NONE and name in landed:
            own = Operator.LAND
        if own is Operator.NONE and failed is not None:
            if not started:
                own, reasons[name] = Operator.LAND, f"{failed} is not ready"
            elif plan.fleet.on_failure == "land-all":
                own, reasons[name] = Operator.LAND, f"{failed} has failed"
        if own is Operator.NONE and view.stage not in (Stage.FLYING, Stage.ENDING):
            obstacle = find_obstacle(plan, name, ended)
            if obstacle is not None:
                own, reasons[name] = Operator.LAND, obstacle
        permitted = started and own is Operator.NONE and name in group
        orders[name] = Order(may_take_off=permitted, word=own)
    return Decision(orders=orders, reasons=reasons)


def find_obstacle(plan: FleetPlan, name: str, ended: Mapping[str, Result]) -> str | None:
    """Why this vehicle must not take off any more: who has ended in the way of its corridor. Those
    that have ended do not move again, so it is for good."""
    corridor = plan.corridors[name]
    for other, result in ended.items():
        vehicle = plan.fleet.vehicle(other)
        if other == name:
            continue
        if result.hangs and result.outcome == "perched":
            place, where = vehicle.target_m, "hangs"
        elif is_at_home(vehicle, result):
            place, where = vehicle.home_m, "stands"
        elif not plan.schedule.may_fly_together(name, other):
            return f"{other} may be in its corridor: it has ended away from its home"
        else:
            continue
        away_m = corridor.distance_to_m(place)
        if away_m < OBSTACLE_M:
            text = f"{-away_m:.2f} m inside" if away_m < 0.0 else f"{away_m:.2f} m from"
            return f"{other} {where} {text} its corridor"
    return None


def is_at_home(vehicle: FleetVehicle, result: Result) -> bool:
    """True if a vehicle that has ended is known to stand where it took off. An estimate that begins
    at zero drifts, so it does not show it."""
    if not result.has_flown:
        return True
    if result.hangs or vehicle.frame != "room" or result.place_m is None:
        return False
    away_m = math.dist(vehicle.as_flown.to_room(result.place_m), vehicle.home_m)
    return result.outcome == "landed" and away_m <= OBSTACLE_M
