"""`perchctl profile`: shown, its schema, and a new one, whose file equals the answers."""

from __future__ import annotations

import itertools
import json
import re
import tempfile
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from perchctl.check import Verdict, profile_rows
from perchctl.commands import app
from perchctl.commands.profile import (
    PICTURE_EDGES,
    QUESTIONS,
    WORDS,
    front_left_edges,
    left_edges,
    profile_and_keys,
)
from perchctl.profile import Profile, find_calibration, load_profile, profile_value
from perchctl.profile.keys import keys
from tests.profile.test_written import uncommented


def new(output: Path, *words: str, typed: str = "", **given: str) -> Result:
    """`perchctl profile new` with these answers; `__` in a name stands for a dot."""
    answers = {name.replace("__", "."): text for name, text in given.items()}
    options = [word for name, text in answers.items() for word in ("--set", f"{name}={text}")]
    return CliRunner().invoke(
        app, ["profile", "new", "-o", str(output), *options, *words], input=typed
    )


def made(output: Path, *words: str, **given: str) -> Profile:
    """The profile with these answers, and the defaults of the others."""
    done = new(output, *words, "--defaults", **given)
    assert done.exit_code == 0, done.output
    return load_profile(str(output))


metres = st.decimals("-0.29", "0.29", places=4).map(str)
places = st.tuples(metres, metres, metres).map(lambda place: f"[{', '.join(place)}]")


@st.composite
def answers(draw: st.DrawFn) -> dict[str, str]:
    """Allowed answers to all questions."""
    front = draw(st.sampled_from(sorted(PICTURE_EDGES)))
    large = draw(st.decimals("0.02", "0.4", places=4))
    simulated = draw(st.booleans())
    return {
        "link.uri": "sim://" if simulated else draw(st.sampled_from(["usb://0", "udp://a.b:1"])),
        "camera.source": draw(st.sampled_from(["camera:3", "http://h:80/a#b?c=d, e"])),
        "positioning.by": draw(st.sampled_from(["deck", "mocap", "target"])),
        "camera.calibration": "example_640x480",
        "camera.latency_s": str(draw(st.decimals("0.001", "0.39", places=5))),
        "front": front,
        "left": draw(st.sampled_from(left_edges(front))),
        "camera.mount.position_m": draw(places),
        "vehicle.gear_body_m": draw(places),
        "target.large.side_m": str(large),
        "target.small.side_m": str(draw(st.decimals("0.004", str(large * 49 / 100), places=4))),
        "ceiling": str(draw(st.decimals(1, 10, places=2))),
        "safety.fence_radius_m": str(draw(st.decimals("0.3", 20, places=2))),
    }


@settings(max_examples=10, deadline=None)
@given(answers())
def test_the_file_loads_and_equals_what_was_answered(said: dict[str, str]) -> None:
    assert said.keys() == QUESTIONS.keys()
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "mine.yaml"
        given = {name.replace(".", "__"): text for name, text in said.items()}
        mine = made(output, **given)
        assert uncommented(output.read_text(encoding="utf-8")) == []
    for key in said.keys() - WORDS.keys() - {"camera.source", "camera.calibration"}:
        assert profile_value(mine, key) == yaml.safe_load(said[key])
    assert mine.camera.source == said["camera.source"]
    assert find_calibration(mine.camera.calibration).name == "example_640x480.yaml"
    assert front_left_edges(mine.camera.mount, mine.camera.mirrored) == (
        said["front"],
        said["left"],
    )
    ceiling_m = float(said["ceiling"])
    assert mine.safety.max_height_m == pytest.approx(ceiling_m + 0.4, abs=0.01)
    assert mine.planner.search.max_height_m <= ceiling_m - 0.49
    found, default = ({key.path: key.default for key in keys(p)} for p in (mine, type(mine)()))
    other = default.keys() - profile_and_keys(said, "mine")[1] - {"name"}
    # With the target as the position source, positions have other defaults.
    other -= {path for path in other if path.startswith("positioning.")}
    assert {path: found[path] for path in other} == {path: default[path] for path in other}


def test_enter_takes_every_default(tmp_path: Path) -> None:
    asked, silent = tmp_path / "asked.yaml", tmp_path / "silent.yaml"
    assert new(asked, typed="\n" * (len(QUESTIONS) + 1)).exit_code == 0
    one, other = load_profile(str(asked)), made(silent)
    assert one.model_copy(update={"name": ""}) == other.model_copy(update={"name": ""})
    assert one.link.uri.startswith("radio://")


def test_no_question_is_broken_inside_a_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    monkeypatch.setattr("perchctl.commands.profile.ask", lambda text: asked.append(text) or "")
    assert new(tmp_path / "mine.yaml").exit_code == 0
    assert len(asked) == len(QUESTIONS) + 1
    assert max(len(line) for text in asked for line in text.splitlines()) <= 80


def test_a_question_fills_its_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr("perchctl.commands.profile.ask", lambda text: asked.append(text) or "")
    assert new(tmp_path / "mine.yaml").exit_code == 0
    for text in asked[:-1]:
        *question, _default = text.splitlines()
        for line, below in itertools.pairwise(question):
            assert len(f"{line} {below.split()[0]}") > 80, text


@pytest.mark.parametrize(("typed", "allowed"), [
    ("2000", "found '2000'; allowed are 0 to 1000 ms, or the word measured"),
    ("-5 ms", "found '-5 ms'; allowed are 0 to 1000 ms"),
])  # fmt: skip
def test_a_latency_out_of_range_is_refused_in_the_unit_of_the_answer(
    typed: str, allowed: str, tmp_path: Path
) -> None:
    done = new(tmp_path / "mine.yaml", typed="\n" * 4 + f"{typed}\n" + "\n" * 10)
    assert done.exit_code == 0
    assert allowed in " ".join(done.stderr.split())


@pytest.mark.parametrize(("by", "latency_s", "told"), [
    ("deck", 0.08, ""), ("mocap", 0.08, "add system, host and body"), ("target", "measured", ""),
])  # fmt: skip
def test_the_position_source_is_asked_for(
    by: str, latency_s: float | str, told: str, tmp_path: Path
) -> None:
    done = new(tmp_path / "mine.yaml", typed="\n" + f"{by}\n" + "\n" * 12)
    assert done.exit_code == 0, done.stderr
    mine = load_profile(str(tmp_path / "mine.yaml"))
    assert (mine.positioning.by, mine.camera.latency_s) == (by, latency_s)
    assert (told or "wrote") in done.stderr + done.stdout


def test_a_section_is_refused_with_one_of_its_keys(tmp_path: Path) -> None:
    refused = new(tmp_path / "m.yaml", "--set", "positioning=deck")
    assert refused.exit_code == 30
    assert "set its keys one by one, such as positioning.by" in refused.stderr


@pytest.mark.parametrize(("confirmed", "code"), [
    ("\n", 0), ("n\n", 2), ("", 2), ("nope\nn\n", 2),
    *(pytest.param(*each, marks=pytest.mark.long) for each in (
        ("y\n", 0), ("YES\n", 0), ("No\n", 2), ("quit\n", 2), ("nope\n\n", 0),
        ("back\n\n\n", 0),
    )),
])  # fmt: skip
def test_nothing_is_written_after_a_no(confirmed: str, code: int, tmp_path: Path) -> None:
    output = tmp_path / "mine.yaml"
    done = new(output, typed="\n" * len(QUESTIONS) + confirmed)
    assert done.exit_code == code
    assert output.exists() is (code == 0)
    assert ("nothing was written" in done.stderr) is (code != 0)
    assert ("found 'nope'" in done.stderr) is ("nope" in confirmed)


@pytest.mark.parametrize("front", sorted(PICTURE_EDGES))
def test_a_mirrored_picture_is_named(front: str, tmp_path: Path) -> None:
    plain, mirrored = left_edges(front)
    said = new(tmp_path / "plain.yaml", "--defaults", front=front, left=plain).stderr
    assert "camera.mirrored" not in said
    said = new(tmp_path / "m.yaml", "--defaults", front=front, left=mirrored).stderr
    assert "camera.mirrored: true" in said
    assert f"front at its {front} and the left side at its {mirrored} edge" in said


def test_a_password_is_in_the_source_alone(tmp_path: Path) -> None:
    output, source = tmp_path / "mine.yaml", "rtsp://me:secret@cam/s"
    done = new(output, "--defaults", camera__source=source)
    assert "secret" not in done.output
    assert load_profile(str(output)).camera.source == source
    assert load_profile(str(output)).description.endswith("rtsp://cam/s")


WRONG: dict[str, tuple[str, str]] = {
    "link.uri": ("bogus", "radio://0/80/2M"),
    "positioning.by": ("flow", "allowed are deck, mocap, target; write deck"),
    "camera.source": ("webcam:0", "camera:N"),
    "camera.calibration": ("none.yaml", "give a path"),
    "camera.latency_s": ("80", "allowed are 0 to 1"),
    "front": ("up", "top, right, bottom, left"),
    "left": ("bottom", "right, left"),
    "camera.mount.position_m": ("[30, 0, 10]", "millimetres"),
    "vehicle.gear_body_m": ("0.4", "must be 3 numbers in brackets"),
    "target.large.side_m": ("15 cm", "number"),
    "target.small.side_m": ("0.08", "less than half"),
    "ceiling": ("0.2", "1 to 10 m"),
    "safety.fence_radius_m": ("far", "number"),
}


MISTYPED = WRONG | {
    "camera.latency_s": ("0.08", "too small: enter numbers in ms"),
    "camera.mount.position_m": ("0.03 0 0.01", "too small: enter numbers in mm"),
    "vehicle.gear_body_m": ("0 0 400", "allowed are -300 to 300 mm"),
    "target.large.side_m": ("15 cm", "numbers in mm"),
    "target.small.side_m": ("80", "less than half"),
    "safety.fence_radius_m": ("far", "numbers in m"),
}


def test_a_wrong_answer_is_asked_again_with_what_is_allowed(tmp_path: Path) -> None:
    output = tmp_path / "mine.yaml"
    done = new(output, typed="".join(f"{MISTYPED[name][0]}\n\n" for name in QUESTIONS) + "\n")
    assert done.exit_code == 0
    for _, allowed in MISTYPED.values():
        assert allowed in done.stderr
    assert load_profile(str(output)).link.uri.startswith("radio://")


def test_a_ruler_s_millimetres_are_written_as_metres_and_one_may_go_back(tmp_path: Path) -> None:
    output = tmp_path / "mine.yaml"
    typed = ["usb://0", "", "", "", "80", "back", "95 ms", "top", "left"]
    typed += ["31.5, 0 -4 mm", "", "180"]
    done = new(output, typed="\n".join([*typed, "", "", "", "back", "1.2", ""]) + "\n")
    assert done.exit_code == 0, done.stderr
    mine = load_profile(str(output))
    assert mine.camera.latency_s == 0.095
    assert mine.camera.mount.position_m == (0.0315, 0.0, -0.004)
    assert (mine.target.large.side_m, mine.target.small.side_m) == (0.18, 0.03)
    assert mine.safety.fence_radius_m == 1.2
    assert "picture                  mirrored, turned by" in done.stderr


@pytest.mark.parametrize("given", [True, False])
def test_a_latency_that_flights_measure_may_be_answered(tmp_path: Path, given: bool) -> None:
    output, settings = tmp_path / "mine.yaml", ["--set", "ceiling=2.4m"]
    settings += ["--set", "camera.latency_s=measured"] if given else []
    typed = "\n" * 4 + ("" if given else "measured\n") + "\n" * 8
    done = new(output, *settings, typed=typed)
    assert done.exit_code == 0, done.stderr
    assert load_profile(str(output)).camera.latency_s == "measured"
    assert re.search(r"camera.latency_s +measured\n", done.stderr)
    assert re.search(r"ceiling +2.4m\n", done.stderr)


@pytest.mark.parametrize(("file", "given"), [
    ("camera_640x480.yaml", {}), ("mine.yaml", {"camera__calibration": "calib/mine.yaml"}),
])  # fmt: skip
def test_a_calibration_that_lies_there_is_offered_and_found_from_where_the_profile_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, given: dict[str, str]
) -> None:
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "calib" / file
    own.parent.mkdir()
    own.write_bytes(find_calibration("example_640x480").read_bytes())
    (tmp_path / "elsewhere").mkdir()
    mine = made(tmp_path / "elsewhere" / "m.yaml", planner__attempts="3", **given)
    assert Path(mine.camera.calibration).samefile(own)
    assert mine.planner.attempts == 3, "any key can be given"
    made(tmp_path / "near.yaml", **given)
    assert f"calibration: calib/{file}\n" in (tmp_path / "near.yaml").read_text()


@pytest.mark.parametrize(("name", "text", "allowed"), [
    *((name, *wrong) for name, wrong in WRONG.items()), ("camera.source", "aideck://", ""),
])  # fmt: skip
def test_a_wrong_setting_is_refused_before_anything_is_asked(
    name: str, text: str, allowed: str, tmp_path: Path
) -> None:
    given = {"front": "top"} | {name.replace(".", "__"): text}
    refused = new(tmp_path / "m.yaml", **given)
    assert refused.exit_code == (20 if name == "camera.calibration" else 30)
    (line,) = refused.stderr.splitlines()
    assert allowed in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ceiling_m", ["1", "2.4", "4.1", "6", "9", "10"])
def test_a_landing_from_under_any_ceiling_has_the_time(ceiling_m: str, tmp_path: Path) -> None:
    mine = made(tmp_path / "m.yaml", ceiling=ceiling_m)
    (row,) = (row for row in profile_rows(mine) if row.name == "time limits")
    assert row.verdict is Verdict.PASS, row.found


def test_nobody_to_ask_is_one_sentence(tmp_path: Path) -> None:
    refused = new(tmp_path / "m.yaml", typed="usb://0\n", ceiling="3")
    assert refused.exit_code == 2
    assert "--defaults" in refused.stderr.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


def test_a_file_that_exists_is_kept_without_force(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text("mine")
    refused = new(path)  # before anything is asked
    assert refused.exit_code == 30
    assert len(refused.stderr.splitlines()) == 1
    assert path.read_text() == "mine"
    assert made(path, "--force").name == "m"
    assert new(tmp_path / "m.txt").exit_code == 30


def test_an_aideck_gets_its_size_and_what_late_pictures_need(tmp_path: Path) -> None:
    mine = made(tmp_path / "m.yaml", link__uri="usb://0", camera__source="aideck://192.168.4.1")
    shipped = load_profile("aideck")
    assert mine.camera.calibration == shipped.camera.calibration
    assert (mine.kalman, mine.planner.ascend) == (shipped.kalman, shipped.planner.ascend)
    assert mine.safety.max_frame_age_s == shipped.safety.max_frame_age_s


# --- perchctl profile -----------------------------------------------------------------------


def shown(*words: str) -> Result:
    result = CliRunner().invoke(app, ["profile", *words])
    assert result.exit_code == 0
    return result


def test_profile_prints_what_is_flown(tmp_path: Path) -> None:
    text = shown("-p", "crazyflie")
    (tmp_path / "again.yaml").write_text(text.stdout, encoding="utf-8")
    again = load_profile(str(tmp_path / "again.yaml"))
    assert again.planner == load_profile("crazyflie").planner
    assert "calibration file: " in text.stderr
    record = json.loads(shown("-p", "crazyflie", "--json").stdout)
    assert record["profile"]["name"] == "crazyflie"
    assert record["check"][0]["verdict"] == "warn"
