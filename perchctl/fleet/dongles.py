"""Which Crazyradio carries which vehicle: the URI's first part, read and filled in."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from perchctl.fleet.fleet import FleetVehicle

ANY = "radio:///"
"""Beginning of a URI on whichever dongle is there, as Bitcraze's cfcli and Swarmkeeper write it
(bitcraze/cfcli, docs/swarm.md)."""
_RADIO = "radio://"


@dataclass(frozen=True)
class RadioPlace:
    """Where a vehicle is on the air. `dongle`: number or serial number of the Crazyradio; empty:
    any. `rate`: ``250K``, ``1M`` or ``2M``."""

    dongle: str
    channel: int
    rate: str


def radio_place(vehicle: FleetVehicle) -> RadioPlace | None:
    """The vehicle's dongle, channel and rate; None without a radio (sim, USB, UDP, own link)."""
    if not vehicle.uri.startswith(_RADIO):
        return None
    _, channel, rate, _ = vehicle.address.split("/")
    dongle = vehicle.uri.removeprefix(_RADIO).partition("?")[0].partition("/")[0]
    return RadioPlace(
        str(int(dongle)) if len(dongle) < 10 and dongle else dongle.upper(), int(channel), rate
    )


def choose_dongles(vehicles: Sequence[FleetVehicle]) -> Iterable[FleetVehicle]:
    """The vehicles, each ``radio:///`` with a dongle.

    Vehicles on one channel share a dongle, since two dongles on a channel disturb each other. A
    channel on which no other vehicle names a dongle gets the next number that nobody has named.
    """
    places = [radio_place(vehicle) for vehicle in vehicles]
    named = {p.channel: p.dongle for p in reversed(places) if p is not None and p.dongle}
    used = set(named.values())
    free = (str(number) for number in itertools.count() if str(number) not in used)
    for vehicle, place in zip(vehicles, places, strict=True):
        if place is None or place.dongle:
            yield vehicle
            continue
        if place.channel not in named:
            named[place.channel] = next(free)
        uri = vehicle.uri.replace(ANY, f"{_RADIO}{named[place.channel]}/", 1)
        link = vehicle.profile.link.model_copy(update={"uri": uri})
        yield replace(vehicle, profile=vehicle.profile.model_copy(update={"link": link}))
