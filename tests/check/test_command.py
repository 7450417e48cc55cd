"""`perchctl check`: its table, its JSON, its exit codes, Ctrl-C; and what `fly` takes from it."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

pytest.importorskip("mujoco", reason="the simulator needs the extra [sim]")

from perchctl.check import CheckScope, Row, Verdict, camera, check, session
from perchctl.check.capture import BODY_ROWS, COMPARED
from perchctl.commands import app
from perchctl.commands.check import exit_code, format_rows, print_rows
from perchctl.sim import SimProcess
from tests.helpers.checks import NOWHERE, QUICK, VEHICLE, options
from tests.helpers.flights import ROOT

pytestmark = pytest.mark.usefixtures("elsewhere")


# --- The command ------------------------------------------------------------------------


def invoke(*words: str) -> Any:
    return CliRunner().invoke(app, ["check", *words])


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("perchctl.check.CheckScope", lambda **_: CheckScope(**QUICK))


def test_json_is_a_list_of_rows(quick: None) -> None:
    (Path.cwd() / "mine.yaml").write_text(
        "extends: sim\nlink: {connect_timeout_s: 0.4}\n", encoding="utf-8"
    )
    said = invoke("-p", "mine.yaml", "-u", NOWHERE, "--source", "camera:97", "--json")
    rows = json.loads(said.stdout)
    assert all(set(row) == {"name", "verdict", "found", "advice"} for row in rows)
    assert {row["verdict"] for row in rows} <= {v.value for v in Verdict}
    assert said.exit_code == 10
    named = {row["name"]: row for row in rows}
    assert named["camera"]["verdict"] == "fail"
    assert len(named) == len(rows)


@pytest.mark.parametrize(("words", "code", "complaint"), [
    (("-p", "none"), 20, "profile 'none' not found"),
    (("-u", "radio:/0"), 30, "is not the URI of a vehicle"),
    (("--scan", "-u", "radio:/0"), 30, "is not the URI of a vehicle"),
    (("--source", "nonsense:1"), 30, "camera source"),
    (("-u", NOWHERE), 2, "belongs to the simulated vehicle"),
    (("-u", NOWHERE, "--source", "video:old.mp4"), 2, "is a recording"),
])  # fmt: skip
def test_bad_input_is_one_sentence(words: tuple[str, ...], code: int, complaint: str) -> None:
    said = invoke(*words)
    assert said.exit_code == code
    assert said.stdout == ""
    lines = [line for line in said.stderr.splitlines() if "scanning" not in line]
    assert len(lines) == 1
    assert complaint in lines[0]


def test_a_broken_calibration_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "broken.yaml").write_text("no: calibration\n", encoding="utf-8")
    (tmp_path / "p.yaml").write_text("extends: sim\ncamera: {calibration: broken.yaml}\n")
    said = invoke("-p", "p.yaml")
    assert said.exit_code == 30
    assert len(said.stderr.splitlines()) == 1


@pytest.mark.parametrize("stage", ["starting", "connecting", "opening"])
def test_ctrl_c_ends_with_what_was_found(
    stage: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], sim: SimProcess
) -> None:
    def tell(text: str) -> None:
        if text.startswith(stage):
            raise KeyboardInterrupt

    monkeypatch.setattr(session, "start_simulated_vehicle", lambda *_: nullcontext(sim))
    rows = check(options("sim://", "sim:"), CheckScope(**QUICK, announce=tell))
    code = print_rows(rows, as_json=False)
    printed = capsys.readouterr()
    assert code == 130
    assert "Ctrl-C" in printed.err
    assert ("supervisor" in printed.out) is (stage == "opening")
    assert not printed.out or "not finished" in printed.out
    assert "no check failed" not in printed.out


ROWS = [
    Row("address", Verdict.PASS, "sim:// answers"),
    Row(
        "lost frames",
        Verdict.WARN,
        "22 %, longest gap 111 ms " + "and more " * 12,
        "bring it nearer " * 8,
    ),
    Row("battery", Verdict.FAIL, "the resting battery voltage is 3.50 V", "charge it"),
    Row("print", Verdict.SKIPPED, "both markers must be in view", "hold the vehicle closer"),
    Row("level", Verdict.SKIPPED, "the vehicle does not answer"),
]


def test_the_table_fits_80_columns_and_says_what_to_do() -> None:
    lines = format_rows(ROWS).splitlines()
    assert max(map(len, lines)) <= 80
    text = re.sub(r"\s+", " ", " ".join(lines))
    assert "FAIL battery the resting battery voltage is 3.50 V -> charge it" in text
    assert "skip level the vehicle does not answer" in text
    skipped = [replace(ROWS[-1], name=name) for name in ("packets", "telemetry", "level")]
    assert "skip  3 checks         the vehicle does not answer" in format_rows(skipped)
    assert format_rows(skipped).splitlines()[-1].startswith("3 skip")
    assert lines[-1] == "1 pass, 1 warn, 1 FAIL, 2 skip: not fit to fly: battery"
    assert format_rows(ROWS[:2]).splitlines()[-1].endswith("no check failed")
    assert "not finished" in format_rows(ROWS[:2], finished=False).splitlines()[-1]


@pytest.mark.parametrize(("rows", "code"), [
    (ROWS[:2], 0),
    (ROWS, 52),
    ([Row("address", Verdict.FAIL, "")], 10),
    ([Row("camera", Verdict.FAIL, ""), Row("battery", Verdict.FAIL, "")], 20),
    ([Row("address", Verdict.SKIPPED, "")], 0),
])  # fmt: skip
def test_the_exit_code_is_the_first_failing_row_s(rows: list[Row], code: int) -> None:
    assert exit_code(rows) == code


# --- The quick part before a flight -----------------------------------------------------


def test_a_flight_is_refused_for_what_the_profile_or_the_disk_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = type("Usage", (), {"free": 1_000_000, "total": 10**12})
    monkeypatch.setattr("perchctl.check.profile.shutil.disk_usage", lambda path: usage)
    said = CliRunner().invoke(app, ["fly", "-u", NOWHERE, "--source", "camera:97", "--yes"])
    assert said.exit_code == 52
    assert "1 MB free" in said.stderr
    assert "connecting" not in said.stderr


def test_a_flight_says_what_its_profile_makes_doubtful(tmp_path: Path) -> None:
    (tmp_path / "p.yaml").write_text(
        "extends: sim\nsafety: {fence_radius_m: 0.2}\nlink: {connect_timeout_s: 0.4}\n"
    )
    words = ["fly", "-p", "p.yaml", "-u", NOWHERE, "--source", "camera:97", "--yes"]
    said = CliRunner().invoke(app, words)
    warned_of = [line for line in said.stderr.splitlines() if line.startswith("perchctl: check: ")]
    assert any("fence" in line for line in warned_of)
    assert said.exit_code in (10, 20)


def test_every_row_is_on_its_page() -> None:
    page = (ROOT / "docs" / "check.md").read_text(encoding="utf-8")
    others = (COMPARED, camera.IN_VIEW, "capture", "camera", "size", "loop", "log folder")
    for name in (*VEHICLE, *BODY_ROWS, *camera.PICTURES, *others):
        assert f"`{name}`" in page, name
