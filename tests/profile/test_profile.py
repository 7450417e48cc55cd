"""Profiles: found, merged, checked, and refused in one sentence."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

import perchctl
from perchctl.calibration import load_calibration
from perchctl.errors import InvalidValue, Note, NotFound, ProfileNote
from perchctl.places import file_names
from perchctl.plain_yaml import value_text
from perchctl.profile import (
    PositioningConfig,
    Profile,
    SimulationConfig,
    apply_settings,
    find_calibration,
    load_profile,
)
from perchctl.record import FlightLog
from perchctl.sim import scenario


def test_shipped_profiles_are_listed_and_load() -> None:
    names = file_names("profiles")
    assert {"sim", "paper", "crazyflie", "fpv", "aideck", "rough", "extreme"} <= set(names)
    assert [load_profile(name).name for name in names] == names


def test_paper_constants() -> None:
    """Sections II-A and III-B of the paper."""
    paper = load_profile("paper")
    assert (paper.target.large.dictionary, paper.target.large.id) == ("DICT_4X4_1000", 997)
    assert (paper.target.small.dictionary, paper.target.small.id) == ("DICT_ARUCO_ORIGINAL", 5)
    assert (paper.target.large.side_m, paper.target.small.side_m) == (0.150, 0.025)
    assert (paper.kalman.alpha, paper.kalman.n_max) == (0.85, 8)
    weights = paper.merge.weights
    assert (weights.x, weights.y, weights.z, weights.yaw) == (0.275, 0.306, 0.728, 0.469)
    assert (paper.merge.z2_m, paper.merge.z3_m) == (0.25, 0.12)
    assert paper.merge.method == "weights"
    assert load_calibration(find_calibration(paper.camera.calibration)).size_px == (640, 480)


def _refusal(tmp_path: Path, text: str) -> str:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InvalidValue) as caught:
        load_profile(str(path))
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("planer: {}", ["planer", "unknown", "extends", "planner"]),
        ("kalman: {alfa: 0.85}", ["kalman.alfa", "unknown", "alpha"]),
        ("safety: {corridor: {home_m: [0, 0], target_m: [0, 0], radius_m: 1, way_top_m: 1, "
         "target_top_m: 3, width_m: 2}}", ["safety.corridor.width_m", "unknown", "radius_m"]),
        ("target: {large: {dictionary: DICT_4X4_100, id: 997, side_m: 0.15}}",
         ["target.large", "997", "0 to 99"]),
        ("target: {large: {dictionary: DICT_4X4_1000, id: 1000, side_m: 0.15}}",
         ["0 to 999"]),
        ("target: {large: {dictionary: DICT_9X9, id: 1, side_m: 0.15}}",
         ["DICT_9X9", "unknown", "DICT_4X4_1000"]),
        ("target: {large: {dictionary: DICT_4X4_1000, id: 997, side_m: 150}}",
         ["target.large.side_m", "150", "millimetres"]),
        ("kalman: {alpha: high}", ["kalman.alpha", "'high'"]),
        ("kalman: {alpha: .nan}", ["kalman.alpha", "finite"]),
        ("simulation: {ceiling_z_m: [2.6, 1.8]}", ["simulation.ceiling_z_m", "2.6", "1.8"]),
        ("planner: {search: {max_height_m: 9}}", ["planner.search.max_height_m"]),
        ("vehicle: {gear_body_m: [0, 0, 3]}",
         ["vehicle.gear_body_m.2", "0.3, found 3 (the unit is metres"]),
        ("vehicle: {gear_body_m: 0.03}",
         ["gear_body_m: must be 3 numbers in brackets (", "left, up), found 0.03"]),
        ("vehicle: {gear_body_m: [0, 0.1]}",
         ["gear_body_m: must be 3 numbers", "left, up), found [0, 0.1]"]),
        ("planner: {approach_xy_m: [1, 2, 3]}",
         ["approach_xy_m: must be 2 numbers in brackets", "found [1, 2, 3]"]),
        ("simulation: {mass_kg: 0.04}", ["mass_kg: must be 2 numbers in brackets", "found 0.04"]),
        ("camera: {mount: {position_m: [-30, 0, 0]}}", ["camera.mount.position_m.0", "-30"]),
        ("camera: {mount: {rpy_deg: [0, 0, 1.5708]}}",
         ["camera.mount.rpy_deg", "found 1.5708", "90 degrees in radians", "write 90"]),
        ("camera: {mount: {rpy_deg: [3.14, 0, -0.785]}}", ["found 3.14", "write 180"]),
        *((f"camera: {{latency_s: {value}}}",
           ["camera.latency_s", f"found {found};", "0 to 1 (seconds)", "the word measured"])
          for value, found in [("80", "80"), ("-0.1", "-0.1"), ("auto", "'auto'"),
                               ("null", "nothing"), (".nan", "nan")]),
        *((f"camera: {{format: {value}}}",
           ["camera.format", f"found {found}"])
          for value, found in [("4", "4"), ("mjpeg", "'mjpeg'"), ("[MJPG]", "['MJPG']")]),
        ("target: {small: {dictionary: DICT_4X4_1000, id: 997, side_m: 0.025}}",
         ["target", "the same marker", "DICT_4X4_1000/997", "another id"]),
        ("target: {large: {dictionary: DICT_4X4_50, id: 5, side_m: 0.15}, "
         "small: {dictionary: DICT_4X4_250, id: 5, side_m: 0.025}}",
         ["target", "the same marker", "DICT_4X4_50/5 and DICT_4X4_250/5", "another id"]),
        ("kalman: {k1: 1}\nmerge: {}\nkalman: {k2: 1}", ["line 3", "kalman", "line 1", "only one"]),
        ("kalman: {k1: 1,\n  k1: 2}", ["line 2", "k1 appears twice"]),
        ("planner: {takeoff_height_m: yes}", ["planner.takeoff_height_m", "yes", "a number"]),
        ("planner: {approach_xy_m: [off, 1]}", ["planner.approach_xy_m", "a number"]),
        ("link: {parameters: {a.b: on}}", ["link.parameters", "a number"]),
        *(
            (f"link: {{parameters: {{{name}: 1}}}}", ["link.parameters", name, "would turn motors"])
            for name in ("motorPowerSet.enable", "health.startPropTest", "health.startBatTest")
        ),
        ("", ["empty", "extends: sim"]),
        ("# only a remark\n", ["empty"]),
        ("camera:\nkalman: {}", ["camera: must have keys and values, found nothing; "]),
        ("kalman: {alpha: high}", ["kalman.alpha: must be a number, found 'high'"]),
        ("kalman: {n_max: 0.5}", ["kalman.n_max: must be a whole number, found 0.5"]),
        ("kalman: {noise: null}", ["kalman.noise: must be fixed or measured, found nothing"]),
        ("camera: {mirrored: 7}", ["camera.mirrored: must be true or false, found 7"]),
        ("camera: {source: 7}", ["camera.source: must be text, found 7: put it in quotes"]),
        ("camera: {yes: 1}", ["camera: found the key true, but keys must be text (YAML reads yes"]),
        ("off: 1", ["yaml: profile: found the key false, but keys must be text (YAML reads yes"]),
        ("safety: {2: 1}", ["safety: found the key 2, but keys must be text: put it in quotes"]),
        ("link: {parameters: {on: 1}}", ["link.parameters: found the key true, but keys must be"]),
        ("camera: {source: {no: [on]}}", ["must be text, found {false: [true]}"]),
        ("kalman: {alpha: 0x1" + 4000 * "0" + "}", ["must be a number, found 0x1000"]),
        ("camera: &a [*a]", ["camera: must have keys and values, found [[[[...]]]]; add some"]),
        ("name: &a {b: [*a]}", ["name: must be text, found {b: [{b: [...]}]}"]),
        ("link: {parameters: &a {b: *a}}", ["link.parameters.b: must be a number, found {b: {b:"]),
        ("camera: {format: 7x}", ["format: found '7x'; allowed here: pixel format to request"]),
        ("date: 5", ["date: must be a date, as in 2026-01-31, found 5"]),
        ("safety: {fence_radius_m: 60}", ["fence_radius_m: must be at most 50, found 60 (the"]),
        ("link: {parameters: {a.b: x}}", ["link.parameters.a.b: must be a number, found 'x'"]),
        ("simulation: {neighbours: [[1, 2]]}", ["neighbours.0: must be 3 numbers in brackets"]),
        ("link: {unreported: battery}", ["link.unreported: must be a list (", "found 'battery'"]),
        ("target: {large: {id: 145}}", ["large.dictionary: is missing; add it (and 1 more error)"]),
        ("date: 2024-13-45", ["month"]),
        pytest.param("a: " + "[" * 3000, ["nested too deeply"], marks=pytest.mark.long),
        ("- a list", ["must have keys and values, found ['a list']"]),
        ("kalman: {alpha: 0.85", ["line", "YAML"]),
        (
            "target: {expected_xy_m: [400, -1200]}\n",
            ["target.expected_xy_m", "50", "the unit is metres, not millimetres or centimetres"],
        ),
        (
            "target: {expected_within_m: 0.2}\n",
            ["target", "expected_within_m is set, but expected_xy_m is not"],
        ),
    ],
)  # fmt: skip
def test_faults_are_one_sentence(tmp_path: Path, text: str, expected: list[str]) -> None:
    message = _refusal(tmp_path, text)
    for word in expected:
        assert word in message


def test_a_value_is_written_out_only_as_far_as_a_message_shows_it(tmp_path: Path) -> None:
    """By its aliases, a file of a few lines can have a value of many megabytes."""

    class NeverShown:
        def __repr__(self) -> str:
            pytest.fail("this is far beyond the end of the message")

    values = [*[1] * 60, NeverShown()], {**dict.fromkeys(range(60)), 60: NeverShown()}
    for value in values:
        text = value_text(value)
        assert (len(text), text[-3:]) == (60, "...")
    message = _refusal(tmp_path, "name: [&a [[7]], &b [*a], [*b, *b]]")
    assert "name: must be text, found [[[7]], [[[7]]], [[[...]], [[...]]]]" in message


def test_a_latency_is_a_time_or_measured(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("camera: {latency_s: measured}")
    camera = load_profile(str(path)).camera
    assert (camera.latency_s, camera.start_latency_s) == ("measured", 0.1)
    assert camera.model_validate(camera.model_dump(mode="json")) == camera
    path.write_text("camera: {latency_s: 0.05}")
    assert load_profile(str(path)).camera.start_latency_s == 0.05


@pytest.mark.parametrize("text", [
    *(f"camera: {{mount: {{rpy_deg: {angles}}}}}"  # measured, and no radians
      for angles in ("[0.3, -1.57, 90.2]", "[0, 0, 1.56]", "[0, 180, -45]")),
    "vehicle: {gear_body_m: &here [0.01, 0, 0.02]}\ncamera: {mount: {position_m: *here}}\n",
    "camera: {mirrored: yes}\nlog: {plot: off}\n",
])  # fmt: skip
def test_what_could_be_mistaken_is_taken(tmp_path: Path, text: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    mine = load_profile(str(tmp_path / "mine.yaml"))
    if "here" in text:
        assert mine.vehicle.gear_body_m == mine.camera.mount.position_m == (0.01, 0, 0.02)
    if "yes" in text:
        assert (mine.camera.mirrored, mine.log.plot) == (True, False)


def test_missing_profile_names_the_choices(tmp_path: Path) -> None:
    with pytest.raises(NotFound, match="sim"):
        load_profile("smi")
    with pytest.raises(NotFound, match="does not exist"):
        load_profile(str(tmp_path / "none.yaml"))


def test_extends_takes_the_rest_from_another_profile_but_not_in_a_circle(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: paper\nkalman: {n_max: 5}\n")
    mine, paper = load_profile(str(path)), load_profile("paper")
    assert (mine.kalman.n_max, mine.kalman.alpha) == (5, paper.kalman.alpha)
    assert mine.merge == paper.merge
    assert mine.name == "mine"
    (tmp_path / "a.yaml").write_text("extends: b.yaml\n")
    (tmp_path / "b.yaml").write_text("extends: a.yaml\n")
    with pytest.raises(InvalidValue, match="refers back"):
        load_profile(str(tmp_path / "a.yaml"))


# --- keys and logs of earlier versions, and the harder worlds ----------------------------


@pytest.mark.parametrize(("text", "words"), [
    ("planner: {ascend: {near_m: 0.35}}", r"planner\.ascend\.near_m .* it is 0\.35"),
    ("planner: {recover: {timeout_s: 6}}", r"timeout_s is no longer a key"),
])  # fmt: skip
def test_a_key_that_is_a_constant_is_named(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "old.yaml").write_text(f"extends: sim\nname: sim\n{text}\n")
    with pytest.warns(ProfileNote, match=words):
        old = load_profile(str(tmp_path / "old.yaml"))
    assert old == load_profile("sim")


@pytest.mark.parametrize(("key", "value", "words"), [
    ("planner.ascend.near_m", "0.5", r"near_m.*0\.35.*but 0\.5 here"),
    ("simulation.capture_delay_s", "0.02", r"capture_delay_s.*0\.01.*but 0\.02 here"),
])  # fmt: skip
def test_another_value_of_a_constant_is_refused(
    tmp_path: Path, key: str, value: str, words: str
) -> None:
    *sections, name = key.split(".")
    opened, closed = "".join(f"{section}: {{" for section in sections), "}" * len(sections)
    (tmp_path / "old.yaml").write_text(f"extends: sim\n{opened}{name}: {value}{closed}\n")
    with pytest.raises(InvalidValue, match=words):
        load_profile(str(tmp_path / "old.yaml"))
    with pytest.raises(InvalidValue, match=rf"--set: {re.escape(key)} is no longer"):
        apply_settings(load_profile("sim"), [f"{key}={value}"])


@pytest.mark.parametrize(("key", "value", "words"), [
    ("planner.attemps", 2, "did you mean attempts"),
    ("planer.attempts", 2, "planer is unknown; did you mean planner"),
    ("camera.latency_s.x", 2, "latency_s is no section"),
    ("planner.attempts", -1, "planner.attempts: .*found -1"),
    ("planner", {"attempts": 2}, "planner is a section"),
    ("planner.search.max_height_m", 9, "the search would climb"),
])  # fmt: skip
def test_other_values_are_checked_as_the_file_s_are(key: str, value: object, words: str) -> None:
    sim = load_profile("sim")
    assert sim.with_({"planner.attempts": 2, "link.parameters": {"a.b": 1}}) == apply_settings(
        sim, ["planner.attempts=2", "link.parameters={a.b: 1}"]
    )
    with pytest.raises(InvalidValue, match=words):
        sim.with_({key: value})


def test_another_positioning_brings_its_own_defaults() -> None:
    sim = load_profile("sim")
    by_target = sim.with_({"positioning.by": "target", "positioning.rate_hz": 25.0})
    assert by_target.positioning == PositioningConfig(by="target", rate_hz=25.0)
    assert by_target.with_({"positioning.by": "deck"}).positioning == PositioningConfig()


def test_a_profile_in_an_old_log_is_read() -> None:
    """It holds every key, also of the world in which was flown."""
    values = load_profile("sim").model_dump(mode="json")
    values["simulation"] |= {"set": "extreme", "gust_mps": [0.2, 0.6], "drift_xyz_mps": None}
    values["planner"]["ascend"]["near_m"] = 0.35
    assert Profile.constant_key_errors(values) == []
    values["planner"]["ascend"]["near_m"] = 0.5
    log = FlightLog(Path("f.jsonl"), {"profile": values}, [], [], None, True)
    with pytest.warns(Note, match=r"planner\.ascend\.near_m"):
        assert log.flown_profile == load_profile("sim")


@pytest.mark.parametrize("name", ["rough", "extreme"])
def test_a_harder_world_is_sim_in_all_else(name: str) -> None:
    """It settles less exactly there."""
    sim, world = load_profile("sim"), load_profile(name)
    assert world.simulation != sim.simulation == SimulationConfig()
    assert world.planner.ascend.settle_xy_m > sim.planner.ascend.settle_xy_m
    own = ("name", "description", "simulation", "planner")
    assert sim == world.model_copy(update={key: getattr(sim, key) for key in own})
    ascend = world.planner.ascend.model_copy(update={"settle_xy_m": sim.planner.ascend.settle_xy_m})
    assert world.planner.model_copy(update={"ascend": ascend}) == sim.planner


@pytest.mark.parametrize("values", [
    {"neighbour_ids": [1000, 5]}, {"neighbour_ids": [997, -1]},
    {"radio_loss": (0.0, 0.9)}, {"radio_burst_s": (0.0, 0.1)}, {"target_tilt_deg": (3.0, 1.0)},
    {"cell_charge": (0.0, 1.0)},
], ids=str)  # fmt: skip
def test_a_world_that_cannot_be_is_refused(values: dict[str, Any]) -> None:
    with pytest.raises(ValidationError, match=next(iter(values))):
        Profile.model_validate({"simulation": values})


# --- the files that a profile names ------------------------------------------------------


def test_a_profile_s_paths_are_from_its_folder_and_from_nowhere_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of those names in the folder where perchctl is called are other files."""
    there, here = tmp_path / "there", tmp_path / "here"
    for folder in (there / "lens", here / "lens"):
        folder.mkdir(parents=True)
    (there / "base.yaml").write_text(
        "camera: {calibration: lens/mine.yaml, mask: gear.png}\nmerge: {weights_file: w.yaml}\n"
    )
    (here / "heir.yaml").write_text("extends: ../there/base.yaml\n")
    text = find_calibration("example_640x480").read_text(encoding="utf-8")
    for name in ("lens/mine.yaml", "gear.png", "w.yaml"):
        (here / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(here)
    heir = load_profile("heir.yaml", with_weights=False)
    assert heir.camera.calibration == str(there / "lens/mine.yaml")
    assert heir.camera.mask == str(there / "gear.png")
    assert heir.merge.weights_file == str(there / "w.yaml")
    with pytest.raises(NotFound, match=r"there/lens/mine\.yaml not found"):
        find_calibration(heir.camera.calibration)
    (there / "lens" / "mine.yaml").write_text(text, encoding="utf-8")
    assert find_calibration(load_profile("heir.yaml", with_weights=False).camera.calibration)
    (here / "none.yaml").write_text("extends: base.yaml\n")
    monkeypatch.chdir(there)
    with pytest.raises(NotFound, match=r"here/none\.yaml: extends: profile file"):
        load_profile("../here/none.yaml")


# --- every key is read by something ------------------------------------------------------


def keys_of(model: type[BaseModel], name: str = "profile") -> Iterator[tuple[str, str]]:
    """(section's name, key) of every value."""
    for key, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield from keys_of(kind, key)
        else:
            yield name, key


@cache
def attributes_read() -> set[tuple[str, str]]:
    """Every ``name.key`` and ``x.name.key`` in the package's code, and what is drawn by its name:
    ``between("key")``, or copied by its name (`_AS_GIVEN` and `_DRAWN` of the scenario)."""
    by_name = (*scenario._AS_GIVEN, *scenario._DRAWN)
    found: set[tuple[str, str]] = {("simulation", key) for key in by_name}
    for path in Path(perchctl.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "between":
                found |= {("simulation", a.value) for a in node.args if isinstance(a, ast.Constant)}
            if isinstance(node, ast.Attribute):
                owner = node.value
                if isinstance(owner, ast.Attribute):
                    found.add((owner.attr, node.attr))
                elif isinstance(owner, ast.Name):
                    found.add((owner.id, node.attr))
    return found


ALIASES = {
    "profile": ("config",), "camera": ("config",), "detector": ("config",), "pose": ("config",),
    "kalman": ("config",),
    "merge": ("config",), "weights": ("weights",), "large": ("large", "config", "old"),
    "small": ("small", "config", "old"), "mount": ("self",), "simulation": ("ranges", "sim"),
    "link": ("_config",), "landing": ("landing_config",), "positioning": ("config", "_config"),
}  # fmt: skip
"""By what other names the code holds a section."""


@pytest.mark.parametrize(("section", "key"), sorted(set(keys_of(Profile))))
def test_each_key_is_read_by_something(section: str, key: str) -> None:
    """A key that nothing reads is a promise that nothing keeps."""
    read = attributes_read()
    names = (section, *ALIASES.get(section, ()))
    assert any((name, key) in read for name in names), f"nothing reads {section}.{key}"
