"""`perchctl profile`: shown, its schema, and a new one, whose file equals the answers."""

from __future__ import annotations

import json
import os
import re
import shlex
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from perchctl.check import Verdict, profile_rows
from perchctl.commands import app
from perchctl.commands.picture_edges import PICTURE_EDGES, edges_beside, picture_edges
from perchctl.commands.profile import QUESTIONS, completed, profile_keys, write_new_profile
from perchctl.errors import Interrupted, InvalidValue, PerchError, UsageError
from perchctl.files import mode_of
from perchctl.profile import find_calibration, load_profile
from perchctl.profile.keys import keys
from tests.profile.test_written import uncommented

mm = st.decimals(-299, 299, places=1).map(str)
places = st.tuples(mm, mm, mm).filter(lambda place: any(abs(float(x)) >= 1 for x in place))


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
        "latency": str(draw(st.just(0) | st.decimals(1, 390, places=2))),
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
        write_new_profile(output, said)
        text = output.read_text(encoding="utf-8")
        mine = load_profile(str(output))
    assert uncommented(text) == []
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
    other = default.keys() - profile_keys(completed(said), output).keys() - {"name"}
    assert {path: found[path] for path in other} == {path: default[path] for path in other}


def typed(*lines: str, end: type[BaseException] = EOFError) -> Callable[[str], str]:
    """Someone at the terminal: those lines, and then the end."""
    waiting = iter(lines)

    def ask(_question: str) -> str:
        for line in waiting:
            return line
        raise end

    return ask


def test_enter_takes_every_default(tmp_path: Path) -> None:
    asked, silent = tmp_path / "asked.yaml", tmp_path / "silent.yaml"
    write_new_profile(asked, {}, typed(*[""] * len(QUESTIONS)))
    write_new_profile(silent, {})
    one, other = (load_profile(str(path)) for path in (asked, silent))
    assert one.model_copy(update={"name": ""}) == other.model_copy(update={"name": ""})
    assert one.link.uri.startswith("radio://")


@pytest.mark.parametrize("front", sorted(PICTURE_EDGES))
def test_a_mirrored_picture_is_asked_about_and_named(
    front: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain, mirrored = edges_beside(front)
    asked: list[str] = []

    def ask(question: str) -> str:
        asked.append(question)
        return ""

    given = {question.name: question.default({}) for question in QUESTIONS[:1]}
    write_new_profile(tmp_path / "asked.yaml", given | {"front": front}, ask)
    (question,) = [text for text in asked if "left side" in text]
    assert plain in question
    assert mirrored in question
    assert "mirrors" in question
    assert "camera.mirrored" not in capsys.readouterr().err

    for left in (mirrored, mirrored[0]):
        write_new_profile(tmp_path / f"{left}.yaml", {"front": front, "left": left})
        said = capsys.readouterr().err
        assert "camera.mirrored: true" in said
        assert front in said
        assert mirrored in said


def test_a_password_is_in_the_source_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output, source = tmp_path / "mine.yaml", "rtsp://me:secret@cam/s"
    write_new_profile(output, {"source": source})
    assert load_profile(str(output)).camera.source == source
    assert load_profile(str(output)).description.endswith("rtsp://cam/s")
    shown = capsys.readouterr()
    assert "secret" not in shown.out + shown.err


WRONG: dict[str, tuple[str, str]] = {
    "uri": ("bogus", "radio://0/80/2M"),
    "source": ("webcam", "camera:N"),
    "calibration": ("none.yaml", "give a path"),
    "latency": ("900", "0 to 390 ms"),
    "front": ("up", "top, right, bottom, left"),
    "left": ("bottom", "right, left"),
    "camera": ("1 2", "3 numbers, in mm"),
    "gear": ("0 0 400", "found 400 mm; allowed are -300 to 300 mm"),
    "large": ("15 cm", "in mm"),
    "small": ("80", "less than half"),
    "ceiling": ("0.2", "1 to 10 m"),
    "fence": ("far", "a number, in m"),
}


def test_a_wrong_answer_is_asked_again_with_what_is_allowed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = [line for question in QUESTIONS for line in (WRONG[question.name][0], "")]
    write_new_profile(tmp_path / "mine.yaml", {}, typed(*lines))
    said = capsys.readouterr().err
    assert max(map(len, said.splitlines()[1:3])) <= 80
    told = re.findall(r"^  \S.*$", re.sub(r"\n    (?=\S)", " ", said), re.MULTILINE)
    assert len(told) == len(QUESTIONS)
    for question, line in zip(QUESTIONS, told, strict=True):
        assert WRONG[question.name][1] in line
    assert load_profile(str(tmp_path / "mine.yaml")).link.uri.startswith("radio://")


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_option_is_one_sentence_with_its_name(name: str, tmp_path: Path) -> None:
    (question,) = (question for question in QUESTIONS if question.name == name)
    given = {"front": "top"} if name == "left" else {}
    with pytest.raises(PerchError, match=f"^{question.option}: ") as caught:
        write_new_profile(tmp_path / "m.yaml", {**given, name: WRONG[name][0]})
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"latency": "0.08"}, "--latency: found '0.08': this looks like seconds.*in ms .*80 ms"),
        ({"latency": "0.999"}, "seconds.*in ms"),
        ({"camera": "0.03 0 0.01"}, "--camera-at: .*look like metres.*in mm .*30 0 10"),
        ({"gear": "0,0,-.03"}, "--gear-at: .*look like metres.*in mm"),
        ({"camera": "0 -301 0"}, "--camera-at: found -301 mm; allowed are -300 to 300 mm"),
        ({"left": "top"}, "allowed are right, left .*--front-at top, the default"),
        ({"front": "left", "left": "left"}, "allowed are top, bottom$"),
        ({"large": "far"}, "--large: found 'far'"),
        ({"uri": "radio://0/200/2M"}, "--uri: .*channel '200'; allowed are 0 to 125"),
    ],
)
def test_a_wrong_option_says_what_was_meant(
    given: dict[str, str], said: str, tmp_path: Path
) -> None:
    with pytest.raises(InvalidValue, match=said):
        write_new_profile(tmp_path / "m.yaml", given)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("given", [{"latency": "0"}, {"latency": "1"}, {"camera": "0 0 0"}])
def test_small_and_nothing_are_taken(given: dict[str, str], tmp_path: Path) -> None:
    write_new_profile(tmp_path / "m.yaml", given)


@pytest.mark.parametrize("ceiling_m", ["1", "2.4", "4.1", "6", "9", "10"])
def test_a_landing_from_under_any_ceiling_has_the_time(ceiling_m: str, tmp_path: Path) -> None:
    write_new_profile(tmp_path / "m.yaml", {"ceiling": ceiling_m})
    mine = load_profile(str(tmp_path / "m.yaml"))
    (row,) = (row for row in profile_rows(mine) if row.name == "time limits")
    assert row.verdict is Verdict.PASS, row.found


@pytest.mark.parametrize(
    ("uri", "what_to_do"), [("usb://0", "perchctl calibrate"), ("sim://", "nothing is left to do")]
)
def test_without_a_calibration_it_says_once_which_was_written(
    uri: str, what_to_do: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = {"uri": uri, "calibration": "none"}
    write_new_profile(tmp_path / "m.yaml", said)
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "calibration" in line)
    assert "none yet: wrote example_640x480.yaml" in line
    assert what_to_do in line


@pytest.mark.parametrize(
    ("end", "kind", "code"), [(KeyboardInterrupt, Interrupted, 130), (EOFError, UsageError, 2)]
)
def test_a_dialogue_that_is_left_says_how_to_go_on(
    end: type[BaseException], kind: type[PerchError], code: int, tmp_path: Path
) -> None:
    output = tmp_path / "my own.yaml"
    with pytest.raises(kind) as caught:
        write_new_profile(output, {"gear": "0 0 31"}, typed("usb://0", "", "", "", "left", end=end))
    assert caught.value.exit_code == code
    assert not output.exists()
    words = shlex.split(str(caught.value).partition("go on from here: ")[2])
    assert words[:3] == ["perchctl", "profile", "new"]
    done = CliRunner().invoke(app, [*words[1:], "--defaults"])
    assert done.exit_code == 0, done.output
    mine = load_profile(str(output))
    assert (mine.link.uri, mine.vehicle.gear_body_m) == ("usb://0", (0.0, 0.0, 0.031))
    assert picture_edges(mine.camera.mount, mine.camera.mirrored) == ("left", "top")


def test_nobody_to_ask_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(app, ["profile", "new", "-o", "m.yaml", "--uri", "usb://0"])
    assert refused.exit_code == UsageError.exit_code
    assert re.search(r"nobody to ask .*--source.*--fence.*--defaults", refused.stderr)
    assert "--uri" not in refused.stderr


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_who_may_read_it_is_up_to_the_umask(umask: int, mode: int, tmp_path: Path) -> None:
    before = os.umask(umask)
    try:
        write_new_profile(tmp_path / "mine.yaml", {})
    finally:
        os.umask(before)
    assert mode_of(tmp_path / "mine.yaml") == mode


def test_a_file_that_exists_is_kept_without_force(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    path.write_text("mine")
    with pytest.raises(InvalidValue, match="--force"):
        write_new_profile(path, {}, typed())  # before anything is asked
    assert path.read_text() == "mine"
    write_new_profile(path, {}, force=True)
    assert load_profile(str(path)).name == "m"
    with pytest.raises(InvalidValue, match=r"\.yaml or \.yml"):
        write_new_profile(tmp_path / "m.txt", {})


def test_a_calibration_is_named_from_where_the_profile_is(tmp_path: Path) -> None:
    text = find_calibration("example_640x480").read_text(encoding="utf-8")
    (tmp_path / "calib").mkdir()
    (tmp_path / "calib" / "mine.yaml").write_text(f"{text}\n", encoding="utf-8")
    (tmp_path / "elsewhere").mkdir()
    for place, named in (("m.yaml", "calib/mine.yaml"), ("elsewhere/m.yaml", str(tmp_path))):
        said = {"calibration": str(tmp_path / "calib" / "mine.yaml")}
        write_new_profile(tmp_path / place, said)
        mine = load_profile(str(tmp_path / place))
        assert Path(mine.camera.calibration).samefile(tmp_path / "calib" / "mine.yaml")
        assert f"calibration: {named}" in (tmp_path / place).read_text(encoding="utf-8")


# --- perchctl profile -----------------------------------------------------------------------


def test_profile_prints_what_is_flown(tmp_path: Path) -> None:
    shown = CliRunner().invoke(app, ["profile", "-p", "crazyflie"])
    assert shown.exit_code == 0
    (tmp_path / "again.yaml").write_text(shown.stdout, encoding="utf-8")
    again = load_profile(str(tmp_path / "again.yaml"))
    assert again.planner == load_profile("crazyflie").planner
    assert "calibration file: " in shown.stderr
    record = json.loads(CliRunner().invoke(app, ["profile", "-p", "crazyflie", "--json"]).stdout)
    assert record["profile"]["name"] == "crazyflie"
    assert record["check"][0]["verdict"] == "warn"


def test_profile_prints_a_schema_for_editors() -> None:
    schema = json.loads(CliRunner().invoke(app, ["profile", "schema"]).stdout)
    assert set(schema["properties"]) == {"extends", *type(load_profile("sim")).model_fields}


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_the_command_shows_no_password(options: list[str], tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text(
        'description: "at http://me:secret@h/s"\ncamera: {source: "http://me:secret@h/s"}\n'
    )
    shown = CliRunner().invoke(app, ["profile", "-p", str(path), *options])
    assert shown.exit_code == 0
    assert "http://h/s" in shown.stdout
    assert "secret" not in shown.output


def test_an_aideck_gets_its_size_and_what_late_pictures_need(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = {"uri": "usb://0", "source": "aideck://192.168.4.1", "calibration": "none"}
    write_new_profile(tmp_path / "m.yaml", said)
    assert "none yet: wrote example_aideck_324x244.yaml" in capsys.readouterr().err
    mine, shipped = load_profile(str(tmp_path / "m.yaml")), load_profile("aideck")
    assert mine.camera.calibration == shipped.camera.calibration
    assert (mine.kalman, mine.planner.ascend) == (shipped.kalman, shipped.planner.ascend)
    assert mine.safety.max_frame_age_s == shipped.safety.max_frame_age_s


def test_an_aideck_without_a_host_is_refused(tmp_path: Path) -> None:
    said = {"uri": "usb://0", "source": "aideck://"}
    with pytest.raises(PerchError, match="aideck://192"):
        write_new_profile(tmp_path / "m.yaml", said)
