"""Fleets for tests, from places and a profile, without a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from perchctl.corridor import Point
from perchctl.fleet.fleet import Fleet, FleetVehicle
from perchctl.profile import Profile, layered_profile, load_profile
from perchctl.profile.load import find_profile

FENCE_M = 40.0


@cache
def base(by: str = "mocap") -> Profile:
    return load_profile("sim").with_(
        {"positioning.by": by, "safety.fence_radius_m": FENCE_M, "target.expected_within_m": 0.01}
        | {"target.expected_xy_m": (0.0, 0.0)}
    )


def vehicle(name: str, home_m: Point, target_m: Point, profile: Profile | None = None) -> Any:
    return FleetVehicle(
        name=name,
        profile=profile or base(),
        home_m=home_m,
        target_m=target_m,
        frame="room",
    ).with_target(target_m)


def fleet(places: Sequence[tuple[Point, Point]], by: str = "mocap", **settings: Any) -> Fleet:
    """A fleet of vehicles v0, v1, ..., each with its home and target."""
    vehicles = tuple(vehicle(f"v{n}", *ends, base(by)) for n, ends in enumerate(places))
    return Fleet(name="test", vehicles=vehicles, **settings)


def on_air(uris: Sequence[str], keys: Mapping[str, Any] | None = None) -> Fleet:
    """A fleet with these URIs; `keys`: sections of their profiles."""
    vehicles = []
    for number, uri in enumerate(uris):
        own = dict(keys or {})
        own["link"] = {**own.get("link", {}), "uri": uri}
        profile = layered_profile(find_profile("sim"), "crazyflie", own)
        place = 3.0 * number, 0.0
        vehicles.append(vehicle(f"v{number}", place, place, profile))
    return Fleet(name="air", vehicles=tuple(vehicles))


def same_channel(count: int, keys: Mapping[str, Any] | None = None) -> Fleet:
    """So many vehicles on channel 80 of dongle 0."""
    return on_air([f"radio://0/80/2M/E7E7E7E7{n:02X}" for n in range(1, count + 1)], keys)
