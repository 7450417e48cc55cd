"""The radio budget: what each Crazyradio can carry, and what the flights on it need.

A Crazyradio sends one packet at a time and receives one in its answer, so a vehicle can send only
as often as it is polled. cflib polls the vehicles of a dongle in turn, whether or not they have
anything to send. Before each packet, cflib sets the dongle's address, and its channel if that
differs. Each of n vehicles therefore gets an equal share, and a share is enough if it exceeds both
what the vehicle sends (telemetry) and what it receives (setpoints and positions).

The figures were measured with cflib's threads over a simulated dongle (0.7 ms per packet, 1.25 ms
per setting). The figures have not been confirmed with a real dongle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from perchctl.errors import InvalidValue
from perchctl.fleet.fleet import Fleet, FleetVehicle
from perchctl.link import LOG_STEP_S, telemetry_packets_per_s
from perchctl.profile import Profile, SafetyConfig

ANY = "radio:///"
"""Prefix of a URI for any dongle that is plugged in, as Bitcraze's cfcli and Swarmkeeper write it
(bitcraze/cfcli, docs/swarm.md)."""
RADIO = "radio://"

ALONE_PER_S = 1000.0
"""Packets per second for a vehicle that is alone on its dongle, whose address and channel never
change."""
SAME_CHANNEL_PER_S = {2: 245.0, 3: 162.0, 4: 123.0}
"""Measured packets per second for each of this many vehicles on one channel of one dongle. Too
large: telemetry arrives late in flight. Too small: fleets that could fly are refused."""
OTHER_CHANNELS_PER_S = {2: 151.0, 4: 73.0}
"""Measured packets per second for each of this many vehicles on different channels of one dongle.
Because these rates are so low, perchctl refuses such fleets."""
PACKET_S = 0.00206
"""Duration of a packet on a shared dongle, s, the longest of `SAME_CHANNEL_PER_S` (3 vehicles): 0.7
ms on the air, 1.25 ms for the address, and the rest for Python's threads. This duration is used for
larger numbers of vehicles than were measured."""
USABLE_SHARE = 0.8
"""Usable part of a vehicle's share of the packets. The rest is for lost packets, for a neighbour
that does not answer, which costs 2 ms per turn (measured), and for a busy computer. On a busy
computer, a hub over the same simulated dongle carried 207 packets per second for each of two
vehicles and 111 for each of four, 0.85 and 0.9 of the shares. Larger: telemetry arrives late; at
0.9, in one run, two simulated flights with telemetry every 10 ms were aborted. Smaller: telemetry
is slower than necessary."""
MOST_ON_A_DONGLE = 5
"""Largest number of vehicles on one dongle: users of cflib report three to five."""
LEAST_APART = 2
"""Minimum number of channels between two dongles: at 2M, a signal is 2 MHz wide, which is the width
of two channels (bitcraze/cfcli)."""
SLOWEST_PERIOD_S = SafetyConfig.proof_age_s / 2
"""Slowest telemetry period that is chosen, s. With a slower period, a single lost packet would make
the telemetry too old to prove anything."""
LEAST_RATE_HZ = 10
"""Lowest rate at which `positioning.rate_hz` allows positions to be sent, Hz."""
MEASURED_RATE = "2M"
"""Data rate to which all figures above apply; the capacity at 1M and 250K has not been measured."""


@dataclass(frozen=True)
class RadioPlace:
    """The radio settings of a vehicle. `dongle`: number or serial number of the Crazyradio; empty:
    any. `rate`: ``250K``, ``1M`` or ``2M``."""

    dongle: str
    channel: int
    rate: str


@dataclass(frozen=True, kw_only=True)
class DongleLoad:
    """One dongle with its vehicles: the packets per second that it can carry for each of them, and
    the largest number that any of them needs."""

    dongle: str
    channel: int
    vehicles: tuple[str, ...]
    carries_per_s: float
    needs_per_s: float


def radio_place(vehicle: FleetVehicle) -> RadioPlace | None:
    """Return the vehicle's dongle, channel and rate; None without a radio (sim, USB, UDP, your own
    link)."""
    if not vehicle.uri.startswith(RADIO):
        return None
    _, channel, rate, _ = vehicle.address.split("/")
    dongle = vehicle.uri.removeprefix(RADIO).partition("?")[0].partition("/")[0]
    is_number = dongle.isdecimal() and len(dongle) < 10  # a number of ten digits is a serial number
    return RadioPlace(str(int(dongle)) if is_number else dongle.upper(), int(channel), rate)


def choose_dongles(vehicles: Sequence[FleetVehicle]) -> Iterable[FleetVehicle]:
    """Return the vehicles after adding a dongle to each ``radio:///`` URI.

    Vehicles on one channel share a dongle, since two dongles on a channel disturb each other. A
    channel on which no vehicle names a dongle gets the next unused dongle number.
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
        uri = vehicle.uri.replace(ANY, f"{RADIO}{named[place.channel]}/", 1)
        yield _with_link(vehicle, uri=uri)


# --- The budget ---


def carried_per_s(vehicles: int) -> float:
    """Return the packets per second that a dongle can carry for each of this many vehicles on one
    channel."""
    if vehicles <= 1:
        return ALONE_PER_S
    return SAME_CHANNEL_PER_S.get(vehicles, 1.0 / (vehicles * PACKET_S))


def uplink_per_s(profile: Profile) -> float:
    """Return the packets per second that perchctl sends to a vehicle: a setpoint in each iteration
    of the flight loop, and positions from motion capture or from the target."""
    positioning = profile.positioning
    sent_hz = 0.0 if positioning.source.is_deck else positioning.rate_hz
    return profile.link.loop_hz + sent_hz


def needed_per_s(profile: Profile, period_s: float | None = None) -> float:
    """Return the packets per second that a flight needs at the telemetry period `period_s`, by
    default the profile's.

    Each exchange carries one packet in each direction, so the larger of the two numbers counts.
    """
    period_s = profile.link.telemetry_period_s if period_s is None else period_s
    return max(telemetry_packets_per_s(period_s), uplink_per_s(profile))


def budget_radio(fleet: Fleet) -> tuple[Fleet, tuple[DongleLoad, ...]]:
    """Return the fleet with telemetry periods that its dongles can carry, and the load of each
    dongle.

    If a profile or the fleet file contains `link.telemetry_period_s`, that value is used; otherwise
    the shortest period that fits is chosen. Raises InvalidValue, naming the dongle and what to do,
    if vehicles on one dongle use different channels or rates, if the channels of two dongles are
    too close, or if a flight needs more than its dongle can carry.
    """
    on_air: dict[str, list[tuple[FleetVehicle, RadioPlace]]] = {}
    for vehicle in fleet.vehicles:
        if (place := radio_place(vehicle)) is not None:
            on_air.setdefault(place.dongle, []).append((vehicle, place))
    _refuse_mixed(on_air)
    _refuse_near(on_air)
    chosen: dict[str, FleetVehicle] = {}
    loads = []
    for dongle, members in on_air.items():
        channel, names = members[0][1].channel, tuple(vehicle.name for vehicle, _ in members)
        for vehicle, _ in members:
            chosen[vehicle.name] = _fitted(vehicle, dongle, channel, len(members))
        loads.append(
            DongleLoad(
                dongle=dongle,
                channel=channel,
                vehicles=names,
                carries_per_s=carried_per_s(len(members)),
                needs_per_s=max(needed_per_s(chosen[name].profile) for name in names),
            )
        )
    vehicles = tuple(chosen.get(vehicle.name, vehicle) for vehicle in fleet.vehicles)
    return replace(fleet, vehicles=vehicles), tuple(loads)


def _refuse_mixed(on_air: dict[str, list[tuple[FleetVehicle, RadioPlace]]]) -> None:
    for dongle, members in on_air.items():
        (first, there), others = members[0], members[1:]
        for other, place in others:
            if place.channel != there.channel:
                raise InvalidValue(
                    f"dongle {dongle} has {first.name} on channel {there.channel} and {other.name} "
                    f"on channel {place.channel}; on two channels it carries "
                    f"{OTHER_CHANNELS_PER_S[2]:g} packets/s for each of two vehicles instead of "
                    f"{SAME_CHANNEL_PER_S[2]:g}: set both to the same channel, or move "
                    f"{other.name} to another dongle"
                )
            if MEASURED_RATE not in (there.rate, place.rate) or place.rate != there.rate:
                slow, rate = (
                    (other, place.rate) if there.rate == MEASURED_RATE else (first, there.rate)
                )
                raise InvalidValue(
                    f"dongle {dongle} is shared, but {slow.name} uses the data rate {rate}, for "
                    f"which the capacity of a shared dongle is unknown: set the rate to "
                    f"{MEASURED_RATE}"
                )


def _refuse_near(on_air: dict[str, list[tuple[FleetVehicle, RadioPlace]]]) -> None:
    channels = [(dongle, members[0][1].channel) for dongle, members in on_air.items()]
    for (one, low), (other, high) in itertools.combinations(sorted(channels, key=_channel), 2):
        if high - low < LEAST_APART:
            where = f"channel {low}" if low == high else f"channels {low} and {high}"
            raise InvalidValue(
                f"dongles {one} and {other} interfere on {where}: put vehicles that use the same "
                f"channel on one dongle, or set channels that are at least {LEAST_APART} apart"
            )


def _channel(item: tuple[str, int]) -> int:
    return item[1]


def _fitted(vehicle: FleetVehicle, dongle: str, channel: int, shared_by: int) -> FleetVehicle:
    """The vehicle with a telemetry period that fits. Raises InvalidValue if no period fits."""
    profile, usable = vehicle.profile, USABLE_SHARE * carried_per_s(shared_by)
    periods_s = _periods_s(profile)
    fits = [period_s for period_s in periods_s if needed_per_s(profile, period_s) <= usable]
    is_named = "telemetry_period_s" in profile.link.model_fields_set
    need = needed_per_s(profile, None if is_named else periods_s[-1])
    most = _most_that_fit(need)
    fewer = (
        f"leave at most {most} on it, and move the others to another dongle, on a channel at "
        f"least {LEAST_APART} away"
    )
    if shared_by > MOST_ON_A_DONGLE:
        raise InvalidValue(
            f"dongle {dongle} has {shared_by} vehicles on channel {channel}, but at most "
            f"{MOST_ON_A_DONGLE} are allowed: {fewer}"
        )
    if need > usable:
        raise InvalidValue(
            f"dongle {dongle} carries {carried_per_s(shared_by):.0f} packets/s for each of its "
            f"{shared_by} vehicles on channel {channel}, of which {usable:.0f} are usable, "
            f"but {vehicle.name} needs {need:.0f}: {_slower(profile, usable, fits)}{fewer}"
        )
    return vehicle if is_named else _with_link(vehicle, telemetry_period_s=fits[0])


def _slower(profile: Profile, usable: float, fits: Sequence[float]) -> str:
    """Return the advice to slow down telemetry or positions so that the dongle can carry the
    flight, ending in ``, or``; empty if that is not enough."""
    if fits:
        need = needed_per_s(profile, fits[0])
        return (
            f"set link.telemetry_period_s to {fits[0]:g} (for {need:.0f} packets/s) instead of "
            f"{profile.link.telemetry_period_s:g}, or "
        )
    rate_hz = math.floor((usable - profile.link.loop_hz) / 10.0) * 10
    if not profile.positioning.source.is_deck and rate_hz >= LEAST_RATE_HZ:
        return (
            f"set positioning.rate_hz to {rate_hz} instead of {profile.positioning.rate_hz:g}, or "
        )
    return ""


def _periods_s(profile: Profile) -> list[float]:
    """Return the periods that may be chosen, shortest first, beginning with the profile's."""
    first = round(profile.link.telemetry_period_s / LOG_STEP_S)
    last = round(SLOWEST_PERIOD_S / LOG_STEP_S)
    return [round(step * LOG_STEP_S, 3) for step in range(first, max(first, last) + 1)]


def _most_that_fit(need_per_s: float) -> int:
    """Return how many vehicles with this packet rate one dongle can carry; the result is at least
    1."""
    counts = range(1, MOST_ON_A_DONGLE + 1)
    fit = [count for count in counts if need_per_s <= USABLE_SHARE * carried_per_s(count)]
    return max(fit, default=1)


def _with_link(vehicle: FleetVehicle, **changes: object) -> FleetVehicle:
    link = vehicle.profile.link.model_copy(update=changes)
    return replace(vehicle, profile=vehicle.profile.model_copy(update={"link": link}))
