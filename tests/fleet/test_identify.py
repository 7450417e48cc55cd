"""`perchctl fleet check --identify`: where each vehicle stands, and what it prints."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.fleet import load_fleet
from perchctl.fleet.identify import make_stand
from tests.helpers.commands import run

ONE = """\
name: one
vehicles:
  - {name: north, home_m: [0, 0], target_m: [0.2, 0.1]URI}
"""
PAIR = """\
name: pair
defaults: {profile: sim}
vehicles:
  - {name: north, home_m: [0, 0], target_m: [0.2, 0]}
  - {name: east, home_m: [3, 0], target_m: [3, TARGET], heading_deg: 90IDS}
"""


def pair(folder: Path, target: float, ids: str = "") -> Any:
    path = folder / "pair.yaml"
    path.write_text(PAIR.replace("TARGET", str(target)).replace("IDS", ids), encoding="utf-8")
    return load_fleet(path)


def test_a_target_in_the_same_place_as_the_others_makes_lookalikes(tmp_path: Path) -> None:
    """East looks along y: its target at y = 0.2 is in front of it, as that of north is."""
    fleet = pair(tmp_path, 0.2)
    north, east = (make_stand(fleet, vehicle) for vehicle in fleet.vehicles)
    assert (north.lookalikes, east.lookalikes) == (("east",), ("north",))
    assert math.dist(north.views["east"], (0.2, 0.0)) < 1e-9
    assert math.dist(north.homes["east"], (3.0, 0.0)) < 1e-9
    assert math.dist(east.homes["north"], (0.0, 3.0)) < 1e-9
    assert east.home_text == "3.00 0.00 m"


def test_a_target_elsewhere_or_with_other_ids_can_be_told_apart(tmp_path: Path) -> None:
    ids = (
        ", target: {large: {dictionary: DICT_4X4_1000, id: 145, side_m: 0.15}, "
        "small: {dictionary: DICT_ARUCO_ORIGINAL, id: 254, side_m: 0.025}}"
    )
    for fleet in (pair(tmp_path, -0.4), pair(tmp_path, 0.2, ids)):
        assert [make_stand(fleet, v).lookalikes for v in fleet.vehicles] == [(), ()]
    # A target with other ids is not detected, so no camera is mistaken for that of its vehicle.
    assert [make_stand(fleet, v).views for v in fleet.vehicles] == [{}, {}]


def test_ids_of_two_dictionaries_may_name_the_same_marker(tmp_path: Path) -> None:
    ids = (
        ", target: {large: {dictionary: DICT_4X4_%d, id: 16, side_m: 0.15}, "
        "small: {dictionary: DICT_ARUCO_ORIGINAL, id: %d, side_m: 0.025}}"
    )
    text = PAIR.replace("target_m: [0.2, 0]", "target_m: [0.2, 0]" + ids % (1000, 5))
    path = tmp_path / "pair.yaml"
    path.write_text(text.replace("IDS", ids % (50, 254)).replace("TARGET", "0.2"), encoding="utf-8")
    fleet = load_fleet(path)
    assert [make_stand(fleet, v).lookalikes for v in fleet.vehicles] == [("east",), ("north",)]


def test_a_simulated_fleet_is_identified_without_a_question(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(ONE.replace("URI", ""), encoding="utf-8")
    done = run("fleet", "check", str(path), "--identify", "--json")
    assert done.code == 0, done.stderr
    rows = json.loads(done.stdout)["identified"]["north"]
    verdicts = {row["name"]: row["verdict"] for row in rows}
    assert verdicts == {"address": "pass", "vehicle": "skipped", "camera": "pass", "target": "pass"}


def test_without_a_terminal_nobody_can_see_it_blink(tmp_path: Path) -> None:
    path = tmp_path / "one.yaml"
    uri = ", uri: 'radio://0/80/2M/E7E7E7E701', source: 'camera:97'"
    path.write_text(ONE.replace("URI", uri), encoding="utf-8")
    done = run("fleet", "check", str(path), "--identify")
    assert (done.code, done.stdout) == (2, "")
    assert done.complaint.startswith("--identify asks you whether north is blinking")
