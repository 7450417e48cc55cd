"""The link's small parts: signs, time, URIs."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from perchctl.errors import InvalidValue
from perchctl.link import UDEV_HELP, check_uri
from perchctl.link import probe as scan_room
from perchctl.link.telemetry import (
    ATTITUDE_BLOCK,
    BATTERY_BLOCK,
    NEEDED,
    STATE_BLOCK,
    WRAP_MS,
    Timebase,
    telemetry_from,
)

SIZES = {"float": 4, "FP16": 2, "uint16_t": 2, "int8_t": 1}


@pytest.mark.parametrize("block", [STATE_BLOCK, ATTITUDE_BLOCK, BATTERY_BLOCK])
def test_blocks_fit_into_a_packet(block: dict[str, str]) -> None:
    """Firmware facts, "Link": at most 26 bytes a log block."""
    assert sum(SIZES[ctype] for ctype in block.values()) <= 26


def test_pitch_and_degrees_turn_at_the_edge() -> None:
    """stateEstimate.pitch is nose up in degrees; inside it is nose down in radians."""
    values = dict.fromkeys(NEEDED, 0.0) | {
        "stateEstimate.roll": 10.0,
        "stateEstimate.pitch": 20.0,
        "stateEstimate.yaw": 30.0,
        "supervisor.info": 0x021E,
    }
    sample = telemetry_from(values, 1.5)
    assert sample.roll_rad == pytest.approx(math.radians(10))
    assert sample.pitch_rad == pytest.approx(-math.radians(20))
    assert sample.yaw_rad == pytest.approx(math.radians(30))
    assert sample.supervisor == 0x021E
    assert sample.t_s == 1.5
    assert sample.position_variance_m2 is None
    assert sample.climb_variance_m2ps2 is None
    assert sample.battery_v == 0.0  # unknown, which to the planner is not empty


def test_the_vertical_speed_s_variance_stands_by_itself() -> None:
    variances = {"kalman.varPX": 3e-4, "kalman.varPY": 2e-4, "kalman.varPZ": 1e-4}
    sample = telemetry_from(dict.fromkeys(NEEDED, 0.0) | variances, 1.5)
    assert (sample.position_variance_m2, sample.climb_variance_m2ps2) == (3e-4, 1e-4)


@given(
    start_ms=st.integers(0, WRAP_MS - 1),
    delays_ms=st.lists(st.integers(0, 80), min_size=20, max_size=60),
)
def test_timebase_follows_stamps_not_arrivals(start_ms: int, delays_ms: list[int]) -> None:
    """Also across the wrap of the three-byte stamp; the best delivery sets the offset."""
    base = Timebase()
    times = []
    for i, delay_ms in enumerate(delays_ms):
        stamp = (start_ms + 10 * i) % WRAP_MS
        times.append(base.to_loop_s(stamp, 100.0 + 0.01 * i + 0.001 * delay_ms))
    best_s = min(delays_ms) / 1000.0
    after = delays_ms.index(min(delays_ms))
    for i in range(after, len(times)):
        assert times[i] == pytest.approx(100.0 + 0.01 * i + best_s, abs=2e-4)


def test_a_vehicle_that_has_started_again_is_followed_from_its_first_stamp_on() -> None:
    """Packets that overtake each other are no new start."""
    base = Timebase()
    assert base.to_loop_s(60_000, 100.0) == pytest.approx(100.0)
    assert base.to_loop_s(59_990, 100.0) == pytest.approx(99.99)
    assert base.start == 0
    assert base.to_loop_s(300, 103.0) == pytest.approx(103.0)
    assert base.to_loop_s(310, 103.02) == pytest.approx(103.01)
    assert base.start == 1


@pytest.mark.parametrize(
    "uri",
    [
        "sim://",
        "radio://0/80/2M/E7E7E7E7E7",
        "radio://0/125/250K",
        "radio://0/0/1M",
        "radio://0",
        "radio://E7E7E7E7E7/80/2M/00000000e7?rate_limit=100",
        "usb://0",
        "udp://host:19850",
    ],
)
def test_good_uris(uri: str) -> None:
    assert check_uri(uri) == uri.split(":")[0]


@pytest.mark.parametrize(
    "uri", ["", "radio:/0", "radio://0/80/3M/E7E7E7E7E7", "udp://host", "http://host:80", "sim"]
)
def test_bad_uris_name_examples(uri: str) -> None:
    with pytest.raises(InvalidValue, match="radio://0/80/2M"):
        check_uri(uri)


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("radio://0/200/2M", "has channel '200'; allowed are 0 to 125"),
        ("radio://0/126", "has channel '126'"),
        ("radio://0/x/2M", "has channel 'x'"),
        ("radio://0/80/3M/E7E7E7E7E7", "has data rate '3M'; allowed are 250K, 1M, 2M"),
        ("radio://0/80/2M/E7", "has address 'E7'; needed are ten hex digits"),
        ("radio://0/80/2M/E7E7E7E7EG", "has address 'E7E7E7E7EG'"),
        ("radio://0/80/2M/E7?rate_limit=100", "has address 'E7'"),
    ],
)
def test_a_wrong_part_of_a_radio_s_uri_is_named(uri: str, said: str) -> None:
    with pytest.raises(InvalidValue, match=re.escape(f"URI {uri!r} {said}")):
        check_uri(uri)


def test_a_scan_gives_uris_that_are_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """cflib's own have an address without the zeros in front."""

    class Radio:
        def scan_interface(self, address: int | None) -> list[list[str]]:
            end = "" if address is None else f"/{address:X}"
            return [[f"radio://0/80/2M{end}", ""]]

    monkeypatch.setattr("cflib.crtp.CLASSES", [Radio])
    monkeypatch.setattr(scan_room, "ready_cflib", lambda: None)
    monkeypatch.setattr(scan_room, "_radio_problem", lambda: "")
    found = scan_room.find_vehicles([0x01]).uris
    assert found == ("radio://0/80/2M", "radio://0/80/2M/0000000001")
    assert list(map(check_uri, found)) == ["radio", "radio"]


def test_udev_lines_name_all_three_devices() -> None:
    """Conventions: radio, bootloader, Crazyflie over USB."""
    for ids in (("1915", "7777"), ("1915", "0101"), ("0483", "5740")):
        assert any(all(i in line for i in ids) for line in UDEV_HELP.splitlines())
