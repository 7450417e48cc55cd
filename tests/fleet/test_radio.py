"""The radio budget: what a dongle carries, what a flight needs, and what to do about it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import InvalidValue
from perchctl.fleet import load_fleet
from perchctl.fleet.fleet import Fleet
from perchctl.fleet.radio import (
    MOST_ON_A_DONGLE,
    SLOWEST_PERIOD_S,
    USABLE_SHARE,
    budget_radio,
    carried_per_s,
    needed_per_s,
)
from perchctl.link import telemetry_packets_per_s
from tests.fleet.rig import on_air, same_channel

NAMED = {"link": {"telemetry_period_s": 0.01}}
MOCAP = {"positioning": {"by": "mocap"}}


def refusal(fleet: Fleet) -> str:
    with pytest.raises(InvalidValue) as caught:
        budget_radio(fleet)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def periods_s(fleet: Fleet) -> set[float]:
    planned, _ = budget_radio(fleet)
    return {vehicle.profile.link.telemetry_period_s for vehicle in planned.vehicles}


@pytest.mark.parametrize(("period_s", "packets"), [(0.01, 220), (0.02, 120), (0.04, 70)])
def test_what_telemetry_needs_follows_from_its_blocks(period_s: float, packets: float) -> None:
    assert telemetry_packets_per_s(period_s) == pytest.approx(packets)


@pytest.mark.parametrize(
    ("count", "period_s"), [(1, 0.01), (2, 0.02), (3, 0.02), (4, 0.03), (5, 0.04)]
)
def test_the_shortest_period_that_fits_is_chosen(count: int, period_s: float) -> None:
    assert periods_s(same_channel(count)) == {period_s}


@given(st.integers(1, 40))
def test_more_vehicles_get_less_each(count: int) -> None:
    assert carried_per_s(count + 1) < carried_per_s(count)


@pytest.mark.parametrize("count", range(1, MOST_ON_A_DONGLE))
def test_one_more_vehicle_never_makes_telemetry_faster(count: int) -> None:
    assert max(periods_s(same_channel(count))) <= max(periods_s(same_channel(count + 1)))


@pytest.mark.parametrize("count", range(1, MOST_ON_A_DONGLE + 1))
def test_no_flight_of_a_plan_needs_more_than_its_dongle_carries(count: int) -> None:
    planned, (load,) = budget_radio(same_channel(count))
    assert load.vehicles == tuple(vehicle.name for vehicle in planned.vehicles)
    assert load.needs_per_s <= USABLE_SHARE * load.carries_per_s
    assert max(periods_s(planned)) <= SLOWEST_PERIOD_S


def test_five_at_100_hz_are_refused_with_what_to_change() -> None:
    assert refusal(same_channel(5, NAMED)) == (
        "dongle 0 carries 97 packets/s for each of its 5 vehicles on channel 80, of which 78 are "
        "usable, but v0 needs 220: set link.telemetry_period_s to 0.04 (for 70 packets/s) "
        "instead of 0.01, or leave at most 1 on it, and move the others to another dongle, on a "
        "channel at least 2 away"
    )


def test_what_is_advised_is_accepted() -> None:
    assert periods_s(same_channel(5, {"link": {"telemetry_period_s": 0.04}})) == {0.04}
    assert periods_s(same_channel(1, NAMED)) == {0.01}


def test_a_period_that_somebody_named_is_kept() -> None:
    assert periods_s(same_channel(2, {"link": {"telemetry_period_s": 0.04}})) == {0.04}


def test_six_on_a_dongle_are_too_many() -> None:
    sentence = refusal(same_channel(6))
    assert sentence.startswith(
        "dongle 0 has 6 vehicles on channel 80, but at most 5 are allowed: leave at most"
    )


def test_positions_that_are_sent_count_too() -> None:
    """A setpoint and a position each need a packet, however slow the telemetry is."""
    fleet = same_channel(3, MOCAP)
    assert needed_per_s(fleet.vehicles[0].profile, 0.05) == 150
    assert "v0 needs 150: set positioning.rate_hz to 70 instead of 100" in refusal(fleet)
    slower = {"positioning": {"by": "mocap", "rate_hz": 70}}
    assert periods_s(same_channel(3, slower)) == {0.02}


def test_vehicles_of_one_dongle_belong_on_one_channel() -> None:
    uris = ["radio://0/80/2M/E7E7E7E701", "radio://0/90/2M/E7E7E7E702"]
    assert refusal(on_air(uris)) == (
        "dongle 0 has v0 on channel 80 and v1 on channel 90; on two channels it carries 151 "
        "packets/s for each of two vehicles instead of 245: set both to the same channel, or move "
        "v1 to another dongle"
    )


@pytest.mark.parametrize(
    ("channel", "where"), [(80, "channel 80"), (81, "channels 80 and 81"), (79, "channels 79 and")]
)
def test_dongles_are_two_channels_apart(channel: int, where: str) -> None:
    uris = ["radio://0/80/2M/E7E7E7E701", f"radio://1/{channel}/2M/E7E7E7E702"]
    assert f"interfere on {where}" in refusal(on_air(uris))
    budget_radio(on_air([uris[0], "radio://1/82/2M/E7E7E7E702"]))


def test_what_a_shared_dongle_carries_at_1m_is_not_known() -> None:
    uris = ["radio://0/80/1M/E7E7E7E701", "radio://0/80/1M/E7E7E7E702"]
    assert refusal(on_air(uris)).startswith("dongle 0 is shared, but v0 uses the data rate 1M")
    budget_radio(on_air(uris[:1]))


def test_serial_numbers_and_numbers_name_dongles() -> None:
    uris = [f"radio://{d}/{c}/2M/E7E7E7E7{c}" for d, c in (("00", 10), ("abcdef0123", 20), (7, 30))]
    _, loads = budget_radio(on_air(uris))
    assert [load.dongle for load in loads] == ["0", "ABCDEF0123", "7"]


def test_what_flies_without_a_radio_has_no_dongle() -> None:
    fleet = on_air(["udp://127.0.0.1:19850", "usb://0"])
    assert budget_radio(fleet) == (fleet, ())
    assert budget_radio(load_fleet())[1] == ()
