"""`perchctl profile`: shown, its schema, and a new one, whose file equals the answers."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner, Result

from perchctl.check import Verdict, profile_rows
from perchctl.commands import app
from perchctl.commands.picture_edges import PICTURE_EDGES, edges_beside, picture_edges
from perchctl.commands.profile import QUESTIONS, Answers, Question, collect_answers, profile_keys
from perchctl.profile import Profile, find_calibration, load_profile
from perchctl.profile.keys import keys
from tests.profile.test_written import uncommented

mm = st.decimals(-299, 299, places=1).map(str)
places = st.tuples(mm, mm, mm).filter(lambda place: any(abs(float(x)) >= 1 for x in place))


def new(output: Path, *words: str, typed: str = "", **given: str) -> Result:
    """`perchctl profile new` with these answers."""
    options = [word for name, text in given.items() for word in ("--set", f"{name}={text}")]
    return CliRunner().invoke(
        app, ["profile", "new", "-o", str(output), *options, *words], input=typed
    )


def made(output: Path, *words: str, **given: str) -> Profile:
    """The profile with these answers, and the defaults of the others."""
    done = new(output, *words, "--defaults", **given)
    assert done.exit_code == 0, done.output
    return load_profile(str(output))


@st.composite
def answers(draw: st.DrawFn) -> dict[str, str]:
    """Allowed answers to all questions."""
    front = draw(st.sampled_from(sorted(PICTURE_EDGES)))
    large = draw(st.decimals(20, 400, places=1))
    simulated = draw(st.booleans())
    return {
        "uri": "sim://" if simulated else draw(st.sampled_from(["usb://0", "udp://10.0.0.1:19850"])),
        "source": draw(st.sampled_from(["camera:3", "http://h:80/a#b?c=d, e"])),
        "calibration": draw(st.sampled_from(["none", "example_640x480"])),
        "latency": str(draw(st.decimals(1, 390, places=2))),
        "front": front,
        "left": draw(st.sampled_from(edges_beside(front))),
        "camera": " ".join(draw(places)),
        "gear": ", ".join(draw(places)),
        "large": f"{large} mm",
        "small": str(draw(st.decimals(4, int(large) // 2 - 1, places=1))),
        "ceiling": str(draw(st.decimals(1, 10, places=2))),
        "fence": str(draw(st.decimals("0.3", 20, places=2))),
    }  # fmt: skip


@settings(max_examples=20, deadline=None)
@given(answers())
def test_the_file_loads_and_equals_what_was_answered(said: dict[str, str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "mine.yaml"
        mine = made(output, **said)
        assert uncommented(output.read_text(encoding="utf-8")) == []
    assert (mine.link.uri, mine.camera.source) == (said["uri"], said["source"])
    assert mine.camera.latency_s == pytest.approx(float(said["latency"]) / 1e3, abs=1e-12)
    assert find_calibration(mine.camera.calibration).name == "example_640x480.yaml"
    assert picture_edges(mine.camera.mount, mine.camera.mirrored) == (said["front"], said["left"])
    for key, found in (
        ("camera", mine.camera.mount.position_m),
        ("gear", mine.vehicle.gear_body_m),
    ):
        numbers = said[key].replace(",", " ").split()
        assert found == pytest.approx([float(number) / 1e3 for number in numbers], abs=1e-12)
    large_m, small_m = mine.target.large.side_m, mine.target.small.side_m
    assert large_m == pytest.approx(float(said["large"][:-3]) / 1e3, abs=1e-12)
    assert small_m == pytest.approx(float(said["small"]) / 1e3, abs=1e-12)
    ceiling_m = float(said["ceiling"])
    assert mine.safety.max_height_m == pytest.approx(ceiling_m + 0.4, abs=0.01)
    assert mine.planner.search.max_height_m <= ceiling_m - 0.49
    assert mine.safety.fence_radius_m == float(said["fence"])
    found, default = ({key.path: key.default for key in keys(p)} for p in (mine, type(mine)()))
    other = default.keys() - profile_keys(collect_answers(said, unasked), output).keys() - {"name"}
    assert {path: found[path] for path in other} == {path: default[path] for path in other}


def unasked(question: Question, _answers: Answers) -> None:
    pytest.fail(f"{question.name} was asked")


def test_enter_takes_every_default(tmp_path: Path) -> None:
    asked, silent = tmp_path / "asked.yaml", tmp_path / "silent.yaml"
    assert new(asked, typed="\n" * len(QUESTIONS)).exit_code == 0
    one, other = load_profile(str(asked)), made(silent)
    assert one.model_copy(update={"name": ""}) == other.model_copy(update={"name": ""})
    assert one.link.uri.startswith("radio://")


@pytest.mark.parametrize("front", sorted(PICTURE_EDGES))
def test_a_mirrored_picture_is_named(front: str, tmp_path: Path) -> None:
    plain, mirrored = edges_beside(front)
    said = new(tmp_path / "plain.yaml", "--defaults", front=front, left=plain).stderr
    assert "camera.mirrored" not in said
    said = new(tmp_path / "m.yaml", "--defaults", front=front, left=mirrored).stderr
    assert "camera.mirrored: true" in said
    assert f"front at its {front} and the left side at its {mirrored} edge" in said


def test_a_password_is_in_the_source_alone(tmp_path: Path) -> None:
    output, source = tmp_path / "mine.yaml", "rtsp://me:secret@cam/s"
    done = new(output, "--defaults", source=source)
    assert "secret" not in done.output
    assert load_profile(str(output)).camera.source == source
    assert load_profile(str(output)).description.endswith("rtsp://cam/s")


WRONG: dict[str, tuple[str, str]] = {
    "uri": ("bogus", "radio://0/80/2M"),
    "source": ("webcam", "camera:N"),
    "calibration": ("none.yaml", "give a path"),
    "latency": ("0.08", "1 to 390 ms"),
    "front": ("up", "top, right, bottom, left"),
    "left": ("bottom", "right, left"),
    "camera": ("0.03 0 0.01", "look like metres"),
    "gear": ("0 0 400", "-300 to 300 mm"),
    "large": ("15 cm", "in mm"),
    "small": ("80", "less than half"),
    "ceiling": ("0.2", "1 to 10 m"),
    "fence": ("far", "a number, in m"),
}


def test_a_wrong_answer_is_asked_again_with_what_is_allowed(tmp_path: Path) -> None:
    output = tmp_path / "mine.yaml"
    done = new(output, typed="".join(f"{WRONG[q.name][0]}\n\n" for q in QUESTIONS))
    assert done.exit_code == 0
    for question in QUESTIONS:
        assert WRONG[question.name][1] in done.stderr
    assert load_profile(str(output)).link.uri.startswith("radio://")


@pytest.mark.parametrize(("name", "text", "allowed"), [
    *((name, *wrong) for name, wrong in WRONG.items()),
    *(("source", source, "") for source in ("aideck://", "camera:", "sim:", "video:x.mp4")),
])  # fmt: skip
def test_a_wrong_option_is_refused_by_its_name_before_anything_is_asked(
    name: str, text: str, allowed: str, tmp_path: Path
) -> None:
    refused = new(tmp_path / "m.yaml", **({"uri": "usb://0"} | {name: text}))
    assert refused.exit_code == (20 if name == "calibration" else 30)
    (line,) = refused.stderr.splitlines()
    assert line.startswith(f"perchctl: --set {name}: ")
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


def test_a_calibration_is_named_from_where_the_profile_is(tmp_path: Path) -> None:
    text = find_calibration("example_640x480").read_text(encoding="utf-8")
    own = tmp_path / "calib" / "mine.yaml"
    own.parent.mkdir()
    own.write_text(f"{text}\n", encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    for place, named in (("m.yaml", "calib/mine.yaml"), ("elsewhere/m.yaml", str(tmp_path))):
        mine = made(tmp_path / place, calibration=str(own))
        assert Path(mine.camera.calibration).samefile(own)
        assert f"calibration: {named}" in (tmp_path / place).read_text(encoding="utf-8")


def test_an_aideck_gets_its_size_and_what_late_pictures_need(tmp_path: Path) -> None:
    mine = made(tmp_path / "m.yaml", uri="usb://0", source="aideck://192.168.4.1")
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


def test_profile_prints_a_schema_for_editors() -> None:
    schema = json.loads(shown("schema").stdout)
    assert set(schema["properties"]) == {"extends", *type(load_profile("sim")).model_fields}


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_the_command_shows_no_password(options: list[str], tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(
        'description: "at http://me:secret@h/s"\ncamera: {source: "http://me:secret@h/s"}\n'
    )
    result = shown("-p", str(path), *options)
    assert "http://h/s" in result.stdout
    assert "secret" not in result.output
