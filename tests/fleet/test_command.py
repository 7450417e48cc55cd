"""`perchctl fleet`: what it prints and draws, and its exit codes."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from perchctl.fleet import draw_svg, draw_text, load_fleet
from perchctl.fleet.fleet import Fleet
from tests.fleet.rig import fleet
from tests.helpers.commands import run

CLASH = """\
name: clash
vehicles:
  - {name: north, home_m: [0, 0], target_m: [1.2, 0]}
  - {name: east, home_m: [2.4, 0], target_m: [1.2, 0.1]}
"""


@pytest.fixture
def clash(tmp_path: Path) -> Path:
    path = tmp_path / "clash.yaml"
    path.write_text(CLASH, encoding="utf-8")
    return path


def test_the_shipped_fleet_is_planned_in_80_columns() -> None:
    done = run("fleet")
    assert done.code == 0
    assert max(map(len, done.stdout.splitlines())) <= 80
    assert "group 1: north, east" in done.stdout
    assert "1 north: home 0.00 1.20, 1* target -0.10 1.50, radius 0.64 m, flies 1st" in done.stdout


def test_json_has_the_plan() -> None:
    plan = json.loads(run("fleet", "check", "--json").stdout)
    assert plan["groups"] == [["north", "east"], ["south", "west"]]
    assert [vehicle["group"] for vehicle in plan["vehicles"]] == [1, 1, 2, 2]
    assert plan["dongles"] == []


def test_a_refused_plan_is_drawn_and_refused_in_one_sentence(clash: Path, tmp_path: Path) -> None:
    picture = tmp_path / "clash.svg"
    done = run("fleet", "check", str(clash), "-o", str(picture))
    assert done.code == 30
    assert not done.stdout
    assert done.stderr.splitlines()[-1].startswith(f"perchctl: {clash}: the targets of north and")
    assert "##" in done.stderr
    assert picture.exists()
    failed = json.loads(run("fleet", "check", str(clash), "--json").stdout)
    assert failed["exit_code"] == 30


def test_one_bad_uri_of_many_is_one_sentence(clash: Path) -> None:
    clash.write_text(CLASH.replace("name: east", "name: east, uri: 'radio://x'"), encoding="utf-8")
    done = run("fleet", str(clash))
    assert (done.code, done.stdout) == (30, "")
    assert done.complaint.startswith(f"{clash}: vehicle east: 'radio://x' is not the URI of a")


@pytest.mark.parametrize("subcommand", ["fly", "simulate"])
def test_a_negative_seed_is_the_users_and_no_vehicles(subcommand: str) -> None:
    done = run("fleet", subcommand, "--seed", "-1")
    assert done.code == 30
    assert "--seed: found '-1'" in done.complaint
    assert "-32" not in done.stderr


def test_convert_writes_a_file_that_says_what_it_lacks(tmp_path: Path) -> None:
    listed, written = tmp_path / "lab.yaml", tmp_path / "fleet.yaml"
    listed.write_text("units: [{name: CF-01, uri: 'radio:///80/2M/E7E7E7E701'}]\n")
    done = run("fleet", "convert", str(listed), "-o", str(written))
    assert done.code == 0
    assert "add home_m, target_m, source to each vehicle" in done.stdout
    again = run("fleet", "convert", str(listed), "-o", str(written))
    assert (again.code, "add --force" in again.stderr) == (30, True)


@pytest.mark.parametrize("is_tracked", [True, False])
def test_convert_asks_for_the_motion_capture_that_it_writes(
    is_tracked: bool, tmp_path: Path
) -> None:
    listed, written = tmp_path / "lab.yaml", tmp_path / "fleet.yaml"
    listed.write_text(
        "robots: {cf1: {enabled: true, uri: 'usb://0', initial_position: [0, 0, 0], type: cf}}\n"
        f"robot_types: {{cf: {{motion_capture: {{enabled: {str(is_tracked).lower()}}}}}}}\n"
    )
    done = run("fleet", "convert", str(listed), "-o", str(written))
    assert ("by: mocap" in written.read_text()) is is_tracked
    keys = "positioning.system, positioning.host to defaults, and " if is_tracked else ""
    assert f"add {keys}target_m, source to each vehicle" in done.stdout


def test_a_list_that_does_not_exist_is_reported_before_an_output_that_does(tmp_path: Path) -> None:
    listed, written = tmp_path / "nosuch.yaml", tmp_path / "fleet.yaml"
    written.write_text("mine")
    done = run("fleet", "convert", str(listed), "-o", str(written))
    assert done.code == 20
    assert f"{listed}: cannot be read: No such file or directory" in done.stderr
    assert "already exists" not in done.stderr
    assert written.read_text() == "mine"


def test_the_map_has_each_home_and_target_where_it_is() -> None:
    text = draw_text(load_fleet())
    rows = text.splitlines()
    at = {
        label: next((r, row.index(label)) for r, row in enumerate(rows) if label in row)
        for label in ("1*", "2*", "3*", "4*")
    }
    assert at["1*"][0] < at["2*"][0] < at["3*"][0], "y is up"
    assert at["4*"][1] < at["1*"][1] < at["2*"][1], "x is to the right"


def labels(planned: Fleet) -> list[str]:
    """The labels on the map, sorted, as they are read: two that touch are read as another one."""
    lines = draw_text(planned).splitlines()
    drawn = lines[: next(n for n, line in enumerate(lines) if "x to the right" in line)]
    return sorted(re.findall(r"(?<!\d)\d+\*?(?![\d*])", "\n".join(drawn)))


def test_no_label_touches_another_one() -> None:
    """Home 1 beside target 1 would read 11*, the target of vehicle 11."""
    beside = fleet([((0.06 * n, 0.0), (0.06 * n - 0.03, 0.0)) for n in range(12)])
    crowd = fleet([((0.0, 0.0), (0.0, 0.0))] * 32)
    assert labels(beside) == sorted(f"{n}{star}" for n in range(1, 13) for star in ("", "*"))
    assert labels(crowd) == sorted(f"{n}*" for n in range(1, 33))


def test_each_label_of_the_list_is_on_the_map_whole() -> None:
    """Also where a home and a target, or the targets of two vehicles, are side by side."""
    close = fleet([((0.0, 0.0), (-0.03, 0.0)), ((0.1, 0.0), (0.0, 0.0)), ((3.0, 0.0), (3.0, 0.0))])
    lines = draw_text(close).splitlines()
    assert labels(close) == ["1", "1*", "2", "2*", "3*"], (
        "a home below its own target has one label"
    )
    assert "1 home, 1* target (or both, if they are in the same place)" in lines
    assert ". in one corridor, # in several" in lines


def test_many_vehicles_on_one_spot_can_be_drawn() -> None:
    crowd = fleet([((0.0, 0.0), (0.0, 0.0))] * 12)
    assert max(map(len, draw_text(crowd).splitlines())) <= 80
    assert "12" in draw_text(crowd)


def test_a_long_and_narrow_room_has_each_label_once() -> None:
    column = fleet([((0.0, 8.0 * n), (0.0, 8.0 * n)) for n in range(12)])
    rows = [row for row in draw_text(column).splitlines() if row.endswith("*")]
    assert rows == [f"{n}*" for n in range(12, 0, -1)]


def test_the_picture_is_an_svg_of_all_vehicles() -> None:
    planned = load_fleet()
    root = ElementTree.fromstring(draw_svg(planned, (("north",), ("east",))))
    words = " ".join(node.text or "" for node in root.iter() if node.tag.endswith("text"))
    assert all(vehicle.name in words for vehicle in planned.vehicles)
    assert "flies 2nd" in words
    assert "circle: home; square: target; wide line: corridor" in words
    shapes = [node.tag.rpartition("}")[2] for node in root.iter()]
    assert (shapes.count("circle"), shapes.count("rect")) == (4, 5), "one is the background"


def test_a_short_address_is_named_in_full(tmp_path: Path) -> None:
    path = tmp_path / "short.yaml"
    path.write_text(
        "vehicles:\n  - {name: a, uri: 'radio://0/80/2M/E7E7E7', source: 'camera:0', "
        "home_m: [0, 0], target_m: [0, 0]}\n"
    )
    done = run("fleet", str(path))
    assert done.code == 0
    assert "a: radio://0/80/2M/E7E7E7 means the address 0000E7E7E7: write all ten" in done.stderr
