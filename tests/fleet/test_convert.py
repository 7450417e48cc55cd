"""Lists of other programs become fleet files, which say what they lack."""

from __future__ import annotations

from pathlib import Path

import pytest

from perchctl.errors import InvalidValue
from perchctl.fleet import convert_fleet, load_fleet

CRAZYSWARM2 = """\
fileversion: 3
robots:
  cf231:
    enabled: true
    uri: radio://0/80/2M/E7E7E7E7E7
    initial_position: [0.0, 0.5, 0.0]
    type: cf21
  cf5:
    enabled: false
    uri: radio://0/80/2M/E7E7E7E705
    initial_position: [0.0, -0.5, 0.0]
    type: cf21
  cf7:
    enabled: true
    uri: radio://0/80/2M/E7E7E7E707
    initial_position: [2, -0.5, 0.0]
    type: cf21
robot_types:
  cf21:
    motion_capture: CAPTURE
    big_quad: false
all:
  broadcasts: {num_repeats: 15, delay_between_repeats_ms: 1}
"""
CFCLI = """\
name: Lab Crazyflies
description: The bench
lighthouse: lab/cage
units:
- uri: radio:///80/2M/E7E7E7E701
  name: CF-01
- uri: radio:///80/2M/E7E7E7E702
  name: Rig, left
  description: Test bench
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "crazyflies.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def refusal(tmp_path: Path, text: str) -> str:
    with pytest.raises(InvalidValue) as caught:
        convert_fleet(written(tmp_path, text))
    return str(caught.value).removeprefix(f"{tmp_path / 'crazyflies.yaml'}: ")


@pytest.mark.parametrize(
    ("capture", "body"),
    [
        ("{enabled: true, marker: default}", "cf231"),
        ("{tracking: vendor}", "cf231"),
        ("{enabled: false}", None),
    ],
)
def test_crazyswarm2_gives_names_uris_homes_and_bodies(
    tmp_path: Path, capture: str, body: str | None
) -> None:
    found = convert_fleet(written(tmp_path, CRAZYSWARM2.replace("CAPTURE", capture)))
    first, second = found.vehicles
    assert (first.name, first.uri) == ("cf231", "radio://0/80/2M/E7E7E7E7E7")
    assert (first.home_m, second.home_m) == ((0.0, 0.5), (2.0, -0.5))
    assert first.body == body
    assert found.skipped == ("cf5",)
    assert found.missing == ("target_m", "source")


def test_cfcli_gives_names_and_uris_and_a_lighthouse_s_frame(tmp_path: Path) -> None:
    found = convert_fleet(written(tmp_path, CFCLI))
    assert [vehicle.name for vehicle in found.vehicles] == ["CF-01", "Rig-left"]
    assert found.missing == ("home_m", "target_m", "source")
    assert "frame: room" in found.text()


def test_a_type_that_is_no_name_and_names_that_are_empty_do_no_harm(tmp_path: Path) -> None:
    listed = CRAZYSWARM2.replace("type: cf21", "type: [cf21]")
    first, _ = convert_fleet(written(tmp_path, listed)).vehicles
    assert (first.name, first.body) == ("cf231", None)
    unnamed = convert_fleet(written(tmp_path, "name:\nunits: [{uri: 'usb://0', name: }]\n"))
    assert (unnamed.name, unnamed.vehicles[0].name) == ("crazyflies", "CF-01")


@pytest.mark.parametrize("text", [CRAZYSWARM2.replace("CAPTURE", "{enabled: true}"), CFCLI])
def test_what_is_missing_is_refused_until_it_is_there(tmp_path: Path, text: str) -> None:
    found = convert_fleet(written(tmp_path, text))
    fleet = tmp_path / "fleet.yaml"
    fleet.write_text(found.text(), encoding="utf-8")
    with pytest.raises(InvalidValue, match=rf"vehicle {found.vehicles[0].name}: "):
        load_fleet(fleet)
    lines = found.text().splitlines()
    for number, line in enumerate(lines):
        if line.startswith("  - "):
            home = "" if "home_m" in line else f", home_m: [{number}, 0]"
            more = f"{home}, target_m: [{number}, 1], source: 'camera:{number}'}}"
            lines[number] = line.removesuffix("}") + more
    fleet.write_text("\n".join(lines), encoding="utf-8")
    loaded = load_fleet(fleet)
    assert [vehicle.name for vehicle in loaded.vehicles] == [v.name for v in found.vehicles]
    assert {vehicle.frame for vehicle in loaded.vehicles} == {"room"}


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("extends: sim\n", "has neither robots, like Crazyswarm2's crazyflies.yaml, nor a list"),
        ("robots: {a: {enabled: false}}\n", "no vehicle in this file is switched on"),
        (
            "robots: {a: {enabled: true}}\n",
            "robots.a: uri: is missing; add the vehicle's URI, as in radio",
        ),
        ("robots: {a: 3}\n", "robots.a: must have keys and values, found 3"),
        (
            "robots: {a: {enabled: true, uri: 5}}\n",
            "robots.a: uri: must be text, as in radio://0/80/2M/E7E7E7E7E7, found 5",
        ),
        ("units: [{name: a, uri: 'usb://0'}, {name: b}]\n", "units, number 2 (b): uri: is missing"),
        ("units: [{}]\n", "units, number 1: uri: is missing"),
        (
            "robots: {a: {enabled: true, uri: 'usb://0', initial_position: [1, x]}}\n",
            "robots.a.initial_position: must be x, y and z in metres, found [1, 'x']",
        ),
        (
            f"robots: {{a: {{enabled: true, uri: 'usb://0', initial_position: [{'9' * 400}, 0]}}}}",
            "robots.a.initial_position: must be x, y and z in metres, found [999",
        ),
        ("units: [{uri: 'usb://0', name: a}, {uri: 'usb://1', name: A}]\n", "two vehicles would"),
    ],
    ids=[
        "profile",
        "off",
        "no-uri",
        "no-keys",
        "bad-uri",
        "unit",
        "no-name",
        "place",
        "no-float",
        "twice",
    ],
)
def test_what_is_no_such_list_is_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    assert refusal(tmp_path, text).startswith(sentence)
