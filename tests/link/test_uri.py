"""The URIs of vehicles: which are taken, and what a scan gives."""

from __future__ import annotations

import re

import pytest

from perchctl.errors import InvalidValue
from perchctl.link import UDEV_HELP, check_uri
from perchctl.link import probe as scan_room


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
    found = scan_room.find_vehicles("radio://0/80/2M/0000000001?rate_limit=100").uris
    assert found == ("radio://0/80/2M", "radio://0/80/2M/0000000001")
    assert list(map(check_uri, found)) == ["radio", "radio"]


def test_udev_lines_name_all_three_devices() -> None:
    """Conventions: radio, bootloader, Crazyflie over USB."""
    for ids in (("1915", "7777"), ("1915", "0101"), ("0483", "5740")):
        assert any(all(i in line for i in ids) for line in UDEV_HELP.splitlines())
