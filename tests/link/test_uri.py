"""The URIs of vehicles: which are taken, which are of one vehicle, and what a scan gives."""

from __future__ import annotations

import pytest
from cflib.crtp import radiodriver

from perchctl.errors import InvalidValue
from perchctl.link import check_uri, listening, vehicle_uri

RADIO = "radio://0/80/2M/E7E7E7E701"


@pytest.mark.parametrize("uri", [
    "sim://", "radio://0/80/2M/E7E7E7E7E7", "radio://0/125/250K", "radio://0/0/1M", "radio://0",
    "radio://E7E7E7E7E7/80/2M/00000000e7?rate_limit=100", "usb://0", "udp://host:19850",
])  # fmt: skip
def test_good_uris(uri: str) -> None:
    assert check_uri(uri) == uri.split(":")[0]


@pytest.mark.parametrize("uri", [
    "", "radio:/0", "udp://host", "http://host:80", "sim", "sim://1", "udp://host:0",
    "udp://host:65536", "tcp://host:80",
    "radio://0/200/2M", "radio://0/126", "radio://0/", "radio://0/x/2M",
    "radio://0/80/3M/E7E7E7E7E7", "radio://0/80/2M/E7E7E7E7EG", "radio://0/80/2M/E7E7E7E7E7E",
])  # fmt: skip
def test_a_wrong_uri_is_refused_with_what_is_allowed(uri: str) -> None:
    with pytest.raises(InvalidValue, match=r"channel 0 to 125.*ten hex digits") as caught:
        check_uri(uri)
    assert repr(uri) in str(caught.value)


@pytest.mark.parametrize(("one", "other", "same"), [
    (RADIO, "radio://1/80/2M/e7e7e7e701?rate_limit=100", True),  # by another dongle
    ("radio://0/80/2M/0000000001", "radio://0/80/2M/1", True),
    ("radio://0", "radio://0/2/2M/E7E7E7E7E7", True),
    (RADIO, "radio://0/81/2M/E7E7E7E701", False),  # its twin on another channel
    (RADIO, "radio://0/80/1M/E7E7E7E701", False),
    (RADIO, "radio://0/80/2M/E7E7E7E702", False),
    ("udp://LocalHost:19850", "UDP://127.0.0.1:19850", True),
    ("Radio://0/80/2m/E7E7E7E701", RADIO, True),
    ("udp://127.0.0.1:19851", "udp://127.0.0.1:19850", False),
    ("usb://0", "usb://1", False),
])  # fmt: skip
def test_which_uris_are_of_one_vehicle(one: str, other: str, same: bool) -> None:
    assert (vehicle_uri(one) == vehicle_uri(other)) is same


def test_a_scan_gives_uris_that_are_taken_and_prints_nothing(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """cflib's own have an address without the zeros in front, and its radio prints what fails."""

    class Radio:
        def scan_interface(self, address: int | None) -> list[list[str]]:
            end = "" if address is None else f"/{address:X}"
            return [[f"radio://0/80/2M{end}", ""]]

    monkeypatch.setattr("cflib.crtp.CLASSES", [radiodriver.RadioDriver, Radio])
    monkeypatch.setattr(radiodriver.RadioManager, "open", lambda number: 1 / 0)
    monkeypatch.setattr(listening, "_radio_problem", lambda: "")
    found = listening.find_uris_and_problem("radio://0/80/2M/0000000001?rate_limit=100")[0]
    assert found == ["radio://0/80/2M", "radio://0/80/2M/1"]
    assert list(map(check_uri, found)) == ["radio", "radio"]
    assert capfd.readouterr() == ("", "")
