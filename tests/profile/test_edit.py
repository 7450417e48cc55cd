"""Numbers written into a profile: nothing else of the file changes."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from perchctl.errors import InvalidValue, NotFound
from perchctl.files import file_mode
from perchctl.places import data_folder
from perchctl.profile import load_profile, writable_profile, write_profile_values
from perchctl.profile.edit import replace_values

MEASURED = {
    "camera.mount.rpy_deg": (-0.41, 0.9, 89.62),
    "camera.latency_s": 0.0912,
    "vehicle.gear_body_m": (0.0012, -0.0003, 0.0317),
}
SHIPPED = sorted(data_folder("profiles").glob("*.yaml"))


def at(values: object, dotted: str) -> object:
    for key in dotted.split("."):
        assert isinstance(values, dict)
        values = values[key]
    return tuple(values) if isinstance(values, list) else values


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_only_the_numbers_change(path: Path) -> None:
    """All comments and all other lines of a profile stay, in their order."""
    old = path.read_text(encoding="utf-8")
    new = replace_values(old, MEASURED)
    for dotted, value in MEASURED.items():
        assert at(yaml.safe_load(new), dotted) == value
    changed = [line for line in old.splitlines() if line not in new.splitlines()]
    assert all(any(k in line for k in ("rpy_deg", "latency_s", "gear_body")) for line in changed)
    comments = [line.partition("#")[2] for line in old.splitlines() if "#" in line]
    assert [line.partition("#")[2] for line in new.splitlines() if "#" in line] == comments


LAYOUTS = {
    "block list": "camera:\n  latency_s: 0.1\n  mount:\n    rpy_deg:\n    - 0  # roll\n    - 1\n"
    "    - 90  # to the left\nvehicle: {gear_body_m: [0, 0, 0.03]}\n",
    "braces": "{camera: {mount: {}, source: 'camera:0'}, vehicle: {gear_body_m: [0, 0, 0]}}",
    "sections missing": "extends: crazyflie\nname: mine",
    "keys missing": "extends: crazyflie\ncamera: # mine\n    # receiver\n    source: camera:1\n",
    "many languages": "extends: sim\ndescription: D\u00fcsen \U0001f681 \u98db\n"
    "camera: {latency_s: 1.0e-2}\n",
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_every_layout_takes_them(name: str) -> None:
    old = LAYOUTS[name]
    new = replace_values(old, MEASURED)
    assert replace_values(new, MEASURED) == new
    kept = [line.partition("#")[2] for line in old.splitlines() if "#" in line]
    assert [line.partition("#")[2] for line in new.splitlines() if "#" in line] == kept


def test_an_alias_is_not_written_through() -> None:
    """The anchor's number is another key's too, which stays as it is."""
    shared = "camera: {latency_s: &late 0.1}\nsimulation: {camera_jitter_s: *late}\n"
    behind = "kalman: {k1: &late 0.1}\ncamera: {latency_s: *late}\n"
    for text, other in ((shared, "simulation.camera_jitter_s"), (behind, "kalman.k1")):
        values = yaml.safe_load(replace_values(text, {"camera.latency_s": 0.09}))
        assert (at(values, "camera.latency_s"), at(values, other)) == (0.09, 0.1)
    lists = "camera: {mount: {rpy_deg: &same [0, 0, 1]}}\nplanner: {unread: *same}\n"
    with pytest.raises(ValueError, match="layout"):
        replace_values(lists, {"camera.mount.rpy_deg": (0.0, 0.0, 2.0)})


def test_the_old_file_is_kept_beside_and_never_lost(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: crazyflie\ncamera:\n  latency_s: 0.1  # a guess\n", encoding="utf-8")
    first = path.read_text(encoding="utf-8")
    asides = [write_profile_values(path, {"camera.latency_s": number}) for number in (0.09, 0.08)]
    assert [aside.name for aside in asides] == ["mine.yaml.bak", "mine.yaml.bak2"]
    assert asides[0].read_text(encoding="utf-8") == first
    assert asides[1].read_text(encoding="utf-8") == first.replace("0.1  #", "0.09 #")
    assert load_profile(str(path)).camera.latency_s == 0.08


def test_what_cannot_be_written_says_the_numbers(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    text = "camera: 7\n"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InvalidValue, match=r"mine.yaml: .*by hand.*camera.latency_s: 0.09$"):
        write_profile_values(path, {"camera.latency_s": 0.09})
    assert path.read_text(encoding="utf-8") == text
    assert [p.name for p in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.mark.parametrize(("values", "fault"), [
    ({"camera.latency_s": 0.16}, r"camera\.latency_s.*safety\.max_frame_age_s"),
    ({"vehicle.gear_body_m": (0.0, 0.0, 0.31)}, r"vehicle\.gear_body_m.*0\.31"),
])  # fmt: skip
def test_a_profile_that_would_not_load_is_left_as_it_was(
    tmp_path: Path, values: dict[str, float], fault: str
) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: base.yaml\nsafety: {max_frame_age_s: 0.15}\n", encoding="utf-8")
    (tmp_path / "base.yaml").write_text("extends: crazyflie\n", encoding="utf-8")
    assert load_profile(str(path)).camera.latency_s < 0.15
    before = {file: file.read_bytes() for file in tmp_path.iterdir()}
    (dotted,) = values
    with pytest.raises(InvalidValue, match=rf"would be invalid.*{fault}.*by hand.*{dotted}: "):
        write_profile_values(path, values)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_permissions_stay_and_the_old_text_is_for_the_same_eyes(tmp_path: Path) -> None:
    """An old key is not said again: the tests make a warning an error."""
    path = tmp_path / "mine.yaml"
    for mode in (0o600, 0o664):
        path.write_text("extends: sim\nplanner: {ascend: {near_m: 0.35}}\n", encoding="utf-8")
        path.chmod(mode)
        aside = write_profile_values(path, {"camera.latency_s": 0.09})
        assert (file_mode(path), file_mode(aside)) == (mode, mode)


def test_a_read_only_or_a_shipped_profile_is_not_written_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, link = tmp_path / "own.yaml", tmp_path / "mine.yaml"
    path.write_text("extends: crazyflie\n", encoding="utf-8")
    link.symlink_to(data_folder("profiles") / "sim.yaml")
    for name in ("sim", str(data_folder("profiles") / "crazyflie.yaml"), str(link)):
        with pytest.raises(InvalidValue, match=r"shipped.*cp .*yaml my_.*-p my_"):
            writable_profile(name)
    with pytest.raises(NotFound):
        writable_profile("no_such")
    assert writable_profile(str(path)) == path
    monkeypatch.setattr("os.access", lambda place, _mode: Path(place) != path)  # root may always
    with pytest.raises(InvalidValue, match=r"own\.yaml is read-only.*chmod u\+w .*-p"):
        writable_profile(str(path))
