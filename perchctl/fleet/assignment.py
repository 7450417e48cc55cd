"""Which vehicle flies to which target where the targets are interchangeable."""

from __future__ import annotations

from dataclasses import replace

from perchctl.fleet.fleet import Fleet


def assign_nearest(fleet: Fleet) -> Fleet:
    """The fleet with its targets handed out so that the sum of squared distances from home to
    target is least.

    By squared distances, straight ways between starts and goals do not meet when starts and goals
    lie 2.83 radii apart (CAPT: Turpin, Michael and Kumar, 2014). Of equal sums, scipy's choice
    counts, which is the same each time. A target's markers go with it.
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
            vehicle.with_target(other.target_m, other.profile.target)
            for vehicle, other in zip(vehicles, targets, strict=True)
        ),
    )
