"""The fleet file: each vehicle gets its profile and target, and each fault is one sentence."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from perchctl.camera import device
from perchctl.commands.fleet import plan_text
from perchctl.errors import InvalidValue, NotFound
from perchctl.fleet import load_fleet, make_plan
from perchctl.fleet.fleet import Fleet
from perchctl.profile import load_profile
from tests.helpers.flights import ROOT

ATRIUM = """\
name: atrium
defaults: {profile: crazyflie, planner: {takeoff_height_m: 0.6}}
order: 2 at a time
on_failure: land-all
vehicles:
  - {name: north, uri: radio:///80/2M/E7E7E7E701, source: camera:FPV-1, home_m: [0, 0],
     target_m: [0.2, 0.1], safety: {fence_radius_m: 1.2}}
  - {name: east, uri: radio:///80/2M/E7E7E7E702, source: camera:FPV-2, home_m: [3, 0],
     heading_deg: 90, target: east.yaml}
"""
EAST = """\
target:
  expected_xy_m: [0.3, -0.1]
  large: {dictionary: DICT_4X4_1000, id: 145, side_m: 0.15}
"""


def load(tmp_path: Path, text: str) -> Fleet:
    path = tmp_path / "fleet.yaml"
    path.write_text(text, encoding="utf-8")
    return load_fleet(path)


def refusal(tmp_path: Path, text: str) -> str:
    """The sentence with which the file is refused, without its path."""
    with pytest.raises((InvalidValue, NotFound)) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'fleet.yaml'}: ")
    assert "\n" not in message
    return message.removeprefix(f"{tmp_path / 'fleet.yaml'}: ")


def two(first: str = "", second: str = "", top: str = "", defaults: str = "") -> str:
    """A fleet file of two simulated vehicles with other keys added."""
    return (
        f"defaults: {{profile: sim{defaults}}}\n{top}\nvehicles:\n"
        f"  - {{name: north, home_m: [0, 0], target_m: [0.2, 0]{first}}}\n"
        f"  - {{name: east, home_m: [3, 0], target_m: [3.2, 0]{second}}}\n"
    )


def test_the_shipped_fleet_is_four_simulated_vehicles_with_ordinary_profiles() -> None:
    fleet = load_fleet()
    assert (fleet.name, len(fleet.vehicles)) == ("four", 4)
    assert all(vehicle.simulated for vehicle in fleet.vehicles)
    north = fleet.vehicle("north").profile
    changed = {"name", "target", "planner"}
    same = {name: value for name, value in load_profile("sim") if name not in changed}
    assert {name: value for name, value in north if name not in changed} == same


def test_each_vehicle_resolves_to_a_profile(tmp_path: Path) -> None:
    (tmp_path / "east.yaml").write_text(EAST, encoding="utf-8")
    fleet = load(tmp_path, ATRIUM)
    north, east = fleet.vehicles
    assert (fleet.name, fleet.most_at_once, fleet.on_failure) == ("atrium", 2, "land-all")
    assert (north.profile.name, north.source) == ("north", "camera:FPV-1")
    assert north.profile.safety.fence_radius_m == 1.2
    assert east.profile.safety.fence_radius_m == 1.5
    assert north.profile.planner.takeoff_height_m == east.profile.planner.takeoff_height_m == 0.6
    assert north.profile.target.expected_xy_m == (0.2, 0.1)
    assert east.profile.target.large.id == 145


def test_a_place_of_a_file_is_in_the_axes_of_its_own_vehicle(tmp_path: Path) -> None:
    (tmp_path / "east.yaml").write_text(EAST, encoding="utf-8")
    east = load(tmp_path, ATRIUM).vehicle("east")
    assert east.target_m == pytest.approx((3.1, 0.3))
    assert east.profile.planner.approach_xy_m == pytest.approx((0.3, -0.1))
    assert east.to_estimate(east.to_room((0.5, -0.7))) == pytest.approx((0.5, -0.7))


def test_by_motion_capture_the_room_s_axes_are_the_vehicle_s(tmp_path: Path) -> None:
    fleet = load(tmp_path, two(second=", body: cf7", defaults=", positioning: mocap"))
    north, east = fleet.vehicles
    assert (north.frame, north.profile.positioning.body) == ("room", "north")
    assert east.profile.positioning.body == "cf7"
    assert east.profile.target.expected_xy_m == (3.2, 0.0)


def test_by_the_target_alone_no_point_is_approached(tmp_path: Path) -> None:
    north = load(tmp_path, two(defaults=", positioning: target")).vehicles[0]
    assert north.profile.planner.approach_xy_m is None
    assert north.profile.target.expected_xy_m == (0.2, 0.0)


@pytest.mark.parametrize(
    ("order", "most"), [("one-at-a-time", 1), ("together", 2), ("7 at a time", 7), ("3", 3)]
)
def test_order_says_how_many_fly_at_a_time(tmp_path: Path, order: str, most: int) -> None:
    assert load(tmp_path, two(top=f"order: {order}")).most_at_once == most


def test_any_dongle_is_one_for_each_channel_that_nobody_has_named(tmp_path: Path) -> None:
    uris = (
        "radio:///80/2M/E7E7E7E701",
        "radio:///80/2M/E7E7E7E702",
        "radio:///90/2M/E7E7E7E703",
        "radio://0/70/2M/E7E7E7E704",
    )
    rows = "".join(
        f"  - {{name: v{n}, uri: {uri}, source: 'camera:{n}', home_m: [{3 * n}, 0], "
        f"target_m: [{3 * n}, 0]}}\n"
        for n, uri in enumerate(uris)
    )
    fleet = load(tmp_path, f"defaults: {{profile: crazyflie}}\nvehicles:\n{rows}")
    assert [vehicle.uri[8] for vehicle in fleet.vehicles] == ["1", "1", "2", "0"]


def test_files_are_named_from_the_fleet_file_s_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").write_text("extends: sim\nsafety: {max_height_m: 2.5}\n")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    fleet = load(tmp_path, two(first=", profile: mine.yaml"))
    assert [v.profile.safety.max_height_m for v in fleet.vehicles] == [2.5, 3.0]


def test_a_plan_says_which_targets_were_reassigned(tmp_path: Path) -> None:
    crossed = two().replace("[0.2, 0]", "TEMP").replace("[3.2, 0]", "[0.2, 0]")
    text = f"assign: nearest\n{crossed.replace('TEMP', '[3.2, 0]')}"
    plan = make_plan(load(tmp_path, text))
    assert plan.reassigned == (
        "north flies to the target of east, 0.2 0",
        "east flies to the target of north, 3.2 0",
    )
    assert [each["target_from"] for each in plan.record()["vehicles"]] == ["east", "north"]
    assert "nearest       north flies to the target of east" in plan_text(plan)
    unchanged = make_plan(load(tmp_path, f"assign: nearest\n{two()}"))
    assert unchanged.reassigned == ()
    assert [each["target_from"] for each in unchanged.record()["vehicles"]] == ["north", "east"]


def test_interchangeable_targets_go_to_the_nearest_with_their_markers(tmp_path: Path) -> None:
    crossed = two().replace("[0.2, 0]", "TEMP").replace("[3.2, 0]", "[0.2, 0]")
    marked = crossed.replace("TEMP", "[3.2, 0], target: east.yaml")
    (tmp_path / "east.yaml").write_text(EAST, encoding="utf-8")
    north, east = load(tmp_path, f"assign: nearest\n{marked}").vehicles
    assert (north.target_m, east.target_m) == ((0.2, 0.0), (3.2, 0.0))
    assert (north.profile.target.large.id, east.profile.target.large.id) == (997, 145)
    assert east.profile.target.expected_xy_m == pytest.approx((0.2, 0.0))


RADIO = ", uri: radio://0/80/2M/E7E7E7E7{0}, source: 'camera:{1}'"
BAD_URI = "'radio://0/80/3M/E7' is not the URI of a vehicle; examples: sim://"
REFUSED = [
    (two(top="odrer: together"), "odrer: this key is unknown; did you mean order?"),
    (two(top="order: two"), "order: found 'two'; allowed are one-at-a-time, together, or"),
    (
        two(top="order: 0"),
        "order: found 0; allowed are one-at-a-time, together, or a number from 1",
    ),
    (two(top="order:"), "order: found nothing; allowed are one-at-a-time, together, or a number"),
    (two(top="assign: yes"), "assign: must be fixed or nearest, found true"),
    (two(top="order: &a {b: *a}"), "order: found {b: {b: {b: {b: ...}}}}; allowed are one-at-a"),
    (two(top="name: &a [*a]"), "name: must be text, found [[[[...]]]]"),
    (
        two().replace("[3, 0]", "&a [*a, 1]"),
        "vehicle east: home_m.0: must be a number, found [[[[..., 1], 1], 1], 1]",
    ),
    (two(top="yes: 1"), "fleet: found the key true, but keys must be text (YAML reads yes, no,"),
    (two(second=", on: 1"), "vehicles, number 2: found the key true, but keys must be text (YAML"),
    (two(defaults=", off: 1"), "defaults: found the key false, but keys must be text (YAML reads"),
    (two(top="on_failure:"), "on_failure: must be continue or land-all, found nothing"),
    ("vehicles: []", "vehicles: must have at least 1 entry, found []"),
    ("vehicles: [a]", "vehicles, number 1: must have keys and values, found 'a'; add some, or"),
    (
        "vehicles: 3",
        "vehicles: must be a list (the vehicles, each with a name and home_m), found 3",
    ),
    (
        f"vehicles: [{', '.join(['{name: a, home_m: [0, 0]}'] * 33)}]",
        "vehicles: must have at most 32 entries, found 33",
    ),
    (two().replace("name: north", "name: ''"), "vehicle 1: name: found ''; allowed are at most 32"),
    (two().replace("name: north", "name: 5"), "vehicle 1: name: found 5; allowed are at most 32"),
    (two(first=", heading_deg: up"), "vehicle north: heading_deg: must be a number, found 'up'"),
    (
        two().replace("[3, 0]", "[3, 0, 0]"),
        "vehicle east: home_m: must be 2 numbers in brackets (position before take-off: x, y), "
        "found [3, 0, 0]",
    ),
    (
        two().replace("[3, 0]", "3 0"),
        "vehicle east: home_m: must be 2 numbers in brackets (position before take-off: x, y), "
        "found '3 0'",
    ),
    ("- a list", "must have keys and values, found ['a list']"),
    (two(top="separation_m: 0.1"), "separation_m: must be at least 0.2, found 0.1"),
    (two(first=", hme_m: [0, 0]"), "vehicle north: hme_m: this key is unknown; did you mean home"),
    (two(first=", safety: {fence_m: 1}"), "vehicle north: safety.fence_m: this key is unknown"),
    (two(defaults=", home_m: [0, 0]"), "defaults: home_m: this key is unknown"),
    (two(first=", target: [1]"), "vehicle north: target: must have keys and values, found [1]; "),
    (
        two(", safety: {fence_radius_m: 1}", defaults=", safety: 3"),
        "defaults: safety: must have keys and values, found 3; add some, or remove the section",
    ),
    (two(second=", profile: smi"), "vehicle east: profile: profile 'smi' not found"),
    (two(second=", uri: radio://0/80/3M/E7"), f"vehicle east: {BAD_URI}"),
    (two(second=", source: 'camra:0'"), "vehicle east: "),
    (two(second=", uri: radio://0/80/2M/E7E7E7E701"), "vehicle east: camera source sim: is no"),
    (two().replace("east", "north"), "vehicles 1 and 2 share the name north: give each "),
    (
        two(RADIO.format("01", 0), RADIO.format("01", 1).replace("//0", "//1")),
        "vehicles north and east share the address of radio://0/80/2M/E7E7E7E701 and "
        "radio://1/80/2M/E7E7E7E701: give each vehicle its own address",
    ),
    (
        two(RADIO.format("01", 0), RADIO.format("01", 1)),
        "vehicles north and east share the address of radio://0/80/2M/E7E7E7E701: give each",
    ),
    (
        two(RADIO.format("01", 0), RADIO.format("02", "/dev/video0")),
        "vehicles north and east share the camera camera:0: give each vehicle its own source",
    ),
    (two(defaults="").replace("sim}", "smi}"), "defaults: profile: profile 'smi' not found; give"),
    (two(defaults=", safety: {fence_radius_m: -1}"), "defaults: safety.fence_radius_m: must be"),
    (two(defaults=", target: none.yaml"), "defaults: target: "),
    (two(defaults=", uri: radio://0/80/3M/E7"), f"defaults: {BAD_URI}"),
    (two(defaults=", source: 'camra:0'"), "defaults: camera source 'camra:0' is unknown"),
    (
        two(", safety: {fence_radius_m: -2}", defaults=", safety: {fence_radius_m: -1}"),
        "vehicle north: safety.fence_radius_m: must be above 0, found -2",
    ),
    (
        two(RADIO.format("01", 0), RADIO.format("02", 0)),
        "vehicles north and east share the camera camera:0: give each vehicle its own source",
    ),
    (
        two(", body: cf", ", body: cf", defaults=", positioning: mocap"),
        "vehicles north and east share the motion-capture body cf: give each vehicle its own body",
    ),
    (
        two().replace(", target_m: [3.2, 0]", ""),
        "vehicle east: the position of its target is missing",
    ),
    (two().replace("home_m: [3, 0], ", ""), "vehicle east: home_m: is missing; measure the"),
    (two(second=", target: none.yaml"), "vehicle east: target: "),
    (
        two(", frame: room", defaults=", positioning: target"),
        "vehicle north: frame: is room, but with positioning by the view of the target its",
    ),
    (
        two(defaults=", frame: room, positioning: target"),
        "defaults: frame: is room, but with positioning by the view of the target north's estimate",
    ),
    (
        two(", frame: home", ", frame: home", defaults=", frame: room, positioning: mocap"),
        "vehicle north: frame: is home, but with positioning by motion capture at vicon its",
    ),
    (
        two(second=", uri: radio://0/80/2M/E7E7E7E701", defaults=", source: 'sim:'"),
        "defaults: camera source sim: is not a live camera, but radio://0/80/2M/E7E7E7E701 is a",
    ),
    (
        two(", frame: home", defaults=", positioning: mocap"),
        "vehicle north: frame: is home, but with positioning by motion capture at vicon its",
    ),
    (
        two().replace("[3, 0]", "[3000, 0]"),
        "vehicle east: home_m.0: must be at most 50, found 3000 (the unit is metres",
    ),
    ("extends: sim\n", "has no vehicles, so it is not a fleet file: list them under vehicles"),
    (two(first=", name: west"), "line 4: key name appears twice, first on line 4: keep only one"),
]


@pytest.mark.parametrize(("text", "sentence"), REFUSED, ids=[s for _, s in REFUSED])
def test_a_fault_is_one_sentence_that_names_the_vehicle(
    tmp_path: Path, text: str, sentence: str
) -> None:
    assert refusal(tmp_path, text).startswith(sentence)


def test_two_names_of_one_camera_are_one_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged = [device.ConnectedCamera(0, "FPV receiver", "/dev/v4l/by-id/usb-fpv")]
    monkeypatch.setattr(device, "_known_cameras", lambda *_: plugged)
    text = two(RADIO.format("01", 0), RADIO.format("02", "receiver"))
    words = "vehicles north and east share the camera camera:0: give each vehicle its own source"
    assert refusal(tmp_path, text) == words


def test_a_section_may_be_text_and_the_date_is_no_section(tmp_path: Path) -> None:
    fleet = load(tmp_path, two(first=", date: 2026-01-02", defaults=", positioning: target"))
    assert str(fleet.vehicles[0].profile.date) == "2026-01-02"
    assert all(vehicle.profile.positioning.source.is_target for vehicle in fleet.vehicles)


def test_the_example_of_four_real_vehicles_can_be_planned(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "swarm.md").read_text(encoding="utf-8")
    texts = re.findall(r"```yaml\n(name: lab\ndefaults.*?)```", page, re.DOTALL)
    (tmp_path / "my_vehicle.yaml").write_text("extends: crazyflie\n", encoding="utf-8")
    plan = make_plan(load(tmp_path, texts[0]))
    assert [len(dongle.vehicles) for dongle in plan.dongles] == [4]
    assert {v.profile.link.telemetry_period_s for v in plan.fleet.vehicles} == {0.03}


def test_a_fleet_that_is_missing_names_the_choices() -> None:
    with pytest.raises(
        NotFound, match=r"fleet file none.yaml does not exist; .* one of these names: 'four'$"
    ):
        load_fleet("none.yaml")
