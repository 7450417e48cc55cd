"""`perchctl fit-weights`: weights out, and the flight that uses them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import pytest
import yaml
from typer.testing import CliRunner

from perchctl.commands import app
from perchctl.errors import InvalidValue
from perchctl.profile import load_profile
from tests.helpers.fit_weights import run
from tests.helpers.weights_data import BEST, independent, known, write


def test_one_object_with_every_method(session: Path, tmp_path: Path) -> None:
    other = write(independent(2), tmp_path / "other.csv")
    done = run(session, "--json", "--test", other)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    for name in ("lms", "closed_form", "inverse_variance"):
        assert set(found[name]) == {"x", "y", "z", "yaw"}
        assert {"x", "y", "z", "yaw"} <= set(found["errors"][name])
    assert {"large", "small", "paper"} <= set(found["errors"])
    assert found["recommended"] == found["closed_form"]
    assert found["data"]["positions"] == 10


def test_the_known_weights_come_back_through_the_file(tmp_path: Path) -> None:
    found = json.loads(run(write(known(2), tmp_path / "k.csv"), "--json").stdout)
    for axis, best in zip(("x", "y", "z", "yaw"), BEST, strict=True):
        assert found["closed_form"][axis] == pytest.approx(best, abs=0.005)
        assert found["lms"][axis] == pytest.approx(found["closed_form"][axis], abs=0.01)


@pytest.mark.long
def test_weights_go_to_a_file_and_from_there_into_a_flight(session: Path, tmp_path: Path) -> None:
    out, plot = tmp_path / "w.yaml", tmp_path / "w.png"
    first = run(session, "-o", out, "--plot", plot)
    assert first.exit_code == 0, first.output
    assert "Tables I and II" in first.stdout
    assert cv2.imread(str(plot)).shape[0] > 500
    written = yaml.safe_load(out.read_text())
    assert len(written["data"]["sha256"]) == 64
    refused = run(session, "-o", out, "--method", "lms")
    assert refused.exit_code == 30
    assert refused.stdout == ""
    assert "w.yaml exists already; add --force" in refused.stderr
    assert run(session, "-o", out, "--method", "lms", "--force").exit_code == 0
    assert yaml.safe_load(out.read_text()) != written
    (tmp_path / "mine.yaml").write_text(
        "extends: paper\nmerge: {method: weights, weights_file: w.yaml}\n", encoding="utf-8"
    )
    again = yaml.safe_load(out.read_text())
    profile = load_profile(str(tmp_path / "mine.yaml"))
    assert profile.merge.weights.model_dump() == pytest.approx(again["weights"])
    plan = CliRunner().invoke(app, ["fly", "-p", str(tmp_path / "mine.yaml"), "--dry-run"])
    assert again["date"] in plan.stdout
    assert again["data"]["sha256"][:12] in plan.stdout


def test_the_profile_s_own_file_is_where_they_go(session: Path, tmp_path: Path) -> None:
    profile = tmp_path / "mine.yaml"
    profile.write_text("extends: paper\nmerge: {weights_file: fitted.yaml}\n", encoding="utf-8")
    with pytest.raises(Exception, match=r"weights_file: /.*/fitted\.yaml does not exist"):
        load_profile(str(profile))
    assert run(session, "-p", profile).exit_code == 0
    written = (tmp_path / "fitted.yaml").read_text()
    again = run(session, "-p", profile, "--method", "lms")
    assert again.exit_code == 0
    assert "recommended" in again.stdout
    assert "fitted.yaml exists already and stays as it is; add --force" in again.stderr
    assert (tmp_path / "fitted.yaml").read_text() == written
    (tmp_path / "heir.yaml").write_text(f"extends: {profile}\n", encoding="utf-8")
    for name in ("mine.yaml", "heir.yaml"):
        assert load_profile(str(tmp_path / name)).merge.weights.x == pytest.approx(0.8, abs=0.05)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("weights: {x: 2, y: 0, z: 0, yaw: 0}", "weights.x"),
        ("weights: {x: 0.5, y: 0, z: 0}", "weights.yaw is missing"),
        ("date: today", "weights"),
        ("- 1", "keys and values"),
    ],
)
def test_a_bad_weights_file_is_one_sentence(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "w.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "p.yaml").write_text("merge: {weights_file: w.yaml}\n", encoding="utf-8")
    with pytest.raises(InvalidValue, match=r"w\.yaml") as raised:
        load_profile(str(tmp_path / "p.yaml"))
    assert said in str(raised.value)


def test_weights_that_do_not_help_are_not_written(tmp_path: Path) -> None:
    data = write(independent(3, small=(0.5, 0.5, 0.5, 0.5)), tmp_path / "s.csv")
    refused = run(data, "-o", tmp_path / "w.yaml")
    assert refused.exit_code == 1
    assert "not written" in refused.stderr
    assert not (tmp_path / "w.yaml").exists()
    assert run(data, "-o", tmp_path / "w.yaml", "--anyway").exit_code == 0
    assert json.loads(run(data, "--json").stdout)["recommended"] is None
    told = run(data, "-o", tmp_path / "v.yaml", "--json")
    assert told.exit_code == json.loads(told.stdout)["exit_code"] == 1
    assert "not written" in json.loads(told.stdout)["error"]


def test_the_report_fits_a_terminal_with_the_verdict_first_and_notes_last(tmp_path: Path) -> None:
    """80 columns, also of data that are off by half a metre; micrometres, no exponents."""
    for name, data in (("good", known(1)), ("wild", independent(3, small=(0.5,) * 4, positions=4))):
        path = write(data, tmp_path / f"{name}.csv")
        other = write(independent(8), tmp_path / "other.csv")
        text = run(path, "--test", other).stdout
        lines = text.splitlines()
        assert max(len(line) for line in lines if str(tmp_path) not in line) <= 80
        assert "[um]" in text
        assert "[mm]" not in text
        assert not re.search(r"\de[+-]\d|(?<!\+)-0\.00\b", text)
        paragraphs = text.split("\n\n")
        assert "recommended" in paragraphs[1]
        notes = [k for k, part in enumerate(paragraphs) if part.startswith("note:")]
        assert notes in ([], [len(paragraphs) - 1])
    assert paragraphs[1].startswith("not recommended")
    assert notes  # of few positions


@pytest.mark.long
def test_what_is_not_written_is_said(session: Path, tmp_path: Path) -> None:
    assert "no file written: name one with -o" in run(session).stderr
    bad = write(independent(3, small=(0.5,) * 4), tmp_path / "s.csv")
    assert "no file written: the weights are not recommended" in run(bad).stderr
    out, plot = tmp_path / "w.yaml", tmp_path / "w.png"
    found = json.loads(run(session, "--json", "-o", out, "--plot", plot).stdout)
    assert (found["weights_file"], found["plot"]) == (str(out), str(plot))
    found = json.loads(run(session, "--json").stdout)
    assert (found["weights_file"], found["plot"]) == (None, None)


@pytest.mark.parametrize("as_json", [False, True])
def test_ctrl_c_in_the_drawing_leaves_the_result(
    as_json: bool, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def draw(_result: object) -> bytes:
        raise KeyboardInterrupt

    monkeypatch.setattr("perchctl.weights.draw_weights", draw)
    done = run(session, "--plot", tmp_path / "w.png", *(["--json"] if as_json else []))
    assert done.exit_code == 130
    if as_json:
        found = json.loads(done.stdout)
        assert (found["plot"], found["exit_code"]) == (None, 130)
        assert found["recommended"]
    else:
        assert "recommended weights" in done.stdout
