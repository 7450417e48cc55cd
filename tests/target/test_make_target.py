"""`perchctl make-target` as it is called: files, profiles, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from perchctl.commands import app
from perchctl.profile import load_profile

CAMERA = "example_640x480.yaml"


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def call(*words: str, code: int = 0) -> tuple[str, str]:
    """stdout and stderr of the command, whose exit code must be this."""
    done = CliRunner().invoke(app, ["make-target", *words])
    assert done.exit_code == code, (done.stdout, done.stderr)
    return done.stdout, done.stderr


def files() -> set[str]:
    return {path.name for path in Path().iterdir()}


def test_the_plain_call_writes_the_pdf_alone_and_twice_the_same() -> None:
    out, _ = call()
    assert "wrote target.pdf" in out
    first = Path("target.pdf").read_bytes()
    call("-o", "target.pdf", "--force")
    assert files() == {"target.pdf"}
    assert Path("target.pdf").read_bytes() == first


def test_a_board() -> None:
    out, _ = call("board", "chessboard:9x6:25mm", "-o", "board.pdf")
    assert "wrote board.pdf" in out
    assert files() == {"board.pdf"}


def test_the_profile_s_own_date_is_on_the_sheet() -> None:
    Path("mine.yaml").write_text("extends: sim\ndate: 2026-03-01\n")
    call("-p", "mine.yaml")
    assert b"D:20260301" in Path("target.pdf").read_bytes()
    call("-p", "mine.yaml", "--large", "140mm", "--force")
    assert b"D:2026" not in Path("target.pdf").read_bytes()


@pytest.mark.long
def test_the_design_and_a_suggestion_write_nothing() -> None:
    out, _ = call("design", CAMERA, "--ceiling", "2.4", "--blur", "2.0")
    assert "z1" in out
    out, _ = call("suggest", "--blur", "2", "--json")
    assert json.loads(out)["command"].startswith("perchctl make-target --large ")
    assert files() == set()


REFUSALS = [
    (["--large", "150"], 30, "has no unit; write 150mm"),
    (["--large", "1mm"], 30, "outside of 4 mm"),
    (["--small", "80mm"], 30, "less than half"),
    (["--large-id", "5000"], 30, "--large-id, --large-dict: id 5000 is outside"),
    (["--large-dict", "DICT_4X4_50"], 2, "needs --large-id"),
    (["--small", "36mm"], 30, "diagonal"),
    (["--magnet", "20mm"], 30, "not inside the magnet"),
    (["--page", "150x150mm"], 30, "--page a4 holds it"),
    (["--page", "a9"], 30, "allowed are a4, letter, a3"),
    (["-o", "target.txt"], 30, "must end in .pdf"),
    (["-o", "/dev/null/target.pdf"], 30, "/dev/null is a file, not a folder"),
    (["-p", "nothing"], 20, "profile 'nothing' not found"),
    (["board", "chessboard:9x6"], 30, "COLUMNSxROWS:SQUARE"),
    (["board", "chessboard:9x6:25mm:measured=249x174mm"], 2, "leave out :measured="),
    (["board", "chessboard:9x6:25mm", "-o", "board.txt"], 30, "must end in .pdf"),
    (["design", "nothing.yaml"], 20, "not found"),
    (["suggest", CAMERA, "--ceiling", "1"], 30, "below the highest search position"),
    (["measured", "-p", "m.yaml"], 2, "nothing was measured"),
    (["measured", "--measured-large", "149.6", "-p", "crazyflie"], 2, "-p my_vehicle.yaml"),
    (["measured", "--measured-large", "149.6", "-p", "m.yaml"], 20, "m.yaml does not exist"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "code", "said"), REFUSALS)
def test_a_refusal_is_one_sentence_and_leaves_nothing(
    words: list[str], code: int, said: str
) -> None:
    _, err = call(*words, code=code)
    assert said in err
    assert err.count("\n") == 1
    assert files() == set()


@pytest.mark.parametrize("words", [
    ("design", "--blur", "-1"), ("suggest", "--ceiling", "nan"),
    ("sheet", "--ceiling", "2.4"), ("board", "chessboard:9x6:25mm", "--large", "15cm"),
    ("suggest", "--small", "2cm"), ("measured", "--page", "a4"), ("board",),
])  # fmt: skip
def test_options_of_another_task_and_out_of_range_are_wrong_usage(words: tuple[str, ...]) -> None:
    call(*words, code=2)
    assert files() == set()


MEASURED = ("--measured-large", "149.6", "--measured-small", "24.9mm")


@pytest.mark.parametrize(
    ("size", "said"), [("0.1496", "measure what is black, in mm"), ("150in", "unit 'in'")]
)
def test_a_size_that_cannot_be_the_marker_s_is_refused(size: str, said: str) -> None:
    Path("m.yaml").write_text("extends: crazyflie\n")
    _, err = call("measured", "--measured-large", size, "-p", "m.yaml", "--force", code=30)
    assert said in err
    assert Path("m.yaml").read_text() == "extends: crazyflie\n"


PROFILES = {
    "known": "extends: sim\ntarget:\n  size_sigma: 0.01  # keep\n",
    "no side": "extends: crazyflie  # keep\ntarget:\n    large:\n        id: 16\n"
    "    small: {id: 6}\n",
}
"""Further layouts: tests/profile/test_edit.py."""


@pytest.mark.parametrize("name", PROFILES)
def test_an_existing_profile_is_changed_in_place_with_force_only(name: str) -> None:
    path = Path("mine.yaml")
    path.write_text(PROFILES[name])
    before = load_profile("./mine.yaml")
    words = ("measured", "-p", "mine.yaml", *MEASURED)
    _, err = call(*words, code=30)
    assert "--force" in err
    assert path.read_text() == PROFILES[name]
    out, err = call(*words, "--force")
    assert "mine.yaml.bak" in out + err
    after = load_profile("./mine.yaml")
    assert (after.target.large.side_m, after.target.small.side_m) == (0.1496, 0.0249)
    assert after.target.size_sigma == 0.001
    assert after.target.large.id == before.target.large.id
    assert after.model_copy(update={"target": before.target}) == before
    assert "keep" in path.read_text()
    assert files() == {"mine.yaml", "mine.yaml.bak"}
    assert Path("mine.yaml.bak").read_text() == PROFILES[name]
    call(*words, "--force")
    assert files() == {"mine.yaml", "mine.yaml.bak"}, "nothing changed, and nothing is kept twice"


def test_a_scaled_page_and_a_marker_that_was_not_measured_are_noticed() -> None:
    Path("m.yaml").write_text("extends: crazyflie\n")
    out, _ = call("measured", "-p", "m.yaml", "--measured-small", "25.1", "--force")
    assert "measure both markers" in out
    assert load_profile("./m.yaml").target.size_sigma == 0.005
    words = ("--measured-large", "145.5", "--measured-small", "24.25", "--force")
    out, _ = call("measured", "-p", "m.yaml", *words)
    assert "was the page scaled" in out
    assert "small against large: " in out


@pytest.mark.long
def test_both_ways_say_from_where_on_the_mounting_is_blind() -> None:
    out, _ = call("-p", "sim")
    assert "example_640x480.yaml: never blind (by whole markers alone: blind from 20 mm" in out
    out, _ = call("design", CAMERA)
    assert "mounting  never blind" in out
    out, _ = call("design", CAMERA, "--json")
    assert json.loads(out)["blind"]["left_m"] == 0.0


def test_a_sheet_needs_no_calibration() -> None:
    Path("mine.yaml").write_text("extends: sim\ncamera: {calibration: none_yet.yaml}\n")
    out, _ = call("-p", "mine.yaml")
    assert "blind" not in out
