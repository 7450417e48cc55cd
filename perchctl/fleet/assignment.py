"""Decide which vehicle flies to which target if the targets are interchangeable."""

from __future__ import annotations

from dataclasses import replace

from perchctl.fleet.fleet import Fleet


def assign_nearest(fleet: Fleet) -> Fleet:
    """Return the fleet with its targets assigned so that the sum of the squared distances from home
    to target is minimal.

    With squared distances, straight paths between starts and goals do not meet if starts and goals
    are 2.83 radii apart (CAPT: Turpin, Michael and Kumar, 2014). If several assignments have the
    same sum, scipy chooses one of them deterministically. A target's markers are assigned with it.
    """
    from scipy.optimize import linear_sum_assignment

    vehicles = fleet.vehicles
    costs_m2 = [
        [(h.home_m[0] - t.target_m[0]) ** 2 + (h.home_m[1] - t.target_m[1]) ** 2 for t in vehicles]
        for h in vehicles
    ]
    _, chosen = linear_sum_assignment(costs_m2)
    targets = [vehicles[index] for index in chosen]
    return replace(
        fleet,
        vehicles=tuple(
            replace(
                vehicle.with_target(other.target_m, other.profile.target),
                target_from="" if other is vehicle else other.name,
            )
            for vehicle, other in zip(vehicles, targets, strict=True)
        ),
    )
