"""What commands write: one rule for what is there already, for folders, and for names."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.errors import InvalidValue
from tests.helpers.commands import elsewhere, run, run_apart  # noqa: F401
from tests.helpers.flights import ROOT
from tests.helpers.recording import write_pictures
from tests.helpers.weights_data import known
from tests.helpers.weights_data import write as write_session

WRITING = [
    ["calibrate", "images:.", "-o", "OUT.yaml"],
    ["calibrate", "convert", str(ROOT / "calib/example_640x480.yaml"), "-o", "OUT.yaml"],
    ["calibrate", "mask", "images:.", "-o", "OUT.png"],
    ["make-target", "-o", "OUT.pdf"],
    ["make-target", "board", "chessboard:9x6:20mm", "-o", "OUT.pdf"],
    ["make-target", "measured", "--measured-large", "150", "-o", "OUT.yaml"],
    ["track", "images:.", "--csv", "OUT.csv"],
    ["track", "images:.", "--overlay", "OUT.mp4"],
    ["fit-weights", "session.csv", "-o", "OUT.yaml"],
]


"""Each way to write a file, which is refused before there is anything to work on."""


@pytest.mark.parametrize("words", WRITING, ids=lambda words: f"{words[0]} {words[-2]}")
def test_one_rule_for_what_is_there_already(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name = words[-1].replace("OUT", "mine")
    words = [*words[:-1], name]
    Path(name).write_text("mine")
    said = run(*words)
    assert said.code == InvalidValue.exit_code
    assert said.complaint == f"{name} exists already; add --force to replace it, or name another"
    assert Path(name).read_text() == "mine"
    assert "exists already" not in run(*words, "--force").stderr
    inside = [*words[:-1], f"{name}/inside/{name}"]
    Path(name).write_text("mine")
    assert "is a file, not a folder" in run(*inside).complaint
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "convert", str(ROOT / "calib/example_640x480.yaml"), "-o", "OUT.yaml"],
        ["make-target", "board", "chessboard:9x6:20mm", "-o", "OUT.pdf"],
        ["make-target", "measured", "--measured-large", "150", "-o", "OUT.yaml"],
        ["track", "images:pictures", "--stills", "--csv", "OUT.csv"],
        ["fit-weights", "session.csv", "-o", "OUT.yaml"],
    ],
    ids=lambda words: f"{words[0]} {words[-2]}",
)
def test_one_rule_for_folders(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if words[0] == "fit-weights":
        write_session(known(positions=4, per=20), Path("session.csv"))
    if words[0] == "track":
        write_pictures(Path("pictures"))
    place = Path(words[-1].replace("OUT", "made/new/out"))
    said = run(*words[:-1], str(place))
    assert said.code == 0, said.stderr
    assert [path.name for path in place.parent.iterdir()] == [place.name]


@pytest.mark.parametrize("name", ["d3.png", "camera", "camera.txt"])
def test_a_calibration_is_not_named_like_its_report(name: str, tmp_path: Path) -> None:
    said = run("calibrate", "images:.", "-o", str(tmp_path / name), "--force")
    assert said.code == InvalidValue.exit_code
    assert "must end in .yaml or .yml" in said.complaint
    assert "report goes beside it as .png" in said.complaint
    assert list(tmp_path.iterdir()) == []
